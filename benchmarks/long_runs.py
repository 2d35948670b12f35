"""Long runs: whether memory and open files stay as they are, and answers too.

    python benchmarks/long_runs.py [--share 1.0]
        [--only day_c day_fmu loop mpc plans exports stream]

day_c, day_fmu : an Mpc (horizon 5) and its plant for a day at 1 kHz, 86.4 million steps, in a
          program in C (day.c): the Mpc as exported C, and as FMU. The plant is an FMU in both.
loop    : an Mpc (horizon 50) and its plant as FMUs from Python, a million steps at 1 kHz.
mpc     : 1e5 steps of an Mpc in Python.
plans   : 1e4 times a plan is solved again.
exports : 1e3 times a plant is exported, loaded and stepped (compiled once).
stream  : 1e5 cases whose numbers go to a folder.

Each runs in a process of its own; ``--share`` takes that part of it. Memory and files at the end
are compared with those after a fifth. Answers are compared where the same is asked again. Exit code
1 where something grew or differs.
"""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
from mpc import predicted

import pam_ocp as pam
from pam_ocp.export.runner import Runner, UnpackedFmu

STEP = 1e-3
PERIOD = 500
"""Steps of the wanted square wave."""
TRACKED = {"x": 1.0, "muscle1.pressure": 0.1}
"""The pressure, too: else nothing holds both muscles' tension at a level."""
GROWTH = 2.0
"""Memory that may come [MB] between a fifth of the way and its end, for all that is cached late."""
SAME = 1e-6
"""Difference of answers, relative to the largest, that is allowed where a loop settles to them."""


@dataclass
class Meter:
    """Resident memory [MB] and open files along the way."""

    count: int
    notes: list[tuple[float, int]] = field(default_factory=list)

    def note(self, done: int) -> None:
        """At each hundredth of the way: what is in use, not what the collector will free at its
        next turn (an FMU that was closed is a ring of objects of FMPy).
        """
        if done * 100 // self.count > len(self.notes):
            gc.collect()
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            memory = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            self.notes.append((memory, len(os.listdir("/proc/self/fd"))))

    def row(self, differ: float, allowed: float) -> harness.Row:
        """Flat where nothing grew, and answers differ by no more than is allowed."""
        (before, files), (after, more) = self.notes[len(self.notes) // 5], self.notes[-1]
        good = after - before < GROWTH and more <= files and differ <= allowed
        text = (
            f"{self.count} times; memory {before:.1f} -> {after:.1f} MB, files {files} -> {more}; "
            f"answers differ by {differ:.1e}"
        )
        return {"verdict": "flat" if good else "NOT FLAT OR NOT EQUAL", "text": text}


def controller(sample_time: float) -> tuple[pam.Plant, Any, Any]:
    """A slide, its Mpc, and where both begin."""
    plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
    rate = dict.fromkeys((v.name for v in plant.inputs), 0.1)
    ask: dict[str, Any] = {"track": TRACKED, "rate": rate, "iterations": 1}
    horizon = round(0.05 / sample_time)
    mpc = pam.control.Mpc(plant, horizon=horizon, sample_time=sample_time, **ask)
    return plant, mpc, plant.equilibrium(x=0.0, stiffness=1.5e4)


def wanted(k: int) -> dict[str, float]:
    """The square wave [m] at a step, and the pressure [Pa]."""
    return {"x": 0.002 if k % PERIOD < PERIOD // 2 else -0.002, "muscle1.pressure": 2.5e5}


def unit(path: Path, start: dict[str, float]) -> Runner:
    """An FMU in co-simulation, loaded into this process; unpacked beside its file."""
    made = Runner(UnpackedFmu(path, path.with_suffix("")), "CoSimulation")
    made.initialize(start, 0.0, None)
    return made


def settled(count: int, step: Callable[[int], float]) -> harness.Row:
    """So many steps of a loop in whole periods; whether the last period is as the fourth."""
    count = max(5, count // PERIOD) * PERIOD
    meter, fourth, last = Meter(count), np.zeros(PERIOD), np.zeros(PERIOD)
    for k in range(count):
        last[k % PERIOD] = step(k)
        if k == 4 * PERIOD - 1:
            fourth[:] = last
        meter.note(k + 1)
    return meter.row(float(np.abs(last - fourth).max() / np.abs(fourth).max()), SAME)


def loop(count: int) -> harness.Row:
    plant, mpc, rest = controller(STEP)
    commands = [v.name for v in plant.inputs]
    states = [v.name for v in plant.states]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, n) for n in ("mpc.fmu", "slide.fmu")]
        for path, what in zip(paths, (pam.control.block(mpc), plant), strict=True):
            pam.export_fmu(what, path, platforms="native", fmi="2.0")
        begin = {n: rest[n] for n in states}
        given = {**begin, **{n: rest[n] for n in commands}}
        with unit(paths[0], begin) as control, unit(paths[1], given) as slide:

            def step(k: int) -> float:
                seen = dict(zip(states, slide.get(states), strict=True))
                control.set({**seen, **{f"wanted.{n}": v for n, v in wanted(k).items()}})
                control.step(k * STEP, STEP)
                slide.set(dict(zip(commands, control.get(commands), strict=True)))
                slide.step(k * STEP, STEP)
                return seen["x"]

            return settled(count, step)


def day(count: int, in_c: bool) -> harness.Row:
    """As ``loop``, all of it in C; the hash of all commands is printed: equal for both."""
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0)
    ask: dict[str, Any] = {"track": {"x": 1.0, "v": 0.03}, "rate": {"muscle.command": 0.01}}
    mpc = pam.control.Mpc(plant, horizon=5, sample_time=STEP, iterations=1, **ask)
    rest = plant.equilibrium(x=0.02)
    states, commands = ([v.name for v in kind] for kind in (plant.states, plant.inputs))
    begin = [repr(float(rest[n])) for n in (*states, *commands)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = [*library(plant, folder, "load", [*states, *commands]), *begin]
        build = ["-std=c11", "-O2", "-ffp-contract=off", str(Path(__file__).with_name("day.c"))]
        if in_c:
            pam.export_c(mpc, folder / "c", name="mpc")
            build += ["-DCONTROLLER_IN_C", "-I", str(folder / "c"), str(folder / "c" / "mpc.c")]
        else:
            block = pam.control.block(mpc)
            given += library(block, folder, "mpc", [*states, "wanted.x", "wanted.v", *commands])
        program = [str(folder / "day")]
        subprocess.run(["cc", *build, "-o", *program, "-lm", "-ldl"], check=True)
        count = max(5, count // PERIOD) * PERIOD
        told = subprocess.run(
            [*program, str(count), str(PERIOD), *given], capture_output=True, text=True, check=True
        )
    *numbers, commands_hash = told.stdout.split()
    before, files, after, more, differ = map(float, numbers)
    meter = Meter(count, [(before, int(files)), (after, int(more))])
    row = meter.row(differ, SAME)
    return {**row, "text": f"{row['text']}; hash of all commands {commands_hash}"}


def library(what: Any, folder: Path, name: str, variables: Sequence[str]) -> list[str]:
    """Of its exported FMU: the shared library, the token, references of variables."""
    path = pam.export_fmu(what, folder / f"{name}.fmu", platforms="native", fmi="2.0")
    unit = UnpackedFmu(path, folder / name)
    found = next((unit.folder / "binaries").rglob("*.so"))
    return [str(found), unit.description.guid, *(str(unit.references[n]) for n in variables)]


def mpc(count: int) -> harness.Row:
    plant, regulator, rest = controller(0.005)
    regulator.reset({v.name: rest[v.name] for v in plant.inputs})
    state = np.array(rest.x)

    def step(k: int) -> float:
        nonlocal state
        regulator.control(state, wanted(k))
        state = predicted(plant, regulator)
        return float(state[0])

    return settled(count, step)


def plans(count: int) -> harness.Row:
    plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
    stops = [{"x": -0.01}, {"x": 0.01}]
    planner = pam.Planner(plant, stops, method=pam.Collocation(20, 3))
    first, meter = planner(), Meter(count)
    durations = np.zeros((2, 5))  # of the first five masses' turn, and of the latest
    for k in range(count):
        durations[1, k % 5] = planner({"mass": 1.5 + 0.25 * (k % 5)}, guess=first).duration
        if k == 4:
            durations[0] = durations[1]
        meter.note(k + 1)
    return meter.row(float(np.abs(durations[1] / durations[0] - 1).max()), 0.0)


def exports(count: int) -> harness.Row:
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0)
    meter, found = Meter(count), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "load.fmu")
        for k in range(count):
            pam.export_fmu(plant, path, platforms="native", fmi="2.0")
            with unit(path, {"muscle.command": 3e5}) as load:
                load.step(0.0, STEP)
                found = [*found[:1], load.get(["x"])[0]]
            meter.note(k + 1)
    return meter.row(abs(found[-1] - found[0]), 0.0)


