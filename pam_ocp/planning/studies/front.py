"""pareto: the front of two objectives, by the epsilon-constraint method."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ... import courtesy
from ...core.cases import ending
from ...core.errors import InputError, PlanError, require_count, require_positive
from ...core.executors import Place, placed
from ...core.progress import counted
from ...core.shown import shown
from ...core.stop import TimeIsUp, deadline, verb
from ...core.variables import Variable
from ...judge.motion import objectives
from ...judge.statement import Profile, Stop, budget_range, subject
from ...plants.plant import Plant, require_plant
from ..planner import PlanKeywords, Planner
from ..problem.limits import range_of
from ..problem.problem import budget
from ..result import Plan

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from typing_extensions import Unpack

Array: TypeAlias = NDArray[np.float64]
_Point: TypeAlias = tuple[Plan, float, float]
_Points: TypeAlias = tuple[list[_Point], list[tuple[float, str]]]
"""Those found, and (bound of the first objective, message) of those that were not."""

_PEAK = re.compile(r"peak\((.+)\)$")
_UNBOUNDED = 1e25
"""As a budget: none. (IPOPT takes 1e19 in units of nominal for infinite.)"""
SLOWEST = 3.0
"""The end of a sweep over time where nothing else ends it, in shortest durations."""
CONTINUOUS = 1e-12
"""Weight of the inputs' rates that keeps inputs from jumping, and no more."""
POLISH = 1e-4
"""What the second objective weighs, relative to the first, to choose among equally good anchors."""
SAME = 1e-7
"""By so much of itself the second must fall where the first may be larger: solvers know no more."""


@shown
@dataclass(frozen=True, eq=False)
class Pareto:
    """Plans along the front of two objectives,
    from the least of the first to that of the second.

    Examples
    --------
    >>> front = pam.pareto(slide, [{"x": -0.01}, {"x": 0.01}], points=3)
    >>> bool(np.all(np.diff(front.values[:, 1]) < 0))
    True
    """

    first: Variable
    """Name and unit of the first objective."""
    second: Variable
    plans: tuple[Plan, ...]
    values: Array
    """(plans, 2) both objectives of each plan, in SI."""
    failures: tuple[tuple[float, str], ...] = ()
    """(bound of the first objective, message) of points that are not on the front."""

    @property
    def knee(self) -> int:
        """The plan farthest below the straight line between the ends, each objective scaled to 0 ..
        1: past it, little more of one costs much of the other.
        """
        span = np.ptp(self.values, axis=0)
        scaled = (self.values - self.values.min(axis=0)) / np.where(span > 0, span, 1.0)
        return int(np.argmin(scaled.sum(axis=1)))

    @property
    def unverified(self) -> tuple[int, ...]:
        """The plans that are not verified; ``plans[i].verdict`` says why."""
        return tuple(i for i, plan in enumerate(self.plans) if not plan.verified)

    def __len__(self) -> int:
        return len(self.plans)

    def _table_rows(self) -> list[dict[str, Any]]:
        """Of its table: both objectives of each plan in SI, and what is known of it."""
        knee = self.knee
        return [
            {
                f"{self.first.name} [{self.first.unit}]": float(a),
                f"{self.second.name} [{self.second.unit}]": float(b),
                "verified": plan.verified,
                "knee": i == knee,
                "replay_error": plan.replay_error,
            }
            for i, (plan, (a, b)) in enumerate(zip(self.plans, self.values, strict=True))
        ]

    def plot(self) -> Figure:
        """The front, its ends and its knee; plans that are not verified crossed out."""
        return courtesy.plot_pareto(self)

    def __str__(self) -> str:
        wrong = self.unverified
        lines = [f"NOT VERIFIED: {len(wrong)} of {len(self)} plans, marked below"] if wrong else []
        lines += [
            f"{self.first.name:>18}{self.second.name:>18}{'replay error':>15}{'iterations':>12}"
        ]
        for i, (plan, row) in enumerate(zip(self.plans, self.values, strict=True)):
            cells = "".join(
                f"{v.shown(x):>18}" for v, x in zip((self.first, self.second), row, strict=True)
            )
            mark = "  knee" if i == self.knee else ""
            mark += "" if plan.verified else f"  {plan.verdict}"
            lines.append(
                f"{cells}{plan.replay_error:>15.1e}{plan.statistics['iterations']:>12}{mark}"
            )
        lines += [f"not found at {self.first.shown(b)}: {m}" for b, m in self.failures]
        return "\n".join(lines)


