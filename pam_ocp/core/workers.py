"""Cases in tasks: what a loop hands to a worker at once, and workers of our own, which may die.

A worker tells of each case that it has ended. When it is killed, the case at which it was is known:
that one is tried once more in a fresh worker, all others go on as if nothing had happened.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as ready
from typing import Any, TypeAlias

from .errors import PamError, kind_of
from .stop import LOCK, check, unlimited, yielded

Work: TypeAlias = Callable[[Any], Any]
"""What is done with one case."""
Finish: TypeAlias = "Callable[[Task, list[Any]], Any]"
"""What a worker makes of the results of a whole task before they travel."""
Answer: TypeAlias = Any
"""The results of a task in the order of its cases, or what ``Finish`` made of them."""

TRIES = 2
"""How often a case may take its worker with it."""
MOST = 100
"""Cases of a task, unless more are asked for."""
PER_WORKER = 50
"""Tasks for each worker, where there are cases enough: the last one keeps nobody waiting."""
UNCOUNTED = 10
"""Cases of a task where nobody knows how many there are."""
LOOK = 0.2
"""How often signals are looked for while we wait for workers [s]."""
GIVEN_UP: set[str] = set()
"""Loops that were broken off: their threads go on no further."""


@dataclass(frozen=True)
class Task:
    """Neighbouring cases: the ``index``-th task, its first case numbered ``first``."""

    index: int
    first: int
    cases: Sequence[Any]
    known: Mapping[int, Any] = field(default_factory=dict)
    """Results that are there already, by the case's place in the task."""

    @property
    def left(self) -> list[int]:
        """Places of the cases that are still to be worked on."""
        return [i for i in range(len(self.cases)) if i not in self.known]

    def results(self, found: Mapping[int, Any]) -> list[Any]:
        """All of them in order."""
        whole = {**self.known, **found}
        return [whole[i] for i in range(len(self.cases))]


def split(cases: Iterator[Any], size: int, first: int | None = None) -> Iterator[Task]:
    """Tasks of ``size`` cases, as they are asked for; where ``first`` says how many the first one
    has, each has twice as many as the one before it until they are ``size``, so that what ends
    early has results.
    """
    done, now = 0, size if first is None else min(first, size)
    for index in itertools.count():
        part = tuple(itertools.islice(cases, now))
        if not part:
            return
        yield Task(index, done, part)
        done, now = done + len(part), min(2 * now, size)


