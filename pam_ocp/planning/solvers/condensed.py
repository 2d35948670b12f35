"""A program's optimality system, interval by interval: what Newton's method on it needs.

The points inside an interval follow from its start, its inputs and what all intervals share, by its
linearised defects (condensing); what is left is a linear-quadratic problem along the stages, whose
coordinates are homogeneous: a one stands behind the shared unknowns and carries gradients and
residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.buffered import Buffered
from ..transcription.derivatives import Block, stage_blocks
from ..transcription.transcription import Program

__all__ = ["Condensed", "Intervals", "Other", "Values", "condensable"]

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]


def condensable(program: Program) -> bool:
    """Whether a program's unknowns and rows meet stage by stage only: no profiles, no costs or rows
    from one interval's inputs to the next's, no sums over the motion that have limits.
    """
    problem = program.problem
    if problem.profiles or problem.auxiliaries or problem.budgets or not problem.plant.u.numel():
        return False
    return Layout.of(program).placed(program)


@dataclass(frozen=True)
class Layout:
    """Where unknowns stand in a stage's coordinates (start, shared, first state, 1, inputs)."""

    nx: int
    nu: int
    """Of inputs' values in an interval, the most there are."""
    shared: int
    count: int
    stage: Index
    """(unknowns,) the stage whose coordinate an unknown is; -1: of all, -2: of none."""
    place: Index
    """(unknowns,) which."""

    @property
    def one(self) -> int:
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
        mesh, n = program.mesh, program.nlp["x"].numel()
        nx, inputs = len(program.problem.plant.states), len(program.problem.plant.inputs)
        every = stage_blocks(program)
        widths = [inputs * len(mesh.form.input_taus(i.degree)) for i in mesh.intervals]
        shared = every[0].unknowns.shape[0] - cls._own(every[0], nx, widths, program)
        stage, place = np.full(n, -2, dtype=np.intp), np.zeros(n, dtype=np.intp)
        for block, group in zip(every, program.groups, strict=True):
            points = group.rows  # as many defects as states at points
            for j, k in enumerate(group.members):
                own = block.unknowns[:, j]
                ends, u = own[points : nx + points][-nx:], own[nx + points :][: widths[k]]
                stage[ends], place[ends] = k + 1, np.arange(nx)
                stage[u], place[u] = k, 2 * nx + shared + 1 + np.arange(widths[k])
        stage[n - shared :], place[n - shared :] = -1, nx + np.arange(shared)
        stage[:nx], place[:nx] = -1, nx + shared + np.arange(nx)
        return cls(nx, max(widths), shared, len(mesh.intervals), stage, place)

    @staticmethod
    def _own(block: Block, nx: int, widths: list[int], program: Program) -> int:
        group = program.groups[0]
        return nx + group.rows + widths[group.members[0]]

    def placed(self, program: Program) -> bool:
        """Whether all that no interval gives stands at one stage each."""
        return Other.made(program, self) is not None


@dataclass
class Values:
    """At one point: rows' values, slopes and curvatures of all intervals of a group."""

    rows: Array
    """(n, rows) defects, then path."""
    slopes: Array
    """(n, rows, y)"""
    gradient: Array
    """(n, y) of the costs."""


class Intervals:
    """The intervals of a group, evaluated at once."""

    def __init__(self, program: Program, block: Block, members: tuple[int, ...], nd: int) -> None:
        local = block.local
        self.members, self.defects = np.array(members), nd
        self.unknowns, self.row_at = block.unknowns.T.copy(), block.rows.T.copy()
        n, ny = self.unknowns.shape
        slopes, gradient = local.slopes, ca.densify(ca.gradient(local.cost, local.given[0]))
        self._rows = local.rows.numel()
        column = ca.vertcat(local.rows, slopes.nz[:] if slopes.nnz() else ca.SX(0, 1), gradient)
        first = ca.Function("first", local.given, [ca.densify(column)])
        factor, multipliers, hessian = local.curvature
        given = [*local.given, factor, multipliers]
        entries = hessian.nz[:] if hessian.nnz() else ca.SX(0, 1)
        second = ca.Function("second", given, [ca.densify(entries)])
        self._first, self._second = Buffered(first.map(n)), Buffered(second.map(n))
        self._at = tuple(np.array(e, np.intp) for e in slopes.sparsity().get_triplet())
        self._curved = tuple(np.array(e, np.intp) for e in hessian.sparsity().get_triplet())
        self._slopes, self._hessian = np.zeros((n, self._rows, ny)), np.zeros((n, ny, ny))
        self._fixed = [w.T.ravel() for w in block.weights]
        self._plain = len(program.problem.plant.parameters)

    def _given(self, w: Array, p: Array) -> list[Array]:
        n = len(self.members)
        both = np.tile(p[: self._plain], n), np.tile(p[self._plain :], n)
        return [w[self.unknowns].ravel(), *self._fixed, *both]

    def values(self, w: Array, p: Array) -> Values:
        found = self._first(*self._given(w, p))[0].T.reshape(len(self.members), -1)
        split = self._rows + len(self._at[0])
        self._slopes[:, self._at[0], self._at[1]] = found[:, self._rows : split]
        return Values(found[:, : self._rows].copy(), self._slopes, found[:, split:].copy())

    def curvature(self, w: Array, p: Array, multipliers: Array) -> Array:
        """(n, y, y) of the Lagrangian; multipliers (n, rows)."""
        n = len(self.members)
        given = [*self._given(w, p), np.ones(n), multipliers.ravel()]
        found = self._second(*given)[0].T.reshape(n, -1)
        i, j = self._curved
        self._hessian[:, i, j] = found
        self._hessian[:, j, i] = found
        return self._hessian


