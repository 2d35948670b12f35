"""What a statement asks of a motion, read from its words alone: points, limits, sums.

A planner reads the same words into conditions of its own; nothing of that is seen here, so that
what one of them overlooks the other names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import casadi as ca

from ..core.errors import InputError, UnknownNameError, require_finite
from ..core.variables import Variable
from ..plants.plant import Plant
from .statement import (
    COSTS,
    Avoid,
    Constraint,
    Duration,
    Profile,
    Statement,
    Stop,
    aim_and_weight,
    budget_range,
    duration_range,
    ranged_outputs,
    require_expression,
    subject,
    times_seconds,
)

INF = math.inf
End: TypeAlias = "float | Profile"
KNOTS = 1000
"""Of a profile: with more they lie closer than what is looked at."""
_FORM = re.compile(r"(integral|square|final|peak)\((.+)\)$")


@dataclass(frozen=True, eq=False)
class Limit:
    """low <= expression <= high; an end may be a Profile over time."""

    label: str
    expression: ca.SX
    low: End
    high: End
    nominal: float
    axes: tuple[ca.SX, ...] = ()
    """Of a forbidden region: what the expression is the length of."""


@dataclass(frozen=True, eq=False)
class Point:
    """A stop at its time [s]."""

    time: float
    label: str
    stop: Stop
    rest: bool
    limits: tuple[Limit, ...]
    left: bool = False
    """Whether a dwell ends here: what inputs are then is the next leg's."""


@dataclass(frozen=True, eq=False)
class Span:
    """What is limited from one time to another [s]."""

    begin: float
    end: float
    limits: tuple[Limit, ...]


@dataclass(frozen=True, eq=False)
class Sum:
    """low <= integral of the integrand over the motion <= high."""

    label: str
    integrand: ca.SX
    low: float
    high: float
    nominal: float


@dataclass(frozen=True, eq=False)
class Goal:
    """The objective: ``time`` T + integral + final + peaks + ``rate`` times that of the inputs."""

    time: float
    rate: float
    integrand: ca.SX
    final: ca.SX
    peaks: tuple[tuple[float, ca.SX], ...]
    tracked: tuple[tuple[float, ca.SX, End], ...]
    """(weight, value in nominals, aim in nominals or Profile over nominal 1)."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A statement, read for a motion whose legs take given times."""

    points: tuple[Point, ...]
    always: tuple[Limit, ...]
    """What holds on all legs and at all stops."""
    spans: tuple[Span, ...]
    sums: tuple[Sum, ...]
    goal: Goal
    times: dict[str, tuple[float, float, float]]
    """{"duration of" a leg: (it, shortest, longest)} [s]."""
    design: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def knots(self) -> list[float]:
        """Times at which profiles have their values [s]."""
        limits = (limit for span in self.spans for limit in span.limits)
        ends = [end for limit in limits for end in (limit.low, limit.high)]
        ends += [aim for _, _, aim in self.goal.tracked]
        found = {e: e.t.tolist() for e in ends if isinstance(e, Profile)}
        last = self.points[-1].time
        return [t for each in found.values() if len(each) <= KNOTS for t in each if 0 < t < last]


class _AsItIs:
    """Running costs with max(., 0) as it stands."""

    def positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        return ca.fmax(expression, 0)


def asked(plant: Plant, statement: Statement, durations: Sequence[float]) -> Asked:
    """What is asked of a motion of this plant.

    durations : of each leg, dwells among them [s].

    Raises InputError where the words mean nothing for this plant, or the motion has other legs.
    """
    stops = [s if isinstance(s, Stop) else Stop(s) for s in statement.stops]
    route = [(f"stop {i}", stop) for i, stop in enumerate(stops, start=1)]
    if statement.cyclic is True:
        route.append(route[0])
    elif statement.cyclic and not plant.mirror_map:
        raise InputError(f"cyclic = 'mirrored': plant {plant.name!r} declares no mirror symmetry")
    points, legs = _laid_out(plant, statement, route, durations)
    common = _limits(plant, statement.bounds or {}, statement.constraints, _own(plant))
    each = statement.of_legs(len(route) - 1)
    spans, times = [], {}
    for leg in legs:
        limits, wanted = common, leg.dwell
        if leg.number is not None:
            phase, wanted = each[leg.number]
            limits = _limits(plant, phase.bounds, phase.constraints, common)
        spans.append(Span(leg.begin, leg.end, (*limits.values(), *leg.held)))
        if wanted is not None:
            ends = duration_range(wanted, (0.0, INF))
            times[f"duration of {leg.label}"] = (leg.end - leg.begin, *ends)
    sums = tuple(s for t, v in (statement.budgets or {}).items() for s in [_sum(plant, t, v)])
    design = {
        plant.variable(n).name: _ends(plant.variable(n), f"design[{n!r}]", v)
        for n, v in (statement.design or {}).items()
    }
    goal = _goal(plant, statement)
    always = tuple(common.values())
    return Asked(tuple(points), always, tuple(spans), sums, goal, times, design)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class _Leg:
    """From one time to another [s]. number : among the motions, None of a dwell, which lasts
    ``dwell`` and holds some values.
    """

    label: str
    begin: float
    end: float
    number: int | None
    dwell: Duration = None
    held: tuple[Limit, ...] = ()


