"""Newton's method from a neighbour's optimum: quadratic programs along the stages, whose active rows
are sought from the neighbour's.

A change of a few percent in a problem's numbers moves few rows in or out of the active ones; then
some two to four exact Newton steps on the optimality conditions end at their rounding, where an
interior-point method first leaves the boundary and comes back. Each step is a Riccati recursion.
Active rows are held by weights whose multipliers are corrected from step to step (method of
multipliers), so that redundant ones do no harm. Where steps do not contract, rows come and go, or
the curvature is not that of a minimum, it gives up soon: somebody else solves it then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..transcription.transcription import Program
from .condensed import Condensed, Values

__all__ = ["Newton", "Point"]

Array: TypeAlias = NDArray[np.float64]

STEPS, PASSES = 5, 10
"""Newton steps, and quadratic programs' recursions in all of them, at most."""
CHANGES = 12
"""Rows that become active or inactive at once, at most."""
WEIGHT = 1e6
"""Of active rows' residuals, in units of nominals."""
RESIDUAL, GAP = 1e-9, 1e-10
"""Of stationarity and constraints, of complementarity: what IPOPT's results keep."""
WORST = 0.9
"""Rows are added whose violation is that part of the largest, at least."""


@dataclass
class Point:
    """Unknowns and multipliers, with CasADi's signs."""

    w: Array
    lam_g: Array
    lam_x: Array
    steps: int = 0


class NoMinimum(Exception):
    """The curvature along the free directions is not positive."""


class Newton:
    """For one program's expressions, built once."""

    def __init__(self, program: Program) -> None:
        self.made = Condensed(program)

    def solve(self, program: Program, near: Point) -> Point | None:
        """From a neighbour's optimum; None where it gives up."""
        try:
            with np.errstate(all="ignore"):
                return _Run(self.made, program, near).solve()
        except (NoMinimum, np.linalg.LinAlgError):
            return None


