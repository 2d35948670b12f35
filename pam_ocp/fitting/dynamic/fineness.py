"""Whether the steps of free runs are short enough for what is said of them.

Halving the steps changes the runs by a gap. What values it would move is told by the fit's own
normal equations: least squares shift by -(J^T J)^-1 J^T gap. Beside that stands what the gap is to
the errors of the runs themselves.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..statistics import Array
from .rollout import Rollout

__all__ = ["LEAST_STEPS", "MOST_STEPS", "Fineness", "fine_runs", "fineness"]

LEAST_STEPS = 4
"""In a sampling interval, where the search for enough of them begins."""
MOST_STEPS = 64
MOVED = 0.2
"""Standard errors by which a value may move when the steps are halved."""
GAP = 0.05
"""Root mean square that halved steps may change, in parts of that of the errors."""
OF_REACH = 1e-3
"""The same in parts of how far runs reach, where nothing is fitted."""
SMALLEST = 1e-4
"""Of the gap, in spreads of the measured variable: below it nothing is asked of it."""
NO_NOISE = 1e-6
"""Error of runs, in spreads, below which no record is measured: there is nothing to be sure of."""
EXACT = 1e-5
"""In parts of a value, or of its nominal: nobody asks for more, however free of noise a record."""


@dataclass(frozen=True, eq=False)
class Fineness:
    """What halved steps change.

    gap : root mean square of each variable, in its unit. moved : of each unknown that is the same
    for all records, in standard errors. fine : whether all of it is small.
    """

    gap: Array
    moved: Array
    fine: bool


def fineness(
    rollout: Rollout,
    z: Array,
    finer: Array,
    free: NDArray[np.bool_],
    stderr: Array,
) -> Fineness:
    """finer : prediction with half the steps' length at z. free : unknowns that no bound holds.
    stderr : of the unknowns that all records share, in units of z.
    """
    predicted, measured = rollout.predicted(z), rollout.runs.measured
    with np.errstate(over="ignore", invalid="ignore"):
        gap, error = (
            np.sqrt(np.nanmean((finer - b) ** 2, axis=(0, 1))) for b in (predicted, measured)
        )
    small = bool(np.all(gap <= np.maximum(GAP * error, SMALLEST * rollout.spread)))
    change = rollout.errors(finer) - rollout.errors(predicted)
    square, right = np.zeros((len(z), len(z))), np.zeros(len(z))
    for rows, _, slopes, _ in rollout.blocks(z):
        k = slopes.shape[1] // change.shape[2]
        flat = slopes.reshape(-1, len(z))
        square += flat.T @ flat
        right += flat.T @ change[rows, :k].ravel()
    found = np.zeros(len(z))
    found[free] = shift(square[np.ix_(free, free)], right[free])
    shared = np.abs(found[: len(stderr)])
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = shared / stderr
    moved = np.where(np.isfinite(moved), moved, 0.0)
    still = bool(np.all(error <= NO_NOISE * rollout.spread)) or unmoved(shared, stderr, z)
    return Fineness(np.asarray(gap), moved, small and still)


def shift(square: Array, right: Array) -> Array:
    """What a change of the residuals does to least squares: square = J^T J, right = J^T change."""
    size = np.sqrt(np.maximum(np.diag(square), 1e-300))
    inverse = np.linalg.pinv(square / np.outer(size, size), rcond=1e-13, hermitian=True)
    return np.asarray(-(inverse @ (right / size)) / size)


def unmoved(shifts: Array, stderr: Array, z: Array) -> bool:
    """Whether shifts of the first unknowns are small beside their standard errors, or themselves;
    unknowns that no record sees have none.
    """
    allowed = np.maximum(MOVED * stderr, EXACT * np.maximum(np.abs(z[: len(stderr)]), 1.0))
    return bool(np.all((shifts <= allowed) | ~np.isfinite(stderr)))


def fine_runs(predicted: Array, finer: Array) -> bool:
    """Whether halved steps change runs little, in parts of how far the runs reach themselves: what
    was measured behind a start has no say in a prediction.
    """
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # runs that diverge have no number at all
        gap = np.sqrt(np.nanmean((finer - predicted) ** 2, axis=(0, 1)))
        reach, size = np.nanstd(finer, axis=(0, 1)), np.nanmax(np.abs(finer))
    return bool(np.all(gap <= np.maximum(OF_REACH * reach, 1e-12 * size)))
