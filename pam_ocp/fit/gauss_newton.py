"""Solving a dynamic fit: IPOPT with the Gauss-Newton Hessian, and what its solution depends on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..errors import FitError
from .statistics import Array
from .transcribe import Program

__all__ = ["Solution", "reduced_jacobian", "solve"]

DONE = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True, eq=False)
class Solution:
    """Scaled unknowns w, residuals without weights (K, ny) in nominals, and IPOPT's account."""

    w: Array
    residuals: Array
    status: str
    iterations: int

    @property
    def found(self) -> bool:
        return self.status in DONE


def solve(program: Program, weights: Array, guess: Array, max_iterations: int = 200) -> Solution:
    """Least squares from a guess. The residuals' curvature is left out of the Hessian."""
    w, residuals = program.w, program.residuals
    jacobian = ca.jacobian(residuals, w)
    factor, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", program.defects.numel())
    hessian = ca.Function(
        "gauss_newton", [w, program.weights, factor, multipliers],
        [ca.triu(factor * (jacobian.T @ jacobian))], ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"],
    )  # fmt: skip
    options: Any = {
        "print_time": False, "error_on_fail": False, "calc_lam_p": False, "hess_lag": hessian,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": max_iterations,
                  "mu_strategy": "adaptive", "honor_original_bounds": "yes"},
    }  # fmt: skip
    nlp: Any = {"x": w, "p": program.weights, "f": ca.sumsqr(residuals) / 2, "g": program.defects}
    solver = ca.nlpsol("fit", "ipopt", nlp, options)
    answer = solver(x0=guess, p=weights, lbx=program.low, ubx=program.high, lbg=0.0, ubg=0.0)
    found = np.asarray(answer["x"]).ravel()
    if not np.all(np.isfinite(found)):
        raise FitError("the fit left all finite numbers; start nearer with plant.with_values(...)")
    value = ca.Function("residuals", [w, program.weights], [residuals])(found, weights)
    statistics = solver.stats()
    return Solution(
        found,
        np.asarray(value).reshape(-1, weights.size) / weights,
        str(statistics["return_status"]),
        int(statistics["iter_count"]),
    )


def reduced_jacobian(program: Program, weights: Array, w: Array) -> Array:
    """d(weighted residuals)/d(head), the states following from the plant's equations.

    Along solutions of defects(head, states) = 0: d(states) = -(d defects/d states)^-1 (d defects/
    d head) d(head). The rest of the covariance is that of least squares in the head alone.
    """
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    function = ca.Function(
        "derivatives", [program.w, program.weights],
        [ca.jacobian(program.residuals, program.w), ca.jacobian(program.defects, program.w)],
    )  # fmt: skip
    r, g = (_sparse(csc_matrix, block) for block in function(w, weights))
    head = program.head
    direct = np.asarray(r[:, :head].todense())
    if g.shape[0] == 0:
        return direct
    try:
        states = splu(g[:, head:]).solve(np.asarray(g[:, :head].todense()))
    except RuntimeError:
        raise FitError(
            "the plant's equations do not determine its states along a record: one of them is "
            "singular at the solution"
        ) from None
    return np.asarray(direct - r[:, head:] @ states)


def _sparse(kind: Any, matrix: ca.DM) -> Any:
    pattern = matrix.sparsity()
    return kind(
        (np.array(matrix.nonzeros()), np.array(pattern.row()), np.array(pattern.colind())),
        shape=matrix.shape,
    )
