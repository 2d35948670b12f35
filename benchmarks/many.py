"""A loop over many cases: what it costs beside a plain one, what processes gain, what memory it
takes.

    python benchmarks/many.py                    cost and scaling, some hundred cases
    python benchmarks/many.py --large            100 000 simulations of a slide, 1000 plans
    python benchmarks/many.py --memory [cases]   memory by the number of cases, into a folder
    python benchmarks/many.py --keep [base]      numbers kept of 10 base cases, with Sobol indices

Cost: processor seconds of all processes for a case, by ``simulate_many`` or ``each``, over those
of a plain loop, which is run on a sample of the same cases in the same minute. Scaling: wall time
by one process of our own over that by two; it needs two idle processors. Cases go into a folder
of Parquet files.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

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


def processor() -> float:
    """Seconds of this process and of its children that have ended."""
    both = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(r.ru_utime + r.ru_stime for r in both)


def measured(work: Callable[[], Any]) -> tuple[float, float]:
    """(processor seconds of all processes, seconds by the clock)."""
    begin, clock = processor(), perf_counter()
    work()
    return processor() - begin, perf_counter() - clock


def simulations(count: int, both: bool = True) -> dict[str, float]:
    """Figures of simulations into a folder."""
    plant = slide()
    pam.simulate(plant, **COMMON, **next(pushes(1)))  # integrators are built once
    sample = min(count, SAMPLE)
    chosen = [c for i, c in enumerate(pushes(count)) if i % (count // sample) == 0][:sample]
    plain = measured(lambda: [pam.simulate(plant, **COMMON, **c) for c in chosen])[0] / sample

    def run(processes: int) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as folder:
            return measured(
                lambda: pam.simulate_many(
                    plant, pushes(count), executor=processes, into=folder, **COMMON
                )
            )

    two = run(2)
    found = {
        "simulations, cost of a case / plain loop": two[0] / count / plain,
        "simulations, a case of a plain loop [ms]": 1e3 * plain,
        "simulations, wall, two processes [s]": two[1],
    }
    if both:
        found["simulations, scaling on two processes (wall)"] = run(1)[1] / two[1]
    return found


def plans(count: int, both: bool = True) -> dict[str, float]:
    """Figures of plans."""
    work, masses = Quickest(), np.linspace(1.5, 3.0, count).tolist()
    sample = masses[:: max(1, count // 50)]
    plain = measured(lambda: [work(m) for m in sample])[0] / len(sample)
    two = measured(lambda: pam.each(work, masses, executor=2))
    found = {
        "plans, cost of a case / plain loop": two[0] / count / plain,
        "plans, a case of a plain loop [ms]": 1e3 * plain,
    }
    if both:
        one = measured(lambda: pam.each(work, masses, executor=1))
        found["plans, scaling on two processes (wall)"] = one[1] / two[1]
    return found


def figures(quick: bool) -> dict[str, float]:
    """For run.py: cost, growth with the number of cases, and scaling, which many cases show."""
    if quick:
        found = simulations(60, both=False) | plans(40, both=False)
    else:
        found = simulations(400) | plans(200)
    plant = slide()
    for count in (10, 100) if quick else (10, 100, 1000):
        cases = list(pushes(count))
        work = lambda c=cases: pam.simulate_many(plant, c, executor=2, **COMMON)  # noqa: E731
        seconds, wall = measured(work)
        found[f"simulate_many, a case [ms]@{count}"] = 1e3 * seconds / count
        found[f"simulate_many, two processes, a case, wall [ms]@{count}"] = 1e3 * wall / count
    return found


def memory(count: int) -> None:
    """The largest resident memory at every tenth of short cases, and a worker's."""
    plant, met = pam.HangingLoad("DMSP-20-400N"), {}
    cases = ({"parameters": {"mass": 5.0 + 45.0 * i / count}} for i in range(count))
    short = {"inputs": {"muscle.command": 4e5}, "t": np.linspace(0.0, 0.02, 3), "rtol": 1e-4}

    def note(done: int, _: int | None) -> None:
        if done * 10 // count > len(met):
            met[done] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    with tempfile.TemporaryDirectory() as folder:
        ways = {"executor": 2, "chunk": 500, "into": folder}
        seconds = measured(lambda: pam.simulate_many(plant, cases, progress=note, **ways, **short))
        size = sum(p.stat().st_size for p in Path(folder).rglob("*.*")) / 1e6
    worker = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print("peak memory [MB] after so many cases:")
    print(", ".join(f"{done}: {mb:.0f}" for done, mb in met.items()))
    print(f"{count} cases: {seconds[1]:.0f} s, {size:.0f} MB on disk, a worker {worker:.0f} MB")


def kept(base: int) -> dict[str, float]:
    """Two numbers of a slide's motion, 8 parameters, ten times ``base`` cases."""
    plant = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
    names = [f"muscle{i}.{n}" for i in (1, 2) for n in ("a3", "a4", "lag")]
    starts = {n: plant.variable(n).start for n in ("mass", "damping", *names)}
    ranges = {n: tuple(sorted((0.9 * v, 1.1 * v))) for n, v in starts.items()}
    common = {
        **COMMON,
        "keep": {"x_end": "x.final", "peak": "max(muscle1.force)"},
        "inputs": {"muscle1.command": 4e5, "muscle2.command": 3e5},
    }
    few = pam.simulation.SobolCases(ranges, 64)
    pam.simulate_many(plant, few, executor=0, **common)  # compiled once
    cases, found = pam.simulation.SobolCases(ranges, base), {}
    for rtol in (1e-10, 1e-6):
        with tempfile.TemporaryDirectory() as folder:
            ways = {"executor": 2, "into": folder, "rtol": rtol}
            numbers = []
            work = lambda w=ways, n=numbers: n.append(  # noqa: E731
                pam.simulate_many(plant, cases, **w, **common)
            )
            seconds, wall = measured(work)
            size = sum(p.stat().st_size for p in Path(folder).rglob("*.parquet"))
            found[f"kept, rtol {rtol:g}, a case [ms]"] = 1e3 * seconds / len(cases)
            found[f"kept, rtol {rtol:g}, two processes, a case, wall [ms]"] = (
                1e3 * wall / len(cases)
            )
            found["kept, a case on disk [B]"] = size / len(cases)
            found["Sobol indices of one number [s]"] = measured(
                lambda n=numbers: n[0].sobol("peak")
            )[0]
    return found


def main() -> None:
    print(f"load {os.getloadavg()[0]:.1f}", flush=True)
    if "--memory" in sys.argv:
        memory(int(sys.argv[2]) if len(sys.argv) > 2 else 100_000)
        return
    if "--keep" in sys.argv:
        for name, value in kept(int(sys.argv[2]) if len(sys.argv) > 2 else 2048).items():
            print(f"{name:<52}{value:>10.3f}")
        return
    large = "--large" in sys.argv
    parts = (
        (lambda: simulations(100_000, both=False), lambda: simulations(5000), lambda: plans(1000))
        if large
        else (lambda: simulations(200), lambda: plans(40))
    )
    for part in parts:
        for name, value in part().items():
            print(f"{name:<52}{value:>10.3f}", flush=True)


if __name__ == "__main__":
    main()
