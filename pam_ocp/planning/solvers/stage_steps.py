"""One step of Newton's method along the stages: a quadratic program with given active rows.

Active rows are held by weights whose multipliers are corrected from step to step (method of
multipliers), so that redundant ones do no harm. The program is solved by a Riccati recursion over
the condensed intervals, and the multipliers of their defects follow from the cost to go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .condensed import Beside, Condensed, Interval, Values

__all__ = ["NoMinimum", "StageProgram", "Step"]

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]

WEIGHT = 1e6
"""Of active rows' residuals, in units of nominals; heavier ones cost digits."""
SHIFT = 1e-7
"""Added to the curvature by the inputs: where costs are flat, the nearest optimum is taken."""


class NoMinimum(Exception):
    """The curvature along the free directions is not positive."""


@dataclass(frozen=True)
class _Part:
    """A group's intervals at a point, in coordinates of their stages."""

    group: Interval
    values: Values
    z: Array
    """(n, unknowns, coordinates) changes of the unknowns."""
    curved: Array
    """The Lagrangian's curvature times these."""
    inverse: Array
    """(n, states, states) of the defects' slopes by the states."""
    rows: Array
    """(n, rows, coordinates) changes of path and of own unknowns."""
    at: Index
    """(n, rows) where these stand among all rows."""


@dataclass(frozen=True)
class Step:
    """What a quadratic program comes to."""

    along: Array
    """(stages, coordinates)"""
    value: Array
    """(stages, carried, carried) the cost to go, a quadratic form."""
    change: Array
    """(all rows,) but the defects'."""
    lam: Array
    """(all rows,) new multipliers, but the defects'."""


