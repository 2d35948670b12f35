"""Commands of others (compilers, units under check) that end with this process, and with all that
they have started; see core/supervisor.py.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .interrupts import undisturbed

SUPERVISOR = Path(__file__).with_name("supervisor.py")
PATIENCE = 10.0
"""For a supervisor to end what it looks after [s]."""


@undisturbed  # a handler that raises between the fork and the answer would leave it alone
def start(command: Sequence[str], folder: str = "", **arguments: Any) -> subprocess.Popen[Any]:
    """``subprocess.Popen(command, **arguments)``, supervised.

    folder : removed where this process is gone before the command has ended. Raises OSError.
    """
    if sys.platform == "win32":
        group = subprocess.CREATE_NEW_PROCESS_GROUP
        return subprocess.Popen(command, creationflags=group, **arguments)
    watch = [sys.executable, "-I", "-S", str(SUPERVISOR), str(os.getpid()), folder]
    if not os.access(sys.executable or "", os.X_OK):  # rights were given up: without a supervisor
        watch = []
    return subprocess.Popen([*watch, *command], start_new_session=True, **arguments)


def end(process: subprocess.Popen[Any]) -> None:
    """End the command now, with whatever it has started (on Windows: the command alone)."""
    if process.poll() is None:
        process.terminate()  # the supervisor is told; on Windows the command is ended
        if sys.platform != "win32":
            process.send_signal(signal.SIGCONT)  # what it looks after may have stopped it
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE)
    if sys.platform != "win32" and str(SUPERVISOR) not in list(process.args):  # type: ignore[arg-type]
        with contextlib.suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()  # nothing where it has ended
    process.wait()


class Processes:
    """Commands that several threads start; ``with`` ends them all where it is left by an error."""

    def __init__(self) -> None:
        self._lock, self._running, self._over = threading.Lock(), set[Any](), False

    def run(
        self,
        command: Sequence[str],
        folder: Path,
        environment: dict[str, str],
        timeout: float | None = None,
    ) -> subprocess.CompletedProcess[str]:
        """The command's exit code and words. Raises OSError, or subprocess.TimeoutExpired."""
        pipe = subprocess.PIPE
        with self._lock:
            if self._over:
                raise InterruptedError("the other commands were ended")
            process = start(
                command,
                os.fspath(folder),
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=pipe,
                stderr=pipe,
                text=True,
            )
            self._running.add(process)
        try:
            out, errors = process.communicate(timeout=timeout)
        finally:
            end(process)
            with self._lock:
                self._running.discard(process)
        return subprocess.CompletedProcess(list(command), process.returncode, out, errors)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *raised: object) -> None:
        with self._lock:
            self._over = True
            left = list(self._running)
        for process in left:
            end(process)
