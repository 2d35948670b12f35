"""A loop over many cases: what it costs beside a plain one, what processes gain, what memory it
takes, what is lost where jobs are killed.

    python benchmarks/many.py                    cost and scaling, some hundred cases
    python benchmarks/many.py large              100 000 simulations of a slide, 1000 plans
    python benchmarks/many.py memory [cases]     memory by the number of cases, into a folder
    python benchmarks/many.py keep [base]        numbers kept of 10 base cases, with Sobol indices
    python benchmarks/many.py scheduler [seed]   job arrays on a simulated scheduler
    python benchmarks/many.py array [jobs]       the shards of a study as processes, two at a time

Cost: processor seconds of all processes for a case, by ``simulate_many`` or ``each``, over those
of a plain loop, which is run on a sample of the same cases in the same minute. Scaling: wall time
by one process of our own over that by two; it needs two idle processors. Cases go into a folder
of Parquet files.

scheduler: jobs wait for a free processor, each computes its slice of the cases by
``simulate_many(keep=, into=)``, is killed at random, and is started once more; what its last file
did not hold yet is computed again. array: a tenth of the shards are killed (SIGKILL) amid their
steps and queued again; the merged folder is compared with one run's.
"""

from __future__ import annotations

import heapq
import os
import random
import resource
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import time
from typing import Any

import harness
import numpy as np
from harness import took

import pam_ocp as pam

SAMPLE = 200
"""Cases of the plain loop, where there are more."""
COMMON: dict[str, Any] = {"t": np.linspace(0.0, 1.0, 51)}
STOPS = [{"x": -0.01}, {"x": 0.01}]


def slide() -> pam.Plant:
    """A slide between two muscles, each behind a proportional valve."""
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-400N"), feed=pam.feeds.SpoolValve())


def pushes(count: int) -> Iterator[dict[str, Any]]:
    """Loads and openings of the valves."""
    for i in range(count):
        share = i / count
        opening = {"muscle1.command": 0.1 + 0.3 * share, "muscle2.command": 0.2 - 0.3 * share}
        yield {"parameters": {"mass": 1.0 + 4.0 * share}, "inputs": opening}


class Quickest:
    """The quickest motion of a load, from the solution for another."""

    def __init__(self) -> None:
        plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
        self.planner = pam.Planner(plant, STOPS, method=pam.Collocation(20, 3))
        self.first = self.planner()

    def __call__(self, mass: float) -> float:
        return self.planner({"mass": mass}, guess=self.first).duration

    def __reduce__(self) -> tuple[Any, ...]:
        return Quickest, ()


