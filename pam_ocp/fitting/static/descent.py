"""Damped Newton steps over some coefficients of a law, from where they are.

The exact second derivatives make the last steps quadratic; where they are not positive definite,
far from an optimum, those of Gauss and Newton stand in (K. Levenberg, D. Marquardt).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..statistics import Array
from .least_squares import LeastSquares

__all__ = ["descend"]

ITERATIONS = 60
SETTLED = 1e-9
"""Relative fall of the cost at which a descent ends."""
FIRST_DAMPING = 1e-6
"""Of columns of unit length; none as long as whole steps do."""
LARGEST_DAMPING = 1e8


def descend(
    problem: LeastSquares, start: Array, moved: Sequence[int], settled: float = SETTLED
) -> tuple[Array, float, int]:
    """The coefficients (all), the least squares that they come to, priors included, and how many
    steps it took.

    moved : positions of the coefficients that may change, within their bounds. The cost is infinite
    where the law gives no finite force at the start. Columns are scaled, so that coefficients
    of any size, or hardly seen ones, do no harm.
    """
    places = list(moved)
    low = np.array([problem.variables[i].min for i in places])
    high = np.array([problem.variables[i].max for i in places])
    c, damping, count = start.copy(), 0.0, 0
    c[places] = np.clip(c[places], low, high)
    rest, slopes, cost = _at(problem, c)
    if not np.isfinite(cost) or not places:
        return c, cost, count
    for count in range(1, ITERATIONS + 1):
        columns = slopes[:, places]
        norms = np.linalg.norm(columns, axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        normal = (columns.T @ columns) / np.outer(norms, norms)
        right = (columns.T @ rest) / norms
        whole = normal + _curvature(problem, c, rest, places) / np.outer(norms, norms)
        before = cost
        while damping < LARGEST_DAMPING:
            trial = c.copy()
            trial[places] = np.clip(
                c[places] + _step(whole, normal, right, damping) / norms, low, high
            )
            new = _at(problem, trial)
            if new[2] <= cost:
                c, (rest, slopes, cost) = trial, new
                damping = damping / 10 if damping > FIRST_DAMPING else 0.0
                break
            damping = max(4 * damping, FIRST_DAMPING)
        if before - cost <= settled * before:
            break
    return c, cost, count


def _step(whole: Array, normal: Array, right: Array, damping: float) -> Array:
    """With all second derivatives, or, where they have no minimum, without those of residuals."""
    identity = np.eye(len(right))
    try:
        np.linalg.cholesky(whole + (damping - 1e-12) * identity)
        return np.asarray(np.linalg.solve(whole + damping * identity, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.solve(normal + max(damping, 1e-12) * identity, right))


def _curvature(problem: LeastSquares, c: Array, rest: Array, places: list[int]) -> Array:
    found = problem.curvature(c, rest[: len(problem.cells)])[np.ix_(places, places)]
    return np.asarray(found if np.isfinite(found).all() else np.zeros_like(found))


def _at(problem: LeastSquares, c: Array) -> tuple[Array, Array, float]:
    with np.errstate(all="ignore"):
        rest, slopes = (a[0] for a in problem.with_priors(c[None]))
        cost = float(rest @ rest)
    finite = np.isfinite(cost) and np.all(np.isfinite(slopes))
    return rest, slopes, cost if finite else float("inf")
