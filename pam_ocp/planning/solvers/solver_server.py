"""IPOPT in a process of its own, talking in pickles over its standard streams; see side_by_side.py.

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
from typing import Any

import casadi as ca
import numpy as np


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
    function, options = pickle.load(commands)
    problem: Any = function
    x, p = ca.MX.sym("x", function.size1_in(0)), ca.MX.sym("p", function.size1_in(1))
    f, g = function(x, p)
    problem = {"x": x, "p": p, "f": f, "g": g}
    solvers: dict[str, ca.Function] = {}
    while True:
        try:
            name, arguments = pickle.load(commands)
        except EOFError:
            return
        if name not in solvers:
            solvers[name] = ca.nlpsol(name, "ipopt", problem, options[name])
        result = solvers[name](**arguments)
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "f", "lam_g", "lam_x")}
        stats = solvers[name].stats()
        keys = ("return_status", "success", "iter_count", "iterations")
        pickle.dump((arrays, {k: stats.get(k) for k in keys}), answers)
        answers.flush()


if __name__ == "__main__":
    main()
