"""Work with someone else's code in a process of its own, which may crash, hang or leave.

The parent starts a fresh Python by a short command, so that no ``__main__`` is run again (scripts
without a guard, notebooks). The child tells what it found line by line in JSON, and keeps the name
of the call that it is in, in a file that both have mapped into memory: it is there after a crash,
too.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import mmap
import os
import pickle
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from ..core.errors import SimulationError
from ..core.processes import end, start
from ..numerics.solvers import environment
from .archive import printable

Tell: TypeAlias = Callable[..., None]
"""Called with keywords, JSON each; what they mean is between the worker and its caller."""

MEMORY = 2 << 30
"""Memory that a unit may ask for [bytes], where the platform can limit it."""
LARGEST_FILE = 2 << 30

_START_TIME = 120.0
"""For Python to start and to load its libraries [s]; the time limit counts from there."""
_GRACE = 1.0
"""For a process to end of itself when it has told everything [s]."""
_POLL = 0.05
_NOTE = 128
_BOOT = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from pam_ocp.export.isolation import _serve; _serve()"
)


@dataclass(frozen=True)
class Ended:
    """How a process ended: ``finished``, or else ``how`` and in which ``call`` of the unit."""

    finished: bool
    how: str = ""
    call: str = ""

    def __str__(self) -> str:
        return f"{self.how} in {self.call}" if self.call else self.how


# ---- parent --------------------------------------------------------------------------------------


def run_alone(
    worker: str, job: Mapping[str, Any], folder: Path, time_limit: float, heard: Tell
) -> Ended:
    """Let ``worker`` ("module:function") work on ``job`` in a process of its own.

    worker : called there with the job, ``tell`` and ``note`` (takes the name of the call it is in).
    job : keyword values that can be pickled.
    folder : an empty folder, the process's working directory.
    time_limit : [s] from the moment when the process has loaded what it needs.
    heard : called here with the keywords of each ``tell``.

    The process ends with this call, however it is left, and with this process; also what it has
    started (core/supervisor.py). Raises SimulationError when it cannot be started.
    """
    note = folder / "call"
    note.write_bytes(bytes(_NOTE))
    with (folder / "words").open("wb") as words:
        process, reader = _start(folder, words), None
        try:
            messages, reader = _listen(process)
            _send(process, worker, job)
            return _wait(process, messages, folder, time_limit, heard)
        finally:
            end(process)
            if reader is not None:  # a thread that wakes when Python has gone crashes the process
                reader.join(_GRACE)
            with contextlib.suppress(OSError):
                process.stdin.close()  # type: ignore[union-attr]


def _start(folder: Path, words: Any) -> subprocess.Popen[bytes]:
    try:
        return start(
            [sys.executable, "-c", _BOOT],
            os.fspath(folder),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=words,
            cwd=folder,
            env=environment(),
        )
    except (OSError, ValueError, TypeError) as error:
        raise SimulationError(
            f"{sys.executable!r} cannot be started for a process of the unit's own ({error})"
        ) from None


def _send(process: subprocess.Popen[bytes], worker: str, job: Mapping[str, Any]) -> None:
    """The job; the pipe stays open, and its end tells that this process is gone (on Windows)."""
    assert process.stdin is not None
    path = [os.path.abspath(p) for p in sys.path]
    with contextlib.suppress(BrokenPipeError):  # it died: seen by waiting for it
        for part in (path, (worker, dict(job))):
            process.stdin.write(pickle.dumps(part))
        process.stdin.flush()


def _listen(
    process: subprocess.Popen[bytes],
) -> tuple[queue.Queue[dict[str, Any] | None], threading.Thread]:
    messages: queue.Queue[dict[str, Any] | None] = queue.Queue()

    def read() -> None:
        assert process.stdout is not None
        # nobody else closes the pipe: what escapes its end may hold it open for ever
        with contextlib.suppress(ValueError), process.stdout as answers:  # half a line
            for line in answers:
                messages.put(json.loads(line))
        messages.put(None)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    return messages, reader


def _wait(
    process: subprocess.Popen[bytes],
    messages: queue.Queue[dict[str, Any] | None],
    folder: Path,
    time_limit: float,
    heard: Tell,
) -> Ended:
    end, ready = time.monotonic() + _START_TIME, False
    while True:
        left = end - time.monotonic()
        if left <= 0:
            return Ended(False, f"was stopped after {time_limit:g} s (time_limit)", _call(folder))
        try:
            message = messages.get(timeout=min(left, _POLL))
        except queue.Empty:
            if process.poll() is None:
                continue
            try:  # dead; what it said last may still be on its way
                message = messages.get(timeout=_GRACE)
            except queue.Empty:
                message = None  # something that it started may hold the pipe
        if message is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(min(left, _GRACE))
            break
        if message.pop("ready", False):
            end, ready = time.monotonic() + time_limit, True
        if message.pop("done", False):
            return Ended(True)
        if message:
            heard(**message)
    said = _read(folder / "words").decode("utf-8", "replace").strip().splitlines()
    words = printable(said[-1])[:200] if said else ""  # where the C library says why it aborts
    if not ready:
        raise SimulationError(f"the process for the unit did not start: {words or 'no word why'}")
    how = _how(process.poll())
    return Ended(False, f"{how} ({words})" if words else how, _call(folder))


def _call(folder: Path) -> str:
    return _read(folder / "call").rstrip(b"\0 ").decode("utf-8", "replace")


def _read(path: Path, most: int = 1000) -> bytes:
    """The end of a file; nothing where the unit has removed it."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - most))
            return file.read(most)
    except OSError:
        return b""


