"""IPOPT in a process of its own, talking in pickles over its standard streams; see side_by_side.py.

Run as a file, so that it needs to import nothing but CasADi and NumPy, and never the caller's
script. First comes (problem, {name: options}); then, again and again, (name, arguments) of a solve.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from typing import Any

import casadi as ca
import numpy as np


class Orphaned(ca.Callback):
    """An iteration callback that ends the solve once the parent process is gone."""

    def __init__(self, nx: int, ng: int, parameters: int) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": parameters}
        self._parent = os.getppid()
        self.construct("orphaned", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Any) -> list[int]:
        if os.getppid() != self._parent:
            os._exit(1)
        return [0]


def main() -> None:
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
    watch = Orphaned(x.numel(), g.numel(), p.numel())
    solvers: dict[str, ca.Function] = {}
    while True:
        try:
            name, arguments = pickle.load(commands)
        except EOFError:
            return
        if name not in solvers:
            given = {**options[name], "iteration_callback": watch}
            solvers[name] = ca.nlpsol(name, "ipopt", problem, given)
        result = solvers[name](**arguments)
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "f", "lam_g", "lam_x")}
        stats = solvers[name].stats()
        keys = ("return_status", "success", "iter_count", "iterations")
        pickle.dump((arrays, {k: stats.get(k) for k in keys}), answers)
        answers.flush()


if __name__ == "__main__":
    main()
