"""plan: state the problem, transcribe it, solve it, refine the mesh, check the motion by replay."""

from __future__ import annotations

import difflib
import functools
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import (
    InputError,
    PlanError,
    PlanWarning,
    require_count,
    require_instance,
    require_positive,
)
from ..core.quantities import outside
from ..core.stop import TimeIsUp, deadline, spared, turns, verb
from ..judge.motion import TOLERANCE, judge
from ..judge.statement import Avoid, Constraint, Cyclic, Phase, Statement, StatementKeywords, Stop
from ..operating.held import Memory
from ..plants.plant import Plant, Values
from ..simulation.integrate import evaluated
from .candidate import Candidate, Checked, Engine, renewed
from .problem.formulation import formulate
from .problem.problem import follows_inputs
from .result import Plan, Solved, motion_of
from .search import Found, Search
from .settings import SETTINGS, UNBOUNDED
from .solvers.diagnosis import Conflict, advice, explanation
from .solvers.solver import KEPT, Backend, Progress, SolverName
from .stages import WorkIsSpent, as_data, recorded
from .starts import MOST, starts_on
from .transcription.mesh import Arcs, Collocation, Mesh, Method, Shooting
from .transcription.transcription import Program, transcribe

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..core.executors import Place

SEARCH = {"solver": "name", "compiled": "compiled", "options": "options", "progress": "progress"}
"""Keywords that say how a solution is searched, and the fields of Backend that hold them."""


class PlanKeywords(StatementKeywords, total=False):
    """What is asked, and how it is searched: the keywords of all verbs that plan."""

    method: Method | Arcs | None
    progress: Progress
    solver: SolverName
    compiled: bool
    options: Mapping[str, Any] | None


class SolveKeywords(PlanKeywords, total=False):
    """All keywords of :func:`plan`."""

    tolerance: float | None
    guess: Plan | None
    starts: int | None


def require_known(keywords: Mapping[str, Any]) -> None:
    """Raise a TypeError that names the nearest keyword."""
    known = (*StatementKeywords.__annotations__, *SEARCH, "method")
    for name in keywords:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"it knows {', '.join(known)}"
            raise TypeError(f"a planner takes no argument {name!r}; {hint}")


STRICTER, NEARLY, LEAST = 2, 1e3, 1e-6
"""Times that a plan is refined beyond its tolerance where the judge misses that, by so many
tolerances at most; and to which at least.
"""
SPENT = "the work that a search may take, a few minutes, was spent; time_limit= allows more"
GRACE = 10.0
"""Seconds, at most, for the verdict on a plan that was found when the time was up."""

Array: TypeAlias = NDArray[np.float64]


