"""The last step of a static fit, over all coefficients: Newton steps on the few columns of the
Jacobian, or, for robust losses and inequalities, IPOPT.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ...muscles.law import ForceLaw
from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..statistics import Array, SolverStatistics
from .descent import descend
from .least_squares import LeastSquares, Loss, sizes

__all__ = [
    "STATIONARY",
    "Optimum",
    "by_ipopt",
    "cosine",
    "ending",
    "local_optima",
    "local_optimum",
]

EXPANDED = 1000
"""Cells up to which the solver's functions are written out, which makes many small fits fast.

Beyond, one law is mapped over the cells: what it takes to build does not grow with each of them.
"""

STATIONARY = 1e-6
"""Largest cosine between the residual and a column of the Jacobian at an optimum."""

SPLIT = ("huber", "l1")
"""Losses with a kink, or a jump of their curvature, which the solver meets by splitting residuals.
"""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Coefficients (all of the law) and what they cost [N2]."""

    coefficients: Array
    cost: float
    solver: SolverStatistics


@lru_cache(maxsize=64)
def _solver(
    law: type[ForceLaw], free: tuple[int, ...], count: int, loss: Loss, priors: int, slack: int
) -> Nlp:
    """min sum rho(w (F - y)/unit)/2 over scaled coefficients; built once per law and size.

    Huber's loss and absolute values split the residual, r = a + b: squares of a, ``edge`` |b|. So
    IPOPT sees a smooth problem whose solution is that of the loss itself. Tukey's is smooth itself.
    """
    total = law.function().size1_in(2)
    z, base = ca.MX.sym("z", len(free)), ca.MX.sym("base", total)
    scale, unit, edge = ca.MX.sym("scale", len(free)), ca.MX.sym("unit"), ca.MX.sym("edge")
    data, rows = ca.MX.sym("data", count, 4), ca.MX.sym("rows", priors, len(free) + 1)
    limp = ca.MX.sym("slack", slack, 2)
    place = ca.DM(total, len(free))
    for column, row in enumerate(free):
        place[row, column] = 1
    c = base + place @ (scale * z)
    p, kappa, force, weight = ca.horzsplit(data)
    tension = law.function().map(count)(p.T, kappa.T, ca.repmat(c, 1, count))[0]
    residual = (weight.T * (tension - force.T) / unit).T
    parts = ca.MX.sym("parts", count if loss in SPLIT else 0, 2)
    inner = residual - parts[:, 0] + parts[:, 1] if loss in SPLIT else residual
    objective = edge * ca.sum1(ca.sum2(parts))
    constraints = [inner] if loss == "l1" else []
    if loss == "bisquare":
        objective += edge**2 / 6 * ca.sum1(1 - (1 - ca.fmin((inner / edge) ** 2, 1)) ** 3)
    elif loss != "l1":
        objective += ca.sumsqr(inner) / 2
    if priors:
        objective += ca.sumsqr((rows[:, :-1] @ (scale * z) - rows[:, -1]) / unit) / 2
    if slack:
        pulled = law.function().map(slack)(limp[:, 0].T, limp[:, 1].T, ca.repmat(c, 1, slack))[0]
        constraints.append(pulled.T / unit)
    parameters = ca.veccat(base, scale, unit, edge, data, rows, limp)
    options = quiet_ipopt(
        {"expand": count <= EXPANDED}, tol=1e-11, max_iter=300, honor_original_bounds="yes"
    )
    nlp: Any = {
        "x": ca.veccat(z, parts),
        "p": parameters,
        "f": objective,
        "g": ca.vertcat(*constraints),
    }
    return nlpsol("fit", "ipopt", nlp, options)


def local_optimum(problem: LeastSquares, start: Array, scanned: int) -> Optimum:
    """The optimum next to ``start`` (all coefficients)."""
    return local_optima(problem, start[None], scanned)[0]


def local_optima(problem: LeastSquares, starts: Array, scanned: int) -> list[Optimum]:
    """The optima next to each of ``starts`` (m, all)."""
    if problem.terms.loss == "squares" and not problem.censored:
        return _by_newton(problem, starts, scanned)
    return [by_ipopt(problem, start, scanned) for start in starts]


def _by_newton(problem: LeastSquares, starts: Array, scanned: int) -> list[Optimum]:
    limits = [_bounds(problem, start) for start in starts]
    low, high = (np.array([pair[i] for pair in limits]) for i in (0, 1))
    ended = descend(problem, starts, low, high)
    residuals, jacobians = problem.with_priors(ended.coefficients)
    size = problem.size
    found = []
    for row, resting in enumerate(ended.resting):
        free = list(zip(problem.free, resting, strict=True))
        columns = jacobians[row][:, [i for i, rests in free if not rests]]
        gradient = cosine(residuals[row], columns, size)
        statistics = SolverStatistics(
            ending(gradient),
            int(ended.steps[row]),
            gradient,
            scanned,
            tuple(problem.names[i] for i, rests in free if rests),
        )
        found.append(Optimum(ended.coefficients[row], float(ended.cost[row]), statistics))
    return found


