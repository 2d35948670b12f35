"""robust_plan: one input for a whole set of plants, their spread at the stops bounded."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from ...core.errors import (
    InputError,
    PamError,
    PlanError,
    PlanWarning,
    require_count,
    require_finite,
    require_positive,
)
from ...core.executors import Place
from ...core.progress import counted
from ...core.quantities import outside
from ...core.stop import TimeIsUp, verb
from ...core.trajectory import Trajectory
from ...judge.statement import Stop
from ...plants.ensemble import Ensemble
from ...plants.plant import Plant, require_plant
from ...simulation.integrate import evaluated
from ..planner import SolveKeywords, plan
from ..result import Plan, Solved
from .robust_result import (
    Demand,
    Judged,
    RobustPlan,
    RobustVerdict,
    Round,
    Share,
    judged,
    missed,
    share_of,
)
from .spread import Draw, Spread, drawn, ensemble_arguments, ensemble_stop, spread_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

ALIKE = {"mumps_pivtol": 1e-4, "mumps_scaling": 0, "mumps_pivot_order": 7}
"""IPOPT's options for ensembles: with smaller pivots steps are too inexact where copies of a plant
are nearly alike, and not scaled these fill in by any order but MUMPS' own choice (tenfold time).
"""

Widths: TypeAlias = Mapping[str, float]
Start: TypeAlias = Literal["rest", "same"]
Cases: TypeAlias = Sequence[Mapping[str, Any]]
Sampler: TypeAlias = Callable[[int, int], Cases]
"""(count, seed) -> so many draws, others for another seed."""

ADDED = 4
"""Most plants that are added in a round."""


@verb
def robust_plan(
    plant: Plant,
    stops: Sequence[Mapping[str, Any] | Stop],
    *,
    draws: Cases | Sampler,
    spread: Widths | Sequence[Widths | None],
    unseen: Cases | Sampler = (),
    share: float | None = 0.95,
    confidence: float = 0.95,
    fresh: int = 200,
    begin: int = 6,
    rounds: int = 8,
    time_limit: float = 600.0,
    seed: int = 0,
    all_within: bool = True,
    start: Start = "rest",
    executor: Place = None,
    **arguments: Unpack[SolveKeywords],
) -> RobustPlan:
    """One input for a set of plants, so that named variables spread little at the stops.

    The nominal plant meets the stops exactly; a copy of it for each draw, driven by the same inputs
    from its own start, ends within ``spread`` of it. Planned as one plant (:class:`Ensemble`), then
    verified by simulating each draw on the plant itself.

    With a function that draws, the plan is one for a ``share`` of all plants: planned for a few,
    tried on ``fresh`` others, planned again with the worst of these added, and so on until a sample
    that was never used before confirms the share (G. C. Calafiore, M. C. Campi, IEEE Trans. Autom.
    Control 51 (2006) 742-753, for plans by scenarios; that the worst are added is our choice).

    Parameters
    ----------
    stops, arguments : as for :func:`pam_ocp.plan`. Objectives, budgets and tracking see the nominal
        plant. ``cyclic="mirrored"`` is refused: unequal muscles have no mirror image.
    draws : a function (count, seed) that gives so many draws {parameter: value}, or cases of
        :func:`pam_ocp.simulation.draws`, all of the same parameters; or a list of them, which are
        then all planned for.
    spread : {variable: largest deviation from the nominal plant} at every stop, and all along its
        dwell, in SI; or a list with one of these, or None, per stop.
    unseen : further draws, simulated only: a list, on which the share is judged, or a function as
        ``draws`` where ``draws`` is a list to begin with.
    share : part of all plants that shall keep the spread and (``all_within``) all limits. It is met
        when as large a part of a fresh sample does; ``robust.share`` tells its two-sided
        Clopper-Pearson interval of the level ``confidence``. Ask for more if its lower end is to
        lie above your need. None: only the plants planned for count.
    fresh : plants of each sample, at least 100. begin : plants of the first plan, drawn by the
        function.
    rounds, time_limit : at most so many plans, so many seconds; the best so far is returned,
        OutOfTime is raised when there is none.
    seed : of the first plants; the fresh samples have the seeds after it. With it all is
        repeatable.
    all_within : bounds and path constraints (never slack, strokes, rates) hold for every draw, not
        for the nominal plant only.
    start : where the copies begin: "rest" in the nominal's first state, but each with its positions
        where it rests under the pressures there (if the first stop is at rest); "same" in the very
        same state, as held by a latch. A cyclic motion has no start: every plant closes its own
        cycle.
    executor : where the plants of a sample are simulated, as for :func:`pam_ocp.each`.

    ``robust.verdict`` says whether it is verified, or which figure failed: then a PlanWarning is
    given, and the plan is the one with the largest share that was found. Raises InputError for what
    is invalid; PlanError where the spread cannot be kept for the first plants: the message
    names ``NAME.deviation<k>`` at its stop, and what the nominal plan's inputs would keep.

    Examples
    --------
    >>> draws = [{"mass": 1.96}, {"mass": 2.04}]
    >>> ways = {"share": None, "method": pam.Collocation(10, 3)}
    >>> stops = [{"x": -0.01}, {"x": 0.01}]
    >>> robust = pam.robust_plan(slide, stops, draws=draws, spread={"x": 1e-3}, **ways)
    >>> robust.verified
    True
    """
    require_plant(plant)
    _check_share(share, confidence)
    require_count("fresh", fresh, 100)
    require_count("rounds", rounds)
    require_count("begin", begin)
    time_limit = require_positive("time_limit", time_limit, "s")
    sampler = draws if callable(draws) else unseen if callable(unseen) else None
    samples = None if sampler is None else _Samples(plant, sampler, seed)
    members = samples(begin) if callable(draws) and samples else drawn(plant, _listed(draws))
    given = None if callable(unseen) or not unseen else drawn(plant, unseen)
    task = _Task(plant, stops, spread, all_within, start, executor, dict(arguments))
    if samples is None or share is None:
        tried = given if samples is None else samples(fresh)
        try:
            found = task.planned(members, None)
        except PlanError as error:
            raise task.explained(error, tried or members, share) from None
        drawn_by = samples.last if samples else None
        best = task.tried(found, members, tried, share, confidence, drawn_by)
        made: tuple[Round, ...] = (best.round(0.0),)
        ended = ""
    else:
        limits = (fresh, rounds, time_limit)
        best, made, ended = _searched(task, members, samples, share, confidence, limits)
    result = task.result(best, share, made, ended)
    if not result.verified:
        warnings.warn(f"robust_plan: {result.verdict}", PlanWarning, stacklevel=outside())
    return result


def _check_share(share: float | None, confidence: float) -> None:
    for name, value in (("share", share), ("confidence", confidence)):
        if value is not None and not 0 < require_finite(name, value) < 1:
            raise InputError(f"{name} = {value:g} must lie between 0 and 1, as in 0.95")


def _listed(draws: Cases | Sampler) -> Cases:
    assert not callable(draws)
    return draws


class _Samples:
    """Draws that were never drawn before."""

    def __init__(self, plant: Plant, sampler: Sampler, seed: int) -> None:
        self.plant, self.sampler = plant, sampler
        self.next = require_count("seed", seed, 0)
        self.last: int | None = None
        self._before: Draw | None = None

    def __call__(self, count: int) -> tuple[dict[str, float], ...]:
        self.last, self.next = self.next, self.next + 1
        found = drawn(self.plant, self.sampler(count, self.last))
        if len(found) != count:
            raise InputError(f"draws({count}, {self.last}) gave {len(found)} draws, not {count}")
        for draw in found:
            self.plant.vector("parameter", draw)  # a value out of range is the function's fault
        if found[0] == self._before:
            raise InputError(
                f"draws(count, seed) gives the same plants for the seeds {self.last - 1} and "
                f"{self.last}; let it draw by numpy.random.default_rng(seed)"
            )
        self._before = found[0]
        return found


@dataclass(frozen=True, eq=False)
class _Found:
    """A plan of an ensemble, and what was tried under its inputs."""

    plan: Plan
    motion: Trajectory
    members: tuple[Draw, ...]
    tried: Spread | None
    judged: Judged | None
    share: Share | None

    @property
    def value(self) -> float:
        """The share of the sample, 0 without one."""
        return self.share.value if self.share else 0.0

    def worst(self, share: float) -> list[Draw]:
        """Plants of the sample that are to be planned for."""
        if self.judged is None or self.tried is None:
            return []
        return [self.tried.draws[i] for i in self.judged.worst(share, ADDED)]

    def round(self, seconds: float) -> Round:
        return Round(len(self.members), self.plan.objective, self.share, seconds)


def _searched(
    task: _Task,
    members: tuple[Draw, ...],
    samples: _Samples,
    share: float,
    confidence: float,
    limits: tuple[int, int, float],
) -> tuple[_Found, tuple[Round, ...], str]:
    """The first plan that a fresh sample confirms, or the best; all rounds; why the search ended.

    limits : plants of a fresh sample, number of rounds, seconds.
    """
    fresh, rounds, time_limit = limits
    began = time.perf_counter()
    made: list[Round] = []
    best: _Found | None = None
    last: _Found | None = None
    ended = f"{rounds} rounds were allowed"
    for _ in counted(range(rounds), "rounds"):
        try:
            found = task.planned(members, last)
            last = task.tried(found, members, samples(fresh), share, confidence, samples.last)
        except TimeIsUp:
            if best is None:
                raise
            ended = f"{time_limit:g} s were allowed"
            break
        except PlanError as error:
            if last is None:
                raise task.explained(error, samples(fresh), share) from None
            ended = f"with {len(members) - len(last.members)} of these planned for, too: {error}"
            break
        made.append(last.round(time.perf_counter() - began))
        if best is None or last.value > best.value:
            best = last
        if last.share is not None and last.share.enough:
            break
        if made[-1].seconds > time_limit:
            ended = f"{time_limit:g} s were allowed"
            break
        members = (*members, *last.worst(share))
    assert best is not None  # the first round ends in a plan or an error
    return best, tuple(made), ended


class _Task:
    """What is the same for all plans of a search: the statement, and the nominal plan."""

    def __init__(
        self,
        plant: Plant,
        stops: Sequence[Any],
        spread: Any,
        all_within: bool,
        start: Start,
        executor: Place,
        arguments: dict[str, Any],
    ) -> None:
        self.executor = executor
        self.plant, self.stops, self.all_within = plant, stops, all_within
        self.arguments = arguments
        cyclic = arguments.get("cyclic", False)
        if cyclic not in (False, True, None):
            raise InputError(f"cyclic = {cyclic!r}: a robust plan takes True or False")
        if start not in ("rest", "same"):
            raise InputError(f"start = {start!r}: choose 'rest' or 'same'")
        self.cyclic = bool(cyclic)
        self.allowed = _allowed(plant, stops, spread)
        first = stops[0] if isinstance(stops[0], Stop) else Stop(stops[0])
        at_rest = arguments.get("rest", True) if first.rest is None else first.rest
        self.rest = bool(at_rest and start == "rest")
        self.nominal = plan(plant, stops, **arguments)

    def planned(self, members: Sequence[Draw], near: _Found | None) -> Plan:
        """The plan for the members, from that for fewer of them or from the nominal plan."""
        watched = [v.name for v in self.plant.states] + [n for a in self.allowed for n in a]
        ensemble = Ensemble(self.plant, members, list(dict.fromkeys(watched)), self.all_within)
        wanted = [
            ensemble_stop(ensemble, s, w) for s, w in zip(self.stops, self.allowed, strict=True)
        ]
        if not self.cyclic:
            wanted[0] = _begun(ensemble, wanted[0], self.rest)
        base, motion = (self.nominal, self.nominal.trajectory)
        if near is not None:
            base, motion = near.plan, near.motion
        guess = _stacked(ensemble, base, motion, self.cyclic, self.rest)
        further = {k: v for k, v in self.arguments.items() if k != "guess"}
        said = ensemble_arguments(ensemble, further, self.all_within)
        if said.get("solver", "ipopt") == "ipopt":
            said["options"] = {**ALIKE, **(said.get("options") or {})}
        return plan(ensemble, wanted, guess=guess, **said)

    def explained(self, error: PlanError, draws: Sequence[Draw], share: float | None) -> PlanError:
        """The error, and what the nominal plan's inputs would keep."""
        spread = self.simulated(self.nominal, self.nominal.trajectory, draws)
        found = share_of(judged(spread, self.demand(self.nominal)), share or 0.95, 0.95)
        words = f"{error}. Under the nominal plan's inputs {found} keep the spread and all limits"
        if found.hindrance:
            words += f"; most of the others exceed {found.hindrance}"
        return PlanError(words, error.plan)

    def demand(self, found: Plan) -> Demand:
        """What plants are judged by under a plan's inputs."""
        solved, legs = found._solved, self.nominal._problem
        assert solved is not None  # a fresh plan
        assert legs is not None
        problem = legs if self.all_within else None
        ends = np.concatenate([[0.0], np.cumsum(found.durations)])
        at = [int(np.argmin(np.abs(found.trajectory.t - end))) for end in ends]
        stops, dwells = [(at[0], 1)], []
        for leg, here, there in zip(legs.legs, at[:-1], at[1:], strict=True):
            number = stops[-1][1]  # a dwell ends at the stop at which it begins
            if leg.dwell:
                dwells.append((slice(here, there + 1), number))
            stops.append((there, number if leg.dwell else number % len(self.allowed) + 1))
        return Demand(
            tuple((i, n, self.allowed[n - 1]) for i, n in stops if self.allowed[n - 1]),
            tuple((s, n, self._strayed(n)) for s, n in dwells if self.allowed[n - 1]),
            problem,
            found.meshes[-1],
            solved.solution,
        )

    def _strayed(self, number: int) -> dict[str, float]:
        """The spread that a dwell allows: what is held there may stray by ``within``."""
        stop = self.stops[number - 1]
        assert isinstance(stop, Stop)  # it has a dwell
        return {
            n: width + stop.within * self.plant.variable(n).nominal
            for n, width in self.allowed[number - 1].items()
        }

    def simulated(self, of: Plan, motion: Trajectory, draws: Sequence[Draw]) -> Spread:
        """The plants under the inputs of a plan."""
        own = self.plant.with_values(of.design)
        at = [sample for sample, _, _ in self.demand(of).stops]
        ways: dict[str, Any] = {"cyclic": self.cyclic, "rest": self.rest}
        return spread_of(own, motion, draws, at, executor=self.executor, **ways)

    def tried(
        self,
        found: Plan,
        members: Sequence[Draw],
        sample: Sequence[Draw] | None,
        share: float | None,
        confidence: float,
        seed: int | None,
    ) -> _Found:
        """A plan with the nominal plant's motion, and a sample of plants under its inputs."""
        own = self.plant.with_values(found.design)
        names = [v.name for v in self.plant.states]
        samples = found.trajectory
        assert samples.signals is not None  # a plan's inputs are known in between
        motion = evaluated(own, samples.t, samples.array(names), samples.signals)
        if sample is None:
            return _Found(found, motion, tuple(members), None, None, None)
        spread = self.simulated(found, motion, sample)
        verdicts = judged(spread, self.demand(found))
        part = share_of(verdicts, 0.95 if share is None else share, confidence, seed)
        return _Found(found, motion, tuple(members), spread, verdicts, part)

    def result(
        self, best: _Found, share: float | None, rounds: tuple[Round, ...], ended: str
    ) -> RobustPlan:
        """The plan with the simulations of its members, and the verdict."""
        members = self.simulated(best.plan, best.motion, best.members)
        alone = [
            self.simulated(self.nominal, self.nominal.trajectory, draws) if draws else None
            for draws in (best.members, best.tried.draws if best.tried else None)
        ]
        assert alone[0] is not None  # there is at least one member
        demand = self.demand(best.plan)
        off, where = missed(judged(members, demand))
        solved = "" if best.plan.success else str(getattr(best.plan, "verdict", best.plan.status))
        verdict = RobustVerdict(solved, len(best.members), off, where, best.share, share, ended)
        return RobustPlan(
            best.plan,
            self.nominal,
            best.motion,
            self.allowed,
            members,
            alone[0],
            best.tried,
            alone[1],
            self.cyclic,
            self.rest,
            verdict,
            demand,
            rounds,
        )


