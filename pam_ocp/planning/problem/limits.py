"""Bounds of a plan, constant or changing with time: the plant's own narrowed by the user's; and the
first stop: what the past left there, in states that nobody sets.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, PlanWarning, require_finite
from ...core.quantities import outside
from ...core.variables import Variable
from ...judge.statement import (
    COSTS,
    Avoid,
    Constraint,
    Profile,
    Statement,
    Stop,
    ranged_outputs,
    require_expression,
    subject,
)
from ...operating.held import at_rest, driven_names, held, held_names, surroundings
from ...operating.resting_point import EquilibriumError, equilibrium
from ...plants.plant import Plant
from ...plants.stillness import Position, settled_names, store_names, totals
from ..transcription.guess import Point, rest_point
from .problem import Condition, Problem, Range, Symbols

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
        for v in (*plant.constraints, *ranged_outputs(plant))
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
        if variable.disturbance and changing:
            raise InputError(
                f"{argument}[{name!r}]: {key} is a disturbance, which a plan holds constant; give "
                "a number, or state in the plant how it changes"
            )
        for profile, side in changing:
            path.append(_beside(variable, expression, symbols.aim(key, profile), side))
        if variable.disturbance:  # the user may say what it is
            variables[key] = _inside(argument, variable, low, high)
        elif key in variables:
            least, most = variables[key]
            low, high = _inside(argument, variable, low, high)
            variables[key] = _crossing(argument, variable, max(low, least), min(high, most))
        else:
            alike = (i for i, c in enumerate(path) if (c.label, c.shown) == (key, variable))
            at = next(alike, None)
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


def distinct(path: Sequence[Condition]) -> list[Condition]:
    """The conditions with labels that differ: by these the mesh knows which of them to watch."""
    found: dict[str, Condition] = {}
    for condition in path:
        label, count = condition.label, 1
        while label in found:
            count += 1
            label = f"{condition.label} ({count})"
        found[label] = condition if count == 1 else replace(condition, label=label)
    return [*found.values()]


def conditions_of(plant: Plant, given: Sequence[Constraint | Avoid]) -> list[Condition]:
    return [
        _kept_outside(plant, c) if isinstance(c, Avoid) else _kept_within(plant, c) for c in given
    ]


def _kept_within(plant: Plant, given: Constraint) -> Condition:
    require_expression(plant, f"Constraint {given.name!r}", given.expression)
    low, high = given.ends
    shown = Variable("value", "constraint", unit=given.unit, nominal=given.nominal)
    return Condition(given.name, given.expression, low, high, given.nominal, shown)


def _kept_outside(plant: Plant, given: Avoid) -> Condition:
    shown = Variable("distance", "constraint")
    # the root grows evenly with the distance, so a solver far inside sees a slope of order one
    distance = ca.sqrt(sum(axis**2 for axis in given.axes(plant)) + 1e-12)
    return Condition(given.name, distance, 1.0, INF, 1.0, shown)


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


# ---- the first stop ------------------------------------------------------------------------------
ROUNDS, SAME = 10, 1e-6
"""From a pressure to memories at their envelopes to the pressure there, at most, and until these
change by less [nominal].
"""
NEAR = 0.01
"""To either side of where a position is expected, in nominals: the slope of a memory there."""
KEEPS = 1e-7
"""Rate below which a tank without a source keeps its air before a motion [nominal/s]."""
DRAWN = 1e-5
"""Rate from which surroundings are drawn from [nominal/s]."""


def left_by_the_past(
    plant: Plant, statement: Statement, first: Stop, bounds: Mapping[str, Range]
) -> list[Condition]:
    """What the past left at the first stop, of states that nobody could set: memories, totals, what
    keeps whatever its surroundings left there; without rest, lags that have settled.
    """

    def condition(name: str, words: str, low: float, high: float) -> Condition:
        variable, expression = subject(plant, name)
        return Condition(
            f"stop 1: {name} {words}", expression, low, high, variable.nominal, variable
        )

    sums = [n for n in totals(plant) if n not in first.values]
    starts = {n: float(plant.variable(n).start or 0.0) for n in sums}
    conditions = [condition(n, "at its start", value, value) for n, value in starts.items()]
    if statement.cyclic:  # the cycle itself says what they hold
        if statement.memory != "virgin":
            raise InputError(
                f"memory = {statement.memory!r}: a cyclic motion closes its memories by "
                "itself; leave it out"
            )
        kept = [n for n in held_names(plant) if n not in first.values]
        ranges = {n: (plant.variable(n).min, plant.variable(n).max) for n in kept}
        return conditions + [condition(n, "in its range", *ends) for n, ends in ranges.items()]
    left = {n: v for n, v in surroundings(plant).items() if n not in plant.copies}
    left = {n: v for n, v in left.items() if n not in first.values}
    conditions += [condition(n, "held", value, value) for n, value in left.items()]
    memory = _slid(plant, statement, first)
    for n, value in memory.items():
        variable, expression = subject(plant, n)
        label, off = f"stop 1: {n} held", expression - value
        conditions.append(Condition(label, off, 0.0, 0.0, variable.nominal, variable))
    if first.rest:
        return conditions
    settled = [n for n in settled_names(plant) if n not in {*first.values, *memory, *left}]
    return conditions + [condition(f"der({n})", "settled", 0.0, 0.0) for n in settled]


def _kept(plant: Plant, statement: Statement, first: Stop) -> dict[str, float]:
    """What held memories hold at the first stop as the statement says, but for those that it names;
    without envelopes.
    """
    return {n: v for n, v in held(plant, statement.memory).items() if n not in first.values}


def _slid(plant: Plant, statement: Statement, first: Stop) -> dict[str, ca.SX]:
    """What they come to there: envelopes that are wider under pressure are lines in it, be it a
    state or an input.
    """
    kept = _kept(plant, statement, first)
    if isinstance(statement.memory, Mapping) or not kept:
        return {n: ca.SX(value) for n, value in kept.items()}
    z = np.concatenate([_named_states(plant, first), plant.vector("input")])
    symbols, variables = ca.vertcat(plant.x, plant.u), (*plant.states, *plant.inputs)

    def there(z: NDArray[np.float64]) -> dict[str, float]:
        return at_rest(plant, z[: plant.x.numel()], kept, z[plant.x.numel() :])

    memory = there(z)
    found = {n: ca.SX(value) for n, value in memory.items()}
    places = {n for q in plant.resting() for n in (q.name, *q.velocities)}
    unsaid = _unsaid_places(plant, first)
    passive = {*places, *held_names(plant), *first.values} - unsaid
    rates = ca.vertcat(*(plant.expression(f"der({n})") for n in memory))
    widens = ca.which_depends(rates, symbols, 1, False)
    for i, v in enumerate(variables):
        if not widens[i] or v.name in passive:
            continue
        if v.name in unsaid:  # a tendon stretches by little
            levels = [float(z[i] + part * v.nominal) for part in (-NEAR, NEAR)]
        elif np.isfinite(v.max - v.min):
            levels = [float(v.min + part * (v.max - v.min)) for part in (0.25, 0.75)]
        else:
            continue
        low, high = (there(np.where(np.arange(len(z)) == i, level, z)) for level in levels)
        for n in (n for n in memory if n not in store_names(plant)):  # which open valves drain
            slope = float(high[n] - low[n]) / (levels[1] - levels[0])
            if slope:  # at z, start values, nothing may lie beyond its envelope
                found[n] += low[n] - memory[n] + slope * (symbols[i] - levels[0])
    ends = {n: (plant.variable(n).min, plant.variable(n).max) for n in memory}
    return {n: ca.fmin(ca.fmax(line, ends[n][0]), ends[n][1]) for n, line in found.items()}


def _named_states(plant: Plant, stop: Stop) -> NDArray[np.float64]:
    """The states' start values, with those that a stop names; positions that it does not say are
    those of an equilibrium there, where there is one.
    """
    ends = {n: range_of(n, v, plant.variable(n)) for n, v in stop.values.items() if "(" not in n}
    known = {n: sum(pair) / 2 for n, pair in ends.items()}
    start = plant.vector("state")
    for i, variable in enumerate(plant.states):
        if np.isfinite(known.get(variable.name, np.nan)):
            start[i] = known[variable.name]
    unsaid = _unsaid_places(plant, stop)
    if unsaid:
        try:
            point = equilibrium(plant, {n: v for n, v in known.items() if np.isfinite(v)})
        except (EquilibriumError, InputError):
            return start
        for i, variable in enumerate(plant.states):
            if variable.name in unsaid:
                start[i] = point[variable.name]
    return start


def _unsaid_places(plant: Plant, stop: Stop) -> set[str]:
    """Positions of which a stop says nothing: the muscle's end, where there is a tendon."""
    return {q.name for q in plant.resting()} - {*stop.values}


