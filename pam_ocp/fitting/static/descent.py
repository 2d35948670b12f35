"""Damped least squares over some coefficients of a law,
from where they are (Levenberg-Marquardt).
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


def descend(problem: LeastSquares, start: Array, moved: Sequence[int]) -> tuple[Array, float]:
    """The coefficients (all) and the least squares that they come to, priors included.

    moved : positions of the coefficients that may change, within their bounds. The cost is infinite
    where the law gives no finite force at the start. Columns are scaled, so that coefficients
    of any size, or hardly seen ones, do no harm.
    """
    places = list(moved)
    low = np.array([problem.variables[i].min for i in places])
    high = np.array([problem.variables[i].max for i in places])
    c, damping = start.copy(), 1e-4
    c[places] = np.clip(c[places], low, high)
    rest, slopes, cost = _at(problem, c)
    if not np.isfinite(cost) or not places:
        return c, cost
    for _ in range(ITERATIONS):
        columns = slopes[:, places]
        norms = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(norms > 0, norms, 1.0)
        normal, right = columns.T @ columns, columns.T @ rest
        before = cost
        while damping < 1e8:
            step = np.linalg.solve(normal + damping * np.eye(len(places)), right)
            trial = c.copy()
            moved_by = step / np.where(norms > 0, norms, np.inf)
            trial[places] = np.clip(c[places] + moved_by, low, high)
            new = _at(problem, trial)
            if new[2] <= cost:
                c, (rest, slopes, cost) = trial, new
                damping = max(damping / 10, 1e-10)
                break
            damping *= 4
        if before - cost <= SETTLED * before:
            break
    return c, cost


def _at(problem: LeastSquares, c: Array) -> tuple[Array, Array, float]:
    with np.errstate(all="ignore"):
        rest, slopes = (a[0] for a in problem.with_priors(c[None]))
        cost = float(rest @ rest)
    finite = np.isfinite(cost) and np.all(np.isfinite(slopes))
    return rest, slopes, cost if finite else float("inf")
