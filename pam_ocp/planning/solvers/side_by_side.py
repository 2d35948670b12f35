"""Several starts of one program side by side: this process, and others that only solve.

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
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.cases import ending
from ...core.errors import PlanError
from ...core.executors import Place, placed
from ...core.stop import TimeIsUp, check
from ...core.workers import processors
from ...numerics.blas import environment
from ...numerics.solvers import nlpsol
from ..stages import written
from ..starts import Task
from ..transcription.transcription import Program
from .solver import Ipopt, Outcome
from .solver_server import Solves

Array: TypeAlias = NDArray[np.float64]

SERVER = Path(__file__).with_name("solver_server.py")
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
    placed(executor)
    if executor is None:
        yield
        return
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
