"""Estimation: is there anything to learn, which delay, a solution as accurate as the noise asks;
and from there to a PlantFit: statistics of the unknowns, simulations of the records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...core.errors import FitError, InputError, require_count, require_positive
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...simulation.compare import RecordComparison, compare_with_record
from ..statistics import Array, Linearisation, even
from .experiment import Experiment, ParameterGroup, measured_names, prepare, recorded
from .gauss_newton import GaussNewtonResult, Report, solve
from .plant_fit import PlantFit
from .rig import Rig, unknowns_of
from .transcribe import (
    METHODS,
    FitMethod,
    FitProblem,
    Program,
    SimulatedProgram,
    sensed,
    transcribe,
)

SCANNED_DELAYS = 5
"""Delays from which the best is sought, evenly over the range."""
SCAN_ITERATIONS = 30
"""How far a wrong delay is followed."""
ORDERS = {
    "collocation": (3, 5, 7, 9),
    "multiple-shooting": (1, 2, 4, 8, 16),
    "single-shooting": (1, 2, 4, 8, 16),
    "simulation": (1,),
}
"""Degrees (or RK4 steps per interval), tried in turn until the integration is accurate enough."""
SETTLED = 0.1
"""Relative change of the noise below which a fit of one variable is not sought anew."""
BLIND = 1e-10
"""A column of the Jacobian shorter than this part of the longest has no influence."""
BLIND_BY_RUNS = 1e-5
"""The same where columns are differences of runs, which are a little off."""


class NoInfluence(FitError):
    """Parameters that nothing measured depends on: no other method finds them either."""


@dataclass(frozen=True, eq=False)
class Asked:
    """What is asked of records, whatever the plant's values and the method. delays : [s], lowest
    and highest. sensors : by argument of :func:`unknowns_of`. noise : in nominals, where it is
    known. iterations : of the solver in each search, at most.
    """

    names: Sequence[str]
    delays: tuple[float, float]
    sensors: Mapping[str, Any] = field(default_factory=dict)
    process: Sequence[tuple[int, float]] = ()
    noise: Array | None = None
    degree: int | None = None
    step: float | None = None
    inputs: Mapping[str, float] = field(default_factory=dict)
    input_noise: Mapping[str, float] = field(default_factory=dict)
    iterations: int | None = None
    report: Report | None = None

    @property
    def free_delay(self) -> bool:
        return self.delays[0] < self.delays[1]

    def task(
        self,
        plant: Plant,
        records: Sequence[Trajectory],
        wanted: Sequence[ParameterGroup],
        method: Any,
    ) -> FitTask:
        if method not in METHODS:
            raise InputError(f"method = {method!r}: choose one of {', '.join(METHODS)}")
        step = None if self.step is None else require_positive("step", self.step, "s")
        order = ORDERS[method][0] if self.degree is None else self.degree
        require_count("degree", order, 1, 9)
        low, high = self.delays
        experiments = [
            prepare(plant, r, self.names, high, step, self.inputs, self.input_noise)
            for r in records
        ]
        width = max(e.coefficients.shape[1] for e in experiments)
        if not self.input_noise:  # held and joined inputs side by side: higher powers are zero
            for i, e in enumerate(experiments):
                more = ((0, 0), (0, width - e.coefficients.shape[1]), (0, 0))
                experiments[i] = replace(e, coefficients=np.pad(e.coefficients, more))
        u, _ = unknowns_of(
            plant,
            wanted,
            self.names,
            len(experiments),
            usual(experiments),
            delay=self.delays if self.free_delay else low,
            hidden=dict(enumerate(np.array([e.states[0] for e in experiments]).T)),
            **self.sensors,
        )
        one = len(experiments) == 1
        names = [n.replace(", record 1)", ")") if one else n for n in u.names]
        unknowns = u.changed(name=names, guess=np.clip(u.guess, u.low, u.high))
        known = self.names, unknowns, low, self.process
        return FitTask(plant, experiments, *known, method, order, self)


def usual(experiments: Sequence[Experiment]) -> float:
    """Length of an interval [s]."""
    return float(np.median(np.concatenate([np.diff(e.mesh) for e in experiments])))


@dataclass(frozen=True, eq=False)
class FitTask(FitProblem):
    """A problem and how it is solved."""

    method: FitMethod
    degree: int
    asked: Asked

    @property
    def sigma(self) -> Array:
        """Standard deviations in nominals; at first a part of what each variable spreads over."""
        if self.asked.noise is not None:
            return self.asked.noise
        measured = np.concatenate([e.measured for e in self.experiments])
        spread = measured.std(axis=0) / self.nominal
        return np.asarray(np.where(spread > 0, 0.05 * spread, 1e-3))

    def program(self, delay: float, bounds: tuple[float, float] | None = None) -> Program:
        """The program at a delay, or with one that is free within bounds."""
        problem, u = self, self.unknowns
        if u.of("delays"):
            late = [r.kind == "delays" for r in u.rows]
            low, high = bounds or (delay, delay)
            columns = {
                name: np.where(late, value / u.scale, getattr(u, name))
                for name, value in (("guess", delay), ("low", low), ("high", high))
            }
            problem = replace(problem, unknowns=u.changed(**columns))
        if self.method == "simulation":
            return SimulatedProgram(problem)
        return transcribe(problem, self.method, self.degree)

    def refined(self, estimate: PlantEstimate, order: int) -> FitTask:
        """The same with another degree, starting from what an estimate found."""
        w, head = estimate.solution.w, estimate.program.head
        x_nominal = self.plant.vector("state", attribute="nominal")
        nx = len(x_nominal)
        per = nx * (self.degree if self.method == "collocation" else 1)
        inner = w[head : w.size - estimate.program.jumps]
        ends = inner.reshape(-1, per)[:, -nx:] * x_nominal  # none in single shooting
        u, first, experiments = self.unknowns, 0, []
        starts = (w[:head] * u.scale)[u.shared :].reshape(-1, nx)
        for e, start in zip(self.experiments, starts, strict=True):
            states = e.states.copy()
            states[0] = start
            if ends.size:
                states[1:] = ends[first : first + len(e.mesh) - 1]
            first += len(e.mesh) - 1
            experiments.append(replace(e, states=states))
        unknowns = u.changed(guess=np.clip(w[:head], u.low, u.high))
        return replace(self, experiments=experiments, unknowns=unknowns, degree=order)

    def solved(
        self,
        program: Program,
        weights: Array,
        guess: Array,
        stage: str,
        iterations: int | None = None,
    ) -> GaussNewtonResult:
        """A search that tells what it does, within the limit of iterations."""
        limits = (n for n in (iterations, self.asked.iterations) if n is not None)
        return solve(program, weights, guess, min(limits, default=None), self.asked.report, stage)


@dataclass(frozen=True, eq=False)
class PlantEstimate:
    """A solution with the program and the weights that it belongs to."""

    solution: GaussNewtonResult
    program: Program
    sigma: Array
    delay: float


def estimate(task: FitTask, sigma: Array, start: float | None = None) -> PlantEstimate:
    """Solve; several measured variables of unknown noise are weighed by their residuals anew."""
    solution, program, found = _seek_delay(task, sigma, start)
    for number in range(2 if task.asked.noise is None else 0):
        last, sigma = sigma, np.maximum(np.sqrt(np.mean(solution.residuals**2, axis=0)), 1e-9)
        # of one variable the size of its noise weighs nothing, but a search in units that are far
        # too coarse ends before it is there
        enough = number and np.max(np.abs(np.log(sigma / last))) < SETTLED
        if solution.timed or (enough and len(sigma) == 1):
            sigma = last
            break
        bounds = _around(task, found)
        again = program if bounds is None else task.program(found, bounds)
        weighed = task.solved(again, 1 / sigma, solution.w, "noise weighed")
        if solution.found and not weighed.found and not weighed.timed:
            sigma = last  # exact records: the rest is rounding, and weighs too much to go on
            break
        program, solution = again, weighed
        found = task.delay(solution.w)
    if not solution.found and not solution.timed and task.asked.iterations is None:
        raise FitError(
            f"the fit of {task.plant.name!r} came to no solution ({solution.status} after "
            f"{solution.iterations} iterations); start nearer with plant.with_values(...), free "
            "fewer parameters or give bounds"
        )
    return PlantEstimate(solution, program, sigma, found)


# ---- is there anything to learn ------------------------------------------------------------------
def require_influence(task: FitTask, program: Program, sigma: Array) -> None:
    """Refuse parameters that nothing measured depends on, and inputs that do not move."""
    jacobian = program.jacobian(1 / sigma, program.guess)
    names = [g.name for g in task.unknowns.groups]
    lengths = np.linalg.norm(jacobian, axis=0)
    if not np.all(np.isfinite(lengths)):
        raise FitError("the plant's start values give no finite motion; set them with with_values")
    least = (BLIND_BY_RUNS if task.method == "simulation" else BLIND) * lengths.max()
    blind = [n for n, size in zip(names, lengths, strict=False) if size <= least]
    levels = [e.coefficients[:, 0] for e in task.experiments]
    sizes = [np.abs(x).max(axis=0, initial=1.0) for x in levels]
    # no input moves by more than rounding
    still = all(np.all(np.ptp(x, axis=0) <= 1e-9 * s) for x, s in zip(levels, sizes, strict=True))
    if blind and not still:
        raise NoInfluence(
            f"{', '.join(blind)}: no influence on {', '.join(task.measured)} in these "
            "records; leave it out of free, or measure something that depends on it (in a "
            "symmetric pair an equal constant of both muscles cancels)"
        )
    if not still or not names:
        return
    _, s, vt = np.linalg.svd(even(jacobian)[0], full_matrices=False)
    lost = vt[s <= 1e-6 * s[0]]
    mixed = [n for j, n in enumerate(names) if lost.size and np.abs(lost[:, j]).max() > 1e-3]
    unknown = [n for n in names if n in blind or n in mixed]
    if unknown:
        raise NoInfluence(
            f"all inputs are constant in these records, which cannot tell {', '.join(unknown)}: "
            "move the inputs (steps, a sweep), or leave them out of free"
        )


# ---- the delay -----------------------------------------------------------------------------------
def _around(task: FitTask, delay: float) -> tuple[float, float] | None:
    """One mesh interval to either side, within the limits; None for a known delay."""
    low, high = task.asked.delays
    step = usual(task.experiments)
    return (max(low, delay - step), min(high, delay + step)) if low < high else None


def _seek_delay(
    task: FitTask, sigma: Array, start: float | None
) -> tuple[GaussNewtonResult, Program, float]:
    """Solve at a few fixed delays, then let the best one move until it stays within an interval."""
    low, high = task.asked.delays
    if low == high:
        program = task.program(low)
        return task.solved(program, 1 / sigma, program.guess, "fit"), program, low
    if start is None:
        delay, w = _scanned(task, sigma)
    else:
        delay, w = start, task.program(start).guess
    step = usual(task.experiments)
    for _ in range(int(np.ceil((high - low) / step)) + 3):
        program = task.program(delay, _around(task, delay))
        solution = task.solved(program, 1 / sigma, w, "delay", 6 * SCAN_ITERATIONS)
        w, moved = solution.w, task.delay(solution.w)
        settled = abs(moved - delay) < 0.5 * step
        delay = moved
        if settled or solution.timed:
            break
    # once more with the samples in their right intervals
    if solution.timed:
        return solution, program, delay
    program = task.program(delay, _around(task, delay))
    solution = task.solved(program, 1 / sigma, w, "fit")
    return solution, program, task.delay(solution.w)


def _scanned(task: FitTask, sigma: Array) -> tuple[float, Array]:
    """The best of a few fixed delays, followed for some iterations, and the unknowns there."""
    best: tuple[float, float, Array] | None = None
    low, high = task.asked.delays
    guess = task.program(low).guess
    for delay in np.linspace(low, high, SCANNED_DELAYS):
        program = task.program(float(delay))
        answer = task.solved(program, 1 / sigma, guess, f"delay {delay:.3g} s", SCAN_ITERATIONS)
        cost = float(np.sum((answer.residuals / sigma) ** 2))
        if best is None or cost < best[0]:
            best = (cost, float(delay), answer.w)
            guess = answer.w if answer.found else guess
        if answer.timed:
            break
    assert best is not None
    return best[1], best[2]


# ---- what comes of it -------------------------------------------------------------------------
def outcome(task: FitTask, estimate: PlantEstimate) -> PlantFit:
    """Statistics, fitted plant and simulations of a solution."""
    solution, sigma = estimate.solution, estimate.sigma
    plant, u, names, nominal = task.plant, task.unknowns, task.measured, task.nominal
    head = solution.w[: estimate.program.head]
    ends = [(g.low, g.high) for g in u.groups for _ in g.members]
    found = u.parameters(plant, head).items()
    fitted = plant.with_values(
        {n: float(np.clip(v, *within)) for (n, v), within in zip(found, ends, strict=True)}
    )
    rig, starts = u.rig(plant, names, Rig(), head), u.begins(plant, head)
    sizes = np.cumsum([len(e.t) for e in task.experiments])[:-1]
    residuals = tuple(np.split(solution.residuals * nominal, sizes))
    simulated = (
        _smoothed(task, residuals)
        if task.process
        else tuple(
            _simulated(fitted, e, s, estimate.delay, names, rig)
            for e, s in zip(_corrected(task, solution.jumps), starts, strict=True)
        )
    )
    if solution.timed and not task.process:
        # the states of a search that did not end need not move as the plant does
        residuals = tuple(
            e.record.array(names)[-len(e.t) :] - s.array(names)
            for e, s in zip(task.experiments, simulated, strict=True)
        )
        solution = replace(solution, residuals=np.concatenate(residuals) / nominal)
    # of a smoothed motion the residuals are smaller than the noise, which is given then
    scatter = sigma if task.process else np.sqrt(np.mean(solution.residuals**2, axis=0))
    linearisation, at_bound = _linearised(task, replace(estimate, solution=solution))
    return PlantFit(
        plant=fitted,
        records=tuple(e.record for e in task.experiments),
        simulated=simulated,
        measured=tuple(names),
        parameters=u.names[: u.shared],
        linearisation=linearisation,
        delay=estimate.delay,
        offsets=rig.offsets,
        gains=rig.gains,
        starts=tuple(starts),
        noise=dict(zip(names, (scatter * nominal).tolist(), strict=True)),
        residuals=residuals,
        descriptions={g.name: g.description for g in u.groups},
        at_bound=at_bound,
        method=task.method,
        degree=task.degree,
        step=task.asked.step,
        inputs=task.asked.inputs,
        process_noise={plant.states[i].name: size for i, size in task.process},
        input_noise=task.asked.input_noise,
        status=solution.status,
        iterations=solution.iterations,
        seconds=0.0,
    )


def _linearised(
    problem: FitProblem, estimate: PlantEstimate
) -> tuple[Linearisation, tuple[str, ...]]:
    """The unknowns with their statistics, and which of them ended at a bound."""
    solution, program, sigma = estimate.solution, estimate.program, estimate.sigma
    u = problem.unknowns
    jacobian = program.jacobian(1 / sigma, solution.w)
    w, low, high = (a[: program.head] for a in (solution.w, program.low, program.high))
    tight = (w - low < 1e-6) | (high - w < 1e-6)
    tight[len(u.groups) : u.shared] = False
    dof = max(solution.residuals.size - len(u.names) + int(tight.sum()), 0)
    squares = float(np.sum((solution.residuals / sigma) ** 2) + np.sum(solution.jumps**2))
    linearisation = Linearisation(
        list(u.names),
        u.values(w),
        [r.unit for r in u.rows],
        jacobian / program.head_scale,
        np.sqrt(squares / max(dof, 1)),
        dof,
        np.eye(len(u.names))[tight] if tight.any() else None,
    )
    return linearisation, tuple(n for n, edge in zip(u.names, tight, strict=True) if edge)


def _corrected(problem: FitProblem, jumps: Array) -> list[Experiment]:
    """The records with their inputs as estimated: errors of these stand at the end of the jumps."""
    first = jumps.size - sum(e.errors.count for e in problem.experiments if e.errors is not None)
    found = []
    for e in problem.experiments:
        if e.errors is not None:
            own = jumps[first : first + e.errors.count]
            first += e.errors.count
            e = replace(e, coefficients=e.errors.added(e.coefficients, own))
        found.append(e)
    return found


def _smoothed(problem: FitProblem, residuals: Sequence[Array]) -> tuple[Trajectory, ...]:
    """The most probable motions, as the sensors would have shown them without noise."""
    variables = [problem.plant.variable(n) for n in problem.measured]
    return tuple(
        Trajectory(
            e.t, {v.name: e.measured[:, i] - r[:, i] for i, v in enumerate(variables)}, variables
        )
        for e, r in zip(problem.experiments, residuals, strict=True)
    )


def _simulated(
    plant: Plant,
    experiment: Experiment,
    start: Mapping[str, float],
    delay: float,
    names: Sequence[str],
    rig: Rig,
) -> Trajectory:
    """The plant under the measured inputs, as its sensors would have shown it."""
    run = sensed(plant, experiment, start, delay, names, rig)
    columns = dict(zip(names, run.T, strict=True))
    return Trajectory(experiment.t, columns, [plant.variable(n) for n in names])


def _replay(fit: PlantFit, record: Trajectory) -> Trajectory:
    """The fitted plant along another record, only its initial states estimated from it."""
    names = measured_names(fit.plant, [record], fit.measured)
    corrected = {
        n: (record[n] - fit.offsets.get(n, 0.0)) / fit.gains.get(n, 1.0) for n in record.names
    }
    between = record.interpolation if record.interpolation_known else fit.interpolation
    clean = Trajectory(record.t, corrected, record.variables, between)
    noisy = {n: s for n, s in fit.input_noise.items() if n in clean}
    delays, step = (fit.delay, fit.delay), fit.step
    asked = Asked(names, delays, step=step, inputs=fit.inputs, input_noise=noisy)
    task = replace(asked.task(fit.plant, [clean], [], fit.method), degree=fit.degree)
    sigma = np.maximum(np.array([fit.noise[n] for n in names]) / task.nominal, 1e-9)
    program = task.program(fit.delay)
    solution = solve(program, 1 / sigma, program.guess)
    (start,) = task.unknowns.begins(fit.plant, solution.w[: program.head])
    (experiment,) = _corrected(task, solution.jumps)
    rig = Rig(gains=fit.gains, offsets=fit.offsets)
    return _simulated(fit.plant, experiment, start, fit.delay, names, rig)


def validate(fit: PlantFit, records: Trajectory | Sequence[Trajectory]) -> list[RecordComparison]:
    """See :meth:`PlantFit.validate`."""
    chosen = recorded(records)
    return [compare_with_record(_replay(fit, r), r, fit.measured) for r in chosen]
