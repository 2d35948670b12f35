"""The guard: looks at every reading and every command, and says when air must go out; and its
watchdog, a process of its own that is told again and again.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import PamError, require_positive
from .channels import Command, Reading
from .drivers.driver import Emergency

SILENT = "nothing valid comes in"
"""How words about readings that stay out end."""


class RigError(PamError):
    """A rig that was vented, or that does not do what it is asked; says why.

    Examples
    --------
    >>> issubclass(pam.rig.RigError, pam.PamError)
    True
    """


@dataclass(frozen=True)
class Guard:
    """What the guard allows, besides the limits of the channels. It vents where that is exceeded.

    max_age : of the newest valid reading, and of the last command that was taken where none is any
    more [s]. late : by which a sample may be late [s]; a sample
    later than ``tolerated`` of its length is counted as a missed deadline, and nothing more.
    heartbeat : [s] without a sign of life, after which the watchdog's process vents. fade : time
    constant [s] by which the step fades that a controller would make as it takes over.

    Examples
    --------
    >>> pam.rig.Guard(max_age="20 ms").max_age
    0.02
    """

    max_age: float = 0.03
    late: float = 0.03
    heartbeat: float = 0.03
    fade: float = 0.1
    tolerated: float = 0.5

    def __post_init__(self) -> None:
        for name in ("max_age", "late", "heartbeat", "fade"):
            value = require_positive(f"Guard.{name}", getattr(self, name), "s", zero=name == "fade")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "tolerated", require_positive("Guard.tolerated", self.tolerated))


class Watch:
    """A guard at work: remembers what it needs of the samples before."""

    def __init__(
        self, guard: Guard, readings: Mapping[str, Reading], commands: Mapping[str, Command]
    ) -> None:
        self.guard, self.readings, self.commands = guard, readings, commands
        self._last: dict[str, tuple[float, float]] = {}
        self._since: dict[str, float] = {}
        self._astray: dict[str, float] = {}

    def look(
        self, now: float, values: Mapping[str, float], stamp: float, sent: Mapping[str, float]
    ) -> str:
        """What is wrong with the newest readings [SI], taken at ``stamp``; "" where nothing is."""
        age = now - stamp
        if not age <= self.guard.max_age:
            return (
                f"the newest reading is {1e3 * age:.3g} ms old, {1e3 * self.guard.max_age:g} ms "
                f"are allowed: {SILENT}"
            )
        if age < -self.guard.max_age:  # would pass for new until the clock has come that far
            return (
                f"the newest reading is stamped {-1e3 * age:.3g} ms ahead of this host's clock, "
                f"{1e3 * self.guard.max_age:g} ms are allowed: its age is not known"
            )
        for name, channel in self.readings.items():
            words = self._channel(name, channel, now, values[name], stamp)
            if words or (words := self._following(name, channel, now, values[name], sent)):
                return words
        return ""

    def _channel(self, name: str, channel: Reading, now: float, value: float, stamp: float) -> str:
        if not math.isfinite(value):
            return f"{name} is no number"
        if not channel.low <= value <= channel.high:
            return f"{name} = {value:g} {channel.unit} has left {channel.low:g} .. {channel.high:g}"
        last, at = self._last.get(name, (value, stamp))
        if stamp > at and abs(value - last) > channel.rate * (stamp - at):
            return (
                f"{name} changes by {abs(value - last) / (stamp - at):.3g} {channel.unit}/s, "
                f"{channel.rate:g} are allowed"
            )
        if name not in self._last or stamp > at:
            self._last[name] = value, stamp
        if value != last or name not in self._since:
            self._since[name] = now
        still = now - self._since[name]
        if channel.frozen is not None and still > channel.frozen:
            return f"{name} has stayed the same to the last digit for {1e3 * still:.3g} ms"
        return ""

    def _following(
        self, name: str, channel: Reading, now: float, value: float, sent: Mapping[str, float]
    ) -> str:
        if not channel.follows:
            return ""
        away = abs(value - sent[channel.follows])
        if away <= channel.deviation:
            self._astray.pop(name, None)
        elif now - self._astray.setdefault(name, now) > channel.within:
            return (
                f"{name} is {away:g} {channel.unit} away from {channel.follows} for "
                f"{now - self._astray[name]:.3g} s: look at supply, valve and cable"
            )
        return ""

    def limited(
        self, asked: Mapping[str, float], before: Mapping[str, float], span: float
    ) -> dict[str, float]:
        """Commands within their ranges and rates; ``span`` [s] since those before."""
        found = {}
        for name, channel in self.commands.items():
            value = asked.get(name, before[name])
            if not math.isfinite(value):
                raise RigError(f"the command {name} = {value} is no number")
            way = channel.rate * span
            value = min(max(value, before[name] - way), before[name] + way)
            found[name] = min(max(value, channel.low), channel.high)
        return found


# ---- the watchdog, seen from the loop ------------------------------------------------------------
SCRIPT = Path(__file__).with_name("watchdog_server.py")
TRIPPED = "the watchdog has vented: the loop was late"
PATIENCE = 10.0
"""For it to be ready, and to end [s]."""


class Watchdog:
    """A process that vents by ``emergency`` when no :meth:`beat` comes for ``heartbeat`` [s].

    Raises RigError where it does not get ready.
    """

    def __init__(self, emergency: Emergency, heartbeat: float) -> None:
        how = {**emergency.told, "heartbeat": heartbeat}
        plain = ["-I", "-S"] if emergency.kind != "call" else []
        self._process = subprocess.Popen(
            [sys.executable, *plain, str(SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the loop
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.told, self._heard = self._process.stdin.fileno(), self._process.stdout.fileno()
        """The pipe by which it is told letters, also by a loop in another process."""
        self.tripped = False
        self._say(json.dumps(how).encode("ascii") + b"\n")
        if self._answer(PATIENCE) != b"R":
            self.close()
            raise RigError(
                f"the watchdog cannot reach {emergency.target}; it needs a way of its own to the "
                "rig (a second connection)"
            )

    def _answer(self, seconds: float) -> bytes:
        if select.select([self._heard], [], [], seconds)[0]:
            return os.read(self._heard, 1)
        return b""

    def _say(self, letter: bytes) -> bool:
        try:
            os.write(self.told, letter)
        except OSError:
            return False
        return True

    def beat(self) -> str:
        """All is well. What is wrong with the watchdog, "" where nothing is."""
        if not self._say(b"H"):
            return "the watchdog's process has ended"
        return TRIPPED if self.heard_trip() else ""

    def heard_trip(self) -> bool:
        """Whether it has said that it vented."""
        self.tripped = self.tripped or self._answer(0.0) == b"T"
        return self.tripped

    def idle(self) -> None:
        """The air is out: nothing to look after."""
        self._say(b"I")

    def vent(self) -> None:
        """Vent by the watchdog's own way."""
        self._say(b"V")

    def close(self) -> None:
        """End it; the air is out."""
        self._say(b"Q")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(PATIENCE if self._process.poll() is None else 0)
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
