"""Rest at a stop as conditions: what must vanish there, and what inputs would hold it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from ...core.errors import InputError
from ...core.variables import Variable
from ...judge.statement import Stop, subject, times_seconds
from ...plants.plant import Plant
from ...plants.stillness import Position, rate_of, rest_rows
from .objective import Symbols
from .problem import Condition, Range

__all__ = ["Holding", "at_rest", "resting_positions"]


def resting_positions(plant: Plant, stops: Sequence[Stop]) -> tuple[Position, ...]:
    """What stands still at the stops that are at rest; those the stops speak of come first."""
    if not any(stop.rest for stop in stops):
        return ()
    expressions = [subject(plant, name)[1] for stop in stops for name in stop.values]
    spoken = ca.which_depends(ca.vertcat(*expressions), plant.x, 1, False) if expressions else []
    named = [v.name for v, is_named in zip(plant.states, spoken, strict=False) if is_named]
    positions = plant.resting(named) or _named_places(plant, stops)
    if not positions:
        raise InputError(
            f"rest = True: plant {plant.name!r} has no position that could stand still (a state "
            "whose rate, where it vanishes, does not depend on the state itself), and no input "
            "that could hold what the stops name; give rest=False, and what shall vanish in the "
            "stops, such as {'der(NAME)': 0.0}"
        )
    return positions


def _named_places(plant: Plant, stops: Sequence[Stop]) -> tuple[Position, ...]:
    """What the stops name, where no state is a position: a level of a tank, a sum of states.

    An input has to be able to hold it: what runs down by itself cannot rest.
    """
    chosen = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    if not chosen:
        return ()
    names = dict.fromkeys(plant.variable(n).name for s in stops for n in s.values if "(" not in n)
    return tuple(
        Position(name, (), bool(ca.depends_on(rate_of(plant, name), plant.u[chosen])))
        for name in names
        if plant.variable(name).causality in ("state", "output")
    )


@dataclass
class Holding:
    """How rest is asked for: what an input sets at once need not vanish before the stop.

    There it is enough that admissible inputs would hold the plant: unknowns of their own, so that
    the last interval of piecewise constant inputs is not spent on zero acceleration. Admissible are
    those that keep the path conditions, too: slack muscles hold nothing, and where they are slack
    the conditions of rest have no slope in the inputs.
    """

    plant: Plant
    bounds: Mapping[str, Range]
    path: tuple[Condition, ...]
    symbols: Symbols
    jumps: bool
    positions: tuple[Position, ...] = ()

    def inputs(self, label: str, rows: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX, list[Condition]]:
        """(inputs, what stands for them in the rows of rest, conditions on the latter)."""
        plant = self.plant
        values, conditions, jumping = [], [], []
        asked = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        for i, variable in enumerate(plant.inputs):
            jumps = self.jumps and not variable.disturbance and ca.depends_on(asked, plant.u[i])
            if not jumps:
                values.append(plant.u[i])
                continue
            jumping.append(plant.u[i])
            held = self.symbols.unknown() * variable.nominal
            low, high = self.bounds[variable.name]
            values.append(held)
            conditions.append(
                Condition(
                    f"{label}: {variable.name} that holds it",
                    held,
                    low,
                    high,
                    variable.nominal,
                    variable,
                )
            )
        instead = ca.vertcat(*values)
        if jumping:
            conditions += [
                replace(
                    c,
                    label=f"{label}: {c.label} where it is held",
                    expression=ca.substitute(c.expression, plant.u, instead),
                )
                for c in self.path
                if ca.depends_on(c.expression, ca.vertcat(*jumping))
            ]
        return plant.u, instead, conditions


def at_rest(
    plant: Plant, label: str, stop: Stop, holding: Holding, settled: Sequence[Condition] = ()
) -> list[Condition]:
    """Rate and acceleration of every position are zero, where the stop says nothing else; and with
    the same inputs what else has settled there.
    """
    conditions = []
    positions = holding.positions
    for position, order, expression in rest_rows(plant, positions):
        rate, velocities = f"der({position.name})", position.velocities
        said = [f"der({v})" for v in velocities] if order == 2 else velocities
        if (order == 1 and rate in stop.values) or (said and set(said) <= set(stop.values)):
            continue
        literal = len(velocities) == 1 and ca.is_equal(
            plant.expression(rate), plant.expression(velocities[0])
        )
        if literal:
            name = velocities[0] if order == 1 else f"der({velocities[0]})"
            variable, expression = subject(plant, name)
        else:
            name = rate if order == 1 else f"der(der({position.name}))"
            variable = _rate_of(plant, position.name, order)
        conditions.append(
            Condition(f"{label}: {name} at rest", expression, 0.0, 0.0, variable.nominal, variable)
        )
    conditions += settled
    u, held, beside = holding.inputs(label, [c.expression for c in conditions])
    if not beside:
        return conditions
    return [
        replace(c, expression=ca.substitute(c.expression, u, held)) for c in conditions
    ] + beside


def _rate_of(plant: Plant, name: str, order: int) -> Variable:
    """What is shown of the ``order``-th derivative of a state."""
    state = plant.variable(name)
    unit = times_seconds(state.unit, -1)
    if order == 2:
        unit = times_seconds(unit, -1)
    return Variable("rate", "constraint", unit=unit, nominal=10**order * state.nominal)