def _laid_out(
    plant: Plant,
    statement: Statement,
    route: Sequence[tuple[str, Stop]],
    durations: Sequence[float],
) -> tuple[list[Point], list[_Leg]]:
    """(points, legs) in time."""
    last = len(route) - 1
    dwells = [
        s.dwells and not (statement.cyclic is True and i == last) for i, (_, s) in enumerate(route)
    ]
    if len(durations) != last + sum(dwells) or last < 1:
        raise InputError(
            f"durations: {len(durations)} legs for {len(statement.stops)} stops; give one for each "
            "motion between two stops, and one for each dwell"
        )
    points, legs, now, rest = [], [], 0.0, iter(durations)
    for i, (label, stop) in enumerate(route):
        still = statement.rest if stop.rest is None else stop.rest
        named = tuple(_named(plant, label, stop))
        points.append(Point(now, label, stop, still, named))
        if dwells[i]:
            then = now + next(rest)
            margins = (stop.within * limit.nominal for limit in named)
            held = tuple(
                replace(c, label=f"dwell at {c.label}", low=_by(c.low, -m), high=_by(c.high, m))
                for c, m in zip(named, margins, strict=True)
            )
            legs.append(_Leg(f"the dwell at {label}", now, then, None, stop.dwell, held))
            now = then
            points.append(Point(now, label, stop, still, named, left=True))
        if i < last:
            then = now + next(rest)
            legs.append(_Leg(f"leg {i + 1}", now, then, i))
            now = then
    return points, legs


def _by(end: End, margin: float) -> End:
    """An end of a limit, moved."""
    if isinstance(end, Profile):
        return Profile(end.t, end.values + margin, end.smooth)
    return end + margin


def _named(plant: Plant, label: str, stop: Stop) -> Iterator[Limit]:
    for name, value in stop.values.items():
        variable, expression = subject(plant, name)
        low, high = _ends(variable, f"{label}: {name}", value)
        yield Limit(f"{label}: {name}", expression, low, high, variable.nominal)


# ---- limits -----------------------------------------------------------------------------------
def _own(plant: Plant) -> dict[str, Limit]:
    """The plant's own: ranges of states, inputs and outputs, path constraints."""
    found = {}
    for v in (*plant.states, *plant.inputs, *plant.constraints, *ranged_outputs(plant)):
        low, high = (float(v.start or 0.0),) * 2 if v.disturbance else (v.min, v.max)
        found[v.name] = Limit(v.name, plant.expression(v.name), low, high, v.nominal)
    return found


def _limits(
    plant: Plant,
    bounds: Mapping[str, Any],
    constraints: Sequence[Constraint | Avoid],
    common: Mapping[str, Limit],
) -> dict[str, Limit]:
    """Limits by name, narrowed by a user's bounds and constraints."""
    found = dict(common)
    for name, value in bounds.items():
        variable, expression = subject(plant, name)
        key = name if name.startswith("der(") else variable.name
        low, high = _ends(variable, f"bounds[{name!r}]", value)
        if variable.disturbance:
            found[key] = Limit(key, expression, low, high, variable.nominal)
            continue
        ends: tuple[tuple[End, End, str], ...] = ((low, INF, "above"), (-INF, high, "below"))
        for least, most, side in ends:
            old = found.get(key)
            changing = isinstance(least, Profile) or isinstance(most, Profile)
            if changing:  # each holds, also those of the whole motion beside those of a leg
                label = f"{key} {side} its profile"
                limit = Limit(label, expression, least, most, variable.nominal)
                found[f"{len(found)} {label}"] = limit
            elif old is None:
                found[key] = Limit(key, expression, least, most, variable.nominal)
            else:
                least, most = max(least, old.low), min(most, old.high)  # type: ignore[type-var]
                found[key] = replace(old, low=least, high=most)
    for i, given in enumerate(constraints):
        limit = _region(plant, given) if isinstance(given, Avoid) else _constraint(plant, given)
        found[f"{len(found)}.{i} {limit.label}"] = limit
    return found


