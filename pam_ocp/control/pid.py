"""PID on position with feed-forward by the exact inverse; pressure loops below it (a cascade)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_positive
from ..plants.inversion import Inversion
from ..plants.plant import Plant
from .controller import Measured
from .inverse import InverseDynamics
from .references import Reference

__all__ = ["PID", "PositionController", "PressureLoop"]

Array: TypeAlias = NDArray[np.float64]
Values: TypeAlias = Mapping[str, Any]
"""Numbers or symbols by name."""


@dataclass
class PID:
    """u = kp e + ki integral(e) + kd d(e)/dt, the derivative filtered by ``filter_time`` [s].

    Sampled by backward differences. The integral is frozen while the caller says that the output
    is saturated and the error would drive it further (no wind-up).

    Examples
    --------
    >>> pid = pam.control.PID(kp=2.0, ki=1.0)
    >>> round(pid(0.5, 0.01), 3)
    1.005
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    filter_time: float = 2e-3
    _integral: float = field(default=0.0, repr=False)
    _slope: float = field(default=0.0, repr=False)
    _last: float | None = field(default=None, repr=False)

    @classmethod
    def placed(cls, frequency: float, damping: float = 1.0, filter_time: float = 2e-3) -> PID:
        """For a double integrator (output: an acceleration): poles -w and -w (zeta +-
        sqrt(zeta^2-1)).

        frequency : w/(2 pi) [Hz]; to be some five times below the bandwidth of what gives the
            force.
        """
        w = 2 * np.pi * require_positive("frequency", frequency, "Hz")
        z = require_positive("damping", damping)
        return cls((1 + 2 * z) * w**2, w**3, (1 + 2 * z) * w, filter_time)

    def reset(self) -> None:
        """Forget the past."""
        self._integral, self._slope, self._last = 0.0, 0.0, None

    def __call__(self, error: float, sample_time: float, saturated: bool = False) -> float:
        """The output for an error, ``sample_time`` seconds after the call before."""
        if self._last is not None:
            share = self.filter_time / (self.filter_time + sample_time)
            self._slope = share * self._slope + (1 - share) * (error - self._last) / sample_time
        self._last = error
        if not (saturated and error * self._integral > 0):
            self._integral += error * sample_time
        return self.kp * error + self.ki * self._integral + self.kd * self._slope


class PressureLoop:
    """The inner loop: from wanted pressures to the plant's inputs, whatever feeds the muscles.

    time_constant : of the closed pressure loop [s]. A ``Regulator`` gets the command
        p + lag/time_constant (p_wanted - p), which makes it as quick as that (None: p_wanted
        itself); pressures that are inputs are simply set.
    gain : opening of a valve per pressure error [1/Pa], for spool and on/off valves; the command
        that gives this opening is sent, so that the dead zone of a spool leaves no error.

    Examples
    --------
    >>> inner = pam.control.PressureLoop(plant, time_constant=0.01)
    >>> inner({"muscle": 3e5}, {**point.values, "muscle.pressure": 2.9e5})
    {'muscle.command': 340000.0}
    """

    def __init__(
        self, plant: Plant, time_constant: float | None = None, gain: float = 2e-5
    ) -> None:
        self.gain = require_positive("gain", gain, "1/Pa")
        self.inversion = Inversion(plant)
        names = {v.name: v for v in plant.variables}
        self._rules: list[Callable[[Values, Values], dict[str, Any]]] = []
        self.muscles: list[str] = []
        muscles = [n.removesuffix(".pressure") for n in names if n.endswith(".pressure")]
        for m in muscles:
            self.muscles.append(m)
            command = names.get(f"{m}.command")
            if names[f"{m}.pressure"].causality == "input":
                self._rules.append(lambda p, y, m=m: {f"{m}.pressure": p[m]})  # type: ignore[misc]
            elif command is not None and command.causality == "input" and command.unit == "Pa":
                self._rules.append(self._regulator(plant, m, time_constant))
            elif command is not None and command.causality == "input":
                self._rules.append(self._spool(m))
            elif f"{m}.fill" in names:
                self._rules.append(self._on_off(m))
            else:
                raise InputError(
                    f"PressureLoop: nothing in {plant.name!r} sets the pressure of {m}; give it a "
                    "feed"
                )

    def _regulator(
        self, plant: Plant, m: str, time_constant: float | None
    ) -> Callable[[Values, Values], dict[str, Any]]:
        ratio = 0.0
        if time_constant is not None:
            lag = float(plant.variable(f"{m}.lag").start or 0.0)
            ratio = lag / require_positive("time_constant", time_constant, "s")

        def rule(p: Values, y: Values) -> dict[str, Any]:
            now = y[f"{m}.pressure"]
            return {f"{m}.command": now + ratio * (p[m] - now) if ratio else p[m]}

        return rule

    def _spool(self, m: str) -> Callable[[Values, Values], dict[str, Any]]:
        name = self.inversion.name(f"{m}.command")  # the opening where the plant declares one
        return lambda p, y: {name: self._opening(p[m] - y[f"{m}.pressure"])}

    def _on_off(self, m: str) -> Callable[[Values, Values], dict[str, Any]]:
        def rule(p: Values, y: Values) -> dict[str, Any]:
            opening = self._opening(p[m] - y[f"{m}.pressure"])
            return {f"{m}.fill": ca.fmax(opening, 0.0), f"{m}.vent": ca.fmax(-opening, 0.0)}

        return rule

    def _opening(self, error: Any) -> Any:
        return ca.fmin(ca.fmax(self.gain * error, -1.0), 1.0)

    def inputs(self, wanted: Values, measured: Values) -> dict[str, Any]:
        """Inputs for wanted pressures {muscle: Pa}, openings as they are: numbers, or symbols."""
        found: dict[str, Any] = {}
        for rule in self._rules:
            found.update(rule(wanted, measured))
        return found

    def __call__(self, wanted: Mapping[str, float], measured: Measured) -> dict[str, float]:
        """Inputs by name for wanted pressures {muscle: Pa}."""
        inputs = {n: float(u) for n, u in self.inputs(wanted, measured).items()}
        return self.inversion.commands(inputs, measured=measured)