def settled_before(plant: Plant, first: Stop, positions: tuple[Position, ...]) -> list[Condition]:
    """What stands still besides the positions where a plant has rested before a motion: pressures,
    temperatures, spools, lags, all that inputs or positions move; and what a tank without a source
    holds, which air that flows through open valves would empty. What the first stop names of those
    that settle by themselves is as it says, and so is what it names the rate of.
    """
    places = {n for p in positions for n in (p.name, *p.velocities)}
    kept = {*places, *totals(plant), *held_names(plant), *surroundings(plant), *plant.copies}
    own = {n for n in settled_names(plant) if n in first.values}
    moved = [n for n in driven_names(plant) if n not in kept and n not in own]
    widths = dict.fromkeys(moved, 0.0)
    # an equation would leave the valves that drain a tank no inside: their areas are bounded below
    widths |= {n: KEEPS for n in store_names(plant) if n not in first.values}
    return [
        Condition(f"stop 1: {rate} settled", expression, -width, width, variable.nominal, variable)
        for name, part in widths.items()
        if (rate := f"der({name})") not in first.values
        for variable, expression in [subject(plant, rate)]
        for width in [part * variable.nominal]
    ]


def _rest_at(
    problem: Problem, statement: Statement, first: Stop, beside: Mapping[str, float] | None = None
) -> Point | None:
    """(states, inputs) of rest at the first stop, with memories at the envelopes of its pressures;
    None where none is found. beside : states that are known there, too.
    """
    plant, point = problem.plant, None
    kept = _kept(plant, statement, first)
    told = isinstance(statement.memory, Mapping)
    memory = kept if told else at_rest(plant, _named_states(plant, first), kept)
    for _ in range(ROUNDS):
        point = rest_point(problem, problem.stops[0] | dict(beside or {}) | memory)
        if point is None or told:
            break
        before, memory = memory, at_rest(plant, point[0], kept)
        if all(abs(memory[n] - before[n]) <= SAME * plant.variable(n).nominal for n in memory):
            break
    return point


