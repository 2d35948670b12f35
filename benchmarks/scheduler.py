"""Job arrays of which some jobs are killed: what they cost, and whether they give the same bits.

    python benchmarks/scheduler.py [--seed S]
    python benchmarks/scheduler.py --array [--jobs 50] [--seed S]

The first simulates a scheduler: jobs wait for a free processor, each computes its slice of the
cases by ``simulate_many(keep=, into=)``, is killed at random, and is started once more; what its
last file did not hold yet is computed again.

The second is one: the shards of a study as processes, two at a time. A tenth of them are killed
(SIGKILL) amid their steps and queued again; the merged folder is compared with one run's.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import random
import resource
import signal
import sys
import tempfile
from collections import deque
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import sleep, time

import pam_ocp.figures.picture  # noqa: F401  # before the forks: most of what a job imports
from pam_ocp.cli.main import main
from pam_ocp.studies.shards import Shard

CASE, START, ROWS = 0.255e-3, 10.0, 100_000
"""Seconds of a case (docs/many.md) and of a job's start (queue, imports, compiler); rows a file."""
BYTES = 35


@dataclass(frozen=True)
class Outcome:
    """wall, processor : [s]. killed : jobs."""

    wall: float
    processor: float
    killed: int


def run(cases: int, jobs: int, processors: int, doomed: float, chance: random.Random) -> Outcome:
    """doomed : probability that a job is killed, at any of its cases, each time it is started."""
    share = -(-cases // jobs)
    waiting = [min(share, cases - i * share) for i in range(jobs) if i * share < cases]
    free = [0.0] * processors
    wall, spent, killed = 0.0, 0.0, 0
    while waiting:
        left, begin = waiting.pop(0), heapq.heappop(free)
        dies = chance.random() < doomed
        done = int(chance.random() * left) if dies else left
        end = begin + START + CASE * done
        if dies:
            killed += 1
            waiting.append(left - done // ROWS * ROWS)
        wall, spent = max(wall, end), spent + end - begin
        heapq.heappush(free, end)
    return Outcome(wall, spent, killed)


# ---- a scheduler of this machine -----------------------------------------------------------------
STUDY = """
title = "Loads"

[steps.load]
kind = "plant"
arrangement = "HangingLoad"
muscle = "DMSP-20-300"
mass = "10 kg"

[steps.lifted]
kind = "simulate"
plant = "load"
inputs = { "muscle.command" = "3 bar" }
duration = "20 ms"
samples = 5

[steps.heavier]
kind = "sweep"
of = "lifted"
vary = { "load.mass" = [MASSES] }
numbers = ["x.last"]
"""


def loads(folder: Path, count: int) -> Path:
    """A study with a sweep of so many masses."""
    path = folder / "loads.toml"
    masses = (f'"{5 + 20 * i / count:.3f} kg"' for i in range(count))
    path.write_text(STUDY.replace("MASSES", ", ".join(masses)))
    return path


def job(words: Sequence[str | Path]) -> BaseProcess:
    """``pam-ocp study`` in a process of its own: a fork of this one, which has imported all."""
    process = get_context("fork").Process(target=_quiet, args=(["study", *map(str, words)],))
    process.start()
    return process


def _quiet(words: list[str]) -> None:
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        sys.exit(main(words))


def array(words: Sequence[str | Path], out: Path, count: int, doomed: set[int]) -> list[int]:
    """All shards, two at a time, each until it has come to its end; those that were killed.

    A doomed one is killed (SIGKILL) once, as soon as its record tells of a step, and queued again.
    Raises RuntimeError where one fails by itself.
    """
    waiting, running, killed = deque(range(1, count + 1)), dict[int, BaseProcess](), list[int]()
    while waiting or running:
        while waiting and len(running) < 2:
            number = waiting.popleft()
            running[number] = job([*words, "--shard", f"{number}/{count}"])
        for number, process in list(running.items()):
            record = out / "shards" / Shard(number, count).name / "shard.json"
            if number in doomed and record.is_file() and json.loads(record.read_bytes())["done"]:
                process.kill()
                process.join()
            if process.exitcode is None:
                continue
            del running[number]
            if number in doomed and process.exitcode == -signal.SIGKILL:
                doomed = doomed - {number}
                killed.append(number)
                waiting.append(number)
            elif process.exitcode:
                raise RuntimeError(f"shard {number} ended with exit code {process.exitcode}")
        sleep(1e-3)
    return killed


def drawn(count: int, chance: random.Random) -> set[int]:
    """A tenth of the shards."""
    return set(chance.sample(range(1, count + 1), max(1, count // 10)))


def written(folder: Path) -> dict[str, bytes]:
    """All that a study wrote, but for the page, which tells when and how long."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name not in ("report.html", ".in-use") and "shards" not in p.parts
    }


def measured_array(count: int, seed: int) -> bool:
    """Run an array of a case for each shard, and the study in one go; whether bits are equal."""
    doomed = drawn(count, random.Random(seed))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        path, out, one = loads(folder, count), folder / "out", folder / "one"
        words = [path, "--out", out, "--cache", folder / "kept"]
        killed = array(words, out, count, doomed)
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        for rest in ([*words, "--merge"], [path, "--out", one, "--cache", folder / "other"]):
            process = job(rest)
            process.join()
            assert process.exitcode == 0, rest
        files = written(out)
        same = files == written(one)
    print(f"seed {seed}: {count} shards of {2 * count + 2} steps; killed amid their work: {killed}")
    print(f"{spent.ru_utime + spent.ru_stime:.0f} s of processor for all jobs, without imports")
    print(f"{len(files)} files merged, equal to one run's bit for bit: {same}")
    return same and set(killed) == doomed


def run_as_told() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=int(time()))
    parser.add_argument("--array", action="store_true", help="run one on this machine")
    parser.add_argument("--jobs", type=int, default=50)
    options = parser.parse_args()
    if options.array:
        return 0 if measured_array(options.jobs, options.seed) else 1
    model(options.seed)
    return 0


def model(seed: int) -> None:
    """Print what the simulated scheduler costs."""
    print(f"seed {seed}; a tenth of the jobs killed, as often as they are started")
    print("cases        jobs  processors  wall [min]  processor [h]  more than unkilled  disk [GB]")
    for cases, jobs, processors in ((10**6, 50, 2), (10**6, 50, 50), (10**8, 200, 50)):
        found = run(cases, jobs, processors, 0.1, random.Random(seed))
        plain = run(cases, jobs, processors, 0.0, random.Random(seed))
        more = found.processor / plain.processor - 1
        print(
            f"{cases:<12} {jobs:<5} {processors:<11} {found.wall / 60:<11.1f} "
            f"{found.processor / 3600:<14.2f} {100 * more:<19.1f} {cases * BYTES / 1e9:.2f}"
        )


if __name__ == "__main__":
    sys.exit(run_as_told())
