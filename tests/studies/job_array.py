"""A job array on this machine: shards of a study as processes, some of them killed amid their steps
and queued again. ``benchmarks/many.py --array`` runs a large one.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import redirect_stdout
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import sleep

import pam_ocp.figures.picture  # noqa: F401  # before the forks: most of what a job imports
from pam_ocp.cli.main import main
from pam_ocp.studies.shards import Shard

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
