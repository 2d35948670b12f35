"""IPOPT in a process of its own, talking in pickles over its standard streams; see starts.py.

Run as a file, so that it needs to import nothing but CasADi and NumPy, and never the caller's
script. First comes (problem, {name: options}); then, again and again, (name, arguments) of a solve.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np


class Solves:
    """The problem as a function, and options of its solvers by name; called with a name and
    arguments, it gives the solver's arrays and what it says of itself.
    """

    def __init__(
        self, problem: ca.Function, options: Any, make: Callable[..., Any] = ca.nlpsol
    ) -> None:
        self.problem, self.options, self.make = problem, options, make
        self.solvers: dict[str, Any] = {}

    def __call__(self, name: str, arguments: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        if name not in self.solvers:
            x, p = (ca.MX.sym(n, self.problem.size1_in(i)) for i, n in enumerate("xp"))
            f, g = self.problem(x, p)
            nlp = {"x": x, "p": p, "f": f, "g": g}
            self.solvers[name] = self.make(name, "ipopt", nlp, self.options[name])
        solver = self.solvers[name]
        result = solver(**arguments)
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "f", "lam_g", "lam_x")}
        keys, stats = ("return_status", "success", "iter_count", "iterations"), solver.stats()
        return arrays, {k: stats.get(k) for k in keys}


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
    os.dup2(nothing, 1)
    solve = Solves(*pickle.load(commands))
    while True:
        try:
            name, arguments = pickle.load(commands)
        except EOFError:
            return
        pickle.dump(solve(name, arguments), answers)
        answers.flush()


if __name__ == "__main__":
    main()
