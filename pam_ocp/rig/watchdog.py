"""The watchdog, seen from the loop: a process of its own that is told again and again."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path

from .drivers.driver import Emergency
from .guard import RigError

__all__ = ["Watchdog"]

SCRIPT = Path(__file__).with_name("watchdog_server.py")
TRIPPED = "the watchdog has vented: the loop was late"
PATIENCE = 10.0
"""For it to be ready, and to end [s]."""


class Watchdog:
    """A process that vents by ``emergency`` when no :meth:`beat` comes for ``heartbeat`` [s].

    Raises RigError where it does not get ready.
    """

    def __init__(self, emergency: Emergency, heartbeat: float) -> None:
        how = {
            "kind": emergency.kind,
            "target": emergency.target,
            "port": emergency.port,
            "payload": base64.b64encode(emergency.payload).decode("ascii"),
            "arguments": dict(emergency.arguments or {}),
            "path": sys.path,
            "heartbeat": heartbeat,
        }
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
        self._told, self._heard = self._process.stdin.fileno(), self._process.stdout.fileno()
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
            os.write(self._told, letter)
        except OSError:
            return False
        return True

    def beat(self) -> str:
        """All is well. What is wrong with the watchdog, "" where nothing is."""
        if not self._say(b"H"):
            return "the watchdog's process has ended"
        return TRIPPED if self.heard_trip() else ""

    @property
    def told(self) -> int:
        """The pipe by which it is told letters, for a loop in another process."""
        return self._told

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

    def wait_for_trip(self, seconds: float) -> bool:
        """Whether it says within a time that it vented."""
        until = time.monotonic() + seconds
        while not self.tripped and time.monotonic() < until:
            self.tripped = self._answer(until - time.monotonic()) == b"T"
        return self.tripped
