"""A planning problem in the user's words, checked and brought into one form."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import casadi as ca

from ...core.errors import InputError, PlanWarning, require_instance, require_positive
from ...core.variables import Variable
from ...operating.held import Memory, held
from ...plants.plant import Plant, require_plant
from ...plants.stillness import Position, rate_of, rest_rows, settled_names, totals
from ..transcription.guess import rest_point
from .limits import Limits, common_limits, conditions_of, design_ranges, key_of, narrowed, range_of
from .objective import Symbols, budget, objective
from .problem import Condition, Leg, Problem, Range
from .wording import Avoid, Constraint, Phase, Stop, subject, times_seconds

__all__ = ["Cyclic", "Wish", "pose"]

Cyclic: TypeAlias = 'bool | Literal["mirrored"]'

DURATIONS: Range = (1e-3, 10.0)
"""Bounds of a free duration of one leg [s]."""


@dataclass(frozen=True)
class Wish:
    """The arguments of :func:`pam_ocp.plan` that say what is wanted; see there."""

    stops: Sequence[Mapping[str, Any] | Stop]
    cyclic: Cyclic = False
    duration: Any = None
    minimise: str | Mapping[str, float] = "time"
    bounds: Mapping[str, Any] | None = None
    rest: bool = True
    memory: Memory = "virgin"
    jumps: bool = True
    """Whether inputs may jump at the stops."""
    phases: Sequence[Phase | None] | None = None
    constraints: Sequence[Constraint | Avoid] = ()
    track: Mapping[str, Any] | None = None
    budgets: Mapping[str, Any] | None = None
    design: Mapping[str, tuple[float, float]] | None = None
    integrand: ca.SX | None = None
    final: ca.SX | None = None

    def __post_init__(self) -> None:
        lists = (list, tuple)
        shown = 'give a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]'
        require_instance("stops", self.stops, (*lists, Mapping), shown)
        require_instance(
            "minimise", self.minimise, (str, Mapping), "give a term, or {term: weight}"
        )
        for argument in ("bounds", "track", "budgets", "design"):
            value = getattr(self, argument)
            require_instance(argument, value, Mapping, "give a mapping by name", none=True)
        require_instance("phases", self.phases, lists, "give a list of Phase or None", none=True)
        for i, phase in enumerate(self.phases or ()):
            require_instance(f"phases[{i}]", phase, Phase, "give a Phase or None", none=True)
        remedy = "give a list of Constraint and Avoid"
        require_instance("constraints", self.constraints, lists, remedy)


def pose(plant: Plant, wish: Wish) -> Problem:
    """Check a user's wish and state the Problem."""
    require_plant(plant)
    symbols = Symbols()
    common = common_limits(plant, wish.bounds or {}, symbols)
    common.path += conditions_of(plant, wish.constraints)
    stops = _stops(plant, wish)
    labels = [f"stop {i + 1}" for i in range(len(stops))]
    route = list(zip(labels, stops, strict=True))
    if wish.cyclic is True:
        route.append(route[0])
    goal = objective(plant, symbols, wish.minimise, wish.track, wish.integrand, wish.final)
    common.path += [condition for _, condition in symbols.peaks]
    motions = _motions(plant, wish, len(route) - 1, common, symbols)
    closing = _closing(plant, wish.cyclic)
    holding = _Holding(plant, common.variables, symbols, _inputs_jump(wish))
    nodes, legs, values = _laid_out(plant, wish, route, motions, common.variables, holding)
    nodes[0] += tuple(_past(plant, wish, stops[0], common.variables))
    if wish.cyclic is True:  # the last node is the first: its own conditions would stand twice
        nodes[-1] = ()
    elif wish.cyclic == "mirrored":
        nodes[-1] = _not_implied(plant, stops, nodes[-1], closing or {})
    _require_an_end(wish, legs)
    goal = replace(goal, peaks=goal.peaks + (0.0,) * (len(symbols.m) - len(goal.peaks)))
    budgets = [
        each
        for term, value in (wish.budgets or {}).items()
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
        design_ranges(plant, wish.design or {}),
        tuple(symbols.profiles),
        tuple(symbols.aims),
        r,
        q,
        m,
        tuple(used),
    )
    return _filled(problem, wish, stops[0], holding.positions)