@verb
def plan(
    plant: Plant,
    stops: Sequence[Mapping[str, Any] | Stop],
    *,
    cyclic: Cyclic = False,
    duration: Any = None,
    minimise: str | Mapping[str, float] = "time",
    bounds: Mapping[str, Any] | None = None,
    rest: bool = True,
    memory: Memory = "virgin",
    phases: Sequence[Phase | None] | None = None,
    constraints: Sequence[Constraint | Avoid] = (),
    track: Mapping[str, Any] | None = None,
    budgets: Mapping[str, Any] | None = None,
    design: Mapping[str, tuple[float, float]] | None = None,
    integrand: ca.SX | None = None,
    final: ca.SX | None = None,
    method: Method | Arcs | None = None,
    tolerance: float | None = TOLERANCE,
    guess: Plan | None = None,
    starts: int | None = None,
    executor: Place = None,
    progress: Progress = False,
    solver: SolverName = "ipopt",
    compiled: bool = False,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
) -> Plan:
    """The optimal motion of a plant that visits ``stops`` in order.

    Parameters
    ----------
    stops : at least two mappings {variable: value or (low, high)} of states, inputs or outputs, or
        :class:`Stop` with more to say: a via point (``rest=False``), a dwell.
    cyclic : True returns to the first stop and closes the cycle in all states; "mirrored" plans
        half a cycle between two stops whose second half is its mirror image (equal muscles).
    duration : of each leg between two stops: None (free), seconds, (shortest, longest), or a list
        with one of these per leg.
    minimise : one term, or {term: weight}. Terms: "time", "effort" (integral of the squared inputs
        in units of nominal, without disturbances), "rate" (the same of their rates), "work"
        (mechanical, out of the muscles [J]), "air" [g] and "exergy" [10 J] (of valve-fed muscles),
        and of any variable: "integral(NAME)", "square(NAME)" (integral of the square),
        "final(NAME)" (at the end; a negative weight asks for the most), "peak(NAME)" (largest
        value), in units of its nominal.
    bounds : {NAME or "der(NAME)": value or (low, high)}, None for an open end, a :class:`Profile`
        for a bound that changes with time; narrows the plant's own bounds. Path constraints of the
        plant (never slack, pressure rates) always hold.
    rest : positions have zero velocity and acceleration at each stop, in whatever coordinates; what
        an input sets at once may jump there, if admissible inputs (as the stop names them, where
        it does) would hold the plant.
    memory : what states with a held memory (hysteresis) hold at the first stop: "virgin" (their
        start values), "above" or "below" (the side from which the plant came to rest there), or
        {state: value}; a cyclic motion closes them. What settles (creep) has settled there.
    phases : one :class:`Phase` or None per leg, for what holds there only.
    constraints : :class:`Constraint` (any expression) and :class:`Avoid` (forbidden regions).
    track : {NAME: aim or (aim, weight)}, an aim being a number or a Profile: adds the integral of
        weight ((value - aim)/nominal)^2 to the objective.
    budgets : {running term: most, or (least, most)} in SI, such as {"air": 1e-3} or
        {"integral(force)": 50.0} ("effort" and squares as they are minimised, in s); "time" bounds
        the duration of the whole motion.
    design : {parameter of the plant: (low, high)}: chosen with the motion.
    integrand, final : further running cost, and cost of the end: CasADi expressions of the plant's
        symbols (``plant.expression("v") ** 2``, say) and ``pam_ocp.planning.TIME``.
    method : ``Collocation(intervals=50, degree=3, control=None, points="radau")`` per leg, or
        ``Shooting(intervals=50, steps=4)``, or ``Arcs()``: intervals that end where inputs switch.
    tolerance : of the plan's verdict, in units of nominal: how far a tight integration of the
        planned inputs may leave the planned motion, and exceed limits, stops and budgets, between
        the points of the mesh too. The mesh is refined until it is met; polynomial inputs that
        cannot meet it are held constant instead. None for one mesh only, judged by 1e-3.
    guess : another plan to start from.
    starts : 1 to 12: how many starts are tried (other durations, states and barrier strategies of
        the first guess), side by side in processes where that pays; the best plan is kept, and
        ``statistics["starts"]`` says where each ended. None: 4 where local optima are many (a load
        on a tendon, valves whose openings lead nowhere), 2 with other valves, 1 with a guess and
        for all else.
    executor : where they are tried, as for :func:`pam_ocp.each`; what comes of them is the same
        everywhere. None: here, and by processes of our own where that pays (on Linux). The
        first start is tried here, and so are all where another solver than IPOPT is named.
    progress : True prints each iteration; a function (iteration, objective, violation) is called.
    solver : "ipopt", or one that a component adds to the library (docs/architecture.md).
    compiled : IPOPT's functions compiled (cc or zig) and kept for the next time; pays for
        :class:`Shooting` solved many times (a third of the time), little for collocation.
    options : of the solver, over its defaults here.
    time_limit : [s] of the whole search, refinement and replay included (the building of the
        program is not broken off). The best so far is returned, not verified: its verdict says that
        the time was up. PlanError when there is nothing yet. None: iterations are counted instead,
        to a few minutes of the processor, so that an answer does not depend on the machine; the
        best verified motion by then is returned, or the best with its verdict.

    Raises InputError for an invalid problem, PlanError when no solution was found: the
    message names the constraints in conflict, ``error.plan`` is the sealed plan. Warns
    (PlanWarning) when the plan is not verified: ``plan.verdict`` says why.

    Examples
    --------
    >>> plan = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], minimise="time")
    >>> print(f"{1e3 * plan.duration:.1f} ms")
    36.6 ms
    >>> plan.verified
    True
    """
    build = functools.partial(
        Planner,
        plant,
        stops,
        cyclic=cyclic,
        duration=duration,
        minimise=minimise,
        bounds=bounds,
        rest=rest,
        memory=memory,
        phases=phases,
        constraints=constraints,
        track=track,
        budgets=budgets,
        design=design,
        integrand=integrand,
        final=final,
        method=method,
        progress=progress,
        solver=solver,
        compiled=compiled,
        options=options,
    )
    try:
        planner = build()
    except TimeIsUp:
        if time_limit is None:  # somebody else's limit
            raise
        raise _nothing_yet(plant) from None
    with starts_on(executor):
        return planner._solve(None, guess, tolerance, starts, {}, time_limit)


