"""Which model? A ladder of them on the same records, each with one thing more, judged by what it
predicts of the parts that it was not fitted to.

Every rung is fitted to all records, and once without each fold of them; the parts left out are
predicted by free runs through the whole record (see :mod:`.whole_runs`). Rungs are compared part by
part, so that what makes a part hard for all of them drops out: the simplest rung that is not
significantly worse than the best is marked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, InputError, OutOfTime, require_count
from ...core.progress import counted
from ...core.stop import TimeIsUp, check, limited, spared, verb
from ...core.trajectory import Trajectory
from ...plants.feeds import Regulator
from ...plants.plant import Plant
from ..static.report import coefficient_line
from ..statistics import Array, Coefficient, student_t
from .experiment import ParameterGroup, groups, measured_names
from .rungs import LADDER, Builder, Rung, rungs_of, starting
from .whole_runs import WholeRuns, scaled, usual_steps

__all__ = ["Ladder", "RungFit", "fit_ladder"]

Part: TypeAlias = "tuple[int, int, int]"
"""(record, first sample, last sample + 1)."""
TRIED = 6
"""Evaluations by which starts are compared; the best goes on."""
EVALUATIONS = 40
"""Of a fit, at most."""
FARTHEST = 100.0
"""Error in spreads from which runs count as diverged at the start."""
MARGIN = 0.01
"""Models whose errors differ by less than this part count as equally good, however sure it is."""
FIRST_RATE = 1e6
"""Of pressures [Pa/s], where no rung before tells it."""
ACCURATE = 0.02
"""Error of the integration that values are content with, in parts of the residuals."""
MOST_STEPS = 32
"""In a sampling interval, however small the residuals are."""
REPORTING = 5.0
"""Seconds to say what was found when a time limit is over."""


@dataclass(frozen=True, eq=False)
class RungFit:
    """One rung: fitted to all records, and what it predicts of parts that it was not fitted to.

    plant : with the fitted values. coefficients : the free parameters with standard errors.
    rmse : of each measured variable over all parts left out [its unit]. losses : mean squared error
    of each part, in parts of the variables' variances, averaged over the variables (n,).
    against : how the error (a root mean square) compares with the rung before, as (ratio - 1, half
    width of its interval). worse : whether it is significantly worse than the best rung.
    seconds : processor time of its fit to all records. failure : why there is none.
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

    @property
    def score(self) -> float:
        """Root of the mean loss: 1 is what a constant predicts."""
        return float(np.sqrt(np.mean(self.losses))) if self.losses.size else float("inf")


