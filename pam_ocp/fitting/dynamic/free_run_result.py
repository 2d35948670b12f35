"""What a fit of free runs tells: values with intervals, its runs, its doubts.

Errors along a run are serially correlated, and runs overlap, so a sample tells less than an
independent one. Blocks of the records (at least BLOCKS, each in one record) count as independent
of each other; the covariance is H^-1 (sum of the blocks' squared gradients) H^-1 with H the normal
matrix (K.-Y. Liang, S. Zeger, Biometrika 73 (1986) 13-22). With few blocks to an unknown
only the mean widening over all directions is taken from them, on top of the usual covariance.

Whether their steps are short enough for what is said of them: halving the steps changes the runs
by a gap. What values it would move is told by the normal equations: least squares shift by
-(J^T J)^-1 J^T gap. Beside that stands what the gap is to the errors of the runs themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.quantities import outside
from ...core.shown import shown
from ...core.signals import Interpolation
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..estimates import coefficient_line
from ..statistics import Array, Coefficient, inverse
from .adequacy import Adequacy, adequacy_of, residual_adequacy
from .coverage import FittedPlant
from .evidence import evidence_of
from .experiment import groups, recorded, running
from .gauss_newton import descend
from .rig import Rig, RunUnknowns, unknowns_of
from .rollout import Rollout, gaps, spreads
from .runs import FreeRun, Runs, runs_of, settled_starts

BLOCKS = 24
ENOUGH = 3
"""Blocks to an unknown from which each direction has a width of its own."""
UNSEEN = 1e-12


@dataclass(frozen=True, eq=False)
class Spread:
    """Standard errors of a free-run fit. dof : blocks of the records less one. edge : which
    unknowns ended at the edge of their range.
    """

    coefficients: dict[str, Coefficient]
    covariance: Array
    dof: int
    edge: NDArray[np.bool_]


def spread_of(rollout: Rollout, z: Array) -> Spread:
    """The covariance at z; unknowns at the edge of their range count as known."""
    runs, u = rollout.runs, rollout.unknowns
    edge = (z - u.low < 1e-9) | (u.high - z < 1e-9)
    label = _blocks(runs)
    scores = np.zeros((int(label.max()) + 1, len(z)))
    cost, _, square, _ = rollout.normal(z)
    for rows, errors, slopes, _ in rollout.blocks(z):
        k = slopes.shape[1] // len(runs.names)
        of_errors = np.repeat(label[rows, :k], len(runs.names), axis=1)
        for own, columns in rollout.by_record(rows):
            places = np.ix_(of_errors[own].ravel(), columns)
            np.add.at(
                scores, places, (slopes[own] * errors[own, :, None]).reshape(-1, len(columns))
            )
    samples = 1.0 / float(np.sum((runs.weights / max(runs.weights.sum(), 1e-300)) ** 2))
    samples *= len(runs.names)
    free = ~edge & (np.diag(square) > UNSEEN * np.diag(square).max(initial=0.0))
    covariance = np.full((len(z), len(z)), np.nan)
    usual, lost = _inverse(square[np.ix_(free, free)])
    noise = cost / max(samples - free.sum(), 1.0)
    inner = widened(usual, scores[:, free], noise)
    covariance[np.ix_(free, free)] = inner * np.outer(u.scale[free], u.scale[free])
    errors_ = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    errors_[np.nonzero(free)[0][lost]] = np.inf
    descriptions = {g.name: g.description for g in u.groups}
    units = [r.unit for r in u.rows[: u.shared]]
    shared = zip(u.names, u.values(z), errors_, units, edge, strict=False)
    coefficients = {
        n: Coefficient(
            n,
            float(v),
            float(e) if np.isfinite(e) else float("inf"),
            unit,
            bool(at),
            descriptions.get(n, ""),
        )
        for n, v, e, unit, at in shared
    }
    return Spread(coefficients, covariance, max(len(scores) - 1, 1), edge)


def _inverse(square: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Of a normal matrix, in the directions that the runs see; which unknowns they do not."""
    size = np.sqrt(np.diag(square))
    values, vectors = np.linalg.eigh(square / np.outer(size, size))
    seen = values > UNSEEN * values.max(initial=0.0)
    found = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(size, size)
    return np.asarray(found), (np.abs(vectors[:, ~seen]) > 1e-3).any(axis=1)