# ---- stops ----------------------------------------------------------------------------------
def _stops(plant: Plant, wish: Wish) -> list[Stop]:
    if isinstance(wish.stops, Mapping | Stop) or not all(
        isinstance(s, Mapping | Stop) for s in wish.stops
    ):
        raise InputError('stops must be a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]')
    if len(wish.stops) < 2:
        raise InputError(f"stops = {list(wish.stops)}: a motion needs at least two stops")
    found = []
    for stop in wish.stops:
        stop = stop if isinstance(stop, Stop) else Stop(stop)
        values = {key_of(plant, n): v for n, v in stop.values.items()}
        rest = wish.rest if stop.rest is None else stop.rest
        if stop.dwells and not rest:
            raise InputError(f"{stop}: a stop with a dwell is at rest; leave out rest=False")
        found.append(Stop(values, rest, stop.dwell, stop.within))
    return found


def _laid_out(
    plant: Plant,
    wish: Wish,
    route: Sequence[tuple[str, Stop]],
    motions: Sequence[Leg],
    bounds: Mapping[str, Range],
    holding: _Holding,
) -> tuple[list[tuple[Condition, ...]], list[Leg], list[dict[str, Any]]]:
    """Nodes, legs and the nodes' values; a dwell adds a leg behind its stop."""
    nodes, legs, values = [], [], []
    holding.positions = _positions(plant, [stop for _, stop in route])
    for i, (label, stop) in enumerate(route):
        closes = bool(wish.cyclic) and i == len(route) - 1
        # rest at the end of a cycle follows from that at its beginning
        asked = replace(stop, rest=False) if closes else stop
        conditions = tuple(_conditions(plant, label, asked, bounds, holding))
        nodes.append(conditions)
        values.append(dict(stop.values))
        closes = closes and wish.cyclic is True
        if stop.dwells and not closes:
            if wish.cyclic == "mirrored" and i == len(route) - 1:
                raise InputError("cyclic = 'mirrored': give the dwell to stop 1, its image follows")
            within = _held(plant, conditions, stop)
            path = (*(motions[i] if i < len(motions) else motions[-1]).path, *within)
            legs.append(Leg(_duration(stop.dwell), path, dict(bounds), dwell=True))
            nodes.append(conditions)
            values.append(dict(stop.values))
        if i < len(motions):
            legs.append(motions[i])
    return nodes, legs, values


