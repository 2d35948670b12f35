"""Learning a residual on the physics, along whole free runs; how much it helps, and how far to
trust it.

The physics stays as it was fitted. Weights are found by damped Gauss-Newton steps through the
simulated runs, with a penalty that shrinks them to where the residual is zero.
How strong it is is chosen by cross-validation over records (or parts of them) against no residual,
which stays unless another is significantly better. The models of the folds are the ensemble; errors
on what a fold left out make the bands (the cross-conformal way of R. Barber et al., Annals of
Statistics 49 (2021) 486), wider where the ensemble disagrees.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_count, require_instance, require_positive
from ...core.shown import shown
from ...core.stop import check, verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant, require_plant
from ..dynamic.choice import paired
from ..dynamic.experiment import groups, recorded, running
from ..dynamic.free_run_fit import fit_free_run
from ..dynamic.free_run_result import FreeRunFit, begun, rollout_like, runs_like
from ..dynamic.gauss_newton import descend
from ..dynamic.rollout import Rollout
from ..dynamic.runs import Band, FreeRun
from ..dynamic.structures import FreeRunStructure
from ..statistics import Array, require_level
from .residual import Attached, Residual, Visited, attached

STRENGTHS = (1e-2, 1e-3, 1e-4, 1e-5)
"""Of the penalty, in parts of the measured variables' variance, from strong to weak."""
PIECES = 3
"""That a record is cut into for each fold, where there are few records."""
PAST = 1.05
"""Times the least loss: a weaker penalty that loses so much says that the least is past."""
ENOUGH = 1e-3
"""Relative gain of a step below which a strength's search ends."""
WIDTH = 0.1
"""Of secants, in weights."""
LEVEL = 0.95
FAR = 50.0
"""Of logarithms, so that they have an end."""
WORST = 1e6
"""Stands for the loss of a run that went beyond all numbers, in those without a residual."""


@dataclass(frozen=True)
class Strength:
    """A strength of the penalty; ``value`` None is no residual. ratio : mean squared error on what
    was left out, in parts of that without a residual. low, high : the 95 % interval of what this is
    in a typical part of the records (of the geometric mean), by which a residual counts as better:
    parts where everything is hard weigh no more than others.
    """

    value: float | None
    ratio: float
    low: float
    high: float


@shown
@dataclass(frozen=True, eq=False)
class LearnedFit:
    """A fitted plant with what was learned beside it.

    plant : with the residual, or that of ``physics`` where no residual is significantly better.
    strengths : what was tried, none first; ``strength`` the chosen one (None: no residual).
    members : plants of the folds, each learned without one. errors : (steps, ny) root mean square
    of what folds left out, by time since the start of a run; scores : those errors, each in parts
    of its expected size.

    Examples
    --------
    >>> len(learned.strengths), learned.plant is free_fit.plant
    (2, True)
    """

    plant: Plant
    physics: FreeRunFit
    residuals: tuple[Residual, ...]
    strength: float | None
    strengths: tuple[Strength, ...]
    members: tuple[Plant, ...] = field(repr=False)
    errors: Array = field(repr=False)
    scores: Array = field(repr=False)
    seconds: float = 0.0

    @property
    def options(self) -> Mapping[str, Any]:
        """Of the runs, as of the fit of the physics."""
        return self.physics.options

    @cached_property
    def training(self) -> FreeRun:
        """The runs along the records of the fit."""
        return self.validate(self.physics.records)

    def validate(self, records: Trajectory | Sequence[Trajectory], **options: Any) -> FreeRun:
        """Runs along other records, as :meth:`FreeRunFit.validate`."""
        return runs_like(self.physics, self.plant, records, options)

    def predict(
        self, records: Trajectory | Sequence[Trajectory], level: float = 0.9, **options: Any
    ) -> Band:
        """Runs along records with bands that hold ``level`` of what is measured there, if these
        records are like those of the fit; wider where the members disagree.
        """
        require_level(level)
        run = self.validate(records, **options)
        wide = _sizes(self.errors, _disagreement(self.members, self.physics, run, records, options))
        rank = np.ceil((1 + 1 / max(len(self.scores), 1)) * level * len(self.scores))
        quantile = np.sort(self.scores, axis=0)[int(min(rank, len(self.scores))) - 1]
        return Band(run, quantile * wide)

    def __str__(self) -> str:
        lines = [
            f"{self.physics.plant.name}: mean squared error on records that were left out,",
            "in parts of that without a residual (95 % interval of a typical part)",
        ]
        for s in self.strengths:
            label = "no residual" if s.value is None else f"penalty {s.value:g}"
            mark = " <- chosen" if s.value == self.strength else ""
            lines.append(f"    {label:<16} {s.ratio:.3f}  ({s.low:.3f} .. {s.high:.3f}){mark}")
        return "\n".join(lines)


