"""Dynamic fit: parameters of a plant from measured records.

Parameters, initial states and the motion between the samples are sought together (H. G. Bock,
Recent advances in parameter identification techniques for ODE, 1983), so a start far from the truth
does not make the integration diverge. Intervals come from the Gauss-Newton covariance projected on
the parameters.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from ...core.errors import (
    FitError,
    InputError,
    require_count,
    require_finite,
    require_positive,
)
from ...core.stop import spared, verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array
from .estimation import (
    ORDERS,
    Asked,
    FitTask,
    NoInfluence,
    PlantEstimate,
    estimate,
    outcome,
    require_influence,
)
from .experiment import (
    ParameterGroup,
    decided,
    deviance,
    groups,
    measured_names,
    named,
    recorded,
)
from .gauss_newton import GRACE, TIMED, Progress, from_fewer, reporter
from .plant_fit import ACCURATE, PlantFit
from .rig import delay_range
from .transcribe import FitMethod

RINGING = 3.0
"""Angle [rad] by which an oscillation may turn between samples for polynomials to follow it."""
ASTRAY = 0.5
"""Error of the integration, in standard deviations of the noise, with which a fit is made anew."""
SLOW = 0.5
"""A higher degree that leaves more than this part of the error is not raised further."""
CORRECTIONS = 8
"""Of a fit by what its integration is off by, at most."""
POOR = 0.3
"""Error, in spreads of a measured variable, from which poorer fits are tried as starts."""
NARROWING = 40
"""Iterations with roundings that are not the plant's own."""
Found: TypeAlias = tuple[PlantFit, float]
"""A fit and its deviance."""


@verb
def fit_plant(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]],
    *,
    outputs: Sequence[str] | None = None,
    method: FitMethod | None = None,
    degree: int | None = None,
    step: float | None = None,
    delay: float | tuple[float, float] = 0.0,
    offsets: Sequence[str] = (),
    gains: Sequence[str] = (),
    noise: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    inputs: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    input_noise: Mapping[str, float] | None = None,
    widest: Mapping[str, float] | bool = True,
    iterations: int | None = None,
    progress: Progress = False,
    time_limit: float | None = None,
) -> PlantFit:
    """Fit parameters of a plant to measured records by least squares.

    Parameters
    ----------
    plant : any Plant; its parameter values are where the fit starts (such as those of a static
        fit).
    records : Trajectories with the measured inputs and some states or outputs; see
        :func:`read_record`. Inputs run between samples as each record says; where one does not,
        both are fitted (held, joined by lines), the likelier counts, and the report says so.
        Initial states are unknown and estimated.
    free : names of the parameters to fit. A tuple of names, or a pattern such as ``"muscle*.a1"``,
        is one unknown: these parameters are to be equal.
    outputs : the measured states and outputs to compare; by default all that the records hold.
    method : "collocation" (Radau points), "multiple-shooting" or "single-shooting" (RK4 between the
        samples; for plants that are not stiff), or "simulation" (runs of :func:`simulate`,
        compiled where there is a compiler, slopes by differences: for kinks and ringing that no
        polynomial follows between samples). By default collocation; simulation for plants with held
        memories (hysteresis) or that ring between the samples, and where collocation leads to
        nothing (neither with process nor with input noise).
    degree : of the collocation (1 to 9), or steps of RK4 in each interval; by default raised until
        the integration is off by less than 2 % of the noise.
    step : longest interval [s]; by default from sample to sample.
    delay : of the inputs [s]; (low, high) to estimate it.
    offsets, gains : measured variables whose sensor has an unknown offset, or gain.
    noise : {measured variable: standard deviation}; by default estimated from the residuals.
    bounds : {free parameter: (low, high)}.
    inputs : values of inputs that were constant and are no column.
    process_noise : {state: intensity}: white noise that disturbs the plant itself, as the standard
        deviation that the state gains in one second [its unit/sqrt(s)]. The motion is then
        smoothed: states may jump where intervals begin, and jumps are weighed against the
        measurement noise, which must be given (the most probable parameters and motion together; A.
        Jazwinski, Stochastic Processes and Filtering Theory, 1970, 5.3). Not for single shooting.
    input_noise : {measured input: standard deviation}: its samples have errors, which are estimated
        with all else and weighed against those of the outputs, whose ``noise`` must be given. An
        input that is measured with noise and taken as exact biases the parameters, damping above
        all (errors in variables; W. Fuller, Measurement Error Models, 1987).
    widest : parameters that round off a kink (friction, memory, a stop) and the widths at which the
        search begins, to narrow them to the plant's own: {name: width}; True for those that the
        plant declares, False for none.
    iterations : of the solver in each search, at most. progress : True prints each iteration; a
        function is called as progress(stage, iteration, cost).
    time_limit : [s]. Where iterations or time end, the best until then is kept and the fit's
        ``status`` and warnings say so; OutOfTime where there is none.

    Of the result ``.plant`` has the fitted values, ``.report()`` tells what the records say. Raises
    InputError, UnknownNameError (arguments that cannot be, NaN in a record), FitError (a parameter
    without influence, constant inputs that cannot tell the parameters, or no solution).

    Examples
    --------
    >>> found = pam.fit_plant(plant, record, ["mass", "damping"], outputs=["x"])
    >>> abs(found.values["mass"] - 10.0) < 0.05, found.at_bound
    (True, ())
    """
    began = time.perf_counter()
    chosen = recorded(records)
    names = measured_names(plant, chosen, outputs)
    noisy = _scattering("input_noise", input_noise, plant, "input", noise)
    ways = _ways(plant, chosen, method, bool(noisy or process_noise))
    wanted = groups(plant, free, bounds)
    if iterations is not None:
        require_count("iterations", iterations)
    late = delay_range(delay, partial(require_positive, zero=True))
    constant = {
        named("inputs", n, plant, "input").name: require_finite(n, value)
        for n, value in (inputs or {}).items()
    }
    asked = Asked(
        names,
        late if isinstance(late, tuple) else (late, late),
        {"gains": gains, "offsets": offsets},
        _process(plant, process_noise, ways[0], noise),
        _noise(plant, names, noise),
        degree,
        step,
        constant,
        noisy,
        iterations,
        reporter(progress),
    )
    if not (wanted or gains or offsets or asked.free_delay):
        raise InputError("free is empty: name at least one parameter of the plant")
    roundings = _roundings(plant, widest, wanted)

    def by(way: FitMethod, ran: Sequence[Trajectory]) -> Found:
        task = asked.task(plant, ran, wanted, way)
        # a simulation meets kinks as they are
        return _fitted(task if way == "simulation" else _narrowed(task, roundings))

    def fitted(ran: Sequence[Trajectory]) -> Found:
        first, *rest = ways
        found: Found | None = None
        try:
            found = by(first, ran)
        except FitError as error:
            if not rest or isinstance(error, NoInfluence):
                raise
        if found is None or (
            rest and found[0].status != TIMED and not found[0].integration_error < ASTRAY
        ):
            found = by(rest[0], ran)
        several = len(wanted) > 1 and not (process_noise or noisy)
        if not several or found[0].status == TIMED or not _poor(found[0]):
            return found
        return _not_worse(asked, found, ran, wanted)

    fit, between, words = decided(plant, chosen, fitted)
    seconds = time.perf_counter() - began
    return replace(fit, seconds=seconds, interpolation=between, inputs_ran=words)


