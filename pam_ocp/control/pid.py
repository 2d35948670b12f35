"""PID on position with feed-forward by the exact inverse; pressure loops below it (a cascade)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ..core.block import Block
from ..core.errors import InputError, require_finite, require_instance, require_positive
from ..core.stop import turns
from ..core.variables import Variable
from ..plants.inversion import Inversion
from ..plants.plant import Plant
from .blocks.draft import Draft, Symbol, as_output, compensated
from .blocks.running import ByBlock, Running, SampledLaw
from .controller import Measured
from .inverse import InverseDynamics, pressures_of, unreached, wanted_motion, wanted_stiffness
from .kinds import BLOCKS, Array
from .references import Reference

Values: TypeAlias = Mapping[str, Any]
"""Numbers or symbols by name."""


@dataclass
class PID(ByBlock):
    """u = kp e + ki integral(e) + kd d(e)/dt, the derivative filtered by ``filter_time`` [s].

    Sampled by backward differences. The integral is frozen while the caller says that the output
    is saturated and the error would drive it further the way that it points (no wind-up). A number
    in place of True says by how much what was asked for is beyond reach, where something else is
    added to the output: its sign is that way.

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

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd"):
            setattr(self, name, require_finite(f"PID.{name}", getattr(self, name)))
        self.filter_time = require_positive("PID.filter_time", self.filter_time, "s", zero=True)

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

    def __call__(self, error: float, sample_time: float, saturated: bool | float = False) -> float:
        """The output for an error, ``sample_time`` seconds after the call before."""
        law, itself = self._law, isinstance(saturated, (bool, np.bool_))
        law.parameters[:] = self.kp, self.ki, self.kd, self.filter_time
        law.tell({"error": error, "sample_time": sample_time})
        law.tell({"saturated": saturated if itself else 0, "beyond": 0 if itself else saturated})
        return float(law.step()[0])

    @turns
    def _running(self) -> Running:
        """The law of the block, told its sample time with each error."""
        draft = Draft("pid", 1.0, "PID controller")
        error, time = draft.input("error"), draft.input("sample_time")
        saturated, more = draft.input("saturated"), draft.input("beyond")
        value = pid_law(draft, self, error, lambda last: saturated * last + more, time=time)
        draft.output(Variable("command", "output"), value)
        return Running(draft.block(), ())


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
        inputs: dict[str, Any] = {}
        for rule in self._rules:
            inputs.update(rule(wanted, measured))
        return inputs

    def __call__(self, wanted: Mapping[str, float], measured: Measured) -> dict[str, float]:
        """Inputs by name for wanted pressures {muscle: Pa}."""
        inputs = {n: float(u) for n, u in self.inputs(wanted, measured).items()}
        return self.inversion.commands(inputs, measured=measured)


class PositionController(SampledLaw):
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
        require_instance("pid", pid, PID, "give a PID, such as PID(kp=1e5)")
        if not callable(reference):
            raise InputError(
                f"reference = {reference!r}: give a function of the time [s] that returns "
                "(position, velocity, acceleration)"
            )
        self.reference, self.pid = reference, pid
        if len(self.inverse.muscles) == 2 and not (stiffness is None or callable(stiffness)):
            stiffness = require_finite("stiffness", stiffness, plant.variable("stiffness").unit)
        self.stiffness, self.feedforward = stiffness, feedforward
        self.inner = inner or PressureLoop(plant)
        at = self.inverse.position, self.inverse.velocity, "acceleration"
        self._names = [f"wanted.{n}" for n in at]

    def _needed(self) -> set[str]:
        return {self.inverse.position, *(f"{m}.pressure" for m in self.inverse.muscles)}

    def wanted(self, t: float) -> dict[str, float]:
        """The position to be reached at a time [s]."""
        return {self.inverse.position: self.reference(t)[0]}

    def pressures(self, t: float, acceleration: float = 0.0) -> Array:
        """Pressures that move the believed plant along the reference, plus an acceleration."""
        at = self.reference(t if self.feedforward else 0.0)
        stiffness = self.stiffness(t) if callable(self.stiffness) else self.stiffness
        return self.inverse(at[0], at[1], at[2] + acceleration, stiffness)

    def _references(self, t: float) -> dict[str, float]:
        references = dict(zip(self._names, self.reference(t), strict=False))
        if callable(self.stiffness):
            references["wanted.stiffness"] = self.stiffness(t)
        return references


# ---- as blocks ----------------------------------------------------------------------------------
@BLOCKS.register("PID")
def pid(
    controller: PID,
    name: str = "pid",
    *,
    sample_time: float = 1e-3,
    measured: str = "measured",
    command: str = "command",
    plant: Plant | None = None,
) -> Block:
    """command = PID(wanted - measured), as :class:`PID`, on one measured value.

    sample_time : [s]. measured, command : names; of a ``plant``, which then says their units.
    """
    draft = Draft(name, sample_time, "PID controller")
    if plant is None:
        seen, sent = Variable(measured, "output"), Variable(command, "input")
    else:
        seen, sent = plant.variable(measured), plant.variable(command)
    error = draft.like(seen, "wanted.") - draft.like(seen)
    acted, limited = draft.sent([sent])[0], draft.limited
    value = pid_law(draft, controller, error, lambda last: limited * (last - acted), acted)
    draft.output(as_output(sent), value, command=True)
    return draft.block()


