"""What a tight integrator says of a planned motion, on the whole and for each interval."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from ..integrate import Integration
from ..plant.plant import Plant
from ..simulate import simulate
from ..trajectory import Trajectory
from .problem import Problem
from .solution import Solution

__all__ = ["Replay", "interval_errors", "replayed"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-11
"""Relative tolerance of the integrator that replays a plan."""
OVERSAMPLING = 8
"""Checked times between two samples of a plan."""


@dataclass(frozen=True)
class Replay:
    """What an independent tight integration of the planned inputs says."""

    error: float
    """Largest deviation of a state from the plan at its samples, in units of nominal."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation of a bound or path constraint, between samples too, in units of nominal."""
    constraint: str
    """The bound that is violated most ("" when none is)."""
    trajectory: Trajectory = field(repr=False)


def interval_errors(plant: Plant, solution: Solution) -> list[float]:
    """For each interval: how far a tight integration from its start leaves its planned points."""
    times, states, signals = solution.t, solution.states, solution.inputs
    nominal = plant.vector("state", attribute="nominal")
    ends = np.searchsorted(times, signals.breaks - 1e-12 * (1 + np.abs(signals.breaks)))
    errors = []
    for a, b in pairwise(ends):
        part = slice(a, b + 1)
        found = Integration.over(plant, signals, times[part], states[a], rtol=TOLERANCE)()
        if found is None:
            errors.append(float("inf"))
        else:
            errors.append(float(np.max(np.abs(found - states[part]) / nominal)))
    return errors


def replayed(problem: Problem, plant: Plant, samples: Trajectory, solution: Solution) -> Replay:
    """Integrate the planned inputs tightly, and look at the bounds between the samples too."""
    fine = np.linspace(samples.t[:-1], samples.t[1:], OVERSAMPLING, endpoint=False).T.ravel()
    fine = np.append(fine, samples.t[-1])
    try:
        motion = simulate(plant, samples, t=fine, rtol=TOLERANCE)
    except SimulationError as error:
        part = error.trajectory or samples
        return Replay(
            float("inf"), f"the replay stops at t = {error.time:g} s", float("inf"), "", part
        )
    names = samples.named("state")
    nominal = plant.vector("state", attribute="nominal")
    deviation = np.abs(motion.array(names)[::OVERSAMPLING] - samples.array(names)) / nominal
    violation, constraint = _violation(problem, plant, motion, solution)
    worst = names[int(np.argmax(deviation.max(axis=0)))]
    return Replay(float(deviation.max()), worst, violation, constraint, motion)


def _violation(
    problem: Problem, plant: Plant, motion: Trajectory, solution: Solution
) -> tuple[float, str]:
    """Largest violation of bounds and path conditions along a motion, in units of nominal."""
    x, u = (motion.array(motion.named(c)).T for c in ("state", "input"))
    profiles = [profile(motion.t) for profile in problem.profiles]
    r = np.vstack(profiles) if profiles else np.zeros((0, len(motion.t)))
    ends = np.concatenate([[0.0], np.cumsum(solution.durations)])
    found = [(0.0, "")]
    for i, leg in enumerate(problem.legs):
        inside = (motion.t >= ends[i] - 1e-12) & (motion.t <= ends[i + 1] + 1e-12)
        if not inside.any():
            continue
        for name, (low, high) in leg.bounds.items():
            values, nominal = motion[name][inside], plant.variable(name).nominal
            found.append((float(np.max(np.maximum(low - values, values - high))) / nominal, name))
        if leg.path:
            function = problem.conditions("path", leg.path)
            arguments = (
                x[:, inside], u[:, inside], plant.vector("parameter"), motion.t[None, inside],
                r[:, inside], np.array(problem.aims), solution.peaks,
            )  # fmt: skip
            found += _excess(leg.path, function, arguments)
    return max(found, key=lambda pair: pair[0])


def _excess(path: tuple, function: ca.Function, arguments: tuple) -> list[tuple[float, str]]:  # type: ignore[type-arg]
    """(largest violation in nominals, label) of each condition."""
    values = np.asarray(function(*arguments), float)
    return [
        (float(np.max(np.maximum(c.low / c.nominal - row, row - c.high / c.nominal))), c.label)
        for c, row in zip(path, values, strict=True)
    ]
