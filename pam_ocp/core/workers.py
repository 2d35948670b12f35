"""Worker processes of our own, which may die.

A worker tells of each case that it has ended. When it is killed, the case at which it was is known:
that one is tried once more in a fresh worker, all others go on as if nothing had happened.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as ready
from typing import Any

from .stop import LOCK, check, unlimited, yielded
from .tasks import LOOK, TRIES, Answer, Errand, Task, sendable

__all__ = ["end_with_parent", "forks", "in_workers", "nested"]

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
