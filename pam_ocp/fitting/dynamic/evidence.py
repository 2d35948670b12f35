"""What the residuals of a fit are made of: one motion through each record, its start free, with the
slopes of the residuals in the fitted values, in the start and in what the plant may lack. No value
leaves its bounds and no start the range of its state: a transient from beyond it would take up what
the model lacks.

A record too long for one motion (an unstable plant) is cut into as many as it needs. Starts are
nuisance: they are projected out of each motion by itself, so there may be many of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import FitError, PamError
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array, spanned
from .experiment import with_inputs
from .gauss_newton import descend
from .rig import Rig, RunUnknowns, Unknown
from .rollout import Rollout, gaps
from .runs import LEAST_STEPS, MOST_STEPS, Runs, runs_of, settled_starts
from .suspects import Suspect, Suspected, sensor_suspects, suspected

STEEP = 1e3
"""What a start may change, in spreads per nominal, for a motion to be followed."""
SHORTEST = 24
"""Samples of a motion, at least."""
LOST = 1e6
"""As STEEP, but of the shortest motions and of finer steps: beyond it nothing is followed. So it is
where a memory has kinks, which no step meets.
"""
EVALUATIONS = 30
"""Of the slopes on the way to the least squares of these motions, for one set of weights."""
WEIGHINGS = 5
"""Of the measured variables by their residuals, at most."""
GAINED = 1e-4
"""Relative change of the sum of squares below which this ends: only at its least do the tests hold.
"""
COMPARED = 3e-3
"""The same where only causes are compared: what they take up differs by more."""
UNSEEN = 1e-10
"""Length of a column, in that of the longest, below which it is rounding."""
EDGE = 1e-9
"""Distance of a start [nominals] from the end of its range at which it is there."""
ACCURATE = 0.02
"""Error of the integration, in parts of the residuals."""
NEGLIGIBLE = 1e-7
"""Of a column, that is left when those before are projected out: nothing new."""


@dataclass(frozen=True, eq=False)
class Motion:
    """error (K, ny): modelled less measured; start, values, suspects (K, ny, .): slopes of it."""

    error: Array
    start: Array
    values: Array
    suspects: Array


@dataclass(frozen=True, eq=False)
class Evidence:
    """Motions with their slopes in ``names`` (scaled values) and in ``suspects``. shifts : of the
    values at the least squares of these motions. integration : RMS of what halved steps change, of
    each measured variable.
    """

    outputs: tuple[str, ...]
    units: tuple[str, ...]
    names: tuple[str, ...]
    scale: Array
    motions: tuple[Motion, ...]
    suspects: tuple[Suspect, ...]
    shifts: Array
    integration: Array
    measured: tuple[Array, ...]
    squares_with: Callable[[str], Array]
    """(ny,) mean squares of the residuals with the suspects of a cause at their least squares."""

    @property
    def rms(self) -> Array:
        """Of the residuals of each measured variable."""
        every = np.concatenate([m.error for m in self.motions])
        return np.asarray(np.sqrt(np.mean(every**2, axis=0)))


@dataclass(frozen=True, eq=False)
class _Case:
    """What is run: see :func:`evidence_of`."""

    plant: Plant
    records: Sequence[Trajectory]
    outputs: Sequence[str]
    unknowns: RunUnknowns
    rig: Rig
    z: Array
    steps: int

    def runs(self, length: float | None) -> Runs:
        """Whole records, or pieces [s] of them, each with a number and a start of its own."""
        found = runs_of(
            self.plant, self.records, length, length, list(self.outputs), 2, self.steps, 0.0
        )
        return replace(
            found,
            record=np.arange(len(found.record)),
            inputs=[found.inputs[r] for r in found.record],
        )

    def rollout(self, runs: Runs) -> Rollout:
        """With as many starts as there are motions."""
        unknowns = self.unknowns.of_motions(self.plant, len(runs.record))
        return Rollout(self.plant, runs, unknowns, self.rig, wild=LOST)


def evidence_of(
    plant: Plant,
    records: Sequence[Trajectory],
    outputs: Sequence[str],
    unknowns: RunUnknowns,
    rig: Rig,
    z: Array,
) -> Evidence | None:
    """plant : fitted. unknowns : of the fit; only those that all records share count. z : their
    values. None where the plant cannot be followed through the records.
    """
    try:
        still = {v.name: float(v.start or 0.0) for v in plant.inputs}
        # only what belongs to the model: no observer, and every motion with a start of its own
        case = _Case(
            plant,
            [with_inputs(plant, r, still) for r in records],
            outputs,
            unknowns.of_motions(plant, 0),
            replace(rig, corrections={}, starts={}),
            np.asarray(z)[unknowns.of_model],
            LEAST_STEPS,
        )
        runs, every = _followed(case)
        every, _ = _least_squares(case, runs, every)
        fine = case.rollout(runs)
        modelled = fine.predicted(every)
        while True:
            finer = fine.finer()
            better = finer.predicted(every)
            gap, rms = gaps(better, modelled), gaps(better, runs.measured)
            if np.all(gap <= ACCURATE * rms) or finer.runs.steps > MOST_STEPS:
                break
            # values that were found with long steps leave more than they should
            every, _ = _least_squares(case, finer.runs, every)
            fine, modelled = finer, finer.predicted(every)
        if not np.all(np.isfinite(gap)):
            return None  # shorter steps diverge, and shall say what longer ones cannot
        return _evidence(replace(case, steps=fine.runs.steps), fine.runs, every, better, gap)
    except (PamError, np.linalg.LinAlgError):
        return None


def _followed(case: _Case) -> tuple[Runs, Array]:
    """Motions as long as their starts stay in sight; the values, and guesses of all starts."""
    sampling = case.records[0].duration / (len(case.records[0]) - 1)
    length: float | None = None
    samples = max(len(r) for r in case.records) - 2
    while True:
        runs = case.runs(length)
        nx = len(case.plant.states)
        nominal = case.plant.vector("state", attribute="nominal")
        x0 = settled_starts(case.plant, runs, len(runs.record), range(nx)) / nominal
        rollout = case.rollout(runs)
        z = np.concatenate([case.z, x0.ravel()])
        steep = 0.0
        for part, y, slopes in rollout.computed(z, True):
            own = np.abs(slopes[..., len(case.z) :]) / rollout.spread[:, None]
            inside = np.arange(part.samples) < runs.length[part.rows][:, None]
            size = np.where(np.isfinite(own), own, np.inf).max(axis=(2, 3), initial=0.0)
            steep = max(steep, float(np.where(inside, size, 0.0).max(initial=0.0)))
            if not np.all(np.isfinite(y[inside])):
                steep = np.inf
        if steep <= STEEP or samples < 2 * SHORTEST:
            return runs, z
        samples //= 2
        length = samples * sampling


def projected(motions: Sequence[Motion], weights: Array) -> tuple[Array, Array]:
    """(error (n,), columns (n, .) of the values) of all motions times ``weights``, their starts
    projected out.
    """
    errors, columns = [], []
    for m in motions:
        start = (m.start * weights[:, None]).reshape(-1, m.start.shape[2])
        size = np.linalg.norm(start, axis=0)
        basis = spanned(start[:, size > UNSEEN * size.max(initial=0.0)], NEGLIGIBLE)
        e = (m.error * weights).ravel()
        c = (m.values * weights[:, None]).reshape(len(e), -1)
        errors.append(e - basis @ (basis.T @ e))
        columns.append(c - basis @ (basis.T @ c))
    return np.concatenate(errors), np.concatenate(columns)


def solved(matrix: Array, right: Array) -> Array:
    """Least squares with columns of unit length; the shortest, and nothing of what is not seen."""
    size = np.linalg.norm(matrix, axis=0)
    size = np.where(size > UNSEEN * size.max(initial=0.0), size, np.inf)
    return np.asarray(np.linalg.lstsq(matrix / size, right, rcond=NEGLIGIBLE)[0] / size)


Sensors = Callable[[Sequence[Array]], Sequence[Array]]
"""(K, ny, p) of each motion from what is modelled (K, ny): what p errors of sensors add to it."""


@dataclass(frozen=True, eq=False)
class _Projected:
    """The squares of motions whose sensors have such errors as fit best: these are linear, and
    projected out (variable projection; L. Kaufman, BIT 15 (1975) 49-57).
    """

    rollout: Rollout
    sensors: Sensors

    def errors(self, predicted: Array) -> tuple[Array, Array]:
        """(n, K, ny) weighted, and a basis (n, K, ny, p) of what sensors may add to them."""
        runs, errors = self.rollout.runs, self.rollout.errors(predicted)
        shown = [y[:k] for y, k in zip(predicted, runs.length, strict=True)]
        if not all(np.all(np.isfinite(y)) for y in shown):
            return errors, np.empty((*errors.shape, 0))
        columns = self.sensors(shown)
        weights = self.rollout.weights / self.rollout.spread
        every = np.zeros((*errors.shape, columns[0].shape[2]))
        for row, w, own in zip(every, weights, columns, strict=True):
            row[: len(own)] = own * w[: len(own), :, None]
        basis = spanned(every.reshape(errors.size, -1), NEGLIGIBLE)
        left = errors.ravel() - basis @ (basis.T @ errors.ravel())
        return left.reshape(errors.shape), basis.reshape(*errors.shape, -1)

    def cost(self, z: Array, /) -> float:
        return float(np.sum(self.errors(self.rollout.predicted(z))[0] ** 2))

    def normal(self, z: Array, /) -> tuple[float, Array, Array, int]:
        left, basis = self.errors(self.rollout.predicted(z))
        both = np.concatenate([left[..., None], basis], axis=3)
        _, right, square, damped = self.rollout.normal(z, both)
        return float(np.sum(left**2)), right[:, 0], square - right[:, 1:] @ right[:, 1:].T, damped


def _least_squares(
    case: _Case,
    runs: Runs,
    best: Array,
    sensors: Sensors | None = None,
    least: float = GAINED,
) -> tuple[Array, Array]:
    """Values and starts of the least squares of these motions, from those given; mean squares (ny,)
    of the residuals, by which the variables are weighed. sensors : whose errors are sought, too.
    least : relative change below which the search ends.
    """
    k, plain = len(case.unknowns.rows), case.rollout(runs)
    low, high = plain.unknowns.low, plain.unknowns.high
    inside = ~np.isnan(runs.measured)

    def squares(at: Array) -> Array:
        errors = plain.errors(plain.predicted(at))
        if sensors:
            errors, _ = _Projected(plain, sensors).errors(plain.predicted(at))
        errors = np.divide(errors, plain.weights, out=np.zeros_like(errors), where=inside)
        return np.asarray(np.sum(errors**2, axis=(0, 1)) / runs.length.sum())

    found = squares(best)
    for number in range(WEIGHINGS):
        weighed = plain.weighed(1 / np.maximum(np.sqrt(found), 1e-12))
        problem = _Projected(weighed, sensors) if sensors else weighed
        # values that are moved by wrong starts go astray
        first, last = (a if number else np.concatenate([best[:k], a[k:]]) for a in (low, high))
        best = descend(problem, best, first, last, EVALUATIONS, enough=least).z
        before, found = found, squares(best)
        if number and np.sum(np.abs(np.log(found / before))) < least:
            break
    return best, found * plain.spread**2


def _rows(runs: Runs) -> list[Array]:
    return [r[:n] for r, n in zip(runs.measured, runs.length, strict=True)]


def _evidence(case: _Case, runs: Runs, every: Array, modelled: Array, gap: Array) -> Evidence:
    groups, k = case.unknowns.groups, len(case.z)
    z, x0 = every[:k], every[k:].reshape(len(runs.record), -1)
    delays = case.unknowns.rig(case.plant, runs.names, case.rig, z).delays
    found = suspected(case.plant, case.records, groups, delays, runs.names)
    u = case.unknowns.of_motions(case.plant, len(runs.record))
    m, count = len(found.suspects), len(groups)
    rig = replace(case.rig, delays={**case.rig.delays, **found.delays})
    wider = replace(case, plant=found.plant, records=found.records, rig=rig)
    later = wider.runs(runs.horizons[0] if runs.horizons else None)
    unknowns = u.with_more(*map(Unknown.of_group, found.groups[count:]))
    rollout = Rollout(found.plant, later, unknowns, rig)
    at = np.insert(every, [count] * m, 0.0)
    order = [*range(count), *range(count + m, k + m)]
    edge = (np.minimum(every - u.low, u.high - every)[k:] < EDGE).reshape(x0.shape)
    motions = {}
    for part, _, slopes in rollout.computed(at, True):
        for row, own in zip(part.rows.tolist(), slopes, strict=True):
            n = int(runs.length[row])
            s = np.nan_to_num(own[:n])
            start = s[..., k + m :]
            if np.any(np.abs(start) > LOST * rollout.spread[:, None]):
                raise FitError("motions that depend on their starts without bound tell nothing")
            start = np.where(edge[row], 0.0, start)  # at the edge of its range it is not free
            error = modelled[row, :n] - runs.measured[row, :n]
            suspects = s[..., count : count + m]
            motions[row] = Motion(error, start, s[..., order], suspects)
    return Evidence(
        tuple(runs.names),
        tuple(case.plant.variable(n).unit for n in runs.names),
        u.names[:k],
        u.scale[:k],
        tuple(motions[i] for i in range(len(runs.record))),
        found.suspects,
        z - case.z,
        gap,
        tuple(_rows(runs)),
        lambda cause: _squares_with(wider, later, found, cause, z, x0, modelled),
    )


def _squares_with(
    case: _Case, runs: Runs, found: Suspected, cause: str, z: Array, x0: Array, modelled: Array
) -> Array:
    """See :class:`Evidence`; as ``modelled`` where motions with it cannot be followed."""
    count = len(case.unknowns.groups)
    chosen = [
        g for g, s in zip(found.groups[count:], found.suspects, strict=True) if s.cause == cause
    ]
    wide = replace(case, unknowns=case.unknowns.with_more(*map(Unknown.of_group, chosen)))
    named = [(n, case.plant.variable(n).unit) for n in runs.names]

    def sensors(modelled: Sequence[Array]) -> list[Array]:
        own = [c for s, c in sensor_suspects(named, modelled, _rows(runs)) if s.cause == cause]
        return [np.stack(c, axis=2) for c in zip(*own, strict=True)]

    has = any(s.cause == cause for s, _ in sensor_suspects(named, _rows(runs), _rows(runs)))
    z = np.insert(z, [count] * len(chosen), 0.0)
    begun = np.hstack([x0, np.zeros((len(x0), len(case.plant.states) - x0.shape[1]))])
    with suppress(FitError):
        begin = np.concatenate([z, begun.ravel()])
        return _least_squares(wide, runs, begin, sensors if has else None, COMPARED)[1]
    return np.asarray(np.nanmean((modelled - runs.measured) ** 2, axis=(0, 1)))