def _ways(plant: Plant, records: Sequence[Trajectory], method: Any, noisy: bool) -> list[FitMethod]:
    """The methods to be tried: the one that is asked for, or what suits the plant."""
    if method is not None or noisy:
        return ["collocation" if method is None else method]
    held = any(v.memory == "held" for v in plant.states)
    jacobian = plant.jacobians(*(plant.vector(k) for k in ("state", "input", "parameter")))[0]
    poles = np.linalg.eigvals(np.nan_to_num(np.asarray(jacobian)))
    sampling = max(float(np.median(np.diff(r.t))) for r in records)
    if held or np.abs(poles.imag).max(initial=0.0) * sampling > RINGING:
        return ["simulation"]
    return ["collocation", "simulation"]


def _poor(fit: PlantFit) -> bool:
    """Whether a measured variable is met badly: there may be a better optimum."""
    spreads = {n: np.std(np.concatenate([r[n] for r in fit.records])) for n in fit.rmse}
    return any(error > POOR * spreads[n] for n, error in fit.rmse.items())


def _not_worse(
    asked: Asked, found: Found, records: Sequence[Trajectory], wanted: Sequence[ParameterGroup]
) -> Found:
    """The same, or what is found from where fits with one parameter less lead."""
    plant, way = found[0].plant, found[0].method
    start = {plant.parameters[m].name: g.value for g in wanted for m in g.members}

    def fitted(at: Plant, free: Sequence[ParameterGroup]) -> Found:
        return _fitted(asked.task(at, records, free, way))

    def without(j: int) -> Found:
        return fitted(plant.with_values(start), [g for i, g in enumerate(wanted) if i != j])

    def again(poorer: Found) -> Found:
        at = [float(v.start or 0.0) for v in poorer[0].plant.parameters]
        free = [replace(g, value=float(np.clip(at[g.members[0]], g.low, g.high))) for g in wanted]
        return fitted(poorer[0].plant, free)

    return from_fewer(found, lambda f: f[1], range(len(wanted)), without, again)


def _fitted(task: FitTask) -> Found:
    """The fit, and its deviance."""
    asked, sigma = task.asked, task.sigma
    process = bool(asked.process)
    require_influence(task, task.program(asked.delays[0]), sigma)
    found = estimate(task, sigma)
    fit = _told(task, found)
    for order in ORDERS[task.method][1:] if asked.degree is None else ():
        if found.solution.timed or (fit.integration_error < ACCURATE and not process):
            break
        before, error = found.solution.residuals, fit.integration_error
        task = task.refined(found, order)
        found = estimate(task, found.sigma, found.delay)
        fit = _told(task, found)
        if process and np.max(np.abs(found.solution.residuals - before) / sigma) < ACCURATE:
            break
        if not process and fit.integration_error > SLOW * error:
            break  # kinks between the samples: no degree meets them
    if not process:
        found, fit = _deferred(task, found, fit)
    jumps = float(np.sum(found.solution.jumps**2))
    return fit, deviance(found.solution.residuals, asked.noise) + jumps