def pid_law(
    draft: Draft,
    controller: PID,
    error: Symbol,
    beyond: Callable[[Symbol], Symbol],
    sent: Symbol | None = None,
    time: Symbol | None = None,
) -> Symbol:
    """The PID's output for an error.

    beyond : its last output -> a number of the sign in which that went beyond what could be had, 0
    where it did not. sent : the output that acted in its place while something else was sent; the
    integral follows it. None: the integral is empty then. time : since the last one; None: the
    draft's sample time.
    """
    kp, ki, kd = (
        draft.parameter(n, getattr(controller, n), description=words)
        for n, words in (("kp", "proportional"), ("ki", "integral"), ("kd", "derivative gain"))
    )
    filter_time = draft.parameter(
        "filter_time", controller.filter_time, unit="s", min=0.0, description="of the derivative"
    )
    time = draft.sample_time if time is None else time
    integral = draft.memory("integral", description="integral of the error")
    carry = draft.memory("carry", description="what rounding took from the integral")
    slope = draft.memory("slope", description="filtered derivative of the error")
    last = draft.memory("last_error", description="error of the last step")
    started = draft.started
    share = filter_time / (filter_time + time)
    turned = share * slope + (1 - share) * (error - last) / time
    slope_now = ca.if_else(started, turned, slope)
    frozen = beyond(kp * last + ki * integral + kd * slope) * ki * error > 0
    added, left = compensated(integral, carry, error * time)
    added, left = (ca.if_else(frozen, a, b) for a, b in ((integral, added), (carry, left)))
    follow = draft.kind(0)
    if sent is not None:
        acts = ca.fabs(ki) > 0
        rest = sent - kp * error - kd * slope_now
        follow = ca.if_else(acts, rest / ca.if_else(acts, ki, 1), 0)
    now = ca.if_else(draft.active, added, follow)
    draft.next("integral", now)
    draft.next("carry", ca.if_else(draft.active, left, 0))
    draft.next("slope", slope_now)
    draft.next("last_error", error)
    return kp * error + ki * now + kd * slope_now


def out_of_reach(draft: Draft) -> Callable[[Symbol], Symbol]:
    """By how much the last acceleration was beyond what could be had, see ``pid_law``: the memory
    ``saturated``, or where the guard held a command back the output itself.
    """
    words = "acceleration asked for beyond what the pressures give"
    saturated, held_back = draft.memory("saturated", description=words), draft.held_back
    return lambda last: ca.if_else(saturated, saturated, held_back * last)


@BLOCKS.register("PositionController")
def position_controller(controller: PositionController, name: str = "position") -> Block:
    """PID on position with feed-forward by the exact inverse, as :class:`PositionController`.

    Inputs are the position, the pressures, and what is to be reached: ``wanted.POSITION``,
    ``wanted.VELOCITY``, ``wanted.acceleration`` and for a pair ``wanted.stiffness``.
    """
    c, inverse, plant = controller, controller.inverse, controller.inverse.plant
    draft = Draft(name, c.sample_time, "position controller with feed-forward", ca.MX)
    x, v, a = wanted_motion(draft, inverse, c.reference(0.0))
    stiffness = c.stiffness(0.0) if callable(c.stiffness) else c.stiffness
    inverse.require_stiffness(stiffness)
    k = wanted_stiffness(draft, plant, stiffness) if len(inverse.muscles) == 2 else None
    error = x - draft.like(plant.variable(inverse.position))
    more = pid_law(draft, c.pid, error, out_of_reach(draft))
    if not c.feedforward:
        at = c.reference(0.0)
        x, v, a = (
            draft.parameter(f"at.{n}", value)
            for n, value in zip(("position", "velocity", "acceleration"), at, strict=True)
        )
    p = pressures_of(draft, inverse, x, v, a + more, k)
    draft.next("saturated", unreached(inverse, x, v, a + more, p))
    _send(draft, c.inner, {m: p[i] for i, m in enumerate(inverse.muscles)}, plant)
    return draft.block()


def _send(draft: Draft, loop: PressureLoop, wanted: dict[str, Symbol], plant: Plant) -> None:
    measured: dict[str, Any] = {
        f"{m}.pressure": draft.like(plant.variable(f"{m}.pressure"))
        for m in wanted
        if plant.variable(f"{m}.pressure").causality == "state"
    }
    draft.drive(loop.inversion, loop.inputs(wanted, measured))


@BLOCKS.register("PressureLoop")
def pressure_loop(
    controller: PressureLoop, name: str = "pressure_loop", *, sample_time: float = 1e-3
) -> Block:
    """From wanted pressures ``wanted.MUSCLE.pressure`` to the plant's inputs.

    As :class:`PressureLoop`. sample_time : [s].
    """
    plant = controller.inversion.plant
    draft = Draft(name, sample_time, "pressure loops")
    wanted = {m: draft.like(plant.variable(f"{m}.pressure"), "wanted.") for m in controller.muscles}
    _send(draft, controller, wanted, plant)
    return draft.block()
