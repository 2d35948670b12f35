"""A program's optimality system, interval by interval: what Newton's method on it needs.

The points inside an interval follow from its start, its inputs and what all intervals share, by its
linearised defects (condensing). What is left is a linear-quadratic problem along the stages. Its
coordinates at a stage are (start, shared unknowns, first state, 1, inputs): the one carries
gradients and residuals, the first state what a cycle's closing says of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.solvers import Buffered
from ..transcription.derivatives import Block, entries_of, stage_blocks, stored
from ..transcription.solution import Places
from ..transcription.transcription import Group, Program

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]

ALL, NONE = -1, -2
"""In place of a stage: what belongs to all of them, or to none (points inside an interval)."""
LARGEST = 5_000_000
"""Entries of all intervals' slopes, kept densely; more are for a sparse solver."""


@dataclass(frozen=True)
class Layout:
    """Where unknowns stand among the coordinates of the stages."""

    nx: int
    nu: int
    """Values of the inputs in an interval, the most there are."""
    shared: int
    """Durations, design, peaks."""
    count: int
    """Of intervals; the last stage is behind them."""
    stage: Index
    """(unknowns,) the stage whose coordinate an unknown is, ALL or NONE."""
    place: Index
    """(unknowns,) which coordinate."""

    @property
    def one(self) -> int:
        """The coordinate that is 1."""
        return 2 * self.nx + self.shared

    @property
    def carried(self) -> int:
        """Coordinates that go from stage to stage; the inputs stand behind them."""
        return self.one + 1

    @property
    def size(self) -> int:
        return self.carried + self.nu

    @classmethod
    def of(cls, program: Program) -> Layout:
        problem, mesh, n = program.problem, program.mesh, program.nlp["x"].numel()
        places = Places.of(problem, mesh)
        nx, shared, widths = places.nx, sum(places.tail), [size[1] for size in places.sizes]
        stage, place = np.full(n, NONE, dtype=np.intp), np.zeros(n, dtype=np.intp)
        first_input = 2 * nx + shared + 1
        for k, width in enumerate(widths):
            end, u = places.begin(k + 1), places.inputs(k)
            stage[end], place[end] = k + 1, np.arange(nx)
            stage[u], place[u] = k, first_input + np.arange(width)
        stage[n - shared :], place[n - shared :] = ALL, nx + np.arange(shared)
        stage[:nx], place[:nx] = ALL, nx + shared + np.arange(nx)
        return cls(nx, max(widths), shared, len(widths), stage, place)


@dataclass(frozen=True)
class Values:
    """Intervals of a group at one point: a row each."""

    rows: Array
    """(n, rows) defects, then path."""
    slopes: Array
    """(n, rows, unknowns)"""
    cost: float
    """Of all of them."""
    gradient: Array
    """(n, unknowns) of the costs."""


class Interval:
    """A group's intervals, evaluated at once; unknowns of each are (start, states at points,
    inputs, shared).
    """

    def __init__(self, program: Program, block: Block, group: Group, nx: int, shared: int) -> None:
        local = block.local
        self.members, self.defects = np.array(group.members), group.rows
        self.unknowns, self.row_at = block.unknowns.T.copy(), block.rows.T.copy()
        n, size = self.unknowns.shape
        self.states = slice(nx, nx + group.rows)
        self.own = slice(nx, size - shared)
        """States and inputs: unknowns that no other interval of its kind calls its own."""
        self.inputs = size - shared - nx - group.rows
        slopes, (factor, multipliers, hessian) = local.slopes, local.curvature
        gradient = ca.densify(ca.gradient(local.cost, local.given[0]))
        column = ca.vertcat(local.rows, stored(slopes), local.cost, gradient)
        first = ca.Function("first", local.given, [ca.densify(column)])
        second = ca.Function("second", [*local.given, factor, multipliers], [stored(hessian)])
        self._first, self._second = Buffered(first.map(n)), Buffered(second.map(n))
        self._sloped, self._curved = entries_of(slopes.sparsity()), entries_of(hessian.sparsity())
        rows = local.rows.numel()
        self._slopes, self._hessian = np.zeros((n, rows, size)), np.zeros((n, size, size))
        self._weights = [weights.T.ravel() for weights in block.weights]
        self._plain = len(program.problem.plant.parameters)

    def _given(self, w: Array, p: Array) -> list[Array]:
        n = len(self.members)
        both = np.tile(p[: self._plain], n), np.tile(p[self._plain :], n)
        return [w[self.unknowns].ravel(), *self._weights, *both]

    def values(self, w: Array, p: Array) -> Values:
        """At unknowns and parameters of the program; the slopes stand until the next call."""
        found = self._first(*self._given(w, p))[0].T.reshape(len(self.members), -1)
        rows = self._slopes.shape[1]
        split = rows + len(self._sloped[0])
        self._slopes[:, self._sloped[0], self._sloped[1]] = found[:, rows:split]
        cost = float(found[:, split].sum())
        return Values(found[:, :rows].copy(), self._slopes, cost, found[:, split + 1 :].copy())

    def curvature(self, w: Array, p: Array, multipliers: Array) -> Array:
        """(n, unknowns, unknowns) of the Lagrangian, at multipliers (n, rows)."""
        n = len(self.members)
        given = [*self._given(w, p), np.ones(n), multipliers.ravel()]
        found = self._second(*given)[0].T.reshape(n, -1)
        i, j = self._curved
        self._hessian[:, i, j] = found
        self._hessian[:, j, i] = found
        return self._hessian


