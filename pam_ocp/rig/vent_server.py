"""A button that vents a rig, on a small page of its own process and port.

    python -m pam_ocp.rig.vent_server

It depends on nothing that may hang elsewhere: it sends the vent line itself, as the watchdog does
(watchdog_server.py), and interrupts the process that runs the rig. The page is plain HTML: a form
with one button, no script. The first line on its input is JSON: ``host``, ``port`` (0: any),
``token`` (part of the address, known to who may vent), ``ancestors`` (pages that may frame it). It
answers its port. The second line is how to vent, as the watchdog is told, with ``pid`` (of who runs
the rig). It ends with its input.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from .watchdog_server import LONG, OFTEN, Sender, called

FIRST = 20
"""Vent lines before the answer; more follow for a second."""
PAGE = """<!doctype html><html lang=en><meta name=viewport content="width=device-width">
<title>Vent</title><style>:root{{color-scheme:light dark}}body{{margin:0;font:14px system-ui}}
form{{margin:0}}button{{width:100%;height:88px;border:3px solid #7a0000;border-radius:10px;
background:#c5221f;color:#fff;font:700 30px system-ui;cursor:pointer}}
button:focus-visible{{outline:4px solid #1a73e8;outline-offset:-8px}}
p{{margin:6px 2px 0}}</style>
<form method=post action="/{token}/vent"><button>VENT</button></form>
<p role=status>{words}</p></html>"""
NOT_YET = "The rig does not answer yet: use the emergency stop."
IDLE = "Lets the air out at once, whatever else hangs. It is no emergency stop."


class Vent:
    """What the button does."""

    def __init__(self) -> None:
        self._send: Callable[[], None] | None = None
        self.words = NOT_YET
        self._lock = threading.Lock()

    def begin(self, how: dict[str, Any]) -> None:
        """It is known now how to vent."""
        self._send = called(how) if how["kind"] == "call" else Sender(how)
        self.pid, self.words = int(how["pid"]), IDLE

    def __call__(self) -> None:
        if self._send is None:
            return
        with self._lock:
            for _ in range(FIRST):
                self._send()
                time.sleep(OFTEN)
        with contextlib.suppress(OSError):  # it may be gone
            os.kill(self.pid, signal.SIGINT)
        self.words = f"Vent lines were sent at {time.strftime('%H:%M:%S')}."
        threading.Thread(target=self._more, daemon=True).start()

    def _more(self) -> None:
        assert self._send is not None
        until = time.monotonic() + LONG
        while time.monotonic() < until:
            with self._lock:
                self._send()
            time.sleep(OFTEN)


def handler(vent: Vent, token: str, ancestors: str) -> type[BaseHTTPRequestHandler]:
    """What answers a browser."""
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'; base-uri 'none'; "
        f"frame-ancestors {ancestors or chr(39) + 'none' + chr(39)}"
    )

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0
        server_version, sys_version = "vent", ""

        def do_GET(self) -> None:
            self._answer(self.path == f"/{token}")

        def do_POST(self) -> None:
            known = self.path == f"/{token}/vent"
            if known:
                vent()
            self._answer(known)

        def _answer(self, known: bool) -> None:
            text = PAGE.format(token=token, words=vent.words) if known else "unknown"
            body = text.encode()
            self.send_response(200 if known else 404)
            for name, value in (
                ("content-type", "text/html; charset=utf-8" if known else "text/plain"),
                ("content-length", str(len(body))),
                ("content-security-policy", policy),
                ("referrer-policy", "no-referrer"),
                ("cache-control", "no-store"),
                ("x-content-type-options", "nosniff"),
            ):
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing is logged: the address holds the token."""

    return Handler


def main() -> None:
    """Serve until the input ends."""
    for name in ("SIGINT", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    said, vent = json.loads(sys.stdin.readline()), Vent()
    answers = handler(vent, said["token"], said["ancestors"])
    server = ThreadingHTTPServer((said["host"], int(said["port"])), answers)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.server_address[1], flush=True)
    for line in sys.stdin:
        vent.begin(json.loads(line))


if __name__ == "__main__":
    main()
