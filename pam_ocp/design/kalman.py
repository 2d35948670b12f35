"""Kalman filter about a stop, and state feedback from its estimate (LQG)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..equilibrium import OperatingPoint
from ..errors import InputError, require_positive
from ..linear import linearize
from ..plant.plant import Plant, Values
from .closed_loop import Controller, Measured

__all__ = ["KalmanFilter", "WithEstimate", "kalman"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class KalmanFilter:
    """Estimate of all states from a few measured outputs, by the plant's linear model at a point.

    gain : (states, measured), stationary. In each sample: ``correct(measured)``, then
    ``predict(inputs)`` to the next one.
    """

    point: OperatingPoint
    measured: list[str]
    gain: Array
    dt: float
    system: Any = field(repr=False)
    """python-control's sampled system, x[k+1] = A x[k] + B u[k]."""

    def __post_init__(self) -> None:
        self._a, self._b, self._c, self._d = (
            np.asarray(getattr(self.system, n)) for n in ("A", "B", "C", "D")
        )
        self._y0 = np.array([self.point[n] for n in self.measured])
        self.reset()

    def reset(self) -> None:
        """Back to the point itself."""
        self.deviation: Array = np.zeros(len(self.point.x))
        self._u: Array = np.zeros(self._b.shape[1])

    def correct(self, measured: Measured) -> Array:
        """The estimated states (nx,) after a measurement."""
        y = np.array([measured[n] for n in self.measured]) - self._y0
        error = y - self._c @ self.deviation - self._d @ self._u
        self.deviation = self.deviation + self.gain @ error
        return np.asarray(self.point.x + self.deviation)

    def predict(self, inputs: Mapping[str, float]) -> None:
        """Go on to the next sample under inputs by name (kept within the plant's range)."""
        variables = self.point.plant.inputs
        u = np.array([np.clip(inputs.get(v.name, v.start or 0.0), v.min, v.max) for v in variables])
        self._u = u - self.point.u
        self.deviation = self._a @ self.deviation + self._b @ self._u


def kalman(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    measured: Mapping[str, float],
    process: float | Mapping[str, float] = 1.0,
    dt: float = 1e-3,
) -> KalmanFilter:
    """The stationary Kalman filter about a point of rest, for a sampling time ``dt`` [s].

    measured : {state or output: standard deviation of its noise [SI]}, of each sample.
    process : what drives the states besides the inputs, in units of nominal per sqrt(s): a number
        for all, or {state: value} (others 0). The mass not known well is noise on the velocity.

    By ``control.dlqe``'s Riccati equation on the exactly sampled system in units of nominal.
    Raises InputError when the states cannot be told from what is measured.
    """
    import control

    if not isinstance(at, OperatingPoint):
        at = plant.equilibrium(at)
    names = [plant.variable(n).name for n in measured]
    system = linearize(plant, at, outputs=names, dt=dt)
    nominal = plant.vector("state", attribute="nominal")
    noise = np.array([require_positive(f"measured[{n!r}]", s) for n, s in measured.items()])
    if isinstance(process, Mapping):
        given = {plant.variable(n).name: float(v) for n, v in process.items()}
        drive = np.array([given.get(v.name, 0.0) for v in plant.states])
    else:
        drive = np.full(len(nominal), require_positive("process", process))
    a = np.asarray(system.A) * nominal / nominal[:, None]
    c = np.asarray(system.C) * nominal / noise[:, None]
    try:
        gain, covariance, _ = control.dlqe(
            a, np.eye(len(a)), c, np.diag(drive**2) * dt, np.eye(len(noise))
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"kalman: the states of {plant.name!r} cannot be told from {', '.join(names)} ({error}); "
            "measure more, or add process noise"
        ) from None
    # dlqe's gain corrects the prediction for the next sample; this one corrects the present one
    p = np.asarray(covariance)
    present = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.eye(len(noise)))
    if not np.all(np.isfinite(gain)):
        raise InputError(f"kalman: no stationary filter exists for {', '.join(names)}")
    return KalmanFilter(at, names, present * nominal[:, None] / noise, dt, system)


@dataclass
class WithEstimate:
    """A controller that sees the filter's estimate in place of the states, and what is measured.

    Outputs that the filter does not measure stay visible only if named in ``also``.
    """

    controller: Controller
    filter: KalmanFilter
    also: Sequence[str] = ()

    def reset(self) -> None:
        """See :class:`Controller`."""
        self.controller.reset()
        self.filter.reset()

    def __call__(self, t: float, measured: Measured) -> Mapping[str, float]:
        """See :class:`Controller`."""
        estimate = self.filter.correct(measured)
        states = [v.name for v in self.filter.point.plant.states]
        seen = dict(zip(states, estimate.tolist(), strict=True))
        visible = [n for n in (*self.filter.measured, *self.also) if n not in seen]
        seen.update({n: measured[n] for n in visible})
        inputs = self.controller(t, seen)
        self.filter.predict(inputs)
        return inputs