def _constraint(plant: Plant, given: Constraint) -> Limit:
    require_expression(plant, f"Constraint {given.name!r}", given.expression)
    return Limit(given.name, given.expression, *given.ends, given.nominal)


def _region(plant: Plant, given: Avoid) -> Limit:
    """Outside of an ellipsoid: the distance from its centre in half widths is one or more."""
    axes = tuple(given.axes(plant))
    return Limit(given.name, ca.norm_2(ca.vertcat(*axes)), 1.0, INF, 1.0, axes)


def _ends(variable: Variable, argument: str, value: Any) -> tuple[End, End]:
    """(low, high) from a value, a pair with None for an open end, or a Profile."""
    if isinstance(value, Profile):
        return value, value
    pair = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2
    given = value if pair else (value, value)
    low, high = (
        v if isinstance(v, Profile) else default if v is None else _number(variable, argument, v)
        for v, default in zip(given, (-INF, INF), strict=True)
    )
    return low, high


def _number(variable: Variable, argument: str, value: Any) -> float:
    if isinstance(value, float | int) and math.isinf(value):
        return float(value)
    return require_finite(argument, value, variable.unit)


# ---- sums -------------------------------------------------------------------------------------
def _running(plant: Plant, term: str) -> tuple[ca.SX, float, str]:
    """(integrand in SI, nominal and unit of its integral) of a running term."""
    if term in COSTS:
        total = COSTS[term].total
        return COSTS[term].expression(plant, _AsItIs()), total.nominal, total.unit
    form = _FORM.match(term)
    if not form or form[1] not in ("integral", "square"):
        raise UnknownNameError(
            "objective", term, (*COSTS, "rate", "integral(NAME)", "square(NAME)")
        )
    variable, expression = subject(plant, form[2])
    if form[1] == "square":
        return (expression / variable.nominal) ** 2, 1.0, "s"
    return expression, variable.nominal, times_seconds(variable.unit)


def unit_of_sum(plant: Plant, term: str) -> str:
    """The unit of the integral of a running term."""
    return _running(plant, term)[2]


def _sum(plant: Plant, term: str, value: Any) -> Sum:
    integrand, nominal, unit = _running(plant, term)
    low, high = budget_range(term, value, unit)
    return Sum(f"budget of {term}", integrand, low, high, nominal)


def _goal(plant: Plant, statement: Statement) -> Goal:
    integrand, final = ca.SX(0), ca.SX(0)
    peaks, tracked = [], []
    for term, weight in statement.weights.items():
        form = _FORM.match(term)
        if form and form[1] in ("final", "peak"):
            variable, expression = subject(plant, form[2])
            if form[1] == "final":
                final += weight * expression / variable.nominal
            elif weight:
                peaks.append((float(weight), expression / variable.nominal))
        elif term not in ("time", "rate"):
            value, nominal, _ = _running(plant, term)
            integrand += weight * value / nominal
    for name, wanted in (statement.track or {}).items():
        variable = plant.variable(name)
        aim, weight = aim_and_weight(name, wanted)
        value = plant.expression(variable.name) / variable.nominal
        if not isinstance(aim, Profile):
            aim = require_finite(f"track[{name!r}]", aim, variable.unit) / variable.nominal
            integrand += weight * (value - aim) ** 2
        else:
            scaled = Profile(aim.t, aim.values / variable.nominal, aim.smooth)
            tracked.append((float(weight), value, scaled))
    for argument in ("integrand", "final"):
        if (given := getattr(statement, argument)) is not None:
            require_expression(plant, argument, given)
    integrand += 0 if statement.integrand is None else statement.integrand
    final += 0 if statement.final is None else statement.final
    weights = statement.weights
    return Goal(
        float(weights.get("time", 0.0)),
        float(weights.get("rate", 0.0)),
        integrand,
        final,
        tuple(peaks),
        tuple(tracked),
    )
