"""Damped Newton steps to a least sum of squares, from many starts side by side.

The exact second derivatives make the last steps quadratic; where they have no minimum, far from an
optimum, those of Gauss and Newton stand in (K. Levenberg, D. Marquardt). A coefficient that is
pushed against a bound rests there (D. Bertsekas, SIAM J. Control Optim. 20 (1982) 221-246).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.stop import check
from ..statistics import Array
from .least_squares import Sums

__all__ = ["Descended", "descend"]

ITERATIONS = 150
"""Evaluations of all starts that are still on their way."""
FIRST_DAMPING = 1e-6
"""Of columns of unit length; none as long as whole steps do."""
LARGEST_DAMPING = 1e8
NEAR = 0.1
"""Part of the cost that a step took off, from which on second derivatives of residuals pay."""
LAST_STEP = 1e-12
"""Part of the cost that a whole Newton step would still take off, from which it is the last."""
SAME = 1e-6
"""Part of a cost by which a start that comes down to it leads to the same place."""
FAR, PATIENCE = 1.5, 25
"""Times the least cost so far, and evaluations after which a start that is above it is left."""
DEFINITE = 1e-13
"""Smallest eigenvalue of second derivatives, columns of unit length, that counts as positive."""


class Squares(Protocol):
    """A sum of squares over unknowns, of which the ``free`` ones may move."""

    @property
    def free(self) -> Sequence[int]: ...

    @property
    def size(self) -> float:
        """Norm of the weighted measurements [N]."""
        ...

    def sums(self, coefficients: Array, second: bool = False) -> Sums: ...


@dataclass(frozen=True, eq=False)
class Descended:
    """Where starts came to: coefficients (m, all), costs (m,), steps (m,), and which free
    coefficients rest at a bound (m, free).
    """

    coefficients: Array
    cost: Array
    steps: NDArray[np.intp]
    resting: NDArray[np.bool_]


def descend(
    problem: Squares, starts: Array, low: Array, high: Array, settled: float = 0.0
) -> Descended:
    """Follow starts (m, all) to the least squares next to them, priors included.

    low, high : bounds of the free coefficients, (m, free); those with low = high stay where they
    are. settled : relative fall of the cost in one step at which a descent ends; by default it goes
    on to a stationary point. Costs are infinite where the law gives no finite force at the start.
    """
    return _Descent(problem, starts, low, high, settled).run()


class _Descent:
    def __init__(
        self, problem: Squares, starts: Array, low: Array, high: Array, settled: float
    ) -> None:
        self.problem, self.free, self.settled = problem, list(problem.free), settled
        self.low, self.high, self.c = low, high, starts.copy()
        self.c[:, self.free] = np.clip(starts[:, self.free], low, high)
        m, k = len(starts), len(self.free)
        self.near = np.zeros(m, dtype=bool)
        self.cost, *rest = self._at(self.c, self.near)
        self.sums: list[Array] = rest
        self.damping, self.steps = np.zeros(m), np.zeros(m, dtype=np.intp)
        self.resting, self.newton = low >= high, np.zeros(m, dtype=bool)
        self.norms, self.right = np.ones((m, k)), np.zeros((m, k))
        self.values, self.vectors = np.ones((m, k)), np.zeros((m, k, k))
        self.floor = 1e-24 * problem.size**2

    def run(self) -> Descended:
        active = np.isfinite(self.cost) & ~self.resting.all(axis=1)
        fresh = active.copy()
        least = np.inf
        for count in range(ITERATIONS):
            check()
            rows = np.nonzero(active)[0]
            if not rows.size:
                break
            self._model(np.nonzero(active & fresh)[0])
            step, gain = self._step(rows)
            trial = self.c[rows]
            with np.errstate(all="ignore"):
                trial[:, self.free] = np.clip(
                    trial[:, self.free] + step, self.low[rows], self.high[rows]
                )
            cost, *sums = self._at(trial, self.near[rows])
            before = self.cost[rows]
            part = np.where(self.newton[rows], LAST_STEP, LAST_STEP**1.5)
            last = (self.damping[rows] == 0) & (gain <= part * before + self.floor)
            last &= cost <= before * (1 + 1e-9) + self.floor
            better = (cost <= before) | last
            fall = before - cost
            done = last | (better & (fall <= self.settled * before) & (self.settled > 0))
            done |= better & (fall <= 0) & (gain <= LAST_STEP * before)
            good, bad = rows[better], rows[~better]
            self.c[good], self.cost[good] = trial[better], cost[better]
            for held, new in zip(self.sums, sums, strict=True):
                held[good] = new[better]
            self.steps[good] += 1
            damping = self.damping[good]
            self.damping[good] = np.where(damping > FIRST_DAMPING, damping / 10, 0.0)
            self.damping[bad] = np.maximum(4 * self.damping[bad], FIRST_DAMPING)
            self.near[good] = fall[better] <= NEAR * cost[better]
            fresh[good], fresh[bad] = True, False
            active[rows[done]] = False
            least = float(np.min(self.cost[rows[done]], initial=least))
            active &= ~self._idle(least, count)
            active &= self.damping < LARGEST_DAMPING
        return Descended(self.c, self.cost, self.steps, self.resting)

    def _idle(self, least: float, count: int) -> NDArray[np.bool_]:
        """Starts that need not be followed: on their way to where another has come, or long on a
        way from far above it.
        """
        same = (self.cost >= least) & (self.cost <= least * (1 + SAME))
        return same | ((self.cost > FAR * least) & (count > PATIENCE))

    def _at(self, c: Array, near: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
        """Cost, J^T r, J^T J and second derivatives of the free coefficients; the last only where
        ``near``.
        """
        m, k = len(c), len(self.free)
        found = (np.empty(m), np.empty((m, k)), np.empty((m, k, k)), np.zeros((m, k, k)))
        for chosen, second in ((~near, False), (near, True)):
            if chosen.any():
                cost, right, normal, bent = self.problem.sums(c[chosen], second)
                found[0][chosen], found[1][chosen] = cost, right[:, self.free]
                found[2][chosen] = normal[:, self.free][:, :, self.free]
                found[3][chosen] = bent[:, self.free][:, :, self.free]
        finite = np.isfinite(found[0]) & np.isfinite(found[2]).all(axis=(1, 2))
        found[0][~finite] = np.inf
        found[3][~np.isfinite(found[3]).all(axis=(1, 2))] = 0.0
        return found

    def _model(self, rows: NDArray[np.intp]) -> None:
        """The quadratic model at where these rows stand, in columns of unit length."""
        if not rows.size:
            return
        right, normal, second = (held[rows] for held in self.sums)
        z, low, high = self.c[rows][:, self.free], self.low[rows], self.high[rows]
        norms = np.sqrt(np.einsum("mii->mi", normal))
        norms = np.where(norms > 0, norms, 1.0)
        right = right / norms
        resting = (low >= high) | ((z <= low) & (right < 0)) | ((z >= high) & (right > 0))
        both = norms[:, :, None] * norms[:, None, :]
        normal = normal / both
        values, vectors = np.linalg.eigh(_without(normal, resting))
        newton = self.near[rows] & second.any(axis=(1, 2))
        if newton.any():
            whole = (normal + second / both)[newton]
            exact = np.linalg.eigh(_without(whole, resting[newton]))
            definite = exact[0][:, 0] > DEFINITE
            newton[newton] = definite
            values[newton], vectors[newton] = exact[0][definite], exact[1][definite]
        self.newton[rows], self.resting[rows] = newton, resting
        self.norms[rows], self.right[rows] = norms, np.where(resting, 0.0, right)
        self.values[rows], self.vectors[rows] = np.maximum(values, 1e-12), vectors

    def _step(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Steps (r, free), and what they promise to take off the costs (r,)."""
        along = np.einsum("mij,mi->mj", self.vectors[rows], self.right[rows])
        parts = along / (self.values[rows] + self.damping[rows, None])
        step = np.einsum("mij,mj->mi", self.vectors[rows], parts)
        return step / self.norms[rows], np.sum(along * parts, axis=1)


def _without(matrix: Array, resting: NDArray[np.bool_]) -> Array:
    """The rows and columns of coefficients that rest made those of the identity."""
    open_ = ~resting
    kept = np.where(open_[:, :, None] & open_[:, None, :], matrix, 0.0)
    return np.asarray(kept + np.eye(resting.shape[1]) * resting[:, :, None])
