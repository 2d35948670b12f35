"""Several starts of one program: whether they pay, which they are, what came of them, and how they
are solved side by side: by this process, and by others that only solve.

The other processes get the program as CasADi's functions, so nothing of the caller's is imported or
run again there (a script needs no ``if __name__ == "__main__"``). They end when this function is
left, by an answer or an interruption, and by themselves when this process is gone. Where none can
be started, all starts are solved here.

Whoever names a place (:func:`starts_on`) has them worked on there, as any other loop over cases.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import PlanError
from ..core.stop import TimeIsUp, check
from ..numerics.solvers import environment, nlpsol
from ..plants.plant import Plant
from .problem.problem import Problem
from .settings import SETTINGS
from .solvers.ipopt import Solves, Start
from .solvers.solver import Ipopt, Outcome
from .stages import written
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
SERVER = Path(__file__).parent / "solvers" / "ipopt.py"
PAYS = 1.0
"""Seconds of work left from which on other processes are started: each takes a third of this to
begin.
"""
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

    first : seconds that one start takes, by experience; short work is done in this process.
    """
    executor = PLACE.get()
    if executor is None:
        return _by_processes(ipopt, program, tasks, first)
    from ..core.cases import ending

    work: Any = _Elsewhere(*ipopt.portable({task.start for task in tasks}))
    cases = [(task.start, ipopt.arguments(program, task.guess)) for task in tasks]
    found: dict[int, Outcome] = {}
    with contextlib.suppress(TimeIsUp):
        for i, answer in ending(
            work, cases, executor=executor, chunk=1, what="starts", lost=PlanError
        ):
            if isinstance(answer, PlanError):
                raise PlanError(f"a start of the plan was lost: {answer}")
            if isinstance(answer, Exception):
                raise answer
            found[i] = Outcome.of(*answer)
    return _settled(ipopt, program, tasks, found, set(found))


def _settled(
    ipopt: Ipopt,
    program: Program,
    tasks: Sequence[Task],
    found: Mapping[int, Outcome],
    elsewhere: set[int],
) -> list[Outcome]:
    """Those that wandered brought to a place, while there is time; in the order of their tasks.

    elsewhere : those that were not solved in this process. Raises TimeIsUp where that has ended
    the search before a success.
    """
    ended, late = [], len(found) < len(tasks)
    for i in sorted(found):
        if i in elsewhere:
            written(program, tasks[i].start, found[i], found[i].seconds, ipopt.cost)
        try:
            ended.append(ipopt.settled(program, found[i]))
        except TimeIsUp:
            ended.append(replace(found[i], success=found[i].success and not found[i].wandered))
            late = True
    if late and not any(outcome.ended for outcome in ended):
        raise TimeIsUp
    return ended


class _Elsewhere:
    """What solves there; called with a start and arguments."""

    def __init__(self, problem: ca.Function, options: Mapping[str, Mapping[str, Any]]) -> None:
        self._given = problem, options
        self._solve = Solves(problem, options, nlpsol)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Elsewhere, self._given

    def __call__(
        self, case: tuple[str, Mapping[str, Array]]
    ) -> tuple[dict[str, Array], dict[str, Any], float]:
        begin = time.perf_counter()
        return *self._solve(*case), time.perf_counter() - begin


def _by_processes(
    ipopt: Ipopt, program: Program, tasks: Sequence[Task], first: float
) -> list[Outcome]:
    """By processes that know CasADi alone, and this one; short work by this one alone."""
    from ..core.workers import processors

    queue, found = deque(range(len(tasks))), {}
    others = min(len(tasks), processors()) - 1
    workers: list[_Worker] = []
    try:
        if first * len(tasks) >= PAYS:
            workers = _started(ipopt, program, tasks, queue, others)
        while True:
            try:
                i = queue.popleft()
            except IndexError:  # what a process that died gave back comes last
                alive = any(worker.thread.is_alive() for worker in workers)
                if not alive and not queue:
                    break
                check()
                time.sleep(0.01)
                continue
            found[i] = ipopt(program, tasks[i].guess, tasks[i].start)
            if found[i].stopped:
                break
    except TimeIsUp:
        pass
    finally:
        elsewhere: set[int] = set()
        for worker in workers:
            worker.end()
            found |= worker.found
            elsewhere |= set(worker.found)
    return _settled(ipopt, program, tasks, found, elsewhere)


def _started(
    ipopt: Ipopt, program: Program, tasks: Sequence[Task], queue: deque[int], count: int
) -> list[_Worker]:
    """Up to ``count`` processes; fewer where the program or the system does not allow them."""
    workers: list[_Worker] = []
    if count < 1 or not sys.executable:
        return workers
    try:
        setup = pickle.dumps(ipopt.portable({task.start for task in tasks}))
    except Exception:  # a plant may hold functions of its own that cannot travel
        return workers
    messages = [pickle.dumps((t.start, ipopt.arguments(program, t.guess))) for t in tasks]
    for _ in range(count):
        with contextlib.suppress(OSError):
            workers.append(_Worker(setup, messages, queue))
    return workers


class _Worker:
    """A process that takes tasks from a queue, and the thread that talks to it (which knows no
    CasADi).
    """

    def __init__(self, setup: bytes, messages: Sequence[bytes], queue: deque[int]) -> None:
        self.found: dict[int, Outcome] = {}
        self._process = subprocess.Popen(
            [sys.executable, str(SERVER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),
        )
        self.thread = threading.Thread(
            target=self._talk, args=(setup, messages, queue), daemon=True
        )
        self.thread.start()

    def _talk(self, setup: bytes, messages: Sequence[bytes], queue: deque[int]) -> None:
        into, out = self._process.stdin, self._process.stdout
        assert into is not None
        assert out is not None
        i = -1
        try:
            into.write(setup)
            while queue:
                try:
                    i = queue.popleft()
                except IndexError:
                    return
                begin = time.perf_counter()
                into.write(messages[i])
                into.flush()
                arrays, stats = pickle.load(out)
                self.found[i] = Outcome.of(arrays, stats, time.perf_counter() - begin)
                i = -1
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            if i >= 0:
                queue.append(i)  # somebody else will

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        self.thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