def stream(count: int) -> harness.Row:
    plant, meter = pam.HangingLoad("DMSP-20-300"), Meter(count)

    def cases() -> Iterator[dict[str, Any]]:
        for k in range(count):
            yield {"parameters": {"mass": 5.0 + 0.01 * (k % 1000)}}

    ask: dict[str, Any] = {"keep": {"x_end": "x.final"}, "inputs": {"muscle.command": 3e5}}
    with tempfile.TemporaryDirectory() as folder:
        places: dict[str, Any] = {"into": folder, "chunk": max(1000, count // 20), "executor": 0}
        told = lambda done, _: meter.note(done)  # noqa: E731
        kept = pam.simulate_many(plant, cases(), duration=0.1, progress=told, **ask, **places)
        numbers = kept["x_end"]
    return meter.row(float(np.abs(numbers[-1000:] - numbers[:1000][: len(numbers)]).max()), 1e-9)


day_c, day_fmu = partial(day, in_c=True), partial(day, in_c=False)
RUNS = {
    "day_c": 86_400_000,
    "day_fmu": 86_400_000,
    "loop": 10**6,
    "mpc": 10**5,
    "plans": 10**4,
    "exports": 10**3,
    "stream": 10**5,
}


def cases(given: harness.Given) -> harness.Keyed:
    for name, count in RUNS.items():
        yield name, partial(globals()[name], max(100, round(count * given.share)))


OPTIONS = {"--share": {"type": float, "default": 1.0, "help": "of each run"}}

if __name__ == "__main__":
    rows = harness.main(__doc__, cases, options=OPTIONS, seconds=math.inf)
    sys.exit(any(row["verdict"] != "flat" for row in rows))