def _nothing_yet(plant: Plant, advised: str = "") -> PlanError:
    return PlanError(
        f"{deadline()} was over before a plan was found for {plant.name}; allow more time, or "
        f"fewer intervals. {advised}".removesuffix(". ")
    )


def _stated(
    plant: Plant, statement: Statement, method: Method | Arcs | None
) -> tuple[Statement, Method | Arcs]:
    """The statement with whether inputs may jump, and the method with its kind of inputs."""
    method = method or Collocation()
    if isinstance(method, Collocation):
        if method.control is None and follows_inputs(plant, statement.weights):
            method = replace(method, control="linear")
        statement = replace(statement, jumps=method.control != "linear")
    return statement, method


class Planner:
    """A planning problem that is built once and solved many times.

    Takes the arguments of :func:`plan` but ``tolerance``, ``guess``, ``starts`` and ``executor``,
    which are said at each call. ``planner()`` solves it;
    ``planner(stops=..., values=..., guess=plan)`` solves it for other numbers, in milliseconds from
    the solution of a neighbour: stops, durations, bounds, budgets and constant aims may have other
    values (not other names), and so may all parameters of the plant.

    Examples
    --------
    >>> planner = pam.Planner(slide, [{"x": -0.01}, {"x": 0.01}])
    >>> first = planner()
    >>> second = planner(values={"mass": 2.5}, guess=first)
    >>> second.duration > first.duration
    True
    """

    @turns
    def __init__(
        self,
        plant: Plant,
        stops: Sequence[Mapping[str, Any] | Stop],
        **keywords: Unpack[PlanKeywords],
    ) -> None:
        begin = time.perf_counter()
        require_known(keywords)
        said: dict[str, Any] = dict(keywords)
        method: Method | Arcs | None = said.pop("method", None)
        search = {SEARCH[name]: said.pop(name) for name in SEARCH if name in said}
        if method is not None and not isinstance(method, Collocation | Shooting | Arcs):
            raise InputError(
                f"method = {method!r}: give Collocation(...), Shooting(...) or Arcs(...)"
            )
        self.plant = plant
        self._said = stops, dict(keywords)
        self._statement, method = _stated(plant, Statement(stops, **said), method)
        self._backend = Backend(**search)
        problem = formulate(plant, self._statement)
        mesh = method.mesh(len(problem.legs))
        self._program = transcribe(problem, mesh)
        self._solver = self._backend.build(self._program)
        self._finer: deque[Program] = deque(maxlen=KEPT)
        self._build_seconds = time.perf_counter() - begin

    def __reduce__(self) -> tuple[Any, ...]:
        """Symbols do not travel: another process builds the problem anew, once."""
        stops, said = self._said
        keywords: dict[str, Any] = said
        return functools.partial(Planner, self.plant, stops, **keywords), ()

    @verb
    def __call__(
        self,
        values: Values | None = None,
        *,
        guess: Plan | None = None,
        tolerance: float | None = TOLERANCE,
        starts: int | None = None,
        executor: Place = None,
        time_limit: float | None = None,
        **changed: Any,
    ) -> Plan:
        """The optimal motion for other numbers.

        values : parameters (and start values) of the plant by name.
        guess : a plan to start from; one of this planner starts warm, with its multipliers.
        tolerance, starts, executor, time_limit : refine the mesh, try other starts, where, how
            long; see :func:`plan`.
        changed : other ``stops``, ``duration``, ``bounds``, ``budgets``, ``track``, ``memory`` of
            the same form.

        Raises InputError when a change would ask for another program, PlanError as plan does; warns
        as plan does.
        """
        with starts_on(executor):
            return self._solve(values, guess, tolerance, starts, changed, time_limit)

    def _solve(
        self,
        values: Values | None,
        guess: Plan | None,
        tolerance: float | None,
        starts: int | None,
        changed: Mapping[str, Any],
        time_limit: float | None,
    ) -> Plan:
        begin = time.perf_counter()
        if tolerance is not None:
            tolerance = require_positive("tolerance", tolerance)
        require_instance("guess", guess, Plan, "give what plan() returned", none=True)
        if starts is not None:
            require_count("starts", starts, 1, MOST)
        program = self._with(values, changed)
        statement = replace(self._statement, **changed)
        settings = SETTINGS if time_limit is None else UNBOUNDED
        with recorded(settings.most_work) as stages:
            engine = Engine(program, self._solver, self._backend, stages, settings)
            search = Search(engine, statement, starts, tolerance)
            near = None if guess is None else guess._near(program)
            last = None if guess is None else guess._solved
            try:
                found = search.best(near, last, self._finer)
            except WorkIsSpent:
                name = program.problem.plant.name
                why = f"no plan was found for {name}: {SPENT}. {advice(program)}"
                raise PlanError(why) from None
            except TimeIsUp:
                if time_limit is None:  # somebody else's limit
                    raise
                raise _nothing_yet(program.problem.plant, advice(program)) from None
            if found.best is None:
                if found.cut:  # before it came to that
                    search.diagnosed()
                raise self._failure(found, statement, self._figures(search, begin))
            first = found.first or (guess._coarse if guess is not None else None)
            asked = statement, search, begin, tolerance, first
            return self._result(search, functools.partial(self._assembled, *asked), tolerance)

    def _failure(self, found: Found, statement: Statement, figures: Mapping[str, Any]) -> PlanError:
        """Why there is no plan."""
        assert found.failure is not None
        program, outcome = found.failure.program, found.failure.outcome
        outcome = replace(outcome, advice="" if outcome.stopped else advice(program))
        failure = replace(found.failure, outcome=outcome)
        failed = _plan_of(failure, statement, figures, conflicts=found.conflicts)
        words = explanation(failed.plant.name, outcome, found.conflicts, found.feasible)
        return PlanError(words, failed)

    def _result(
        self, search: Search, assembled: Callable[[], Plan], tolerance: float | None
    ) -> Plan:
        """The plan of what a search came to; refined further where the judge sees more in what is
        left of its errors than the mesh does (a load that is stiff beside its pressures).
        """
        result = assembled()
        for _ in range(STRICTER):
            missed = max(result.verdict.error, result.verdict.violation)
            if result.verified or tolerance is None or not search.met or search.found.cut:
                break
            if not tolerance < missed <= NEARLY * tolerance:
                break
            best = search.found.best
            assert best is not None
            aim = min(SETTINGS.aim * tolerance**2 / missed, best.check.miss / 2)
            if not search.closer(max(aim, LEAST)):
                break
            result = assembled()
        if not result.verified:
            message = f"the plan of {result.plant.name} is {result.verdict}"
            warnings.warn(message, PlanWarning, stacklevel=outside())
        return result

    def _figures(self, search: Search, begin: float) -> dict[str, Any]:
        """Of a search, for a plan's statistics."""
        stages = search.engine.stages
        figures = {**search.found.figures, "stages": as_data(stages)}
        if isfinite(deadline().seconds) and (search.found.cut or deadline().over):
            figures["ended"] = f"{deadline()} was over"
        elif search.found.cut and not search.met:
            figures["ended"] = SPENT
        figures["iterations"] = sum(s.iterations for s in stages)
        seconds = {"seconds": time.perf_counter() - begin, "build_seconds": self._build_seconds}
        return figures | seconds

    def _assembled(
        self,
        statement: Statement,
        search: Search,
        begin: float,
        tolerance: float | None,
        first: Solved | None,
    ) -> Plan:
        """The plan of the best candidate, judged."""
        best = search.found.best
        assert best is not None
        figures = self._figures(search, begin) | _trust(search, best, tolerance)
        meshes = best.meshes(search.engine.first.mesh)
        with spared(GRACE):  # what there is to show is judged, whatever the time
            check = best.check.explained(tolerance or TOLERANCE)
            plan = _plan_of(check.found, statement, figures, check, meshes, first, tolerance)
        program = check.found.program
        known = (self._program, *self._finer)
        if check.found.multiplied and not any(program.nlp is each.nlp for each in known):
            self._finer.append(program)
        return plan

    def _with(self, values: Values | None, changed: Mapping[str, Any]) -> Program:
        """The program with other numbers."""
        if not values and not changed:
            return self._program
        allowed = ("stops", "duration", "bounds", "budgets", "track", "memory")
        for name in changed:
            if name not in allowed:
                raise InputError(
                    f"{name} cannot change in a built planner (only values, {', '.join(allowed)}); "
                    "make a new Planner"
                )
        plant = self.plant.with_values(values) if values else self.plant
        problem = formulate(plant, replace(self._statement, **changed))
        return renewed(self._program, problem)