_SIGNALS = {
    "SIGSEGV": "crashed (segmentation fault)",
    "SIGBUS": "crashed (bus error: is the library cut short?)",
    "SIGABRT": "aborted",
    "SIGFPE": "crashed (arithmetic exception)",
    "SIGILL": "crashed (illegal instruction)",
    "SIGKILL": "was killed (the system may be out of memory)",
    "SIGXCPU": "took more processor time than it may",
}


def _how(code: int | None) -> str:
    if code is None:
        return "closed its connection and went on"
    if code >= 1 << 30:  # Windows' numbers of exceptions
        return "crashed (access violation)" if code == 0xC0000005 else f"crashed ({code:#x})"
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return _SIGNALS.get(name, f"was ended by {name}")


# ---- child ---------------------------------------------------------------------------------------


def _serve() -> None:
    """The child's whole life: a job on standard input, answers on standard output."""
    worker, job = pickle.load(sys.stdin.buffer)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    if sys.platform == "win32":  # elsewhere the supervisor looks for the parent
        _die_with(os.dup(0))
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)  # what the unit reads and writes is not ours
    os.dup2(2, 1)

    def tell(**what: Any) -> None:
        answers.write(f"{json.dumps(what)}\n")
        answers.flush()

    module, _, name = worker.partition(":")
    work = getattr(importlib.import_module(module), name)
    with Path("call").open("r+b") as file:
        place = mmap.mmap(file.fileno(), _NOTE)

    @cache
    def noted(call: str) -> bytes:
        return call.encode()[:_NOTE].ljust(_NOTE, b"\0")

    def note(call: str) -> None:
        place[:] = noted(call)

    _limit()
    tell(ready=True)
    try:
        work(job, tell, note)
        tell(done=True)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(70)
    os._exit(0)  # what the unit has left behind is not asked to go in order


def _die_with(pipe: int) -> None:
    """End this process, and remove its folder, once the parent's end of the pipe is closed."""
    folder = os.getcwd()

    def watch() -> None:
        with contextlib.suppress(OSError):  # the unit has closed it
            while os.read(pipe, 1024):
                pass
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _limit() -> None:
    """Memory beyond what Python itself has taken, size of files, no dumps."""
    try:
        import resource
    except ImportError:  # Windows
        return
    taken = 0
    with contextlib.suppress(OSError, ValueError):
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = {"RLIMIT_CORE": 0, "RLIMIT_FSIZE": LARGEST_FILE}
    if taken:
        limits["RLIMIT_AS"] = taken + MEMORY
    for name, value in limits.items():
        if hasattr(resource, name):
            with contextlib.suppress(OSError, ValueError):
                kind = getattr(resource, name)
                _, most = resource.getrlimit(kind)
                value = value if most == resource.RLIM_INFINITY else min(value, most)
                resource.setrlimit(kind, (value, value))