class PositionController:
    """Position loop: PID plus feed-forward by the exact inverse of the plant's equations.

    The PID gives an acceleration, to which the reference's is added; the inverse at the reference
    turns both (and the wanted stiffness of a pair) into pressures, an inner loop those into inputs.

    plant : what the controller believes the plant to be. reference : position, see ``references``.
    pid : in 1/s^2 per unit of position; see :meth:`PID.placed`.
    stiffness : wanted stiffness of a pair [N/m or N m/rad], a number or a function of time.
    inner : a :class:`PressureLoop`; by default one that passes commands on.
    feedforward : False leaves the reference's motion to the PID alone (for comparison).
    sample_time : sampling time [s], that of :func:`closed_loop`.

    Examples
    --------
    >>> law = pam.control.PositionController(
    ...     plant, lambda t: (0.045, 0.0, 0.0), pam.control.PID.placed(3.0), sample_time=2e-3
    ... )
    >>> loop = pam.closed_loop(law, plant, duration=2.0, start=point)
    >>> print(f"{loop['x'][-1]:.4f}")
    0.0450
    """

    def __init__(
        self,
        plant: Plant,
        reference: Reference,
        pid: PID,
        *,
        sample_time: float,
        stiffness: float | Callable[[float], float] | None = None,
        inner: PressureLoop | None = None,
        feedforward: bool = True,
    ) -> None:
        self.inverse = InverseDynamics(plant)
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.reference, self.pid = reference, pid
        self.stiffness, self.feedforward = stiffness, feedforward
        self.inner = inner or PressureLoop(plant)
        self._saturated = False

    def reset(self) -> None:
        """See :class:`Controller`."""
        self.pid.reset()
        self._saturated = False

    def wanted(self, t: float) -> dict[str, float]:
        """The position to be reached at a time [s]."""
        return {self.inverse.position: self.reference(t)[0]}

    def pressures(self, t: float, acceleration: float = 0.0) -> Array:
        """Pressures that move the believed plant along the reference, plus an acceleration."""
        at = self.reference(t if self.feedforward else 0.0)
        stiffness = self.stiffness(t) if callable(self.stiffness) else self.stiffness
        return self.inverse(at[0], at[1], at[2] + acceleration, stiffness)

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        error = self.reference(t)[0] - measured[self.inverse.position]
        p = self.pressures(t, self.pid(error, self.sample_time, self._saturated))
        self._saturated = bool(np.any((p <= self.inverse.low) | (p >= self.inverse.high)))
        return self.inner(dict(zip(self.inverse.muscles, p.tolist(), strict=True)), measured)