def _told(task: FitTask, found: PlantEstimate) -> PlantFit:
    with spared(GRACE if found.solution.timed else 0.0):
        return outcome(task, found)


def _deferred(task: FitTask, found: PlantEstimate, fit: PlantFit) -> tuple[PlantEstimate, PlantFit]:
    """The estimate of the exact motion, by deferred correction: what the integration is off by is
    added to the measured values, and the fit made anew, until both agree.
    """
    exact = [e.measured for e in task.experiments]
    for _ in range(CORRECTIONS):
        if found.solution.timed or fit.integration_error < ACCURATE:
            break
        experiments = []
        for e, own, left, run in zip(
            task.experiments, exact, fit.residuals, fit.simulated, strict=True
        ):
            simulated = run.array(list(fit.measured))[-len(left) :]
            experiments.append(replace(e, measured=own + (e.measured - left) - simulated))
        moved = replace(task, experiments=experiments).refined(found, task.degree)
        again = estimate(moved, found.sigma, found.delay)
        better = _told(moved, again)
        if not better.integration_error < fit.integration_error:
            break
        task, found, fit = moved, again, better
    return found, fit


def _roundings(
    plant: Plant, given: Mapping[str, float] | bool, wanted: Sequence[ParameterGroup]
) -> dict[str, float]:
    """Widths with which the search begins, of parameters that are not sought themselves."""
    sought = {plant.parameters[m].name for g in wanted for m in g.members}
    if isinstance(given, bool):
        declared = {v.name: v.widest for v in plant.parameters if given and v.widest > 0}
        found = {n: w for n, w in declared.items() if w > float(plant.variable(n).start or 0.0)}
    else:
        found = {plant.variable(n).name: require_positive("widest", w) for n, w in given.items()}
        wrong = [n for n in found if plant.variable(n).causality != "parameter"]
        if wrong:
            raise InputError(f"widest: {wrong[0]} is no parameter of the plant")
    return {n: w for n, w in found.items() if n not in sought}


def _narrowed(task: FitTask, widths: Mapping[str, float]) -> FitTask:
    """The task, starting from what was found with wide roundings, step by step down to its own."""
    plant, asked, sigma = task.plant, task.asked, task.sigma
    few = replace(asked, noise=sigma, iterations=min(asked.iterations or NARROWING, NARROWING))
    own = {n: float(plant.variable(n).start or 0.0) for n in widths}
    delay = None
    for part in (0.0, 0.5) if widths else ():
        wide = {
            n: float(np.clip(w ** (1 - part) * max(own[n], 1e-3 * w) ** part, v.min, v.max))
            for (n, w), v in zip(widths.items(), map(plant.variable, widths), strict=True)
        }
        stage = replace(task, plant=plant.with_values(wide), asked=few)
        found = estimate(stage, sigma, delay)
        if not found.solution.found:
            break  # where this led is no better a start than the plant's own values
        delay = found.delay if asked.free_delay else None
        stage = stage.refined(found, stage.degree)
        task = replace(stage, plant=plant, asked=asked)
    return task


# ---- arguments ----------------------------------------------------------------------------------
def _process(
    plant: Plant, given: Mapping[str, float] | None, method: Any, noise: Any
) -> tuple[tuple[int, float], ...]:
    """Positions of the disturbed states, and intensities."""
    if not given:
        return ()
    if method in ("single-shooting", "simulation"):
        raise InputError(
            f"process_noise: {method.replace('-', ' ')} knows no jumps; take "
            "method='collocation' or 'multiple-shooting'"
        )
    sizes = _scattering("process_noise", given, plant, "state", noise)
    order = [v.name for v in plant.states]
    return tuple((order.index(n), size) for n, size in sizes.items())


def _scattering(
    argument: str,
    given: Mapping[str, float] | None,
    plant: Plant,
    kind: Literal["state", "input"],
    noise: Any,
) -> dict[str, float]:
    """What scatters beside the measurement, by the plant's own names."""
    if given and noise is None:
        raise InputError(
            f"{argument} needs noise={{measured variable: standard deviation}}, too: the data "
            "alone do not tell which of both scattered"
        )
    found, per = {}, "/sqrt(s)" if kind == "state" else ""
    for name, value in (given or {}).items():
        v = named(argument, name, plant, kind)
        found[v.name] = require_positive(f"{argument}[{name!r}]", value, v.unit + per)
    return found


def _noise(plant: Plant, names: Sequence[str], noise: Mapping[str, float] | None) -> Array | None:
    """Standard deviations in nominals, if they are known."""
    if noise is None:
        return None
    given = {plant.variable(n).name: require_positive(f"noise[{n!r}]", v) for n, v in noise.items()}
    missing = [n for n in names if n not in given]
    if missing:
        raise InputError(f"noise: {missing[0]} is measured too; give its standard deviation")
    return np.array([given[n] / plant.variable(n).nominal for n in names])
