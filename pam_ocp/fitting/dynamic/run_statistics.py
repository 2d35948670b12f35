"""How far the values of a free-run fit may be off: errors follow each other along a run, and runs
overlap, so a sample tells less than an independent one.

Blocks of the records (at least BLOCKS, each in one record) count as independent of each other; the
covariance is H^-1 (sum of the blocks' squared gradients) H^-1 with H the normal matrix (K.-Y.
Liang, S. Zeger, Biometrika 73 (1986) 13-22). With few blocks to an unknown only the mean widening
over all directions is taken from them, on top of the usual covariance.

Whether their steps are short enough for what is said of them: halving the steps changes the runs
by a gap. What values it would move is told by the normal equations: least squares shift by
-(J^T J)^-1 J^T gap. Beside that stands what the gap is to the errors of the runs themselves.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..statistics import Array, Coefficient
from .rig import RunUnknowns
from .rollout import Rollout
from .runs import Runs

__all__ = [
    "BLOCKS",
    "LEAST_STEPS",
    "MOST_STEPS",
    "Fineness",
    "Spread",
    "fine_runs",
    "fineness",
    "spread_of",
    "widened",
]

BLOCKS = 24
ENOUGH = 3
"""Blocks to an unknown from which each direction has a width of its own."""
UNSEEN = 1e-12


@dataclass(frozen=True, eq=False)
class Spread:
    """Standard errors of a free-run fit. dof : blocks of the records less one. widening : how much
    wider the intervals are than those of independent errors, on average.
    """

    coefficients: dict[str, Coefficient]
    covariance: Array
    dof: int
    widening: float


def spread_of(
    rollout: Rollout, runs: Runs, u: RunUnknowns, z: Array, edge: NDArray[np.bool_]
) -> Spread:
    """The covariance at z; unknowns at an ``edge`` count as known."""
    label = _blocks(runs)
    scores = np.zeros((int(label.max()) + 1, len(z)))
    square, cost, samples = np.zeros((len(z), len(z))), 0.0, 0.0
    for rows, errors, slopes, _ in rollout.blocks(z):
        m, k = label[rows].shape[0], slopes.shape[1] // len(runs.names)
        own = np.repeat(label[rows, :k], len(runs.names), axis=1)
        for i in range(m):
            np.add.at(scores, own[i], slopes[i] * errors[i][:, None])
        flat = slopes.reshape(-1, len(z))
        square += flat.T @ flat
        cost += float(np.sum(errors**2))
    samples = 1.0 / float(np.sum((runs.weights / max(runs.weights.sum(), 1e-300)) ** 2))
    samples *= len(runs.names)
    free = ~edge & (np.diag(square) > UNSEEN * np.diag(square).max(initial=0.0))
    covariance = np.full((len(z), len(z)), np.nan)
    inverse, lost = _inverse(square[np.ix_(free, free)])
    noise = cost / max(samples - free.sum(), 1.0)
    inner, ratio = widened(inverse, scores[:, free], noise)
    covariance[np.ix_(free, free)] = inner * np.outer(u.scale[free], u.scale[free])
    errors_ = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors_[np.nonzero(free)[0][lost]] = np.inf
    values = z * u.scale
    values[u.places("gains")] += 1.0
    descriptions = {g.name: g.description for g in u.groups}
    coefficients = {
        n: Coefficient(
            n,
            float(v),
            float(e) if np.isfinite(e) else float("inf"),
            unit,
            bool(at),
            descriptions.get(n, ""),
        )
        for n, v, e, unit, at in list(zip(u.names, values, errors_, u.units, edge, strict=True))[
            : u.shared
        ]
    }
    return Spread(
        coefficients, covariance, max(len(scores) - 1, 1), float(np.sqrt(max(ratio, 0.0)))
    )


def _inverse(square: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Of a normal matrix, in the directions that the runs see; which unknowns have a part in one
    that they do not see.
    """
    size = np.sqrt(np.diag(square))
    values, vectors = np.linalg.eigh(square / np.outer(size, size))
    seen = values > UNSEEN * values.max(initial=0.0)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(size, size)
    return np.asarray(inverse), (np.abs(vectors[:, ~seen]) > 1e-3).any(axis=1)


def widened(inverse: Array, scores: Array, noise: float) -> tuple[Array, float]:
    """(covariance (k, k) of least squares whose errors follow each other, its mean widening, a
    variance ratio).

    inverse : of the normal matrix J^T J. scores : J^T r of each block (blocks, k). noise : mean
    square of the errors r. Where there are few
    blocks to an unknown, only their mean widening counts, and no narrowing.
    """
    blocks, k = len(scores), max(len(inverse), 1)
    meat = scores.T @ scores * blocks / max(blocks - 1, 1)
    ratio = float(np.trace(meat @ inverse)) / k / max(noise, 1e-300)
    if blocks >= ENOUGH * k:
        return np.asarray(inverse @ meat @ inverse), ratio
    return np.asarray(inverse * noise * max(ratio, 1.0)), ratio


def _blocks(runs: Runs) -> NDArray[np.intp]:
    """The block (n, K) of each sample: equal parts of each record's time, by when it was taken."""
    records = np.unique(runs.record)
    parts = max(1, -(-BLOCKS // len(records)))
    time = runs.start[:, None] + runs.t
    label = np.zeros(time.shape, dtype=np.intp)
    for number, r in enumerate(records):
        own = runs.record == r
        last = float((runs.start[own] + runs.t[runs.length[own] - 1]).max())
        first = float(runs.start[own].min())
        share = (time[own] - first) / max(last - first, 1e-300)
        label[own] = number * parts + np.clip((share * parts).astype(int), 0, parts - 1)
    return label


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
