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
from .mesh import Mesh
from .problem import Problem, limits
from .solution import Solution
from .stage import Stage

__all__ = ["Replay", "excesses", "interval_errors", "motion_error", "replayed"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-11
"""Relative tolerance of the integrator that replays a plan."""
DENSE = 31
"""Places between two points of a polynomial input where it is looked at."""
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


def interval_errors(plant: Plant, mesh: Mesh, solution: Solution) -> list[float]:
    """For each interval: how far a tight integration from its start leaves its planned points."""
    states, breaks = solution.states, solution.inputs.breaks
    nominal = plant.vector("state", attribute="nominal")
    run = Integration(plant, solution.inputs, breaks, states[0], rtol=TOLERANCE)
    errors, at = [], 0
    for interval, (begin, end) in zip(mesh.intervals, pairwise(breaks), strict=True):
        taus = tuple(mesh.form.state_taus(interval.degree).tolist())
        planned = states[at + 1 : at + 1 + len(taus)]
        try:
            found = run.between(begin, states[at], end, taus)
            miss = float(np.max(np.abs(found - planned) / nominal))
        except RuntimeError:
            miss = float("inf")
        errors.append(miss if np.isfinite(miss) else float("inf"))
        at += len(taus)
    return errors


def motion_error(plant: Plant, solution: Solution) -> float:
    """How far a tight integration of the whole motion leaves its planned points, in nominals."""
    nominal = plant.vector("state", attribute="nominal")
    run = Integration.over(plant, solution.inputs, solution.t, solution.states[0], rtol=TOLERANCE)
    found = run()
    if found is None:
        return float("inf")
    return float(np.max(np.abs(run.at(solution.t, found) - solution.states) / nominal))


def excesses(problem: Problem, mesh: Mesh, solution: Solution) -> list[float]:
    """For each interval: by how much polynomial inputs, and what depends on them, exceed their limits
    between the points, in units of nominal."""
    found = [0.0] * len(mesh.intervals)
    if not mesh.form.guarded or mesh.form.control != "polynomial":
        return found
    begins, h = solution.inputs.breaks[:-1], np.diff(solution.inputs.breaks)
    p, at = problem.plant.vector("parameter"), 0
    rest = (np.zeros(problem.r.numel()), np.array(problem.aims), solution.peaks)
    stages = [Stage(problem, leg, mesh.form, 1, DENSE) for leg in problem.legs]
    values_of = [problem.conditions("guarded", stage.guarded) for stage in stages]
    for k, interval in enumerate(mesh.intervals):
        taus = mesh.form.guard_taus(interval.degree, DENSE)
        points = solution.states[at : at + 1 + len(mesh.form.state_taus(interval.degree))]
        weights = [mesh.form.state_weights(interval.degree, tau) for tau in taus]
        x = points.T @ np.asarray(ca.horzcat(*weights))
        powers = (taus * h[k]) ** np.arange(solution.inputs.coefficients.shape[1])[:, None]
        u = solution.inputs.coefficients[k].T @ powers
        values = np.asarray(
            values_of[interval.leg](x, u, p, begins[k] + h[k] * taus[None, :], *rest)
        )
        low, high = (np.array(e)[:, None] for e in limits(stages[interval.leg].guarded))
        beyond = np.maximum(low - values, values - high)
        found[k] = float(np.max(beyond, initial=0.0))
        at += len(points) - 1
    return found


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