@dataclass(frozen=True)
class Other:
    """What no interval gives: rows of stops and of a cycle's closing, the cost of the end."""

    function: ca.Function
    """(w, p, multipliers) -> (rows, their slopes, gradient of the cost, curvature), entries."""
    first: int
    """Where the rows stand in the program."""
    rows: Index
    """(rows,) the stage of each."""
    slope_at: tuple[Index, Index]
    """Row, and coordinate, of each slope."""
    slope_of: Index
    """The unknown of each slope."""
    gradient_of: Index
    curvature_at: tuple[Index, Index, Index]
    """Stage and two coordinates of each entry."""
    gradient_at: tuple[Index, Index]

    @classmethod
    def made(cls, program: Program, layout: Layout) -> Other | None:
        """None where an entry belongs to no stage."""
        x, p = program.nlp["x"], program.nlp["p"]
        f, g = program.other["f"], program.other["g"]
        lam = ca.MX.sym("lam", g.numel())
        slopes, gradient = ca.jacobian(g, x), ca.jacobian(f, x)
        hessian = ca.triu(ca.hessian(f + ca.dot(lam, g), x)[0])
        pieces = [slopes, gradient, hessian]
        dense = [ca.densify(ca.vec(e.nz[:])) if e.nnz() else ca.MX(0, 1) for e in pieces]
        function = ca.Function("other", [x, p, lam], [ca.densify(g), *dense])
        i, j = (np.array(e, np.intp) for e in slopes.sparsity().get_triplet())
        a, b = (np.array(e, np.intp) for e in hessian.sparsity().get_triplet())
        of = np.array(gradient.sparsity().get_triplet()[1], np.intp)
        stage = layout.stage
        rows = np.full(g.numel(), layout.count, dtype=np.intp)
        for row, unknown in zip(i, j, strict=True):
            if stage[unknown] == -2:
                return None
            if stage[unknown] >= 0:
                rows[row] = stage[unknown]
        if any(stage[u] >= 0 and stage[u] != rows[r] for r, u in zip(i, j, strict=True)):
            return None
        if np.any(stage[np.concatenate([a, b, of])] == -2):
            return None
        curved = np.maximum(stage[a], stage[b])
        if np.any((stage[a] >= 0) & (stage[b] >= 0) & (stage[a] != stage[b])):
            return None
        curved = np.where(curved < 0, layout.count, curved)
        sloped = np.where(stage[of] < 0, layout.count, stage[of])
        first = program.nlp["g"].numel() - g.numel()
        place = layout.place
        return cls(
            function, first, rows, (i, place[j]), j, of,
            (curved, place[a], place[b]), (sloped, place[of]),
        )


class Condensed:
    """Everything of a program that is made once."""

    def __init__(self, program: Program) -> None:
        self.layout = Layout.of(program)
        other = Other.made(program, self.layout)
        assert other is not None
        self.other, self._other = other, Buffered(other.function)
        self.groups = [
            Intervals(program, block, group.members, group.rows)
            for block, group in zip(stage_blocks(program), program.groups, strict=True)
        ]

    def beside(self, w: Array, p: Array, lam: Array) -> tuple[Array, Array, Array, Array]:
        """(rows, slopes, gradient, curvature) of what no interval gives, their entries."""
        first = self.other.first
        found = self._other(w, p, lam[first : first + len(self.other.rows)])
        g, slopes, gradient, curvature = (f.ravel().copy() for f in found)
        return g, slopes, gradient, curvature
