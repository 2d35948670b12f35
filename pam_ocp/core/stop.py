"""Stopping and taking turns: what signals, time limits and threads mean to every verb.

CasADi swallows what Python raises inside its calls: the error of a signal's handler comes back as
RuntimeError, as the status of a failed solve, or not at all. So for the time of a verb the handlers
of signals are wrapped: what they raise is kept, breaks off the call, and is raised again behind it,
at the latest where the verb ends. A time limit goes the same way.

CasADi's objects are not thread safe (two threads on one plant end the process): verbs take turns,
by one lock.
"""

from __future__ import annotations

import _thread
import difflib
import functools
import inspect
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from types import FrameType, FunctionType, TracebackType
from typing import Any, ParamSpec, TypeVar

from .errors import OutOfTime, require_positive

__all__ = [
    "LOCK",
    "Deadline",
    "TimeIsUp",
    "ask",
    "check",
    "deadline",
    "interruptible",
    "limited",
    "locked",
    "native",
    "spared",
    "turns",
    "verb",
]

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)

LOCK = threading.RLock()
"""Held by whatever builds or evaluates CasADi's objects."""

SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGALRM", "SIGBREAK")
    if hasattr(signal, name)
)
"""Whose handlers, where they are Python's, may raise to end a verb."""


class TimeIsUp(BaseException):
    """A time limit is over. No Exception: what counts failures must not take it for one.

    Whoever has something to show for the time catches it; the verb whose limit it is turns it into
    OutOfTime.
    """


class Deadline:
    """A moment that a time limit sets (math.inf for none); an inner one never outlasts an outer."""

    def __init__(self, seconds: float, outer: Deadline | None = None) -> None:
        self.seconds = seconds
        self.end: float = time.monotonic() + seconds
        if outer is not None:
            self.end = min(self.end, outer.end)

    def __str__(self) -> str:
        return f"time_limit = {self.seconds:g} s"

    def remaining(self) -> float:
        """Seconds left; 0 when there are none."""
        return max(0.0, self.end - time.monotonic())

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return self.end != math.inf and time.monotonic() >= self.end

    def check(self) -> None:
        """Raise TimeIsUp when the time is up."""
        if self.over:
            raise TimeIsUp


class _Here(threading.local):
    """Of each thread: the innermost deadline."""

    deadline = Deadline(math.inf)