@dataclass(frozen=True, eq=False)
class Ladder:
    """What :func:`fit_ladder` found.

    rungs : from the simplest up. parts : what was left out, each once. best : the rung of the least
    error; chosen : the simplest that is not significantly worse. unclimbed : names of rungs for
    which there was no time.

    Examples
    --------
    >>> from functools import partial
    >>> rig = partial(pam.HangingLoad, muscle, 10.0, damping=100.0)
    >>> commanded = pam.Trajectory(
    ...     record.t,
    ...     {n: record[n] for n in ("muscle.command", "x")},
    ...     [plant.variable(n) for n in ("muscle.command", "x")],
    ...     "previous",
    ... )
    >>> ladder = pam.fitting.fit_ladder(rig, commanded, folds=3, rungs=["static", "lag"])
    >>> ladder.best.name
    '+ lag'
    """

    rungs: tuple[RungFit, ...]
    parts: tuple[Part, ...] = field(repr=False)
    fold: NDArray[np.intp] = field(repr=False)
    outputs: tuple[str, ...]
    records: int
    level: float
    seconds: float
    unclimbed: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> RungFit:
        return next(r for r in self.rungs if r.name.removeprefix("+ ") == name.removeprefix("+ "))

    @property
    def best(self) -> RungFit:
        return min(self.rungs, key=lambda r: r.score)

    @property
    def chosen(self) -> RungFit:
        return next(r for r in self.rungs if not r.worse and not r.failure)

    @property
    def plant(self) -> Plant:
        """The chosen one, fitted to all records."""
        return self.chosen.plant

    def report(self) -> str:
        """The ladder as text: error of what was left out, gain, cost, and the chosen rung."""
        shown = [self.rungs[0].plant.variable(n) for n in self.outputs]
        heads = [f"{v.name} [{v.display_unit}]" for v in shown]
        wide = [max(len(h), 9) + 2 for h in heads]
        name = max(12, *(len(r.name) + 2 for r in self.rungs))
        lines = [
            f"[[Ladder]] {self.rungs[0].plant.name}",
            f"    {self.records} record{'s' * (self.records > 1)} of {', '.join(self.outputs)}; "
            f"{len(self.parts)} parts in {int(self.fold.max()) + 1} folds, each predicted by a fit "
            f"without it; {self.seconds:.1f} s",
            "[[Rungs]] error (RMS) of free runs in the parts left out",
            f"      {'model':<{name}}{'free':>5}{'states':>7}"
            + "".join(f"{h:>{w}}" for h, w in zip(heads, wide, strict=True))
            + f"{'error':>9}{'against the rung before':>26}{'fit [s]':>9}",
        ]
        for r in self.rungs:
            mark = "*" if r is self.chosen else " "
            row = f"    {mark} {r.name:<{name}}{len(r.coefficients):>5}{r.states:>7}"
            if r.failure:
                lines.append(f"{row}  failed: {r.failure}")
                continue
            row += "".join(
                f"{r.rmse[v.name] / v.display_factor:>{w}.4g}"
                for v, w in zip(shown, wide, strict=True)
            )
            gain, half = r.against
            said = "" if np.isnan(gain) else f"{100 * gain:+.1f} % ± {100 * half:.1f}"
            lines.append(f"{row}{r.score:>9.4f}{said:>26}{r.seconds:>9.2f}")
        lines += [f"      {n:<{name}} no time left" for n in self.unclimbed]
        lines += [
            f"    error: of all variables, in parts of their spread; ±: {100 * self.level:g} % of "
            "paired differences over the parts",
            f"    * the simplest that is not significantly (and by 1 %) worse than the best "
            f"({self.best.name.removeprefix('+ ')})",
            f"[[Parameters]] of '{self.chosen.name}', ± standard error; SI",
        ]
        t = student_t(self.level, max(sum(b - a for _, a, b in self.parts) - 1, 1))
        lines += [
            coefficient_line(c, (c.value - t * c.stderr, c.value + t * c.stderr))
            for c in self.chosen.coefficients.values()
        ]
        return "\n".join(lines)

    __str__ = report


