"""Handlers of signals in verbs: what they raise comes out, whatever becomes of it on its way.

An error that a handler raises can get lost: in CasADi's calls, in ``__del__``, in callbacks from C,
or as another error's cause (Python below 3.12: while a class is made). And it can do harm: half of
an import, half of a guard's own work. So for the time of a verb handlers are wrapped. What they
raise is kept; where it would do harm it waits; where it got lost it is raised again, at the latest
where the verb ends.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found, unused-ignore]  # without signal's enumerations
import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ContextDecorator, suppress
from types import CodeType, FrameType
from typing import Any, TypeVar
from weakref import WeakKeyDictionary, WeakSet, WeakValueDictionary

F = TypeVar("F", bound=Callable[..., Any])

SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGALRM", "SIGBREAK")
    if hasattr(signal, name)
)
"""Whose handlers, where they are Python's, may raise to end a verb."""
TICK = getattr(signal, "SIGURG", signal.SIGFPE)
"""By which our own threads call the main thread: one that nobody uses, and that is ignored."""
AGAIN = 0.05
"""How often an error is raised again that waits or got lost [s]."""
PATIENCE = 0.6
"""How long an import is not disturbed [s]; a second signal does not wait."""

_WEAK: tuple[Any, ...] = (WeakSet(), WeakKeyDictionary(), WeakValueDictionary())
_UNDISTURBED: set[CodeType] = {collection._remove.__code__ for collection in _WEAK}
_BOUNDARIES: set[CodeType] = set()
_DROPPING = frozenset({"__del__", "_remove_proxy"})
"""Functions that are called where an object goes (the second as matplotlib's callback of weak
references), so that what they raise is printed and lost."""


def undisturbed(function: F) -> F:
    """While the function runs no handler raises: what it raises waits."""
    _UNDISTURBED.add(function.__code__)
    return function


def boundary(function: F) -> F:
    """What called the function is not asked whether it may be disturbed."""
    _BOUNDARIES.add(function.__code__)
    return function


def in_main() -> bool:
    """Whether this is the thread that signals reach."""
    return threading.current_thread() is threading.main_thread()


