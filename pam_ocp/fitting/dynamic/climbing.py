"""One rung of a ladder: its fit to all records, and what it predicts of each fold left out.

Its fits are those of free runs (:mod:`.rollout`) that are as long as the records are.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...core.cases import Place, results_of
from ...core.errors import FitError
from ...core.stop import TimeIsUp, verb
from ...core.trajectory import Trajectory
from ...plants.dead_time import DelayLine
from ...plants.plant import Plant
from ...plants.undelayed import without_dead_times
from ..statistics import Array, Coefficient
from .descent import Descent, descend
from .experiment import ParameterGroup, groups, with_inputs
from .ladder_result import Part, RungFit
from .rig import Rig, RunUnknowns, unknowns_of
from .rollout import Rollout, require_followed
from .run_statistics import fineness, spread_of
from .rungs import Rung, starting
from .runs import Runs, runs_of, settled_starts

__all__ = ["RungModel", "Task", "climbed", "model_of", "usual_steps"]

TRIED = 6
"""Evaluations by which starts are compared; the best goes on."""
EVALUATIONS = 40
"""Of a fit, at most."""
MOST_STEPS = 32
"""In a sampling interval, however small the residuals are."""
STEP = 1.25e-3
"""Longest step [s] where no number of steps is given."""
HISTORY = 3
"""Samples at the begin of a record that tell where a run begins, and are not compared."""
LOST = 1e3
"""Stands for an error, in spreads, that is no number or beyond: a run that diverged."""
NEWTON = 8
"""Steps of Newton's method from one sample's point of rest to the next, in static runs."""


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
    """A rung from a plant's values on, run through whole records. What is not measured begins at
    rest; where positions, velocities and pressures begin is unknown in each record, too.

    plant, records : as they are run, dead times apart. x0 (records, nx) : guesses of the starts.
    z : where a search begins, or ended.
    """

    plant: Plant
    records: Sequence[Trajectory]
    outputs: Sequence[str]
    unknowns: RunUnknowns
    rig: Rig
    x0: Array
    z: Array
    static: bool
    weigh: Array | None = field(default=None)
    """Factors of the measured variables."""

    def rollout(self, steps: int, counted: Sequence[Array] | None = None) -> Rollout:
        """counted : weights of the samples of each record."""
        runs = _runs(self.plant, self.records, self.outputs, steps, self.static)
        runs = replace(runs, x0=self.x0)
        if counted is not None:
            weights = np.zeros(runs.weights.shape)
            for row, own in zip(weights, counted, strict=True):
                row[: len(own) - HISTORY] = own[HISTORY:]
            runs = replace(runs, weights=weights / weights.sum())
        return Rollout(
            self.plant, runs, self.unknowns, self.rig, weigh=self.weigh, static=self.static
        )

    def fitted(self, rollout: Rollout, evaluations: int, starts: bool = True) -> Descent:
        """starts : whether those of the records are sought, too."""
        require_followed(rollout, self.z)
        low, high = self.unknowns.low.copy(), self.unknowns.high.copy()
        if not starts:
            own = slice(self.unknowns.shared, None)
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
    runs = runs_of(plant, records, None, None, outputs, HISTORY, steps, even=False)
    if not static:
        return runs
    # at rest under the input of the sample itself, even where that has only just been set
    later = [
        replace(e, u=np.concatenate([e.u[1:], e.u[-1:]])) if e.held else e for e in runs.inputs
    ]
    return replace(runs, inputs=later)


def model_of(task: Task, plant: Plant, rung: Rung) -> RungModel:
    """Dead times are those of inputs, and exact, where all records have the same equal steps; else
    delay lines are integrated.
    """
    own = {g.name for g in groups(plant, rung.free)}
    wanted = groups(plant, rung.free, {n: b for n, b in task.bounds.items() if n in own})
    late = _dead_times(task, plant, wanted)
    bare = plant if late is None else without_dead_times(plant)
    lines = plant.delay_lines if late is not None else ()
    records = [with_inputs(bare, _at_outlets(r, lines), {}) for r in task.records]
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
        members = [inputs.index(n.outlet) for n in lines if names[n.time] in g.members]
        ends = (g.value, g.low, g.high)
        unknowns = unknowns.with_delay(tuple(members), g.name, sampling, *ends)
    times = {line.outlet: float(plant.variable(line.time).start or 0.0) for line in lines}
    rig = Rig({n: d for n, d in times.items() if d})
    return RungModel(bare, records, task.outputs, unknowns, rig, x0, unknowns.guess, rung.static)


def _at_outlets(record: Trajectory, lines: Sequence[DelayLine]) -> Trajectory:
    """With what goes into a delay line as a column called as what comes out of it."""
    if not lines:
        return record
    columns = {n: record[n] for n in record.names} | {n.outlet: record[n.source] for n in lines}
    return Trajectory(record.t, columns, interpolation=record.interpolation)


def _dead_times(
    task: Task, plant: Plant, wanted: Sequence[ParameterGroup]
) -> list[ParameterGroup] | None:
    """The unknowns that are dead times; None where delay lines have to be integrated: records of
    other steps, a dead time that is to be equal to something else.
    """
    steps = np.concatenate([np.diff(r.t) for r in task.records])
    times = {line.time for line in plant.delay_lines}
    found = [(g, [plant.parameters[m].name in times for m in g.members]) for g in wanted]
    if np.ptp(steps) > 1e-3 * np.median(steps) or any(any(t) != all(t) for _, t in found):
        return None
    return [g for g, late in found if all(late)]


def _values(plant: Plant, model: RungModel) -> dict[str, float]:
    """Of all parameters that were fitted, dead times among them."""
    found = model.unknowns.parameters(model.plant, model.z)
    delays = model.unknowns.rig(model.plant, model.outputs, model.rig, model.z).delays
    if model.plant is not plant:
        found |= {line.time: delays.get(line.outlet, 0.0) for line in plant.delay_lines}
    return {
        n: float(np.clip(v, plant.variable(n).min, plant.variable(n).max)) for n, v in found.items()
    }


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
        plant, model = _best_start(task, starting(rung, before, rate), rung)
        model, steps, coefficients = _accurate(model, task.steps)
        seconds = time.process_time() - clock
        folds = range(int(task.fold.max()) + 1)
        one = partial(_one_fold, task, model, steps)
        found = results_of(one, folds, executor=executor, chunk=1, what="folds")
    except FitError as error:
        nothing = RungFit(rung.name, rung.plant, {}, {}, np.empty(0), len(rung.plant.states), 0.0)
        return replace(nothing, failure=str(error), worse=True), dict(before), rate
    losses = {i: loss for losses in found for i, loss in losses.items()}
    squares = np.array([losses[i] for i in range(len(task.parts))])
    samples = np.array([b - a for _, a, b in task.parts], float)
    mean = (samples @ squares) / samples.sum()
    rollout = model.rollout(steps)
    values = _values(plant, model)
    fit = RungFit(
        rung.name,
        plant.with_values(values),
        coefficients,
        dict(zip(task.outputs, (np.sqrt(mean) * rollout.spread).tolist(), strict=True)),
        squares.mean(axis=1),
        0 if rung.static else len(plant.states),
        seconds,
        model=model,
    )
    fastest = 0.0 if rung.static else _fastest_pressure(model, rollout)
    return fit, {**before, **values}, fastest or rate


@verb
def _best_start(task: Task, plants: Sequence[Plant], rung: Rung) -> tuple[Plant, RungModel]:
    """A few evaluations from each start; where the best led."""
    found, failure = [], FitError("no start")
    for plant in plants:
        model = model_of(task, plant, rung)
        try:
            tried = model.fitted(model.rollout(task.steps), TRIED)
        except FitError as error:
            failure = error
            continue
        found.append((tried.cost, plant, replace(model, z=tried.z)))
    if not found:
        raise failure
    return min(found, key=lambda f: f[0])[1:]


@verb
def _accurate(model: RungModel, steps: int) -> tuple[RungModel, int, dict[str, Coefficient]]:
    """Each variable weighed by its residuals, with steps so short that halving them changes little;
    the number of these, and the values with standard errors.
    """
    rollout = model.rollout(steps)
    model = replace(model, z=model.fitted(rollout, EVALUATIONS).z)
    sizes = np.sqrt(np.nanmean(_squares(rollout, model.z), axis=(0, 1)))
    model = replace(model, weigh=1 / np.maximum(sizes, 1e-6))
    while True:
        rollout, u = model.rollout(steps), model.unknowns
        z = model.fitted(rollout, EVALUATIONS).z
        model = replace(model, z=z)
        if not z.size:
            return model, steps, {}
        edge = (z - u.low < 1e-9) | (u.high - z < 1e-9)
        found = spread_of(rollout, rollout.runs, u, z, edge).coefficients
        stderr = np.array([c.stderr for c in found.values()]) / u.scale[: u.shared]
        if model.static or 2 * steps > MOST_STEPS:
            return model, steps, found
        finer = model.rollout(2 * steps).predicted(z)
        if fineness(rollout, z, finer, ~edge, stderr).fine:
            return model, steps, found
        steps *= 2


@verb
def _one_fold(task: Task, model: RungModel, steps: int, fold: int) -> dict[int, Array]:
    """As to a validation, where records begin is known to a fit without a part."""
    rollout = model.rollout(steps, task.counted(fold))
    found = model.fitted(rollout, EVALUATIONS, starts=False)
    return task.losses(_squares(rollout, found.z), fold)


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