def widened(usual: Array, scores: Array, noise: float) -> Array:
    """Covariance (k, k) of least squares with serially correlated errors. usual : (J^T J)^-1.
    scores : J^T r of each block (blocks, k). noise : mean square of the errors r. Where blocks are
    few to an unknown, only their mean widening counts, and no narrowing.
    """
    blocks, k = len(scores), max(len(usual), 1)
    meat = scores.T @ scores * blocks / max(blocks - 1, 1)
    ratio = float(np.trace(meat @ usual)) / k / max(noise, 1e-300)
    if blocks >= ENOUGH * k:
        return np.asarray(usual @ meat @ usual)
    return np.asarray(usual * noise * max(ratio, 1.0))


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
    """What halved steps change: RMS of each variable, and each unknown in standard errors."""

    gap: Array
    moved: Array
    fine: bool


def fineness(rollout: Rollout, z: Array, spread: Spread) -> Fineness:
    """Of steps with which these values were found."""
    predicted, finer = rollout.predicted(z), rollout.finer().predicted(z)
    gap, error = gaps(finer, predicted), gaps(finer, rollout.runs.measured)
    u, free = rollout.unknowns, ~spread.edge
    stderr = np.array([c.stderr for c in spread.coefficients.values()]) / u.scale[: u.shared]
    small = bool(np.all(gap <= np.maximum(GAP * error, SMALLEST * rollout.spread)))
    _, right, square, _ = rollout.normal(z, rollout.errors(finer) - rollout.errors(predicted))
    found = np.zeros(len(z))
    found[free] = shift(square[np.ix_(free, free)], right[free])
    shared = np.abs(found[: len(stderr)])
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = shared / stderr
    moved = np.where(np.isfinite(moved), moved, 0.0)
    # small beside standard errors, or themselves; unknowns that no record sees have none
    allowed = np.maximum(MOVED * stderr, EXACT * np.maximum(np.abs(z[: len(stderr)]), 1.0))
    still = bool(np.all((shared <= allowed) | ~np.isfinite(stderr)))
    still |= bool(np.all(error <= NO_NOISE * rollout.spread))
    return Fineness(gap, moved, small and still)


def shift(square: Array, right: Array) -> Array:
    """What a change of the residuals does to least squares: square = J^T J, right = J^T change."""
    return np.asarray(-inverse(square) @ right)


def fine_runs(predicted: Array, finer: Array) -> bool:
    """Whether halved steps change runs little, in parts of how far the runs reach themselves."""
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # runs that diverge have no number at all
        gap = gaps(finer, predicted)
        reach, size = np.nanstd(finer, axis=(0, 1)), np.nanmax(np.abs(finer))
    return bool(np.all(gap <= np.maximum(OF_REACH * reach, 1e-12 * size)))


