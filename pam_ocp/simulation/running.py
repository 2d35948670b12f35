"""Many cases run here, on an executor, or in worker processes of our own.

A worker of our own answers case by case. When it is killed, the case at which it was is known: that
one is tried once more in a fresh worker, all others go on as if nothing had happened.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import signal
import threading
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as ready
from typing import Any, TypeAlias

from ..core.errors import PamError, SimulationError
from ..core.stop import ask
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from .simulator import simulate

__all__ = ["CASE_KEYS", "Case", "Result", "Run", "Task", "end_pool", "end_with_parent", "split"]

Case: TypeAlias = Mapping[str, Any]
Result: TypeAlias = "Trajectory | Exception"
CASE_KEYS = ("parameters", "start", "inputs")
WAITING = 4
"""Tasks per worker that are handed to an executor at once."""
UNKNOWN_WORKERS = 16
"""Workers of an executor that does not say how many it has."""
TRIES = 2
"""How often a case may take its worker with it."""

WATCH = 0.5
"""How often a worker asks whether its parent still lives [s]."""

_CASADI = threading.Lock()
"""CasADi's expressions are not safe among threads: a process works on one task at a time."""


_GIVEN_UP: set[str] = set()
"""Runs that were interrupted: their threads go on no further."""


@dataclass(frozen=True)
class Task:
    """Neighbouring cases: the ``index``-th task, its first case numbered ``first``."""

    index: int
    first: int
    cases: Sequence[Case]


def split(cases: Iterator[Case], size: int) -> Iterator[Task]:
    """Tasks of ``size`` cases, as they are asked for."""
    for index in itertools.count():
        part = tuple(itertools.islice(cases, size))
        if not part:
            return
        yield Task(index, index * size, part)


@dataclass(frozen=True)
class Run:
    """How cases are run: a plant, where, with which arguments; ``report`` is told how many ended.

    Called with tasks it gives them back with their results as they end; only a few of them are
    taken at a time.
    """

    plant: Plant
    executor: Executor | None
    workers: int | None
    common: dict[str, Any]
    report: Callable[[int], None]

    def __call__(self, tasks: Iterator[Task]) -> Generator[tuple[Task, list[Result]], None, None]:
        with closing(self._ended(tasks)) as ended:
            for task, results in ended:
                yield task, results
                self.report(len(results))

    def _ended(self, tasks: Iterator[Task]) -> Generator[tuple[Task, list[Result]], None, None]:
        if self.executor is not None:
            return _on_executor(pickle.dumps(self.plant), tasks, self.executor, self.common)
        if self.workers is not None:
            return _in_workers(pickle.dumps(self.plant), tasks, self.workers, self.common)
        return ((t, [run_case(self.plant, c, self.common) for c in t.cases]) for t in tasks)


def run_case(plant: Plant, case: Case, common: dict[str, Any]) -> Result:
    """The simulation of one case, or why there is none."""
    arguments = dict(common)
    for key in CASE_KEYS:
        if key in case:
            both = isinstance(case[key], Mapping) and isinstance(arguments.get(key), Mapping)
            arguments[key] = {**arguments[key], **case[key]} if both else case[key]
    try:
        return simulate(plant, **arguments)
    except PamError as error:
        return error


# ---- executors ----------------------------------------------------------------------------------
def _on_executor(
    packed: bytes, tasks: Iterator[Task], executor: Executor, common: dict[str, Any]
) -> Generator[tuple[Task, list[Result]], None, None]:
    workers = getattr(executor, "_max_workers", UNKNOWN_WORKERS)
    pending: dict[Any, Task] = {}
    broken: list[Task] = []
    name = uuid.uuid4().hex
    try:
        for task in tasks:
            try:
                pending[executor.submit(_task, name, packed, task.cases, common)] = task
            except BrokenExecutor:
                broken.append(task)
                break
            if len(pending) >= WAITING * workers:
                yield from _ended(pending, broken)
            if broken:
                break
        while pending:
            yield from _ended(pending, broken)
    except BaseException:  # also when no more is asked for
        _GIVEN_UP.add(name)
        if ask() and isinstance(executor, ProcessPoolExecutor):
            end_pool(executor)
        raise
    finally:
        for future in pending:
            future.cancel()
    # a worker's death breaks a whole pool of the standard library: we go on without it
    if broken:
        yield from _in_workers(packed, _chained(broken, tasks), workers, common)


def end_pool(pool: ProcessPoolExecutor) -> None:
    """What runs in it too; Python below 3.14 has no word for it."""
    processes: dict[int, Any] = dict(getattr(pool, "_processes", None) or {})
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes.values():
        process.kill()


def _chained(first: list[Task], then: Iterator[Task]) -> Iterator[Task]:
    yield from first
    yield from then