class StageProgram:
    """The quadratic program at a point. All rows are the program's, then its unknowns.

    w, p : unknowns and parameters; lam : multipliers of all rows; residual : of all rows, to the
    low limit of those that are equations, else zero.
    """

    def __init__(
        self,
        made: Condensed,
        at: tuple[list[Values], Beside],
        point: tuple[Array, Array, Array],
        residual: Array,
    ) -> None:
        self._made, self._layout = made, made.layout
        self._w, self._p, self._lam = point
        self._residual = residual
        values, self._beside = at
        self._m = len(self._lam) - len(self._w)
        self._fixed = np.flatnonzero(made.layout.stage == -1)
        lay = made.layout
        self._base = np.zeros((lay.count + 1, lay.size, lay.size))
        self._forth = np.zeros((lay.count, lay.carried, lay.size))
        same = np.arange(lay.nx, lay.carried)
        self._forth[:, same, same] = 1.0
        self._parts = [self._part(g, v) for g, v in zip(made.groups, values, strict=True)]
        self._stops()

    def _part(self, group: Interval, found: Values) -> _Part:
        """Condense a group's intervals; their costs and ends go where they belong."""
        lay, nx, nd = self._layout, self._layout.nx, group.defects
        n, size = group.unknowns.shape
        slopes = found.slopes
        hessian = group.curvature(self._w, self._p, self._lam[group.row_at])
        inverse: Array = np.asarray(np.linalg.inv(slopes[:, :nd, group.states]), float)
        z = np.zeros((n, size, lay.size))
        for rows, first, count in (
            (0, 0, nx),
            (nx + nd, lay.carried, group.inputs),
            (size - lay.shared, nx, lay.shared),
        ):
            i = np.arange(count)
            z[:, rows + i, first + i] = 1.0
        right = slopes[:, :nd] @ z
        right[:, :, lay.one] += self._residual[group.row_at[:, :nd]]
        z[:, group.states] = -inverse @ right
        curved = hessian @ z
        cost = z.transpose(0, 2, 1) @ curved
        _add_linear(cost, lay.one, np.einsum("ky,kyv->kv", found.gradient, z))
        i = lay.carried + np.arange(lay.nu)
        cost[:, i, i] += SHIFT
        cost[:, i[group.inputs :], i[group.inputs :]] += 1.0  # of other intervals
        self._base[group.members] = cost
        self._forth[group.members, :nx] = z[:, nd : nd + nx]
        rows = np.concatenate([slopes[:, nd:] @ z, z[:, group.own]], axis=1)
        own = self._m + group.unknowns[:, group.own]
        at = np.concatenate([group.row_at[:, nd:], own], axis=1)
        return _Part(group, found, z, curved, inverse, rows, at)

    def _stops(self) -> None:
        """What no interval gives."""
        other, beside, one = self._made.other, self._beside, self._layout.one
        stage, i, j = other.curvature_at
        np.add.at(self._base, (stage, i, j), beside.curvature)
        off = i != j
        np.add.at(self._base, (stage[off], j[off], i[off]), beside.curvature[off])
        stage, i = other.gradient_at
        behind = np.full_like(i, one)
        np.add.at(self._base, (stage, behind, i), beside.gradient)
        np.add.at(self._base, (stage, i, behind), beside.gradient)
        self._rows = np.zeros((other.count, self._layout.size))
        np.add.at(self._rows, other.slope_at, beside.slopes)

    def solved(self, active: NDArray[np.bool_], miss: Array) -> Step:
        """With the rows held that are active, from which the point is off by ``miss``.

        Raises NoMinimum, or NumPy's LinAlgError.
        """
        lay, other = self._layout, self._made.other
        one, total = lay.one, self._base.copy()
        weight = np.where(active, WEIGHT, 0.0)
        miss, lam = np.where(active, miss, 0.0), np.where(active, self._lam, 0.0)
        for part in self._parts:
            rows = part.rows.copy()
            rows[:, :, one] += miss[part.at]
            cost = rows.transpose(0, 2, 1) @ (weight[part.at][..., None] * rows)
            _add_linear(cost, one, (lam[part.at][:, None, :] @ rows)[:, 0])
            total[part.group.members] += cost
        rows = self._rows.copy()
        own = slice(other.first, self._m)
        rows[:, one] += miss[own]
        for row, k, w, force in zip(rows, other.rows, weight[own], lam[own], strict=True):
            total[k] += (w * row)[:, None] * row
            total[k, one] += force * row
            total[k, :, one] += force * row
        at, place = self._m + self._fixed, lay.place[self._fixed]
        linear = weight[at] * miss[at] + lam[at]
        total[-1][place, place] += weight[at]
        total[-1][place, one] += linear
        total[-1][one, place] += linear
        along, value = self._recursion(total)
        change = self._changes(along)
        return Step(along, value, change, lam + weight * (miss + change))

    def _recursion(self, total: Array) -> tuple[Array, Array]:
        """(coordinates along the stages, costs to go) of the least cost."""
        lay, forth = self._layout, self._forth
        count, nx, nc = lay.count, lay.nx, lay.carried
        value = np.zeros((count + 1, nc, nc))
        gains, pivots = np.zeros((count, lay.nu, nc)), np.zeros((count, lay.nu, lay.nu))
        value[count] = v = total[-1][:nc, :nc]
        inverse, back = _inverse(lay.nu), forth.transpose(0, 2, 1)
        for k in range(count - 1, -1, -1):
            both = total[k] + back[k] @ v @ forth[k]
            pivots[k] = pivot = both[nc:, nc:]
            gains[k] = gain = inverse(pivot) @ -both[nc:, :nc]
            v = both[:nc, :nc] + both[:nc, nc:] @ gain
            value[k] = v = (v + v.T) / 2
        if not np.linalg.eigvalsh(pivots).min() > 0:  # NaN, too
            raise NoMinimum
        join = np.zeros((nc, nc - nx))  # the first stage's start is the first state
        join[np.arange(nx, nc), np.arange(nc - nx)] = 1.0
        join[np.arange(nx), lay.shared + np.arange(nx)] = 1.0
        root = join.T @ value[0] @ join
        np.linalg.cholesky(root[:-1, :-1])
        x = join @ np.append(-np.linalg.solve(root[:-1, :-1], root[:-1, -1]), 1.0)
        along = np.zeros((count + 1, lay.size))
        for k in range(count):
            along[k, :nc] = x
            along[k, nc:] = gains[k] @ x
            x = forth[k] @ along[k]
        along[count, :nc] = x
        return along, value

    def _changes(self, along: Array) -> Array:
        """Of all rows but the defects."""
        other, change = self._made.other, np.zeros(len(self._lam))
        for part in self._parts:
            change[part.at] = (part.rows @ along[part.group.members][:, :, None])[..., 0]
        change[other.first : self._m] = np.einsum("rv,rv->r", self._rows, along[other.rows])
        change[self._m + self._fixed] = along[-1][self._layout.place[self._fixed]]
        return change

    def taken(self, step: Step) -> tuple[Array, Array]:
        """(unknowns, multipliers of all rows) behind a step."""
        nx, lam = self._layout.nx, step.lam.copy()
        carried = step.along[1:, : self._layout.carried]
        costates = np.einsum("kij,kj->ki", step.value[1:, :nx], carried)
        for part in self._parts:
            group, nd = part.group, part.group.defects
            along = step.along[group.members][:, :, None]
            force = (part.curved @ along)[..., 0] + part.values.gradient
            path = lam[group.row_at[:, nd:]]
            force += (path[:, None, :] @ part.values.slopes[:, nd:])[:, 0]
            states = force[:, group.states] + lam[self._m + group.unknowns[:, group.states]]
            states[:, nd - nx :] += costates[group.members]
            lam[group.row_at[:, :nd]] = -(states[:, None, :] @ part.inverse)[:, 0]
        return self._w + step.change[self._m :], lam


def _add_linear(form: Array, one: int, linear: Array) -> None:
    """Add (n, coordinates) linear terms to (n, coordinates, coordinates) quadratic forms."""
    form[:, one, :] += linear
    form[:, :, one] += linear


def _inverse(size: int) -> Callable[[Array], Array]:
    """Of small matrices; NumPy's takes six times as long for two inputs."""

    def of_two(matrix: Array) -> Array:
        (a, b), (c, d) = matrix.tolist()
        by = a * d - b * c
        return np.array([[d / by, -b / by], [-c / by, a / by]]) if by else np.full((2, 2), np.nan)

    def of_any(matrix: Array) -> Array:
        return np.asarray(np.linalg.inv(matrix), float)

    return of_two if size == 2 else of_any
