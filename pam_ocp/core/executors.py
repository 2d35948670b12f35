"""Tasks on anybody's executor: the standard library's pools, Dask's, MPI's, joblib's.

A worker that is lost takes a task with it. Its cases are then tried once more, each alone and one
after the other, so that one that kills its workers is told from those that stood beside it.
"""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Generator, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from pickle import loads
from typing import Any, Protocol, TypeAlias, runtime_checkable

from .errors import InputError, kind_of, require_count
from .stop import ask, check, yielded
from .workers import GIVEN_UP, LOOK, TRIES, Answer, Errand, Task, in_workers, packed, remote

WAITING = 4
"""Tasks per worker that are handed to an executor at once."""
UNKNOWN_WORKERS = 16
"""Workers of an executor that does not say how many it has."""
RECOUNT = 2.0
"""How often a cluster is asked how large it is by now [s]."""


@runtime_checkable
class Client(Protocol):
    """What Dask's clients have."""

    def get_executor(self, **arguments: Any) -> Executor:
        """An executor that hands to the cluster."""


Place: TypeAlias = "Executor | Client | int | None"
"""Where a loop over cases runs; see :func:`pam_ocp.core.cases.each`."""


def placed(executor: Any) -> Executor | int | None:
    """Where a loop runs, checked. Raises InputError."""
    if executor is None or isinstance(executor, Executor):
        return executor
    if isinstance(executor, int) and not isinstance(executor, bool):
        return require_count("executor", executor, 0)
    if isinstance(executor, Client):
        return executor.get_executor(pure=False)
    raise InputError(
        f"executor is {kind_of(executor)}: give a number of processes (0: this one alone), "
        "an executor of concurrent.futures, a client of Dask, or None for all processors"
    )


def end_pool(pool: ProcessPoolExecutor) -> None:
    """What runs in it too; Python below 3.14 has no word for it."""
    processes: dict[int, Any] = dict(getattr(pool, "_processes", None) or {})
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes.values():
        process.kill()


def on_executor(
    errand: Errand, tasks: Iterator[Task], executor: Executor
) -> Generator[tuple[Task, Answer], None, None]:
    """The tasks and their answers as they end; a few are handed over at a time."""
    try:
        content = packed(errand.work)
    except Exception as error:
        raise InputError(
            f"executor: what is to be done does not travel to its workers ({error}); take "
            "functions and classes of a module, without lambdas, or executor=0"
        ) from None
    there = _There(executor, content, errand)
    try:
        for task in tasks:
            there.submit(task)
            while there.full:
                yield from there.ended()
            if there.broken:
                break
        while there.pending:
            yield from there.ended()
        if there.broken:  # a worker's death breaks a whole pool: we go on without it
            rest = itertools.chain(there.broken, tasks)
            yield from in_workers(errand, rest, there.workers())
        for task in there.suspects:
            yield task, there.one_by_one(task)
    except BaseException:  # also when no more is asked for
        there.give_up()
        raise


class _There:
    """Tasks on an executor."""

    def __init__(self, executor: Executor, content: bytes, errand: Errand) -> None:
        self.executor, self.content, self.errand = executor, content, errand
        self.name = uuid.uuid4().hex
        self.pending: dict[Any, Task] = {}
        self.broken: list[Task] = []
        """Tasks of a pool that is no more."""
        self.suspects: list[Task] = []
        """Tasks that were lost."""
        self._size, self._asked = 0, -RECOUNT

    def workers(self) -> int:
        """How many there are; a cluster may grow and shrink."""
        if time.monotonic() > self._asked + RECOUNT:
            self._asked = time.monotonic()
            client: Any = getattr(self.executor, "_client", None)
            if hasattr(client, "nthreads"):
                self._size = sum(client.nthreads().values())
            else:
                self._size = getattr(self.executor, "_max_workers", 0)
        return self._size or UNKNOWN_WORKERS

    @property
    def full(self) -> bool:
        """Whether the executor has enough to do."""
        return len(self.pending) >= WAITING * self.workers()

    def submit(self, task: Task, finish: bool = True) -> None:
        """Hand a task over."""
        made = self.errand.finish if finish else None
        try:
            future = self.executor.submit(remote, self.name, self.content, task, made)
        except BrokenExecutor:
            self.broken.append(task)
            return
        self.pending[future] = task

    def ended(self) -> Iterator[tuple[Task, Answer]]:
        """What has ended, waiting for one for a while; what was lost is noted."""
        for future in self._first():
            task = self.pending.pop(future)
            try:
                answer = future.result()
            except BrokenExecutor:
                self.broken.append(task)
            except Exception:  # of the executor: what a case raises is a result
                self.suspects.append(task)
            else:
                yield task, loads(answer)  # our own bytes, from ``remote``

    def _first(self) -> list[Any]:
        check()
        if not all(isinstance(f, Future) for f in self.pending):
            return [next(iter(self.pending))]  # a class of its own: asked in order
        with yielded():
            done = wait(self.pending, LOOK, FIRST_COMPLETED).done
        check()
        return list(done)

    def one_by_one(self, task: Task) -> Answer:
        """A task that was lost, each of its cases alone and nothing beside it."""
        found: dict[int, Any] = {}
        for i in task.left:
            single = Task(task.index, task.first + i, [task.cases[i]])
            self.submit(single, finish=False)
            try:
                (future,) = self.pending
                while not (done := self._first()):
                    pass
                del self.pending[done[0]]
                found[i] = loads(future.result())[0]
            except Exception as error:
                found[i] = self.errand.lost(
                    f"case {single.first} was lost with its worker, {TRIES} times "
                    f"({type(error).__name__}: {error}); run it alone to see why"
                )
        return self.errand.finished(task, found)

    def give_up(self) -> None:
        """Nothing more is asked for: call off what waits, and end what we may."""
        GIVEN_UP.add(self.name)
        if ask() and isinstance(self.executor, ProcessPoolExecutor):
            end_pool(self.executor)
        for future in self.pending:
            future.cancel()
