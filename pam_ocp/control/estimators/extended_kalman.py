"""KalmanFilter: states, and unknown parameters, disturbances or offsets, from noisy measurements.

Extended Kalman filter, continuous in the model and discrete in the measurements (Jazwinski,
Stochastic Processes and Filtering Theory, 1970, ch. 8), with exact Jacobians of the integrated
step.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError, require_number, require_positive
from ...core.stop import locked
from ...core.variables import Variable
from ...export.machine import quick
from ...numerics.solvers import Buffered
from ...plants.plant import Plant, Values, require_plant
from ...simulation.sampled import StepMethod
from ..blocks.draft import Draft, Symbol, clipped
from ..controller import Estimate
from ..kinds import BLOCKS, ESTIMATORS, LARGEST, Array
from ..step import Givens, Step
from .stationary import deviations, measurements

PROCESS = 1e-2
"""Default process noise of a state, scaled by nominals, per square root of a second."""


@locked
class Estimator(ABC):
    """What every estimator of a plant has: the model's step and measurements, noise, and the start.

    Derived are :class:`KalmanFilter`, where the arguments are explained, and
    MovingHorizonEstimator.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        sample_time: float,
        measured: Mapping[str, float],
        process: Mapping[str, float] | None = None,
        unknown: Mapping[str, tuple[float, float]] | None = None,
        start: Values | None = None,
        uncertainty: Mapping[str, float] | None = None,
        method: StepMethod = "rk4",
        substeps: int | None = None,
        compiled: bool | None = False,
    ) -> None:
        require_plant(plant)
        how = Step.of(type(self).__name__, plant, sample_time, method, substeps)
        self.plant, self.given = plant, Givens(plant)
        self.sample_time = sample_time = require_positive("sample_time", sample_time, "s")
        self._control_names = [v.name for v in self.given.controls]
        self._at_rest = plant.vector("input")
        names = [v.name for v in plant.inputs]
        self._control_places = [names.index(n) for n in self._control_names]
        self.measured, self.noise = measurements(plant, measured)
        self._noise: Array = self.noise / np.array([v.nominal for v in self.measured])
        self._measured_at = {v.name: i for i, v in enumerate(self.measured)}
        self._nominal = [v.nominal for v in self.measured]
        self.unknown = [self.given.name(n) for n in unknown or {}]
        self._at = np.array([self.given.names.index(n) for n in self.unknown], dtype=int)
        nx = len(plant.states)
        self._scale = np.concatenate(
            [plant.vector("state", attribute="nominal"), self.given.nominal[self._at]]
        )
        self.names = (*(v.name for v in plant.states), *self.unknown)
        pairs = [_pair(n, v) for n, v in (unknown or {}).items()]
        spread = {v.name: v.nominal for v in plant.states}
        spread |= deviations(plant, uncertainty or {}, "uncertainty")
        drift = {v.name: PROCESS * v.nominal for v in plant.states}
        drift |= dict.fromkeys(plant.positions, 0.0) | deviations(plant, process or {}, "process")
        first = np.array([*(spread[v.name] for v in plant.states), *(a for a, _ in pairs)])
        density = np.array([*(drift[v.name] for v in plant.states), *(b for _, b in pairs)])
        self._density = np.diag((density / self._scale) ** 2)
        self.covariance: Array = np.diag((first / self._scale) ** 2)
        """Of states and unknowns, scaled by nominals."""
        self._q = self.given.vector()
        self._z = np.concatenate([plant.vector("state", start), self._q[self._at]]) / self._scale
        self._first = self._z.copy(), self.covariance.copy()
        low, high = self.given.low[self._at], self.given.high[self._at]
        self._low = np.concatenate([np.full(nx, -np.inf), low]) / self._scale
        self._high = np.concatenate([np.full(nx, np.inf), high]) / self._scale
        self._compiled = compiled
        self._functions(how)

    def _functions(self, how: Step) -> None:
        """Prediction with its Jacobian over a step and half a step,
        and measurement with its own.
        """
        plant, given, nx = self.plant, self.given, len(self.plant.states)
        z, u = ca.SX.sym("z", len(self.names)), ca.SX.sym("u", len(given.controls))
        x, unknown = ca.vertsplit(z, [0, nx, len(self.names)])  # not z[nx:]: a row if z is a scalar
        rest = ca.SX.sym("q", len(given.names))
        q = ca.SX(rest)
        for i, j in enumerate(self._at):
            q[int(j)] = unknown[i] * self._scale[nx + i]

        def after(length: float, substeps: int) -> tuple[ca.SX, ca.SX]:
            scaled = u / np.array([v.nominal for v in given.controls])
            part = replace(how, substeps=substeps)
            end, slopes = part.with_slopes(given, x, scaled, q, z, length)
            fixed = ca.jacobian(unknown, z)
            return ca.vertcat(end, unknown), ca.SX(ca.vertcat(slopes, fixed))

        # of an even number of substeps the first half is the half step
        even = how.substeps % 2 == 0
        half, to_half = after(self.sample_time / 2, how.substeps // 2 if even else how.substeps)
        if even:
            again = ca.Function("half", [z, u, rest], [half, to_half])
            whole, onward = again.call([half, u, rest])
            to_whole = onward @ to_half
        else:
            whole, to_whole = after(self.sample_time, how.substeps)
        jacobians = [to_whole, to_half]
        self._predict = ca.Function("predict", [z, u, rest], [whole, *jacobians])
        inputs, p, _ = given.parts(q, u)
        nominal = np.array([v.nominal for v in self.measured])
        seen = ca.substitute(
            [plant.expression(v.name) for v in self.measured],
            [plant.x, plant.u, plant.p],
            [x * self._scale[:nx], inputs, p],
        )
        value = ca.vertcat(*seen) / nominal
        slope = ca.densify(ca.jacobian(value, z))
        self._measure = ca.Function("measure", [z, u, rest], [value, slope])
        self._carrying((z, u, rest), (whole, *jacobians), (value, slope))

    def _carrying(
        self, point: tuple[ca.SX, ...], step: tuple[ca.SX, ...], seen: tuple[ca.SX, ca.SX]
    ) -> None:
        """Prediction and correction with the covariance, each on fixed memory."""
        n, count = len(self.names), len(self.measured)
        mean, covariance = ca.SX.sym("mean", n), ca.SX.sym("covariance", n, n)
        whole, a, half = step
        noise = self.noise_of_step(a, half)
        spread = ca.densify(mirrored(a @ covariance @ a.T + noise))
        results = [whole, spread, ca.densify(a)]
        self.going = ca.Function("going", [*point, covariance], results, {"cse": True})
        """(z, u, q, covariance) -> (z, covariance a step on, Jacobian of the step)."""
        measured, weight = ca.SX.sym("measured", count), ca.SX.sym("weight", count)
        known = taken_in(
            (mean, covariance),
            point[0],
            seen,
            measured,
            [*(self._noise**2).tolist()],
            ca.vertsplit(weight),
        )
        arguments = [*point, mean, covariance, measured, weight]
        self.taking = ca.Function("taking", arguments, [*map(ca.densify, known)], {"cse": True})
        """(z, u, q, mean, covariance, measured, weights) -> (mean, covariance), see taken_in."""
        self._going, self._taking = (
            Buffered(quick(f, self._compiled)) for f in (self.going, self.taking)
        )

    def _after(self, z: Array, u: Array, q: Array, covariance: Array) -> tuple[Array, Array]:
        """State and covariance a step on."""
        found, spread, _ = self._going(z, u, q, covariance.ravel())  # symmetric
        return found[:, 0].copy(), spread.copy()

    def _with(
        self,
        at: tuple[Array, Array, Array],
        known: tuple[Array, Array],
        seen: list[float],
        weights: list[float],
    ) -> tuple[Array, Array]:
        """Mean and covariance with measured values, the plant linearised about (z, u, q)."""
        mean, covariance = known
        found, spread = self._taking(*at, mean, covariance.ravel(), seen, weights)
        return found[:, 0].copy(), spread.copy()

    # ---- using it -------------------------------------------------------------------------------
    @property
    def deviations(self) -> dict[str, float]:
        """{measured state or output: standard deviation of its noise [SI]}."""
        return {v.name: float(s) for v, s in zip(self.measured, self.noise, strict=True)}

    def reset(self) -> None:
        """Back to what was known at first."""
        self._q = self.given.vector()
        self._z, self.covariance = (part.copy() for part in self._first)

    @property
    def estimate(self) -> Estimate:
        """The present knowledge."""
        values = dict(zip(self.names, (self._z * self._scale).tolist(), strict=True))
        deviation = (np.sqrt(self.covariance.diagonal()) * self._scale).tolist()
        unknown = {n: values.pop(n) for n in self.unknown}
        return Estimate(values, unknown, dict(zip(self.names, deviation, strict=True)))

    @abstractmethod
    def correct(self, measurement: Values, inputs: Values | None = None) -> Estimate:
        """Take measured values in, by name [SI]; what is not named, NaN or infinite is missing, and
        corrects nothing. ``inputs`` matter for outputs that depend on them.
        """

    @abstractmethod
    def predict(self, inputs: Values | None = None) -> Estimate:
        """Go one step on, under inputs (by name [SI]; start values for those not named)."""

    def _seen(self, measurement: Values) -> tuple[list[float], list[float]]:
        """Measured values scaled by nominals, and their weights: 0 for those that are missing."""
        known = self._measured_at
        seen, weights = [0.0] * len(known), [0.0] * len(known)
        for given, value in measurement.items():
            name = given if given in known else self.plant.variable(given).name
            if name not in known:
                raise UnknownNameError("measured variable", name, [*known])
            i, number = known[name], require_number(given, value)
            if abs(number) <= LARGEST:
                seen[i], weights[i] = number / self._nominal[i], 1.0
        return seen, weights

    def noise_of_step(self, a: Symbol, half: Symbol) -> Any:
        """Covariance that the noise adds in a step, from the Jacobians over it and over its half:
        Simpson's rule for the integral of exp(A s) Q exp(A s)'.
        """
        density = ca.DM(self._density)
        noise = ca.mtimes([a, density, a.T]) + 4 * ca.mtimes([half, density, half.T])
        return self.sample_time / 6 * mirrored(noise + density)

    def _inputs(self, inputs: Values | None) -> Array:
        """Controls [SI]; disturbances named among the inputs are taken as known."""
        if inputs is not None and self._only_controls(inputs):
            return np.array([inputs[n] for n in self._control_names])
        everything = self._at_rest if inputs is None else self.plant.vector("input", inputs)
        if self.given.disturbances:
            values = {v.name: everything[i] for i, v in enumerate(self.plant.inputs)}
            for variable in self.given.disturbances:
                if variable.name not in self.unknown:
                    self._q[self.given.names.index(variable.name)] = values[variable.name]
        controls: Array = everything[self._control_places]
        return controls

    def _only_controls(self, inputs: Values) -> bool:
        """Whether these are all the plant's inputs, under their full names, floats in their ranges:
        then nothing is to be looked up, and nothing to be said.
        """
        if len(inputs) != len(self._control_names) or len(self.given.disturbances):
            return False
        for variable in self.given.controls:
            value = inputs.get(variable.name)
            if not (isinstance(value, float) and variable.min <= value <= variable.max):
                return False
            if not abs(value) < math.inf:
                return False
            variable.doubt(value)
        return True


@locked
@ESTIMATORS.register("kalman")
class KalmanFilter(Estimator):
    """Extended Kalman filter of a plant.

    Parameters
    ----------
    plant : the model.
    sample_time : time between two calls of :meth:`predict` [s].
    measured : {state or output: standard deviation of its noise > 0} [SI].
    process : {state: standard deviation that unmodelled effects add per square root of a second};
        by default 1 % of nominals for states that are not named, and 0 for positions (x' = v).
    unknown : {parameter, disturbance input or "der(STATE)": (initial standard deviation, drift per
        square root of a second)}; they are estimated as random walks, and held inside their bounds.
    start : initial states by name (start values by default); the unknowns start at the plant's.
    uncertainty : {state: initial standard deviation}; by default its nominal.
    method, substeps : of the integration over a step, see Step.
    compiled : the steps as machine code. True: built if need be, some seconds for each structure,
        once; kept in the cache. None: where it is there. False: never.

    ``correct(measurement)`` takes the measurement in, ``predict(inputs)`` goes one step on. Without
    an unknown the filter is the linear Kalman filter when the plant is linear.

    Raises InputError for values, UnknownNameError for unknown names.

    Examples
    --------
    >>> filter = pam.KalmanFilter(plant, sample_time=0.01, measured={"x": 1e-4}, start=point)
    >>> seen = filter.correct({"x": 0.041})
    >>> seen.state["x"] > point["x"], sorted(seen.deviation)
    (True, ['muscle.pressure', 'v', 'x'])
    """

    def correct(self, measurement: Values, inputs: Values | None = None) -> Estimate:
        seen = self._seen(measurement)
        at, known = (self._z, self._inputs(inputs), self._q), (self._z, self.covariance)
        mean, self.covariance = self._with(at, known, *seen)
        self._z = np.clip(mean, self._low, self._high)
        return self.estimate

    def predict(self, inputs: Values | None = None) -> Estimate:
        u = self._inputs(inputs)
        self._z, self.covariance = self._after(self._z, u, self._q, self.covariance)
        return self.estimate


def _pair(name: str, value: Any) -> tuple[float, float]:
    try:
        first, drift = value
    except (TypeError, ValueError):
        raise InputError(
            f"unknown[{name!r}] = {value!r}: give (initial standard deviation, drift per sqrt(s))"
        ) from None
    label = f"unknown[{name!r}]"
    return require_positive(label, first, zero=True), require_positive(label, drift, zero=True)


def mirrored(matrix: Symbol) -> Any:
    """A symmetric matrix, its upper half from the lower one: symmetric to the last digit, too."""
    return ca.tril2symm(ca.tril(matrix))


# ---- equations -----------------------------------------------------------------------------------
def taken_in(
    known: tuple[ca.SX, ca.SX],
    at: ca.SX,
    seen: tuple[ca.SX, ca.SX],
    measured: ca.SX,
    noise: Sequence[float | ca.SX],
    weights: Sequence[ca.SX],
) -> tuple[ca.SX, ca.SX]:
    """Mean and covariance (n, n) after a measurement, from those before, ``known``.

    seen : the measurement of the model and its Jacobian (measured, n) at the state ``at``.
    noise : variances of the measured values, which are independent and so taken in one by one.
    weights : what their inverses are multiplied by; 0 for a value that is missing.
    The covariance in Joseph's form, which rounding leaves symmetric and positive (R. S. Bucy and
    P. D. Joseph, Filtering for Stochastic Processes, 1968).
    """
    mean, covariance = known
    values, slopes = seen
    eye = ca.SX.eye(mean.numel())
    for i, (variance, weight) in enumerate(zip(noise, weights, strict=True)):
        c = slopes[i, :]
        across = covariance @ c.T
        gain = across / (weight * (c @ across) + variance)
        mean = mean + weight * gain * (measured[i] - values[i] - c @ (mean - at))
        keep = eye - weight * gain @ c
        covariance = keep @ covariance @ keep.T + weight * variance * gain @ gain.T
    return mean, covariance


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("KalmanFilter")
def extended_filter(filter: KalmanFilter, name: str = "filter") -> Block:
    """The estimate of states and unknowns, as :class:`KalmanFilter`, begun anew.

    Inputs are what is measured (NaN where a value is missing) and the commands sent since the last
    step; outputs ``estimate.NAME`` and ``deviation.NAME``.
    """
    draft = Draft(name, filter.sample_time, "extended Kalman filter")
    estimated, n = estimated_variables(filter), len(filter.names)
    start_z, start_p = filter._first
    scaled_names = [f"scaled.{v.name}" for v in estimated]
    entries = [f"covariance.c{i}_{j}" for j in range(n) for i in range(n)]
    z, covariance = (
        draft.column(
            [Variable(k, "state", start=float(v)) for k, v in zip(names, start, strict=True)]
        )
        for names, start in ((scaled_names, start_z), (entries, start_p.ravel("F")))
    )
    p: Symbol = ca.reshape(covariance, n, n)
    started = draft.started
    sent = draft.sent(filter.given.controls)
    q = ca.DM(filter.given.vector())
    moved, p_moved, _ = filter.going(z, sent, q, p)
    z, p = ca.if_else(started, moved, z), ca.if_else(started, p_moved, p)
    y = draft.measured(filter.measured, missing=True)
    good = ca.fabs(y) <= LARGEST
    scaled = ca.if_else(good, y, 0) / ca.DM([v.nominal for v in filter.measured])
    mean, p = filter.taking(z, sent, q, z, p, scaled, good)
    z = clipped(mean, filter._low, filter._high)
    draft.next(scaled_names[0], z)
    draft.next(entries[0], ca.vec(p))
    for i, v in enumerate(estimated):
        draft.estimate(v, z[i] * float(filter._scale[i]))
    for i, v in enumerate(estimated):
        draft.deviation(v, ca.sqrt(ca.fmax(p[i, i], 0)) * float(filter._scale[i]))
    return draft.block()


def estimated_variables(filter: Estimator) -> list[Variable]:
    """Variables of states and unknowns; that of an offset der(STATE) is offset.STATE."""
    found = []
    for name, scale in zip(filter.names, filter._scale, strict=True):
        if name.startswith("der("):
            found.append(Variable(f"offset.{name[4:-1]}", "output", nominal=float(scale)))
        else:
            found.append(filter.plant.variable(name))
    return found
