"""MovingHorizonEstimator: the states and unknowns of the last steps, fitted to all their
measurements.

At each measurement the trajectory of the window is the most probable one under the model, the noise
and the bounds (Rao, Rawlings, Mayne, IEEE Trans. Automat. Control 48, 2003); what came before the
window enters as an arrival cost carried on by the extended Kalman filter. Solved by Gauss-Newton
steps, each by a smoother of the linearised window; where that leaves the bounds, by an
interior-point method whose steps are the same smoother (estimators/smoother.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import (
    InputError,
    UnknownNameError,
    require_count,
    require_ends,
    require_positive,
)
from ...core.stop import locked
from ...export.machine import quick
from ...numerics.portable import portable
from ...numerics.solvers import Buffered
from ...plants.plant import Plant, Values
from ...simulation.sampled import StepMethod
from ..blocks.draft import Draft
from ..controller import Estimate
from ..kinds import BLOCKS, ESTIMATORS, LARGEST, Array
from .extended_kalman import Estimator, estimated_variables
from .smoother import PASSES, Smoother

LEAST = 1e-12
"""Variance of an unknown that a reset keeps, in squares of nominal, at least: it can go on to move.
"""


@locked
@ESTIMATORS.register("moving-horizon")
class MovingHorizonEstimator(Estimator):
    """Moving-horizon estimation of a plant's states and unknowns.

    Parameters
    ----------
    horizon : number of steps looked back.
    bounds : {state or unknown: (low, high)} [SI], None for an open end; narrows the bounds of
        states and parameters that the plant declares, which always hold, all over the window.
    robust : residuals beyond so many standard deviations count linearly, not squared (Huber, Ann.
        Math. Statist. 35, 1964; 1.345 is usual): outliers lose their pull. None: all squared.
    iterations : at most so many Gauss-Newton steps per measurement.
    plant, sample_time, measured, process, unknown, start, uncertainty, method, substeps,
        compiled : see KalmanFilter.

    On a linear plant, without active bounds and with ``robust=None``, it is the Kalman filter.
    Measuring the same variable twice before the next :meth:`predict` replaces its value.

    Raises InputError for values, UnknownNameError for unknown names.

    Examples
    --------
    >>> estimator = pam.control.MovingHorizonEstimator(
    ...     plant, sample_time=0.01, measured={"x": 1e-4}, horizon=5, start=point
    ... )
    >>> estimator.correct({"x": 0.041}).state["x"] > point["x"]
    True
    """

    def __init__(
        self,
        plant: Plant,
        *,
        sample_time: float,
        measured: Mapping[str, float],
        horizon: int = 10,
        bounds: Mapping[str, Any] | None = None,
        robust: float | None = None,
        iterations: int = 3,
        process: Mapping[str, float] | None = None,
        unknown: Mapping[str, tuple[float, float]] | None = None,
        start: Values | None = None,
        uncertainty: Mapping[str, float] | None = None,
        method: StepMethod = "rk4",
        substeps: int | None = None,
        compiled: bool | None = False,
    ) -> None:
        require_count("horizon", horizon)
        require_count("iterations", iterations)
        super().__init__(
            plant,
            sample_time=sample_time,
            measured=measured,
            process=process,
            unknown=unknown,
            start=start,
            uncertainty=uncertainty,
            method=method,
            substeps=substeps,
            compiled=compiled,
        )
        self.horizon, self.iterations = horizon, iterations
        self.robust = math.inf if robust is None else require_positive("robust", robust)
        self._narrow(bounds or {})
        functions = self._predict, self._measure
        smoother = Smoother(self, horizon + 1, self.robust, functions, iterations)
        if compiled is False:
            smoother.unroll()
        self._fit = Buffered(quick(smoother.improve(), compiled))
        self._window()
        firsts = [rows[0] for rows in self._moving]
        known = [self._prior, self._prior_square, *firsts]
        self._arrive = Buffered(quick(smoother.arrive(), compiled), known)
        self._empty()

    def _window(self) -> None:
        """The window: memory of the Function that fits it, one row a node."""
        z, square, change, prior, prior_square, *rest = self._fit.arguments
        self._size, self._real = change, rest[4]
        """``_real``: 1 for nodes that have one behind them."""
        nodes, n = self.horizon + 1, len(self._z)
        rows = [e.reshape(nodes, len(e) // nodes) for e in (z, *rest)]
        self._nodes, *controls, self._values, self._has, _, q, q_then = rows
        self._controls, self._givens = controls, [q, q_then]
        """Of each node: when it was measured, and on the step that follows."""
        self._moving = [*rows[:5], q, q_then]
        """All that goes back by a node as the window moves."""
        self._prior, self._square, self._prior_square = prior, square.reshape(n, n), prior_square

    def _empty(self) -> None:
        """A window of one node: the present."""
        self._prior[:], self._prior_square[:] = self._z, self.covariance.ravel()
        self._last = 0
        """Index of the present node: how many steps the window has."""
        for rows in (self._real, self._values, self._has, *self._controls):
            rows[:] = 0.0
        self._nodes[:] = self._z
        for given in self._givens:
            given[:] = self._q

    def reset(self, kept: Sequence[str] = ()) -> None:
        """Back to what was known at first, with an empty window; the unknowns that are named in
        ``kept`` stay, with their deviations. Raises UnknownNameError for any other name.
        """
        names = (kept,) if isinstance(kept, str) else tuple(kept)
        for name in names:
            if name not in self.names:
                raise UnknownNameError("kept", name, self.names)
        places = [self.names.index(name) for name in names]
        known, variance = self._z[places], self.covariance.diagonal()[places]
        super().reset()
        self._z[places] = known
        self.covariance[places, places] = np.maximum(variance, LEAST)
        self._empty()

    def _narrow(self, bounds: Mapping[str, Any]) -> None:
        """Bounds of states and unknowns scaled by nominals: the plant's, narrowed."""
        states = self.plant.states
        nx = len(states)
        self._low[:nx] = [v.min for v in states] / self._scale[:nx]
        self._high[:nx] = [v.max for v in states] / self._scale[:nx]
        for name, value in bounds.items():
            i = self.names.index(self._estimated(name))
            low, high = require_ends(f"bounds[{name!r}]", value, open_ends=True)
            self._low[i] = max(self._low[i], low / self._scale[i])
            self._high[i] = min(self._high[i], high / self._scale[i])
            if self._low[i] > self._high[i]:
                raise InputError(f"bounds[{name!r}] = {value!r} leave nothing of the plant's own")

    def _estimated(self, name: str) -> str:
        """The full name of a state or unknown."""
        full = name if name in self.names else self.plant.variable(name).name
        if full not in self.names:
            raise InputError(
                f"bounds: {full} is not estimated; give one of {', '.join(self.names)}"
            )
        return full

    # ---- using it -------------------------------------------------------------------------------
    def correct(self, measurement: Values, inputs: Values | None = None) -> Estimate:
        """Take measured values in, by name [SI], and fit the window anew."""
        k, seen = self._last, self._seen(measurement)
        self._controls[0][k], self._givens[0][k] = self._inputs(inputs), self._q
        for i, weight in enumerate(seen[1]):
            if weight:
                self._values[k, i], self._has[k, i] = seen[0][i], 1.0
        self._nodes[k + 1 :] = self._nodes[k]  # they stand still
        self._square[:], self._size[0] = self.covariance, 1.0
        self._fit.call()
        nodes, covariance, _ = self._fit.results
        self._nodes[:] = nodes.T
        self.covariance = covariance.reshape(self._square.shape).copy()
        self._z = self._nodes[k].copy()
        return self.estimate

    def predict(self, inputs: Values | None = None) -> Estimate:
        """Go one step on, under inputs; the window moves when it is full."""
        k = self._last
        u = self._controls[1][k] = self._inputs(inputs)
        self._givens[1][k] = self._q
        z, self.covariance = self._after(self._nodes[k], u, self._q, self.covariance)
        if k == self.horizon:
            self._forget()
            for rows in self._moving:
                rows[:-1] = rows[1:]
        self._last = k = min(k + 1, self.horizon)
        self._real[:k] = 1.0
        self._z = np.maximum(np.minimum(z, self._high), self._low)
        self._nodes[k] = self._z
        self._values[k] = self._has[k] = 0.0
        return self.estimate

    @property
    def window(self) -> dict[str, Array]:
        """The fitted trajectory of the window by name [SI], oldest first, one value a step."""
        rows = self._nodes[: self._last + 1].T * self._scale[:, None]
        return dict(zip(self.names, rows, strict=True))

    def _forget(self) -> None:
        """Carry what is known of the window's first node on to its second."""
        self._arrive.call()
        prior, covariance = self._arrive.results
        self._prior[:], self._prior_square[:] = prior[:, 0], covariance[:, 0]


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("MovingHorizonEstimator")
def moving_horizon(filter: MovingHorizonEstimator, name: str = "estimator") -> Block:
    """The estimate of states and unknowns, as :class:`MovingHorizonEstimator`, begun anew.

    Inputs are what is measured (NaN where a value is missing) and the commands sent since the last
    step; outputs ``estimate.NAME`` and ``deviation.NAME``. Memory is the window.
    """
    given, functions = ca.DM(filter.given.vector()), (filter._predict, filter._measure)
    low, high = ca.DM(filter._low), ca.DM(filter._high)
    window = Smoother(
        filter,
        filter.horizon + 1,
        filter.robust,
        (portable(functions[0]), portable(functions[1])),
        filter.iterations,
        given,
    )
    n, m, nodes, controls = window.n, window.m, window.nodes, filter.given.controls
    words = f"moving-horizon estimator, {filter.horizon} steps"
    draft = Draft(name, filter.sample_time, words, ca.MX)
    measured = draft.measured(filter.measured, missing=True)
    sent = draft.sent(controls)
    first_z, first_p = filter._first
    starts = {
        "nodes": np.tile(first_z, nodes),
        "values": np.zeros(m * nodes),
        "present": np.zeros(m * nodes),
        "controls": np.zeros(len(controls) * nodes),
        "prior": first_z,
        "covariance": first_p.ravel(),
        "counts": np.zeros(2),
    }
    *rows, prior, p, counts = (
        draft.memories(start, f"{part} of the window", f"{part}.w")
        for part, start in starts.items()
    )
    z, y, has, u = (ca.reshape(e, -1, nodes) for e in rows)
    started, count = ca.vertsplit(counts)
    good = ca.fabs(measured) <= LARGEST
    value = ca.if_else(good, measured, 0) / ca.DM([v.nominal for v in filter.measured])

    # one step on, where there was one before
    oldest = [z[:, 0], u[:, 0], u[:, 1], y[:, 0], has[:, 0]]
    following, onward = window.arrive()(prior, p, *oldest)
    full = ca.logic_and(started, count >= filter.horizon)
    prior, p = (ca.if_else(full, a, b) for a, b in ((following, prior), (onward, p)))
    after = window.predict(z[:, nodes - 1], sent, given)[0]
    after = ca.fmax(ca.fmin(after, high), low)
    z = ca.if_else(started, ca.horzcat(z[:, 1:], after), z)
    y, has, u = (
        ca.horzcat(ca.if_else(started, old[:, 1:], old[:, : nodes - 1]), new)
        for old, new in ((y, value), (has, good), (u, sent))
    )
    count = ca.fmin(ca.if_else(started, count + 1, 0), filter.horizon)
    real = count >= filter.horizon - ca.DM(range(nodes)).T
    has = has * ca.repmat(real, m, 1)

    then = ca.horzcat(u[:, 1:], u[:, nodes - 1])
    begun = [z, ca.MX.zeros(n * n), ca.MX(ca.DM(1.0))]
    z, covariance, _ = window.improve()(*begun, prior, p, u, then, y, has, real)
    scale = ca.DM(filter._scale)
    square = ca.diag(ca.reshape(covariance, n, n))
    deviation = ca.sqrt(ca.fmax(square, 0)) * scale
    kept = [ca.vec(e) for e in (z, y, has, u)] + [prior, p, ca.vertcat(1, count)]
    for part, value in zip(starts, kept, strict=True):
        draft.next(f"{part}.w1", ca.densify(value))
    for i, v in enumerate(estimated_variables(filter)):
        draft.estimate(v, z[i, nodes - 1] * scale[i])
    for i, v in enumerate(estimated_variables(filter)):
        draft.deviation(v, deviation[i])
    draft.repeats("Gauss-Newton steps", filter.iterations)
    if window.sides:
        draft.repeats("passes of the smoother", filter.iterations * (PASSES + 1))
    return draft.block()
