"""Free runs: a plant left to itself from many moments of a record, and the fit that makes them best.

A model for prediction is judged by how far it goes astray within a horizon from the present: from
each start on it knows the measured inputs, but of the measured motion only the past. ``fit_plant``
asks another question (one motion through the whole record, its start unknown): where friction or an
unstable plant make a long motion forget its start, many short runs are what can be fitted.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ..errors import FitError, InputError, require_instance, require_positive
from ..plant.plant import Plant
from ..trajectory import Trajectory
from .experiment import Group, groups, measured_names
from .statistics import Array

__all__ = ["FreeRun", "FreeRunFit", "fit_free_run", "free_run"]

GAMMA = 1 - 1 / np.sqrt(2)
"""Of the Rosenbrock method: with this value it is L-stable, so stiff friction does no harm."""
WILD = 1e3
"""A run whose sensitivity (spreads per unit of a scaled unknown) exceeds this steers no step.

It lies beside a parting of the ways (stick or slide) or is unstable: its slope holds for changes far
smaller than any step and would outweigh all other runs. Its error still counts.
"""
ASTRAY = 1e6
"""Stands for a residual that is no number: a motion that diverged is a bad one."""


@dataclass(frozen=True, eq=False)
class FreeRun:
    """Runs of a plant from many starts, beside what was measured.

    record, start : of each run (n,) the number of its record and the time where it begins [s].
    t : times since the start (K,) [s]. measured, predicted : (n, K, ny), in SI, of ``names``.
    """

    names: tuple[str, ...]
    record: Array
    start: Array
    t: Array = field(repr=False)
    measured: Array = field(repr=False)
    predicted: Array = field(repr=False)

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared error over all samples of all runs [unit of the variable]."""
        squares = np.mean((self.predicted - self.measured) ** 2, axis=(0, 1))
        return dict(zip(self.names, np.sqrt(squares).tolist(), strict=True))


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
    runs = _runs(plant, records, horizon, every, outputs, history, steps)
    return runs.result(_Rollout(plant, runs, []).predicted(np.empty(0)))


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
    runs = _runs(plant, records, horizon, every, outputs, history, steps)
    unknowns = groups(plant, free, dict(bounds or {}))
    if not unknowns:
        raise InputError("free is empty: name at least one parameter of the plant")
    rollout = _Rollout(plant, runs, unknowns)
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


# ---- the runs -----------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Runs:
    """What runs start from and are compared with.

    x0 (n, nx); inputs at the edges of all steps (n, K steps + 1, nu), of each step at its begin and
    its end; step [s].
    """

    names: tuple[str, ...]
    record: Array
    start: Array
    t: Array
    measured: Array
    x0: Array
    begin: Array
    end: Array
    step: float
    steps: int

    def result(self, predicted: Array) -> FreeRun:
        return FreeRun(self.names, self.record, self.start, self.t, self.measured, predicted)


