"""Damped Gauss-Newton (Levenberg, Marquardt) from normal equations, within bounds.

For residuals too many to be held: what comes in is their sum of squares, its gradient and the
normal matrix (J. Nocedal, S. Wright, Numerical Optimization, 2006, 10.3). The best that was seen is
kept, whatever ends the search.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np

from ...core.errors import FitError, InputError
from ...core.stop import TimeIsUp, check
from ..statistics import Array

__all__ = ["GRACE", "Descent", "Normal", "Progress", "Report", "descend", "from_fewer", "reporter"]

Result = TypeVar("Result")

GRACE = 20.0
"""For what is told of a fit that a time limit ended [s]."""
LEAST, MOST = 1e-8, 1e8
"""Of the damping, in parts of the normal matrix' diagonal."""
FIRST = 1e-3
"""The same of the first step."""
ENOUGH = 1e-5
"""Relative gain of a step below which the search ends."""
FEWER = 6
"""Fits with one unknown less that are tried as starts, at most."""
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
    *,
    enough: float = ENOUGH,
    damping: float = FIRST,
    progress: Callable[[int, float, Array], None] | None = None,
) -> Descent:
    """Least squares from z; at most so many ``evaluations`` of the normal matrix.

    enough : relative gain of a step below which the search ends. damping : of the first step, in
    parts of the normal matrix' diagonal. progress : called as
    progress(evaluations, cost, z) at each new point. A time limit that ends does not raise when
    there is a point to show.
    """
    z, growth = np.clip(z, low, high), 4.0
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
                if not expected > 1e-3 * enough * cost:
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
            if gain < enough:
                status, converged = f"a step gains less than {enough:g} of the cost", True
                break
    except TimeIsUp:
        if not count:
            raise
        status = "the time limit ended the search; the best until then is kept"
        timed = True
    return Descent(best[1], best[0], count, status, converged, damped, timed)


def from_fewer(
    best: Result,
    cost: Callable[[Result], float],
    places: Sequence[int],
    without: Callable[[int], Result],
    again: Callable[[Result], Result],
) -> Result:
    """No freedom makes a fit worse: the same, or what is found from where a fit leads that has one
    unknown less, where that is better.

    without : the fit without the unknown at a place; again : with all of them, from there.
    """
    for place in list(places)[-FEWER:]:
        try:
            poorer = without(place)
            if cost(poorer) < cost(best):
                best = min(best, again(poorer), key=cost)
        except FitError:
            continue
        except TimeIsUp:
            break
    return best


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


LOG = logging.getLogger(__name__)

Report: TypeAlias = Callable[[str, int, float], Any]
"""Called with the stage, its iterations until now, and the cost."""
Progress: TypeAlias = "bool | Report"


def reporter(progress: Progress) -> Report:
    """What to call: nothing for False, a line on stderr for True, or the user's function."""
    if callable(progress):
        return progress
    if not isinstance(progress, bool):
        raise InputError(
            f"progress = {progress!r}: give True to print, or a function (stage, iteration, cost)"
        )
    return _printed if progress else _logged


def _logged(stage: str, count: int, cost: float) -> None:
    LOG.debug("%s, iteration %d: cost %.6g", stage, count, cost)


def _printed(stage: str, count: int, cost: float) -> None:
    print(f"{stage:<28} {count:>5}  {cost:.6g}", file=sys.stderr, flush=True)