def simulations(count: int, both: bool = True) -> dict[str, float]:
    """Figures of simulations into a folder."""
    plant = slide()
    pam.simulate(plant, **COMMON, **next(pushes(1)))  # integrators are built once
    sample = min(count, SAMPLE)
    chosen = [c for i, c in enumerate(pushes(count)) if i % (count // sample) == 0][:sample]
    plain = took(lambda: [pam.simulate(plant, **COMMON, **c) for c in chosen]).processor / sample

    def run(processes: int, count: int = count) -> harness.Took:
        with tempfile.TemporaryDirectory() as folder:
            ways = {"executor": processes, "into": folder}
            return took(lambda: pam.simulate_many(plant, list(pushes(count)), **ways, **COMMON))

    run(2, 4)  # as in all figures: what is loaded once in a process is no case's cost
    two = run(2)
    found = {
        "simulations, cost of a case / plain loop": two.processor / count / plain,
        "simulations, a case of a plain loop [ms]": 1e3 * plain,
        "simulations, wall, two processes [s]": two.clock,
    }
    if both:
        found["simulations, scaling on two processes (wall)"] = run(1).clock / two.clock
    return found


def plans(count: int, both: bool = True) -> dict[str, float]:
    """Figures of plans."""
    work, masses = Quickest(), np.linspace(1.5, 3.0, count).tolist()
    sample = masses[:: max(1, count // 50)]
    plain = took(lambda: [work(m) for m in sample]).processor / len(sample)
    two = took(lambda: pam.each(work, masses, executor=2))
    found = {
        "plans, cost of a case / plain loop": two.processor / count / plain,
        "plans, a case of a plain loop [ms]": 1e3 * plain,
    }
    if both:
        one = took(lambda: pam.each(work, masses, executor=1))
        found["plans, scaling on two processes (wall)"] = one.clock / two.clock
    return found


def figures(quick: bool) -> dict[str, float]:
    """For run.py: cost, growth with the number of cases, and scaling, which many cases show."""
    sizes = (60, 40) if quick else (400, 200)
    found = simulations(sizes[0], both=not quick) | plans(sizes[1], both=not quick)
    plant = slide()
    for count in (10, 100) if quick else (10, 100, 1000):
        run = took(partial(pam.simulate_many, plant, list(pushes(count)), executor=2, **COMMON))
        found[f"simulate_many, a case [ms]@{count}"] = 1e3 * run.processor / count
        found[f"simulate_many, two processes, a case, wall [ms]@{count}"] = 1e3 * run.clock / count
    return found


# ---- memory and numbers ----------------------------------------------------------------------
def peak(who: int = resource.RUSAGE_SELF) -> float:
    """Largest resident memory so far [MB], of this process or of ended children."""
    return resource.getrusage(who).ru_maxrss / 1024


def memory(count: int) -> None:
    """The largest resident memory at every tenth of short cases, and a worker's."""
    plant, met = pam.HangingLoad("DMSP-20-400N"), dict[int, float]()
    cases = ({"parameters": {"mass": 5.0 + 45.0 * i / count}} for i in range(count))
    short = {"inputs": {"muscle.command": 4e5}, "t": np.linspace(0.0, 0.02, 3), "rtol": 1e-4}

    def note(done: int, _: int | None) -> None:
        if done * 10 // count > len(met):
            met[done] = peak()

    with tempfile.TemporaryDirectory() as folder:
        ways = {"executor": 2, "chunk": 500, "into": folder}
        run = took(lambda: pam.simulate_many(plant, cases, progress=note, **ways, **short))
        size = sum(p.stat().st_size for p in Path(folder).rglob("*.*")) / 1e6
    print("peak memory [MB] after so many cases:")
    print(", ".join(f"{done}: {mb:.0f}" for done, mb in met.items()))
    worker = peak(resource.RUSAGE_CHILDREN)
    print(f"{count} cases: {run.clock:.0f} s, {size:.0f} MB on disk, a worker {worker:.0f} MB")


def eight(base: int) -> tuple[pam.Plant, pam.simulation.SobolCases, dict[str, Any]]:
    """A slide, ten times ``base`` cases of 8 parameters, and what is kept of their motions."""
    plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
    names = [f"muscle{i}.{n}" for i in (1, 2) for n in ("a3", "a4", "lag")]
    starts = {n: plant.variable(n).start for n in ("mass", "damping", *names)}
    ranges = {n: tuple(sorted((0.9 * v, 1.1 * v))) for n, v in starts.items()}
    common = {
        **COMMON,
        "keep": {"x_end": "x.final", "peak": "max(muscle1.force)"},
        "inputs": {"muscle1.command": 4e5, "muscle2.command": 3e5},
    }
    return plant, pam.simulation.SobolCases(ranges, base), common


def kept(base: int) -> dict[str, float]:
    """Two numbers of a slide's motion, 8 parameters, ten times ``base`` cases."""
    plant, few, common = eight(64)
    pam.simulate_many(plant, few, executor=0, **common)  # compiled once
    cases, found = eight(base)[1], {}
    count = len(cases)
    for rtol in (1e-10, 1e-6):
        with tempfile.TemporaryDirectory() as folder:
            ways = {"executor": 2, "into": folder, "rtol": rtol}
            run = took(partial(pam.simulate_many, plant, cases, **ways, **common))
            size = sum(p.stat().st_size for p in Path(folder).rglob("*.parquet"))
            indices = took(partial(run.result.sobol, "peak"))
        found[f"kept, rtol {rtol:g}, a case [ms]"] = 1e3 * run.processor / count
        found[f"kept, rtol {rtol:g}, two processes, a case, wall [ms]"] = 1e3 * run.clock / count
        found["kept, a case on disk [B]"] = size / count
        found["Sobol indices of one number [s]"] = indices.processor
    return found


# ---- job arrays ----------------------------------------------------------------------------------
CASE, START, ROWS = 0.255e-3, 10.0, 100_000
"""Seconds of a case (docs/many.md) and of a job's start (queue, imports, compiler); rows a file."""
BYTES = 35


def scheduled(
    cases: int, jobs: int, processors: int, doomed: float, chance: random.Random
) -> tuple[float, float]:
    """(wall, processor) seconds. doomed : probability that a job is killed, at any of its cases,
    each time it is started.
    """
    part = -(-cases // jobs)
    waiting = [min(part, cases - i * part) for i in range(jobs) if i * part < cases]
    free = [0.0] * processors
    wall, busy = 0.0, 0.0
    while waiting:
        left, begin = waiting.pop(0), heapq.heappop(free)
        dies = chance.random() < doomed
        done = int(chance.random() * left) if dies else left
        end = begin + START + CASE * done
        if dies:
            waiting.append(left - done // ROWS * ROWS)
        wall, busy = max(wall, end), busy + end - begin
        heapq.heappush(free, end)
    return wall, busy


def scheduler(seed: int) -> None:
    """What the simulated scheduler costs."""
    print(f"seed {seed}; a tenth of the jobs killed, as often as they are started")
    rows = []
    for cases, jobs, processors in ((10**6, 50, 2), (10**6, 50, 50), (10**8, 200, 50)):
        wall, busy = scheduled(cases, jobs, processors, 0.1, random.Random(seed))
        plain = scheduled(cases, jobs, processors, 0.0, random.Random(seed))[1]
        more, size = f"{100 * (busy / plain - 1):.1f} %", cases * BYTES / 1e9
        rows.append([cases, jobs, processors, wall / 60, busy / 3600, more, size])
    heads = ("cases", "jobs", "processors", "wall [min]", "processor [h]", "lost", "disk [GB]")
    print(harness.table(heads, rows))


def array(count: int) -> bool:
    """Run an array of a case for each shard, and the study in one go; whether bits are equal."""
    harness.importable("tests/studies")
    import job_array as jobs

    doomed = jobs.drawn(count, random.Random(int(time())))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        path, out, one = jobs.loads(folder, count), folder / "out", folder / "one"
        words = [path, "--out", out, "--cache", folder / "kept"]
        run = took(lambda: jobs.array(words, out, count, doomed))
        for rest in ([*words, "--merge"], [path, "--out", one, "--cache", folder / "other"]):
            process = jobs.job(rest)
            process.join()
            assert process.exitcode == 0, rest
        files = jobs.written(out)
        same = files == jobs.written(one)
    print(f"{count} shards of {2 * count + 2} steps; killed amid their work: {run.result}")
    print(f"{run.processor:.0f} s of processor for all jobs, without imports")
    print(f"{len(files)} files merged, equal to one run's bit for bit: {same}")
    return same and set(run.result) == doomed


# ---- the command line ----------------------------------------------------------------------------
def shown(found: dict[str, float]) -> None:
    for name, value in found.items():
        print(f"{name:<52}{value:>10.3f}", flush=True)


def usual(_: int) -> None:
    shown(simulations(200))
    shown(plans(40))


def large(_: int) -> None:
    shown(simulations(100_000, both=False))
    shown(simulations(5000))
    shown(plans(1000))


WAYS: dict[str, tuple[Callable[[int], bool | None], int]] = {
    "": (usual, 0),
    "large": (large, 0),
    "memory": (memory, 100_000),
    "keep": (lambda base: shown(kept(base)), 2048),
    "scheduler": (scheduler, int(time())),
    "array": (array, 50),
}
"""What is asked for: (function of a number, usual number)."""


def main(what: str = "", number: str = "") -> int:
    print(f"load {os.getloadavg()[0]:.1f}", flush=True)
    way, usually = WAYS[what]
    return int(way(int(number or usually)) is False)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
