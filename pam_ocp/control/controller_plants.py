"""Controllers as plants of their own, to be exported as FMUs: PID and state feedback."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from ..core.errors import InputError, kind_of, require_positive
from ..core.stop import verb
from ..core.variables import Variable
from ..plants.inversion import Inversion
from ..plants.plant import Plant
from .blocks.draft import clipped, sent_by
from .state_feedback import StateFeedback


@verb
def pid_controller(
    plant: Plant,
    position: str,
    weights: Mapping[str, float],
    *,
    proportional: float,
    integral: float = 0.0,
    derivative: float = 0.0,
    filter_time: float = 5e-3,
    windup_time: float = 0.1,
    name: str = "pid",
) -> Plant:
    """A PID controller with feed-forward for a plant, as a Plant of its own, to be exported.

    Each command is its feed-forward plus weight (P e + I + D), held inside the command's range,
    with e = reference - position. While a command is held, the integral runs back (anti-windup).

    Parameters
    ----------
    plant, position : what is controlled: the plant, and the name of the state or output to follow.
    weights : for each input of the plant that is commanded, how it takes part: such as
        ``{"muscle1.command": -1.0, "muscle2.command": 1.0}``.
    proportional, integral, derivative : gains, in command per unit of position, per second, times
        second.
    filter_time : time constant of the derivative's low-pass filter [s].
    windup_time : time constant with which the integral runs back while a command is held [s].

    A command of a spool valve is inverted: the feed-forward's opening plus weight (P e + I + D) is
    the opening, held in -1 .. 1, and ``<command>`` is what gives it; gains then count in openings.
    The dead zone is the tunable parameter ``<name>.valve.overlap``, and on/off valves may be named
    together, as ``muscle.opening``.

    Inputs ``reference``, ``position`` and ``feedforward.<command>``; outputs ``<command>``.

    Examples
    --------
    >>> pid = pam.control.pid_controller(plant, "x", {"muscle.command": 1.0}, proportional=2e6)
    >>> [v.name for v in pid.inputs]
    ['reference', 'position', 'feedforward.muscle.command']
    """
    filter_time = require_positive("filter_time", filter_time, "s")
    windup_time = require_positive("windup_time", windup_time, "s")
    measured = plant.variable(position)
    inversion = Inversion(plant)
    doors = {inversion.opening_of(n) or plant.variable(n).name: w for n, w in weights.items()}
    doors = {inversion.alone(n): w for n, w in doors.items()}
    commands = [inversion.variable(n) for n in doors]
    wrong = [v.name for v in commands if v.causality != "input"]
    if wrong or not commands:
        raise InputError(f"weights: give inputs of the plant, not {', '.join(wrong) or 'nothing'}")
    if len(doors) < len(weights):
        raise InputError(f"weights: {', '.join(weights)} name an opening twice")
    if 0.0 in weights.values():
        raise InputError("weights: a command of weight 0 takes no part; leave it out")
    pid = Plant(name, f"PID with feed-forward for {measured.name} of {plant.name}")
    reference = pid.input("reference", **_shown(measured, 0.0, "wanted"))
    found = pid.input("position", **_shown(measured, 0.0, "measured"))
    kp = _gain(pid, "proportional", proportional, "command per unit of position")
    ki = _gain(pid, "integral", integral, "command per unit of position and second")
    kd = _gain(pid, "derivative", derivative, "command per unit of velocity")
    tau, windup = (
        pid.parameter(n, value, unit="s", min=1e-9, tunable=True, description=words)
        for n, value, words in (
            ("filter_time", filter_time, "time constant of the derivative's filter"),
            ("windup_time", windup_time, "time constant of the integral while a command is held"),
        )
    )
    size: dict[str, Any] = {"unit": commands[0].unit, "nominal": commands[0].nominal}
    total = pid.state("integrated", **size, description="part of the integral")
    shown: dict[str, Any] = {"unit": measured.unit, "nominal": measured.nominal}
    smooth = pid.state("smoothed", **shown, description="error, low-pass filtered")
    error = reference - found
    rate = (error - smooth) / tau
    action = kp * error + total + kd * rate
    excess: ca.SX = ca.SX(0)
    valves = _Valves(pid, inversion)
    for command in commands:
        weight = float(doors[command.name])
        forward = valves.entered(
            command,
            lambda v: pid.input(
                f"feedforward.{v.name}", **_shown(v, v.start or 0.0, "feed-forward of")
            ),
        )
        wanted = forward + weight * action
        held = valves.sent(command, wanted)
        excess += (held - wanted) / (weight * len(commands))
    pid.der(smooth, rate)
    pid.der(total, ki * error + (excess / windup if integral else 0.0))
    return pid


@verb
def state_feedback_controller(
    feedback: StateFeedback,
    *,
    follow: bool = False,
    windup_time: float = 0.1,
    name: str = "state_feedback",
) -> Plant:
    """A state feedback (LQR, LQI) as a Plant of its own, to be exported.

    u = u0 - K (x - x0) - Ki z with z' = y - reference, in continuous time, each command held inside
    its range. While commands are held, the integrals run back: to z' comes Ki^+ (u - held u) / T,
    which lets u come back to its range with the time constant T where the integrals can do it
    (back-calculation; Ki^+ is the pseudo-inverse).

    Parameters
    ----------
    feedback : from :func:`pam_ocp.lqr`, about an equilibrium.
    follow : take x0 and u0 from outside, as the inputs ``reference.<state>`` and
        ``feedforward.<command>``, to follow a motion near the point; by default they are the
        tunable parameters ``point.<state>`` and ``feedforward.<command>``.
    windup_time : T, time constant with which the integrals run back [s].
    name : of the plant.

    Of a plant fed by valves u are the openings: each ``<command>`` is what gives its opening (the
    dead zone is the tunable parameter ``<name>.valve.overlap``), gains are
    ``gain.<name>.opening.<state>``, and feed-forwards are commands, of which the openings are
    taken.

    Inputs: every state of the plant, and what else is integrated (all measured), and
    ``reference.<output>`` for what is integrated. Outputs ``<command>``. All gains are tunable
    parameters ``gain.<command>.<state>`` and ``integral_gain.<command>.<output>``.

    Examples
    --------
    >>> controller = pam.control.state_feedback_controller(pam.lqr(plant, point))
    >>> [v.name for v in controller.outputs]
    ['muscle.command']
    """
    if not isinstance(feedback, StateFeedback):
        raise InputError(
            f"feedback is {kind_of(feedback)}, not a StateFeedback, such as lqr(plant, point)"
        )
    windup_time = require_positive("windup_time", windup_time, "s")
    plant, point = feedback.point.plant, feedback.point
    built = Plant(name, f"state feedback of {plant.name}")
    states = [v.name for v in plant.states]
    known = {n: plant.variable(n) for n in dict.fromkeys([*states, *feedback.integrated])}
    commands = [plant.variable(n) for n in feedback.inputs]
    from_outside: Any = built.input if follow else partial(_tunable, built)
    inversion = feedback.inversion or Inversion(plant.in_commands())
    rest = inversion.inside(point.x, inwards=False)
    here = point.values | dict(zip(states, rest.tolist(), strict=True))
    seen = {n: built.input(n, **_shown(v, here[n], "measured")) for n, v in known.items()}
    role = "reference" if follow else "point"
    origin = {n: from_outside(f"{role}.{n}", **_shown(known[n], here[n], "wanted")) for n in states}
    goal = {
        n: origin[n]
        if follow and n in origin
        else built.input(f"reference.{n}", **_shown(known[n], point[n], "wanted"))
        for n in feedback.integrated
    }
    totals = _integrals(built, feedback, commands)
    valves = _Valves(built, inversion)
    at_rest = inversion.commands({v.name: point[v.name] for v in commands}, measured=here)
    valves.states = seen
    deviation = valves.inside(seen) - valves.inside(origin)
    forward = [
        valves.entered(
            v,
            lambda c: from_outside(
                f"feedforward.{c.name}", **_shown(c, at_rest[c.name], "feed-forward of")
            ),
        )
        for v in commands
    ]
    asked = ca.vertcat(*forward) - _gains(built, "gain", commands, states, feedback.K) @ deviation
    if totals:
        gains = _gains(built, "integral_gain", commands, feedback.integrated, feedback.Ki)
        asked -= gains @ ca.vertcat(*totals)
    held = ca.vertcat(*(valves.sent(v, asked[i]) for i, v in enumerate(commands)))
    if totals:
        back = ca.DM(np.linalg.pinv(feedback.Ki)) @ (asked - held) / windup_time
        for i, n in enumerate(feedback.integrated):
            built.der(totals[i], seen[n] - goal[n] + back[i])
    return built


def _shown(variable: Variable, value: float, role: str) -> dict[str, Any]:
    """Attributes of an input or parameter that stands for a variable of the plant."""
    return {
        "start": value,
        "unit": variable.unit,
        "nominal": variable.nominal,
        "display_unit": variable.display_unit,
        "description": f"{role} {variable.name}",
    }


def _tunable(plant: Plant, name: str, *, start: float, **attributes: Any) -> ca.SX:
    return plant.parameter(name, start, tunable=True, **attributes)


def _gain(built: Plant, name: str, value: float, words: str) -> ca.SX:
    nominal = max(1.0, abs(value))
    return built.parameter(name, value, tunable=True, nominal=nominal, description=words)


def _gains(
    built: Plant, name: str, commands: list[Variable], names: list[str], values: Any
) -> ca.SX:
    """A matrix of gains as tunable parameters, a row for each command."""
    rows = [
        [
            _gain(built, f"{name}.{c.name}.{n}", float(value), f"of {n} to {c.name} [SI]")
            for n, value in zip(names, row, strict=True)
        ]
        for c, row in zip(commands, values, strict=True)
    ]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def _integrals(built: Plant, feedback: StateFeedback, commands: list[Variable]) -> list[ca.SX]:
    """A state for each integrated error; without any a clock, since an FMU here has a state.

    The nominal of an integral is what moves a command by its own nominal: tolerances count by it.
    """
    if not feedback.integrated:
        clock = built.state("clock", unit="s", description="time since the start")
        built.der(clock, 1.0)
    effect = np.abs(feedback.Ki) / np.array([[v.nominal] for v in commands])
    totals = []
    for n, most in zip(feedback.integrated, effect.max(axis=0, initial=0.0), strict=True):
        numerator, slash, rest = feedback.point.plant.variable(n).unit.partition("/")
        total = built.state(
            f"integral.{n}",
            unit=("s" if numerator == "1" else f"{numerator}.s") + slash + rest,
            nominal=1 / most if most > 0 else 1.0,
            description=f"integrated error of {n}",
        )
        totals.append(total)
    return totals


class _Valves:
    """The inversion of valves' dead zones inside a controller, with their widths as parameters."""

    def __init__(self, built: Plant, inversion: Inversion) -> None:
        self.built, self.inversion, self.plant = built, inversion, inversion.plant
        self.states: Mapping[str, ca.SX] = {}
        """The plant's, as they are measured."""

    @cached_property
    def _p(self) -> ca.SX:
        """The plant's parameters: those that openings depend on are the controller's, too."""
        openings = self.plant.openings
        parts = [e for o in openings for e in (o.forward, *o.inverse)]
        parts += [e for c in self.inversion.carried.values() for e in (c.entered, c.left)]
        used = {s.name() for s in ca.symvar(ca.vertcat(*parts))} if parts else set()
        column: list[Any] = [float(v.start or 0.0) for v in self.plant.parameters]
        for i, v in enumerate(self.plant.parameters):
            if v.name in used:
                given = {n: getattr(v, n) for n in ("unit", "min", "max", "nominal", "description")}
                column[i] = self.built.parameter(v.name, column[i], tunable=True, **given)
        return ca.SX(ca.vertcat(*column))

    def _column(self, states: Mapping[str, ca.SX]) -> ca.SX:
        """The plant's states; start values for those that nobody gives."""
        known = (states.get(v.name, v.start or 0.0) for v in self.plant.states)
        return ca.SX(ca.vertcat(*known))

    def inside(self, states: Mapping[str, ca.SX]) -> ca.SX:
        """States of the plant as they count in openings."""
        return ca.SX(self.inversion.entering()(self._column(states), self._p))

    def entered(self, door: Variable, declare: Callable[[Variable], ca.SX]) -> ca.SX:
        """What ``declare`` gives for a command; for an opening that of the commands declared."""
        opening = self.inversion.opening_of(door.name)
        if opening is None:
            return declare(door)
        names = self.inversion.commands_of(opening)
        commands = ca.vertcat(*(declare(self.plant.variable(c)) for c in names))
        forward = self.inversion.forward(opening)
        return ca.SX(forward(commands, self._p, self._column(self.states)))

    def sent(self, door: Variable, wanted: ca.SX) -> ca.SX:
        """Declare the command, or the commands of an opening, as outputs; returns what is held."""
        held: ca.SX = clipped(wanted, [door.min], [door.max])
        known = self._p, self._column(self.states)
        for command, value in sent_by(self.inversion, {door.name: held}, known):
            shown = {n: getattr(command, n) for n in ("unit", "nominal", "description")}
            self.built.output(command.name, value, **shown)
        return held