class Interrupts(ContextDecorator):
    """The handlers of signals, wrapped for the time of the outermost verb (in the main thread)."""

    def __init__(self) -> None:
        self.depth = 0
        self.native = 0
        """How many of CasADi's calls are under way: only these are broken off by a time limit."""
        self.held = 0
        """Above zero nothing is raised by a handler: the call looks for it itself."""
        self.error: BaseException | None = None
        """What a handler raised."""
        self.due: Callable[[], BaseException | None] = lambda: None
        """What a tick raises in a call under way, where no signal asked for anything."""
        self._since = 0.0
        self._before: dict[int, Any] = {}
        self._callers: list[tuple[_thread.LockType, _thread.LockType]] = []
        """Of each thread that calls again: the lock that ends it, and the one that it leaves."""
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self.forget)

    @undisturbed
    def __enter__(self) -> None:
        if not in_main():
            return
        if self.depth == 0:
            try:
                self._install()
            except BaseException:  # of a handler that was not yet wrapped
                self._restore()
                self._end_callers()
                raise
        # last, and no call behind it: what a handler raises above leaves the depth as it was
        self.depth += 1

    @undisturbed
    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not in_main():
            return
        if self.depth > 1:
            self.depth -= 1
            return
        self.depth = 0
        try:
            self._restore()
        finally:  # a handler that is back in its place may raise above
            pending, self.error = self.error, None
            self._end_callers()
        if pending is not None and pending is not error:
            raise pending

    def _install(self) -> None:
        if not self._before:
            self.error, self.native, self.held = None, 0, 0
        for number in SIGNALS:
            before = _signal.getsignal(number)
            if callable(before) and before != self._arrived:
                self._before[number] = before
                _signal.signal(number, self._arrived)
        before = _signal.getsignal(TICK)
        if before in (signal.SIG_DFL, signal.SIG_IGN):
            self._before[TICK] = before
            _signal.signal(TICK, self._ticked)

    def _restore(self) -> None:
        """Handlers as they were. One that is back in its place may raise; then the others still
        follow.
        """
        try:
            for number in list(self._before):
                _signal.signal(number, self._before[number])
                del self._before[number]
        except BaseException:
            self._restore()
            raise

    def _arrived(self, number: int, frame: FrameType | None) -> None:
        """A signal."""
        try:
            self._before[number](number, frame)
        except BaseException as error:
            never, fragile = _work_under_way(frame)
            if self.depth == 0 and not never:  # a verb's end was interrupted, and left us in place
                raise
            first, self.error = self.error is None, error
            if first:
                self._since = time.monotonic()
                with suppress(RuntimeError):  # no thread to be had: at the verb's end then
                    self._begin_caller()
            if not (self.held or never or (fragile and first)):
                raise

    def _ticked(self, number: int, frame: FrameType | None) -> None:
        """One of our threads calls: an error waits or got lost, or a time limit is over."""
        if self.held or self.depth == 0:
            return
        never, fragile = _work_under_way(frame)
        if never:
            return
        if self.error is None:
            due = self.due() if self.native else None
            if due is not None:
                raise due
        elif not _under_way(self.error) and (not fragile or self._waited_long()):
            raise self.error

    def _waited_long(self) -> bool:
        return time.monotonic() > self._since + PATIENCE

    def _begin_caller(self) -> None:
        """A thread that calls till the verb ends (no Thread: its start takes locks)."""
        over, gone = _thread.allocate_lock(), _thread.allocate_lock()
        over.acquire()
        gone.acquire()
        _thread.start_new_thread(self._call_again, (over, gone))
        self._callers.append((over, gone))

    def _call_again(self, over: _thread.LockType, gone: _thread.LockType) -> None:
        try:
            while not over.acquire(timeout=AGAIN) and self.depth and self.error is not None:
                self.tick()
        finally:
            gone.release()

    def _end_callers(self) -> None:
        """Wait for them: one that wakes when the interpreter is gone crashes the process."""
        while self._callers:
            over, gone = self._callers.pop()
            over.release()
            gone.acquire()

    def tick(self) -> None:
        """From another thread: call the main thread, also where it waits for a lock."""
        if not self.depth or TICK not in self._before:
            return
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, TICK)
        else:
            _thread.interrupt_main(TICK)

    def forget(self) -> None:
        """In a process that was forked within a verb: handlers as they were before it."""
        self.depth = self.native = self.held = 0
        self.error = None
        self._callers.clear()
        for number, before in self._before.items():
            signal.signal(number, before)
        self._before.clear()


def _work_under_way(frame: FrameType | None) -> tuple[bool, bool]:
    """Up to the verb: whether nothing must be raised (a guard is at work; it would be printed and
    lost), and whether it had better wait (a module is half loaded).
    """
    fragile = False
    while frame is not None and frame.f_code not in _BOUNDARIES:
        code = frame.f_code
        importing = code.co_filename.startswith("<frozen importlib")
        if (
            code in _UNDISTURBED
            or code.co_name in _DROPPING
            or (importing and code.co_name == "cb")
        ):
            return True, True
        fragile |= importing or code.co_name == "__set_name__"
        frame = frame.f_back
    return False, fragile


def _under_way(error: BaseException) -> bool:
    """Whether the error is being handled: somebody cleans up, and it goes on behind that."""
    at, seen = sys.exc_info()[1], set()
    while at is not None and at is not error and id(at) not in seen:
        seen.add(id(at))  # libraries that set contexts themselves make rings of them
        at = at.__context__
    return at is error


INTERRUPTS = Interrupts()


def interruptible() -> Interrupts:
    """What a signal's handler raises in the ``with`` comes out of it, whatever became of it within.

    Also a decorator. No turns are taken: for what may run while another thread waits for this one,
    as imports do.
    """
    return INTERRUPTS
