"""Several starts of one program: whether they pay, which they are, what came of them, and how they
are solved side by side, as any other loop over cases.

Whoever names a place (:func:`starts_on`) has them solved there, by the program as CasADi's
functions: nothing of the caller's is imported or run again for it.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import PlanError
from ..core.stop import TimeIsUp
from ..numerics.solvers import nlpsol
from ..plants.plant import Plant
from .problem.problem import Problem
from .settings import SETTINGS
from .solvers.ipopt import Start
from .solvers.solver import Ipopt, Outcome
from .stages import Stage, entered, written
from .transcription.guess import by_stops, wants_balance
from .transcription.mesh import Mesh
from .transcription.transcription import Program

if TYPE_CHECKING:
    from ..core.executors import Place

Array: TypeAlias = NDArray[np.float64]

STARTS: tuple[tuple[bool, float, Start], ...] = (
    (True, 1.0, "cold"),
    (True, 1.0, "adaptive"),
    (True, 0.3, "cold"),
    (True, 3.0, "cold"),
    (True, 0.3, "adaptive"),
    (True, 3.0, "adaptive"),
    (False, 1.0, "cold"),
    (False, 1.0, "adaptive"),
    (False, 0.3, "cold"),
    (False, 3.0, "cold"),
    (False, 0.3, "adaptive"),
    (False, 3.0, "adaptive"),
)
"""(whether states run as in the planner's own guess, its durations, barrier strategy), the order in
which they found most on random tasks with valves.
"""
MOST = len(STARTS)


@dataclass(frozen=True)
class Task:
    """One start: a guess, and the solver's barrier strategy."""

    guess: Array
    start: Start


def figures_of(ends: Sequence[Outcome]) -> dict[str, Any]:
    """For a plan's statistics: where each start ended, and how far apart the solutions lay, as part
    of the best.
    """
    each = [
        {
            "objective": o.objective,
            "status": o.status,
            "solved": o.success,
            "iterations": o.iterations,
        }
        for o in ends
    ]
    values, apart = sorted(o.objective for o in ends if o.success), float("nan")
    if values:
        apart = (values[-1] - values[0]) / max(abs(values[0]), 1e-12)
    return {"starts": each, "starts_apart": apart}


def tasks(problem: Problem, mesh: Mesh, starts: int) -> list[Task]:
    """The first ``starts`` that differ, the planner's own guess first."""
    own, free = (
        wants_balance(problem),
        any(leg.duration[0] < leg.duration[1] for leg in problem.legs),
    )
    chosen = [s for s in STARTS if free or s[1] == 1.0][:starts]
    return [
        Task(by_stops(problem, mesh, own if usual else not own, stretch), start)
        for usual, stretch, start in chosen
    ]


def number_of_starts(plant: Plant) -> int:
    """How many starts pay: several with valves or a load on a spring of its own, else one.

    Of 21 random tasks with regulators twelve starts led to one optimum each (docs/validation.md).
    """
    return SETTINGS.several if plant.openings or in_series(plant) else 1


def in_series(plant: Plant) -> bool:
    """Whether the inputs reach a velocity by way of another position only."""
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    by_state = np.array(ca.DM(ca.jacobian_sparsity(xdot, plant.x), 1.0), bool)
    by_input = np.array(ca.DM(ca.jacobian_sparsity(xdot, plant.u), 1.0), bool)
    names = [v.name for v in plant.states]
    moved = {names.index(n) for pair in plant.positions.items() for n in pair}
    free = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    if not free:
        return False
    for velocity in plant.positions.values():
        target = names.index(velocity)
        reached = set(np.flatnonzero(by_input[:, free].any(axis=1)).tolist())
        new = reached - (moved - {target})
        seen: set[int] = set()
        while new:
            seen |= new
            onward = set(np.flatnonzero(by_state[:, sorted(new)].any(axis=1)).tolist())
            new = onward - seen - (moved - {target})
        if target not in seen:
            return True
    return False


# ---- side by side -------------------------------------------------------------------------------
PLACE: ContextVar[Place] = ContextVar("place of starts", default=None)
"""Where starts are solved: as a time limit it holds for all searches within a verb, those on
coarser meshes too.
"""


@contextlib.contextmanager
def starts_on(executor: Place) -> Iterator[None]:
    """In the ``with`` starts are solved there; None: as it was. Raises InputError for no place."""
    if executor is None:
        yield
        return
    from ..core.executors import placed  # `plan` loads no module for other processes without need

    placed(executor)
    before = PLACE.set(executor)
    try:
        yield
    finally:
        PLACE.reset(before)


def solved_side_by_side(
    ipopt: Ipopt, program: Program, tasks: Sequence[Task], first: float
) -> list[Outcome]:
    """The outcomes of all tasks, in their order.

    first : seconds that one start takes, by experience; short work is done in this process. Raises
    TimeIsUp where that has ended the search before a success, PlanError where a start was lost.
    """
    executor, found = PLACE.get(), dict[int, Outcome]()
    with contextlib.suppress(TimeIsUp):
        if executor is None:
            forked = _Forked(ipopt, program, tasks)
            for i, (outcome, stages) in _ended(forked, range(len(tasks)), forked.count(first)):
                entered(stages)
                found[i] = outcome
        else:
            work = _Elsewhere(*ipopt.portable({task.start for task in tasks}))
            cases = [(task.start, ipopt.arguments(program, task.guess)) for task in tasks]
            for i, answer in _ended(work, cases, executor):
                found[i] = Outcome.of(*answer)
                written(program, tasks[i].start, found[i], found[i].seconds, ipopt.cost)
    ended = [found[i] for i in sorted(found)]
    late = len(ended) < len(tasks)
    if executor is not None:
        ended, late = _settled(ipopt, program, ended, late)
    if late and not any(outcome.ended for outcome in ended):
        raise TimeIsUp
    return ended


def _ended(work: Any, cases: Sequence[Any], executor: Place) -> Iterator[tuple[int, Any]]:
    """The number and the result of each case."""
    from ..core.cases import ending

    for i, answer in ending(work, cases, executor=executor, chunk=1, what="starts", lost=PlanError):
        if isinstance(answer, PlanError):
            raise PlanError(f"a start of the plan was lost: {answer}")
        if isinstance(answer, Exception):
            raise answer
        yield i, answer


def _settled(
    ipopt: Ipopt, program: Program, found: Sequence[Outcome], late: bool
) -> tuple[list[Outcome], bool]:
    """Those that wandered brought to a place, while there is time; whether it was up.

    late : whether it was up before.
    """
    ended = []
    for outcome in found:
        try:
            ended.append(ipopt.settled(program, outcome))
        except TimeIsUp:
            ended.append(replace(outcome, success=outcome.success and not outcome.wandered))
            late = True
    return ended, late


@dataclass(frozen=True)
class _Forked:
    """What solves the task of a number, here or in a fork of this process."""

    ipopt: Ipopt
    program: Program
    tasks: Sequence[Task]
    home: int = field(default_factory=os.getpid)

    def count(self, first: float) -> int:
        """How many processes pay; 0: none beside this one."""
        from ..core.cases import PAYS
        from ..core.workers import forks, nested, processors

        pays = first * len(self.tasks) >= PAYS and forks() and not nested()
        others = min(len(self.tasks), processors()) if pays else 0
        return others if others > 1 else 0

    def __call__(self, number: int) -> tuple[Outcome, list[Stage]]:
        """The outcome, and what another process entered of its solves."""
        task, away = self.tasks[number], os.getpid() != self.home
        if away:
            self.ipopt.report = None
        stages = entered()
        before = len(stages)
        outcome = self.ipopt(self.program, task.guess, task.start)
        return outcome, stages[before:] if away else []


class _Elsewhere:
    """What solves on an executor; called with a start and arguments."""

    def __init__(self, problem: ca.Function, options: Mapping[str, Mapping[str, Any]]) -> None:
        self.problem, self.options = problem, options
        self._solvers: dict[str, Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _Elsewhere, (self.problem, self.options)

    def __call__(
        self, case: tuple[str, Mapping[str, Array]]
    ) -> tuple[dict[str, Array], dict[str, Any], float]:
        begin, (name, arguments) = time.perf_counter(), case
        if name not in self._solvers:
            x, p = (ca.MX.sym(n, self.problem.size1_in(i)) for i, n in enumerate("xp"))
            f, g = self.problem(x, p)
            nlp = {"x": x, "p": p, "f": f, "g": g}
            self._solvers[name] = nlpsol(name, "ipopt", nlp, self.options[name])
        solver = self._solvers[name]
        result = solver(**arguments)
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "f", "lam_g", "lam_x")}
        keys, stats = ("return_status", "success", "iter_count", "iterations"), solver.stats()
        return arrays, {k: stats.get(k) for k in keys}, time.perf_counter() - begin
