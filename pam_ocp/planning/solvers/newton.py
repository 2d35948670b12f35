"""Newton's method from a neighbour's optimum: quadratic programs along the stages.

A change of a few percent in a problem's numbers moves few rows in or out of the active ones; then
two to four exact Newton steps end at the rounding of the optimality conditions, where an
interior-point method first leaves the limits and comes back. Where the conditions' residual does
not fall from step to step, many rows come and go, or the curvature is not that of a minimum, it
gives up soon: IPOPT solves it then, from the same neighbour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.buffered import Buffered
from ..transcription.transcription import Program
from .condensed import Condensed
from .stage_steps import NoMinimum, StageProgram, Step

__all__ = ["GAP", "RESIDUAL", "Newton", "Optimality", "Point"]

Array: TypeAlias = NDArray[np.float64]


class Optimality:
    """Of one program's expressions: the judge of what a solver calls an optimum.

    gradient : (w, p) -> (f, gradient of f); jacobian : (w, p) -> (g, slopes of g).
    """

    def __init__(self, gradient: ca.Function, jacobian: ca.Function) -> None:
        self._gradient, self._jacobian = Buffered(gradient), _slopes(jacobian)
        rows, columns = jacobian.sparsity_out(1).get_triplet()
        self._rows, self._columns = np.array(rows, np.intp), np.array(columns, np.intp)

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
    entries = slopes.nz[:] if slopes.nnz() else ca.MX(0, 1)
    return Buffered(ca.Function("slopes", [w, p], [ca.densify(g), entries]))


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
