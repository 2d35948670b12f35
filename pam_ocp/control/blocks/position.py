"""Position loops as blocks: PID with feed-forward by inverse dynamics, pressure loops below."""

from __future__ import annotations

from typing import Any

import casadi as ca

from ...core.block import Block
from ...core.variables import Variable
from ...plants.plant import Plant
from ..inverse import InverseDynamics
from ..pid import PositionController, PressureLoop
from .draft import Draft, Symbol, as_output, per, sent_by
from .kinds import BLOCKS
from .pid import pid_law

__all__ = ["inverse_dynamics", "position_controller", "pressure_loop"]


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
    k = wanted_stiffness(draft, plant, stiffness) if len(inverse.muscles) == 2 else None
    error = x - draft.like(plant.variable(inverse.position))
    saturated = draft.memory("saturated", description="a pressure was at an end of its range")
    frozen = ca.logic_or(saturated, draft.held_back)
    more = pid_law(draft, c.pid, error, frozen)
    if not c.feedforward:
        at = c.reference(0.0)
        x, v, a = (
            draft.parameter(f"at.{n}", value)
            for n, value in zip(("position", "velocity", "acceleration"), at, strict=True)
        )
    p = pressures_of(draft, inverse, x, v, a + more, k)
    draft.next("saturated", at_an_end(inverse, p))
    _send(draft, c.inner, {m: p[i] for i, m in enumerate(inverse.muscles)}, plant)
    return draft.block()


def wanted_motion(
    draft: Draft, inverse: InverseDynamics, start: tuple[float, float, float], first: str = "wanted"
) -> tuple[Symbol, Symbol, Symbol]:
    """Inputs for position, velocity and acceleration."""
    plant = inverse.plant
    position, velocity = (plant.variable(n) for n in (inverse.position, inverse.velocity))
    found = [
        draft.input(
            f"{first}.{v.name}",
            value,
            unit=v.unit,
            nominal=v.nominal,
            description=f"to be reached: {v.description}",
        )
        for v, value in zip((position, velocity), start, strict=False)
    ]
    acceleration = draft.input(
        f"{first}.acceleration",
        start[2],
        unit=per(velocity.unit, "s") if "/" not in velocity.unit else f"{velocity.unit}2",
        nominal=10.0 * velocity.nominal,
        description="to be reached: acceleration",
    )
    return found[0], found[1], acceleration


def wanted_stiffness(
    draft: Draft, plant: Plant, start: float | None, first: str = "wanted"
) -> Symbol:
    """The input for the stiffness of a pair."""
    v = plant.variable("stiffness")
    return draft.input(
        f"{first}.stiffness",
        float(start or 0.0),
        unit=v.unit,
        nominal=v.nominal,
        description=f"to be reached: {v.description}",
    )


def pressures_of(
    draft: Draft,
    inverse: InverseDynamics,
    x: Symbol,
    v: Symbol,
    a: Symbol,
    stiffness: Symbol | None,
    states: dict[str, Symbol] | None = None,
) -> Symbol:
    """Pressures of the muscles by inverse dynamics; states : of memories, by name."""
    count = inverse.search.steps
    known = {inverse._at[0]: x, inverse._at[1]: v}
    known |= {inverse._where[n]: s for n, s in (states or {}).items()}
    z = ca.vertcat(*(known.get(i, float(start)) for i, start in enumerate(inverse._z)))
    draft.repeats("Newton steps of the inverse dynamics", count * (1 if stiffness is None else 5))
    target = a if stiffness is None else ca.vertcat(a, stiffness)
    return inverse.search.function(z, target)


def at_an_end(inverse: InverseDynamics, p: Symbol) -> Symbol:
    """Whether a pressure stands at an end of its range."""
    found = type(p)(0)
    for i in range(len(inverse.muscles)):
        ends = ca.logic_or(p[i] <= float(inverse.low[i]), p[i] >= float(inverse.high[i]))
        found = ca.fmax(found, ends)
    return found


def _send(draft: Draft, loop: PressureLoop, wanted: dict[str, Symbol], plant: Plant) -> None:
    measured: dict[str, Any] = {
        f"{m}.pressure": draft.like(plant.variable(f"{m}.pressure"))
        for m in wanted
        if plant.variable(f"{m}.pressure").causality == "state"
    }
    for variable, value in sent_by(loop.inversion, loop.inputs(wanted, measured), draft):
        draft.output(as_output(variable), value, command=True)


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


@BLOCKS.register("InverseDynamics")
def inverse_dynamics(
    inverse: InverseDynamics, name: str = "inverse", *, sample_time: float = 1e-3
) -> Block:
    """Feed-forward alone: outputs ``wanted.MUSCLE.pressure`` of a motion, for a PressureLoop.

    As :class:`InverseDynamics`. sample_time : [s].
    """
    plant = inverse.plant
    draft = Draft(name, sample_time, "inverse dynamics", ca.MX)
    start = plant.variable(inverse.position).start or 0.0
    x, v, a = wanted_motion(draft, inverse, (start, 0.0, 0.0))
    k = None
    if len(inverse.muscles) == 2:
        at = ca.Function("at", [plant.x, plant.u, plant.p], [plant.expression("stiffness")])
        rest = float(at(*(plant.vector(c) for c in ("state", "input", "parameter"))))
        k = wanted_stiffness(draft, plant, rest)
    p = pressures_of(draft, inverse, x, v, a, k)
    for i, m in enumerate(inverse.muscles):
        pressure = plant.variable(f"{m}.pressure")
        about = Variable(
            f"wanted.{m}.pressure",
            "output",
            unit="Pa",
            start=pressure.start,
            min=pressure.min,
            max=pressure.max,
            nominal=pressure.nominal,
            description=f"gauge pressure of {m} that the motion needs",
        )
        draft.output(about, p[i])
    return draft.block()
