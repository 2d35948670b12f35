"""A motion landed where it shall: exact, its inputs moved as little as its stops ask for.

Where kinks are sharp, re-solving a mesh for its defects (see :mod:`.correction`) may go to and fro:
each Newton step leads across a kink. What is missing is little, though: integrated tightly, the
motion ends a hundredth of a nominal beside its stop. A few smooth changes of the inputs mend that,
the least of those that do: Gauss-Newton in as many unknowns as suffice, on exact runs, which meet
every kink where it is. Where a cycle begins is unknown, too: it shall end there. The optimum stays
that of the mesh, to its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.signals import PiecewisePolynomial
from ..core.stop import check
from ..simulation.integrate import Integration
from .correction import Corrected, left_as
from .problem.problem import Condition
from .replay import TOLERANCE, chosen_plant
from .result import Solved
from .transcription.mesh import Mesh
from .transcription.solution import Solution, pack
from .transcription.stage import nominals

__all__ = ["landed"]

Array: TypeAlias = NDArray[np.float64]

ROUGHLY = 1e-9
"""Relative tolerance of runs on the way."""
STEP = 1e-4
"""Of differences, in nominals of the inputs."""
FARTHEST = 0.3
"""Nominals by which an input may be moved: beyond, it is another motion."""
ROUNDS = 8
LANDED = 0.2
"""Of the tolerance, that a stop may be missed by."""
PER_CONDITION = 2
"""Changes of the inputs to each condition; and of each input, ``LEAST`` at least."""
LEAST = 5
NEARER = 0.6
"""How far from the next stop a change begins, to the one before."""


def landed(found: Solved, tolerance: float) -> Solved | None:
    """The exact motion near a solution that keeps its stops to a tolerance [nominals]; None where
    none was found.

    Motions with budgets are left alone.
    """
    problem = found.program.problem
    if problem.budgets:
        return None
    try:
        return _Landing.of(found).solved(tolerance)
    except RuntimeError:  # a run that cannot be integrated
        return None


@dataclass(frozen=True, eq=False)
class _Landing:
    """shapes : (changes, intervals, 1 or 2, nu) what each unknown adds to the inputs' coefficients,
    in SI: a step on each interval, or lines that join each other.

    starts : states that begin where they like (those of a cycle), unknowns behind the others, in
    nominals.
    """

    found: Solved
    shapes: Array
    starts: NDArray[np.intp]

    @classmethod
    def of(cls, found: Solved) -> _Landing:
        problem, mesh = found.program.problem, found.program.mesh
        inputs = found.solution.inputs
        closing = problem.closing or {}
        count = sum(len(c) for c in problem.nodes[1:]) + len(closing)
        nominal = np.asarray(problem.plant.vector("input", attribute="nominal"))
        each = max(LEAST, -(-PER_CONDITION * count // max(len(nominal), 1)))
        # close to each stop: what is changed early goes through all kinks that follow
        ends = inputs.breaks[[mesh.first(i) for i in range(len(problem.nodes))]]
        near = 1 - NEARER ** np.arange(each)
        knots = np.concatenate([a + (b - a) * near for a, b in pairwise(ends)] + [ends[-1:]])
        hats = [_Hat(knots, row) for row in np.eye(len(knots))]
        shapes = []
        for i, free in enumerate(_free(found).T):
            for hat in hats:
                added = hat.coefficients(mesh, inputs.breaks, free)
                shape = np.zeros((*added.shape, len(nominal)))
                shape[..., i] = added * nominal[i]
                if np.any(shape):
                    shapes.append(shape)
        names = [v.name for v in problem.plant.states]
        starts = np.array([names.index(n) for n in closing], dtype=np.intp)
        return cls(found, np.array(shapes), starts)

    def solved(self, tolerance: float) -> Solved | None:
        z = np.zeros(len(self.shapes) + len(self.starts))
        missed = self._missed(z)
        for _ in range(ROUNDS if z.size and np.all(np.isfinite(missed)) else 0):
            if np.abs(missed).max(initial=0.0) <= LANDED * tolerance:
                break
            slopes = np.column_stack(
                [(self._missed(z + STEP * e) - missed) / STEP for e in np.eye(len(z))]
            )
            before = np.linalg.norm(missed)
            for part, cut in ((1.0, 1e-8), (1.0, 1e-2), (0.5, 1e-2), (0.25, 1e-2), (0.5, 1e-1)):
                step = -np.linalg.pinv(slopes, rcond=cut) @ missed
                there = np.clip(z + part * step, -FARTHEST, FARTHEST)
                now = self._missed(there)
                if np.linalg.norm(now) < (1 - part / 10) * before:
                    z, missed = there, now
                    break
            else:
                break  # kinks leave no more to gain
        return self._taken(z) if np.abs(missed).max(initial=0.0) <= tolerance else None

    def _inputs(self, z: Array) -> PiecewisePolynomial:
        before = self.found.solution.inputs
        coefficients = before.coefficients.copy()
        if len(self.shapes):
            added = np.tensordot(z[: len(self.shapes)], self.shapes, 1)
            coefficients[:, : added.shape[1]] += added
        return PiecewisePolynomial(before.breaks, coefficients)

    def _begin(self, z: Array) -> Array:
        """The state at the start, within its bounds."""
        problem, x = self.found.program.problem, self.found.solution.states[0].copy()
        bounds = np.array([problem.legs[0].bounds[v.name] for v in problem.plant.states])
        x[self.starts] += z[len(self.shapes) :] * nominals(problem)[0][self.starts]
        return np.asarray(np.clip(x, *bounds.T))

    def _run(self, inputs: PiecewisePolynomial, begin: Array, rtol: float) -> Array:
        """The states at all points of the mesh, integrated from the start."""
        found, mesh = self.found.solution, self.found.program.mesh
        plant = chosen_plant(self.found.program.problem, found)
        run = Integration(plant, inputs, inputs.breaks, begin, rtol=rtol)
        rows = [begin[None]]
        for interval, (t, end) in zip(mesh.intervals, pairwise(inputs.breaks), strict=True):
            taus = tuple(mesh.form.state_taus(interval.degree).tolist())
            rows.append(run.between(t, rows[-1][-1], end, taus))
        return np.concatenate(rows)

    def _missed(self, z: Array) -> Array:
        """By how much each condition at a stop is missed, and the cycle is open, in nominals, with
        signs.
        """
        check()
        problem, mesh = self.found.program.problem, self.found.program.mesh
        inputs = self._inputs(z)
        states = self._run(inputs, self._begin(z), ROUGHLY)
        points = [len(mesh.form.state_taus(i.degree)) for i in mesh.intervals]
        at = np.concatenate([[0], np.cumsum(points)])
        parts = [self._open(states)]
        for i, conditions in enumerate(problem.nodes):
            if conditions:
                first = mesh.first(i)
                k = min(first, len(mesh.intervals) - 1)
                values = self._values(
                    conditions, inputs, k, inputs.breaks[first], states[at[first]]
                )
                low, high = (
                    np.array([getattr(c, s) / c.nominal for c in conditions])
                    for s in ("low", "high")
                )
                parts.append(values - np.clip(values, low, high))
        return np.concatenate(parts)

    def _values(
        self,
        conditions: Sequence[Condition],
        inputs: PiecewisePolynomial,
        interval: int,
        time: float,
        state: Array,
    ) -> Array:
        """Of conditions at a stop, in nominals."""
        problem, found = self.found.program.problem, self.found.solution
        since = time - inputs.breaks[interval]
        u = since ** np.arange(inputs.degree + 1) @ inputs.coefficients[interval]
        r = np.array([profile(np.array([time]))[0] for profile in problem.profiles])
        p = chosen_plant(problem, found).vector("parameter")
        function = problem.conditions("stop", conditions)
        value = function(state, u, p, time, r, np.array(problem.aims), found.peaks)
        return np.asarray(value, float).ravel()

    def _open(self, states: Array) -> Array:
        """By how much a cycle is open; empty where there is none."""
        problem = self.found.program.problem
        closing = problem.closing or {}
        names = [v.name for v in problem.plant.states]
        images = [names.index(image) for _, image in closing.values()]
        signs = np.array([sign for sign, _ in closing.values()])
        gap = states[-1, self.starts] - signs * states[0, images]
        return np.asarray(gap / nominals(problem)[0][self.starts])

    def _taken(self, z: Array) -> Solved:
        program, inputs = self.found.program, self._inputs(z)
        states = self._run(inputs, self._begin(z), TOLERANCE)
        solution: Solution = replace(self.found.solution, states=states, inputs=inputs)
        if isinstance(program, Corrected):
            program = program.exact()
        program = left_as(program, solution)
        w = program.completed(pack(program.problem, program.mesh, solution))
        cost = ca.Function("cost", [program.nlp["x"], program.nlp["p"]], [program.nlp["f"]])
        objective = float(cost(w, program.parameters()))
        outcome = replace(self.found.outcome, w=w, objective=objective)
        return Solved(program, outcome, solution)


@dataclass(frozen=True)
class _Hat:
    """A function of time, linear between its knots."""

    knots: Array
    values: Array

    def coefficients(self, mesh: Mesh, breaks: Array, free: NDArray[np.bool_]) -> Array:
        """(intervals, 1 or 2) what it adds on intervals that are free, elsewhere nothing."""
        if mesh.form.control == "linear":  # inputs stay continuous
            open_ends = np.append(True, free) & np.append(free, True)
            ends = np.interp(breaks, self.knots, self.values) * open_ends
            return np.column_stack([ends[:-1], np.diff(ends) / np.diff(breaks)])
        middles = (breaks[:-1] + breaks[1:]) / 2
        own = np.maximum.accumulate(
            [0 if i.joined else k for k, i in enumerate(mesh.intervals)]
        )  # inputs that are held over several intervals have one value
        return (np.interp(middles[own], self.knots, self.values) * free)[:, None]


def _free(found: Solved) -> NDArray[np.bool_]:
    """(intervals, nu) where inputs are inside of their bounds; elsewhere they stay."""
    problem, mesh, inputs = found.program.problem, found.program.mesh, found.solution.inputs
    names = [v.name for v in problem.plant.inputs]
    bounds = np.array([[leg.bounds[n] for n in names] for leg in problem.legs]).reshape(
        len(problem.legs), len(names), 2
    )[[i.leg for i in mesh.intervals]]
    nominal = np.asarray(problem.plant.vector("input", attribute="nominal"))
    ends = [
        (h ** np.arange(inputs.degree + 1)[:, None] * each).sum(axis=0)
        for h, each in zip(np.diff(inputs.breaks), inputs.coefficients, strict=True)
    ]
    both = np.stack([inputs.coefficients[:, 0], np.array(ends)])
    room = np.minimum(both - bounds[..., 0], bounds[..., 1] - both).min(axis=0)
    return np.asarray(room > 1e-3 * nominal)