def _allowed(
    plant: Plant, stops: Sequence[Any], spread: Widths | Sequence[Widths | None]
) -> tuple[dict[str, float], ...]:
    """The spread that each stop allows."""
    each = [spread] * len(stops) if isinstance(spread, Mapping) else list(spread)
    if len(each) != len(stops):
        raise InputError(f"spread holds {len(each)} entries for {len(stops)} stops")
    found = []
    for widths in each:
        checked = {}
        for name, width in (widths or {}).items():
            variable = plant.variable(name)
            if variable.causality not in ("state", "output"):
                raise InputError(f"spread: {name} is {variable.kind}; name states or outputs")
            checked[variable.name] = require_positive(f"spread[{name!r}]", width, variable.unit)
        found.append(checked)
    if not any(found):
        raise InputError("spread is empty; name at least one variable, as in {'x': 1e-3}")
    return tuple(found)


def _begun(ensemble: Ensemble, stop: Stop, rest: bool) -> Stop:
    """The first stop, with what it says of the copies' start."""
    if stop.dwells:
        raise InputError("robust_plan: stop 1 has a dwell; begin with the motion")
    plant, values = ensemble.nominal, dict(stop.values)
    for state in plant.states:
        for k in range(1, len(ensemble.draws) + 1):
            if state.name not in ensemble.own:
                continue
            if rest and state.name in plant.positions:
                values[f"der({plant.positions[state.name]}.draw{k})"] = 0.0
            else:
                values[f"{state.name}.deviation{k}"] = 0.0
    return replace(stop, values=values)


def _stacked(ensemble: Ensemble, base: Plan, motion: Trajectory, cyclic: bool, rest: bool) -> Plan:
    """A plan with the copies' simulated states beside the nominal ones: where the solver starts.

    base : the nominal plan, or one for other copies; motion : that of the nominal plant in it.
    """
    plant, solved = ensemble.nominal.with_values(base.design), base._solved
    assert solved is not None  # a fresh plan that succeeded
    solution = solved.solution
    runs = spread_of(plant, motion, ensemble.draws, (), rest=rest and not cyclic).motions
    columns = []
    for variable in ensemble.states:
        name, _, number = variable.name.partition(".draw")
        run = runs[int(number) - 1] if number else motion
        columns.append(motion[name] if isinstance(run, PamError) else run[name])
    states = np.column_stack(columns)
    shown = replace(solution, t=motion.t, states=states)
    return replace(base, plant=ensemble, _solved=Solved(solved.program, solved.outcome, shown))
