"""Stopping and taking turns: what signals, time limits and threads mean to every verb.

CasADi swallows what Python raises inside its calls: the error of a signal's handler comes back as
RuntimeError, as the status of a failed solve, or not at all. So for the time of a verb the handlers
of signals are wrapped (core/interrupts.py): what they raise breaks off the call, and is raised
again behind it. A time limit goes the same way.

CasADi's objects are not thread safe (two threads on one plant end the process): verbs take turns,
by one lock.
"""

from __future__ import annotations

import functools
import inspect
import math
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

from .errors import OutOfTime, require_known_keywords, require_positive, with_kinds
from .interrupts import INTERRUPTS, boundary, in_main, undisturbed

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)

LOCK = threading.RLock()
"""Held by whatever builds or evaluates CasADi's objects."""


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


_here = _Here()


def _due() -> BaseException | None:
    return TimeIsUp() if _here.deadline.over else None


_signals = INTERRUPTS
_signals.due = _due


def deadline() -> Deadline:
    """The deadline that holds here."""
    return _here.deadline


def check() -> None:
    """For loops: raise what a signal asked for, or TimeIsUp."""
    if _signals.error is not None and in_main():
        raise _signals.error
    _here.deadline.check()


def ask() -> bool:
    """For a solver's iteration callback: whether it should end here."""
    return (_signals.error is not None and in_main()) or _here.deadline.over


@boundary
def native(function: Callable[..., R], *args: Any, held: bool = False, **kwargs: Any) -> R:
    """A call of CasADi's that may take long, which signals and time limits break off.

    held : the call asks for itself (``ask``), in a callback.
    Raises what the signal's handler raised, or TimeIsUp, whatever came of the call.
    """
    with LOCK, _signals:
        check()
        mine = in_main()
        before = _signals.native, _signals.held
        try:
            _signals.native += mine
            _signals.held += mine and held
            found = function(*args, **kwargs)
        except BaseException:
            if mine and _signals.error is not None:
                raise _signals.error from None
            _here.deadline.check()
            raise
        finally:
            if mine:
                _signals.native, _signals.held = before
        if mine and _signals.error is not None:
            raise _signals.error
        if held:
            _here.deadline.check()
        return found


class _Until:
    """A deadline for what stands in the ``with``; no signal parts it from its end."""

    def __init__(self, moment: Deadline | None, told: bool) -> None:
        self._moment, self._told, self._outer = moment, told, _here.deadline
        self._timer: threading.Timer | None = None

    @undisturbed
    def __enter__(self) -> None:
        moment = self._moment
        if moment is None:
            return
        if moment.end != math.inf and in_main():
            # the margin: who wakes too early would find time left
            self._timer = threading.Timer(moment.remaining() + 1e-3, _signals.tick)
            self._timer.daemon = True
            self._timer.start()
        _here.deadline = moment

    @undisturbed
    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        own, _here.deadline = _here.deadline, self._outer
        if self._timer is not None:
            self._timer.cancel()
        if self._told and isinstance(error, TimeIsUp) and own.over and not self._outer.over:
            raise OutOfTime(f"{own} was over before there was a result; allow more time") from None


def limited(seconds: float | None) -> AbstractContextManager[None]:
    """A time limit [s] for what stands in the ``with``: OutOfTime when it is over.

    Limits nest: the one that ends first counts. None for no limit of its own.
    """
    if seconds is None:
        return _Until(None, told=False)
    own = Deadline(require_positive("time_limit", seconds, "s"), _here.deadline)
    return _Until(own, told=True)


def spared(seconds: float) -> AbstractContextManager[None]:
    """So many seconds [s] more where the time is up: to finish what there is to show for it."""
    return _Until(Deadline(max(seconds, _here.deadline.remaining())), told=False)


def unlimited() -> None:
    """In a process that was forked within a time limit: its parent looks after that."""
    _here.deadline = Deadline(math.inf)


class yielded:
    """In the ``with`` other threads may take their turns, though a verb of this one is under way.

    For waiting alone: nothing of CasADi is touched in it.
    """

    def __enter__(self) -> None:
        lock: Any = LOCK
        self._state = lock._release_save() if lock._is_owned() else None

    @undisturbed
    def __exit__(self, *error: object) -> None:
        if self._state is not None:
            lock: Any = LOCK  # as threading.Condition does
            lock._acquire_restore(self._state)


def verb(function: Callable[P, R]) -> Callable[P, R]:
    """A public verb: threads take turns, signals end it, and ``time_limit=`` among its keywords."""

    signature = inspect.signature(function)
    argument = signature.parameters.get("time_limit")
    default = None if argument is None else argument.default
    named = with_kinds(function)

    @functools.wraps(function)
    @boundary
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        require_known_keywords(function.__qualname__, signature, kwargs)
        seconds: Any = kwargs.get("time_limit", default)
        if seconds is None:
            with _signals, LOCK:
                return named(*args, **kwargs)
        with _signals, limited(seconds), LOCK:
            return named(*args, **kwargs)

    return called


def turns(function: Callable[P, R]) -> Callable[P, R]:
    """A quick method that builds or evaluates CasADi's objects: threads take turns, signals come
    out.
    """
    owned: Callable[[], bool] = LOCK._is_owned  # type: ignore[attr-defined]

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        if _signals.depth and owned():  # within another: a step of a filter has twenty such calls
            return function(*args, **kwargs)
        with _signals, LOCK:
            return function(*args, **kwargs)

    return called


_METHODS = ("__init__", "__call__", "__post_init__", "__getitem__", "__str__")


def locked(cls: C) -> C:
    """A class whose own methods evaluate CasADi's objects: all of them are :func:`turns`."""
    for name, member in list(vars(cls).items()):
        plain = not name.startswith("__") or name in _METHODS
        if plain and isinstance(member, FunctionType):
            setattr(cls, name, verb(member) if name == "__init__" else turns(member))
        elif isinstance(member, property) and member.fget is not None:
            setattr(cls, name, property(turns(member.fget), member.fset, None, member.__doc__))
        elif isinstance(member, functools.cached_property):
            member.func = turns(member.func)
    return cls