def _runs(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    horizon: float,
    every: float,
    outputs: Sequence[str] | None,
    history: int,
    steps: int,
) -> _Runs:
    kinds = (Trajectory, list, tuple)
    require_instance(
        "records", records, kinds, "give a Trajectory (of read_record), or a list of them"
    )
    chosen = [records] if isinstance(records, Trajectory) else list(records)
    names = measured_names(plant, chosen, outputs)
    for argument, value, least in (("history", history, 2), ("steps", steps, 1)):
        if not isinstance(value, int) or value < least:
            raise InputError(f"{argument} = {value!r}: give a whole number of at least {least}")
    sampling = _sampling(chosen)
    length = _multiple("horizon", horizon, sampling)
    stride = _multiple("every", every, sampling)
    inputs = [v.name for v in plant.inputs]
    parts: list[tuple[Any, ...]] = []
    for r, record in enumerate(chosen):
        missing = [n for n in inputs if n not in record]
        if missing:
            raise InputError(f"record {r + 1} has no column for the input {missing[0]}")
        if not np.all(np.isfinite(record.array(inputs))):
            raise InputError(f"record {r + 1}: an input is not finite; cut the record there")
        first = -(-(history - 1) // stride) * stride
        for i in range(first, len(record) - length, stride):
            u = record.array(inputs)[i : i + length + 1]
            parts.append(
                (r, record.t[i], record.array(names)[i + 1 : i + length + 1],
                 _start(plant, record, i, history), *_edges(u, steps, record.interpolation))
            )  # fmt: skip
    if not parts:
        raise InputError(
            f"no record holds {history} samples and a horizon of {horizon:g} s after them; the "
            f"longest lasts {max(r.duration for r in chosen):g} s"
        )
    number, start, measured, x0, begin, end = (np.array(c, float) for c in zip(*parts, strict=True))
    t = np.asarray(sampling * np.arange(1, length + 1))
    return _Runs(tuple(names), number, start, t, measured, x0, begin, end, sampling / steps, steps)


def _sampling(records: Sequence[Trajectory]) -> float:
    """The sampling time of all records [s]."""
    usual = float(np.median(np.diff(records[0].t)))
    for r, record in enumerate(records):
        steps = np.diff(record.t)
        uneven = np.nonzero(np.abs(steps - usual) > 1e-3 * usual)[0]
        if uneven.size or not steps.size:
            where = (
                f"a step of {steps[uneven[0]]:g} s at t = {record.t[uneven[0]]:g} s"
                if uneven.size
                else "one sample"
            )
            raise InputError(
                f"record {r + 1} has {where} where {usual:g} s are usual; free runs want equal "
                "steps: resample it with record.at(...)"
            )  # fmt: skip
    return usual


def _multiple(argument: str, value: Any, sampling: float) -> int:
    number = require_positive(argument, value, "s") / sampling
    whole = round(number)
    if whole < 1 or abs(number - whole) > 1e-3 * number:
        raise InputError(
            f"{argument} = {value:g} s is no multiple of the sampling time {sampling:g} s"
        )
    return whole


def _start(plant: Plant, record: Trajectory, i: int, history: int) -> Array:
    """The states at sample i from that sample and those before."""
    values = {v.name: float(v.start or 0.0) for v in plant.states}
    past = slice(i - history + 1, i + 1)
    since = record.t[past] - record.t[past].mean()
    for position, velocity in plant.positions.items():
        if position in record:
            values[velocity] = float(since @ record[position][past] / (since @ since))
    values.update({n: float(record[n][i]) for n in values if n in record})
    return np.array([values[v.name] for v in plant.states])


def _edges(u: Array, steps: int, interpolation: str) -> tuple[Array, Array]:
    """The inputs at the begin and at the end of each step, from samples (K + 1, nu)."""
    part = np.arange(steps)[:, None] / steps
    width = 0.0 if interpolation == "previous" else 1.0
    slope = width * np.diff(u, axis=0)[:, None, :]
    begin = u[:-1, None, :] + part * slope
    end = u[:-1, None, :] + (part + 1 / steps) * slope
    shape = ((len(u) - 1) * steps, u.shape[1])
    return begin.reshape(shape), end.reshape(shape)


# ---- their motion as a function of the unknowns -----------------------------------------------------
class _Rollout:
    """Runs, residuals and their exact Jacobian in the scaled unknowns z."""

    def __init__(self, plant: Plant, runs: _Runs, unknowns: Sequence[Group]) -> None:
        self._runs = runs
        self._whole: dict[str, ca.Function] = {}
        n, k = runs.measured.shape[:2]
        spread = runs.measured.reshape(n * k, -1).std(axis=0)
        nominal = np.array([plant.variable(v).nominal for v in runs.names])
        self._spread = np.where(spread > 1e-9 * nominal, spread, nominal)
        self._nx, self._nz = len(plant.states), len(unknowns)
        self._move, self._tangent, self._read, self._slope = _functions(plant, runs, unknowns)
        self._inputs = [np.ascontiguousarray(np.concatenate(a).T) for a in (runs.begin, runs.end)]  # fmt: skip

    def predicted(self, z: Array) -> Array:
        """(n, K, ny) in SI."""
        x = self._rolled(self._move, self._runs.x0.T, z)
        return self._shaped(self._read.map(x.shape[1])(x, self._late, z))

    def residuals(self, z: Array) -> Array:
        """Predicted minus measured in units of the spread; their mean square is summed."""
        error = (self.predicted(z) - self._runs.measured) / self._spread
        return np.nan_to_num(
            error.ravel() * self._weight, nan=ASTRAY, posinf=ASTRAY, neginf=-ASTRAY
        )

    def jacobian(self, z: Array) -> Array:
        """d(residuals)/dz by sensitivities along the runs."""
        n, nx, nz = len(self._runs.x0), self._nx, self._nz
        zero = np.zeros((nx * nz, n))
        both = self._rolled(self._tangent, np.vstack([self._runs.x0.T, zero]), z)
        slopes = self._slope.map(both.shape[1])(both[:nx], both[nx:], self._late, z)
        ny = len(self._spread)
        rows = np.asarray(slopes).T.reshape(-1, nz, ny).transpose(0, 2, 1)
        scaled = (
            rows.reshape(n, -1, nz, order="C") / np.tile(self._spread, len(self._runs.t))[:, None]
        )
        wild = ~(np.abs(scaled).max(axis=(1, 2), initial=0.0) < WILD)
        scaled[wild] = 0.0
        return np.asarray(scaled.reshape(-1, nz) * self._weight)

    @property
    def _weight(self) -> float:
        return 1 / float(np.sqrt(self._runs.measured.size))

    @property
    def _late(self) -> Array:
        """The inputs at the samples."""
        return self._inputs[1][:, self._runs.steps - 1 :: self._runs.steps]

    def _rolled(self, step: ca.Function, start: Array, z: Array) -> Array:
        """The states at the samples of all runs, side by side."""
        n = start.shape[1]
        if step.name() not in self._whole:
            along = step.mapaccum(len(self._runs.t) * self._runs.steps)
            self._whole[step.name()] = along.map(n)
        found = self._whole[step.name()](start, *self._inputs, z)
        return np.asarray(np.asarray(found)[:, self._runs.steps - 1 :: self._runs.steps])

    def _shaped(self, columns: Any) -> Array:
        n, k = self._runs.measured.shape[:2]
        return np.asarray(np.asarray(columns).T.reshape(n, k, -1))


def _functions(
    plant: Plant, runs: _Runs, unknowns: Sequence[Group]
) -> tuple[ca.Function, ca.Function, ca.Function, ca.Function]:
    """One step; one step with sensitivities; what is measured; its sensitivities."""
    nx, nu, nz = len(plant.states), len(plant.inputs), len(unknowns)
    z, x, s = ca.SX.sym("z", nz), ca.SX.sym("x", nx), ca.SX.sym("s", nx, nz)
    u, late = ca.SX.sym("u", nu), ca.SX.sym("late", nu)
    p = ca.SX(plant.vector("parameter"))
    for j, group in enumerate(unknowns):
        for member in group.members:
            p[member] = z[j] * group.scale
    after = _rosenbrock(plant, x, u, late, p, runs.step)
    slopes = ca.jacobian(after, x) @ s + ca.jacobian(after, z)
    seen = ca.vertcat(*(plant.expression(name) for name in runs.names))
    y = ca.Function("seen", [plant.x, plant.u, plant.p], [seen])(x, u, p)
    y_slopes = ca.jacobian(y, x) @ s + ca.jacobian(y, z)
    column = ca.vec(s)
    return (
        ca.Function("move", [x, u, late, z], [after]),
        ca.Function("tangent", [ca.vertcat(x, column), u, late, z], [ca.vertcat(after, ca.vec(slopes))]),
        ca.Function("read", [x, u, z], [y]),
        ca.Function("slope", [x, column, u, z], [ca.densify(ca.vec(y_slopes))]),
    )  # fmt: skip


def _rosenbrock(plant: Plant, x: ca.SX, u: ca.SX, late: ca.SX, p: ca.SX, h: float) -> ca.SX:
    """The state after one step of ROS2, the inputs going from u to late.

    (I - gamma h A) k1 = f(x, u), (I - gamma h A) k2 = f(x + h k1, late) - 2 k1, A = df/dx,
    x+ = x + 3/2 h k1 + 1/2 h k2. Of second order for any A, so df/dt may be left out.
    """
    f = plant.function
    first = f(x, u, p)[0]
    matrix = ca.SX.eye(x.numel()) - GAMMA * h * ca.jacobian(first, x)
    k1 = ca.solve(matrix, first)
    k2 = ca.solve(matrix, f(x + h * k1, late, p)[0] - 2 * k1)
    return ca.SX(x + 1.5 * h * k1 + 0.5 * h * k2)


def _require_sense(rollout: _Rollout, z: Array, unknowns: Sequence[Group]) -> None:
    if np.any(np.abs(rollout.residuals(z)) >= 1e-3 * ASTRAY):
        raise FitError(
            "the free runs diverge at the plant's values; start elsewhere with "
            "plant.with_values(...), or raise steps"
        )
    influence = np.abs(rollout.jacobian(z)).max(axis=0)
    dead = [g.name for g, size in zip(unknowns, influence, strict=True) if size == 0]
    if dead:
        raise FitError(f"{', '.join(dead)} has no influence on the free runs; leave it out of free")