def by_ipopt(problem: LeastSquares, start: Array, scanned: int) -> Optimum:
    """The optimum next to ``start`` (all coefficients), whatever the loss and the inequalities."""
    free, terms = list(problem.free), problem.terms
    lower, upper = _bounds(problem, start)
    start = start.copy()
    start[free] = np.clip(start[free], lower, upper)
    residuals, jacobian = problem.evaluate(start[None])
    size = problem.size
    unit = max(float(np.linalg.norm(residuals)), 1e-9 * size)
    norms = np.linalg.norm(jacobian[0][:, free], axis=0)
    scale = np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 1.0)
    base = start.copy()
    base[free] = 0.0
    n, robust = len(problem.cells), terms.loss in SPLIT
    limp = problem.slack if problem.censored else problem.slack.subset(slice(0))
    solver = _solver(problem.law, problem.free, n, terms.loss, len(problem.priors[0]), len(limp))
    parts = -residuals[0] / unit if robust else np.empty(0)  # tension - force, as in the solver
    answer = solver(
        x0=np.concatenate([start[free] / scale, np.maximum(parts, 0), np.maximum(-parts, 0)]),
        p=np.concatenate(_data(problem, limp, base, scale, unit)),
        lbx=np.concatenate([lower / scale, np.zeros(2 * parts.size)]),
        ubx=np.concatenate([upper / scale, np.full(2 * parts.size, np.inf)]),
        lbg=np.concatenate([np.zeros(n * (terms.loss == "l1")), np.full(len(limp), -np.inf)]),
        ubg=np.concatenate(
            [np.zeros(n * (terms.loss == "l1")), np.full(len(limp), problem.slack_tolerance / unit)]
        ),
    )
    c = base
    c[free] = np.clip(np.asarray(answer["x"]).ravel()[: len(free)] * scale, lower, upper)
    # an interior-point method ends a hair inside a bound that is active
    hair = 1e-6 * np.maximum(np.abs(c[free]), [problem.variables[i].nominal for i in free])
    at_bound = (c[free] - lower <= hair) | (upper - c[free] <= hair)
    inside = [i for i, bound in zip(free, at_bound, strict=True) if not bound]
    statistics = solver.stats()
    return Optimum(
        c,
        problem.cost(c),
        SolverStatistics(
            status=statistics["return_status"],
            iterations=int(statistics["iter_count"]),
            gradient=_gradient(problem, c, inside, size, statistics),
            scanned=scanned,
            at_bound=tuple(problem.names[i] for i in free if i not in inside),
        ),
    )


def _data(problem: LeastSquares, limp: Any, base: Array, scale: Array, unit: float) -> list[Array]:
    """The parameters of the solver, in its order."""
    cells, terms = problem.cells, problem.terms
    # without a prior only the straight part counts, and its factor is one of convenience
    edge = unit if terms.loss == "l1" and not terms.priors else terms.threshold
    edge = 0.0 if terms.loss == "squares" else edge
    rows, targets = problem.priors
    return [
        base,
        scale,
        np.array([unit, edge / unit]),
        cells.pressure,
        cells.contraction,
        cells.force,
        problem.weights,
        rows[:, list(problem.free)].T.ravel(),
        targets,
        limp.pressure,
        limp.contraction,
    ]


def _gradient(
    problem: LeastSquares, c: Array, inside: list[int], size: float, statistics: dict[str, Any]
) -> float:
    """Largest cosine of residual and Jacobian; for robust losses and inequalities IPOPT's own
    measure.
    """
    if problem.terms.loss in SPLIT or problem.censored:
        done = statistics["success"] and np.isfinite(problem.cost(c))
        return float(statistics["iterations"]["inf_du"][-1]) if done else float("inf")
    residual, jacobian = (a[0] for a in problem.with_priors(c[None]))
    if problem.terms.loss == "bisquare":
        n = len(problem.cells)
        residual[:n] *= problem.terms.reweighting(residual[:n], 0.0) ** 2
    return cosine(residual, jacobian[:, inside], size)


def ending(gradient: float) -> str:
    """How Newton steps ended, in a word."""
    return "Newton_Converged" if gradient <= STATIONARY else "Newton_Stalled"


def cosine(residual: Array, columns: Array, size: float) -> float:
    """Largest cosine between residual and columns; 0 for a residual of rounding errors."""
    length = float(np.linalg.norm(residual))
    if not np.isfinite(length):
        return float("inf")
    norms = np.linalg.norm(columns, axis=0)
    chosen = norms > 0
    if length <= 1e-9 * size or not np.any(chosen):
        return 0.0
    return float(np.max(np.abs(residual @ columns[:, chosen]) / norms[chosen]) / length)


def _bounds(problem: LeastSquares, start: Array) -> tuple[Array, Array]:
    """The law's own bounds; a coefficient that the scan left at its edge is held there.

    At an edge the law degenerates (exp(a3 kappa) becomes a straight line, or a step), the linear
    coefficients grow without end, and no optimum is reached by going on.
    """
    lower = np.array([problem.variables[i].min for i in problem.free])
    upper = np.array([problem.variables[i].max for i in problem.free])
    for place, i in enumerate(problem.free):
        if i in problem.nonlinear and not np.isfinite(upper[place] - lower[place]):
            reach = np.abs(sizes(problem.variables[i]))
            if not 1.01 * reach.min() < abs(start[i]) < 0.99 * reach.max():
                lower[place] = upper[place] = start[i]
    return lower, upper
