"""Run a command so that all that it starts ends with it, and it with whoever asked for it.

    python -I -S supervisor.py PARENT FOLDER COMMAND ...

Run as a file, and loads little: a compiler waits for it. core/processes.py starts it.

On Linux the supervisor is the one to whom orphans come (PR_SET_CHILD_SUBREAPER, prctl(2)): whatever
a descendant does to get away (a session of its own, a second fork), it is found and killed. The
kernel tells of the parent's death (PR_SET_PDEATHSIG). Elsewhere the process group is killed, and
the parent is looked for twice a second.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time

LOOK = 0.5
"""How often the parent is looked for [s]."""
PATIENCE = 5.0
"""For killed processes to be gone [s]: one may hang in the kernel."""
_PDEATHSIG, _SUBREAPER = 1, 36


def main() -> None:
    parent, folder, command = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
    told = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCHLD}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, told)  # from here on they wait to be read
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # who ignores it is not told how children end
    _prepare()
    if os.getppid() != parent:  # it was gone before the kernel was asked to tell
        _remove(folder)
        sys.exit(1)
    try:
        child = os.posix_spawnp(
            command[0], command, os.environ, setpgroup=0, setsigmask=before, setsigdef=told
        )
    except OSError as error:
        sys.exit(f"{command[0]}: {error.strerror}")
    status, alone = _wait(child, parent, told)
    if alone:  # it cannot tidy up
        _remove(folder)
    _end_all(child)
    if alone:  # what was left may have written meanwhile
        _remove(folder)
        os._exit(1)
    if status is not None and os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    number = signal.SIGKILL if status is None else os.WTERMSIG(status)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    with contextlib.suppress(OSError):  # SIGKILL has no other action
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _prepare() -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if sys.platform == "linux":
        import ctypes

        prctl = ctypes.CDLL(None).prctl
        prctl(_SUBREAPER, 1, 0, 0, 0)
        prctl(_PDEATHSIG, int(signal.SIGHUP), 0, 0, 0)


def _wait(child: int, parent: int, told: set[signal.Signals]) -> tuple[int | None, bool]:
    """How the child ended, None where it is to end now; and whether the parent is gone."""
    while os.getppid() == parent:
        while True:
            found, status = os.waitpid(-1, os.WNOHANG)
            if found == child:
                return status, False
            if not found:
                break
        number = _pending(told)
        if number == signal.SIGHUP:  # it is going: its threads end one after the other
            return None, True
        if number not in (None, signal.SIGCHLD):
            return None, False
    return None, True


def _pending(signals: set[signal.Signals]) -> int | None:
    """The signal that came, waiting for it for a while."""
    if hasattr(signal, "sigtimedwait"):
        found = signal.sigtimedwait(signals, LOOK)
        return None if found is None else found.si_signo
    time.sleep(LOOK / 20)  # macOS
    return next(iter(signal.sigpending() & (signals - {signal.SIGCHLD})), None)


def _end_all(child: int) -> None:
    """Kill what is left, till nothing is."""
    with contextlib.suppress(OSError):
        os.killpg(child, signal.SIGKILL)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for pid in _children():
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.002)


def _children() -> list[int]:
    """Of this process; orphans are among them (Linux; elsewhere they are not told)."""
    own, found = str(os.getpid()), []
    with contextlib.suppress(OSError):
        for name in filter(str.isdigit, os.listdir("/proc")):
            with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
                if file.read().rpartition(b")")[2].split()[1].decode() == own:
                    found.append(int(name))
    return found


def _remove(folder: str) -> None:
    if folder:
        import shutil

        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
