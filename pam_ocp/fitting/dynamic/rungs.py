"""Candidates of a ladder of models: each a plant with free parameters, fitted to all records and to
those without a fold, and what it predicts of that.

Fits are those of free runs (:mod:`.rollout`) that are as long as the records are.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.cases import results_of
from ...core.errors import FitError, InputError
from ...core.executors import Place
from ...core.stop import TimeIsUp, verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...plants.undelayed import without_dead_times
from ..statistics import Array, Coefficient
from .experiment import ParameterGroup, groups, measured_names, with_columns, with_inputs
from .free_run_result import fineness, shift, spread_of
from .gauss_newton import Descent, descend
from .rig import Rig, RunUnknowns, Unknown, unknowns_of
from .rollout import Rollout, require_followed
from .runs import FreeRun, Runs, runs_of, settled_starts

Part: TypeAlias = "tuple[int, int, int]"
"""(record, first sample, last sample + 1)."""
FIRST_RATE = 1e6
"""Of pressures [Pa/s], where no candidate before tells it."""
TRIED = 6
"""Evaluations by which starts are compared; the best goes on."""
EVALUATIONS = 40
"""Of a fit, at most."""
MOST_STEPS = 32
"""In a sampling interval, however small the residuals are."""
STEP = 5e-3
"""Longest step [s] where no number of steps is given."""
HISTORY = 3
"""Samples at the begin of a record that tell where a run begins, and are not compared."""
LOST = 1e3
"""Stands for an error, in spreads, that is no number or beyond: a run that diverged."""
NEWTON = 8
"""Steps of Newton's method from one sample's point of rest to the next, in static runs."""


@dataclass(frozen=True, eq=False)
class Rung:
    """A model to be tried: by :func:`fit_ladder`, or, as a structure, by :func:`choose`.

    plant : with start values; where it has a parameter of the rung before, it begins with what was
    found there. free : as for :func:`fit_plant`. starts : values of parameters [SI], from each of
    which the fit begins once; the best goes on. static : the plant counts as at rest at each
    moment. fast : {parameters: parts}: starts are these parts of the fastest rate of pressures in
    the rung before. later : sets of free parameters that are held at first, and freed one set after
    the other, whichever promises most, the last one last: freed at once, they lead to a worse
    minimum.

    Examples
    --------
    >>> rung = pam.fitting.Rung("lag", plant, ("mass", "muscle.lag"))
    >>> rung.name, rung.static
    ('lag', False)
    """

    name: str
    plant: Plant
    free: tuple[str | tuple[str, ...], ...]
    starts: tuple[Mapping[str, float], ...] = ({},)
    static: bool = False
    fast: Mapping[str, Sequence[float]] = field(default_factory=dict)
    later: tuple[frozenset[str], ...] = ()

    @property
    def complexity(self) -> float:
        """Number of free parameters."""
        return float(len(groups(self.plant, self.free)))

    def fit(self, records: Sequence[Trajectory], /) -> RungModel:
        """Least squares of free runs through whole records, where these begin sought, too."""
        task = _whole(self.plant, records)
        model = _best_start(task, starting(self, {}, FIRST_RATE), self)
        return _accurate(model)[0]

    def losses(self, model: RungModel, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record, variable by variable [its unit squared]; only where it
        begins is estimated from it.
        """
        again = model.along(records)
        rollout = again.rollout()
        squares = _squares(rollout, again.fitted(rollout, EVALUATIONS).z)
        return np.asarray(np.nanmean(squares, axis=1) * rollout.spread**2)


