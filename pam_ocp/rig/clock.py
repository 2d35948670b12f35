"""Time: of this host, or simulated, which passes only while somebody waits."""

from __future__ import annotations

import time
from typing import Protocol

SPIN = 3e-4
"""The last part of a wait [s] is spent looking at the clock: sleeping is no more exact."""


class Clock(Protocol):
    """What tells and passes time. ``real`` : it is that of the world."""

    real: bool

    def now(self) -> float: ...
    def wait(self, until: float) -> None: ...


class RealClock:
    """``time.monotonic()``.

    Examples
    --------
    >>> clock = pam.rig.RealClock()
    >>> begin = clock.now()
    >>> clock.wait(begin + 0.001)
    >>> clock.now() >= begin + 0.001
    True
    """

    real = True

    def now(self) -> float:
        """[s]."""
        return time.monotonic()

    def wait(self, until: float) -> None:
        """Come back at a time, or at once where it is over."""
        left = until - time.monotonic()
        if left > SPIN:
            time.sleep(left - SPIN)
        while time.monotonic() < until:
            pass


class SimulatedClock:
    """A clock for twins: waiting takes no time, and nothing else passes any.

    Examples
    --------
    >>> clock = pam.rig.SimulatedClock()
    >>> clock.wait(0.25)
    >>> clock.now()
    0.25
    """

    real = False

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """[s]."""
        return self._now

    def wait(self, until: float) -> None:
        """Go on to a time, where it is not over yet."""
        self._now = max(self._now, until)
