"""The rig that the page was started with: its process, the process of the vent button, and what is
known of it here. All browsers see the same rig.
"""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..core.errors import InputError

KEPT = 600
"""Rows that are shown: half a minute."""
PATIENCE = 10.0
"""For processes to begin and to end [s]."""


class RigRoom:
    """A rig's file, and the processes that work on it.

    hosts : names by which browsers may ask for the page, with its port. The vent button is at
    ``vent_port`` under ``/token``.
    """

    def __init__(
        self, file: Path, host: str, port: int, hosts: Sequence[str], allow_code: bool = False
    ) -> None:
        self.file, self.token = file, secrets.token_urlsafe(32)
        self.about: dict[str, Any] = {}
        self.state: dict[str, Any] = {"armed": False, "reason": "", "doing": "begins"}
        self.rows: deque[tuple[float, dict[str, float]]] = deque(maxlen=KEPT)
        self.errors: list[str] = []
        self.reports: list[str] = []
        self.heard = 0.0
        self._vent = _started("pam_ocp.rig.vent_server")
        ancestors = " ".join(f"http://{name}" for name in sorted(hosts))
        wanted = port + 1 if port else 0
        told = {"host": host, "port": wanted, "token": self.token, "ancestors": ancestors}
        self.vent_port = self._begin_vent(told)
        code = ["--allow-code"] if allow_code else []
        self._worker = _started("pam_ocp.bench.rig_worker", str(file), *code)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    # ---- the rig's process ----------------------------------------------------------------------
    def _listen(self) -> None:
        assert self._worker.stdout is not None
        for line in self._worker.stdout:
            self._take(json.loads(line))
        self.state = {**self.state, "armed": False, "doing": "its process has ended"}

    def _take(self, said: dict[str, Any]) -> None:
        self.heard = time.monotonic()
        if "channels" in said:
            if said["emergency"] is not None:
                _write(self._vent, {**said["emergency"], "pid": self._worker.pid})
            self.about = said  # from now on it is drawn
        if "values" in said:
            self.rows.append((said["t"], said["values"]))
        if "error" in said:
            self.errors.append(said["error"])
        if "report" in said:
            self.reports.append(said["report"])
        if "armed" in said:
            self.state = {k: said[k] for k in ("armed", "reason", "doing")}

    def ask(self, do: str, **more: Any) -> None:
        """A command to the rig's process."""
        _write(self._worker, {"do": do, "at": time.monotonic(), **more})

    @property
    def silent(self) -> float:
        """How long nothing has been heard of the rig's process [s]."""
        return time.monotonic() - self.heard if self.heard else 0.0

    # ---- the vent button ------------------------------------------------------------------------
    def _begin_vent(self, told: dict[str, Any]) -> int:
        assert self._vent.stdout is not None
        _write(self._vent, told)
        answer = self._vent.stdout.readline().strip()
        if not answer.isdigit():
            raise InputError(
                f"the vent button cannot be served at port {told['port']} of {told['host']}, "
                "beside the page's; give another --port"
            )
        return int(answer)

    def close(self) -> None:
        """Vent and let go."""
        self.ask("end")
        for process in (self._worker, self._vent):
            with suppress(OSError):
                assert process.stdin is not None
                process.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)
            process.kill()
            process.wait()
        self._listener.join(PATIENCE)


def _write(process: subprocess.Popen[str], said: dict[str, Any]) -> None:
    """A line; nothing where the process is gone."""
    assert process.stdin is not None
    with suppress(OSError, ValueError):
        process.stdin.write(json.dumps(said) + "\n")
        process.stdin.flush()


def _started(module: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the page, which ends them
    )
