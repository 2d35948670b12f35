"""From a user's statement to a planning problem: stops, legs and their conditions in one form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca

from ...core.errors import InputError
from ...core.quantities import is_quantity
from ...core.variables import Variable
from ...judge.statement import (
    COSTS,
    Cyclic,
    Statement,
    Stop,
    duration_range,
    subject,
    times_seconds,
)
from ...plants.plant import Plant, require_plant
from ...plants.stillness import Position, rate_of, rest_rows, totals
from .limits import (
    Limits,
    common_limits,
    conditions_of,
    design_ranges,
    distinct,
    key_of,
    left_by_the_past,
    narrowed,
    range_of,
    settled_before,
    with_draught,
    with_given_pressures,
)
from .problem import Condition, Leg, Problem, Range, Symbols, budget, objective

DURATIONS: Range = (1e-3, 10.0)
"""Bounds of a free duration of one leg [s]."""


def formulate(plant: Plant, statement: Statement) -> Problem:
    """The Problem that a user's statement means for a plant; InputError where it means none."""
    require_plant(plant)
    symbols = Symbols()
    common = common_limits(plant, statement.bounds or {}, symbols)
    common.path = distinct([*common.path, *conditions_of(plant, statement.constraints)])
    stops = _stops(plant, statement)
    labels = [f"stop {i + 1}" for i in range(len(stops))]
    route = list(zip(labels, stops, strict=True))
    if statement.cyclic is True:
        route.append(route[0])
    goal = objective(
        plant, symbols, statement.minimise, statement.track, statement.integrand, statement.final
    )
    kept = tuple(common.path)
    common.path += [condition for _, condition in symbols.peaks]
    motions = _motions(plant, statement, len(route) - 1, common, symbols)
    closing = closing_states(plant, statement.cyclic)
    holding = Holding(plant, common.variables, kept, symbols, statement.inputs_jump)
    nodes, legs, values = _laid_out(plant, statement, route, motions, common, holding)
    left = left_by_the_past(plant, statement, stops[0], common.variables)
    nodes[0] += tuple(holding.at(labels[0], left))
    if statement.cyclic is True:  # the last node is the first: its own conditions would stand twice
        nodes[-1] = ()
    elif statement.cyclic == "mirrored":
        nodes[-1] = not_implied(plant, stops, nodes[-1], closing or {})
    _require_an_end(statement, legs)
    _require_a_motion(statement, stops, legs)
    goal = replace(goal, peaks=goal.peaks + (0.0,) * (len(symbols.m) - len(goal.peaks)))
    budgets = [
        each
        for term, value in (statement.budgets or {}).items()
        for each in budget(plant, term, value, symbols)
    ]
    spent = ca.vertcat(goal.integrand, *(b.integrand for b in budgets))
    used = [a for a in symbols.auxiliaries.values() if ca.depends_on(spent, a.symbol)]
    r, q, m = (ca.vertcat(*s) if s else ca.SX(0, 1) for s in (symbols.r, symbols.q, symbols.m))
    problem = Problem(
        plant,
        tuple(values),
        tuple(nodes),
        tuple(legs),
        closing,
        goal,
        tuple(budgets),
        design_ranges(plant, statement.design or {}),
        tuple(symbols.profiles),
        tuple(symbols.aims),
        r,
        q,
        m,
        tuple(used),
    )
    problem = with_draught(problem, statement, stops[0], partial(holding.at, labels[0]))
    return with_given_pressures(problem, statement, stops[0], holding.positions)


# ---- stops ----------------------------------------------------------------------------------
def _stops(plant: Plant, statement: Statement) -> list[Stop]:
    if isinstance(statement.stops, Mapping | Stop) or not all(
        isinstance(s, Mapping | Stop) for s in statement.stops
    ):
        raise InputError('stops must be a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]')
    if len(statement.stops) < 2:
        raise InputError(f"stops holds {len(statement.stops)}: a motion needs at least two stops")
    found = []
    for stop in statement.stops:
        stop = stop if isinstance(stop, Stop) else Stop(stop)
        values = {key_of(plant, n): _in_si(plant, n, v) for n, v in stop.values.items()}
        rest = statement.rest if stop.rest is None else stop.rest
        if stop.dwells and not rest:
            raise InputError(f"{stop}: a stop with a dwell is at rest; leave out rest=False")
        found.append(Stop(values, rest, stop.dwell, stop.within))
    return found


def _in_si(plant: Plant, name: str, value: Any) -> Any:
    """A value of a stop, or the ends of its range, with texts such as "20 mm" as numbers."""
    variable = subject(plant, name)[0]
    if isinstance(value, tuple | list):
        return tuple(v if v is None else _in_si(plant, name, v) for v in value)
    return variable.number(value, name) if is_quantity(value) else value


DWELLING = "dwell at "
"""What is held along a dwell is called this and the condition at its stop."""