def _held(plant: Plant, conditions: Sequence[Condition], stop: Stop) -> list[Condition]:
    """The values of a stop, with a margin, all along its dwell."""
    held = []
    for condition in conditions[: len(stop.values)]:
        margin = stop.within * condition.nominal
        held.append(
            Condition(
                f"dwell at {condition.label}",
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
    holding: _Holding,
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
        if low > most or high < least:
            raise InputError(
                f"{label}: {name} = {variable.shown(low)} is outside the stroke "
                f"{variable.shown(least)} .. {variable.shown(most)}"
            )
        conditions.append(
            Condition(f"{label}: {name}", expression, low, high, variable.nominal, variable)
        )
    return conditions + (_at_rest(plant, label, stop, holding) if stop.rest else [])


def _positions(plant: Plant, stops: Sequence[Stop]) -> tuple[Position, ...]:
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
            "whose "
            "rate, where it vanishes, does not depend on the state itself), and no input that "
            "could hold "
            "what the stops name; give rest=False, and what shall vanish in the stops, such as "
            "{'der(NAME)': 0.0}"
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
class _Holding:
    """How rest is asked for: what an input sets at once need not vanish before the stop.

    There it is enough that admissible inputs would hold the plant: unknowns of their own, so that
    the last interval of piecewise constant inputs is not spent on zero acceleration.
    """

    plant: Plant
    bounds: Mapping[str, Range]
    symbols: Symbols
    jumps: bool
    positions: tuple[Position, ...] = ()

    def inputs(self, label: str, rows: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX, list[Condition]]:
        """(inputs, what stands for them in the rows of rest, conditions on the latter)."""
        plant = self.plant
        values, conditions = [], []
        asked = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        for i, variable in enumerate(plant.inputs):
            jumping = self.jumps and not variable.disturbance and ca.depends_on(asked, plant.u[i])
            if not jumping:
                values.append(plant.u[i])
                continue
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
        return plant.u, ca.vertcat(*values), conditions


def _inputs_jump(wish: Wish) -> bool:
    """Whether inputs may jump: linear ones cannot,
    and where their rate costs they better do not.
    """
    weights = {wish.minimise: 1.0} if isinstance(wish.minimise, str) else wish.minimise
    return wish.jumps and "rate" not in weights


def _at_rest(plant: Plant, label: str, stop: Stop, holding: _Holding) -> list[Condition]:
    """Rate and acceleration of every position are zero, where the stop says nothing else."""
    conditions = []
    positions = holding.positions
    for position, order, expression in plant.cached(
        ("rest rows", positions), lambda: rest_rows(plant, positions)
    ):
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


def _past(plant: Plant, wish: Wish, first: Stop, bounds: Mapping[str, Range]) -> list[Condition]:
    """What the past left at the first stop, of states that nobody could set: memories, lags,
    totals.
    """

    def condition(name: str, words: str, low: float, high: float) -> Condition:
        variable, expression = subject(plant, name)
        return Condition(
            f"stop 1: {name} {words}", expression, low, high, variable.nominal, variable
        )

    sums = [n for n in totals(plant) if n not in first.values]
    starts = {n: float(plant.variable(n).start or 0.0) for n in sums}
    conditions = [condition(n, "at its start", value, value) for n, value in starts.items()]
    memory = {n: v for n, v in held(plant, wish.memory).items() if n not in first.values}
    if wish.cyclic:  # the cycle itself says what they hold
        if wish.memory != "virgin":
            raise InputError(
                f"memory = {wish.memory!r}: a cyclic motion closes its memories by itself; leave "
                "it out"
            )
        ranges = {n: (plant.variable(n).min, plant.variable(n).max) for n in memory}
        return conditions + [condition(n, "in its range", *ends) for n, ends in ranges.items()]
    conditions += [condition(n, "held", value, value) for n, value in memory.items()]
    settled = [n for n in settled_names(plant) if n not in first.values]
    return conditions + [condition(f"der({n})", "settled", 0.0, 0.0) for n in settled]


def _closing(plant: Plant, cyclic: Cyclic) -> dict[str, tuple[float, str]] | None:
    if cyclic is False or cyclic is None:
        return None
    sums = totals(plant)  # what only adds up never comes back
    if cyclic is True:
        return {v.name: (1.0, v.name) for v in plant.states if v.name not in sums}
    if cyclic != "mirrored":
        raise InputError(f"cyclic = {cyclic!r}: choose True, False or 'mirrored'")
    mirror = plant.mirror_map
    if not mirror:
        raise InputError(
            f"cyclic = 'mirrored': plant {plant.name!r} declares no mirror symmetry "
            "(unequal muscles have none); use cyclic=True"
        )
    return {v.name: mirror.get(v.name, (1.0, v.name)) for v in plant.states if v.name not in sums}


def _not_implied(
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
                "is "
                f"not the mirror image of stop 1, {condition.shown.shown(low)}; use cyclic=True"
            )
    return tuple(kept)


def _filled(problem: Problem, wish: Wish, first: Stop, positions: tuple[Position, ...]) -> Problem:
    """Pressures at the first stop are no gift where the supply's air counts.

    A motion that may choose them is made by venting what it was given. Where neither the cycle nor
    the
    first stop says what they are, they are those at rest there, nearest to their start values.
    """
    plant = problem.plant
    weights = {wish.minimise: 1.0} if isinstance(wish.minimise, str) else wish.minimise
    asked = [term for term in ("air", "exergy") if weights.get(term)]
    if not asked or wish.cyclic:
        return problem
    places = {n for p in positions for n in (p.name, *p.velocities)}
    known = {*places, *settled_names(plant), *totals(plant), *first.values}
    free = [v.name for v in plant.states if v.name not in known and not v.memory]
    spoken = ca.vertcat(*(subject(plant, n)[1] for n in first.values))
    symbols = ca.vertcat(*(plant.expression(n) for n in free))
    if not free or ca.depends_on(spoken, symbols):
        return problem
    x = rest_point(problem, problem.stops[0])
    values = {v.name: float(x[i]) for i, v in enumerate(plant.states) if v.name in free}
    shown = ", ".join(f"{n} = {plant.variable(n).shown(value)}" for n, value in values.items())
    warnings.warn(
        f"minimise = {asked[0]!r} leaves no pressure to choose at the first stop, or the motion "
        "would "
        f"vent what it begins with: it begins at rest with {shown}. Name other values in the first "
        "stop, or give cyclic=True",
        PlanWarning,
        stacklevel=5,
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
    # with pressures at rest accelerations vanish by themselves: they would be said twice
    kept = [
        c
        for c in problem.nodes[0]
        if not (c.label.endswith("at rest") and ca.depends_on(c.expression, symbols))
    ]
    return replace(problem, nodes=((*kept, *given), *problem.nodes[1:]))


# ---- legs -------------------------------------------------------------------------------------
def _motions(plant: Plant, wish: Wish, count: int, common: Limits, symbols: Symbols) -> list[Leg]:
    """The legs between the stops, without dwells."""
    durations = _durations(wish.duration, count)
    phases = list(wish.phases or [None] * count)
    if len(phases) != count:
        raise InputError(
            f"phases holds {len(phases)} entries for {count} phases; give a Phase or None for each"
        )
    legs = []
    for i, (phase, duration) in enumerate(zip(phases, durations, strict=True)):
        limits = common
        if phase is not None:
            limits = narrowed(plant, common, f"phases[{i}].bounds", phase.bounds, symbols)
            limits.path.extend(conditions_of(plant, phase.constraints))
            duration = duration if phase.duration is None else _duration(phase.duration)
        legs.append(Leg(duration, tuple(limits.path), limits.variables))
    return legs


def _durations(duration: Any, legs: int) -> tuple[Range, ...]:
    if isinstance(duration, Sequence) and not isinstance(duration, tuple | str):
        if len(duration) != legs:
            raise InputError(
                f"duration holds {len(duration)} entries for {legs} phases; give one per phase"
            )
        return tuple(_duration(d) for d in duration)
    return (_duration(duration),) * legs


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


def _require_an_end(wish: Wish, legs: Sequence[Leg]) -> None:
    """A free duration wants a reason to end."""
    weights = {wish.minimise: 1.0} if isinstance(wish.minimise, str) else dict(wish.minimise)
    asked = {term for term, weight in weights.items() if weight}
    ended = wish.track or "time" in (wish.budgets or {})
    more = wish.integrand is not None or wish.final is not None or ended
    free = any(leg.duration[1] > leg.duration[0] for leg in legs)
    if free and asked and not more and asked <= {"effort", "rate"}:
        raise InputError(
            "minimise = 'effort' needs a fixed duration (a slower motion always takes less); "
            "give duration=0.5, say, or minimise={'time': 1.0, 'effort': 1e-3}"
        )
