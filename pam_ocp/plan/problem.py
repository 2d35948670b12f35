"""What to do: a planning problem in the user's words, checked and brought into one form."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import casadi as ca

from ..errors import InputError, UnknownNameError, require_finite, require_positive
from ..plant.plant import Plant, require_plant
from ..variables import Variable

__all__ = ["OBJECTIVES", "Condition", "Cyclic", "Problem", "pose"]

Cyclic: TypeAlias = 'bool | Literal["mirrored"]'
Range: TypeAlias = tuple[float, float]

OBJECTIVES = ("time", "effort")
DURATIONS: Range = (1e-3, 10.0)
"""Bounds of a free duration of one phase [s]."""


@dataclass(frozen=True)
class Condition:
    """low <= expression(x, u, p) <= high; at one node of the motion, or all along it."""

    label: str
    expression: ca.SX
    low: float
    high: float
    nominal: float
    shown: Variable
    """The variable whose unit the value is shown in."""


@dataclass(frozen=True)
class Problem:
    """A motion of a plant through nodes, with a phase between each two.

    nodes : conditions at each node (stops, and rest there).
    durations : (low, high) of each phase [s].
    path : conditions all along; bounds : {state or input: (low, high)}.
    closing : None, or {state: (sign, image)}: the last node's image is the first node.
    weights : {objective: weight}; integrand : further running cost, or None.
    """

    plant: Plant
    stops: tuple[dict[str, Any], ...]
    nodes: tuple[tuple[Condition, ...], ...]
    durations: tuple[Range, ...]
    path: tuple[Condition, ...]
    bounds: dict[str, Range]
    closing: dict[str, tuple[float, str]] | None
    weights: dict[str, float]
    integrand: ca.SX | None = None


def pose(
    plant: Plant,
    stops: Sequence[Mapping[str, Any]],
    *,
    cyclic: Cyclic,
    duration: Any,
    minimise: str | Mapping[str, float],
    bounds: Mapping[str, Any] | None,
    rest: bool,
    integrand: ca.SX | None = None,
) -> Problem:
    """Check the arguments of :func:`pam_ocp.plan` and state the Problem."""
    require_plant(plant)
    if isinstance(stops, Mapping) or not all(isinstance(s, Mapping) for s in stops):
        raise InputError('stops must be a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]')
    if len(stops) < 2:
        raise InputError(f"stops = {list(stops)}: a motion needs at least two stops")
    state_bounds, path = _limits(plant, bounds or {})
    named = [{plant.variable(n).name: v for n, v in stop.items()} for stop in stops]
    route = [*named, named[0]] if cyclic is True else named
    nodes = tuple(
        tuple(_stop(plant, f"stop {i % len(named) + 1}", stop, state_bounds, rest))
        for i, stop in enumerate(route)
    )
    closing = _closing(plant, cyclic)
    if cyclic is True:  # the last node is the first: its own conditions would stand twice
        nodes = (*nodes[:-1], ())
    elif cyclic == "mirrored":
        nodes = (nodes[0], *nodes[1:-1], _not_implied(plant, named, nodes[-1], closing or {}))
    durations = _durations(duration, len(route) - 1)
    weights = _weights(minimise, integrand is not None)
    if "time" not in weights and any(high > low for low, high in durations):
        raise InputError(
            "minimise = 'effort' needs a fixed duration (a slower motion always takes less); "
            "give duration=0.5, say, or minimise={'time': 1.0, 'effort': 1e-3}"
        )
    _check_integrand(plant, integrand)
    return Problem(
        plant, tuple(route), nodes, durations, path, state_bounds, closing, weights, integrand
    )  # fmt: skip


def _range(argument: str, value: Any, variable: Variable) -> Range:
    """(low, high) from a number, or a pair with None for an open end."""
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        low = -math.inf if value[0] is None else float(value[0])
        high = math.inf if value[1] is None else float(value[1])
    else:
        low = high = require_finite(argument, value, variable.unit)
    if math.isnan(low) or math.isnan(high) or low > high:
        raise InputError(
            f"{argument} = ({variable.shown(low)}, {variable.shown(high)}): the bounds are crossed; "
            "give (lower, upper)"
        )
    return low, high


def _subject(plant: Plant, name: str) -> tuple[Variable, ca.SX]:
    """The variable and expression behind NAME or der(NAME)."""
    expression = plant.expression(name)
    if not name.startswith("der("):
        return plant.variable(name), expression
    state = plant.variable(name[4:-1])
    numerator, _, denominator = state.unit.partition("/")
    unit = f"{numerator}/({denominator.strip('()')}.s)" if denominator else f"{numerator}/s"
    return Variable(
        f"der_{state.name}", "constraint", unit=unit, nominal=10 * state.nominal
    ), expression


def _limits(
    plant: Plant, bounds: Mapping[str, Any]
) -> tuple[dict[str, Range], tuple[Condition, ...]]:
    """Bounds of states and inputs, and path conditions: the plant's own narrowed by the user's."""
    given: dict[str, Range] = {}
    for name, value in bounds.items():
        key = name if name.startswith("der(") else plant.variable(name).name
        variable, _ = _subject(plant, key)
        if variable.causality == "parameter":
            raise InputError(
                f"bounds: {name} is a parameter of the plant; set it by plant.with_values({name}=...)"
            )
        given[key] = _range(f"bounds[{name!r}]", value, variable)
    variables: dict[str, Range] = {}
    for variable in (*plant.states, *plant.inputs):
        held = (variable.start or 0.0,) * 2 if variable.disturbance else (-math.inf, math.inf)
        low, high = given.pop(variable.name, held)
        variables[variable.name] = _narrowed(variable, low, high)
    path = []
    for variable in plant.constraints:
        low, high = given.pop(variable.name, (-math.inf, math.inf))
        low, high = _narrowed(variable, low, high)
        path.append((variable.name, low, high))
    path += [(name, *limits) for name, limits in given.items()]
    conditions = []
    for name, low, high in path:
        variable, expression = _subject(plant, name)
        conditions.append(Condition(name, expression, low, high, variable.nominal, variable))
    return variables, tuple(conditions)


def _narrowed(variable: Variable, low: float, high: float) -> Range:
    if low > variable.max or high < variable.min:
        raise InputError(
            f"bounds[{variable.name!r}] = {variable.shown(low)} .. {variable.shown(high)} lie outside "
            f"the plant's own {variable.shown(variable.min)} .. {variable.shown(variable.max)}"
        )
    return max(low, variable.min), min(high, variable.max)


def _stop(
    plant: Plant, label: str, stop: Mapping[str, Any], bounds: Mapping[str, Range], rest: bool
) -> list[Condition]:
    if not stop:
        raise InputError(f"{label} is empty; name at least one variable, as in {{'x': 0.01}}")
    conditions = []
    for name, value in stop.items():
        variable, expression = _subject(plant, name)
        if variable.causality == "parameter":
            raise InputError(f"{label}: {name} is a parameter, it cannot change along the motion")
        low, high = _range(f"{label}: {name}", value, variable)
        least, most = bounds.get(name, (variable.min, variable.max))
        if low > most or high < least:
            raise InputError(
                f"{label}: {name} = {variable.shown(low)} is outside the stroke "
                f"{variable.shown(least)} .. {variable.shown(most)}"
            )
        conditions.append(
            Condition(f"{label}: {name}", expression, low, high, variable.nominal, variable)
        )
    return conditions + (_at_rest(plant, label) if rest else [])


def _at_rest(plant: Plant, label: str) -> list[Condition]:
    """Velocity and acceleration of every position are zero."""
    conditions = []
    for velocity in plant.positions.values():
        variable = plant.variable(velocity)
        acceleration, expression = _subject(plant, f"der({velocity})")
        conditions += [
            Condition(f"{label}: {velocity} at rest", plant.expression(velocity), 0.0, 0.0,
                      variable.nominal, variable),
            Condition(f"{label}: der({velocity}) at rest", expression, 0.0, 0.0,
                      acceleration.nominal, acceleration),
        ]  # fmt: skip
    return conditions


def _closing(plant: Plant, cyclic: Cyclic) -> dict[str, tuple[float, str]] | None:
    if cyclic is False or cyclic is None:
        return None
    if cyclic is True:
        return {v.name: (1.0, v.name) for v in plant.states}
    if cyclic != "mirrored":
        raise InputError(f"cyclic = {cyclic!r}: choose True, False or 'mirrored'")
    mirror = plant.mirror_map
    if not mirror:
        raise InputError(
            f"cyclic = 'mirrored': plant {plant.name!r} declares no mirror symmetry "
            "(unequal muscles have none); use cyclic=True"
        )
    return {v.name: mirror.get(v.name, (1.0, v.name)) for v in plant.states}


def _not_implied(
    plant: Plant,
    stops: Sequence[Mapping[str, Any]],
    last: tuple[Condition, ...],
    closing: Mapping[str, tuple[float, str]],
) -> tuple[Condition, ...]:
    """Of a mirrored motion's last node: what the first node's image does not say already."""
    if len(stops) != 2:
        raise InputError("cyclic = 'mirrored' takes two stops: the start and its mirror image")
    first = {n: _range(n, v, plant.variable(n)) for n, v in stops[0].items()}
    kept = []
    for condition, name in zip(last, stops[1], strict=False):  # rest follows by symmetry
        sign, image = closing.get(name, (1.0, name))
        if image not in first:
            kept.append(condition)
            continue
        low, high = sorted(sign * v for v in first[image])
        if max(abs(condition.low - low), abs(condition.high - high)) > 1e-9 * condition.nominal:
            raise InputError(
                f"cyclic = 'mirrored': {condition.label} = {condition.shown.shown(condition.low)} is "
                f"not the mirror image of stop 1, {condition.shown.shown(low)}; use cyclic=True"
            )
    return tuple(kept)


def _durations(duration: Any, phases: int) -> tuple[Range, ...]:
    if isinstance(duration, Sequence) and not isinstance(duration, tuple | str):
        if len(duration) != phases:
            raise InputError(
                f"duration holds {len(duration)} entries for {phases} phases; give one per phase"
            )
        return tuple(_duration(d) for d in duration)
    return (_duration(duration),) * phases


def _duration(value: Any) -> Range:
    if value is None:
        return DURATIONS
    if isinstance(value, tuple):
        if len(value) != 2:
            raise InputError(f"duration = {value}: give (shortest, longest) in seconds")
        low, high = (require_positive("duration", v, "s") for v in value)
        if low > high:
            raise InputError(f"duration = ({low:g}, {high:g}) s: the bounds are crossed")
        return low, high
    fixed = require_positive("duration", value, "s")
    return fixed, fixed


def _weights(minimise: str | Mapping[str, float], more: bool) -> dict[str, float]:
    weights = {minimise: 1.0} if isinstance(minimise, str) else dict(minimise)
    for name, weight in weights.items():
        if name not in OBJECTIVES:
            raise UnknownNameError("objective", name, OBJECTIVES)
        require_positive(f"minimise[{name!r}]", weight, zero=True)
    if not any(weights.values()) and not more:
        raise InputError(f"minimise = {weights}: at least one weight must be > 0")
    return {n: w for n, w in weights.items() if w > 0}


def _check_integrand(plant: Plant, integrand: ca.SX | None) -> None:
    if integrand is None:
        return
    known = {s.name() for s in ca.symvar(ca.vertcat(plant.x, plant.u, plant.p))}
    if not isinstance(integrand, ca.SX) or integrand.shape != (1, 1):
        raise InputError(
            f"integrand = {integrand!r}: give a scalar CasADi SX expression of the plant"
        )
    foreign = {s.name() for s in ca.symvar(integrand)} - known
    if foreign:
        raise InputError(
            f"integrand holds symbols that are not the plant's: {', '.join(sorted(foreign))}; "
            "build it from plant.expression(NAME)"
        )