def fit_ladder(
    build: Builder | Sequence[Rung],
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]] = (),
    *,
    feed: Regulator | None = None,
    dynamic: Sequence[str | Sequence[str]] | None = None,
    rungs: Sequence[str] = LADDER,
    outputs: Sequence[str] | None = None,
    folds: int = 5,
    steps: int | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    level: float = 0.95,
    executor: Executor | None = None,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Ladder:
    """Climb from a static model to one with lag, dead time, slew limit, friction, memory, creep.

    Parameters
    ----------
    build : makes the plant of a rung from ``feed=`` and ``losses=``, as
        ``functools.partial(pam.AntagonisticSlide, muscle, 2.0)``; or rungs of your own
        (:class:`Rung`), from the simplest up, with which ``free``, ``feed``, ``dynamic`` and
        ``rungs`` are left out.
    records : with all inputs and some states or outputs. Each should begin at rest: what is not
        measured begins there.
    free : parameters to fit on every rung, as for :func:`fit_plant` (a gain, a base pressure, the
        muscle's coefficients); they begin where ``build`` sets them.
    feed : the regulator on which rungs are built: its gain, base, lags; by default ``Regulator()``.
    dynamic : parameters freed from the second rung on; by default the plant's damping.
    rungs : which to climb, of "static", "lag", "dead time", "slew", "friction", "memory" (slip)
        and "creep". Parameters of these, such as the lags of two muscles, count as equal.
    outputs : what is compared; by default all states and outputs that the records hold.
    folds : of parts of the records (at least 3), each predicted once by a fit to the others. Whole
        records are the parts where there are as many, else each is cut.
    steps : of the integration in each sampling interval; by default of 1.25 ms. Values are found
        with as many more as the residuals ask for.
    bounds : {free parameter: (low, high)}.
    level : of intervals and of the significance of differences.
    executor : any ``concurrent.futures.Executor`` for the fits without folds; take processes.
    progress : called with a line for each rung.
    time_limit : [s]; rungs for which there is no time are named, OutOfTime where none was climbed.

    Raises
    ------
    InputError, UnknownNameError : arguments that cannot be.
    FitError : no rung could be fitted.

    Examples
    --------
    >>> from functools import partial
    >>> rig = partial(pam.HangingLoad, muscle, 10.0, damping=100.0)
    >>> commanded = pam.Trajectory(
    ...     record.t,
    ...     {n: record[n] for n in ("muscle.command", "x")},
    ...     [plant.variable(n) for n in ("muscle.command", "x")],
    ...     "previous",
    ... )
    >>> ladder = pam.fitting.fit_ladder(rig, commanded, folds=3, rungs=["static", "lag"])
    >>> [rung.name for rung in ladder.rungs]
    ['static', '+ lag']
    """
    began = time.perf_counter()
    chosen = [records] if isinstance(records, Trajectory) else list(records)
    ladder = (
        rungs_of(build, free, feed=feed, dynamic=dynamic, names=rungs)
        if callable(build)
        else _own(build)
    )
    names = measured_names(ladder[-1].plant, chosen, outputs)
    student_t(level, 1)  # refuses what is no level
    parts = _parts(chosen, require_count("folds", folds, 3))
    fold = _folds(chosen, parts, folds)
    number = usual_steps(chosen) if steps is None else require_count("steps", steps)
    task = _Task(chosen, names, parts, fold, number, dict(bounds or {}))
    with limited(time_limit):
        found = _climbed_all(ladder, task, executor, progress)
        with spared(REPORTING):
            return Ladder(
                tuple(_compared(found, level)),
                tuple(parts),
                fold,
                tuple(names),
                len(chosen),
                level,
                time.perf_counter() - began,
                tuple(r.name for r in ladder[len(found) :]),
            )


def _climbed_all(
    ladder: Sequence[Rung],
    task: _Task,
    executor: Executor | None,
    progress: Callable[[str], None] | None,
) -> list[RungFit]:
    """The rungs for which there is time."""
    found: list[RungFit] = []
    values: dict[str, float] = {}
    rate = FIRST_RATE
    try:
        for rung in counted(ladder, "rungs"):
            check()
            fit, values, rate = _climbed(task, rung, values, rate, executor)
            found.append(fit)
            if progress is not None:
                progress(f"{fit.name}: {fit.failure or f'error {fit.score:.4f}'}")
    except TimeIsUp:
        if not any(not r.failure for r in found):
            raise OutOfTime(
                "the time limit was over before the first rung was climbed; allow more time, or "
                "give fewer folds"
            ) from None
    if all(r.failure for r in found):
        raise FitError(f"no rung could be fitted: {found[0].failure}")
    return found


# ---- arguments ----------------------------------------------------------------------------------
def _own(given: Sequence[Rung]) -> list[Rung]:
    ladder = list(given) if isinstance(given, Sequence) else []
    wrong = [r for r in ladder if not isinstance(r, Rung)]
    if wrong or not ladder:
        raise InputError(
            "build: give a function of feed= and losses= that makes a plant, or a list of Rungs"
        )
    return ladder