def _laid_out(
    plant: Plant,
    statement: Statement,
    route: Sequence[tuple[str, Stop]],
    motions: Sequence[Leg],
    common: Limits,
    holding: Holding,
) -> tuple[list[tuple[Condition, ...]], list[Leg], list[dict[str, Any]]]:
    """Nodes, legs and the nodes' values; a dwell adds a leg behind its stop."""
    bounds = common.variables
    nodes, legs, values = [], [], []
    holding.positions = resting_positions(plant, [stop for _, stop in route])
    for i, (label, stop) in enumerate(route):
        closes = bool(statement.cyclic) and i == len(route) - 1
        # rest at the end of a cycle follows from that at its beginning
        asked = replace(stop, rest=False) if closes else stop
        begins = i == 0 and not statement.cyclic and asked.rest
        settled = settled_before(plant, stop, holding.positions) if begins else []
        conditions = tuple(_conditions(plant, label, asked, bounds, holding, settled))
        nodes.append(conditions)
        values.append(dict(stop.values))
        closes = closes and statement.cyclic is True
        if stop.dwells and not closes:
            if statement.cyclic == "mirrored" and i == len(route) - 1:
                raise InputError("cyclic = 'mirrored': give the dwell to stop 1, its image follows")
            within = _held(plant, conditions, stop)
            legs.append(
                Leg(
                    duration_range(stop.dwell, DURATIONS),
                    (*common.path, *within),
                    dict(bounds),
                    dwell=True,
                )
            )
            nodes.append(_left(plant, label, asked, bounds, holding))
            values.append(dict(stop.values))
        if i < len(motions):
            legs.append(motions[i])
    return nodes, legs, values


def _left(
    plant: Plant, label: str, stop: Stop, bounds: Mapping[str, Range], holding: Holding
) -> tuple[Condition, ...]:
    """Conditions at the end of a dwell: inputs of its own hold the plant there, and the inputs
    behind it are those of the next leg.
    """
    own = replace(holding, instead={})
    conditions = _conditions(plant, label, stop, bounds, own, ())
    named, rest = conditions[: len(stop.values)], conditions[len(stop.values) :]
    return (*(c for c in named if not ca.depends_on(c.expression, plant.u)), *rest)


def _held(plant: Plant, conditions: Sequence[Condition], stop: Stop) -> list[Condition]:
    """The values of a stop, with a margin, all along its dwell."""
    held = []
    for condition in conditions[: len(stop.values)]:
        margin = stop.within * condition.nominal
        held.append(
            Condition(
                f"{DWELLING}{condition.label}",
                condition.expression,
                condition.low - margin,
                condition.high + margin,
                margin,
                condition.shown,
            )
        )
    return held


def _conditions(
    plant: Plant,
    label: str,
    stop: Stop,
    bounds: Mapping[str, Range],
    holding: Holding,
    settled: Sequence[Condition],
) -> list[Condition]:
    if not stop.values:
        raise InputError(f"{label} is empty; name at least one variable, as in {{'x': 0.01}}")
    conditions = []
    for name, value in stop.values.items():
        variable, expression = subject(plant, name)
        if variable.causality == "parameter":
            raise InputError(f"{label}: {name} is a parameter, it cannot change along the motion")
        low, high = range_of(f"{label}: {name}", value, variable)
        least, most = bounds.get(name, (variable.min, variable.max))
        if (low > most or high < least) and least == most:
            raise InputError(
                f"{label}: {name} = {variable.exactly(low)}, but bounds hold it at "
                f"{variable.exactly(least)} all along; give (low, high) for a range"
            )
        if low > most or high < least:
            raise InputError(
                f"{label}: {name} = {variable.exactly(low)} is outside the stroke "
                f"{variable.exactly(least)} .. {variable.exactly(most)}"
            )
        conditions.append(
            Condition(f"{label}: {name}", expression, low, high, variable.nominal, variable)
        )
    if not stop.rest:
        return conditions
    return conditions + at_rest(plant, label, stop, holding, conditions, settled)


# ---- legs -------------------------------------------------------------------------------------
def _motions(
    plant: Plant, statement: Statement, count: int, common: Limits, symbols: Symbols
) -> list[Leg]:
    """The legs between the stops, without dwells."""
    legs = []
    for i, (phase, duration) in enumerate(statement.of_legs(count)):
        limits = narrowed(plant, common, f"phases[{i}].bounds", phase.bounds, symbols)
        limits.path = distinct([*limits.path, *conditions_of(plant, phase.constraints)])
        ends = duration_range(duration, DURATIONS)
        legs.append(Leg(ends, tuple(limits.path), limits.variables))
    return legs


def _require_a_motion(statement: Statement, stops: Sequence[Stop], legs: Sequence[Leg]) -> None:
    """Between two equal stops a motion as short as possible is none."""
    motions = [leg for leg in legs if not leg.dwell]
    asked = {term for term, weight in statement.weights.items() if weight}
    if asked != {"time"} or statement.track or statement.integrand is not None:
        return
    for i, ((one, other), leg) in enumerate(zip(pairwise(stops), motions, strict=False), start=1):
        if one.values == other.values and leg.duration == DURATIONS:
            raise InputError(
                f"stops {i} and {i + 1} are the same, {dict(one.values)}: the shortest motion "
                "between them is none; leave one out, give the stop a dwell, or fix the duration"
            )


