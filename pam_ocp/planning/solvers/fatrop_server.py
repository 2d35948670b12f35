"""fatrop in a process of its own, talking in pickles over its standard streams; see fatrop.py.

Run as a file, so that it needs to import nothing but CasADi and NumPy. First comes (the problem as
a serialised function, CasADi's options, seconds); then, again and again, the arguments of a solve.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import signal
import sys
import threading
import time
from typing import Any

import casadi as ca
import numpy as np

ORPHAN = 30.0
"""Seconds beyond the limit after which the process ends itself, if its parent did not end it."""


def watch(parent: int) -> None:
    """End this process once its parent is gone (CasADi lets other threads run while it solves)."""
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


def main() -> None:
    threading.Thread(target=watch, args=(os.getppid(),), daemon=True).start()
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is for the parent, which ends this process
    commands = sys.stdin.buffer
    answers = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)  # fatrop prints, whatever its options say
    serialized, options, limit = pickle.load(commands)
    solver = None
    while True:
        try:
            arguments = pickle.load(commands)
        except EOFError:
            return
        # works in C, without the interpreter that fatrop may be keeping
        faulthandler.dump_traceback_later(limit + ORPHAN, exit=True)
        try:
            if solver is None:
                solver = _solver(serialized, options)
            answer: dict[str, Any] = _solved(solver, arguments)
        except RuntimeError as error:
            answer = {"error": str(error)}
        faulthandler.cancel_dump_traceback_later()
        pickle.dump(answer, answers)
        answers.flush()


def _solver(serialized: str, options: dict[str, Any]) -> ca.Function:
    problem = ca.Function.deserialize(serialized)
    x, p = ca.MX.sym("x", problem.size1_in(0)), ca.MX.sym("p", problem.size1_in(1))
    f, g = problem(x, p)
    return ca.nlpsol("fatrop", "fatrop", {"x": x, "p": p, "f": f, "g": g}, options)


def _solved(solver: ca.Function, arguments: dict[str, Any]) -> dict[str, Any]:
    result = solver(**arguments)
    stats = solver.stats()
    answer: dict[str, Any] = {k: np.asarray(result[k], float).ravel() for k in result}
    return {**answer, "success": bool(stats["success"]), "iterations": int(stats["iter_count"])}


if __name__ == "__main__":
    main()