@dataclass(frozen=True, eq=False)
class RungFit:
    """One rung: fitted to all records, and what it predicts of parts that it was not fitted to.

    plant : with the fitted values. coefficients : the free parameters with standard errors.
    rmse : of each measured variable over all parts left out [its unit]. losses : mean squared error
    of each part, in parts of the variables' variances, averaged over the variables (n,).
    against : how the error (a root mean square) compares with the rung before, as (ratio - 1, half
    width of its interval). worse : whether it is significantly worse than the best rung.
    seconds : processor time of its fit to all records. failure : why there is none. members :
    what the folds found, as ``model.z``.
    """

    name: str
    plant: Plant
    coefficients: Mapping[str, Coefficient]
    rmse: Mapping[str, float]
    losses: Array = field(repr=False)
    states: int
    seconds: float
    against: tuple[float, float] = (np.nan, np.nan)
    worse: bool = False
    failure: str = ""
    model: Any = field(default=None, repr=False)
    """As it was run through the records."""
    members: tuple[Array, ...] = field(default=(), repr=False)

    @property
    def score(self) -> float:
        """Root of the mean loss: 1 is what a constant predicts."""
        return float(np.sqrt(np.mean(self.losses))) if self.losses.size else float("inf")


def usual_steps(records: Sequence[Trajectory]) -> int:
    """Steps in each sampling interval where none are given."""
    usual = min(float(np.median(np.diff(r.t))) for r in records)
    return max(1, int(np.ceil(usual / STEP - 1e-6)))


@dataclass(frozen=True, eq=False)
class Task:
    """What all fits have in common."""

    records: Sequence[Trajectory]
    outputs: Sequence[str]
    parts: Sequence[Part]
    fold: NDArray[np.intp]
    steps: int
    bounds: Mapping[str, tuple[float, float]]

    def counted(self, without: int) -> list[Array]:
        """1 for samples that count, 0 for those of a fold left out, of each record."""
        found = [np.ones(len(r)) for r in self.records]
        for (r, a, b), k in zip(self.parts, self.fold, strict=True):
            if k == without:
                found[r][a:b] = 0.0
        return found

    def losses(self, squares: Array, fold: int) -> dict[int, Array]:
        """{part of a fold: mean (ny,) of squared errors (records, K, ny) in it}."""
        return {
            i: np.mean(squares[r, max(a - HISTORY, 0) : b - HISTORY], axis=0)
            for i, ((r, a, b), k) in enumerate(zip(self.parts, self.fold, strict=True))
            if k == fold
        }


# ---- a model ------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class RungModel:
    """A rung run through whole records from guesses ``x0`` (records, nx) of the starts, dead times
    apart. What is not measured begins at rest; where positions, velocities and pressures begin is
    unknown in each record, too. whole : with its delay lines, as it was given. z : where a search
    begins, or ended.
    """

    whole: Plant
    plant: Plant
    records: Sequence[Trajectory]
    outputs: Sequence[str]
    unknowns: RunUnknowns
    rig: Rig
    x0: Array
    z: Array
    static: bool
    steps: int
    """Of the integration in each sampling interval."""
    weigh: Array | None = field(default=None)
    """Factors of the measured variables."""

    def rollout(self, counted: Sequence[Array] | None = None) -> Rollout:
        """counted : weights of the samples of each record."""
        runs = _runs(self.plant, self.records, self.outputs, self.steps, self.static)
        runs = replace(runs, x0=self.x0)
        if counted is not None:
            weights = np.zeros(runs.weights.shape)
            for row, own in zip(weights, counted, strict=True):
                row[: len(own) - HISTORY] = own[HISTORY:]
            runs = replace(runs, weights=weights / weights.sum())
        return Rollout(
            self.plant, runs, self.unknowns, self.rig, weigh=self.weigh, static=self.static
        )

    @property
    def values(self) -> dict[str, float]:
        """Of all parameters that were fitted, dead times among them."""
        found = self.unknowns.parameters(self.plant, self.z)
        delays = self.unknowns.rig(self.plant, self.outputs, self.rig, self.z).delays
        if self.plant is not self.whole:
            found |= {n.time: delays.get(n.outlet, 0.0) for n in self.whole.delay_lines}
        known = {n: self.whole.variable(n) for n in found}
        return {n: float(np.clip(v, known[n].min, known[n].max)) for n, v in found.items()}

    def along(self, records: Sequence[Trajectory]) -> RungModel:
        """The same with these values through other records: only where they begin is open."""
        plant = self.whole.with_values(self.values)
        task = replace(_whole(plant, records, self.outputs), steps=self.steps)
        return model_of(task, plant, Rung("", plant, (), static=self.static))

    def run(self, records: Sequence[Trajectory]) -> FreeRun:
        """Runs through other records, from what was measured at their begin, the rest at rest."""
        again = self.along(records)
        rollout = again.rollout()
        return rollout.runs.result(rollout.predicted(again.z))

    def fitted(
        self, rollout: Rollout, evaluations: int, starts: bool = True, held: Sequence[int] = ()
    ) -> Descent:
        """starts : whether those of the records are sought, too. held : unknowns that stay."""
        require_followed(rollout, self.z)
        low, high = self.unknowns.low.copy(), self.unknowns.high.copy()
        own = [*held, *(range(0) if starts else range(self.unknowns.shared, len(self.z)))]
        low[own] = high[own] = self.z[own]
        if not self.z.size:
            return Descent(self.z, rollout.cost(self.z), 0, "nothing is free", True, 0)
        found = descend(rollout, self.z, low, high, evaluations)
        if found.timed:
            raise TimeIsUp
        return found