@verb
def pareto(
    plant: Plant,
    stops: Sequence[Mapping[str, Any] | Stop],
    *,
    first: str = "time",
    second: str = "effort",
    points: int = 11,
    until: float | None = None,
    time_limit: float | None = None,
    executor: Place = None,
    **arguments: Unpack[PlanKeywords],
) -> Pareto:
    """The front of two objectives: no plan on it is better in one without being worse in the other.

    The least of ``first`` alone and the least of ``second`` alone are its ends; between them
    ``second`` is minimised under bounds of ``first`` (epsilon-constraint method: Haimes, Lasdon and
    Wismer, IEEE Trans. SMC 1, 1971), in geometric steps where both ends are positive, each point
    from its neighbour's solution.

    Parameters
    ----------
    stops, arguments : as for :func:`pam_ocp.plan`, but ``minimise``, ``tolerance``, ``guess``,
        ``starts``.
    first : "time", "effort", "work", "air", "exergy", "integral(NAME)", "square(NAME)" or
        "peak(NAME)"; second : these, or "rate" or "final(NAME)".
    points : on the front, both ends included.
    until : the largest value of ``first`` [SI]; by default its value where ``second`` is least, or
        3 times the least time where a slower motion always takes less.
    time_limit : [s]; the points that are not reached stand in ``failures``. OutOfTime when an end
        is not reached.
    executor : None: the points one after the other, here, which is the least work. Else where they
        are planned side by side, as for :func:`pam_ocp.each` (0: here): each from the plan with the
        least ``second``, so that it is the same wherever that is. Pays where a plan takes seconds.

    Raises InputError for objectives that cannot be bounded, PlanError when an end is not found;
    points between that are not found stand in ``failures``, as do those that another is no worse
    than in either objective. Values are those of the judge, peaks those at the plan's points.

    Examples
    --------
    >>> front = pam.pareto(slide, [{"x": -0.01}, {"x": 0.01}], points=3)
    >>> front.values.shape, front.failures
    ((3, 2), ())
    """
    require_plant(plant)
    require_count("points", points, 2)
    if first == second:
        raise InputError(f"first and second are both {first!r}: give two objectives")
    place = placed(executor)
    for name in ("minimise", "tolerance", "guess", "starts"):
        if name in arguments:
            raise InputError(
                f"{name} is not an argument of pareto; it is what pareto varies or sets"
            )
    sweep = _Sweep(plant, stops, _Term(plant, first), _Term(plant, second), arguments)
    if not sweep.first.bounded:
        raise InputError(f"first = {first!r} cannot be bounded; exchange first and second")
    least = sweep.least_first()
    last = sweep.least_second(least, until)
    low, high = least[1], last[1]
    if high <= low:  # one plan is best in both
        return sweep.result([last if last[2] <= least[2] else least], [])
    spaced = np.geomspace if low > 0 else np.linspace
    bounds = spaced(low, high, points)[-2:0:-1].tolist()
    between = sweep.in_turn if place is None else partial(sweep.side_by_side, place)
    found, failures = between(bounds, last[0])
    return sweep.result([least, *found[::-1], last], failures)