def with_draught(
    problem: Problem,
    statement: Statement,
    first: Stop,
    at: Callable[[Sequence[Condition]], list[Condition]],
) -> Problem:
    """Surroundings from which the inputs that hold the plant draw (a leak, fed through an open
    valve) have settled under them, not with valves closed.

    at : puts those inputs into conditions.
    """
    plant = problem.plant
    left = {n: v for n, v in surroundings(plant).items() if n not in {*plant.copies, *first.values}}
    driven = {*driven_names(plant), *first.values}
    if statement.cyclic or not first.rest or not driven & {*left}:
        return problem
    if _rest_at(problem, statement, first, left) is not None:  # with valves closed, say
        return problem
    point = _rest_at(problem, statement, first)
    if point is None:
        return problem
    x, u = point
    names = [v.name for v in plant.states]
    x = np.array([left.get(n, value) for n, value in zip(names, x, strict=True)])
    rates = np.asarray(plant.function(x, u, plant.vector("parameter"))[0], float).ravel()
    drawn = [n for n in left if abs(rates[names.index(n)]) > DRAWN * plant.variable(n).nominal]
    rates_of = [(n, *subject(plant, f"der({n})")) for n in drawn]
    conditions = [
        Condition(f"stop 1: der({n}) settled", expression, 0.0, 0.0, variable.nominal, variable)
        for n, variable, expression in rates_of
    ]
    settled = {f"stop 1: {n} held": c for n, c in zip(drawn, at(conditions), strict=True)}
    node = tuple(settled.get(c.label, c) for c in problem.nodes[0])
    return replace(problem, nodes=(node, *problem.nodes[1:]))


def with_given_pressures(
    problem: Problem, statement: Statement, first: Stop, positions: tuple[Position, ...]
) -> Problem:
    """Pressures at the first stop are no gift where the supply's air counts.

    A motion that may choose them is made by venting what it was given. Where neither the cycle nor
    the first stop says what they are, they are those at rest there, nearest to their start values.
    """
    plant = problem.plant
    weights = statement.weights
    asked = [n for n in weights if weights[n] and n in COSTS and COSTS[n].from_supply]
    if not asked or statement.cyclic:
        return problem
    places = {n for p in positions for n in (p.name, *p.velocities)}
    known = {*places, *settled_names(plant), *totals(plant), *first.values}
    free = [v.name for v in plant.states if v.name not in known and not v.memory]
    spoken = ca.vertcat(*(subject(plant, n)[1] for n in first.values))
    symbols = ca.vertcat(*(plant.expression(n) for n in free))
    if not free or ca.depends_on(spoken, symbols):
        return problem
    point = _rest_at(problem, statement, first)
    if point is None:
        return problem
    values = {v.name: float(point[0][i]) for i, v in enumerate(plant.states) if v.name in free}
    shown = ", ".join(f"{n} = {plant.variable(n).shown(value)}" for n, value in values.items())
    warnings.warn(
        f"minimise = {asked[0]!r} leaves no pressure to choose at the first stop, or the motion "
        f"would vent what it begins with: it begins at rest with {shown}. Name other values in "
        "the first stop, or give cyclic=True",
        PlanWarning,
        stacklevel=outside(),
    )
    given = [
        Condition(
            f"stop 1: {n} given",
            plant.expression(n),
            value,
            value,
            plant.variable(n).nominal,
            plant.variable(n),
        )
        for n, value in values.items()
    ]
    # with pressures at rest forces balance by themselves: they would be said twice
    fixed = {*free, *places, *first.values}
    open_ = [
        s for v, s in zip(plant.states, ca.vertsplit(plant.x), strict=True) if v.name not in fixed
    ]
    unknown = ca.vertcat(*open_, plant.u, problem.m)

    def follows(c: Condition) -> bool:
        if c.label.endswith("settled"):
            return not ca.depends_on(c.expression, unknown)
        return c.label.endswith("at rest") and bool(ca.depends_on(c.expression, symbols))

    node = (*(c for c in problem.nodes[0] if not follows(c)), *given)
    return replace(problem, nodes=(node, *problem.nodes[1:]))
