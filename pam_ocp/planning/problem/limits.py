"""Bounds of a plan: the plant's own narrowed by the user's, constant or changing with time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from ...core.errors import InputError, require_finite, require_positive
from ...core.variables import Variable
from ...judge.statement import (
    TIME,
    Avoid,
    Constraint,
    Profile,
    require_expression,
    subject,
)
from ...plants.plant import Plant
from .problem import Condition, Range, Symbols

INF = float("inf")
BEYOND = 0.05
"""By which part of their range held memories may leave it in the discretised motion."""
Side: TypeAlias = Literal["low", "high", "both"]


@dataclass
class Limits:
    """Bounds of states and inputs, and conditions along a leg."""

    variables: dict[str, Range] = field(default_factory=dict)
    path: list[Condition] = field(default_factory=list)


def key_of(plant: Plant, name: str) -> str:
    return name if name.startswith("der(") else plant.variable(name).name


def common_limits(plant: Plant, bounds: Mapping[str, Any], symbols: Symbols) -> Limits:
    """The plant's own bounds and path constraints, narrowed by the user's."""
    variables: dict[str, Range] = {}
    for variable in (*plant.states, *plant.inputs):
        if variable.disturbance:
            variables[variable.name] = (variable.start or 0.0,) * 2
        else:
            # a memory keeps its range by itself; on a coarse mesh it may overshoot a little
            beyond = BEYOND * (variable.max - variable.min) if variable.memory == "held" else 0.0
            variables[variable.name] = variable.min - beyond, variable.max + beyond
    path = [
        Condition(v.name, plant.expression(v.name), v.min, v.max, v.nominal, v)
        for v in plant.constraints
    ]
    return narrowed(plant, Limits(variables, path), "bounds", bounds, symbols)


def narrowed(
    plant: Plant, limits: Limits, argument: str, bounds: Mapping[str, Any], symbols: Symbols
) -> Limits:
    """Limits with a user's bounds on top."""
    variables, path = dict(limits.variables), list(limits.path)
    if not isinstance(bounds, Mapping):
        raise InputError(f"{argument} = {bounds!r}: give {{name: (low, high)}}")
    for name, value in bounds.items():
        key = key_of(plant, name)
        variable, expression = subject(plant, key)
        if variable.causality == "parameter":
            raise InputError(
                f"{argument}: {name} is a parameter of the plant; set it by "
                f"plant.with_values({name}=...), or let the plan choose it: design={{{name!r}: "
                f"(low, high)}}"
            )
        low, high, changing = _constant_part(f"{argument}[{name!r}]", value, variable)
        for profile, side in changing:
            path.append(_beside(variable, expression, symbols.aim(key, profile), side))
        if variable.disturbance and not changing:  # the user may say what it is
            variables[key] = _inside(argument, variable, low, high)
        elif key in variables:
            least, most = variables[key]
            low, high = _inside(argument, variable, low, high)
            variables[key] = _crossing(argument, variable, max(low, least), min(high, most))
        else:
            at = next((i for i, c in enumerate(path) if c.label == key), None)
            if at is None:
                path.append(Condition(key, expression, low, high, variable.nominal, variable))
            else:
                old = path[at]
                both = max(low, old.low), min(high, old.high)
                both = _crossing(argument, variable, *both)
                path[at] = Condition(key, expression, *both, variable.nominal, variable)
    return Limits(variables, path)


def _crossing(argument: str, variable: Variable, low: float, high: float) -> Range:
    if low > high:
        raise InputError(
            f"{argument}[{variable.name!r}]: nothing is left between {variable.exactly(low)} and "
            f"{variable.exactly(high)}"
        )
    return low, high


def _inside(argument: str, variable: Variable, low: float, high: float) -> Range:
    if low > variable.max or high < variable.min:
        raise InputError(
            f"{argument}[{variable.name!r}] = {variable.exactly(low)} .. "
            f"{variable.exactly(high)} lie outside the plant's own "
            f"{variable.exactly(variable.min)} .. {variable.exactly(variable.max)}"
        )
    return max(low, variable.min), min(high, variable.max)


def _constant_part(
    argument: str, value: Any, variable: Variable
) -> tuple[float, float, list[tuple[Profile, Side]]]:
    """(low, high, what changes with time) of a bound."""
    if isinstance(value, Profile):
        return -INF, INF, [(value, "both")]
    changing: list[tuple[Profile, Side]] = []
    if isinstance(value, tuple | list) and len(value) == 2:
        kept: list[Any] = list(value)
        sides: tuple[Side, Side] = ("low", "high")
        for i, side in enumerate(sides):
            if isinstance(value[i], Profile):
                changing.append((value[i], side))
                kept[i] = None
        value = tuple(kept)
    low, high = range_of(argument, value, variable)
    return low, high, changing