def _runs(
    plant: Plant, records: Sequence[Trajectory], outputs: Sequence[str], steps: int, static: bool
) -> Runs:
    steps = NEWTON if static else steps
    for r, count in enumerate(map(len, records), start=1):
        if count <= HISTORY:
            raise InputError(
                f"record {r} has {count} samples, of which the first {HISTORY} tell where it "
                "begins; give longer ones"
            )
    runs = runs_of(plant, records, None, None, outputs, HISTORY, steps, even=False)
    if not static:
        return runs
    # at rest under the input of the sample itself, even where that has only just been set
    later = [
        replace(e, u=np.concatenate([e.u[1:], e.u[-1:]])) if e.held else e for e in runs.inputs
    ]
    return replace(runs, inputs=later)


def model_of(task: Task, plant: Plant, rung: Rung) -> RungModel:
    """Dead times are exact where steps are equal or inputs run along lines, else delay lines."""
    own = {g.name for g in groups(plant, rung.free)}
    wanted = groups(plant, rung.free, {n: b for n, b in task.bounds.items() if n in own})
    late = _dead_times(task, plant, wanted)
    bare = plant if late is None else without_dead_times(plant)
    lines = plant.delay_lines if late is not None else ()
    # what goes into a delay line stands in a column called as what comes out of it
    records = [
        with_inputs(bare, with_columns(r, {n.outlet: r[n.source] for n in lines}), {})
        for r in task.records
    ]
    names, places = ({v.name: i for i, v in enumerate(p.parameters)} for p in (plant, bare))
    kept = [
        replace(g, members=tuple(places[n] for n, i in names.items() if i in g.members))
        for g in wanted
        if g not in (late or ())
    ]
    runs = _runs(bare, records, task.outputs, task.steps, rung.static)
    x0 = settled_starts(bare, runs, len(records), range(len(bare.states)))
    seen = {*task.outputs, *(v for q, v in bare.positions.items() if q in task.outputs)}
    free = [i for i, v in enumerate(bare.states) if v.name in seen or v.unit == "Pa"]
    hidden = {} if rung.static else {i: x0[:, i] for i in free}
    sampling = float(runs.t[0])
    unknowns, _ = unknowns_of(bare, kept, task.outputs, len(records), sampling, hidden=hidden)
    inputs = [v.name for v in bare.inputs]
    for g in late or ():
        members = tuple(inputs.index(n.outlet) for n in lines if names[n.time] in g.members)
        ends = (g.value, sampling, g.low, g.high)
        unknowns = unknowns.with_more(Unknown.sized("delays", members, g.name, "s", *ends))
    times = {line.outlet: float(plant.variable(line.time).start or 0.0) for line in lines}
    rig = Rig({n: d for n, d in times.items() if d})
    begin = x0, unknowns.guess, rung.static, task.steps
    return RungModel(plant, bare, records, task.outputs, unknowns, rig, *begin)


