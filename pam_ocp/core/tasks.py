"""Cases in tasks: what a loop hands to a worker at once, and what the worker does with it."""

from __future__ import annotations

import itertools
import os
import pickle
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeAlias

from .errors import PamError, kind_of
from .stop import LOCK, check

__all__ = [
    "GIVEN_UP",
    "LOOK",
    "TRIES",
    "Answer",
    "Errand",
    "Finish",
    "Task",
    "Work",
    "packed",
    "processors",
    "remote",
    "sendable",
    "split",
    "usual_size",
]

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