def usual_size(count: int | None, workers: int) -> int:
    """Cases of a task, so that workers end at about the same time."""
    if count is None:
        return UNCOUNTED
    return min(MOST, max(1, count // (PER_WORKER * workers)))


def processors() -> int:
    """How many this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1


@dataclass(frozen=True)
class Errand:
    """What is done with every task.

    finish : made of a task's results by the worker, before they travel.
    lost : the class of error for a case that takes its worker with it.
    """

    work: Work
    finish: Finish | None = None
    lost: type[PamError] = PamError

    def attempt(self, case: Any) -> Any:
        """The result of a case, or the error that it ended with."""
        try:
            return self.work(case)
        except Exception as error:
            return error

    def finished(self, task: Task, found: Mapping[int, Any]) -> Answer:
        """The answer to a task: its results, or what is made of them (or the error of that)."""
        results = task.results(found)
        if self.finish is None:
            return results
        try:
            return self.finish(task, results)
        except Exception as error:
            return error

    def here(self, task: Task) -> Answer:
        """The answer to a task that is worked on in this thread."""
        found = {}
        for i in task.left:
            check()
            found[i] = self.attempt(task.cases[i])
        return self.finished(task, found)


def sendable(answer: Answer) -> bytes:
    """An answer as bytes; results that cannot travel are replaced by an error that says so."""
    if isinstance(answer, list):
        answer = [_sound(r) if isinstance(r, Exception) else r for r in answer]
    try:
        return pickle.dumps(answer)
    except Exception as error:
        if isinstance(answer, list):
            return pickle.dumps([_travelled(r) for r in answer])
        return pickle.dumps(error)


def _sound(error: Exception) -> Exception:
    """Errors often pickle, and then cannot be made again."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return PamError(f"{type(error).__name__}: {error}")
    return error


def _travelled(result: Any) -> Any:
    try:
        pickle.dumps(result)
    except Exception as error:
        return PamError(f"{kind_of(result)} does not come back from its worker: {error}")
    return result


# ---- on somebody else's executor ----------------------------------------------------------------
def packed(work: Work) -> bytes:
    """What every task carries: small, and unpacked once in each process."""
    return zlib.compress(pickle.dumps(work), 1)


@lru_cache(maxsize=4)
def _unpacked(content: bytes) -> Work:
    """Once, so that integrators and the like are built once too."""
    work: Work = pickle.loads(zlib.decompress(content))  # our own bytes, from the parent
    return work


def remote(loop: str, content: bytes, task: Task, finish: Finish | None) -> bytes | None:
    """The answer to a task in another process or thread; None where the loop was given up."""
    found: dict[int, Any] = {}
    for i in task.left:
        with LOCK:  # threads of one process take turns
            if loop in GIVEN_UP:
                return None
            found[i] = Errand(_unpacked(content)).attempt(task.cases[i])
    return sendable(Errand(_unpacked(content), finish).finished(task, found))


# ---- in processes of our own --------------------------------------------------------------------
WATCH = 0.5
"""How often a worker asks whether its parent still lives [s]."""
DONE = b""
"""Told for each case."""


def forks() -> bool:
    """Whether a worker begins with all that is here: no script is run again for it."""
    return sys.platform == "linux"


def nested() -> bool:
    """Whether this is somebody's worker already, which has no processors to share out."""
    return multiprocessing.parent_process() is not None


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


@dataclass
class _Worker:
    """A process and what it is at."""

    process: Any
    connection: Connection
    errand: Errand
    task: Task | None = None
    done: int = 0
    """Cases of the present task that have ended."""
    deaths: dict[int, int] = field(default_factory=dict)
    """How many workers each case of the present task has taken with it, by its place."""
    answer: Any = None

    @classmethod
    def started(cls, errand: Errand) -> _Worker:
        context: Any = multiprocessing.get_context("fork" if forks() else None)
        here, there = context.Pipe()
        process = context.Process(target=_life, args=(there, here, errand), daemon=True)
        # no other thread may be amid something that the child would wait for
        with LOCK, warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads
            process.start()
        there.close()
        return cls(process, here, errand)

    def begin(self, task: Task) -> bool:
        """False where the task cannot travel; it is done here then."""
        self.task, self.done = task, 0
        try:
            self.connection.send(task)
        except OSError:  # it died at once; that is found when its answer is read
            pass
        except Exception:  # whatever pickling raises
            return False
        return True

    def receive(self) -> bool | None:
        """Whether the task has ended; None when the worker has died."""
        try:
            content = self.connection.recv_bytes()
        except (EOFError, OSError):
            return None
        if content == DONE:
            self.done += 1
            return False
        self.answer = pickle.loads(content)
        return True

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()

    def replaced(self) -> _Worker:
        """A fresh worker with the same task; the case that killed this one for good is left out."""
        self.stop()
        task = self.task
        assert task is not None
        left = task.left
        # behind the last case its results are on their way: then the last one is blamed
        at = left[min(self.done, len(left) - 1)] if left else 0
        deaths = {**self.deaths, at: self.deaths.get(at, 0) + 1}
        if deaths[at] >= TRIES:
            code = self.process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            error = self.errand.lost(
                f"case {task.first + at} ended its worker process {TRIES} times ({how}); run it "
                "alone to see why: memory, or a crash in a function of its own"
            )
            task = replace(task, known={**task.known, at: error})
        fresh = _Worker.started(self.errand)
        fresh.deaths = deaths
        fresh.begin(task)
        return fresh


def _life(connection: Connection, other: Connection, errand: Errand) -> None:
    """A worker's. The parent decides on interrupts and limits; without it there is no work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    other.close()
    end_with_parent()
    unlimited()
    while True:
        try:
            task: Task = connection.recv()
        except EOFError:
            return
        found = {}
        for i in task.left:
            found[i] = errand.attempt(task.cases[i])
            connection.send_bytes(DONE)
        connection.send_bytes(sendable(errand.finished(task, found)))


def in_workers(
    errand: Errand, tasks: Iterator[Task], count: int
) -> Generator[tuple[Task, Answer], None, None]:
    """The tasks and their answers as they end, in ``count`` processes."""
    crew = _Crew(errand, count)
    try:
        while True:
            crew.hand_out(tasks)
            # behind that: what is made of an answer keeps no worker waiting
            while crew.answers:
                yield crew.answers.pop()
            if crew.here:  # one that cannot travel
                task = crew.here.pop(0)
                crew.answers.append((task, errand.here(task)))
            elif crew.busy:
                crew.listen()
            else:
                return
    finally:  # also when the caller is interrupted, or asks for no more
        crew.stop()


class _Crew:
    """Workers, idle and busy, and what came of tasks."""

    def __init__(self, errand: Errand, count: int) -> None:
        self.errand, self.count = errand, count
        self.busy: dict[Any, _Worker] = {}
        self.idle: list[_Worker] = []
        self.here: list[Task] = []
        """Tasks that cannot travel."""
        self.answers: list[tuple[Task, Answer]] = []

    def hand_out(self, tasks: Iterator[Task]) -> None:
        """A task to everybody who has none, as far as there are any."""
        while len(self.busy) < self.count and len(self.here) < self.count:
            task = next(tasks, None)
            if task is None:
                return
            worker = self.idle.pop() if self.idle else _Worker.started(self.errand)
            self.busy[worker.connection] = worker
            worker.deaths = {}
            if not worker.begin(task):
                self.here.append(task)
                self.idle.append(self.busy.pop(worker.connection))

    def listen(self) -> None:
        """To those that have something to say; for a while at most."""
        check()
        with yielded():
            told = ready(list(self.busy), LOOK)
        check()
        for connection in told:
            worker = self.busy[connection]
            ended = worker.receive()
            if ended is None:
                fresh = worker.replaced()
                self.busy[fresh.connection] = fresh
                del self.busy[connection]
            elif ended:
                assert worker.task is not None
                self.answers.append((worker.task, worker.answer))
                self.idle.append(self.busy.pop(connection))

    def stop(self) -> None:
        """End all of them, whatever they are at."""
        for worker in (*self.busy.values(), *self.idle):
            worker.stop()
