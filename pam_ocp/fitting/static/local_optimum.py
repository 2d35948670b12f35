"""The optimum of a sum of squares next to a start: damped Newton steps from many starts side by
side, or, for robust losses and inequalities, IPOPT.

Newton's steps are on the few columns of the Jacobian. The exact second derivatives make the last
steps quadratic; where they have no minimum, far from an optimum, those of Gauss and Newton stand in
(K. Levenberg, D. Marquardt). A coefficient that is pushed against a bound rests there
(D. Bertsekas, SIAM J. Control Optim. 20 (1982) 221-246).

SciPy's least_squares comes to the same optima: from 60 starts of a force law in 4 to 9 times as
long, for they go down one by one; in fits of holds in nine tenths of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.stop import check
from ...muscles.law import ForceLaw
from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..statistics import Array, SolverStatistics
from .least_squares import LeastSquares, Loss, Sums, Terms, summed

ITERATIONS = 150
"""Evaluations of all starts that are still on their way."""
FIRST_DAMPING = 1e-6
"""Of columns of unit length; none as long as whole steps do."""
LARGEST_DAMPING = 1e8
NEAR = 0.1
"""Part of the cost that a step took off, from which on second derivatives of residuals pay."""
LAST_STEP = 1e-12
"""Part of the cost that a whole Newton step would still take off, from which it is the last."""
SAME = 1e-6
"""Part of a cost by which a start that comes down to it leads to the same place."""
FAR, PATIENCE = 1.5, 25
"""Times the least cost so far, and evaluations after which a start that is above it is left."""
DEFINITE = 1e-13
"""Smallest eigenvalue of second derivatives, columns of unit length, that counts as positive."""


class Squares(Protocol):
    """A sum of squares over unknowns, of which the ``free`` ones may move."""

    @property
    def free(self) -> Sequence[int]: ...
    @property
    def size(self) -> float: ...  # norm of the weighted measurements
    def sums(self, coefficients: Array, second: bool = False) -> Sums: ...


class Problem(Squares, Protocol):
    """One of force laws, whose ``nonlinear`` unknowns are scanned."""

    @property
    def law(self) -> type[ForceLaw]: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def nonlinear(self) -> Sequence[int]: ...
    @property
    def terms(self) -> Terms: ...
    @property
    def limited(self) -> bool: ...
    @property
    def scales(self) -> list[Array]: ...
    def thinned(self) -> Problem: ...
    def bounds(self) -> tuple[Array, Array]: ...
    def near(self, start: Array) -> tuple[Array, Array]: ...
    def project(self, values: Array) -> tuple[Array, Array]: ...
    def with_priors(self, coefficients: Array) -> tuple[Array, Array]: ...


@dataclass(frozen=True, eq=False)
class Descended:
    """Where starts came to; ``resting`` : free coefficients at a bound (m, free)."""

    coefficients: Array
    cost: Array
    steps: NDArray[np.intp]
    resting: NDArray[np.bool_]


def descend(
    problem: Squares, starts: Array, low: Array, high: Array, settled: float = 0.0
) -> Descended:
    """Follow starts (m, all) to the least squares next to them, priors included. low, high : (m,
    free). settled : relative fall of the cost at which a descent ends, by default none. Costs are
    infinite where the law gives no finite force at the start.
    """
    of = np.zeros(len(starts), dtype=np.intp)
    sums: Callable[..., Sums] = lambda c, second, of: problem.sums(c, second)  # noqa: E731
    return _Descent(sums, problem.free, [problem.size], of, starts, low, high, settled).run()


class _Descent:
    """Of several sums of squares side by side: ``of`` says whose each start is."""

    def __init__(
        self,
        sums: Callable[[Array, bool, NDArray[np.intp]], Sums],
        free: Sequence[int],
        sizes: Sequence[float],
        of: NDArray[np.intp],
        starts: Array,
        low: Array,
        high: Array,
        settled: float = 0.0,
    ) -> None:
        self.sums_of, self.free, self.of, self.settled = sums, list(free), of, settled
        self.low, self.high, self.c = low, high, starts.copy()
        self.c[:, self.free] = np.clip(starts[:, self.free], low, high)
        m, k = len(starts), len(self.free)
        self.near = np.zeros(m, dtype=bool)
        self.cost, *rest = self._at(np.arange(m), self.c)
        self.sums: list[Array] = rest
        self.damping, self.steps = np.zeros(m), np.zeros(m, dtype=np.intp)
        self.resting, self.newton = low >= high, np.zeros(m, dtype=bool)
        self.norms, self.right = np.ones((m, k)), np.zeros((m, k))
        self.values, self.vectors = np.ones((m, k)), np.zeros((m, k, k))
        self.floor = 1e-24 * np.square(sizes)

    def run(self) -> Descended:
        active = np.isfinite(self.cost) & ~self.resting.all(axis=1)
        fresh = active.copy()
        least = np.full(len(self.floor), np.inf)
        for count in range(ITERATIONS):
            check()
            rows = np.nonzero(active)[0]
            if not rows.size:
                break
            self._model(np.nonzero(active & fresh)[0])
            step, gain = self._step(rows)
            trial = self.c[rows]
            with np.errstate(all="ignore"):
                trial[:, self.free] = np.clip(
                    trial[:, self.free] + step, self.low[rows], self.high[rows]
                )
            cost, *sums = self._at(rows, trial)
            before, floor = self.cost[rows], self.floor[self.of[rows]]
            part = np.where(self.newton[rows], LAST_STEP, LAST_STEP**1.5)
            last = (self.damping[rows] == 0) & (gain <= part * before + floor)
            last &= cost <= before * (1 + 1e-9) + floor
            better = (cost <= before) | last
            fall = before - cost
            done = last | (better & (fall <= self.settled * before) & (self.settled > 0))
            done |= better & (fall <= 0) & (gain <= LAST_STEP * before)
            good, bad = rows[better], rows[~better]
            self.c[good], self.cost[good] = trial[better], cost[better]
            for held, new in zip(self.sums, sums, strict=True):
                held[good] = new[better]
            self.steps[good] += 1
            damping = self.damping[good]
            self.damping[good] = np.where(damping > FIRST_DAMPING, damping / 10, 0.0)
            self.damping[bad] = np.maximum(4 * self.damping[bad], FIRST_DAMPING)
            self.near[good] = fall[better] <= NEAR * cost[better]
            fresh[good], fresh[bad] = True, False
            active[rows[done]] = False
            np.minimum.at(least, self.of[rows[done]], self.cost[rows[done]])
            active &= ~self._idle(least[self.of], count)
            active &= self.damping < LARGEST_DAMPING
        return Descended(self.c, self.cost, self.steps, self.resting)

    def _idle(self, least: Array, count: int) -> NDArray[np.bool_]:
        """Starts that come to where another has been, or are long on a way from far above it."""
        same = (self.cost >= least) & (self.cost <= least * (1 + SAME))
        return same | ((self.cost > FAR * least) & (count > PATIENCE))

    def _at(self, rows: NDArray[np.intp], c: Array) -> tuple[Array, Array, Array, Array]:
        """Cost, J^T r, J^T J and (where near) second derivatives of the free coefficients."""
        m, k, near = len(c), len(self.free), self.near[rows]
        found = (np.empty(m), np.empty((m, k)), np.empty((m, k, k)), np.zeros((m, k, k)))
        for chosen, second in ((~near, False), (near, True)):
            if chosen.any():
                cost, right, normal, bent = self.sums_of(c[chosen], second, self.of[rows[chosen]])
                found[0][chosen], found[1][chosen] = cost, right[:, self.free]
                found[2][chosen] = normal[:, self.free][:, :, self.free]
                found[3][chosen] = bent[:, self.free][:, :, self.free]
        finite = np.isfinite(found[0]) & np.isfinite(found[2]).all(axis=(1, 2))
        found[0][~finite] = np.inf
        found[3][~np.isfinite(found[3]).all(axis=(1, 2))] = 0.0
        return found

    def _model(self, rows: NDArray[np.intp]) -> None:
        """The quadratic model at where these rows stand, in columns of unit length."""
        if not rows.size:
            return
        right, normal, second = (held[rows] for held in self.sums)
        z, low, high = self.c[rows][:, self.free], self.low[rows], self.high[rows]
        norms = np.sqrt(np.einsum("mii->mi", normal))
        norms = np.where(norms > 0, norms, 1.0)
        right = right / norms
        resting = (low >= high) | ((z <= low) & (right < 0)) | ((z >= high) & (right > 0))
        both = norms[:, :, None] * norms[:, None, :]
        normal = normal / both
        values, vectors = np.linalg.eigh(_without(normal, resting))
        newton = self.near[rows] & second.any(axis=(1, 2))
        if newton.any():
            whole = (normal + second / both)[newton]
            exact = np.linalg.eigh(_without(whole, resting[newton]))
            definite = exact[0][:, 0] > DEFINITE
            newton[newton] = definite
            values[newton], vectors[newton] = exact[0][definite], exact[1][definite]
        self.newton[rows], self.resting[rows] = newton, resting
        self.norms[rows], self.right[rows] = norms, np.where(resting, 0.0, right)
        self.values[rows], self.vectors[rows] = np.maximum(values, 1e-12), vectors

    def _step(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Steps (r, free), and what they promise to take off the costs (r,)."""
        along = np.einsum("mij,mi->mj", self.vectors[rows], self.right[rows])
        parts = along / (self.values[rows] + self.damping[rows, None])
        step = np.einsum("mij,mj->mi", self.vectors[rows], parts)
        return step / self.norms[rows], np.sum(along * parts, axis=1)


