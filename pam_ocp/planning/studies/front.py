"""pareto: the front of two objectives, by the epsilon-constraint method."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
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
from ...judge.statement import Stop, subject
from ...plants.plant import Plant, require_plant
from ..planner import PlanKeywords, Planner
from ..problem.problem import budget
from ..result import Plan
from ..transcription.guess import from_solution

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
    """(bound of the first objective, message) of points that were not found."""

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
    points between that are not found stand in ``failures``.

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
    low, high = (sweep.first.value(p) for p in (least, last))
    if high <= low:  # one plan is best in both
        return sweep.result([sweep.point(least)], [])
    spaced = np.geomspace if low > 0 else np.linspace
    bounds = spaced(low, high, points)[-2:0:-1].tolist()
    between = sweep.in_turn if place is None else partial(sweep.side_by_side, place)
    found, failures = between(bounds, last)
    ends = sweep.point(least), sweep.point(last)
    return sweep.result([ends[0], *found[::-1], ends[1]], failures)


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

    def limit(self, most: float | None) -> dict[str, Any]:
        """The arguments of plan that bound it; None for no bound, in the same form."""
        if not self.bounded:
            return {}
        value = _UNBOUNDED if most is None else most
        if self.peak is not None:
            return {"bounds": {self.peak: (None, value)}}
        return {"budgets": {self.name: value}}

    def value(self, plan: Plan) -> float:
        """Of a plan that minimises or bounds it [SI]."""
        if self.name == "time":
            return plan.duration
        if self.peak is not None:
            return float(np.max(plan.trajectory[self.peak]))
        solved, label = plan._solved, f"budget of {self.name}"
        assert solved is not None  # a fresh plan
        nlp = solved.program.nlp
        for row, own in solved.program.placed():
            if row.conditions and row.conditions[0].label == label:
                g = ca.Function("g", [nlp["x"], nlp["p"]], [nlp["g"][own.start]])
                value = float(g(solved.outcome.w, solved.program.parameters()))
                return value * row.conditions[0].nominal
        return plan.objective * self.variable.nominal  # what is minimised alone


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
            for key, limit in term.limit(most).items():
                found[key] = {**(found.get(key) or {}), **self._narrowed(key, limit)}
        return found

    def _narrowed(self, key: str, limit: Mapping[str, Any]) -> dict[str, Any]:
        """A limit that leaves what the user says of the same name."""
        own = self.arguments.get(key) or {}
        found = {}
        for name, value in limit.items():
            most = value[1] if isinstance(value, tuple) else value
            given = own.get(name)
            pair = given if isinstance(given, tuple | list) else (None, given)
            low, high = pair
            found[name] = (low, most if high is None else min(most, high))
        return found

    def least_first(self) -> Plan:
        """The plan with the least of the first; among equally good ones,
        with little of the second.
        """
        asked = self._with((self.second, None))
        alone: dict[str, float] = {self.first.name: 1.0}
        if self.second.name == "rate":  # inputs that jump have none: they shall not
            alone["rate"] = CONTINUOUS
        plan = Planner(self.plant, self.stops, minimise=alone, **asked)()
        one, two = self.first.value(plan), self.second.value(plan)
        if not self.second.bounded or two <= 0 or one <= 0:
            return plan
        sizes = one / self.first.variable.nominal, two / self.second.variable.nominal
        weights = {self.first.name: 1.0, self.second.name: POLISH * sizes[0] / sizes[1]}
        try:
            improved = Planner(self.plant, self.stops, minimise=weights, **asked)(guess=plan)
        except PlanError:
            return plan
        better = self.second.value(improved) < 0.99 * two
        return improved if better and self.first.value(improved) < one * 1.001 else plan

    def least_second(self, least: Plan, until: float | None) -> Plan:
        """The plan with the least of the second, as far as the first may go."""
        most = None if until is None else require_positive("until", until)
        endless = self.first.name == "time" and self.second.name in ("effort", "rate")
        if most is None and endless:
            most = SLOWEST * least.duration
        if most is not None and most <= self.first.value(least):
            raise InputError(
                f"until = {self.first.variable.exactly(most)} is not more than the least of "
                f"{self.first.name}, {self.first.variable.exactly(self.first.value(least))}"
            )
        asked = self._with((self.first, most), (self.second, None))
        self.planner = Planner(self.plant, self.stops, minimise=self.second.name, **asked)
        return self.planner(guess=least)

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
            except TimeIsUp:
                failures.append((bound, f"{deadline()} was over"))
                continue
            except PlanError as error:
                failures.append((bound, str(error)))
                continue
            found.append(self.point(near))
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
        """A plan, and both objectives of it."""
        return plan, self.first.value(plan), self._second_of(plan)

    def _second_of(self, plan: Plan) -> float:
        """The second objective of any plan of the sweep."""
        if self.second.bounded:
            return self.second.value(plan)
        assert self.planner is not None
        assert plan._solved is not None  # a fresh plan
        program = self.planner._program  # what it minimises, at this plan's unknowns
        f = ca.Function("f", [program.nlp["x"], program.nlp["p"]], [program.nlp["f"]])
        w = from_solution(program.problem, program.mesh, plan._solved.solution)
        return float(f(w, program.parameters())) * self.second.variable.nominal

    def result(self, found: Sequence[_Point], failures: Sequence[tuple[float, str]]) -> Pareto:
        """The front, both objectives of each plan."""
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
        values = np.array([both for _, *both in found])
        return Pareto(named[0], named[1], tuple(p for p, *_ in found), values, tuple(failures))


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