def _parts(records: Sequence[Trajectory], folds: int) -> list[Part]:
    """Whole records, or each cut into as many pieces as make a part for each fold and more."""
    if len(records) >= folds:
        return [(r, 0, len(record)) for r, record in enumerate(records)]
    pieces = 3 * folds if len(records) == 1 else folds
    found = []
    for r, record in enumerate(records):
        if len(record) < 4 * pieces:
            raise InputError(
                f"record {r + 1} has {len(record)} samples, too few for {pieces} parts; take fewer "
                "folds"
            )
        edges = np.linspace(0, len(record), pieces + 1).round().astype(int).tolist()
        found += [(r, a, b) for a, b in pairwise(edges)]
    return found


def _folds(records: Sequence[Trajectory], parts: Sequence[Part], folds: int) -> NDArray[np.intp]:
    """The fold of each part: in turn, so that a fold has parts of early and of late."""
    return np.arange(len(parts), dtype=np.intp) % min(folds, len(parts))


# ---- one rung -----------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Task:
    """What all fits have in common."""

    records: Sequence[Trajectory]
    outputs: Sequence[str]
    parts: Sequence[Part]
    fold: NDArray[np.intp]
    steps: int
    bounds: Mapping[str, tuple[float, float]]

    def runs(self, plant: Plant, unknowns: Sequence[ParameterGroup], static: bool) -> WholeRuns:
        return WholeRuns(
            plant, self.records, self.outputs, unknowns, steps=self.steps, static=static
        )

    def weights(self, without: int | None) -> list[Array]:
        """1 for samples that count, 0 for those of a fold left out, of each record."""
        found = [np.ones(len(r)) for r in self.records]
        for (r, a, b), k in zip(self.parts, self.fold, strict=True):
            if k == without:
                found[r][a:b] = 0.0
        return found

    def losses(self, errors: Sequence[Array], fold: int) -> dict[int, Array]:
        """Mean squared errors (ny,) of the parts of a fold, by the part's number."""
        return {
            i: np.mean(errors[r][a:b] ** 2, axis=0)
            for i, ((r, a, b), k) in enumerate(zip(self.parts, self.fold, strict=True))
            if k == fold
        }


def _climbed(
    task: _Task,
    rung: Rung,
    before: Mapping[str, float],
    rate: float,
    executor: Executor | None,
) -> tuple[RungFit, dict[str, float], float]:
    """The rung fitted; values and the fastest rate of a pressure, for the next."""
    clock = time.process_time()
    try:
        plants = starting(rung, before, rate)
        bounds = {n: b for n, b in task.bounds.items() if n in _labels(plants[0], rung)}
        plant = _best_start(task, plants, rung, bounds)
        even = np.ones(len(task.outputs))
        plant, sizes, _ = _fitted(task, plant, rung, bounds, None, EVALUATIONS, even)
        weigh = 1 / np.maximum(sizes, 1e-6)  # each variable in units of its residuals
        plant, coefficients, task = _accurate(task, plant, rung, bounds, weigh)
        seconds = time.process_time() - clock
        losses = _left_out(task, plant, rung, bounds, weigh, executor)
    except FitError as error:
        nothing = RungFit(rung.name, rung.plant, {}, {}, np.empty(0), len(rung.plant.states), 0.0)
        return replace(nothing, failure=str(error), worse=True), dict(before), rate
    runs = task.runs(plant, (), rung.static)
    samples = np.array([b - a for _, a, b in task.parts], float)
    squares = np.array([losses[i] for i in range(len(task.parts))])
    mean = (samples @ squares) / samples.sum()
    rmse = dict(zip(task.outputs, (np.sqrt(mean) * runs.spread).tolist(), strict=True))
    fastest = rate if rung.static else runs.fastest_pressure(np.empty(0)) or rate
    fit = RungFit(
        rung.name,
        plant,
        coefficients,
        rmse,
        squares.mean(axis=1),
        0 if rung.static else len(plant.states),
        seconds,
    )
    values = {v.name: float(v.start or 0.0) for v in plant.parameters}
    freed = {m for g in groups(plant, rung.free, {}) for m in g.members}
    kept = {plant.parameters[m].name for m in freed}
    return fit, {**before, **{n: values[n] for n in kept}}, fastest


