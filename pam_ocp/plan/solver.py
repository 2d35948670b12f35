"""IPOPT on a program: cold and warm starts from one set of derivatives, log, live progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .transcription import Program

__all__ = ["DEFAULTS", "Ipopt", "Outcome", "Progress"]

Array: TypeAlias = NDArray[np.float64]
Progress: TypeAlias = "Callable[[int, float, float], None] | bool"
Start: TypeAlias = Literal["cold", "warm", "adaptive"]

DEFAULTS: dict[str, Any] = {
    "tol": 1e-9,
    "constr_viol_tol": 1e-9,
    "acceptable_iter": 0,
    "max_iter": 500,
    "mu_init": 1e-2,
    "alpha_for_y": "bound-mult",  # 33 iterations instead of 40 to 150 on time-optimal motions
    "nlp_scaling_method": "none",  # the program is scaled by the plant's nominals already
    "mumps_pivtol": 1e-7,
}
"""IPOPT's options; ``plan(..., options=...)`` overrides them."""

ADAPTIVE: dict[str, Any] = {"mu_strategy": "adaptive", "alpha_for_y": "primal"}
"""Another way through, for a second try."""

WARM: dict[str, Any] = {
    "warm_start_init_point": "yes",
    "mu_init": 1e-6,
    "warm_start_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_slack_bound_frac": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
}
"""Primal, dual and barrier together: primal values alone are slower than a cold start."""


@dataclass(frozen=True)
class Outcome:
    """What a solver made of a program."""

    w: Array
    objective: float
    status: str
    success: bool
    iterations: int
    seconds: float
    lam_g: Array
    lam_x: Array
    log: tuple[dict[str, float], ...] = field(default=())
    """One entry per iteration: objective, infeasibilities, barrier, step lengths."""


class _Watch(ca.Callback):
    """Calls ``report(iteration, objective, largest violation)`` in each iteration of IPOPT."""

    def __init__(self, program: Program, report: Callable[[int, float, float], None]) -> None:
        ca.Callback.__init__(self)
        self.sizes = {
            "x": program.nlp["x"].numel(),
            "f": 1,
            "g": program.nlp["g"].numel(),
            "lam_x": program.nlp["x"].numel(),
            "lam_g": program.nlp["g"].numel(),
            "lam_p": program.nlp["p"].numel(),
        }
        self.low, self.high = program.limits()
        self.report, self.iteration = report, 0
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Any) -> list[int]:
        g = np.asarray(arguments[2], float).ravel()
        worst = max(np.max(self.low - g, initial=0.0), np.max(g - self.high, initial=0.0))
        self.report(self.iteration, float(arguments[1]), float(worst))
        self.iteration += 1
        return [0]


def _printed(iteration: int, objective: float, violation: float) -> None:
    print(f"{iteration:5d}  objective {objective:14.8g}  largest violation {violation:9.2e}")


class Ipopt:
    """IPOPT for a program, built once, for any number of solves."""

    def __init__(
        self,
        program: Program,
        options: Mapping[str, Any] | None = None,
        progress: Progress = False,
    ) -> None:
        self.program = program
        self._watch = None
        if progress:
            self._watch = _Watch(program, progress if callable(progress) else _printed)
        self._given = dict(options or {})
        self._first = self._built("plan", {}, {})
        self._solvers: dict[Start, ca.Function] = {"cold": self._first}

    def _built(self, name: str, ipopt: Mapping[str, Any], more: Mapping[str, Any]) -> ca.Function:
        chosen = {"print_level": 0, "sb": "yes", **DEFAULTS, **ipopt, **self._given}
        options = {"print_time": False, "ipopt": chosen, **more}
        if self._watch is not None:
            options["iteration_callback"] = self._watch
        try:
            return ca.nlpsol(name, "ipopt", self.program.nlp, options)
        except RuntimeError as error:
            raise InputError(f"options = {self._given}: {str(error).splitlines()[-1]}") from None

    def _solver(self, start: Start) -> ca.Function:
        """The solver for a kind of start; all share the derivatives of the first."""
        if start not in self._solvers:
            shared = {
                option: self._first.get_function(function)
                for option, function in (
                    ("hess_lag", "nlp_hess_l"), ("jac_g", "nlp_jac_g"), ("grad_f", "nlp_grad_f")
                )
            }  # fmt: skip
            self._solvers[start] = self._built(start, WARM if start == "warm" else ADAPTIVE, shared)
        return self._solvers[start]

    def __call__(
        self, program: Program, guess: Array, warm: Outcome | None = None, adaptive: bool = False
    ) -> Outcome:
        """Solve for the program's values (same expressions as the one built).

        warm : an outcome to start from, with its multipliers. adaptive : another barrier strategy.
        """
        begin = time.perf_counter()
        solver = self._solver("warm" if warm else "adaptive" if adaptive else "cold")
        (lbx, ubx), (lbg, ubg) = program.bounds(), program.limits()
        start = {"x0": np.clip(guess, lbx, ubx)}
        if warm is not None:
            start |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        if self._watch is not None:
            self._watch.iteration = 0
        result = solver(**start, p=program.parameters(), lbx=lbx, ubx=ubx, lbg=lbg, ubg=ubg)
        stats = solver.stats()
        arrays = {k: np.asarray(result[k], float).ravel() for k in ("x", "lam_g", "lam_x")}
        return Outcome(
            arrays["x"], float(result["f"]), str(stats["return_status"]), bool(stats["success"]),
            int(stats["iter_count"]), time.perf_counter() - begin, arrays["lam_g"], arrays["lam_x"],
            _log(stats.get("iterations") or {}),
        )  # fmt: skip


def _log(iterations: Mapping[str, Any]) -> tuple[dict[str, float], ...]:
    """One mapping per iteration, from lists by name."""
    keys = [k for k, v in iterations.items() if isinstance(v, list)]
    return tuple(
        dict(zip(keys, map(float, row), strict=True))
        for row in zip(*(iterations[k] for k in keys), strict=True)
    )