# ---- the Plan that a search has come to ---------------------------------------------------------
HELD = "polynomial inputs did not meet the tolerance, so inputs are held constant on each interval"
BETWEEN = "costs are counted at the points of the mesh, so plan on a finer one"


def _plan_of(
    found: Solved,
    statement: Statement,
    figures: Mapping[str, Any],
    check: Checked | None = None,
    meshes: tuple[Mesh, ...] = (),
    coarse: Solved | None = None,
    tolerance: float | None = TOLERANCE,
    conflicts: tuple[Conflict, ...] = (),
) -> Plan:
    """The Plan of a solution that was checked, or of what a solver left that failed."""
    program, outcome, solution = found.program, found.outcome, found.solution
    problem = program.problem
    plant = check.plant if check else problem.plant
    samples = (
        check.samples if check else evaluated(plant, solution.t, solution.states, solution.inputs)
    )
    said = [words for words in (outcome.warning, figures.get("warning")) if words]
    statistics = {
        **figures,
        **({"warning": "; ".join(said)} if said else {}),
        "solver": outcome.solver,
        "solve_seconds": outcome.seconds,
        "variables": len(outcome.w),
        "constraints": len(outcome.lam_g),
        "intervals": len(program.mesh.intervals),
    }
    design = {n: float(plant.variable(n).start or 0.0) for n in problem.design}
    meshes = meshes or (program.mesh,)
    judgement, objective = None, outcome.objective
    if check:
        motion = motion_of(samples, meshes[-1], solution.durations)
        judgement = judge(plant, statement, motion, samples)
        if np.isfinite(judgement.objective):
            statistics["objective_on_mesh"], objective = objective, judgement.objective
    return Plan(
        plant,
        outcome.success,
        outcome.status,
        objective,
        tuple(float(d) for d in solution.durations),
        design,
        statistics,
        check.replay if check else None,
        judgement,
        meshes,
        outcome.log,
        conflicts,
        tolerance or TOLERANCE,
        samples,
        statement,
        problem,
        found,
        coarse,
        tuple(map(float, solution.peaks)),
    )