def _accurate(
    task: _Task,
    plant: Plant,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
) -> tuple[Plant, dict[str, Coefficient], _Task]:
    """The fit with steps so short that halving them changes little, measured by the residuals;
    and the task with these steps.
    """
    while True:
        plant, sizes, found = _fitted(task, plant, rung, bounds, None, EVALUATIONS, weigh, True)
        finer = replace(task, steps=2 * task.steps)
        if rung.static or finer.steps > MOST_STEPS:
            return plant, found, task
        gaps = [b - a for a, b in zip(_errors(task, plant), _errors(finer, plant), strict=True)]
        gap = np.sqrt(np.mean(np.concatenate(gaps) ** 2, axis=0))
        if np.all(gap <= ACCURATE * np.maximum(sizes, 1e-6)):
            return plant, found, task
        task = finer


@verb
def _errors(task: _Task, plant: Plant) -> list[Array]:
    return task.runs(plant, (), False).errors(np.empty(0))


@verb
def _best_start(
    task: _Task,
    plants: Sequence[Plant],
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
) -> Plant:
    """A few evaluations from each start; where the best led."""
    even = np.ones(len(task.outputs))
    found, failure = [], FitError("no start")
    for plant in plants:
        try:
            fitted, sizes, _ = _fitted(task, plant, rung, bounds, None, TRIED, even)
            found.append((float(np.sum(sizes**2)), fitted))
        except FitError as error:
            failure = error
    if not found:
        raise failure
    return min(found, key=lambda f: f[0])[1]


def _labels(plant: Plant, rung: Rung) -> set[str]:
    return {g.name for g in groups(plant, rung.free, {})}


def _left_out(
    task: _Task,
    plant: Plant,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
    executor: Executor | None,
) -> dict[int, Array]:
    """Losses of all parts, each by a fit without its fold."""
    folds = range(int(task.fold.max()) + 1)
    bare = replace(rung, plant=plant)
    if executor is None:
        found = [_one_fold(task, bare, bounds, weigh, k) for k in folds]
    else:
        futures = [executor.submit(_one_fold, task, bare, bounds, weigh, k) for k in folds]
        try:
            found = []
            for future in futures:
                while True:
                    check()
                    try:
                        found.append(future.result(timeout=0.2))
                        break
                    except TimeoutError:
                        if future.done():
                            raise
        finally:
            for future in futures:
                future.cancel()
    return {i: loss for losses in found for i, loss in losses.items()}


@verb
def _one_fold(
    task: _Task,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
    fold: int,
) -> dict[int, Array]:
    plant, _, _ = _fitted(task, rung.plant, rung, bounds, fold, EVALUATIONS, weigh)
    errors = task.runs(plant, (), rung.static).errors(np.empty(0))
    return task.losses(errors, fold)


