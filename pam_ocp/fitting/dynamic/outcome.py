"""From a solution to a PlantFit: statistics of the unknowns, and simulations of the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core.signals import PiecewisePolynomial
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...simulation.compare import RecordComparison, compare_with_record
from ...simulation.simulator import simulate
from ..statistics import Array, Linearisation
from .estimation import FitTask, PlantEstimate, head_names
from .experiment import Experiment, measured_names, prepare, recorded
from .gauss_newton import reduced_jacobian, solve
from .plant_fit import PlantFit
from .transcribe import Unknowns

__all__ = ["outcome", "replay", "validate"]


def outcome(task: FitTask, estimate: PlantEstimate, delay_free: bool) -> PlantFit:
    """Statistics, fitted plant and simulations of a solution."""
    solution, sigma, plant, u = estimate.solution, estimate.sigma, task.plant, task.unknowns
    names = head_names(task, delay_free)
    count = len(names) - len(task.experiments) * len(plant.states)
    values = _values(task, estimate)
    first = len(u.groups)
    fitted = plant.with_values(
        {
            plant.parameters[m].name: float(np.clip(v, g.low, g.high))
            for g, v in zip(u.groups, values, strict=False)
            for m in g.members
        }
    )
    gains = {u.names[i]: float(v) for i, v in zip(u.gains, values[first:], strict=False)}
    offsets = {
        u.names[i]: float(v)
        for i, v in zip(u.offsets, values[first + len(u.gains) :], strict=False)
    }
    starts = _starts(plant, values[count:], len(task.experiments))
    nominal = np.array([plant.variable(n).nominal for n in u.names])
    sizes = np.cumsum([len(e.t) for e in task.experiments])[:-1]
    residuals = tuple(np.split(solution.residuals * nominal, sizes))
    simulated = (
        _smoothed(task, residuals)
        if u.process
        else tuple(
            _simulated(fitted, e, s, estimate.delay, u.names, offsets, gains)
            for e, s in zip(_corrected(task, solution.jumps), starts, strict=True)
        )
    )
    if solution.timed and not u.process:
        # the states of a search that did not end need not move as the plant does
        residuals = tuple(
            e.record.array(u.names)[-len(e.t) :] - s.array(u.names)
            for e, s in zip(task.experiments, simulated, strict=True)
        )
        solution = replace(solution, residuals=np.concatenate(residuals) / nominal)
    # of a smoothed motion the residuals are smaller than the noise, which is given then
    scatter = sigma if u.process else np.sqrt(np.mean(solution.residuals**2, axis=0))
    ended = replace(estimate, solution=solution)
    linearisation, at_bound = _linearised(task, ended, values, names, count)
    return PlantFit(
        plant=fitted,
        records=tuple(e.record for e in task.experiments),
        simulated=simulated,
        measured=tuple(u.names),
        parameters=tuple(names[:count]),
        linearisation=linearisation,
        delay=estimate.delay,
        offsets=offsets,
        gains=gains,
        starts=tuple(starts),
        noise=dict(zip(u.names, (scatter * nominal).tolist(), strict=True)),
        residuals=residuals,
        descriptions={g.name: g.description for g in u.groups},
        at_bound=at_bound,
        method=task.method,
        degree=task.degree,
        step=task.step,
        inputs=task.inputs,
        process_noise={plant.states[i].name: size for i, size in u.process},
        input_noise=task.input_noise,
        status=solution.status,
        iterations=solution.iterations,
        seconds=0.0,
    )


def _values(task: FitTask, estimate: PlantEstimate) -> Array:
    """Of all unknowns but the states along the records."""
    values = estimate.solution.w[: estimate.program.head] * estimate.program.head_scale
    first = len(task.unknowns.groups)
    values[first : first + len(task.unknowns.gains)] += 1.0
    return np.asarray(values)


def _linearised(
    task: FitTask, estimate: PlantEstimate, values: Array, names: Sequence[str], count: int
) -> tuple[Linearisation, tuple[str, ...]]:
    """The unknowns with their statistics, and which of them ended at a bound.

    count : of the unknowns before the initial states.
    """
    solution, program, sigma = estimate.solution, estimate.program, estimate.sigma
    plant, u = task.plant, task.unknowns
    jacobian = reduced_jacobian(program, 1 / sigma, solution.w)
    first = len(u.groups)
    units = [g.unit for g in u.groups] + ["1"] * len(u.gains)
    units += [plant.variable(u.names[i]).unit for i in u.offsets]
    units += ["s"] * (count - len(units))  # a free delay
    units += [v.unit for v in plant.states] * len(task.experiments)
    w, low, high = (a[: program.head] for a in (solution.w, program.low, program.high))
    tight = (w - low < 1e-6) | (high - w < 1e-6)
    tight[first:count] = False
    dof = max(solution.residuals.size - len(names) + int(tight.sum()), 0)
    squares = float(np.sum((solution.residuals / sigma) ** 2) + np.sum(solution.jumps**2))
    linearisation = Linearisation(
        names,
        values,
        units,
        jacobian / program.head_scale,
        np.sqrt(squares / max(dof, 1)),
        dof,
        np.eye(len(names))[tight] if tight.any() else None,
    )
    return linearisation, tuple(n for n, edge in zip(names, tight, strict=True) if edge)


def _corrected(task: FitTask, jumps: Array) -> list[Experiment]:
    """The records with their inputs as estimated;
    errors of inputs stand at the end of the jumps.
    """
    first = jumps.size - sum(e.errors.count for e in task.experiments if e.errors is not None)
    found = []
    for e in task.experiments:
        if e.errors is not None:
            own = jumps[first : first + e.errors.count]
            first += e.errors.count
            e = replace(e, coefficients=e.errors.added(e.coefficients, own))
        found.append(e)
    return found


def _starts(plant: Plant, values: Array, records: int) -> list[dict[str, float]]:
    rows = values.reshape(records, len(plant.states))
    return [
        {v.name: float(np.clip(x, v.min, v.max)) for v, x in zip(plant.states, row, strict=True)}
        for row in rows
    ]


def _smoothed(task: FitTask, residuals: Sequence[Array]) -> tuple[Trajectory, ...]:
    """The most probable motions, as the sensors would have shown them without noise."""
    variables = [task.plant.variable(n) for n in task.unknowns.names]
    return tuple(
        Trajectory(
            e.t, {v.name: e.measured[:, i] - r[:, i] for i, v in enumerate(variables)}, variables
        )
        for e, r in zip(task.experiments, residuals, strict=True)
    )


def _simulated(
    plant: Plant,
    experiment: Experiment,
    start: Mapping[str, float],
    delay: float,
    names: Sequence[str],
    offsets: Mapping[str, float],
    gains: Mapping[str, float],
) -> Trajectory:
    """The plant under the measured inputs, as its sensors would have shown it."""
    inputs = PiecewisePolynomial(experiment.mesh, experiment.coefficients)
    times = experiment.t - delay
    times[0] = max(times[0], experiment.mesh[0])
    grid = times if times[0] <= experiment.mesh[0] else np.concatenate([experiment.mesh[:1], times])
    run = simulate(plant, inputs, t=grid, start=start, rtol=1e-8)
    skip = len(grid) - len(times)
    columns = {n: run[n][skip:] * gains.get(n, 1.0) + offsets.get(n, 0.0) for n in names}
    return Trajectory(experiment.t, columns, [plant.variable(n) for n in names])


def replay(fit: PlantFit, record: Trajectory) -> Trajectory:
    """The fitted plant along another record, only its initial states estimated from it."""
    names = measured_names(fit.plant, [record], fit.measured)
    corrected = {
        n: (record[n] - fit.offsets.get(n, 0.0)) / fit.gains.get(n, 1.0) for n in record.names
    }
    between = record.interpolation if record.interpolation_known else fit.interpolation
    clean = Trajectory(record.t, corrected, record.variables, between)
    noisy = {n: s for n, s in fit.input_noise.items() if n in clean}
    experiment = prepare(fit.plant, clean, names, fit.delay, fit.step, fit.inputs, noisy)
    task = FitTask(fit.plant, [experiment], Unknowns([], names), fit.method, fit.degree)
    nominal = np.array([fit.plant.variable(n).nominal for n in names])
    sigma = np.maximum(np.array([fit.noise[n] for n in names]) / nominal, 1e-9)
    program = task.program(fit.delay, None)
    solution = solve(program, 1 / sigma, program.guess)
    start = _starts(fit.plant, solution.w[: program.head] * program.head_scale, 1)[0]
    (experiment,) = _corrected(task, solution.jumps)
    return _simulated(fit.plant, experiment, start, fit.delay, names, fit.offsets, fit.gains)


def validate(fit: PlantFit, records: Trajectory | Sequence[Trajectory]) -> list[RecordComparison]:
    """See :meth:`PlantFit.validate`."""
    chosen = recorded(records)
    return [compare_with_record(replay(fit, r), r, fit.measured) for r in chosen]