def _without(matrix: Array, resting: NDArray[np.bool_]) -> Array:
    """The rows and columns of coefficients that rest made those of the identity."""
    open_ = ~resting
    kept = np.where(open_[:, :, None] & open_[:, None, :], matrix, 0.0)
    return np.asarray(kept + np.eye(resting.shape[1]) * resting[:, :, None])


# ---- optima --------------------------------------------------------------------------------------
EXPANDED = 1000
"""Cells up to which the solver's functions are written out; beyond, one law is mapped over them."""
STATIONARY = 1e-6
"""Largest cosine between the residual and a column of the Jacobian at an optimum."""
SPLIT = ("huber", "l1")
"""Losses with a kink, or a jump of their curvature: the solver splits residuals."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """Coefficients (all of the law) and what they cost [N2]."""

    coefficients: Array
    cost: float
    solver: SolverStatistics


@lru_cache(maxsize=64)
def _solver(
    law: type[ForceLaw], free: tuple[int, ...], count: int, loss: Loss, priors: int, slack: int
) -> Nlp:
    """min sum rho(w (F - y)/unit)/2 over scaled coefficients; built once per law and size. Huber's
    loss and absolute values split the residual, r = a + b: squares of a, ``edge`` |b|: smooth.
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


def local_optima(problem: Problem, starts: Array, scanned: int) -> list[Minimum]:
    """The optima next to each of ``starts`` (m, all)."""
    if isinstance(problem, LeastSquares) and not problem.smooth:
        return [by_ipopt(problem, start, scanned) for start in starts]
    return by_newton(problem, starts, scanned)