class _Term:
    """An objective by name: how its value is read, and how it is bounded."""

    def __init__(self, plant: Plant, name: str) -> None:
        self.name = name
        peak = _PEAK.match(name)
        self.peak = plant.variable(peak[1]).name if peak else None
        self.bounded = True
        if self.peak is not None:
            of = plant.variable(self.peak)
            self.variable = Variable(
                "peak", "output", unit=of.unit, nominal=of.nominal, display_unit=of.display_unit
            )
        elif name == "rate":
            self.variable, self.bounded = Variable("rate", "output", unit="1/s"), False
        elif name.startswith("final("):
            of = subject(plant, name[6:-1])[0]
            self.variable = Variable("final", "output", unit=of.unit, nominal=of.nominal)
            self.bounded = False
        else:
            self.variable = budget(plant, name, 0.0)[0].shown

    def limited(self, arguments: dict[str, Any], most: float | None) -> None:
        """Bound it in the arguments of plan, on top of what the user says; None: by no bound, in
        the same form. Raises InputError.
        """
        if not self.bounded:
            return
        name = self.peak or self.name
        key, limit = ("bounds", inf) if self.peak else ("budgets", _UNBOUNDED)
        most = limit if most is None else most
        own = arguments.get(key) or {}
        given, low, high = own.get(name), None, inf
        if given is not None and self.peak:
            if isinstance(given, Sequence) and any(isinstance(v, Profile) for v in given):
                raise InputError(
                    f"bounds[{name!r}] is a Profile; a sweep of {self.name} takes numbers there"
                )
            low, high = range_of(f"bounds[{name!r}]", given, self.variable)
        elif given is not None:
            low, high = budget_range(name, given, self.variable.unit)
        low = None if low == -inf else low
        arguments[key] = {**own, name: (low, min(most, high))}


