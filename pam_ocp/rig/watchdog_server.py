"""A process of its own that vents a rig when nobody says any more that all is well.

    python -I -S watchdog_server.py

The first line on its input is JSON: how to vent. Then letters: H (alive, pressure may be on), I
(idle: nothing to look after), V (vent now), Q (the end). It vents where H stays out for longer than
``heartbeat``, where the input ends (whoever wrote is dead), and at V. It answers R (ready) and T
(vented), a letter each. It loads the standard library alone, so that nothing of ours can hold it up
(for drivers that need a library, that one, before it says that it is ready).
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

OFTEN, RARE, LONG = 0.005, 0.1, 1.0
"""Pauses between messages that vent [s]: OFTEN for the first LONG seconds, then RARE."""
LAST = 2.0
"""How long it goes on venting when whoever wrote is dead [s]."""


class Sender:
    """Sends the payload; a connection that broke is made anew."""

    def __init__(self, how: dict[str, Any]) -> None:
        self.how, self.payload = how, base64.b64decode(how["payload"])
        self.open: Any = None
        self.connect()

    def connect(self) -> None:
        """Raises OSError."""
        kind, target, port = self.how["kind"], self.how["target"], self.how["port"]
        if kind == "tcp":
            self.open = socket.create_connection((target, port), timeout=0.5)
            self.open.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        elif kind == "udp":
            self.open = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.open.connect((target, port))
        else:
            self.open = os.open(target, os.O_WRONLY | getattr(os, "O_NOCTTY", 0))

    def __call__(self) -> None:
        try:
            if self.open is None:
                self.connect()
            if isinstance(self.open, int):
                os.write(self.open, self.payload)
            else:
                self.open.send(self.payload)
                self.answers()
        except OSError:
            with contextlib.suppress(OSError):
                os.close(self.open) if isinstance(self.open, int) else self.open.close()
            self.open = None

    def answers(self) -> None:
        """They are taken, and not looked at: a full buffer would end the connection."""
        if self.how["kind"] == "tcp" and select.select([self.open], [], [], 0)[0]:
            self.open.recv(4096)


def called(how: dict[str, Any]) -> Callable[[], None]:
    """What vents by a driver's own library."""
    sys.path[:] = how["path"]
    module, _, name = how["target"].partition(":")
    driver = getattr(importlib.import_module(module), name)(**how["arguments"])

    def vent() -> None:
        with contextlib.suppress(Exception):
            driver.vent()

    return vent


def say(letter: bytes) -> None:
    """To whom asked; where he is dead, nobody."""
    with contextlib.suppress(OSError):
        os.write(1, letter)


def main() -> None:
    """Watch until Q, or until nobody is there and the air is out."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    line = b""
    while not line.endswith(b"\n"):
        if not (byte := os.read(0, 1)):
            return
        line += byte
    how = json.loads(line)
    sys.stdout = sys.stderr  # letters alone are said to whoever listens, not what drivers print
    vent = called(how) if how["kind"] == "call" else Sender(how)
    say(b"R")
    watch(vent, how["heartbeat"])


def watch(vent: Callable[[], None], heartbeat: float) -> None:
    """The loop."""
    state, heard, begun, alone = "I", time.monotonic(), 0.0, False
    pause: float | None
    while True:
        now = time.monotonic()
        if state == "V":
            pause = OFTEN if now - begun < LONG else RARE
        else:
            pause = max(heard + heartbeat - now, 0.0) if state == "H" else None
        letters = b""
        if alone:
            time.sleep(pause or 0.0)
        elif select.select([0], [], [], pause)[0]:
            letters = os.read(0, 4096)
            alone = not letters
        now = time.monotonic()
        if b"Q" in letters or (alone and (state == "I" or (begun and now - begun > LAST))):
            return
        if letters:
            heard = now
            last = letters[-1:].decode("ascii", "replace")
            if state != "V" or last == "I":  # what comes late does not put pressure on again
                state = "V" if b"V" in letters else last
                begun = 0.0
        if state == "H" and (alone or now - heard >= heartbeat):
            state = "V"
        if state == "V":
            vent()
            if not begun:
                begun = now
                say(b"T")


if __name__ == "__main__":
    main()