def _beside(variable: Variable, expression: ca.SX, limit: ca.SX, side: str) -> Condition:
    """A variable above, below or on a profile."""
    low, high = {"low": (0.0, INF), "high": (-INF, 0.0), "both": (0.0, 0.0)}[side]
    words = {"low": "above", "high": "below", "both": "along"}[side]
    label = f"{variable.name} {words} its profile"
    return Condition(label, expression - limit, low, high, variable.nominal, variable)


def range_of(argument: str, value: Any, variable: Variable) -> Range:
    """(low, high) from a number, or a pair with None for an open end."""
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        low = -math.inf if value[0] is None else variable.number(value[0], argument)
        high = math.inf if value[1] is None else variable.number(value[1], argument)
    else:
        if value is None or (np.ndim(value) and not isinstance(value, str)):
            raise InputError(
                f"{argument} = {value!r}: give a number, or (low, high) with None for an open end"
            )
        low = high = require_finite(argument, value, variable.unit)
    if math.isfinite(high):
        variable.doubt(high, argument)
    elif math.isfinite(low):
        variable.doubt(low, argument)
    if math.isnan(low) or math.isnan(high) or low > high:
        raise InputError(
            f"{argument} = ({variable.exactly(low)}, {variable.exactly(high)}): the bounds are "
            "crossed; give (lower, upper)"
        )
    return low, high


def conditions_of(plant: Plant, given: Sequence[Constraint | Avoid]) -> list[Condition]:
    found: list[Condition] = []
    for constraint in given:
        if isinstance(constraint, Constraint):
            found.append(_kept_within(plant, constraint))
        elif isinstance(constraint, Avoid):
            found.append(_kept_outside(plant, constraint))
        else:
            raise InputError(f"constraints: {constraint!r} is neither a Constraint nor an Avoid")
    return found


def _kept_within(plant: Plant, given: Constraint) -> Condition:
    argument = f"Constraint {given.name!r}"
    require_expression(plant, argument, given.expression)
    low, high = (
        default if value is None else require_finite(argument, value, given.unit)
        for value, default in ((given.low, -INF), (given.high, INF))
    )
    if low > high or (given.low is None and given.high is None):
        raise InputError(
            f"{argument}: low = {given.low}, high = {given.high}; give one of them, or both with "
            "low <= high"
        )
    shown = Variable("value", "constraint", unit=given.unit, nominal=given.nominal)
    return Condition(given.name, given.expression, low, high, given.nominal, shown)


def _kept_outside(plant: Plant, given: Avoid) -> Condition:
    if not given.region:
        raise InputError("Avoid: the region is empty; give {'x': (centre, half width)}")
    distance = ca.SX(0)
    for key, value in given.region.items():
        if not (isinstance(value, Sequence) and len(value) == 2):
            raise InputError(f"Avoid: {key} = {value!r}: give (centre, half width)")
        if key == "time":
            unit, expression = "s", TIME
        else:
            variable, expression = subject(plant, key)
            unit = variable.unit
        centre = require_finite(f"Avoid: centre of {key}", value[0], unit)
        width = require_positive(f"Avoid: half width of {key}", value[1], unit)
        distance += ((expression - centre) / width) ** 2
    shown = Variable("distance", "constraint")
    # the root grows evenly with the distance, so a solver far inside sees a slope of order one
    return Condition(given.name, ca.sqrt(distance + 1e-12), 1.0, INF, 1.0, shown)


def design_ranges(plant: Plant, design: Mapping[str, Any]) -> dict[str, Range]:
    found = {}
    for name, value in design.items():
        variable = plant.variable(name)
        if variable.causality != "parameter":
            raise InputError(
                f"design: {name} is {variable.kind}; a plan may choose parameters: "
                f"{', '.join(v.name for v in plant.parameters)}"
            )
        low, high = range_of(f"design[{name!r}]", value, variable)
        low, high = _inside("design", variable, low, high)
        if not (math.isfinite(low) and math.isfinite(high)):
            raise InputError(f"design[{name!r}] = {value}: both bounds must be finite")
        found[variable.name] = (low, high)
    return found
