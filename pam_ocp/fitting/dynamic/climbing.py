"""One rung of a ladder: its fit to all records, and what it predicts of each fold left out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...core.cases import Place, results_of
from ...core.errors import FitError
from ...core.stop import check, verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array, Coefficient
from .experiment import ParameterGroup, groups
from .fineness import shift, unmoved
from .ladder_result import Part, RungFit
from .run_statistics import BLOCKS, widened
from .rungs import Rung, starting
from .whole_runs import WholeRuns, scaled

__all__ = ["Task", "climbed"]

TRIED = 6
"""Evaluations by which starts are compared; the best goes on."""
EVALUATIONS = 40
"""Of a fit, at most."""
FARTHEST = 100.0
"""Error in spreads from which runs count as diverged at the start."""
ACCURATE = 0.02
"""Error of the integration that values are content with, in parts of the residuals."""
UNSEEN = 1e-8
"""Of a direction of the parameters, in parts of the best seen."""
MOST_STEPS = 32
"""In a sampling interval, however small the residuals are."""


@dataclass(frozen=True, eq=False)
class Task:
    """What all fits have in common."""

    records: Sequence[Trajectory]
    outputs: Sequence[str]
    parts: Sequence[Part]
    fold: NDArray[np.intp]
    steps: int
    bounds: Mapping[str, tuple[float, float]]
    free_starts: bool = True
    """Whether where records begin is sought, too."""
    begun: Array | None = None
    """Where they begin, if that is known."""

    def runs(self, plant: Plant, unknowns: Sequence[ParameterGroup], static: bool) -> WholeRuns:
        return WholeRuns(
            plant,
            self.records,
            self.outputs,
            unknowns,
            steps=self.steps,
            static=static,
            free_starts=self.free_starts,
            begun=self.begun,
        )

    def weights(self, without: int | None) -> list[Array]:
        """1 for samples that count, 0 for those of a fold left out, of each record."""
        found = [np.ones(len(r)) for r in self.records]
        for (r, a, b), k in zip(self.parts, self.fold, strict=True):
            if k == without:
                found[r][a:b] = 0.0
        return found

    def blocks(self) -> NDArray[np.intp]:
        """The block of each row of residuals: equal parts of each record."""
        parts = max(1, -(-BLOCKS // len(self.records)))
        found = []
        for number, record in enumerate(self.records):
            own = number * parts + np.arange(len(record)) * parts // len(record)
            found.append(np.repeat(own, len(self.outputs)))
        return np.concatenate(found)

    def losses(self, errors: Sequence[Array], fold: int) -> dict[int, Array]:
        """Mean squared errors (ny,) of the parts of a fold, by the part's number."""
        return {
            i: np.mean(errors[r][a:b] ** 2, axis=0)
            for i, ((r, a, b), k) in enumerate(zip(self.parts, self.fold, strict=True))
            if k == fold
        }


@dataclass(frozen=True, eq=False)
class _Fitted:
    """plant : with fitted values. sizes : error of each variable in spreads. coefficients : with
    standard errors, if asked. own : where records begin.
    """

    plant: Plant
    sizes: Array
    coefficients: dict[str, Coefficient]
    own: Array


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
        plants = starting(rung, before, rate)
        bounds = {n: b for n, b in task.bounds.items() if n in _labels(plants[0], rung)}
        rough = replace(task, free_starts=False)
        plant = _best_start(rough, plants, rung, bounds)
        even = np.ones(len(task.outputs))
        first = _fitted(rough, plant, rung, bounds, None, EVALUATIONS, even)
        weigh = 1 / np.maximum(first.sizes, 1e-6)  # each variable in units of its residuals
        found, task = _accurate(task, first, rung, bounds, weigh)
        plant, coefficients = found.plant, found.coefficients
        seconds = time.process_time() - clock
        # as to a validation, where records begin is known to the fits without a part
        task = replace(task, free_starts=False, begun=found.own)
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
    freed = {m for g in groups(plant, rung.free) for m in g.members}
    kept = {plant.parameters[m].name for m in freed}
    return fit, {**before, **{n: values[n] for n in kept}}, fastest


def _accurate(
    task: Task,
    found: _Fitted,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
) -> tuple[_Fitted, Task]:
    """The fit with steps so short that halving them changes little, measured by the residuals;
    and the task with these steps.
    """
    while True:
        own = found.own if found.own.size else None
        found = _fitted(task, found.plant, rung, bounds, None, EVALUATIONS, weigh, True, own)
        finer = replace(task, steps=2 * task.steps)
        if rung.static or finer.steps > MOST_STEPS:
            return found, task
        coarse, halved = (_errors(t, found) for t in (task, finer))
        gaps = [b - a for a, b in zip(coarse, halved, strict=True)]
        gap = np.sqrt(np.mean(np.concatenate(gaps) ** 2, axis=0))
        fine = bool(np.all(gap <= ACCURATE * np.maximum(found.sizes, 1e-6)))
        if fine and _unmoved(task, found, rung, bounds, weigh, gaps):
            return found, task
        task = finer