@verb
def _fitted(
    task: _Task,
    plant: Plant,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    without: int | None,
    evaluations: int,
    weigh: Array,
    errors: bool = False,
) -> tuple[Plant, Array, dict[str, Coefficient]]:
    """(plant with fitted values, error of each variable in spreads, coefficients with standard
    errors if asked). weigh : of the variables.
    """
    from scipy.optimize import least_squares

    unknowns = groups(plant, rung.free, dict(bounds))
    runs = task.runs(plant, unknowns, rung.static)
    weights = [w[:, None] * weigh for w in task.weights(without)]
    samples = sum(float(np.sum(w[:, 0] > 0)) for w in weights)
    count = float(np.sqrt(samples * len(task.outputs)))

    def residuals(z: Array) -> Array:
        check()
        found = zip(runs.errors(z), weights, strict=True)
        return np.concatenate([(e * w).ravel() for e, w in found]) / count

    def slopes(z: Array) -> Array:
        check()
        found = zip(runs.slopes(z), weights, strict=True)
        rows = [(s * w[:, :, None]).reshape(-1, len(unknowns)) for s, w in found]
        return np.concatenate(rows) / count

    def sizes(residual: Array) -> Array:
        squares = (residual.reshape(-1, len(weigh)) * count / weigh) ** 2
        return np.asarray(np.sqrt(squares.sum(axis=0) / samples))

    z, low, high = scaled(unknowns)
    if not unknowns:
        return plant, sizes(residuals(z)), {}
    if not np.all(sizes(residuals(z)) < FARTHEST):
        raise FitError("free runs of the records diverge at the start values")
    inside = 1e-9 * (1 + np.abs(z))
    answer = least_squares(
        residuals,
        np.clip(z, low + inside, high - inside),
        jac=slopes,
        bounds=(low, high),
        x_scale="jac",
        ftol=1e-6,
        xtol=1e-6,
        gtol=1e-9,
        max_nfev=evaluations,
    )
    values = {
        plant.parameters[m].name: float(np.clip(v * g.scale, g.low, g.high))
        for g, v in zip(unknowns, answer.x, strict=True)
        for m in g.members
    }
    fitted = plant.with_values(values)
    found = _coefficients(unknowns, answer.x, answer.jac, answer.fun) if errors else {}
    return fitted, sizes(answer.fun), found


def _coefficients(
    unknowns: Sequence[ParameterGroup], z: Array, jacobian: Array, residuals: Array
) -> dict[str, Coefficient]:
    """Standard errors by Gauss-Newton; infinite for what the records do not see."""
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, s, vt = np.linalg.svd(jacobian / size, full_matrices=False)
    with np.errstate(divide="ignore"):
        inverse = np.where(s > 1e-8 * s[0], 1 / s, np.inf)
    with np.errstate(invalid="ignore"):
        variance = np.nansum((vt.T * inverse) ** 2, axis=1) / size**2
    noise = float(residuals @ residuals) / max(residuals.size - len(z), 1)
    return {
        g.name: Coefficient(
            g.name,
            float(v * g.scale),
            float(np.sqrt(noise * var) * g.scale),
            g.unit,
            False,
            g.description,
        )
        for g, v, var in zip(unknowns, z, variance, strict=True)
    }


# ---- comparison ---------------------------------------------------------------------------------
def _compared(found: Sequence[RungFit], level: float) -> list[RungFit]:
    """Each rung against the one before, and against the best; paired over the parts."""
    best = min((r for r in found if not r.failure), key=lambda r: r.score)
    compared: list[RungFit] = []
    last: RungFit | None = None
    for rung in found:
        if rung.failure:
            compared.append(rung)
            continue
        against = (np.nan, np.nan)
        if last is not None:
            gain, half = _ratio(rung, last, level)
            against = (float(np.expm1(gain)), float(np.exp(gain) * np.sinh(min(half, 50.0))))
        behind, half = _ratio(rung, best, 2 * level - 1 if level > 0.5 else level)
        compared.append(replace(rung, against=against, worse=behind - half > np.log1p(MARGIN)))
        last = rung
    return compared


def _ratio(rung: RungFit, other: RungFit, level: float) -> tuple[float, float]:
    """Mean of ln(error/other's error) over the parts, and the half width of its interval."""
    tiny = 1e-30
    gaps = 0.5 * np.log((rung.losses + tiny) / (other.losses + tiny))
    if len(gaps) < 2:
        return float(gaps.mean()), float("inf")
    half = student_t(level, len(gaps) - 1) * float(gaps.std(ddof=1)) / np.sqrt(len(gaps))
    return float(gaps.mean()), float(half)
