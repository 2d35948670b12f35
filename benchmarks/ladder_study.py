"""From a staircase to a prediction of random motion: an antagonistic joint that no plant here is.

    python benchmarks/ladder_study.py [4] [--seed N] [--table FILE]

The rig is SciPy's alone: two muscles by the law of Chou and Hannaford with ends and a spring of
their own, hysteresis in proportion to the force, unequal pulleys, lengths and regulators, friction
and a pendulum, all at random. A staircase of both commands is all that the ladder sees; its
plant begins as a catalogue's muscle on a joint of a guessed size. Random commands judge: how much
of each signal is predicted, 1 - RMSE / standard deviation, in runs without a correction, and how
many of the samples lie in bands of 90 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TypeAlias

import harness
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import pam_ocp as pam

Array: TypeAlias = NDArray[np.float64]

STEP = 0.01
NOISE = np.array([2e-4, 300.0, 300.0])
"""Of the angle [rad] and of both pressures [Pa]."""
SIGNALS = ("theta", "muscle1.pressure", "muscle2.pressure")
COMMANDS = ("muscle1.command", "muscle2.command")
FREE = ("inertia", "link_mass", "muscle1.a4", "muscle2.a4", "muscle2.a5", "muscle1.a6")
"""The scale of all forces is that of muscle1.a5."""


class Rig:
    """Angle, speed, two pressures, and two elements of hysteresis."""

    def __init__(self, random: np.random.Generator) -> None:
        self.inertia, self.damping = random.uniform(0.03, 0.12), random.uniform(0.2, 0.8)
        self.radius = random.uniform(0.02, 0.035, 2) * [1, -1]
        self.weight, self.rest = random.uniform(0, 2.5), random.uniform(0.08, 0.12)
        self.length, diameter = random.uniform(0.18, 0.28, 2), random.uniform(0.012, 0.022, 2)
        angle = np.deg2rad(random.uniform(22, 27, 2))
        self.area = np.pi * diameter**2 / 4
        self.braid = 3 / np.tan(angle) ** 2, 1 / np.sin(angle) ** 2
        self.spring, self.lag = -random.uniform(200, 800, 2), random.uniform(0.08, 0.25, 2)
        self.lost, self.width = random.uniform(0.03, 0.09), random.uniform(0.005, 0.02)

    def rates(self, state: Array, command: Array) -> Array:
        """What the six change by [1/s]."""
        angle, speed, p, z = state[0], state[1], state[2:4], state[4:]
        shortened = self.rest + self.radius * angle / self.length
        rate = self.radius * speed / self.length
        braid = self.braid[0] * (1 - 1.15 * shortened) ** 2 - self.braid[1]
        force = np.maximum(self.area * p * braid + self.spring * shortened, 0)
        moment = np.sum(self.radius * force * (1 - self.lost * z))
        moment -= self.damping * speed + self.weight * np.sin(angle)
        slip = rate / self.width * (1 - 0.5 * (1 + np.sign(rate * z)) * np.abs(z))
        return np.concatenate([[speed, moment / self.inertia], (command - p) / self.lag, slip])

    def record(self, levels: Array, hold: float, random: np.random.Generator) -> pam.Trajectory:
        """Commands [Pa] (n, 2), each held for so long [s], and what is measured."""

        def moved(begin: Array, command: Array, t: Array) -> Array:
            run = solve_ivp(
                lambda _, s: self.rates(s, command),
                (0, t[-1]),
                begin,
                "LSODA",
                t,
                rtol=1e-7,
                atol=1e-9,
            )
            return np.asarray(run.y.T)

        count = round(hold / STEP)
        state = moved(np.r_[0, 0, levels[0], 0, 0], levels[0], np.array([6.0]))[-1]
        rows = [state[None]]
        for command in levels:
            rows.append(moved(rows[-1][-1], command, STEP * np.arange(1, count + 1)))
        seen = np.concatenate(rows)[:, [0, 2, 3]]
        seen = seen + NOISE * random.standard_normal(seen.shape)
        held = np.concatenate([np.repeat(levels, count, axis=0), levels[-1:]])
        columns = dict(zip((*COMMANDS, *SIGNALS), np.hstack([held, seen]).T, strict=True))
        variables = [build().variable(n) for n in columns]
        return pam.Trajectory(STEP * np.arange(len(held)), columns, variables, "previous")


build = partial(
    pam.AntagonisticJoint,
    "DMSP-20-200N",
    0.05,
    0.025,
    damping=0.4,
    link_mass=0.5,
    link_length=0.1,
)


def judged(number: int, seed: int) -> harness.Row:
    """The parts predicted of each signal by the rung that predicts best what folds left out."""
    random = np.random.default_rng([seed, number])
    rig = Rig(random)
    steps = 1.2e5 * np.r_[np.linspace(0, 1, 6), np.linspace(0.8, -1, 10), np.linspace(-0.8, 0, 5)]
    stairs = [np.stack([mean + steps, mean - steps], axis=1) for mean in (2.5e5, 3.2e5)]
    train = rig.record(np.concatenate(stairs), 0.8, random)
    test = rig.record(random.uniform(1.2e5, 4.2e5, (24, 2)), 0.5, random)
    rungs = ["static", "lag", "unequal lags", "memory", "memory per pressure", "force law"]
    ladder = pam.fitting.fit_ladder(build, train, FREE, rungs=rungs, folds=3)
    band = ladder.predict(test, ladder.best.name, level=0.9)
    run = band.run
    error = np.sqrt(np.nanmean((run.predicted - run.measured) ** 2, axis=(0, 1)))
    spread = np.nanstd(run.measured, axis=(0, 1))
    parts = dict(zip(run.names, (1 - error / spread).tolist(), strict=True))
    text = ", ".join(
        f"{n} {100 * v:.1f} % (bands hold {100 * band.coverage[n]:.0f} %)" for n, v in parts.items()
    )
    text += f", {ladder.best.name}; chosen: {ladder.chosen.name}"
    return {"parts": parts, "bands": band.coverage, "best": ladder.best.name, "text": text}


def cases(given: harness.Given) -> harness.Keyed:
    for number in harness.numbers(given):
        yield number, partial(judged, number, given.seed)


def summary(rows: Sequence[harness.Row]) -> str:
    worst = [min(r["parts"].values()) for r in rows if "parts" in r]
    good = sum(w >= 0.95 for w in worst)
    held = {n: [100 * r["bands"][n] for r in rows if "bands" in r] for n in SIGNALS}
    lines = [
        f"95 % of every signal: {good} of {len(rows)}; the least of each: "
        + ", ".join(f"{100 * w:.1f} %" for w in sorted(worst)),
        "bands of 90 % hold: "
        + "; ".join(
            f"{n} {np.mean(h):.0f} ({min(h):.0f} .. {max(h):.0f}) %" for n, h in held.items() if h
        ),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=4)