def _unmoved(
    task: Task,
    found: _Fitted,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
    gaps: Sequence[Array],
) -> bool:
    """Whether these changes of the runs would move no value by much of its standard error."""
    unknowns = groups(found.plant, rung.free, dict(bounds))
    if not unknowns:
        return True
    z = np.concatenate([scaled(unknowns)[0], found.own])
    slopes = task.runs(found.plant, unknowns, rung.static).slopes(z)
    rows = np.concatenate([(s * weigh[:, None]).reshape(-1, len(z)) for s in slopes])
    change = np.concatenate([(g * weigh).ravel() for g in gaps])
    stderr = np.array([found.coefficients[g.name].stderr / g.scale for g in unknowns])
    shifts = np.abs(shift(rows.T @ rows, rows.T @ change))[: len(unknowns)]
    return unmoved(shifts, stderr, z)


@verb
def _errors(task: Task, found: _Fitted) -> list[Array]:
    return task.runs(found.plant, (), False).errors(found.own)


@verb
def _best_start(
    task: Task,
    plants: Sequence[Plant],
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
) -> Plant:
    """A few evaluations from each start; where the best led."""
    even = np.ones(len(task.outputs))
    found, failure = [], FitError("no start")
    for plant in plants:
        try:
            tried = _fitted(task, plant, rung, bounds, None, TRIED, even)
            found.append((float(np.sum(tried.sizes**2)), tried.plant))
        except FitError as error:
            failure = error
    if not found:
        raise failure
    return min(found, key=lambda f: f[0])[1]


def _labels(plant: Plant, rung: Rung) -> set[str]:
    return {g.name for g in groups(plant, rung.free)}


def _left_out(
    task: Task,
    plant: Plant,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
    executor: Place,
) -> dict[int, Array]:
    """Losses of all parts, each by a fit without its fold."""
    folds = range(int(task.fold.max()) + 1)
    bare = replace(rung, plant=plant)
    one = partial(_one_fold, task, bare, bounds, weigh)
    found = results_of(one, folds, executor=executor, chunk=1, what="folds")
    return {i: loss for losses in found for i, loss in losses.items()}


@verb
def _one_fold(
    task: Task,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    weigh: Array,
    fold: int,
) -> dict[int, Array]:
    found = _fitted(task, rung.plant, rung, bounds, fold, EVALUATIONS, weigh)
    errors = task.runs(found.plant, (), rung.static).errors(np.empty(0))
    return task.losses(errors, fold)


@verb
def _fitted(
    task: Task,
    plant: Plant,
    rung: Rung,
    bounds: Mapping[str, tuple[float, float]],
    without: int | None,
    evaluations: int,
    weigh: Array,
    errors: bool = False,
    own: Array | None = None,
) -> _Fitted:
    """Least squares from the plant's values; errors : whether standard errors are asked for.
    without : a fold. weigh : of the variables. own : where records begin, by what is known.
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
        rows = [(s * w[:, :, None]).reshape(-1, len(z)) for s, w in found]
        return np.concatenate(rows) / count

    def sizes(residual: Array) -> Array:
        squares = (residual.reshape(-1, len(weigh)) * count / weigh) ** 2
        return np.asarray(np.sqrt(squares.sum(axis=0) / samples))

    z, low, high = scaled(unknowns)
    free = np.zeros(runs.starts) if own is None else own
    z, low, high = (
        np.concatenate([a, b])
        for a, b in (
            (z, free),
            (low, np.full(free.size, -np.inf)),
            (high, np.full(free.size, np.inf)),
        )
    )
    if not z.size:
        return _Fitted(plant, sizes(residuals(z)), {}, z)
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
        for g, v in zip(unknowns, answer.x, strict=False)
        for m in g.members
    }
    fitted = plant.with_values(values)
    found: dict[str, Coefficient] = {}
    if errors:
        found = _coefficients(unknowns, answer.x, answer.jac, answer.fun, task.blocks())
    return _Fitted(fitted, sizes(answer.fun), found, answer.x[len(unknowns) :])


def _coefficients(
    unknowns: Sequence[ParameterGroup],
    z: Array,
    jacobian: Array,
    residuals: Array,
    block: NDArray[np.intp],
) -> dict[str, Coefficient]:
    """Standard errors by Gauss-Newton, wider where errors follow each other; infinite for what the
    records do not see. block : of each row; blocks count as independent.
    """
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    even = jacobian / size
    _, s, vt = np.linalg.svd(even, full_matrices=False)
    seen = s > UNSEEN * s[0]
    inverse = (vt[seen].T / s[seen] ** 2) @ vt[seen]
    scores = np.zeros((int(block.max()) + 1, len(z)))
    np.add.at(scores, block, even * residuals[:, None])
    noise = float(residuals @ residuals) / max(residuals.size - len(z), 1)
    covariance, _ = widened(inverse, scores, noise)
    lost = (np.abs(vt[~seen]) > UNSEEN).any(axis=0)
    # what blocks narrow is luck of few of them
    most = np.maximum(np.diag(covariance), noise * np.diag(inverse))
    variance = np.where(lost, np.inf, most) / size**2
    return {
        g.name: Coefficient(
            g.name, float(v * g.scale), float(np.sqrt(var) * g.scale), g.unit, False, g.description
        )
        for g, v, var in zip(unknowns, z, variance, strict=False)
    }
