"""Damped Gauss-Newton (Levenberg, Marquardt) from normal equations, within bounds.

For residuals too many to be held: what comes in is their sum of squares, its gradient and the
normal matrix (J. Nocedal, S. Wright, Numerical Optimization, 2006, 10.3). The best that was seen is
kept, whatever ends the search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...core.stop import TimeIsUp, check
from ..statistics import Array

__all__ = ["Descent", "Normal", "descend"]

LEAST, MOST = 1e-8, 1e8
"""Of the damping, in parts of the normal matrix' diagonal."""
ENOUGH = 1e-5
"""Relative gain of a step below which the search ends."""
TRIES = 8
"""Steps from one point, each damped more, before the search ends there."""


class Normal(Protocol):
    """A sum of squares: ``cost(z)``, and ``normal(z)`` = (cost, J^T r, J^T J, rows damped)."""

    def cost(self, z: Array, /) -> float: ...

    def normal(self, z: Array, /) -> tuple[float, Array, Array, int]: ...


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the search ended, and why. damped : of the last point, see :class:`Normal`."""

    z: Array
    cost: float
    evaluations: int
    status: str
    converged: bool
    damped: int
    timed: bool = False
    """Whether a time limit ended the search."""


def descend(
    problem: Normal,
    z: Array,
    low: Array,
    high: Array,
    evaluations: int,
    progress: Callable[[int, float, Array], None] | None = None,
) -> Descent:
    """Least squares from z; at most so many ``evaluations`` of the normal matrix.

    progress : called as progress(evaluations, cost, z) at each new point. A time limit that ends
    does not raise when there is a point to show.
    """
    z, damping, growth = np.clip(z, low, high), 1e-3, 4.0
    best, count, damped = (problem.cost(z), z), 0, 0
    timed = False
    status, converged = f"stopped after {evaluations} evaluations", False
    try:
        while count < evaluations:
            cost, gradient, square, damped = problem.normal(z)
            count += 1
            if progress is not None:
                progress(count, cost, z)
            accepted = False
            for _ in range(TRIES):
                check()
                step = _step(z, gradient, square, damping, low, high)
                expected = -(gradient @ step + step @ square @ step / 2)
                if not expected > 1e-3 * ENOUGH * cost:
                    break
                trial = np.clip(z + step, low, high)
                found = problem.cost(trial)
                if np.isfinite(found) and found < cost:
                    accepted, growth = True, 4.0
                    share = (cost - found) / (2 * expected)
                    damping = max(LEAST, damping * max(1 / 9, float(1 - (2 * share - 1) ** 3)))
                    break
                damping = min(MOST, damping * growth)
                growth *= 2
            if not accepted:
                status, converged = "no step leads further down", True
                break
            gain, z = (cost - found) / max(cost, 1e-300), trial
            best = (found, z)
            if gain < ENOUGH:
                status, converged = f"a step gains less than {ENOUGH:g} of the cost", True
                break
    except TimeIsUp:
        if not count:
            raise
        status = "the time limit ended the search; the best until then is kept"
        timed = True
    return Descent(best[1], best[0], count, status, converged, damped, timed)


def _step(
    z: Array, gradient: Array, square: Array, damping: float, low: Array, high: Array
) -> Array:
    """Minimiser of the damped model within the bounds: unknowns that a bound holds back are taken
    out one set after the other.
    """
    scale = np.sqrt(np.maximum(np.diag(square), 1e-12 * np.diag(square).max(initial=1e-300)))
    matrix = square / np.outer(scale, scale) + damping * np.eye(len(z))
    step, free = np.zeros(len(z)), np.ones(len(z), dtype=bool)
    lower, upper = (low - z) * scale, (high - z) * scale
    right = -gradient / scale
    for _ in range(len(z) + 1):
        inner = right[free] - matrix[np.ix_(free, ~free)] @ step[~free]
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], inner)
        out = free & ((step < lower) | (step > upper))
        if not out.any():
            break
        step[out] = np.clip(step[out], lower[out], upper[out])
        free &= ~out
    return np.asarray(step / scale)
