"""From a solution to a PlantFit: statistics of the unknowns, and simulations of the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...simulation.compare import RecordComparison, compare_with_record
from ..statistics import Array, Linearisation
from .estimation import FitTask, PlantEstimate
from .experiment import Experiment, measured_names, prepare, recorded
from .gauss_newton import reduced_jacobian, solve
from .plant_fit import PlantFit
from .rig import Rig
from .transcribe import FitProblem, sensed, unknowns_with_starts

__all__ = ["outcome", "replay", "validate"]


def outcome(task: FitTask, estimate: PlantEstimate) -> PlantFit:
    """Statistics, fitted plant and simulations of a solution."""
    solution, sigma, problem = estimate.solution, estimate.sigma, task.problem
    plant, u, names, nominal = problem.plant, problem.unknowns, problem.measured, problem.nominal
    head = solution.w[: estimate.program.head]
    ends = [(g.low, g.high) for g in u.groups for _ in g.members]
    found = u.parameters(plant, head).items()
    fitted = plant.with_values(
        {n: float(np.clip(v, *within)) for (n, v), within in zip(found, ends, strict=True)}
    )
    rig, starts = u.rig(plant, names, Rig(), head), u.begins(plant, head)
    sizes = np.cumsum([len(e.t) for e in problem.experiments])[:-1]
    residuals = tuple(np.split(solution.residuals * nominal, sizes))
    simulated = (
        _smoothed(problem, residuals)
        if problem.process
        else tuple(
            _simulated(fitted, e, s, estimate.delay, names, rig)
            for e, s in zip(_corrected(problem, solution.jumps), starts, strict=True)
        )
    )
    if solution.timed and not problem.process:
        # the states of a search that did not end need not move as the plant does
        residuals = tuple(
            e.record.array(names)[-len(e.t) :] - s.array(names)
            for e, s in zip(problem.experiments, simulated, strict=True)
        )
        solution = replace(solution, residuals=np.concatenate(residuals) / nominal)
    # of a smoothed motion the residuals are smaller than the noise, which is given then
    scatter = sigma if problem.process else np.sqrt(np.mean(solution.residuals**2, axis=0))
    linearisation, at_bound = _linearised(problem, replace(estimate, solution=solution))
    return PlantFit(
        plant=fitted,
        records=tuple(e.record for e in problem.experiments),
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
        step=task.step,
        inputs=task.inputs,
        process_noise={plant.states[i].name: size for i, size in problem.process},
        input_noise=task.input_noise,
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
    jacobian = reduced_jacobian(program, 1 / sigma, solution.w)
    w, low, high = (a[: program.head] for a in (solution.w, program.low, program.high))
    tight = (w - low < 1e-6) | (high - w < 1e-6)
    tight[len(u.groups) : u.shared] = False
    dof = max(solution.residuals.size - len(u.names) + int(tight.sum()), 0)
    squares = float(np.sum((solution.residuals / sigma) ** 2) + np.sum(solution.jumps**2))
    values = w * u.scale
    values[u.places("gains")] += 1.0
    linearisation = Linearisation(
        list(u.names),
        values,
        list(u.units),
        jacobian / program.head_scale,
        np.sqrt(squares / max(dof, 1)),
        dof,
        np.eye(len(u.names))[tight] if tight.any() else None,
    )
    return linearisation, tuple(n for n, edge in zip(u.names, tight, strict=True) if edge)


def _corrected(problem: FitProblem, jumps: Array) -> list[Experiment]:
    """The records with their inputs as estimated;
    errors of inputs stand at the end of the jumps.
    """
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
    unknowns = unknowns_with_starts(fit.plant, [], names, [experiment])
    problem = FitProblem(fit.plant, [experiment], names, unknowns, fit.delay)
    task = FitTask(problem, fit.method, fit.degree)
    sigma = np.maximum(np.array([fit.noise[n] for n in names]) / problem.nominal, 1e-9)
    program = task.program(fit.delay)
    solution = solve(program, 1 / sigma, program.guess)
    (start,) = unknowns.begins(fit.plant, solution.w[: program.head])
    (experiment,) = _corrected(problem, solution.jumps)
    rig = Rig(gains=fit.gains, offsets=fit.offsets)
    return _simulated(fit.plant, experiment, start, fit.delay, names, rig)


def validate(fit: PlantFit, records: Trajectory | Sequence[Trajectory]) -> list[RecordComparison]:
    """See :meth:`PlantFit.validate`."""
    chosen = recorded(records)
    return [compare_with_record(replay(fit, r), r, fit.measured) for r in chosen]