class _Signals:
    """The handlers of signals, wrapped for the time of the outermost verb (in the main thread)."""

    def __init__(self) -> None:
        self.depth = 0
        self.native = 0
        """How many of CasADi's calls are under way: only these are broken off by a time limit."""
        self.held = 0
        """Above zero nothing is raised by a handler: the call looks for it itself."""
        self.error: BaseException | None = None
        """What a handler raised."""
        self._before: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._ticked = False

    def __enter__(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        if self.depth == 0:
            self.error, self._ticked = None, False
            for number in SIGNALS:
                before = signal.getsignal(number)
                if callable(before) and before != self._arrived:
                    self._before[number] = before
                    signal.signal(number, self._arrived)
        # last, and no call behind it: what a handler raises above leaves the depth as it was
        self.depth += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        if self.depth > 1:
            self.depth -= 1
            return
        # first: what a handler raises below leaves handlers that the next verb takes over
        pending, self.error, self.depth = self.error, None, 0
        for number, before in self._before.items():
            signal.signal(number, before)
        self._before.clear()
        if pending is not None and pending is not error:
            raise pending

    def _arrived(self, number: int, frame: FrameType | None) -> None:
        if self._ticked and number == signal.SIGINT:
            self._ticked = False
            if self.native and not self.held and _here.deadline.over:
                raise TimeIsUp
            return
        try:
            self._before[number](number, frame)
        except BaseException as error:
            self.error = error
            if not self.held:
                raise

    def tick(self) -> None:
        """From another thread, when a time limit is over: break off the call under way."""
        if self.native and not self.held and signal.SIGINT in self._before:
            self._ticked = True
            _thread.interrupt_main()


_here, _signals = _Here(), _Signals()


def deadline() -> Deadline:
    """The deadline that holds here."""
    return _here.deadline


def check() -> None:
    """For loops: raise what a signal asked for, or TimeIsUp."""
    if _signals.error is not None and _in_main():
        raise _signals.error
    _here.deadline.check()


def ask() -> bool:
    """For a solver's iteration callback: whether it should end here."""
    return (_signals.error is not None and _in_main()) or _here.deadline.over


def _in_main() -> bool:
    return threading.current_thread() is threading.main_thread()


def native(function: Callable[..., R], *args: Any, held: bool = False, **kwargs: Any) -> R:
    """A call of CasADi's that may take long, which signals and time limits break off.

    held : the call asks for itself (``ask``), in a callback.
    Raises what the signal's handler raised, or TimeIsUp, whatever came of the call.
    """
    with LOCK, _signals:
        check()
        mine = _in_main()
        _signals.native += mine
        _signals.held += mine and held
        try:
            found = function(*args, **kwargs)
        except BaseException:
            if mine and _signals.error is not None:
                raise _signals.error from None
            _here.deadline.check()
            raise
        finally:
            _signals.native -= mine
            _signals.held -= mine and held
        if mine and _signals.error is not None:
            raise _signals.error
        if held:
            _here.deadline.check()
        return found


@contextmanager
def limited(seconds: float | None) -> Iterator[None]:
    """A time limit [s] for what stands in the ``with``: OutOfTime when it is over.

    Limits nest: the one that ends first counts. None for no limit of its own.
    """
    outer = _here.deadline
    if seconds is None:
        yield
        return
    own = Deadline(require_positive("time_limit", seconds, "s"), outer)
    try:
        with _until(own):
            yield
    except TimeIsUp:
        if outer.over or not own.over:
            raise
        raise OutOfTime(f"{own} was over before there was a result; allow more time") from None


@contextmanager
def spared(seconds: float) -> Iterator[None]:
    """So many seconds [s] more where the time is up: to finish what there is to show for it."""
    with _until(Deadline(max(seconds, _here.deadline.remaining()))):
        yield


@contextmanager
def _until(moment: Deadline) -> Iterator[None]:
    outer, timer = _here.deadline, None
    _here.deadline = moment
    if moment.end != math.inf and _in_main():
        # the margin: who wakes too early would find time left
        timer = threading.Timer(moment.remaining() + 1e-3, _signals.tick)
        timer.daemon = True
        timer.start()
    try:
        yield
    finally:
        _here.deadline = outer
        if timer is not None:
            timer.cancel()


def interruptible() -> AbstractContextManager[None]:
    """What a signal's handler raises in the ``with`` comes out of it, whatever became of it within.

    No turns are taken: for what may run while another thread waits for this one, as imports do.
    """
    return _signals


def verb(function: Callable[P, R]) -> Callable[P, R]:
    """A public verb: threads take turns, signals end it, and ``time_limit=`` among its keywords."""

    signature = inspect.signature(function)
    argument = signature.parameters.get("time_limit")
    default = None if argument is None else argument.default

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        require_known_keywords(function.__qualname__, signature, kwargs)
        seconds: Any = kwargs.get("time_limit", default)
        if seconds is None:
            with LOCK, _signals:
                return function(*args, **kwargs)
        with limited(seconds), LOCK, _signals:
            return function(*args, **kwargs)

    return called


def require_known_keywords(
    name: str, signature: inspect.Signature, given: Mapping[str, Any]
) -> None:
    """TypeError that names the nearest keywords, where one is given that a function has not."""
    known = signature.parameters
    wrong = next((n for n in given if n not in known), None)
    if wrong is None or any(p.kind is p.VAR_KEYWORD for p in known.values()):
        return
    near = difflib.get_close_matches(wrong, known, 3, 0.6)
    has = " or ".join(near) if near else ", ".join(n for n in known if n != "self")
    raise TypeError(
        f"{name.removesuffix('.__init__')}() has no argument {wrong!r}; "
        + (f"did you mean {has}?" if near else f"it has {has}")
    )


def turns(function: Callable[P, R]) -> Callable[P, R]:
    """A quick method that evaluates CasADi's objects: threads take turns."""

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        with LOCK:
            return function(*args, **kwargs)

    return called


def locked(cls: C) -> C:
    """A class whose own methods evaluate CasADi's objects: threads take turns in all of them."""
    for name, member in list(vars(cls).items()):
        plain = not name.startswith("__") or name in ("__init__", "__call__", "__post_init__")
        if plain and isinstance(member, FunctionType):
            setattr(cls, name, verb(member) if name == "__init__" else turns(member))
        elif isinstance(member, property) and member.fget is not None:
            setattr(cls, name, property(turns(member.fget), member.fset, None, member.__doc__))
        elif isinstance(member, functools.cached_property):
            member.func = turns(member.func)
    return cls