def _ended(pending: dict[Any, Task], broken: list[Task]) -> Iterator[tuple[Task, list[Result]]]:
    """What has ended of ``pending``, waiting for one; tasks of a broken pool go to ``broken``."""
    if all(isinstance(f, Future) for f in pending):
        done = list(wait(pending, return_when=FIRST_COMPLETED).done)
    else:  # futures of a class of their own are asked in order
        done = [next(iter(pending))]
    for future in done:
        task = pending.pop(future)
        try:
            results = future.result()
        except BrokenExecutor:
            broken.append(task)
            continue
        except Exception as error:
            results = [error] * len(task.cases)
        yield task, results


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Plant:
    """The plant in a worker: unpickled once, so that its integrators are built once too."""
    plant: Plant = pickle.loads(packed)  # our own bytes, from simulate_many in the parent
    return plant


def _task(run: str, packed: bytes, cases: Sequence[Case], common: dict[str, Any]) -> list[Result]:
    end_with_parent()
    results: list[Result] = []
    with _CASADI:
        plant = _unpacked(packed)
        for case in cases:
            if run in _GIVEN_UP:
                break
            results.append(run_case(plant, case, common))
    return results


@lru_cache(maxsize=1)
def end_with_parent() -> None:
    """Let this process end when the one that started it is gone, however that came about."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    starter = os.getppid()

    def watch() -> None:
        # siblings made by fork hold the parent's sentinel open, so its number is asked for as well
        while parent.is_alive() and os.getppid() == starter:
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# ---- workers of our own -------------------------------------------------------------------------
@dataclass
class _Worker:
    """A process and what it is at."""

    process: Any
    connection: Connection
    task: Task | None = None
    results: list[Result] = field(default_factory=list)
    deaths: int = 0
    """How many workers the present case has taken with it."""

    @classmethod
    def started(cls, packed: bytes, common: dict[str, Any]) -> _Worker:
        here, there = multiprocessing.Pipe()
        process = multiprocessing.Process(
            target=_work, args=(there, here, packed, common), daemon=True
        )
        process.start()
        there.close()
        return cls(process, here)

    def begin(self, task: Task, results: Sequence[Result] = (), deaths: int = 0) -> None:
        self.task, self.results, self.deaths = task, list(results), deaths
        with suppress(OSError):  # it died at once; that is found when its answer is read
            self.connection.send(task.cases[len(self.results) :])

    def receive(self) -> bool:
        """Take one result; False when the worker has died."""
        try:
            self.results.append(pickle.loads(self.connection.recv_bytes()))
        except (EOFError, OSError):
            return False
        self.deaths = 0
        return True

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


def _work(connection: Connection, other: Connection, packed: bytes, common: dict[str, Any]) -> None:
    """A worker's life. The parent decides on interrupts; without a parent there is no work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    other.close()
    end_with_parent()
    plant = _unpacked(packed)
    while True:
        try:
            cases = connection.recv()
        except EOFError:
            return
        for case in cases:
            try:
                result: Result = run_case(plant, case, common)
            except Exception as error:
                result = error
            try:
                content = pickle.dumps(result)
                pickle.loads(content)
            except Exception:
                content = pickle.dumps(PamError(f"{type(result).__name__}: {result}"))
            connection.send_bytes(content)


def _in_workers(
    packed: bytes, tasks: Iterator[Task], count: int, common: dict[str, Any]
) -> Generator[tuple[Task, list[Result]], None, None]:
    busy: dict[Any, _Worker] = {}
    present: _Worker | None = None
    try:
        for task in itertools.islice(tasks, count):
            present = _Worker.started(packed, common)
            present.begin(task)
            busy[present.connection] = present
        while busy:
            for connection in ready(list(busy)):
                present = busy.pop(connection)
                if not present.receive():
                    present = _replaced(present, packed, common)
                at = present.task
                assert at is not None
                if len(present.results) == len(at.cases):
                    yield at, present.results
                    following = next(tasks, None)
                    if following is None:
                        present.stop()
                        continue
                    present.begin(following)
                busy[present.connection] = present
    finally:  # also when the caller is interrupted, or asks for no more
        for worker in {id(w): w for w in (*busy.values(), present) if w is not None}.values():
            worker.stop()


def _replaced(dead: _Worker, packed: bytes, common: dict[str, Any]) -> _Worker:
    """A fresh worker that goes on where another has died."""
    dead.stop()
    task, results, deaths = dead.task, dead.results, dead.deaths + 1
    assert task is not None
    if deaths >= TRIES:
        code = dead.process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        results.append(
            SimulationError(
                f"case {task.first + len(results)} ended its worker process {TRIES} times ({how}); "
                "run it alone to see why: memory, or a crash in a function of its own"
            )
        )
        deaths = 0
    fresh = _Worker.started(packed, common)
    fresh.begin(task, results, deaths)
    return fresh