class _Run:
    def __init__(self, made: Condensed, program: Program, near: Point) -> None:
        self.made, self.layout = made, made.layout
        self.p = program.parameters()
        (wl, wh), (gl, gh) = program.bounds(), program.limits()
        self.low, self.high = np.concatenate([gl, wl]), np.concatenate([gh, wh])
        self.m = len(gl)
        self.equal = self.low == self.high
        self.w = near.w.copy()
        self.lam = np.concatenate([near.lam_g, near.lam_x])
        self.fixed = np.flatnonzero(made.layout.stage == -1)

    def solve(self) -> Point | None:
        passes, before = 0, np.inf
        self._evaluate()
        reach = self.lam + self.values - self.high
        back = self.lam + self.values - self.low
        self.side = np.where(self.equal, 0, (reach > 0) * 1 - (back < 0) * 1)
        for step in range(STEPS + 1):
            error = self._error()
            if DEBUG:
                print("   step", step, "error %.1e" % error, self._parts, passes)
            if error <= 1.0:
                return Point(self.w, self.lam[: self.m], self.lam[self.m :], step)
            if step == STEPS or not error < before or passes >= PASSES:
                return None
            before = error if step else np.inf
            self._condense()
            while True:
                self._pass()
                passes += 1
                change = self._change()
                if not change:
                    break
                if passes >= PASSES or change > CHANGES:
                    return None
            self._take()
            self._evaluate()
        return None

    # ---- at a point -----------------------------------------------------------------------------
    def _evaluate(self) -> None:
        """Values and first derivatives at the unknowns."""
        made = self.made
        self.at = [group.values(self.w, self.p) for group in made.groups]
        self.beside = made.beside(self.w, self.p, self.lam)
        g = np.zeros(self.m)
        for group, found in zip(made.groups, self.at, strict=True):
            g[group.row_at] = found.rows
        g[made.other.first :] = self.beside[0]
        self.values = np.concatenate([g, self.w])

    def _error(self) -> float:
        """Of the optimality conditions, in units of what is allowed."""
        made, n = self.made, len(self.w)
        slope = self.lam[self.m :].copy()
        for group, found in zip(made.groups, self.at, strict=True):
            lam = self.lam[group.row_at]
            own = found.gradient + np.einsum("kr,kry->ky", lam, found.slopes)
            slope += np.bincount(group.unknowns.ravel(), own.ravel(), n)
        other, (_, slopes, gradient, _) = made.other, self.beside
        lam = self.lam[other.first : self.m]
        slope += np.bincount(other.slope_of, slopes * lam[other.slope_at[0]], n)
        slope += np.bincount(other.gradient_of, gradient, n)
        dual = np.max(np.abs(slope))
        miss = max(np.max(self.low - self.values), np.max(self.values - self.high))
        to = np.where(self.lam > 0, self.high, self.low) - self.values
        gap = np.max(np.abs(np.where(self.equal | (self.lam == 0), 0.0, self.lam * to)))
        self._parts = f"dual {dual:.1e} miss {miss:.1e} gap {gap:.1e}"
        return float(max(dual / RESIDUAL, miss / RESIDUAL, gap / GAP))

    # ---- the quadratic program ------------------------------------------------------------------
    def _condense(self) -> None:
        """What stays the same while active rows change."""
        made, lay = self.made, self.layout
        nx, one, size = lay.nx, lay.one, lay.size
        self.parts = []
        self.base = np.zeros((lay.count + 1, size, size))
        self.step = np.zeros((lay.count, lay.carried, size))
        same = np.arange(nx, one + 1)
        self.step[:, same, same] = 1.0
        for group, found in zip(made.groups, self.at, strict=True):
            n, ny = group.unknowns.shape
            nd = group.defects
            lam = self.lam[group.row_at]
            hessian = group.curvature(self.w, self.p, lam)
            slopes = found.slopes
            inverse = np.linalg.inv(slopes[:, :nd, nx : nx + nd])
            z = np.zeros((n, ny, size))
            widths = ny - nx - nd - lay.shared
            i = np.arange(nx)
            z[:, i, i] = 1.0
            i = np.arange(widths)
            z[:, nx + nd + i, lay.carried + i] = 1.0
            i = np.arange(lay.shared)
            z[:, ny - lay.shared + i, nx + i] = 1.0
            right = slopes[:, :nd] @ z
            right[:, :, one] += found.rows[:, :nd]
            z[:, nx : nx + nd] = -inverse @ right
            curved = hessian @ z
            m = z.transpose(0, 2, 1) @ curved
            linear = np.einsum("ky,kyv->kv", found.gradient, z)
            m[:, one, :] += linear
            m[:, :, one] += linear
            if widths < lay.nu:
                i = lay.carried + np.arange(widths, lay.nu)
                m[:, i, i] += 1.0
            i = lay.carried + np.arange(lay.nu)
            m[:, i, i] += SHIFT
            self.base[group.members] = m
            self.step[group.members, :nx] = z[:, nd : nd + nx]
            path = slopes[:, nd:] @ z
            own = z[:, nx : nx + nd + widths]
            rows = np.concatenate(
                [group.row_at[:, nd:], self.m + group.unknowns[:, nx : nx + nd + widths]], axis=1
            )
            self.parts.append((group, z, curved, inverse, np.concatenate([path, own], axis=1), rows))
        other, (_, slopes, gradient, curvature) = made.other, self.beside
        at = other.curvature_at
        np.add.at(self.base, at, curvature)
        off = at[1] != at[2]
        np.add.at(self.base, (at[0][off], at[2][off], at[1][off]), curvature[off])
        np.add.at(self.base, (other.gradient_at[0], one, other.gradient_at[1]), gradient)
        np.add.at(self.base, (other.gradient_at[0], other.gradient_at[1], one), gradient)
        self.beside_rows = np.zeros((len(other.rows), size))
        np.add.at(self.beside_rows, other.slope_at, slopes)

    def _pass(self) -> None:
        """The quadratic program with the rows that are active now: forth in ``self.v``."""
        lay, made = self.layout, self.made
        one, nc = lay.one, lay.carried
        active = self.equal | (self.side != 0)
        aim = np.where(self.side > 0, self.high, self.low)
        miss = np.where(active, self.values - np.where(active, aim, 0.0), 0.0)
        lam = np.where(active, self.lam, 0.0)
        weight = np.where(active, WEIGHT, 0.0)
        total = self.base.copy()
        for group, _, _, _, rows, at in self.parts:
            r = rows.copy()
            r[:, :, one] += miss[at]
            total[group.members] += r.transpose(0, 2, 1) @ (weight[at][..., None] * r)
            linear = (lam[at][:, None, :] @ r)[:, 0]
            total[group.members, one, :] += linear
            total[group.members, :, one] += linear
        first = made.other.first
        r = self.beside_rows.copy()
        r[:, one] += miss[first : self.m]
        for i, k in enumerate(made.other.rows):
            total[k] += (weight[first + i] * r[i])[:, None] * r[i]
            total[k, one, :] += lam[first + i] * r[i]
            total[k, :, one] += lam[first + i] * r[i]
        end, place = total[-1], lay.place[self.fixed]
        at = self.m + self.fixed
        end[place, place] += weight[at]
        linear = weight[at] * miss[at] + lam[at]
        end[place, one] += linear
        end[one, place] += linear
        self._riccati(total, nc)
        self._look(active, miss, lam, weight)

    def _riccati(self, total: Array, nc: int) -> None:
        lay, step = self.layout, self.step
        count, nx, one = lay.count, lay.nx, lay.one
        value = np.zeros((count + 1, nc, nc))
        gains = np.zeros((count, lay.nu, nc))
        pivots = np.zeros((count, lay.nu, lay.nu))
        value[count] = v = total[-1][:nc, :nc]
        inverse, transposed = _inverse(lay.nu), step.transpose(0, 2, 1)
        for k in range(count - 1, -1, -1):
            both = total[k] + transposed[k] @ v @ step[k]
            pivots[k] = pivot = both[nc:, nc:]
            gains[k] = gain = inverse(pivot) @ -both[nc:, :nc]
            v = both[:nc, :nc] + both[:nc, nc:] @ gain
            value[k] = v = (v + v.T) / 2
        if not np.linalg.eigvalsh(pivots).min() > 0:
            raise NoMinimum
        # the first state is one of the coordinates that go along
        join = np.zeros((nc, nc - nx))
        i = np.arange(nc - nx)
        join[nx + i, i] = 1.0
        i = np.arange(nx)
        join[i, lay.shared + i] = 1.0
        root = join.T @ value[0] @ join
        np.linalg.cholesky(root[:-1, :-1])
        free = -np.linalg.solve(root[:-1, :-1], root[:-1, -1])
        along = np.zeros((count + 1, lay.size))
        x = join @ np.append(free, 1.0)
        for k in range(count):
            along[k, :nc] = x
            along[k, nc:] = gains[k] @ x
            x = step[k] @ along[k]
        along[count, :nc] = x
        self.along, self.value = along, value

    def _look(self, active: Array, miss: Array, lam: Array, weight: Array) -> None:
        """New values of all rows, and multipliers of active ones."""
        lay, made, along = self.layout, self.made, self.along
        change = np.zeros(len(self.values))
        for group, _, _, _, rows, at in self.parts:
            change[at] = (rows @ along[group.members][:, :, None])[..., 0]
        beside = np.einsum("rv,rv->r", self.beside_rows, along[made.other.rows])
        change[made.other.first : self.m] = beside
        change[self.m + self.fixed] = along[-1][lay.place[self.fixed]]
        self.new = self.values + change
        self.new_lam = lam + weight * (miss + change)

    def _change(self) -> int:
        """How many rows become active or inactive; 0 when the quadratic program is solved."""
        free = ~self.equal & (self.side == 0)
        over = np.where(free, np.maximum(self.new - self.high, self.low - self.new), 0.0)
        for group, *_ in self.parts:
            over[group.row_at[:, : group.defects]] = 0.0
        wrong = (self.side != 0) & (self.side * self.new_lam < -1e-12)
        worst, count = float(over.max()), int(wrong.sum())
        if worst > 1e-10:
            added = over > WORST * worst
            self.side[added] = np.where(self.new[added] > self.high[added], 1, -1)
            count += int(added.sum())
            if DEBUG:
                print("     over %.1e" % worst, "added", added.sum(), "of", (over > 1e-10).sum(), "wrong", wrong.sum())
        elif DEBUG:
            print("     wrong", wrong.sum())
        self.side[wrong] = 0
        return count

    def _take(self) -> None:
        """The step, with the multipliers of the defects."""
        lay, nx = self.layout, self.layout.nx
        lam = self.new_lam
        w = self.w.copy()
        w[self.fixed] += self.along[-1][lay.place[self.fixed]]
        costate = np.einsum("kij,kj->ki", self.value[1:], self.along[1:, : lay.carried])[:, :nx]
        for (group, z, curved, inverse, _, _), found in zip(self.parts, self.at, strict=True):
            nd, own = group.defects, slice(nx, group.unknowns.shape[1] - lay.shared)
            along = self.along[group.members][:, :, None]
            change = (z @ along)[..., 0]
            w[group.unknowns[:, own]] += change[:, own]
            force = (curved @ along)[..., 0] + found.gradient
            path = lam[group.row_at[:, nd:]]
            force += (path[:, None, :] @ found.slopes[:, nd:])[:, 0]
            states = force[:, nx : nx + nd] + lam[self.m + group.unknowns[:, nx : nx + nd]]
            states[:, nd - nx :] += costate[group.members]
            lam[group.row_at[:, :nd]] = -(states[:, None, :] @ inverse)[:, 0]
        self.w, self.lam = w, lam


def _inverse(size: int) -> Callable[[Array], Array]:
    """Of small matrices; NumPy's takes six times as long for two inputs."""

    def of_two(matrix: Array) -> Array:
        (a, b), (c, d) = matrix.tolist()
        by = a * d - b * c
        return np.array([[d / by, -b / by], [-c / by, a / by]]) if by else np.full((2, 2), np.nan)

    return of_two if size == 2 else np.linalg.inv


DEBUG = False
SHIFT = 0.0
