"""Plants fed by valves with a dead zone, from closed rest: do LQR, its trajectory and Mpc arrive?

Random masses, muscles, set points, overlaps, tubes, spools and pairs of on-off valves on a hanging
load, a spring, a slide and a joint. Figures: the largest distance from the set point over the last
0.1 s of a run of 1.5 s (Mpc 1 s), as a part of the way; wanted is 1 % of the stroke.

Run:  python benchmarks/valve_study.py [cases] [seed]
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.control import closed_loop

KINDS = ("hanging", "spring", "slide", "joint")
STEP = 4e-3
"""Sample time of state feedback [s]; of Mpc 0.01."""


def fed(rng: np.random.Generator) -> tuple[str, Any]:
    """A random valve, in words and as a feed."""
    overlap = float(rng.choice([0.0, 0.02, 0.05, 0.1]))
    kind = rng.choice(["spool", "spool", "tube", "on-off"])
    if kind == "spool":
        return f"spool, overlap {overlap}", pam.feeds.SpoolValve(overlap=overlap)
    if kind == "tube":
        return f"spool, overlap {overlap}, tube", pam.feeds.SpoolValve(
            overlap=overlap, tube=pam.feeds.Tube()
        )
    return "on-off valves", pam.feeds.OnOffValves()


def drawn(rng: np.random.Generator, kind: str) -> tuple[str, pam.Plant, str, Any, Any]:
    """(words, plant, position, closed rest, set point), a way of 10 to 40 % of what there is."""
    words, feed = fed(rng)
    name = str(rng.choice(["DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300"]))
    muscle = pam.muscle(name)
    if kind in ("hanging", "spring"):
        plant: pam.Plant = (
            pam.HangingLoad(muscle, rng.uniform(8, 30), feed=feed)
            if kind == "hanging"
            else pam.SpringOverMuscle(muscle, rng.uniform(1, 4), feed=feed)
        )
        low, high = np.sort(rng.uniform(1.5e5, 4.5e5, 2))
        ends = (plant.equilibrium({"muscle.pressure": p}) for p in (low, max(high, low + 5e4)))
        return f"{kind}, {name}, {words}", plant, "x", *ends
    if kind == "slide":
        plant = pam.AntagonisticSlide(muscle, rng.uniform(1, 6), feed=feed)
        x, unit = "x", 0.02 * muscle.rest_length
    else:
        plant = pam.AntagonisticJoint(
            muscle, link_mass=rng.uniform(0.5, 2), link_length=0.2, feed=feed
        )
        x, unit = "theta", 0.2
    start, goal = rng.uniform(-1, -0.2) * unit, rng.uniform(0.2, 1) * unit
    mean = rng.uniform(2.0e5, 3.2e5)
    stiffness = plant.equilibrium({"muscle1.pressure": mean, "muscle2.pressure": mean})["stiffness"]
    ends = (plant.equilibrium({x: at, "stiffness": stiffness}) for at in (start, goal))
    return f"{kind}, {name}, {words}", plant, x, *ends


def missed(run: pam.Trajectory, x: str, start: Any, goal: Any) -> float:
    late = run.t >= run.t[-1] - 0.1
    return float(np.abs(run[x][late] - goal[x]).max() / abs(goal[x] - start[x]))


def arrivals(plant: pam.Plant, x: str, start: Any, goal: Any) -> tuple[float, float, float]:
    """What LQR, its trajectory from a tenth of the way beside it, and Mpc miss."""
    begin = {v.name: start[v.name] for v in plant.states}
    loop: dict[str, Any] = {"duration": 1.5, "sample_time": STEP, "rtol": 1e-6}
    still = pam.lqr(plant, goal, sample_time=STEP)
    motion = closed_loop(still, plant, start=begin, **loop).trajectory
    times = np.linspace(0, 1.5, 151)
    along = pam.control.tvlqr(plant, motion, t=times, sample_time=STEP, rtol=1e-5)
    beside = begin | {x: begin[x] + 0.1 * (goal[x] - start[x])}
    again = closed_loop(along, plant, start=beside, **loop).trajectory
    pair = "stiffness" in [v.name for v in plant.outputs] and len(plant.inputs) > 1
    track = {x: 1.0} | ({"stiffness": 0.05} if pair else {})
    rate = {v.name: 0.05 for v in plant.inputs}
    mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, track=track, rate=rate)
    led = mpc.closed_loop(plant, {n: goal[n] for n in track}, 1.0, start=begin)
    failed = np.inf if led.statistics.failures else 0.0
    runs = (motion, again, led.trajectory)
    first, second, third = (missed(run, x, start, goal) for run in runs)
    return first, second, third + failed


def main(cases: int = 24, seed: int = 1) -> None:
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(cases):
        words, plant, x, start, goal = drawn(rng, KINDS[i % len(KINDS)])
        rows.append(arrivals(plant, x, start, goal))
        shown = "  ".join(f"{100 * value:8.3f}" for value in rows[-1])
        print(f"{i:3d} {shown}  {start[x]:.4g} to {goal[x]:.4g}  {words}", flush=True)
    for name, column in zip(("lqr", "tvlqr", "Mpc"), np.array(rows).T, strict=True):
        print(f"{name:6s} {np.sum(column < 0.01)} of {len(column)} within 1 % of the way,", end=" ")
        print(f"median {100 * np.median(column):.3f} %, worst {100 * column.max():.3f} %")


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
