"""MovingHorizonEstimator: the states and unknowns of the last steps, fitted to all their
measurements.

At each measurement the trajectory of the window is the most probable one under the model, the noise
and the bounds (Rao, Rawlings, Mayne, IEEE Trans. Automat. Control 48, 2003); what came before the
window enters as an arrival cost carried on by the extended Kalman filter. Solved by Gauss-Newton
steps, each by a smoother of the linearised window; where that leaves the bounds, by a quadratic
program in the window's start and the noise of each step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_count, require_finite, require_positive
from ...core.stop import locked
from ...export.machine import quick
from ...numerics.buffered import Buffered
from ...numerics.solvers import Native, conic
from ...plants.plant import Plant, Values
from ...simulation.sampled import StepMethod
from ..controller import Estimate
from ..kinds import ESTIMATORS
from .extended_kalman import Estimator
from .smoother import Smoother

__all__ = ["MovingHorizonEstimator"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-9
"""Change of the window's trajectory, in units of nominal, that ends the Gauss-Newton steps."""


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

    Raises InputError for values, UnknownNameError for names that cannot be meant.

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
        self._empty()
        self._fit = Buffered(quick(self._smoothing(), compiled))
        self._look = Buffered(quick(self._measure, compiled))
        self._bounded = np.flatnonzero(np.isfinite(self._low) | np.isfinite(self._high))
        self._qp: Native | None = None

    def _empty(self) -> None:
        """A window of one node: the present."""
        nodes = self.horizon + 1
        self._prior, self._prior_covariance = self._z.copy(), self.covariance.copy()
        self._last = 0
        """Index of the present node: how many steps the window has."""
        self._real = np.zeros(nodes)
        """1 for nodes that have one behind them."""
        self._nodes: Array = np.tile(self._z[:, None], nodes)
        self._values = np.full((nodes, len(self.measured)), np.nan)
        self._controls = np.zeros((2, len(self.given.controls), nodes))
        """Of each node: when it was measured, and on the step that follows."""
        self._givens = np.tile(self._q[None, :, None], (2, 1, nodes))

    def reset(self) -> None:
        """Back to what was known at first, with an empty window."""
        super().reset()
        self._empty()

    def _narrow(self, bounds: Mapping[str, Any]) -> None:
        """Bounds of states and unknowns in units of nominal: the plant's, narrowed."""
        states = self.plant.states
        nx = len(states)
        self._low[:nx] = [v.min for v in states] / self._scale[:nx]
        self._high[:nx] = [v.max for v in states] / self._scale[:nx]
        for name, value in bounds.items():
            i = self.names.index(self._estimated(name))
            low, high = _range(name, value)
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
        self._controls[0, :, k], self._givens[0, :, k] = self._inputs(inputs), self._q
        self._values[k] = np.where(np.isfinite(seen), seen, self._values[k])
        for _ in range(self.iterations):
            if self._improve() <= TOLERANCE:
                break
        self._z = self._nodes[:, k].copy()
        return self.estimate

    def predict(self, inputs: Values | None = None) -> Estimate:
        """Go one step on, under inputs; the window moves when it is full."""
        k = self._last
        self._controls[1, :, k], self._givens[1, :, k] = self._inputs(inputs), self._q
        u = self._controls[1, :, k]
        z, self.covariance = self._after(self._nodes[:, k], u, self._q, self.covariance)
        if k == self.horizon:
            self._arrive()
            for array in (self._nodes, self._controls, self._givens):
                array[..., :-1] = array[..., 1:]
            self._values[:-1] = self._values[1:]
        self._last = k = min(k + 1, self.horizon)
        self._real[:k] = 1.0
        self._nodes[:, k] = self._z = np.clip(z, self._low, self._high)
        self._values[k] = np.nan
        return self.estimate

    @property
    def window(self) -> dict[str, Array]:
        """The fitted trajectory of the window by name [SI], oldest first, one value a step."""
        rows = self._nodes[:, : self._last + 1] * self._scale[:, None]
        return dict(zip(self.names, rows, strict=True))

    # ---- the fit --------------------------------------------------------------------------------
    def _smoothing(self) -> ca.Function:
        """(z, u and following u, y, has, real, q and following q, prior, its covariance) ->
        (changes of the nodes, covariance of the last one, and what the window is linearised to).
        """
        n, nodes = len(self.names), self.horizon + 1
        smoother = Smoother(self, nodes, self.robust, (self._predict, self._measure))
        sizes = {"z": n, "u": smoother.nu, "then": smoother.nu, "y": smoother.m, "has": smoother.m}
        sizes |= {"real": 1, "q": smoother.nq, "q_then": smoother.nq}
        columns = [ca.MX.sym(name, size, nodes) for name, size in sizes.items()]
        z, *rest = columns
        prior, p = ca.MX.sym("prior", n), ca.MX.sym("p", n * n)
        linear = smoother.linear(z, ca.horzcat(z[:, 1:], z[:, nodes - 1]), *rest)
        no_bounds = ca.MX(0, nodes)
        found = smoother.smooth(prior - z[:, 0], p, *linear, no_bounds, no_bounds)
        return ca.Function("smoothing", [*columns, prior, p], [*found, *linear])

    def _improve(self) -> float:
        """One Gauss-Newton step of the window's trajectory; returns its largest change."""
        last = self._last
        has = np.isfinite(self._values)
        u, q = self._controls, self._givens
        change, covariance, *linear = self._fit(
            *(e.T.ravel() for e in (self._nodes, u[0], u[1])),
            np.where(has, self._values, 0.0).ravel(),
            has.ravel(),
            self._real,
            *(e.T.ravel() for e in (q[0], q[1])),
            self._prior,
            self._prior_covariance.ravel(),
        )
        change = change[:, : last + 1].T
        if self._outside(change):
            change = self._constrained(change, linear)
        fitted = self._nodes[:, : last + 1] + change.T
        self._nodes[:, : last + 1] = np.clip(fitted.T, self._low, self._high).T  # rounding
        self.covariance = covariance.reshape(len(self._z), -1).copy()
        return float(np.max(np.abs(change), initial=0.0))

    def _condensed(self, linear: Sequence[Array]) -> tuple[Array, Array]:
        """Each node's change as offset + spread @ (start, noise), all unknowns of unit variance."""
        last, n = self._last, len(self._z)
        a, noise = (linear[i].T.reshape(-1, n, n)[:last].transpose(0, 2, 1) for i in (0, 2))
        roots = _root(np.concatenate([self._prior_covariance[None], noise]))
        offset, spread = np.zeros((last + 1, n)), np.zeros((last + 1, n, n * (last + 1)))
        offset[0], spread[0, :, :n] = self._prior - self._nodes[:, 0], roots[0]
        for k in range(last):
            known = n * (k + 1)
            offset[k + 1] = linear[1][:, k] + a[k] @ offset[k]
            spread[k + 1, :, :known] = a[k] @ spread[k, :, :known]
            spread[k + 1, :, known : known + n] = roots[k + 1]
        return offset, spread

    def _weights(self, residual: Array) -> Array:
        """Of squared residuals: 0 where nothing was measured, Huber's beyond the threshold."""
        size = np.abs(np.nan_to_num(residual))
        huber = np.where(size > self.robust, self.robust / np.maximum(size, 1e-300), 1.0)
        weights: Array = np.where(np.isfinite(residual), huber, 0.0)
        return weights

    def _arrive(self) -> None:
        """Carry what is known of the window's first node on to its second."""
        z, u, q = self._nodes[:, 0], self._controls[:, :, 0], self._givens[:, :, 0]
        value, _ = self._look(z, u[0], q[0])
        weight = self._weights((value.ravel() - self._values[0]) / self._noise)
        known = (self._prior, self._prior_covariance)
        mean, covariance = self._with((z, u[0], q[0]), known, self._values[0], weight)
        following, self._prior_covariance = self._after(z, u[1], q[1], covariance)
        self._prior = following + self._going.results[2] @ (mean - z)

    # ---- bounds ---------------------------------------------------------------------------------
    def _limits(self) -> tuple[Array, Array]:
        """How far bounded states and unknowns of each node may change."""
        nodes = self._nodes[self._bounded, : self._last + 1].T
        return self._low[self._bounded] - nodes, self._high[self._bounded] - nodes

    def _outside(self, change: Array) -> bool:
        low, high = self._limits()
        change = change[:, self._bounded]
        return bool(np.any(change < low - TOLERANCE) or np.any(change > high + TOLERANCE))

    def _constrained(self, free: Array, linear: Sequence[Array]) -> Array:
        """The step that keeps the bounds: a dense quadratic program by an active-set method;
        ``free`` where there is none.
        """
        nodes, n = self._last + 1, len(self._z)
        offset, spread = self._condensed(linear)
        error, variance = (linear[i][:, :nodes].T for i in (4, 5))
        slope = linear[3].T.reshape(-1, n, len(self.measured))[:nodes].transpose(0, 2, 1)
        slope = -slope / np.sqrt(variance)[:, :, None]
        residual = error / np.sqrt(variance) + np.einsum("kij,kj->ki", slope, offset)
        jacobian = (slope @ spread).reshape(residual.size, -1)
        hessian = np.eye(jacobian.shape[1]) + jacobian.T @ jacobian
        gradient = jacobian.T @ residual.ravel()
        matrix = spread[:, self._bounded].reshape(-1, len(gradient))
        start = offset[:, self._bounded].ravel()
        low, high = (e.ravel() - start for e in self._limits())
        if self._qp is None or self._qp.size1_in("a") != len(matrix):
            dense = {"h": ca.Sparsity.dense(*hessian.shape), "a": ca.Sparsity.dense(*matrix.shape)}
            self._qp = conic("window", "daqp", dense, {"error_on_fail": False})
        result = self._qp(h=hessian, g=gradient, a=matrix, lba=low, uba=high)
        found = np.asarray(result["x"]).ravel()
        if not (self._qp.stats()["success"] and np.all(np.isfinite(found))):
            return free
        change: Array = offset + spread @ found
        return change


def _root(covariance: Array) -> Array:
    """A factor G of each covariance = G G', which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return root


def _range(name: str, value: Any) -> tuple[float, float]:
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"bounds[{name!r}] = {value!r}: give (low, high)") from None
    label = f"bounds[{name!r}]"
    low = -math.inf if low is None else require_finite(label, low)
    high = math.inf if high is None else require_finite(label, high)
    if low > high:
        raise InputError(f"{label} = {value!r}: the bounds are crossed")
    return low, high