def _dead_times(
    task: Task, plant: Plant, wanted: Sequence[ParameterGroup]
) -> list[ParameterGroup] | None:
    """The unknowns that are dead times; None where delay lines have to be integrated."""
    held = [np.diff(r.t) for r in task.records if r.interpolation == "previous"]
    times = {line.time for line in plant.delay_lines}
    found = [(g, [plant.parameters[m].name in times for m in g.members]) for g in wanted]
    uneven = any(np.ptp(steps) > 1e-3 * np.median(steps) for steps in held)
    if uneven or any(any(t) != all(t) for _, t in found):
        return None
    return [g for g, late in found if all(late)]


def _whole(
    plant: Plant, records: Sequence[Trajectory], outputs: Sequence[str] | None = None
) -> Task:
    """Of records as they are, without parts."""
    names, nothing = measured_names(plant, records, outputs), np.empty(0, dtype=np.intp)
    return Task(records, names, (), nothing, usual_steps(records), {})


def starting(rung: Rung, before: Mapping[str, float], rate: float) -> list[Plant]:
    """Plants from which a rung's fit begins, after a fastest pressure of ``rate`` [Pa/s]."""
    known = {v.name: v for v in rung.plant.parameters}
    kept = {n: v for n, v in before.items() if n in known}
    ways = [dict(s) for s in rung.starts]
    if rung.fast:
        count = len(next(iter(rung.fast.values())))
        rates = [{n: rate * parts[i] for n, parts in rung.fast.items()} for i in range(count)]
        ways = [{**a, **b} for a in ways for b in rates]
    found = []
    for way in ways:
        values = {**kept, **way}
        inside = {n: float(np.clip(v, known[n].min, known[n].max)) for n, v in values.items()}
        found.append(rung.plant.with_values(inside))
    return found


# ---- a rung -------------------------------------------------------------------------------------
def climbed(
    task: Task,
    rung: Rung,
    before: Mapping[str, float],
    rate: float,
    executor: Place,
) -> tuple[RungFit, dict[str, float], float]:
    """The rung fitted; values and the fastest rate of a pressure, for the next."""
    clock = time.process_time()
    try:
        model = _best_start(task, starting(rung, before, rate), rung)
        model, coefficients = _accurate(model)
        seconds = time.process_time() - clock
        folds = range(int(task.fold.max()) + 1)
        one = partial(_one_fold, task, model)
        found = results_of(one, folds, executor=executor, chunk=1, what="folds")
    except FitError as error:
        nothing = RungFit(rung.name, rung.plant, {}, {}, np.empty(0), len(rung.plant.states), 0.0)
        return replace(nothing, failure=str(error), worse=True), dict(before), rate
    losses = {i: loss for f in found for i, loss in f.losses.items()}
    squares = np.array([losses[i] for i in range(len(task.parts))])
    samples = np.array([b - a for _, a, b in task.parts], float)
    mean = (samples @ squares) / samples.sum()
    rollout = model.rollout()
    values = model.values
    fit = RungFit(
        rung.name,
        model.whole.with_values(values),
        coefficients,
        dict(zip(task.outputs, (np.sqrt(mean) * rollout.spread).tolist(), strict=True)),
        squares.mean(axis=1),
        0 if rung.static else len(model.whole.states),
        seconds,
        model=model,
        members=tuple(f.z for f in found),
    )
    fastest = 0.0 if rung.static else _fastest_pressure(model, rollout)
    return fit, {**before, **values}, fastest or rate


@verb
def _best_start(task: Task, plants: Sequence[Plant], rung: Rung) -> RungModel:
    """A few evaluations from each start; where the best led."""
    found, failure = [], FitError("no start")
    for plant in plants:
        model = model_of(task, plant, rung)
        try:
            tried = _tried(model, rung.later)
        except FitError as error:
            failure = error
            continue
        found.append((tried.cost, replace(model, z=tried.z)))
    if not found:
        raise failure
    return min(found, key=lambda f: f[0])[1]


