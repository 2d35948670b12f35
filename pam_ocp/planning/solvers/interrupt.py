"""Ctrl-C inside IPOPT: the solve ends at its next iteration, and KeyboardInterrupt is raised behind
it.

CasADi swallows an exception that Python raises inside its calls, and the solver's return status
then looks like that of a failed solve. So while a solver runs, the signal only sets a flag, which
the solver's iteration callback hands on.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi as ca

__all__ = ["Interrupt", "Watch", "deferred", "watched_call"]


@dataclass
class Interrupt:
    """Whether Ctrl-C was pressed."""

    seen: bool = False


@contextmanager
def deferred() -> Iterator[Interrupt]:
    """Ctrl-C only sets a flag meanwhile, and is raised behind (in the main thread)."""
    interrupt = Interrupt()
    before = signal.getsignal(signal.SIGINT)
    mine = threading.current_thread() is threading.main_thread() and callable(before)

    def pressed(*_: Any) -> None:
        interrupt.seen = True

    if mine:
        signal.signal(signal.SIGINT, pressed)
    try:
        yield interrupt
    finally:
        if mine:
            signal.signal(signal.SIGINT, before)
    if interrupt.seen:
        assert callable(before)
        before(signal.SIGINT, None)  # Python's own raises KeyboardInterrupt
        raise KeyboardInterrupt


class Watch(ca.Callback):
    """An ``iteration_callback`` for CasADi's interface to IPOPT, for programs of these sizes.

    report : called with (x, f, g) in each iteration. What it raises ends the solve, and is raised
        again behind it.
    """

    def __init__(
        self,
        nx: int,
        ng: int,
        parameters: int,
        report: Callable[[Any, Any, Any], None] | None = None,
    ) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": parameters}
        self._report = report
        self._interrupt = Interrupt()
        self._error: BaseException | None = None
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Any) -> list[int]:
        if self._report is not None and not self._interrupt.seen:
            try:
                self._report(*arguments[:3])
            except BaseException as error:
                self._error = error
        return [int(self._interrupt.seen or self._error is not None)]

    @contextmanager
    def during(self) -> Iterator[None]:
        """For the time of a solve: Ctrl-C ends it, and is raised behind it (in the main thread)."""
        self._error = None
        with deferred() as self._interrupt:
            yield
            if self._error is not None:
                raise self._error


def watched_call(
    name: str, nlp: dict[str, ca.MX], options: dict[str, Any], arguments: dict[str, Any]
) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """(result, statistics) of one solve by IPOPT that Ctrl-C can end."""
    parameters = nlp["p"].numel() if "p" in nlp else 0
    watch = Watch(nlp["x"].numel(), nlp["g"].numel(), parameters)
    solver = ca.nlpsol(name, "ipopt", nlp, {**options, "iteration_callback": watch})
    with watch.during():
        result = solver(**arguments)
    return result, solver.stats()