class _Sweep:
    """The planners of a front."""

    def __init__(
        self, plant: Plant, stops: Any, first: _Term, second: _Term, arguments: Mapping[str, Any]
    ) -> None:
        self.plant, self.stops, self.first, self.second = plant, stops, first, second
        self.arguments = dict(arguments)
        self.planner: Planner | None = None

    def _with(self, *terms: tuple[_Term, float | None]) -> dict[str, Any]:
        """The user's arguments with bounds of terms on top."""
        found = dict(self.arguments)
        for term, most in terms:
            term.limited(found, most)
        return found

    def least_first(self) -> _Point:
        """The plan with the least of the first; among equally good ones,
        with little of the second.
        """
        asked = self._with((self.second, None))
        alone: dict[str, float] = {self.first.name: 1.0}
        if self.second.name == "rate":  # inputs that jump have none: they shall not
            alone["rate"] = CONTINUOUS
        plan, one, two = found = self.point(
            Planner(self.plant, self.stops, minimise=alone, **asked)()
        )
        if not self.second.bounded or two <= 0 or one <= 0:
            return found
        sizes = one / self.first.variable.nominal, two / self.second.variable.nominal
        weights = {self.first.name: 1.0, self.second.name: POLISH * sizes[0] / sizes[1]}
        try:
            improved = self.point(
                Planner(self.plant, self.stops, minimise=weights, **asked)(guess=plan)
            )
        except PlanError:
            return found
        better = improved[2] < 0.99 * two or improved[1] < 0.999 * one
        return improved if better and improved[1] < 1.001 * one else found

    def least_second(self, least: _Point, until: float | None) -> _Point:
        """The plan with the least of the second, as far as the first may go."""
        first = self.first.variable
        most = None if until is None else require_positive("until", until, first.unit)
        endless = self.first.name == "time" and self.second.name in ("effort", "rate")
        if most is None and endless:
            most = SLOWEST * least[1]
        if most is not None and most <= least[1]:
            raise InputError(
                f"until = {first.exactly(most)} is not more than the least of {self.first.name}, "
                f"{first.exactly(least[1])}"
            )
        asked = self._with((self.first, most), (self.second, None))
        self.planner = Planner(self.plant, self.stops, minimise=self.second.name, **asked)
        return self.point(self.planner(guess=least[0]))

    def second_under(self, most: float, near: Plan) -> Plan:
        """The least of the second with the first bounded."""
        assert self.planner is not None
        asked = self._with((self.first, most), (self.second, None))
        changed = {k: asked[k] for k in ("budgets", "bounds") if k in asked}
        return self.planner(guess=near, **changed)

    def in_turn(self, bounds: Sequence[float], last: Plan) -> _Points:
        """The points at these bounds of the first, each from the one before."""
        found, failures, near = [], [], last
        for bound in counted(bounds, "plans of the front"):
            try:
                near = self.second_under(bound, near)
                found.append(self.point(near))
            except TimeIsUp:
                failures.append((bound, f"{deadline()} was over"))
            except PlanError as error:
                failures.append((bound, str(error)))
        return found, failures

    def side_by_side(self, executor: Place, bounds: Sequence[float], last: Plan) -> _Points:
        """The same, each from the last, on an executor."""
        names = self.first.name, self.second.name
        # what travels knows no multipliers: so it is for all, wherever they are planned
        work = _Alone(self.plant, self.stops, names, self.arguments, copy(last))
        answers: dict[int, Any] = {}
        with suppress(TimeIsUp):
            answers.update(ending(work, bounds, executor=executor, what="plans of the front"))
        found, failures = [], []
        for i, bound in enumerate(bounds):
            answer = answers.get(i, f"{deadline()} was over")
            if isinstance(answer, Exception) and not isinstance(answer, PlanError):
                raise answer
            if isinstance(answer, tuple):
                found.append(answer)
            else:
                failures.append((bound, str(answer)))
        return found, failures

    def point(self, plan: Plan) -> _Point:
        """A plan, and both objectives of it [SI], along the judge's integration: a program counts
        work that it does not minimise as it pleases. Peaks are bounded at the points of the plan.
        """
        said, terms = plan._statement, (self.first, self.second)
        assert said is not None  # a fresh plan
        rest: dict[str, Any] = {"track": None, "integrand": None, "final": None}
        alone = [replace(said, minimise=term.name, **rest) for term in terms]
        values = objectives(plan.plant, alone, plan.motion)
        one, two = (
            v * t.variable.nominal if t.peak is None else float(np.max(plan.trajectory[t.peak]))
            for v, t in zip(values, terms, strict=True)
        )
        if not np.isfinite(one + two):
            raise PlanError(f"the plan of {plan.plant.name} is {plan.verdict}", plan)
        return plan, one, two

    def result(self, found: Sequence[_Point], failures: Sequence[tuple[float, str]]) -> Pareto:
        """The front, both objectives of each plan; no other is to be preferred to one of it."""
        values = np.array([both for _, *both in found])
        kept = _front(values)
        worse = "a plan of the front is no worse in either objective"
        dropped = [(float(row[0]), worse) for i, row in enumerate(values) if i not in kept]
        variables = (self.first.variable, self.second.variable)
        named = [
            Variable(
                re.sub(r"\W+", "_", term.name).strip("_"),
                "output",
                unit=v.unit,
                nominal=v.nominal,
                display_unit=v.display_unit,
            )
            for term, v in zip((self.first, self.second), variables, strict=True)
        ]
        plans = tuple(found[i][0] for i in kept)
        return Pareto(named[0], named[1], plans, values[kept], (*failures, *dropped))


def _front(values: Array) -> list[int]:
    """Those points (n, 2) to which no other is to be preferred, by the first value."""
    kept: list[int] = []
    for i in np.lexsort(values.T[::-1]).tolist():
        least = values[kept[-1], 1] if kept else inf
        if values[i, 1] < least - SAME * abs(least if kept else 0.0):
            kept.append(i)
    return kept


@dataclass(frozen=True, eq=False)
class _Alone:
    """Called with a bound of the first objective: the point of the front there."""

    plant: Plant
    stops: Any
    names: tuple[str, str]
    arguments: Mapping[str, Any]
    near: Plan

    def __call__(self, bound: float) -> _Point:
        first, second = (_Term(self.plant, name) for name in self.names)
        sweep = _Sweep(self.plant, self.stops, first, second, self.arguments)
        asked = sweep._with((first, bound), (second, None))
        sweep.planner = Planner(self.plant, self.stops, minimise=second.name, **asked)
        return sweep.point(sweep.planner(guess=self.near))
