"""Newton's method from a neighbour's optimum: quadratic programs along the stages.

A change of a few percent in a problem's numbers moves few rows in or out of the active ones; then
two to four exact Newton steps end at the rounding of the optimality conditions, where an
interior-point method first leaves the limits and comes back. Where the conditions' residual does
not fall from step to step, many rows come and go, or the curvature is not that of a minimum, it
gives up soon: IPOPT solves it then, from the same neighbour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.solvers import Buffered
from ..transcription.derivatives import entries_of, stored
from ..transcription.transcription import Program
from .condensed import Beside, Condensed, Interval, Values

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


class Optimality:
    """Of one program's expressions: the judge of what a solver calls an optimum.

    gradient : (w, p) -> (f, gradient of f); jacobian : (w, p) -> (g, slopes of g).
    """

    def __init__(self, gradient: ca.Function, jacobian: ca.Function) -> None:
        self._gradient, self._jacobian = Buffered(gradient), _slopes(jacobian)
        self._rows, self._columns = entries_of(jacobian.sparsity_out(1))

    def __call__(
        self, numbers: Mapping[str, Array], w: Array, lam_g: Array, lam_x: Array
    ) -> tuple[float, float, float]:
        """Largest (residual of stationarity, violation of rows and bounds, product of a multiplier
        and the distance from its limit), in units of nominals. NaN where one is none.

        numbers : parameters and limits, by CasADi's names ("p", "lbx", "ubx", "lbg", "ubg").
        """
        p = numbers["p"]
        gradient = self._gradient(w, p)[1].ravel()
        g, slopes = (each.ravel() for each in self._jacobian(w, p))
        pulls = np.bincount(self._columns, slopes * lam_g[self._rows], len(w))
        dual = float(np.max(np.abs(gradient + pulls + lam_x)))
        miss = gap = 0.0
        for values, lam, kind in ((g, lam_g, "g"), (w, lam_x, "x")):
            low, high = numbers[f"lb{kind}"], numbers[f"ub{kind}"]
            beyond = np.maximum(low - values, values - high)
            miss = max(miss, float(np.max(beyond, initial=0.0)))
            pressed = (low < high) & (lam != 0)
            far = np.where(lam > 0, high, low)[pressed] - values[pressed]
            gap = max(gap, float(np.max(np.abs(lam[pressed] * far), initial=0.0)))
        return dual, miss, gap


def _slopes(jacobian: ca.Function) -> Buffered:
    """The values, and the slopes' entries as a column."""
    w, p = (ca.MX.sym("v", jacobian.size1_in(i)) for i in range(2))
    g, slopes = jacobian(w, p)
    return Buffered(ca.Function("slopes", [w, p], [ca.densify(g), stored(slopes)]))


STEPS, PASSES = 6, 14
"""Newton steps, and quadratic programs in all of them, at most."""
MANY = 30
"""Rows beyond their limits at once from which on it gives up."""
WORST = 0.6
"""Of rows beyond their limits those are held whose excess is that part of the largest, at least:
all at once contradict each other.
"""
BEYOND, WRONG = 1e-10, 1e-12
"""Excess of a row, and multiplier of the wrong sign, that are rounding."""
RESIDUAL, GAP = 1e-9, 1e-10
"""Of stationarity and rows, and of complementarity: what IPOPT's results keep."""


@dataclass(frozen=True)
class Point:
    """Unknowns and multipliers, with CasADi's signs."""

    w: Array
    lam_g: Array
    lam_x: Array
    log: tuple[dict[str, float], ...] = ()
    """One entry per step, and one for the start, by IPOPT's names."""


class Newton:
    """For one program's expressions, built once; see :meth:`made`."""

    def __init__(self, condensed: Condensed) -> None:
        self._condensed = condensed

    @classmethod
    def made(cls, program: Program) -> Newton | None:
        """None for programs that do not go stage by stage; see :meth:`Condensed.made`."""
        condensed = Condensed.made(program)
        return None if condensed is None else cls(condensed)

    def __call__(self, numbers: Mapping[str, Array], near: Point) -> Point | None:
        """The optimum from a neighbour's; None where it gives up.

        numbers : parameters and limits, by CasADi's names ("p", "lbx", "ubx", "lbg", "ubg").
        """
        try:
            with np.errstate(all="ignore"):
                return _Run(self._condensed, numbers, near).solved()
        except (NoMinimum, np.linalg.LinAlgError):
            return None


