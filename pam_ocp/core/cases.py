"""Loops over cases: the same work for each, here, in processes of our own, or on a cluster.

Fits, plans and simulations leave their loops to this one, so all of them run, report, stop and lose
workers in the same way. What comes of a case depends on the case alone, so a loop gives the same
bits wherever it runs.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

from .errors import InputError, PamError, require_count, require_instance, with_kinds
from .executors import Place, on_executor, placed
from .interrupts import interruptible
from .progress import working
from .stop import check
from .workers import (
    Answer,
    Errand,
    Finish,
    Task,
    Work,
    forks,
    in_workers,
    nested,
    processors,
    split,
    usual_size,
)

PAYS = 1.0
"""Seconds of work left from which on processes are started unasked."""
TRIED = 0.2
"""After so many seconds here we know what a case costs [s]."""


@dataclass(frozen=True)
class Loop:
    """How cases are worked on, and where; finish, lost : see :class:`Errand`."""

    work: Work
    executor: Executor | int | None
    count: int | None = None
    finish: Finish | None = None
    lost: type[PamError] = PamError

    @property
    def errand(self) -> Errand:
        """What is done with every task."""
        return Errand(self.work, self.finish, self.lost)

    @property
    def workers(self) -> int:
        """About how many work side by side."""
        if isinstance(self.executor, Executor):
            return int(getattr(self.executor, "_max_workers", 0)) or processors()
        return processors() if self.executor is None else max(1, self.executor)

    def __call__(self, tasks: Iterator[Task]) -> Generator[tuple[Task, Answer], None, None]:
        """The tasks and their answers as they end; only a few of them are taken at a time."""
        if isinstance(self.executor, Executor):
            return on_executor(self.errand, tasks, self.executor)
        if self.executor is None:
            return self._automatic(tasks)
        if self.executor == 0:
            return ((task, self.errand.here(task)) for task in tasks)
        return in_workers(self.errand, tasks, self.executor)

    def _automatic(self, tasks: Iterator[Task]) -> Generator[tuple[Task, Answer], None, None]:
        """Here, until it is plain that there is work for all processors.

        Workers then begin with what was built for the first cases: only where they are forked.
        """
        alone = processors() < 2 or nested() or not forks()
        begin, done = time.perf_counter(), 0
        for task in tasks:
            found: dict[int, Any] = {}
            for i in task.left:
                spent = time.perf_counter() - begin
                if not alone and done and spent > TRIED and self._pays(spent, done):
                    rest = itertools.chain([replace(task, known=found)], tasks)
                    yield from in_workers(self.errand, rest, processors())
                    return
                check()
                found[i] = self.errand.attempt(task.cases[i])
                done += 1
            yield task, self.errand.finished(task, found)

    def _pays(self, spent: float, done: int) -> bool:
        left = math.inf if self.count is None else self.count - done
        return left >= 2 and left * spent / done >= PAYS


def ending(
    work: Work,
    cases: Iterable[Any],
    *,
    executor: Place = None,
    chunk: int | None = None,
    progress: Callable[[int, int | None], None] | None = None,
    what: str = "cases",
    count: int | None = None,
    lost: type[PamError] = PamError,
) -> Generator[tuple[int, Any], None, None]:
    """(number, result or error) of each case, as they end: as :func:`each`, and nothing is kept."""
    if count is None and isinstance(cases, Sized):
        count = len(cases)
    loop = Loop(work, placed(executor), count, lost=lost)
    tasks = split(iter(cases), chunk or usual_size(count, loop.workers), None if chunk else 1)
    done = 0
    with (
        working(what, count) as bar,
        closing(loop(tasks)) as ended,
    ):
        for task, results in ended:
            for i, result in enumerate(results):
                yield task.first + i, result
            done += len(results)
            bar.step(len(results))
            if progress is not None:
                progress(done, count)


def results_of(
    work: Work, cases: Iterable[Any], *, executor: Place = None, what: str = "cases", **more: Any
) -> list[Any]:
    """The results in the order of the cases; the first error of a case (by number) is raised.

    For loops of our own, in which an error is ours to tell.
    """
    found = dict(ending(work, cases, executor=executor, what=what, **more))
    results = [found[i] for i in range(len(found))]
    for result in results:
        if isinstance(result, Exception):
            raise result
    return results


@with_kinds
def each(
    work: Callable[[Any], Any],
    cases: Iterable[Any],
    *,
    executor: Place = None,
    chunk: int | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> list[Any]:
    """Do the same for many cases, side by side: the results in the order of the cases.

    A case that fails does not stop the others: its result is the error.

    Parameters
    ----------
    work : called with one case. It travels to workers, so it is a function of a module, or an
        object of a class of one; plants, planners' arguments and results can be in it.
    cases : any values that can be pickled; a generator is read as far as there are workers for it.
    executor : where. None: in this process, and by all processors once more than a second of work
        is left (on Linux; elsewhere say a number, under ``if __name__ == "__main__"``). A number:
        so many processes of our own; 0: this one alone. Any ``concurrent.futures.Executor``: the
        standard library's pools, MPI's, joblib's. A client of Dask: its cluster.
    chunk : cases per task; by default so that there are some fifty tasks for each worker.
    progress : called as progress(done, all) after each task; all is None for a generator.

    A worker that is lost costs its cases only: they are tried once more, and what takes its worker
    with it again is a PamError. Ctrl-C ends what runs in processes of our own and in pools of
    processes. Raises InputError for what is no executor.

    Examples
    --------
    >>> import math
    >>> pam.each(math.sqrt, [1.0, 4.0, 9.0])
    [1.0, 2.0, 3.0]
    """
    if not callable(work):
        raise InputError(f"work = {work!r} cannot be called: give a function of one case")
    require_instance("cases", cases, Iterable, "give a list of cases, or a generator")
    if chunk is not None:
        require_count("chunk", chunk)
    with interruptible():
        found = dict(ending(work, cases, executor=executor, chunk=chunk, progress=progress))
    return [found[i] for i in range(len(found))]
