"""Does the ladder find which effect a rig has? Random rigs with one effect each beside their lag.

    python benchmarks/ladder_study.py [--seed N] [--rigs 1] [EFFECT ...]

Effects: lag (nothing else), dead time, slew, friction, memory, creep. A rig is an antagonistic
slide with a random mass, damping, gain, base pressure, lag, and a random size of its effect; two
records of random steps, measured with 20 um of noise, are climbed by ``fit_ladder`` with all seven
rungs. Printed: the rung that is marked, whether it is the effect's, the parameters outside their
95 % intervals, processor seconds. Without --seed it comes from the clock, and is printed.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from functools import partial
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.plants.losses import CoulombFriction, Creep, MaxwellSlip

EFFECTS = ("lag", "dead time", "slew", "friction", "memory", "creep")
SAMPLE = 0.01
NOISE = 2e-5
YIELDS = (0.003, 0.015)


def truth(effect: str, rng: np.random.Generator) -> tuple[pam.Plant, Any, dict[str, float]]:
    """The rig, what builds plants like it, and its parameters by the ladder's names."""
    between = lambda low, high: float(rng.uniform(low, high))  # noqa: E731
    values = {"damping": between(30, 80), "muscle1.lag": between(0.03, 0.08)}
    values["muscle1.gain"] = between(0.9e5, 1.1e5)
    build = partial(pam.AntagonisticSlide, "DMSP-20-200N", between(1.0, 4.0))
    more: dict[str, Any] = {}
    losses: tuple[Any, ...] = ()
    if effect == "dead time":
        more["dead_time"] = values["difference.dead_time"] = between(0.008, 0.03)
    elif effect == "slew":
        more["slew"] = values["muscle1.slew"] = between(5e5, 1.5e6)
    elif effect == "friction":
        values["muscle1.friction_constant"] = between(5, 20)
        losses = (CoulombFriction(values["muscle1.friction_constant"], speed=3e-3),)
    elif effect == "memory":
        forces = between(5, 15), between(5, 15)
        values |= {"muscle1.slip1_force": forces[0], "muscle1.slip2_force": forces[1]}
        losses = (MaxwellSlip(forces, YIELDS, edge=1.0),)
    elif effect == "creep":
        stiff, slow = between(300, 900), between(0.5, 2.0)
        values |= {"muscle1.creep1_stiffness": stiff, "muscle1.creep1_time": slow}
        losses = (Creep((stiff,), (slow,)),)
    feed = pam.feeds.PairRegulator(
        lag=values["muscle1.lag"], gain=values["muscle1.gain"], base=2.4e5, max_pressure=6e5, **more
    )
    return build(feed=feed, losses=losses, damping=values["damping"]), build, values


def recorded(plant: pam.Plant, rng: np.random.Generator) -> pam.Trajectory:
    """Five seconds of random steps from rest."""
    t = np.arange(0, 5, SAMPLE)
    steps = [0.0]
    while len(steps) < len(t):
        steps += [rng.uniform(-1.5, 1.5)] * int(rng.integers(15, 90))
    volts = np.array(steps[: len(t)])
    run = pam.simulate(
        plant, {"difference": volts}, t=t, dead_times="exact", rtol=1e-8,
        start=plant.equilibrium(difference=0.0),
    )  # fmt: skip
    x = run["x"] + NOISE * rng.standard_normal(len(t))
    variables = [plant.variable(n) for n in ("difference", "x")]
    return pam.Trajectory(t, {"difference": volts, "x": x}, variables, "previous")


def climbed(effect: str, rng: np.random.Generator) -> str:
    """A line of the table."""
    plant, build, values = truth(effect, rng)
    records = [recorded(plant, rng) for _ in range(2)]
    feed = pam.feeds.PairRegulator(gain=1e5, base=2.4e5, max_pressure=6e5)
    begin = processor_seconds()
    ladder = pam.fitting.fit_ladder(build, records, ["muscle*.gain"], feed=feed, folds=3)
    spent = processor_seconds() - begin
    marked = ladder.chosen.name.removeprefix("+ ")
    outside, count = [], 0
    for name, (low, high) in ladder.intervals().items():
        true = next((v for n, v in values.items() if n in name or _same(n, name)), None)
        if true is None:
            continue
        count += 1
        if not low <= true <= high:
            outside.append(f"{name} {low:.4g} .. {high:.4g}, true {true:.4g}")
    print(ladder.report(), flush=True)
    right = "yes" if marked == effect else "NO"
    return f"| {effect} | {marked} | {right} | {count} | {'; '.join(outside)} | {spent:.0f} |"


def processor_seconds() -> float:
    """Of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def _same(name: str, key: str) -> bool:
    """Whether a coefficient tied over all muscles is that of the first."""
    return name.partition(".")[2] == key.partition("*.")[2] != ""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("effects", nargs="*", default=EFFECTS, metavar="EFFECT")
    options.add_argument("--seed", type=int, default=time.time_ns() // 10**9)
    options.add_argument("--rigs", type=int, default=1, help="of each effect")
    given = options.parse_args()
    warnings.simplefilter("ignore")
    print("seed", given.seed)
    lines = []
    for i, effect in enumerate(EFFECTS):
        for k in range(given.rigs):
            if effect in given.effects:
                lines.append(climbed(effect, np.random.default_rng([given.seed, i, k])))
                print(lines[-1], flush=True)
    print(
        "\n| effect | marked | right | parameters | outside 95 % | s |\n|---|---|---|---|---|---|"
    )
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