def by_newton(problem: Problem, starts: Array, scanned: int) -> list[Minimum]:
    """The least squares next to each of ``starts``."""
    ended = descend(problem, starts, *_near(problem, starts))
    return _minima(problem, ended, np.arange(len(starts)), scanned)


def optima_of_each(
    problems: Sequence[LeastSquares], begun: Sequence[tuple[Array, int]]
) -> list[list[Minimum]]:
    """:func:`local_optima` of fits of one law to several tables, from starts (m, all) of each and
    how many points were scanned for them; plain squares go down side by side.
    """
    if not all(p.smooth for p in problems) or len(problems) < 2:
        return [local_optima(p, *b) for p, b in zip(problems, begun, strict=True)]
    starts, first = [s for s, _ in begun], problems[0]
    most = max(len(p.cells) for p in problems)
    data = np.zeros((4, len(problems), most))  # filled up by cells of no weight
    for i, problem in enumerate(problems):
        cells, n = problem.cells, len(problem.cells)
        data[:3, i] = np.array([[v[0]] for v in (cells.pressure, cells.contraction, cells.force)])
        data[:, i, :n] = cells.pressure, cells.contraction, cells.force, problem.weights
    of = np.repeat(np.arange(len(problems)), [len(s) for s in starts])
    ends = [_near(p, s) for p, s in zip(problems, starts, strict=True)]
    low, high = (np.concatenate([e[i] for e in ends]) for i in (0, 1))

    def sums(c: Array, second: bool, of: NDArray[np.intp]) -> Sums:
        return summed(first.law, list(data[:, of]), first.priors, c, second)

    sizes, together = [p.size for p in problems], np.concatenate(starts)
    ended = _Descent(sums, first.free, sizes, of, together, low, high).run()
    rows = [np.nonzero(of == i)[0] for i in range(len(problems))]
    return [_minima(p, ended, r, b[1]) for p, r, b in zip(problems, rows, begun, strict=True)]


def _near(problem: Problem, starts: Array) -> tuple[Array, Array]:
    limits = [problem.near(start) for start in starts]
    return np.array([pair[0] for pair in limits]), np.array([pair[1] for pair in limits])


def _minima(
    problem: Problem, ended: Descended, rows: NDArray[np.intp], scanned: int
) -> list[Minimum]:
    """Of those starts of a descent that are this problem's."""
    residuals, jacobians = problem.with_priors(ended.coefficients[rows])
    found = []
    for row, residual, jacobian in zip(rows, residuals, jacobians, strict=True):
        free = list(zip(problem.free, ended.resting[row], strict=True))
        columns = jacobian[:, [i for i, rests in free if not rests]]
        gradient = cosine(residual, columns, problem.size)
        statistics = SolverStatistics(
            "Newton_Converged" if gradient <= STATIONARY else "Newton_Stalled",
            int(ended.steps[row]),
            gradient,
            scanned,
            tuple(problem.names[i] for i, rests in free if rests),
        )
        found.append(Minimum(ended.coefficients[row], float(ended.cost[row]), statistics))
    return found


def by_ipopt(problem: LeastSquares, start: Array, scanned: int) -> Minimum:
    """The optimum next to ``start`` (all coefficients), whatever the loss and the inequalities."""
    free, terms = list(problem.free), problem.terms
    lower, upper = problem.near(start)
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
    return Minimum(
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
    """Largest cosine of residual and Jacobian; IPOPT's own measure for kinks and inequalities."""
    if problem.terms.loss in SPLIT or problem.censored:
        done = statistics["success"] and np.isfinite(problem.cost(c))
        return float(statistics["iterations"]["inf_du"][-1]) if done else float("inf")
    residual, jacobian = (a[0] for a in problem.with_priors(c[None]))
    if problem.terms.loss == "bisquare":
        n = len(problem.cells)
        residual[:n] *= problem.terms.reweighting(residual[:n], 0.0) ** 2
    return cosine(residual, jacobian[:, inside], size)


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
