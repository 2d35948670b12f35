"""Controllers as plants of their own, to be exported as FMUs: PID and state feedback."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from pam_ocp.design.lqr import StateFeedback
from pam_ocp.errors import InputError, require_positive
from pam_ocp.plant.plant import Plant
from pam_ocp.variables import Variable

__all__ = ["pid_controller", "state_feedback_controller"]


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

    Each command is its feed-forward plus weight (P e + I + D), held inside the command's range, with
    e = reference - position. While a command is held, the integral runs back (anti-windup).

    Parameters
    ----------
    plant, position : what is controlled: the plant, and the name of the state or output to follow.
    weights : for each input of the plant that is commanded, how it takes part: such as
        ``{"muscle1.command": -1.0, "muscle2.command": 1.0}``.
    proportional, integral, derivative : gains, in command per unit of position, per second, times
        second.
    filter_time : time constant of the derivative's low-pass filter [s].
    windup_time : time constant with which the integral runs back while a command is held [s].

    Inputs ``reference``, ``position`` and ``feedforward.<command>``; outputs ``<command>``.
    """
    require_positive("filter_time", filter_time, "s")
    require_positive("windup_time", windup_time, "s")
    measured = plant.variable(position)
    commands = [plant.variable(n) for n in weights]
    wrong = [v.name for v in commands if v.causality != "input"]
    if wrong or not commands:
        raise InputError(f"weights: give inputs of the plant, not {', '.join(wrong) or 'nothing'}")
    if 0.0 in weights.values():
        raise InputError("weights: a command of weight 0 takes no part; leave it out")
    pid = Plant(name, f"PID with feed-forward for {measured.name} of {plant.name}")
    shown: dict[str, Any] = {"unit": measured.unit, "nominal": measured.nominal}
    reference = pid.input("reference", **shown, description=f"wanted {measured.name}")
    found = pid.input("position", **shown, description=f"measured {measured.name}")
    gains = (
        pid.parameter(n, value, tunable=True, nominal=max(1.0, abs(value)), description=words)
        for n, value, words in (
            ("proportional", proportional, "command per unit of position"),
            ("integral", integral, "command per unit of position and second"),
            ("derivative", derivative, "command per unit of velocity"),
        )
    )
    kp, ki, kd = gains
    tau, windup = (
        pid.parameter(n, value, unit="s", min=1e-9, tunable=True, description=words)
        for n, value, words in (
            ("filter_time", filter_time, "time constant of the derivative's filter"),
            ("windup_time", windup_time, "time constant of the integral while a command is held"),
        )
    )
    size: dict[str, Any] = {"unit": commands[0].unit, "nominal": commands[0].nominal}
    total = pid.state("integrated", **size, description="part of the integral")
    smooth = pid.state("smoothed", **shown, description="error, low-pass filtered")
    error = reference - found
    rate = (error - smooth) / tau
    action = kp * error + total + kd * rate
    excess: ca.SX = ca.SX(0)
    for command in commands:
        weight = float(weights[command.name])
        forward = pid.input(
            f"feedforward.{command.name}", unit=command.unit, start=command.start or 0.0,
            nominal=command.nominal, description=f"feed-forward of {command.name}",
        )  # fmt: skip
        wanted = forward + weight * action
        held = _command(pid, command, wanted)
        excess += (held - wanted) / (weight * len(commands))
    pid.der(smooth, rate)
    pid.der(total, ki * error + (excess / windup if integral else 0.0))
    return pid


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
    feedback : from :func:`pam_ocp.lqr`, about a point of rest.
    follow : take x0 and u0 from outside, as the inputs ``reference.<state>`` and
        ``feedforward.<command>``, to follow a motion near the point; by default they are the tunable
        parameters ``point.<state>`` and ``feedforward.<command>``.
    windup_time : T, time constant with which the integrals run back [s].
    name : of the plant.

    Inputs: every state of the plant, and what else is integrated (all measured), and
    ``reference.<output>`` for what is integrated. Outputs ``<command>``. All gains are tunable
    parameters ``gain.<command>.<state>`` and ``integral_gain.<command>.<output>``.
    """
    if not isinstance(feedback, StateFeedback):
        raise InputError(
            f"feedback is a {type(feedback).__name__}, not a StateFeedback, such as lqr(plant, point)"
        )
    require_positive("windup_time", windup_time, "s")
    plant, point = feedback.point.plant, feedback.point
    built = Plant(name, f"state feedback of {plant.name}")
    states = [v.name for v in plant.states]
    known = {n: plant.variable(n) for n in dict.fromkeys([*states, *feedback.integrated])}
    commands = [plant.variable(n) for n in feedback.inputs]
    from_outside = built.input if follow else _tunable(built)
    seen = {n: built.input(n, **_shown(v, point[n], "measured")) for n, v in known.items()}
    role = "reference" if follow else "point"
    origin = {
        n: from_outside(f"{role}.{n}", **_shown(known[n], point[n], "wanted")) for n in states
    }
    goal = {
        n: origin[n]
        if follow and n in origin
        else built.input(f"reference.{n}", **_shown(known[n], point[n], "wanted"))
        for n in feedback.integrated
    }
    totals = _integrals(built, feedback, commands)
    deviation = ca.vertcat(*(seen[n] - origin[n] for n in states))
    forward = [
        from_outside(f"feedforward.{v.name}", **_shown(v, point[v.name], "feed-forward of"))
        for v in commands
    ]
    asked = ca.vertcat(*forward) - _gains(built, "gain", commands, states, feedback.K) @ deviation
    if totals:
        gains = _gains(built, "integral_gain", commands, feedback.integrated, feedback.Ki)
        asked -= gains @ ca.vertcat(*totals)
    held = ca.vertcat(*(_command(built, v, asked[i]) for i, v in enumerate(commands)))
    if totals:
        back = ca.DM(np.linalg.pinv(feedback.Ki)) @ (asked - held) / windup_time
        for i, n in enumerate(feedback.integrated):
            built.der(totals[i], seen[n] - goal[n] + back[i])
    return built


def _shown(variable: Variable, value: float, role: str) -> dict[str, Any]:
    """Attributes of an input or parameter that stands for a variable of the plant."""
    return {
        "start": value, "unit": variable.unit, "nominal": variable.nominal,
        "display_unit": variable.display_unit, "description": f"{role} {variable.name}",
    }  # fmt: skip


def _tunable(plant: Plant) -> Any:
    def declare(name: str, *, start: float, **attributes: Any) -> ca.SX:
        return plant.parameter(name, start, tunable=True, **attributes)

    return declare


def _gains(
    built: Plant, name: str, commands: list[Variable], names: list[str], values: Any
) -> ca.SX:
    """A matrix of gains as tunable parameters, a row for each command."""
    rows = [
        [
            built.parameter(
                f"{name}.{command.name}.{n}", float(value), tunable=True,
                nominal=max(1.0, abs(float(value))), description=f"of {n} to {command.name} [SI]",
            )
            for n, value in zip(names, row, strict=True)
        ]
        for command, row in zip(commands, values, strict=True)
    ]  # fmt: skip
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
            f"integral.{n}", unit=("s" if numerator == "1" else f"{numerator}.s") + slash + rest,
            nominal=1 / most if most > 0 else 1.0, description=f"integrated error of {n}",
        )  # fmt: skip
        totals.append(total)
    return totals


def _command(built: Plant, command: Variable, wanted: ca.SX) -> ca.SX:
    """Declare a command as an output, held inside its range; returns what is held."""
    held = wanted if math.isinf(command.min) else ca.fmax(wanted, command.min)
    held = held if math.isinf(command.max) else ca.fmin(held, command.max)
    return built.output(
        command.name, held, unit=command.unit, nominal=command.nominal,
        description=command.description,
    )  # fmt: skip
