"""Free runs: a plant left to itself from many moments of a record, and the fit that makes them
best.

A model for prediction is judged by how far it goes astray within a horizon from the present: from
each start on it knows the measured inputs, but of the measured motion only the past. ``fit_plant``
asks another question (one motion through the whole record, its start unknown): where friction or an
unstable plant make a long motion forget its start, many short runs are what can be fitted.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...core.errors import FitError, InputError
from ...core.plausible import outside
from ...core.shown import shown
from ...core.signals import Interpolation
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array
from .between import decided
from .experiment import ParameterGroup, groups
from .rollout import ASTRAY, Rollout
from .runs import FreeRun, runs_of

__all__ = ["FreeRun", "FreeRunFit", "fit_free_run", "free_run"]


@shown
@dataclass(frozen=True, eq=False)
class FreeRunFit:
    """A plant fitted to free runs.

    plant : with the fitted values. training : its runs along the records of the fit.
    integration_error : how much halving the step changes the runs (RMS, unit of each variable).
    at_bound : free parameters that ended at the edge of their range. cost : mean squared error
    before and after, in parts of the measured variables' variance.
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
    interpolation: Interpolation = "linear"
    """How inputs count as having run between the samples of records that do not say it."""
    inputs_ran: str = ""
    """How that was decided, in words; empty where the records say it."""
    options: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """horizon, every, outputs, history and steps of the runs."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """That runs of the fit diverge; empty when none does."""
        return self.training.warnings

    def validate(self, records: Trajectory | Sequence[Trajectory]) -> FreeRun:
        """Runs of the same kind along other records; a warning says so where some diverge."""
        chosen = [records] if isinstance(records, Trajectory) else list(records)
        known = [r if r.interpolation_known else r.running(self.interpolation) for r in chosen]
        options = {**self.options, "outputs": list(self.training.names)}
        return free_run(self.plant, known, **options)

    def __str__(self) -> str:
        shown = self.plant.variable
        lines = [
            f"{self.plant.name}: {len(self.training.start)} free runs of {self.training.t[-1]:g} "
            f"s, {self.evaluations} evaluations, {self.seconds:.1f} s: {self.status}",
            *(f"    {n}: RMSE {shown(n).shown(e)}" for n, e in self.training.rmse.items()),
            *(f"    {n} = {shown(n).shown(v)}" for n, v in self.values.items()),
        ]
        if self.at_bound:
            lines.append(f"    at the edge of their range: {', '.join(self.at_bound)}")
        lines += [f"    {text}" for text in (self.inputs_ran,) if text]
        lines += [f"    warning: {text}" for text in self.warnings]
        return "\n".join(lines)


@verb
def free_run(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    *,
    horizon: float,
    every: float,
    outputs: Sequence[str] | None = None,
    history: int = 3,
    steps: int = 4,
) -> FreeRun:
    """Run a plant from many moments of records, with the measured inputs.

    A run starts every ``every`` seconds of each record, where ``history`` samples of the past and
    the whole horizon are in it. Measured states start as measured, velocities (of measured
    positions) with the slope of the straight line through the last ``history`` samples, all other
    states at the plant's start values. Nothing measured after the start is used but the inputs.

    Parameters
    ----------
    records : equally sampled Trajectories, all at the same rate, with all inputs of the plant.
    horizon, every : length of a run, and from start to start [s]; multiples of the sampling time.
    outputs : states and outputs to compare; by default all that the records hold.
    history : samples for the initial velocity, at least 2.
    steps : of the integration in each sampling interval: the Rosenbrock method ROS2 (J. G. Verwer
        et al., SIAM J. Sci. Comput. 20 (1999) 1456-1480), of second order and L-stable. Friction
        that ends a motion within one step wants more of them.

    Raises
    ------
    InputError, UnknownNameError : records without an input, of unequal rates, too short, or NaN.
    """
    runs = runs_of(plant, records, horizon, every, outputs, history, steps)
    found = runs.result(Rollout(plant, runs, []).predicted(np.empty(0)))
    for text in found.warnings:
        warnings.warn(text, RuntimeWarning, stacklevel=outside())
    return found


@verb
def fit_free_run(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]],
    *,
    horizon: float,
    every: float,
    outputs: Sequence[str] | None = None,
    history: int = 3,
    steps: int = 4,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    evaluations: int = 60,
    time_limit: float | None = None,
) -> FreeRunFit:
    """Fit parameters so that free runs (see :func:`free_run`) stay near what was measured.

    Least squares over all samples of all runs, each variable in units of its spread, by SciPy's
    trust-region method with exact derivatives. It finds the minimum nearest to the plant's values:
    friction makes several, so start from more than one.

    free : names, tuples or patterns of parameters, as for :func:`fit_plant`.
    bounds : {free parameter: (low, high)}, within those of its variable.
    evaluations : of all runs, at most. Other arguments as for :func:`free_run`. Where a record does
        not say how its inputs ran between samples, both ways are fitted and the likelier counts.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises
    ------
    InputError, UnknownNameError : arguments that cannot be.
    FitError : the runs diverge at the start, or a parameter has no influence on them.
    """
    began = time.perf_counter()
    unknowns = groups(plant, free, dict(bounds or {}))
    if not unknowns:
        raise InputError("free is empty: name at least one parameter of the plant")
    options: dict[str, Any] = {
        "horizon": horizon,
        "every": every,
        "outputs": outputs,
        "history": history,
        "steps": steps,
    }

    def fitted(ran: Sequence[Trajectory]) -> tuple[FreeRunFit, float]:
        fit = _fitted(plant, ran, unknowns, evaluations, options)
        runs = fit.training
        return fit, runs.measured.size * float(np.log(max(fit.cost[1], 1e-300)))

    runs_of(plant, records, **options)  # wrong arguments are refused before anything is tried
    chosen = [records] if isinstance(records, Trajectory) else list(records)
    fit, between, words = decided(plant, chosen, fitted)
    for text in fit.training.warnings:
        warnings.warn(text, RuntimeWarning, stacklevel=outside())
    return replace(
        fit, interpolation=between, inputs_ran=words, seconds=time.perf_counter() - began
    )


def _fitted(
    plant: Plant,
    records: Sequence[Trajectory],
    unknowns: Sequence[ParameterGroup],
    evaluations: int,
    options: dict[str, Any],
) -> FreeRunFit:
    from scipy.optimize import least_squares

    runs = runs_of(plant, records, **options)
    rollout = Rollout(plant, runs, unknowns)
    low, high = (np.array([getattr(g, a) / g.scale for g in unknowns]) for a in ("low", "high"))
    guess = np.array([g.value / g.scale for g in unknowns])
    _require_sense(rollout, guess, unknowns)
    inside = 1e-9 * (1 + np.abs(guess))
    answer = least_squares(
        rollout.residuals,
        np.clip(guess, low + inside, high - inside),
        jac=rollout.jacobian,
        bounds=(low, high),
        x_scale="jac",
        xtol=1e-6,
        ftol=1e-5,
        gtol=1e-8,
        max_nfev=evaluations,
    )
    values = {
        plant.parameters[m].name: float(z * g.scale)
        for g, z in zip(unknowns, answer.x, strict=True)
        for m in g.members
    }
    fitted = plant.with_values(values)
    training = runs.result(rollout.predicted(answer.x))
    again = {**options, "outputs": runs.names, "steps": 2 * options["steps"]}
    halved = runs_of(fitted, records, **again)
    finer = halved.result(Rollout(fitted, halved, []).predicted(np.empty(0)))
    with np.errstate(over="ignore", invalid="ignore"):
        gap = np.sqrt(np.mean((finer.predicted - training.predicted) ** 2, axis=(0, 1)))
    at_bound = [g.name for g, side in zip(unknowns, answer.active_mask, strict=True) if side]
    return FreeRunFit(
        fitted,
        training,
        values,
        tuple(at_bound),
        dict(zip(runs.names, gap.tolist(), strict=True)),
        (float(np.sum(rollout.residuals(guess) ** 2)), float(2 * answer.cost)),
        str(answer.message),
        int(answer.nfev),
        0.0,
        options=options,
    )


def _require_sense(rollout: Rollout, z: Array, unknowns: Sequence[ParameterGroup]) -> None:
    if np.any(np.abs(rollout.residuals(z)) >= 1e-3 * ASTRAY):
        raise FitError(
            "the free runs diverge at the plant's values; start elsewhere with "
            "plant.with_values(...), or raise steps"
        )
    slopes, wild = rollout.sensitivities(z)
    influence = np.abs(slopes[~wild]).max(axis=(0, 1), initial=0.0)
    dead = [g.name for g, size in zip(unknowns, influence, strict=True) if size == 0]
    if not dead:
        return
    if not wild.any():
        raise FitError(f"{', '.join(dead)} has no influence on the free runs; leave it out of free")
    raise FitError(
        f"what {', '.join(dead)} does to the free runs cannot be told: of {len(wild)} runs "
        f"{int(wild.sum())} part ways or diverge so soon that their sensitivities mean nothing, "
        "and the others do not depend on it; take a shorter horizon or more steps, or start "
        "elsewhere with plant.with_values(...)"
    )
