"""Long verbs in processes of their own: progress, a stop, a time limit, and who waits for whom.

No page is needed. What a process does is a function at the top of a module, called with plain
values (numbers, texts, lists, mappings, NumPy arrays), and what it returns is of that kind, too: it
gets descriptions (a session's state) and makes nouns of them there, by made.py. ::

    @job("Front", time_limit=120.0)         # what stands beside its progress, and how it is done
    def front(say, world, points):          # in jobs of a tab; ``say`` is always the first argument
        ...
        say(0.5, "3 of 6 plans")            # fraction done (None: unknown), and words
        return {"t": array, "verdict": text}

    work = Workshop(2)                                              # once for the whole page
    job = work.start("session", "Front", front, world, points=6, time_limit=120.0)
    result = await job                      # raises JobFailed (what it raised), or JobStopped
    job.stop()                              # kills its process; others go on, the job is lost

``warm="plan"`` sends a job to the process that did such a job of this owner last, where what it
keeps (``functools.lru_cache``, made.py) is still there. ``latest="drag"`` drops a waiting job of
the same owner and name: of many positions of a slider the last one counts.

A process that dies loses its job only (JobStopped says so), and another takes its place. Processes
end with the page, also when it is killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from ..core.errors import PamError
from ..core.stop import limited

Say = Callable[..., None]
GRACE = 5.0
"""Seconds that a job has, beyond its time limit, to end by itself."""
MOST_WAITING = 200
"""Jobs that wait; more are refused."""
MOST_JOBS = 200
"""Jobs that a process does before a fresh one takes its place: what libraries leak goes with it."""


F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Manner:
    """How a job is done: title ("{}": of what), ``warm`` and ``latest`` as the head of this module
    says, time_limit [s]; quiet : not shown in the footer (what takes a blink, again and again).
    """

    title: str
    warm: str = ""
    latest: str = ""
    time_limit: float = 600.0
    quiet: bool = False


_manners: dict[Callable[..., Any], Manner] = {}


def job(title: str, **manner: Any) -> Callable[[F], F]:
    """Says with a function how its job is done (:class:`Manner`)."""

    def said(function: F) -> F:
        _manners[function] = Manner(title, **manner)
        return function

    return said


def manner_of(function: Callable[..., Any]) -> Manner:
    """What :func:`job` said of it."""
    return _manners[function]


class JobStopped(Exception):
    """The job was stopped, dropped for a later one, or its process died; the words say which."""


class JobFailed(PamError):
    """What the function raised, in its words. kind : its class. trace : of a fault of ours."""

    def __init__(self, kind: str, words: str, trace: str = "") -> None:
        super().__init__(words)
        self.kind, self.trace = kind, trace


class Job:
    """A piece of work on its way. ``await`` it for its result.

    title : in the page's words. state : "waiting", "running", "done", "failed" or "stopped".
    fraction : done of it, or None. said : its last words.
    """

    def __init__(self, owner: str, title: str, call: tuple[Any, ...], limit: float | None) -> None:
        self.owner, self.title, self.call, self.limit = owner, title, call, limit
        self.warm = self.latest = ""
        self.state = "waiting"
        self.fraction: float | None = None
        self.said = ""
        self.future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self.future.add_done_callback(_looked_at)
        self.changed: Callable[[Job], None] = lambda job: None
        self._shop: Workshop | None = None

    def __await__(self) -> Generator[Any, None, Any]:
        return self.future.__await__()

    @property
    def over(self) -> bool:
        """Whether nothing more will come of it."""
        return self.state in ("done", "failed", "stopped")

    def stop(self, why: str = "stopped") -> None:
        """End it now; nothing where it is over."""
        if self._shop is not None and not self.over:
            self._shop.stop(self, why)


class Workshop:
    """Processes that take jobs in turn.

    processes : that work at once; by default the processors of this machine, two at least.
    prepare : called in each of them before its first job, to load what jobs need.
    """

    def __init__(
        self, processes: int | None = None, prepare: Callable[[], None] | None = None
    ) -> None:
        self.most = processes or max(2, os.cpu_count() or 2)
        self.prepare = prepare
        self.jobs: list[Job] = []
        self._idle: list[_Worker] = []
        self._busy: dict[Job, _Worker] = {}

    def start(
        self,
        owner: str,
        title: str,
        function: Callable[..., Any],
        *args: Any,
        time_limit: float | None = None,
        warm: str = "",
        latest: str = "",
        changed: Callable[[Job], None] | None = None,
        **kwargs: Any,
    ) -> Job:
        """Have ``function(say, *args, **kwargs)`` done; see the head of this module.

        owner : the session. changed : called with the job whenever it changes. Raises PamError
        where too many jobs wait.
        """
        job = Job(owner, title, (function, args, kwargs, time_limit), time_limit)
        job.warm, job.latest, job._shop = warm and f"{owner} {warm}", latest, self
        if changed is not None:
            job.changed = changed
        if sum(1 for j in self.jobs if j.state == "waiting") >= MOST_WAITING:
            raise PamError(f"{title}: {MOST_WAITING} jobs wait already; stop some of them")
        if latest:
            for other in [*self.jobs]:
                if (other.owner, other.latest, other.state) == (owner, latest, "waiting"):
                    other.stop("overtaken")
        self.jobs.append(job)
        job.changed(job)
        self._next()
        return job

    def warm_up(self) -> None:
        """Have one process ready before the first job."""
        if not self._idle and not self._busy:
            self._idle.append(_Worker(self, asyncio.get_running_loop()))

    def stop(self, job: Job, why: str = "stopped") -> None:
        """End a job; its process, if it runs, is killed."""
        worker = self._busy.pop(job, None)
        if worker is not None:
            worker.kill()
        self._over(job, "stopped", JobStopped(f"{job.title}: {why}"))

    def stop_all(self, owner: str | None = None) -> None:
        """End all jobs, or those of one owner."""
        for job in [*self.jobs]:
            if owner in (None, job.owner):
                job.stop()

    def close(self) -> None:
        """End all jobs and processes."""
        self.stop_all()
        for worker in self._idle:
            worker.kill()
            worker.listener.join(GRACE)
        self._idle.clear()

    # ---- inside --------------------------------------------------------------------------------
    def _next(self) -> None:
        """Give waiting jobs to processes: owners who have fewest running come first."""
        while len(self._busy) < self.most:
            running = [j.owner for j in self._busy]
            waiting = [j for j in self.jobs if j.state == "waiting"]
            if not waiting:
                return
            job = min(waiting, key=lambda j: running.count(j.owner))
            worker = self._worker(job.warm)
            job.state = "running"
            self._busy[job] = worker
            if job.limit is not None:
                loop = asyncio.get_running_loop()
                loop.call_later(job.limit + GRACE, self._late, job)
            worker.give(job)
            job.changed(job)

    def _worker(self, warm: str) -> _Worker:
        """An idle process, if it can be one that did such a job; or a new one."""
        self._idle = [w for w in self._idle if w.alive]
        own = [w for w in self._idle if warm and warm in w.warm]
        plain = [w for w in self._idle if not w.warm]
        usable = own or plain or self._idle
        room = len(self._idle) + len(self._busy) < self.most
        if usable and (own or plain or not room):
            worker = usable[0]
            self._idle.remove(worker)
        else:
            worker = _Worker(self, asyncio.get_running_loop())
        if warm:
            worker.warm = {warm}
        return worker

    def _late(self, job: Job) -> None:
        if job.state == "running":
            self._busy.pop(job).kill()
            words = f"{job.title}: time_limit = {job.limit:g} s was over; allow more time"
            self._over(job, "failed", JobFailed("OutOfTime", words))

    def told(self, worker: _Worker, kind: str, content: Any) -> None:
        """A process said something of its job (called in the page's thread)."""
        job = worker.job
        if job is None or self._busy.get(job) is not worker:
            return
        if kind == "said":
            job.fraction, job.said = content
            job.changed(job)
            return
        self._busy.pop(job)
        worker.job = None
        if kind != "gone" and worker.done < MOST_JOBS:
            self._idle.append(worker)
        else:
            worker.kill()
        if kind == "done":
            self._over(job, "done", content)
        elif kind == "failed":
            self._over(job, "failed", JobFailed(*content))
        else:
            self._over(job, "stopped", JobStopped(f"{job.title}: its process ended; try it again"))

    def _over(self, job: Job, state: str, result: Any) -> None:
        job.state = state
        with contextlib.suppress(ValueError):
            self.jobs.remove(job)
        if not job.future.done():
            if state == "done":
                job.future.set_result(result)
            else:
                job.future.set_exception(result)
        job.changed(job)
        self._next()


def _looked_at(future: asyncio.Future[Any]) -> None:
    """A job that nobody awaits any more fails in silence."""
    if not future.cancelled():
        future.exception()


# ---- processes -----------------------------------------------------------------------------------
_numbers = itertools.count()


class _Worker:
    """A process, and the thread that listens to it."""

    def __init__(self, shop: Workshop, loop: asyncio.AbstractEventLoop) -> None:
        context = multiprocessing.get_context("spawn")
        self._shop, self._loop = shop, loop
        self._own, theirs = context.Pipe()
        name = f"pam-ocp bench {next(_numbers)}"
        self._process = context.Process(target=_serve, args=(theirs, shop.prepare), name=name)
        self._process.start()
        theirs.close()
        self.job: Job | None = None
        self.done = 0
        self.warm: set[str] = set()
        self.listener = threading.Thread(target=self._listen, daemon=True)
        self.listener.start()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def give(self, job: Job) -> None:
        self.job = job
        self.done += 1
        with contextlib.suppress(OSError):  # it died: the listener says so
            self._own.send(job.call)

    def kill(self) -> None:
        """End it with the processes that it started (compilers, FMUs)."""
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg") and self._process.pid:
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()

    def _listen(self) -> None:
        while True:
            try:
                kind, content = self._own.recv()
            except Exception:  # it is gone, or sent half of something
                kind, content = "gone", None
            with contextlib.suppress(RuntimeError):  # the loop is closed: the page ends
                self._loop.call_soon_threadsafe(self._shop.told, self, kind, content)
            if kind == "gone":
                self._own.close()
                self._process.join()
                return


def _serve(pipe: Connection, prepare: Callable[[], None] | None) -> None:
    """The life of a process: jobs from the pipe, one after the other."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page, which ends this
    if hasattr(os, "setsid"):
        os.setsid()
    if hasattr(os, "nice"):
        os.nice(5)  # the page answers first
    parent = multiprocessing.parent_process()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    if prepare is not None:
        prepare()
    while True:
        try:
            function, args, kwargs, limit = pipe.recv()
        except (EOFError, OSError):
            return

        def say(fraction: float | None, words: str = "") -> None:
            pipe.send(("said", (None if fraction is None else float(fraction), str(words))))

        try:
            with limited(limit):
                answer: tuple[str, Any] = "done", function(say, *args, **kwargs)
        except Exception as error:
            answer = "failed", _in_words(error)
        try:
            pipe.send(answer)
        except (TypeError, ValueError, AttributeError) as error:
            pipe.send(("failed", _in_words(RuntimeError(f"no plain result: {error}"))))


def _in_words(error: Exception) -> tuple[str, str, str]:
    """Class, words, and the trace of what we did not raise on purpose."""
    if isinstance(error, PamError):
        return type(error).__name__, str(error), ""
    words = f"{type(error).__name__}: {error}; please report it"
    return type(error).__name__, words, "".join(traceback.format_exception(error))


def _end_with(parent: Any) -> None:
    if parent is not None:
        parent.join()
    if hasattr(os, "killpg"):
        with contextlib.suppress(OSError):
            os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)
