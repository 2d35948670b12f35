"""Free runs: a plant left to itself from many moments of a record, and the fit that makes them best.

A model for prediction is judged by how far it goes astray within a horizon from the present: from
each start on it knows the measured inputs, but of the measured motion only the past. ``fit_plant``
asks another question (one motion through the whole record, its start unknown): where friction or an
unstable plant make a long motion forget its start, many short runs are what can be fitted.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import FitError, InputError
from ..plant.plant import Plant
from ..trajectory import Trajectory
from .experiment import Group, groups
from .rollout import ASTRAY, Rollout
from .runs import FreeRun, runs_of
from .statistics import Array

__all__ = ["FreeRun", "FreeRunFit", "fit_free_run", "free_run"]


@dataclass(frozen=True, eq=False)
class FreeRunFit:
    """A plant fitted to free runs.

    plant : with the fitted values. training : its runs along the records of the fit.
    integration_error : how much halving the step changes the runs (RMS, unit of each variable).
    at_bound : free parameters that ended at the edge of their range. cost : mean squared error before
    and after, in parts of the measured variables' variance.
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

    def __str__(self) -> str:
        shown = self.plant.variable
        lines = [
            f"{self.plant.name}: {len(self.training.start)} free runs of {self.training.t[-1]:g} s, "
            f"{self.evaluations} evaluations, {self.seconds:.1f} s: {self.status}",
            *(f"    {n}: RMSE {shown(n).shown(e)}" for n, e in self.training.rmse.items()),
            *(f"    {n} = {shown(n).shown(v)}" for n, v in self.values.items()),
        ]
        if self.at_bound:
            lines.append(f"    at the edge of their range: {', '.join(self.at_bound)}")
        return "\n".join(lines)


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
    return runs.result(Rollout(plant, runs, []).predicted(np.empty(0)))


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
) -> FreeRunFit:
    """Fit parameters so that free runs (see :func:`free_run`) stay near what was measured.

    Least squares over all samples of all runs, each variable in units of its spread, by SciPy's
    trust-region method with exact derivatives. It finds the minimum nearest to the plant's values:
    friction makes several, so start from more than one.

    free : names, tuples or patterns of parameters, as for :func:`fit_plant`.
    bounds : {free parameter: (low, high)}, within those of its variable.
    evaluations : of all runs, at most. Other arguments as for :func:`free_run`.

    Raises
    ------
    InputError, UnknownNameError : arguments that cannot be.
    FitError : the runs diverge at the start, or a parameter has no influence on them.
    """
    from scipy.optimize import least_squares

    began = time.perf_counter()
    runs = runs_of(plant, records, horizon, every, outputs, history, steps)
    unknowns = groups(plant, free, dict(bounds or {}))
    if not unknowns:
        raise InputError("free is empty: name at least one parameter of the plant")
    rollout = Rollout(plant, runs, unknowns)
    low, high = (np.array([getattr(g, a) / g.scale for g in unknowns]) for a in ("low", "high"))
    guess = np.array([g.value / g.scale for g in unknowns])
    _require_sense(rollout, guess, unknowns)
    inside = 1e-9 * (1 + np.abs(guess))
    answer = least_squares(
        rollout.residuals, np.clip(guess, low + inside, high - inside), jac=rollout.jacobian,
        bounds=(low, high), x_scale="jac", xtol=1e-6, ftol=1e-5, gtol=1e-8, max_nfev=evaluations,
    )  # fmt: skip
    values = {
        plant.parameters[m].name: float(z * g.scale)
        for g, z in zip(unknowns, answer.x, strict=True)
        for m in g.members
    }
    fitted = plant.with_values(values)
    training = runs.result(rollout.predicted(answer.x))
    finer = free_run(
        fitted, records, horizon=horizon, every=every, outputs=runs.names, history=history, steps=2 * steps
    )  # fmt: skip
    gap = np.sqrt(np.mean((finer.predicted - training.predicted) ** 2, axis=(0, 1)))
    at_bound = [g.name for g, side in zip(unknowns, answer.active_mask, strict=True) if side]
    return FreeRunFit(
        fitted, training, values, tuple(at_bound), dict(zip(runs.names, gap.tolist(), strict=True)),
        (float(np.sum(rollout.residuals(guess) ** 2)), float(2 * answer.cost)),
        str(answer.message), int(answer.nfev), time.perf_counter() - began,
    )  # fmt: skip


def _require_sense(rollout: Rollout, z: Array, unknowns: Sequence[Group]) -> None:
    if np.any(np.abs(rollout.residuals(z)) >= 1e-3 * ASTRAY):
        raise FitError(
            "the free runs diverge at the plant's values; start elsewhere with "
            "plant.with_values(...), or raise steps"
        )
    influence = np.abs(rollout.jacobian(z)).max(axis=0)
    dead = [g.name for g, size in zip(unknowns, influence, strict=True) if size == 0]
    if dead:
        raise FitError(f"{', '.join(dead)} has no influence on the free runs; leave it out of free")
