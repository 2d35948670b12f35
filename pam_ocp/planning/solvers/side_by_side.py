"""Several starts of one program side by side: this process, and others that only solve.

The other processes get the program as CasADi's functions, so nothing of the caller's is imported or
run again there (a script needs no ``if __name__ == "__main__"``). They end when this function is
left, by an answer or an interruption, and by themselves when this process is gone. Where none can
be started, all starts are solved here.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.stop import TimeIsUp, check
from ...numerics.blas import environment
from ..starts import Task
from ..transcription.transcription import Program
from .solver import Ipopt, Outcome

__all__ = ["solved_side_by_side"]

Array: TypeAlias = NDArray[np.float64]

SERVER = Path(__file__).with_name("solver_server.py")
PAYS = 1.0
"""Seconds of work left from which on other processes are started: each takes a third of this to
begin.
"""


def solved_side_by_side(
    ipopt: Ipopt, program: Program, tasks: Sequence[Task], first: float
) -> list[Outcome]:
    """The outcomes of all tasks, in their order.

    first : seconds that one start takes, by experience; short work is done in this process.
    """
    queue, found = deque(range(len(tasks))), {}
    others = min(len(tasks), _processors()) - 1
    workers: list[_Worker] = []
    try:
        if first * len(tasks) >= PAYS:
            workers = _started(ipopt, program, tasks, queue, others)
        while True:
            try:
                i = queue.popleft()
            except IndexError:  # what a process that died gave back comes last
                alive = any(worker.thread.is_alive() for worker in workers)
                if not alive and not queue:
                    break
                check()
                time.sleep(0.01)
                continue
            found[i] = ipopt(program, tasks[i].guess, tasks[i].start)
            if found[i].stopped:
                break
    except TimeIsUp:
        done = [*found.values(), *(o for w in workers for o in w.found.values())]
        if not any(outcome.success for outcome in done):
            raise
    finally:
        for worker in workers:
            worker.end()
            found |= worker.found
    return [ipopt.settled(program, found[i]) for i in range(len(tasks)) if i in found]


def _processors() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1


def _started(
    ipopt: Ipopt, program: Program, tasks: Sequence[Task], queue: deque[int], count: int
) -> list[_Worker]:
    """Up to ``count`` processes; fewer where the program or the system does not allow them."""
    workers: list[_Worker] = []
    if count < 1 or not sys.executable:
        return workers
    try:
        setup = pickle.dumps(ipopt.portable({task.start for task in tasks}))
    except Exception:  # a plant may hold functions of its own that cannot travel
        return workers
    messages = [pickle.dumps((t.start, ipopt.arguments(program, t.guess))) for t in tasks]
    for _ in range(count):
        with contextlib.suppress(OSError):
            workers.append(_Worker(setup, messages, queue))
    return workers


class _Worker:
    """A process that takes tasks from a queue, and the thread that talks to it (which knows no
    CasADi).
    """

    def __init__(self, setup: bytes, messages: Sequence[bytes], queue: deque[int]) -> None:
        self.found: dict[int, Outcome] = {}
        self._process = subprocess.Popen(
            [sys.executable, str(SERVER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment(),
        )
        self.thread = threading.Thread(
            target=self._talk, args=(setup, messages, queue), daemon=True
        )
        self.thread.start()

    def _talk(self, setup: bytes, messages: Sequence[bytes], queue: deque[int]) -> None:
        into, out = self._process.stdin, self._process.stdout
        assert into is not None
        assert out is not None
        i = -1
        try:
            into.write(setup)
            while queue:
                try:
                    i = queue.popleft()
                except IndexError:
                    return
                begin = time.perf_counter()
                into.write(messages[i])
                into.flush()
                arrays, stats = pickle.load(out)
                self.found[i] = Outcome.of(arrays, stats, time.perf_counter() - begin)
                i = -1
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            if i >= 0:
                queue.append(i)  # somebody else will

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        self.thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