def _tried(model: RungModel, later: Sequence[frozenset[str]]) -> Descent:
    """A few evaluations, after as many with each set less that is freed ``later``."""
    rollout, places = model.rollout(), [_places(model, names) for names in later]
    while places:
        held = sorted(set().union(*places))
        model = replace(model, z=model.fitted(rollout, EVALUATIONS, held=held).z)
        _, right, square, _ = rollout.normal(model.z)
        free = sorted({*range(len(right))} - {*held})
        gains = [promised(right, square, [*free, *own]) for own in places[:-1]]
        places.pop(int(np.argmax(gains)) if gains else -1)
    return model.fitted(rollout, TRIED)


def promised(right: Array, square: Array, free: list[int]) -> float:
    """By how much the cost falls when these unknowns are free, after the normal equations."""
    return -float(right[free] @ shift(square[np.ix_(free, free)], right[free]))


def _places(model: RungModel, names: frozenset[str]) -> list[int]:
    """Of the unknowns that stand for some of these parameters."""
    own = model.plant.parameters
    return [
        j for j, g in enumerate(model.unknowns.groups) if names & {own[m].name for m in g.members}
    ]


@verb
def _accurate(model: RungModel) -> tuple[RungModel, dict[str, Coefficient]]:
    """Variables weighed by their residuals, steps as short as is needed; and standard errors."""
    rollout = model.rollout()
    model = replace(model, z=model.fitted(rollout, EVALUATIONS).z)
    sizes = np.sqrt(np.nanmean(_squares(rollout, model.z), axis=(0, 1)))
    model = replace(model, weigh=1 / np.maximum(sizes, 1e-6))
    while True:
        rollout = model.rollout()
        z = model.fitted(rollout, EVALUATIONS).z
        model = replace(model, z=z)
        if not z.size:
            return model, {}
        spread, steps = spread_of(rollout, z), 2 * model.steps
        if model.static or steps > MOST_STEPS or fineness(rollout, z, spread).fine:
            return model, spread.coefficients
        model = replace(model, steps=steps)


@dataclass(frozen=True, eq=False)
class _Fold:
    """A fit without a fold, and its losses by part of what it left."""

    z: Array
    losses: dict[int, Array]


@verb
def _one_fold(task: Task, model: RungModel, fold: int) -> _Fold:
    """As to a validation, where records begin is known to a fit without a part."""
    rollout = model.rollout(task.counted(fold))
    z = model.fitted(rollout, EVALUATIONS, starts=False).z
    return _Fold(z, task.losses(_squares(rollout, z), fold))


def left_out(fit: RungFit, parts: Sequence[Part], fold: NDArray[np.intp]) -> list[Array]:
    """What each fold predicts of what it left out, from where records were measured to begin, as
    any prediction; and the sizes of its errors (2, samples, ny).
    """
    found = []
    for k, z in enumerate(fit.members):
        run = replace(fit.model, z=z).run(fit.model.records)
        error = np.abs(run.predicted - run.measured)
        own = [(r, slice(max(a - HISTORY, 0), b - HISTORY)) for r, a, b in parts]
        kept = [place for place, of in zip(own, fold, strict=True) if of == k]
        found.append(np.concatenate([(run.predicted[o], error[o]) for o in kept], axis=1))
    return found


def _squares(rollout: Rollout, z: Array) -> Array:
    """Squared errors (records, K, ny) in spreads; NaN behind the end of a record."""
    measured = rollout.runs.measured
    with np.errstate(over="ignore", invalid="ignore"):
        error = (rollout.predicted(z) - measured) / rollout.spread
    error = np.clip(np.nan_to_num(error, nan=LOST, posinf=LOST, neginf=LOST), -LOST, LOST)
    return np.where(np.isnan(measured), np.nan, error**2)


def _fastest_pressure(model: RungModel, rollout: Rollout) -> float:
    """The largest rate of a pressure from sample to sample [Pa/s]; 0 where there is none."""
    pressures = [i for i, v in enumerate(model.plant.states) if v.unit == "Pa"]
    rates = [0.0]
    for part, x in rollout.states(model.z):
        for row, own in zip(part.rows, x[..., pressures], strict=True):
            t = model.records[row].t[HISTORY:]
            change = np.diff(own[: len(t)], axis=0) / np.diff(t)[:, None]
            rates.append(float(np.abs(change).max(initial=0.0)))
    return max(rates)
