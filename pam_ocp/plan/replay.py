"""What a tight integrator says of a planned motion, on the whole and for each interval."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from ..errors import SimulationError
from ..integrate import Integration
from ..plant.plant import Plant
from ..simulate import simulate
from ..trajectory import Trajectory
from .mesh import Mesh
from .problem import Budget, Condition, Leg, Problem
from .solution import Solution
from .stage import nominals

__all__ = ["Replay", "interval_errors", "replayed"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-11
"""Relative tolerance of the integrator that replays a plan."""
OVERSAMPLING = 8
"""Integrated times between two points of a plan (an even number)."""
BY_SHOOTING = 32
"""The same where an interval has no point inside."""
FINER = {"polynomial": 9}
"""Places looked at between two of these, by how the inputs run. Not a divisor's multiple of the checks
that the mesh itself makes there: those hold what they see."""
USUALLY = 2


@dataclass(frozen=True)
class Replay:
    """What an independent tight integration of the planned inputs says."""

    error: float
    """Largest deviation of a state from the plan at its samples, in units of nominal."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation of a bound or path constraint (between the samples too, and on both sides of
    jumps of the inputs), of a condition at a stop, of the closing of a cycle, or of a budget, in
    units of nominal."""
    constraint: str
    """What is violated most ("" when nothing is)."""
    trajectory: Trajectory = field(repr=False)
    objective: float = float("nan")
    """Of the replayed motion."""
    beyond: tuple[dict[str, float], ...] = field(default=(), repr=False)
    """For each interval of the mesh {bound or path condition: by how much it is exceeded}."""
    missed: float = 0.0
    """Largest violation of what is no bound: at the stops, of the closing, of a budget."""


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


def replayed(
    problem: Problem, plant: Plant, mesh: Mesh, samples: Trajectory, solution: Solution
) -> Replay:
    """Integrate the planned inputs tightly, and look at all that was asked for, between the samples too."""
    per = BY_SHOOTING if mesh.form.scheme == "shooting" else OVERSAMPLING
    fine = np.linspace(samples.t[:-1], samples.t[1:], per, endpoint=False).T.ravel()
    fine = np.append(fine, samples.t[-1])
    try:
        motion = simulate(plant, samples, t=fine, rtol=TOLERANCE)
    except SimulationError as error:
        part = error.trajectory or samples
        stopped, inf = f"the replay stops at t = {error.time:g} s", float("inf")
        return Replay(inf, stopped, inf, "everything behind", part)
    names = samples.named("state")
    nominal = plant.vector("state", attribute="nominal")
    deviation = np.abs(motion.array(names)[::per] - samples.array(names)) / nominal
    worst = names[int(np.argmax(deviation.max(axis=0)))]
    check = _Check(problem, plant, mesh, solution, motion.t, motion.array(names).T, per)
    beyond = check.along()
    others = {**check.at_stops(), **check.closing(), **check.budgets()}
    every = [*(pair for each in beyond for pair in each.items()), *others.items()]
    label, violation = max(every, key=lambda pair: pair[1], default=("", 0.0))
    return Replay(
        float(deviation.max()), worst, violation, label, motion, check.objective(), beyond,
        max(others.values(), default=0.0),
    )  # fmt: skip


@dataclass(frozen=True)
class _Check:
    """All that was asked for, looked at along a motion.

    Each interval is looked at from its start to its end with its own inputs, so a jump of the inputs
    is seen from both sides.

    t, x : (n,) and (nx, n) the motion, ``per`` times from one sample to the next.
    """

    problem: Problem
    plant: Plant
    mesh: Mesh
    solution: Solution
    t: Array
    x: Array
    per: int

    @cached_property
    def _pieces(self) -> list[tuple[int, Array, Array, Array]]:
        """(interval, times, states (nx, times), inputs (nu, times)) one by one."""
        at, inputs, found = 0, self.solution.inputs, []
        for k, interval in enumerate(self.mesh.intervals):
            end = at + self.per * len(self.mesh.form.state_taus(interval.degree))
            powers = np.arange(inputs.degree + 1.0)[:, None]

            def u(t: Array, k: int = k, powers: Array = powers) -> Array:
                return np.asarray(inputs.coefficients[k].T @ (t - inputs.breaks[k]) ** powers)

            t, x = self.t[at : end + 1], self.x[:, at : end + 1]
            dense = np.linspace(t[:-1], t[1:], self._finer, endpoint=False).T.ravel()
            dense = np.append(dense, t[-1])
            slopes = np.asarray(self.plant.function(x, u(t), self.plant.vector("parameter"))[0])
            between = CubicHermiteSpline(t, x, slopes, axis=1)(dense)
            found.append((k, dense, np.asarray(between), u(dense)))
            at = end
        return found

    @property
    def _finer(self) -> int:
        return FINER.get(self.mesh.form.control, USUALLY)

    def _arguments(self, t: Array, x: Array, u: Array) -> tuple[Array, ...]:
        """Of a Problem's function, at columns of times, states and inputs."""
        profiles = [profile(t) for profile in self.problem.profiles]
        r = np.vstack(profiles) if profiles else np.zeros((0, len(t)))
        p = self.plant.vector("parameter")
        return x, u, p, t[None], r, np.array(self.problem.aims), self.solution.peaks

    def _legs(self) -> Iterator[tuple[Leg, Array, Array, Array, Array]]:
        """(leg, interval of each point, times, states, inputs), intervals end to end."""
        for i, leg in enumerate(self.problem.legs):
            own = [piece for piece in self._pieces if self.mesh.intervals[piece[0]].leg == i]
            if own:
                numbers, *columns = zip(*own, strict=True)
                of = np.repeat(numbers, [len(t) for t in columns[0]])
                t, x, u = (np.concatenate(c, axis=-1) for c in columns)
                yield leg, of, t, x, u

    def along(self) -> tuple[dict[str, float], ...]:
        """For each interval {bound or path condition: by how much it is exceeded} in nominals."""
        found: list[dict[str, float]] = [{} for _ in self.mesh.intervals]
        for leg, of, t, x, u in self._legs():
            variables = (*self.plant.states, *self.plant.inputs)
            labels = [v.name for v in variables] + [c.label for c in leg.path]
            scale = np.array([v.nominal for v in variables])[:, None]
            values = np.vstack([x, u]) / scale
            pairs = [(np.array(leg.bounds[v.name]) / v.nominal) for v in variables]
            pairs += [np.array([c.low, c.high]) / c.nominal for c in leg.path]
            if leg.path:
                function = self.problem.conditions("path", leg.path)
                path = np.asarray(function(*self._arguments(t, x, u)), float)
                values = np.vstack([values, path])
            for label, row, (low, high) in zip(labels, values, pairs, strict=True):
                excess = _excess(row, low, high)
                for k in np.unique(of[excess > 0]):
                    worst = float(np.max(excess[of == k]))
                    # two conditions may bear one name
                    found[k][label] = max(worst, found[k].get(label, 0.0))
        return tuple(found)

    def _node(self, i: int) -> tuple[Array, ...]:
        """Arguments at a node: at the start of the interval behind it, or at the end of the motion."""
        first, last = self.mesh.first(i), len(self.mesh.intervals)
        _, t, x, u = self._pieces[min(first, last - 1)]
        j = -1 if first == last else 0
        return self._arguments(t[[j]], x[:, [j]], u[:, [j]])

    def at_stops(self) -> dict[str, float]:
        """{condition at a stop: by how much it is missed} in nominals."""
        found: dict[str, float] = {}
        for i, conditions in enumerate(self.problem.nodes):
            if conditions:
                function = self.problem.conditions("stop", conditions)
                values = np.asarray(function(*self._node(i)), float).ravel()
                found |= _missed(conditions, values)
        return found

    def closing(self) -> dict[str, float]:
        """{"closing of the cycle: state": by how much the cycle is open} in nominals."""
        names = [v.name for v in self.plant.states]
        nominal = nominals(self.problem)[0]
        found = {}
        for i, (sign, image) in enumerate((self.problem.closing or {}).values()):
            gap = self.x[i, -1] - sign * self.x[names.index(image), 0]
            found[f"closing of the cycle: {names[i]}"] = _finite(abs(gap) / nominal[i])
        return found

    def _integral(self, expressions: Sequence[object]) -> Array:
        """Of expressions over the whole motion, by Simpson's rule on the pieces."""
        function = self.problem.function("integrands", expressions)  # type: ignore[arg-type]
        total = np.zeros(len(expressions))
        for _, t, x, u in self._pieces:
            values = np.asarray(function(*self._arguments(t, x, u)), float)
            weights = np.zeros(len(t))
            for at in range(0, len(t) - 1, 2):
                weights[at : at + 3] += (t[at + 2] - t[at]) / 6 * np.array([1.0, 4.0, 1.0])
            total += values @ weights
        return total

    def budgets(self) -> dict[str, float]:
        """{budget: by how much it is missed} in nominals."""
        budgets = self.problem.budgets
        if not budgets:
            return {}
        spent = self._integral([b.integrand / b.nominal for b in budgets])
        return _missed(budgets, spent)

    def objective(self) -> float:
        """Of the motion; the rate of the inputs and peaks as planned."""
        goal, total = self.problem.objective, 0.0
        total += goal.time * float(sum(self.solution.durations))
        if not goal.integrand.is_zero():
            total += float(self._integral([goal.integrand])[0])
        if not goal.final.is_zero():
            last = self._node(len(self.problem.legs))
            total += float(self.problem.function("final", [goal.final])(*last))
        total += float(np.dot(goal.peaks, self.solution.peaks)) if goal.peaks else 0.0
        return total + goal.rate * self._rate() if goal.rate else total

    def _rate(self) -> float:
        """Integral of the squared rate of the inputs in nominals; of held ones, that of the joined."""
        inputs, u_nominal = self.solution.inputs, nominals(self.problem)[1]
        h = np.diff(inputs.breaks)
        c = inputs.coefficients / u_nominal
        if self.mesh.form.control == "constant":
            jumps = np.sum(np.diff(c[:, 0], axis=0) ** 2, axis=1)
            return float(np.sum(jumps / ((h[:-1] + h[1:]) / 2)))
        taus, weights = np.polynomial.legendre.leggauss(inputs.degree + 1)
        total, j = 0.0, np.arange(1, inputs.degree + 1)
        for tau, weight in zip((taus + 1) / 2, weights / 2, strict=True):
            slopes = np.einsum("kj,kji->ki", j * (tau * h)[:, None] ** (j - 1), c[:, 1:])
            total += weight * float(np.sum(h * np.sum(slopes**2, axis=1)))
        return total


def _excess(values: Array, low: float, high: float) -> Array:
    """By how much values are outside; infinite where they are no numbers."""
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    return np.where(np.isnan(beyond), np.inf, beyond)


def _finite(value: float) -> float:
    return float("inf") if np.isnan(value) else float(value)


def _missed(conditions: Sequence[Condition | Budget], values: Array) -> dict[str, float]:
    """{label: by how much a value is outside its limits} of those that are, in nominals."""
    found: dict[str, float] = {}
    for c, value in zip(conditions, values, strict=True):
        by = float(_excess(np.array([value]), c.low / c.nominal, c.high / c.nominal)[0])
        if by > 0:
            found[c.label] = max(by, found.get(c.label, 0.0))
    return found