@dataclass(frozen=True)
class Beside:
    """What no interval gives, at one point: entries of :class:`_Other`."""

    rows: Array
    slopes: Array
    cost: float
    gradient: Array
    curvature: Array


class _Other:
    """Rows of stops and of a cycle's closing, and the cost of the end.

    Each row, and each entry of the curvature, belongs to one stage; ``fits`` says whether it does.
    """

    def __init__(self, program: Program, layout: Layout) -> None:
        x, p, f, g = (*(program.nlp[n] for n in ("x", "p")), program.other["f"], program.other["g"])
        lam = ca.MX.sym("lam", g.numel())
        slopes, gradient = ca.jacobian(g, x), ca.jacobian(f, x)
        hessian = ca.triu(ca.hessian(f + ca.dot(lam, g), x)[0])
        entries = [stored(e) for e in (slopes, gradient, hessian)]
        results = [ca.densify(g), ca.densify(f), *entries]
        self._function = Buffered(ca.Function("other", [x, p, lam], results))
        self.count, self.first = g.numel(), program.nlp["g"].numel() - g.numel()
        row, self.slope_of = entries_of(slopes.sparsity())
        self.gradient_of = entries_of(gradient.sparsity())[1]
        a, b = entries_of(hessian.sparsity())
        stage, place = layout.stage, layout.place
        last = layout.count
        self.rows = np.full(self.count, last, dtype=np.intp)
        """(rows,) the stage of each."""
        bound = stage[self.slope_of] >= 0
        self.rows[row[bound]] = stage[self.slope_of[bound]]
        self.slope_at = row, place[self.slope_of]
        """Row and coordinate of each slope."""
        self.gradient_at = self._placed(stage[self.gradient_of], last), place[self.gradient_of]
        """Stage and coordinate."""
        self.curvature_at = self._placed(np.maximum(stage[a], stage[b]), last), place[a], place[b]
        """Stage and two coordinates."""
        used = stage[np.concatenate([self.slope_of, self.gradient_of, a, b])]
        apart = (stage[a] >= 0) & (stage[b] >= 0) & (stage[a] != stage[b])
        astray = bound & (stage[self.slope_of] != self.rows[row])
        self.fits = not (np.any(used == NONE) or apart.any() or astray.any())

    @staticmethod
    def _placed(stage: Index, last: int) -> Index:
        """What all stages share is counted once, at the last."""
        return np.where(stage < 0, last, stage)

    def values(self, w: Array, p: Array, lam_g: Array) -> Beside:
        """At unknowns, parameters and all multipliers of the program."""
        found = self._function(w, p, lam_g[self.first : self.first + self.count])
        rows, cost, *others = (each.ravel().copy() for each in found)
        return Beside(rows, others[0], float(cost[0]), others[1], others[2])


class Condensed:
    """All of a program that is made once; see :meth:`made`."""

    def __init__(self, layout: Layout, groups: list[Interval], other: _Other) -> None:
        self.layout, self.groups, self.other = layout, groups, other

    @classmethod
    def made(cls, program: Program) -> Condensed | None:
        """None where unknowns and rows do not meet stage by stage (profiles, auxiliaries, limits of
        sums over the motion, costs or rows from one interval's inputs to the next's), or where
        the intervals are too large for dense matrices.
        """
        problem = program.problem
        if problem.profiles or problem.auxiliaries or problem.budgets:
            return None
        if not problem.plant.u.numel():
            return None
        blocks = stage_blocks(program)
        if sum(b.rows.shape[0] * b.unknowns.size for b in blocks) > LARGEST:
            return None
        layout = Layout.of(program)
        other = _Other(program, layout)
        if not other.fits:
            return None
        nx, shared = layout.nx, layout.shared
        groups = [
            Interval(program, block, group, nx, shared)
            for block, group in zip(blocks, program.groups, strict=True)
        ]
        return cls(layout, groups, other)