class _Run:
    """Rows are the program's, then its unknowns."""

    def __init__(self, made: Condensed, numbers: Mapping[str, Array], near: Point) -> None:
        self.made, self.p = made, numbers["p"]
        self.low = np.concatenate([numbers["lbg"], numbers["lbx"]])
        self.high = np.concatenate([numbers["ubg"], numbers["ubx"]])
        self.m = len(numbers["lbg"])
        self.equal = self.low == self.high
        self.aim = np.where(self.equal, self.low, 0.0)
        self.free = ~self.equal
        for group in made.groups:
            self.free[group.row_at[:, : group.defects]] = False
        self.w, self.lam = near.w.copy(), np.concatenate([near.lam_g, near.lam_x])
        self.log: list[dict[str, float]] = []

    def solved(self) -> Point | None:
        passes, before, length = 0, np.inf, 0.0
        self._evaluate()
        to_high = self.lam + self.values - self.high > 0
        to_low = self.lam + self.values - self.low < 0
        self.side = np.where(self.free, to_high * 1 - to_low * 1, 0)
        for step in range(STEPS + 1):
            error = self._error(length)
            if error <= 1.0:
                return Point(self.w, self.lam[: self.m], self.lam[self.m :], tuple(self.log))
            if step == STEPS or not error < before:
                return None
            before = error
            point = self.w, self.p, self.lam
            residual = self.values - self.aim
            stages = StageProgram(self.made, (self.at, self.beside), point, residual)
            while True:
                passes += 1
                aim = np.where(
                    self.side > 0, self.high, np.where(self.side < 0, self.low, self.aim)
                )
                found = stages.solved(self.equal | (self.side != 0), self.values - aim)
                if self._settled(found):
                    break
                if passes >= PASSES or self.beyond > MANY:
                    return None
            w, self.lam = stages.taken(found)
            w = np.clip(w, self.low[self.m :], self.high[self.m :])  # weights leave rounding
            length, self.w = float(np.max(np.abs(w - self.w))), w
            self._evaluate()
        return None

    def _evaluate(self) -> None:
        """Values and first derivatives at the unknowns."""
        made = self.made
        self.at = [group.values(self.w, self.p) for group in made.groups]
        self.beside = made.other.values(self.w, self.p, self.lam[: self.m])
        g = np.zeros(self.m)
        for group, found in zip(made.groups, self.at, strict=True):
            g[group.row_at] = found.rows
        g[made.other.first :] = self.beside.rows
        self.values = np.concatenate([g, self.w])

    def _error(self, length: float) -> float:
        """Of the optimality conditions, in parts of what is allowed."""
        made, other, n = self.made, self.made.other, len(self.w)
        slope = self.lam[self.m :].copy()
        for group, found in zip(made.groups, self.at, strict=True):
            lam = self.lam[group.row_at]
            own = found.gradient + (lam[:, None, :] @ found.slopes)[:, 0]
            slope += np.bincount(group.unknowns.ravel(), own.ravel(), n)
        lam = self.lam[other.first : self.m][other.slope_at[0]]
        slope += np.bincount(other.slope_of, self.beside.slopes * lam, n)
        slope += np.bincount(other.gradient_of, self.beside.gradient, n)
        dual = float(np.max(np.abs(slope)))
        beyond = np.maximum(self.low - self.values, self.values - self.high)
        miss = float(np.max(beyond, initial=0.0))
        wall = np.where(self.lam > 0, self.high, self.low)
        pressed = self.free & (self.lam != 0)
        gap = float(np.max(np.abs((self.lam * (wall - self.values))[pressed]), initial=0.0))
        cost = self.beside.cost + sum(found.cost for found in self.at)
        names = ("obj", "inf_pr", "inf_du", "mu", "d_norm")
        self.log.append(dict(zip(names, (cost, miss, dual, gap, length), strict=True)))
        return max(dual / RESIDUAL, miss / RESIDUAL, gap / GAP)

    def _settled(self, found: Step) -> bool:
        """Whether the right rows were active; else some others are now."""
        new = self.values + found.change
        over = np.maximum(new - self.high, self.low - new)
        over[~self.free | (self.side != 0)] = 0.0
        wrong = (self.side != 0) & (self.side * found.lam < -WRONG)
        worst = float(over.max())
        self.beyond = int(np.count_nonzero(over > BEYOND))
        self.side[wrong] = 0
        if self.beyond:
            added = over > WORST * worst
            self.side[added] = np.where(new[added] > self.high[added], 1, -1)
        return not self.beyond and not wrong.any()