def _trust(search: Search, best: Candidate, tolerance: float | None) -> dict[str, Any]:
    """Figures of how far a minimum-energy objective has converged, of whether the mesh's defects
    were corrected, and what did not go as asked.
    """
    figures: dict[str, Any] = {}
    words = []
    meshes, mesh = search.meshes, search.engine.first.mesh
    if (mesh.form.control, best.mesh.form.control) == ("polynomial", "constant"):
        words.append(HELD)
    if meshes.economical and tolerance is not None:
        gap, replayed = meshes.gap(best), best.check.replay.objective
        figures |= {"objective_change": meshes.change(best), "objective_gap": gap}
        figures["objective_replayed"] = replayed
        words += [] if gap <= tolerance else [_not_converged(gap, tolerance)]
        if not abs(replayed - best.objective) / best.scale <= tolerance:
            words.append(f"along the replay the objective is {replayed:.3g}: {BETWEEN}")
    if best.is_corrected:
        figures["corrected"] = True
    if words:
        figures["warning"] = "; ".join(words)
    return figures


def _not_converged(gap: float, tolerance: float) -> str:
    """The note on an objective that finer meshes may yet lower."""
    far = f"{100 * gap:.2g} %" if gap == gap else "an unknown part"
    return (
        f"the objective has not converged to {tolerance:.0e}: it may lie {far} above its least, "
        "which finer meshes (method=Collocation(intervals)) or a plan as guess may reach"
    ).replace("e-0", "e-")