def _disagreement(
    members: Sequence[Plant],
    fit: FreeRunFit,
    run: FreeRun,
    records: Any,
    options: Mapping[str, Any],
) -> Array:
    """Standard deviation of what the members predict for a run; zero without any."""
    if not members:
        return np.zeros_like(run.predicted)
    every = [runs_like(fit, m, records, options).predicted for m in members]
    return np.asarray(np.std(every, axis=0))


def _sizes(errors: Array, spread: Array) -> Array:
    """Expected errors (n, K, ny): of this time since the start, and of the members' differences."""
    steps = np.minimum(np.arange(spread.shape[1]), len(errors) - 1)
    return np.asarray(np.sqrt(errors[steps] ** 2 + np.nan_to_num(spread) ** 2))


@verb
def fit_residual(
    fit: FreeRunFit,
    residuals: Residual | Sequence[Residual],
    *,
    strengths: Sequence[float] = STRENGTHS,
    folds: int = 4,
    evaluations: int = 6,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LearnedFit:
    """Learn what a fitted plant leaves out, along the runs of its fit.

    Parameters
    ----------
    fit : of the physics; its records, horizons, dead times and sensors are those of the learning.
    residuals : one, or one of each state or output that lacks something.
    strengths : of the penalty, tried from the strongest down, beside no residual.
    folds : of records, or of parts of them where there are fewer; each is left out once.
    evaluations : of the runs with their derivatives for each strength.
    seed : of the weights where a search begins. progress : called with a line for each strength.

    The result's plant is a plant like any other, with the weights as parameters: it is simulated,
    planned with, linearised, exported. Only what the records visit can be learned; elsewhere the
    residual is bounded, and :meth:`LearnedFit.predict` tells by its bands.

    Raises InputError (arguments; residuals that name no variable of the plant), FitError.

    Examples
    --------
    >>> lacking = pam.fitting.Residual("v", ["x", "v"], pam.fitting.Splines(3))
    >>> learned = pam.fitting.fit_residual(free_fit, lacking, folds=3, strengths=[1e-2])
    >>> learned.strength is None  # the plant that made the record lacks nothing
    True
    """
    began = time.process_time()
    require_instance("fit", fit, FreeRunFit, "give the result of fit_free_run")
    given = (residuals,) if isinstance(residuals, Residual) else tuple(residuals)
    for one in given:
        require_instance("residuals", one, Residual, "give Residual(...)")
    if not given:
        raise InputError("residuals is empty: give one Residual at least")
    values = sorted((require_positive("strengths", s) for s in strengths), reverse=True)
    if not values:
        raise InputError("strengths is empty: give one above zero at least")
    counts = require_count("folds", folds, 2), require_count("evaluations", evaluations)
    trial = _Trial(fit, given, *counts, require_count("seed", seed, 0))
    tried, found = [trial.without], [trial.compared(trial.without)]
    for value in values:
        tried.append(trial.at(value))
        found.append(trial.compared(tried[-1]))
        if progress is not None:
            progress(f"penalty {value:g}: {found[-1].ratio:.4f} of the loss")
        if found[-1].ratio > PAST * min(f.ratio for f in found):
            break
    best = min(range(len(found)), key=lambda i: found[i].ratio)
    if found[best].high >= 1.0:
        best = 0
    chosen = tried[best]
    plant = fit.plant if not best else trial.fitted(values[:best])
    members = tuple(trial.attached.at(w) for w in chosen.weights) if best else ()
    errors, scores = _out_of_fold(chosen, trial, members)
    return LearnedFit(
        plant,
        fit,
        given,
        found[best].value,
        tuple(found),
        members,
        errors,
        scores,
        time.process_time() - began,
    )


# ---- learning ------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Tried:
    """A strength: weights of the folds, runs along what each left out, losses (parts, criteria)."""

    value: float | None
    weights: tuple[Array, ...]
    runs: tuple[FreeRun, ...]
    losses: Array


@dataclass(frozen=True, eq=False)
class _Shrunk:
    """The mean squared error of runs over the weights, with a penalty; see ``Normal``. width : of
    the secants that stand for slopes; None for exact ones. Friction that sticks makes errors so
    rough a function of the weights that derivatives hold for a thousandth of the step that is to be
    made with them.
    """

    rollout: Rollout
    starts: Array
    centre: Array
    precision: Array
    width: float | None = None

    def _errors(self, w: Array) -> Array:
        return self.rollout.residuals(np.concatenate([w, self.starts]))

    def cost(self, w: Array, /) -> float:
        away = w - self.centre
        return float(np.sum(self._errors(w) ** 2) + away @ self.precision @ away)

    def normal(self, w: Array, /) -> tuple[float, Array, Array, int]:
        n, away = len(w), w - self.centre
        if self.width is None:
            z = np.concatenate([w, self.starts])
            cost, gradient, square, damped = self.rollout.normal(z)
            gradient, square = gradient[:n], square[:n, :n]
        else:
            errors = self._errors(w)
            slopes = np.empty((len(errors), n))
            for k in range(n):
                beside = w.copy()
                beside[k] += self.width
                slopes[:, k] = (self._errors(beside) - errors) / self.width
            cost, gradient, square = float(errors @ errors), slopes.T @ errors, slopes.T @ slopes
            damped = 0
        cost += float(away @ self.precision @ away)
        return cost, gradient + self.precision @ away, square + self.precision, damped


class _Trial:
    """The folds of the records, each with what it leaves out."""

    def __init__(
        self,
        fit: FreeRunFit,
        residuals: Sequence[Residual],
        folds: int,
        evaluations: int,
        seed: int,
    ) -> None:
        self.fit, self.evaluations = fit, evaluations
        records = running(recorded(fit.records), fit.interpolation)
        random = np.random.default_rng(seed)
        self.attached = attached(fit.plant, residuals, _visited(fit, records), random)
        self.records, self.parts = records, _parts(records, fit.options, folds)
        self.fold = np.arange(len(self.parts)) % folds
        self.searches = [
            _Search(
                self.attached,
                fit,
                [p for p, k in zip(self.parts, self.fold, strict=True) if k != i],
            )
            for i in range(folds)
        ]

    @cached_property
    def without(self) -> _Tried:
        """No residual."""
        return self._tried(None, [self.attached.centre for _ in self.searches])

    def at(self, strength: float) -> _Tried:
        """Each fold goes on from where the strength before led."""
        return self._tried(strength, [s.to(strength, self.evaluations) for s in self.searches])

    def fitted(self, strengths: Sequence[float]) -> Plant:
        """With weights learned from all records, down to the last of these strengths."""
        search = _Search(self.attached, self.fit, self.records)
        for strength in strengths:
            weights = search.to(strength, self.evaluations)
        return self.attached.at(weights)

    def left(self, fold: int) -> list[Trajectory]:
        """The parts that a fold leaves out."""
        return [p for p, k in zip(self.parts, self.fold, strict=True) if k == fold]

    def _tried(self, value: float | None, weights: Sequence[Array]) -> _Tried:
        runs = [
            runs_like(self.fit, self.attached.at(w), self.left(i), {})
            for i, w in enumerate(weights)
        ]
        found = [
            np.concatenate(
                [run.losses(len(self.left(i)), h) for h in run.horizons or (None,)], axis=1
            )
            for i, run in enumerate(runs)
        ]
        losses = np.empty((len(self.parts), found[0].shape[1]))
        for i, own in enumerate(found):
            losses[self.fold == i] = own
        return _Tried(value, tuple(weights), tuple(runs), losses)

    def compared(self, tried: _Tried) -> Strength:
        """Its loss in parts of that without a residual."""
        base = np.nanmean(self.without.losses, axis=0)
        own, other = (
            np.nanmean(np.minimum(t.losses / base, WORST), axis=1) for t in (tried, self.without)
        )
        seen = ~np.isnan(own)
        mean, _, half = paired(np.log(own[seen] / other[seen]), LEVEL)
        if tried.value is None:
            half = 0.0
        low, high = np.exp([max(mean - half, -FAR), min(mean + half, FAR)])
        return Strength(tried.value, float(own[seen].mean()), float(low), float(high))


def _parts(
    records: Sequence[Trajectory], options: Mapping[str, Any], folds: int
) -> list[Trajectory]:
    """Whole records where there are as many as folds, else pieces that each hold a run."""
    if len(records) >= folds:
        return list(records)
    sampling = records[0].duration / (len(records[0]) - 1)
    spans = options["horizon"], options["every"] or 0.0, options["warm_up"]
    least = options["history"] + round(sum(np.max(s or 0.0) for s in spans) / sampling) + 1
    found = []
    for record in records:
        pieces = max(min(PIECES * folds, len(record) // least), 1)
        edges = np.linspace(0, len(record), pieces + 1).round().astype(int)
        found += [record.at(record.t[a:b]) for a, b in pairwise(edges.tolist())]
    if len(found) < folds:
        raise InputError(
            f"folds = {folds}: the records hold {len(found)} parts of {least} samples, which a run "
            "and its past take; take fewer folds, shorter horizons, or longer records"
        )
    return found


class _Search:
    """A descent from strong penalties to weak ones along some records; starts stay the physics'."""

    def __init__(self, made: Attached, fit: FreeRunFit, records: Sequence[Trajectory]) -> None:
        self._made, self._w = made, made.begin
        self._rollout = rollout_like(fit, made.plant, records, {}, made.weights)
        self._starts = begun(rollout_like(fit, made.at(made.centre), records, {}))

    def to(self, strength: float, evaluations: int) -> Array:
        """The weights at a strength."""
        made, free = self._made, np.full(len(self._w), np.inf)
        for width in (None, WIDTH):
            check()
            given = self._rollout, self._starts, made.centre, strength * made.precision, width
            found = descend(_Shrunk(*given), self._w, -free, free, evaluations, enough=ENOUGH)
            self._w = found.z
            if not found.damped:
                break  # else slopes of some runs mean nothing
        return self._w


def _visited(fit: FreeRunFit, records: Sequence[Trajectory]) -> Visited:
    """States and inputs at all samples of the runs of the fit."""
    runs = rollout_like(fit, fit.plant, records, {}).runs
    rollout = Rollout(fit.plant, runs, fit.unknowns, fit.rig)
    states, inputs = [], []
    for part, x in rollout.states(fit.z):
        for row, own in zip(part.rows, x, strict=True):
            count = int(runs.length[row])
            first = int(runs.first[row]) + runs.warm + 1
            states.append(own[:count])
            inputs.append(runs.inputs[int(runs.record[row])].u[first : first + count])
    x, u = np.concatenate(states), np.concatenate(inputs)
    fine = np.all(np.isfinite(x), axis=1)
    return Visited(x[fine], u[fine])


def _out_of_fold(tried: _Tried, trial: _Trial, members: Sequence[Plant]) -> tuple[Array, Array]:
    """(root mean square of the errors by time since the start (K, ny), scores as in LearnedFit)."""
    apart = [np.abs(run.predicted - run.measured) for run in tried.runs]
    square = np.full(
        (sum(map(len, apart)), max(e.shape[1] for e in apart), apart[0].shape[2]), np.nan
    )
    ends = np.cumsum([len(e) for e in apart])
    for end, error in zip(ends.tolist(), apart, strict=True):
        square[end - len(error) : end, : error.shape[1]] = error**2
    errors = np.sqrt(np.nanmean(square, axis=0))
    scores = []
    for i, (run, error) in enumerate(zip(tried.runs, apart, strict=True)):
        spread = _disagreement(members, trial.fit, run, trial.left(i), {})
        own = (error / np.maximum(_sizes(errors, spread), 1e-300)).reshape(-1, error.shape[2])
        scores.append(own[~np.isnan(own).any(axis=1)])
    return errors, np.concatenate(scores)


# ---- a structure among others --------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LearnedStructure:
    """Physics by free runs and what is learned beside it, to be chosen among others by
    :func:`choose`: so the residual itself is judged by records that nothing of it has seen.

    plant, free, options : of :func:`fit_free_run`. residuals, learning : of :func:`fit_residual`.

    Examples
    --------
    >>> options = {"horizon": [0.1], "every": 0.2}
    >>> lacking = [pam.fitting.Residual("v", ["x", "v"])]
    >>> pam.fitting.LearnedStructure(plant, ["mass"], options, lacking).complexity
    2.0
    """

    plant: Plant
    free: Sequence[str | Sequence[str]]
    options: Mapping[str, Any]
    residuals: Sequence[Residual]
    learning: Mapping[str, Any] = field(default_factory=dict)
    judged: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_plant(self.plant)

    @property
    def complexity(self) -> float:
        """Number of unknowns of the physics, and one for each residual: its freedom is chosen."""
        return float(len(groups(self.plant, self.free)) + len(self.residuals))

    def fit(self, records: Sequence[Trajectory], /) -> LearnedFit:
        """See :func:`fit_free_run` and :func:`fit_residual`."""
        physics = fit_free_run(
            self.plant, list(records), self.free, **{"judge": False, **self.options}
        )
        return fit_residual(physics, list(self.residuals), **self.learning)

    def losses(self, model: LearnedFit, records: Sequence[Trajectory], /) -> NDArray[Any]:
        """Mean squared error of each record over each horizon, variable by variable."""
        runs: Any = FreeRunStructure(self.plant, self.free, self.options, self.judged)
        return np.asarray(runs.losses(model, records))