# ---- how far the values may be off ---------------------------------------------------------------
@shown
@dataclass(frozen=True, eq=False)
class FreeRunFit(FittedPlant):
    """A plant fitted to free runs.

    plant : with the fitted values. rig : dead times, sensors, starts and corrections, known and
    found. training : its runs along the records of the fit. integration_error : how much halving
    the step changes the runs (RMS, unit of each variable); moved : by how many standard errors it
    would move each value; fine : whether all of that is small. at_bound : unknowns that ended
    at the edge of their range. cost : mean squared error before and after, in parts of the measured
    variables' variance. converged : whether the search came to its end.

    Examples
    --------
    >>> abs(free_fit.values["mass"] - 10.0) < 0.1
    True
    """

    plant: Plant
    training: FreeRun
    values: Mapping[str, float]
    at_bound: tuple[str, ...]
    integration_error: Mapping[str, float]
    cost: tuple[float, float]
    status: str
    evaluations: int
    seconds: float
    options: Mapping[str, Any] = field(repr=False)
    """horizon, every, outputs, history, steps and warm_up of the runs."""
    rig: Rig
    own_starts: Mapping[str, Array] = field(repr=False)
    """{state: where it began in each record}, of states with starts of their own."""
    spread: Spread = field(repr=False)
    moved: Mapping[str, float] = field(repr=False)
    fine: bool
    converged: bool
    records: tuple[Trajectory, ...] = field(repr=False)
    unknowns: RunUnknowns = field(repr=False)
    z: Array = field(repr=False)
    """Of the unknowns, scaled."""
    interpolation: Interpolation = "linear"
    """How inputs count as having run between the samples of records that do not say it."""
    inputs_ran: str = ""
    """How that was decided, in words; empty where the records say it."""

    @cached_property
    def adequacy(self) -> Adequacy:
        """What the residuals of one motion through each record tell about the model; see
        :class:`Adequacy`.
        """
        pushed = any(n.endswith(".disturbance") for n, _ in self.rig.corrections)
        if pushed or np.any(self.training.diverged):
            return Adequacy()  # a model with a disturbance says itself that it lacks something
        u, names = self.unknowns, list(self.training.names)
        known = running(self.records, self.interpolation)
        # beside its edge, if a value is there: a mass of nothing, whose motion cannot be followed
        edge = [n in self.at_bound for n in u.names]
        starts = [np.where(edge, u.guess, self.z), self.z][not any(edge) :]
        tried = (evidence_of(self.plant, known, names, u, self.rig, z) for z in starts)
        evidence = next((e for e in tried if e is not None), None)
        own = {n: c.stderr for n, c in self.spread.coefficients.items()}
        if evidence is None and self._whole:
            runs = self.training
            seen = [~np.isnan(m).any(axis=1) for m in runs.measured]
            errors, measured = (
                [a[s] for a, s in zip(part, seen, strict=True)]
                for part in (runs.measured - runs.predicted, runs.measured)
            )
            return residual_adequacy(names, errors, measured, len(self.z), own)
        given = None if self._whole else own
        return adequacy_of(evidence, 1 / spreads(self.plant, names, self.training.measured), given)

    @property
    def _whole(self) -> bool:
        """Whether the runs are one motion through each record, its start free."""
        whole = self.options.get("horizon") is None and not self.options.get("warm_up")
        return whole and len(self.unknowns.own_starts) == len(self.plant.states)

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every unknown but the starts of single records, with its standard error: that of
        autocorrelated residuals, and where the model is inadequate, of what that may shift.
        """
        a = self.adequacy
        told = {} if self.at_bound and a.adequate else a.stderr
        return {
            n: c
            if n in self.at_bound or c.stderr == np.inf
            else replace(c, stderr=told.get(n, c.stderr))
            for n, c in self.spread.coefficients.items()
        }

    def _freedom(self, name: str) -> int:
        a = self.adequacy
        own = self._whole and name in a.stderr and not self.at_bound
        return a.dof if own else self.spread.dof

    def _plain(self) -> Array:
        k = len(self.coefficients)
        return self.spread.covariance[:k, :k]

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the fit is used; empty when there is nothing."""
        found = list(self.training.warnings)
        if not self.converged:
            found.append(f"the search did not come to its end: {self.status}")
        found += self.coarse
        found += [text for text in (self.adequacy.sentence,) if text]
        return tuple(found)

    @cached_property
    def coarse(self) -> tuple[str, ...]:
        """What the length of the steps costs, in words; empty where that does not count."""
        if self.fine:
            return ()
        steps, error = self.options["steps"], self.training.rmse
        name = max(self.integration_error, key=lambda n: self.integration_error[n] / error[n])
        said = (
            f"the integration is coarse for these records: with {2 * steps} steps to a sample "
            f"instead of {steps}, {name} changes by {self.integration_error[name]:.2g} where its "
            f"error is {error[name]:.2g}"
        )
        most = max(self.moved, key=lambda n: self.moved[n], default=None)
        if most is not None and self.moved[most] >= 0.05:
            said += f", and {most} by some {self.moved[most]:.1f} standard errors"
        return (said + f"; give steps={4 * steps}",)

    def validate(self, records: Trajectory | Sequence[Trajectory], **options: Any) -> FreeRun:
        """Runs of the same kind along other records; a warning says so where some diverge.

        Starts that each record has for itself are estimated from it; nothing else is. ``options``
        of the runs that differ, such as ``every``.
        """
        return told(runs_like(self, self.plant, records, options))

    def __str__(self) -> str:
        shown = self.plant.variable
        lines = [
            f"{self.plant.name}: {len(self.training.start)} free runs of {self.training.t[-1]:g} "
            f"s, {self.evaluations} evaluations, {self.seconds:.1f} s: {self.status}",
        ]
        for h in self.training.horizons or (self.training.t[-1],):
            over = f" over {h:g} s" if len(self.training.horizons) > 1 else ""
            lines += [
                f"    {n}: RMSE{over} {shown(n).shown(e)}"
                for n, e in self.training.rmse_over(h).items()
            ]
        lines += [coefficient_line(c, self.interval(n)) for n, c in self.coefficients.items()]
        if self.at_bound:
            lines.append(f"    at the edge of their range: {', '.join(self.at_bound)}")
        lines += [f"    {text}" for text in (self.inputs_ran,) if text]
        lines += [f"    warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def told(run: FreeRun) -> FreeRun:
    """The runs, with a warning where some diverge."""
    for text in run.warnings:
        warnings.warn(text, RuntimeWarning, stacklevel=outside())
    return run


# ---- runs of the same kind along other records ---------------------------------------------------
def rollout_like(
    fit: FreeRunFit,
    plant: Plant,
    records: Sequence[Trajectory],
    options: Mapping[str, Any],
    weights: Sequence[str] = (),
) -> Rollout:
    """Runs of a plant as those of the fit; ``options`` that differ. Sought are the starts that each
    record has for itself, as in the fit, and what was learned: weights, and memories' starts.
    """
    every = {**fit.options, "outputs": list(fit.training.names), **options}
    runs = runs_of(plant, records, **every)
    states = [v.name for v in plant.states]
    along = {fit.plant.states[i].name for i in fit.unknowns.along}
    hidden = [i for i, n in enumerate(states) if n in along or ".learned.memory" in n]
    guesses = settled_starts(plant, runs, len(records), hidden).T
    unknowns, _ = unknowns_of(
        plant,
        [replace(g, scale=1.0) for g in groups(plant, list(weights))] if weights else (),
        runs.names,
        len(records),
        float(runs.t[0]),
        starts={n: "record" for n in fit.own_starts if n not in along},
        hidden=dict(zip(hidden, guesses, strict=True)),
    )
    return Rollout(plant, runs, unknowns, fit.rig)


def begun(rollout: Rollout) -> Array:
    """Starts that each record has for itself, from it, all else known."""
    u = rollout.unknowns
    return descend(rollout, u.guess, u.low, u.high, 30).z if len(u.guess) else np.empty(0)


def runs_like(
    fit: FreeRunFit,
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    options: Mapping[str, Any],
) -> FreeRun:
    """Runs of a plant as those of the fit, along other records."""
    known = running(recorded(records), fit.interpolation)
    rollout = rollout_like(fit, plant, known, options)
    return rollout.runs.result(rollout.predicted(begun(rollout)))