def _require_an_end(statement: Statement, legs: Sequence[Leg]) -> None:
    """A free duration wants a reason to end."""
    asked = {term for term, weight in statement.weights.items() if weight}
    ended = statement.track or "time" in (statement.budgets or {})
    more = statement.integrand is not None or statement.final is not None or ended
    free = any(leg.duration[1] > leg.duration[0] for leg in legs)
    if not free or more or not asked:
        return
    if all(term == "rate" or (term in COSTS and COSTS[term].slower_is_less) for term in asked):
        term = min(asked)
        raise InputError(
            f"minimise = {term!r} needs a fixed duration (a slower motion always takes less); "
            f"give duration=0.5, say, or minimise={{'time': 1.0, {term!r}: 1e-3}}"
        )


def closing_states(plant: Plant, cyclic: Cyclic) -> dict[str, tuple[float, str]] | None:
    if cyclic is False or cyclic is None:
        return None
    sums = totals(plant)  # what only adds up never comes back
    if cyclic is True:
        return {v.name: (1.0, v.name) for v in plant.states if v.name not in sums}
    mirror = plant.mirror_map
    if not mirror:
        raise InputError(
            f"cyclic = 'mirrored': plant {plant.name!r} declares no mirror symmetry "
            "(unequal muscles have none); use cyclic=True"
        )
    return {v.name: mirror.get(v.name, (1.0, v.name)) for v in plant.states if v.name not in sums}


def not_implied(
    plant: Plant,
    stops: Sequence[Stop],
    last: tuple[Condition, ...],
    closing: Mapping[str, tuple[float, str]],
) -> tuple[Condition, ...]:
    """Of a mirrored motion's last node: what the first node's image does not say already."""
    if len(stops) != 2:
        raise InputError("cyclic = 'mirrored' takes two stops: the start and its mirror image")
    first = {n: range_of(n, v, plant.variable(n)) for n, v in stops[0].values.items()}
    kept = []
    for condition, name in zip(last, stops[1].values, strict=False):  # rest follows by symmetry
        sign, image = closing.get(name, (1.0, name))
        if image not in first:
            kept.append(condition)
            continue
        low, high = sorted(sign * v for v in first[image])
        if max(abs(condition.low - low), abs(condition.high - high)) > 1e-9 * condition.nominal:
            raise InputError(
                f"cyclic = 'mirrored': {condition.label} = {condition.shown.shown(condition.low)} "
                f"is not the mirror image of stop 1, {condition.shown.shown(low)}; use cyclic=True"
            )
    return tuple(kept)


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


HOLDS = " that holds it"
"""End of the label of an unknown that stands for an input where it holds the plant."""


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
    instead: dict[str, ca.SX] = field(default_factory=dict)
    """What stands for the inputs where they hold the plant, by the label of the stop."""

    def at(self, label: str, conditions: Sequence[Condition]) -> list[Condition]:
        """Conditions with the inputs that hold the plant at a stop."""
        if label not in self.instead:
            return list(conditions)
        u, held = self.plant.u, self.instead[label]
        return [replace(c, expression=ca.substitute(c.expression, u, held)) for c in conditions]

    def inputs(
        self, label: str, rows: Sequence[ca.SX], named: Sequence[Condition]
    ) -> list[Condition]:
        """Conditions on what stands for the inputs in the rows of rest; named : what the stop says
        besides, which holds under them, too.
        """
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
                    f"{label}: {variable.name}{HOLDS}",
                    held,
                    low,
                    high,
                    variable.nominal,
                    variable,
                )
            )
        if jumping:
            instead = self.instead[label] = ca.vertcat(*values)
            conditions += [
                replace(
                    c,
                    label=f"{label}: {c.label.removeprefix(f'{label}: ')} where it is held",
                    expression=ca.substitute(c.expression, plant.u, instead),
                )
                for c in (*self.path, *named)
                if ca.depends_on(c.expression, ca.vertcat(*jumping))
            ]
        return conditions


def at_rest(
    plant: Plant,
    label: str,
    stop: Stop,
    holding: Holding,
    named: Sequence[Condition] = (),
    settled: Sequence[Condition] = (),
) -> list[Condition]:
    """Rate and acceleration of every position are zero, where the stop says nothing else; and with
    the same inputs what else has settled there, and what the stop has ``named``.
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
    beside = holding.inputs(label, [c.expression for c in conditions], named)
    return holding.at(label, conditions) + beside


def _rate_of(plant: Plant, name: str, order: int) -> Variable:
    """What is shown of the ``order``-th derivative of a state."""
    state = plant.variable(name)
    unit = times_seconds(state.unit, -1)
    if order == 2:
        unit = times_seconds(unit, -1)
    return Variable("rate", "constraint", unit=unit, nominal=10**order * state.nominal)
