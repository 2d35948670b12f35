"""The optimum of a static fit: the fitted law at its cells, its linearisation, and its profile
likelihood: how far one coefficient goes until the others cannot make up for it.

With one nonlinear coefficient q the cost is for each q a parabola in every other one, so the ends
of all intervals are the extremes over q of ends in closed form: global, and a sweep over q sees
where nothing ends (:class:`Sweep`). Else the coefficient walks outwards, the others fitted anew
from step to step (:func:`walked`; D. Bates, D. Watts, Nonlinear Regression Analysis, 1988, 6.1).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.polynomial.chebyshev import chebval, chebvander

from ...core.cases import results_of
from ...core.errors import FitError
from ...core.executors import Place, placed
from ...core.quantities import UnitWarning
from ...muscles.law import ForceLaw
from ..estimates import Estimates
from ..statistics import (
    Array,
    Coefficient,
    Linearisation,
    SerialErrors,
    SolverStatistics,
    forces_and_slopes,
)
from ..tables.force_table import ForceTable
from .correlation import sequences, serial_errors
from .least_squares import (
    BISQUARE,
    DECADES,
    HUBER,
    PLAIN,
    LeastSquares,
    Terms,
    projected,
    robust_scale,
    sizes,
    spread,
)
from .local_optimum import Problem, descend
from .search import minimise


def sensitivity(law: ForceLaw, free: Sequence[str], p: Array, kappa: Array) -> tuple[Array, Array]:
    """Tension (n,) [N] and its derivatives with respect to the ``free`` coefficients (n, k)."""
    names, values = list(law.values), np.array([[float(v) for v in law.values.values()]])
    tension, jacobian = forces_and_slopes(type(law), p, kappa, values)
    return tension[0], jacobian[0][:, [names.index(n) for n in free]]


@dataclass(frozen=True, eq=False)
class Optimum(Estimates):
    """A force law at the coefficients that fit a table best, and the problem near them; the fields
    are those of :class:`ForceFit`.
    """

    law: ForceLaw
    table: ForceTable
    held: tuple[str, ...]
    weights: Array | None
    solver: SolverStatistics
    terms: Terms = PLAIN

    # ---- the fit itself ---------------------------------------------------------------------
    @cached_property
    def cells(self) -> ForceTable:
        """The taut cells, in the order of ``residuals``."""
        return self.table.taut

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted coefficients."""
        return tuple(n for n in self.law.values if n not in self.held)

    @property
    def root_weights(self) -> Array:
        """Factor of each residual; ones without weights."""
        return np.ones(len(self.cells)) if self.weights is None else self.weights

    @property
    def usual(self) -> float:
        """Standard deviation of a measurement as uncertain as the cells on average, over ``sigma``
        (which goes with the common factor of the weights).
        """
        return float(np.sqrt(np.mean(self.root_weights**-2.0)))

    def _sensitivity(self, p: Array, kappa: Array) -> tuple[Array, Array]:
        """Tension (n,) and its derivatives with respect to the free coefficients (n, k)."""
        return sensitivity(self.law, self.free, p, kappa)

    @cached_property
    def _at_cells(self) -> tuple[Array, Array]:
        return self._sensitivity(self.cells.pressure, self.cells.contraction)

    @property
    def residuals(self) -> Array:
        """Measured minus fitted force of the taut cells [N]."""
        return self.cells.force - self._at_cells[0]

    @property
    def jacobian(self) -> Array:
        """Exact derivatives of the force, (taut cells, free coefficients) [N/unit]."""
        return self._at_cells[1]

    @property
    def n(self) -> int:
        """Number of taut cells."""
        return len(self.cells)

    @cached_property
    def problem(self) -> LeastSquares:
        """The problem that was solved."""
        held = {n: float(self.law.values[n]) for n in self.held}
        return LeastSquares.of(type(self.law), self.table, held, self.root_weights, self.terms)

    @property
    def dof(self) -> int:
        """Degrees of freedom: taut cells and priors less fitted coefficients."""
        return self.n + len(self.problem.priors[0]) - len(self.free)

    @property
    def cost(self) -> float:
        """What the fit made smallest [N2]: ``squares``, or the robust loss, and the priors."""
        return self.problem.cost(self.vector)

    @property
    def squares(self) -> float:
        """Weighted sum of squared residuals."""
        return float(np.sum((self.root_weights * self.residuals) ** 2))

    @property
    def rmse(self) -> float:
        """Root of the mean squared residual over the taut cells, without weights [N]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def r2(self) -> float:
        """1 - (squared residuals)/(squared deviations from the mean), without weights."""
        spread = float(np.sum((self.cells.force - self.cells.force.mean()) ** 2))
        return 1 - float(np.sum(self.residuals**2)) / spread if spread else float("nan")

    @property
    def sigma(self) -> float:
        """Standard deviation s of a measurement of weight 1 [N], robust after a robust fit."""
        if not self.dof:
            return float("nan")
        if self.terms.loss == "bisquare":
            return self.terms.threshold / BISQUARE
        if self.terms.loss != "squares":
            return spread(self.root_weights * self.residuals, len(self.free))
        return float(np.sqrt(self.cost / self.dof))

    # ---- near the optimum ---------------------------------------------------------------------
    @cached_property
    def linearisation(self) -> Linearisation:
        """The weighted least-squares problem near its optimum."""
        variables = {v.name: v for v in self.law.coefficient_variables()}
        jacobian = self.problem.with_priors(self.vector[None])[1][0][:, list(self.problem.free)]
        return Linearisation(
            self.free,
            np.array([float(self.law.values[n]) for n in self.free]),
            [variables[n].unit for n in self.free],
            jacobian,
            self._scale,
            self.dof,
            self._active,
            None
            if self.terms.independent
            else serial_errors(jacobian, self._influential, sequences(self.cells)),
        )

    @property
    def _influential(self) -> Array:
        """Weighted residuals as they count: cells far off do not after a robust fit."""
        residuals = self.root_weights * self.residuals
        if np.linalg.norm(residuals) <= 1e-9 * np.linalg.norm(self.root_weights * self.cells.force):
            return np.zeros(self.n)  # rounding errors are serially correlated, too
        if self.terms.loss == "squares":
            return residuals
        if self.terms.loss == "l1":
            edge = HUBER * spread(residuals, len(self.free))
            return np.clip(residuals, -edge, edge)
        return residuals * self.terms.reweighting(residuals, 0.0) ** 2

    @property
    def serial(self) -> SerialErrors | None:
        """The serial correlation of errors along a ramp, if any; it widens all intervals."""
        return self.linearisation.serial

    @property
    def vector(self) -> Array:
        """All coefficients of the law, in its order."""
        return np.array([float(v) for v in self.law.values.values()])

    @property
    def _scale(self) -> float:
        """The factor s of the covariance s^2 (J^T J)^-1."""
        if self.terms.loss == "squares" or not self.dof:
            return self.sigma
        return robust_scale(self.terms, self.root_weights * self.residuals, len(self.free))

    @property
    def _active(self) -> Array | None:
        """Gradients of the slack cells at which the law would pull more if it could."""
        if not self.problem.censored:
            return None
        tension, gradients = self.problem.tension_where_slack(self.vector)
        return gradients[tension > 0.999 * self.problem.slack_tolerance][:, list(self.problem.free)]

    @property
    def has_profile(self) -> bool:
        """Whether intervals are those of the profile likelihood."""
        return self.terms.loss == "squares" and not self.problem.limited and self.dof > 0

    @property
    def _called(self) -> str:
        return f"coefficient of the {self.law.name} law"

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every coefficient by name, held ones included."""
        errors = dict(zip(self.free, self.linearisation.stderr(), strict=True))
        return {
            v.name: Coefficient(
                v.name,
                float(self.law.values[v.name]),
                float(errors.get(v.name, 0.0)),
                v.unit,
                v.name in self.held,
                v.description,
            )
            for v in self.law.coefficient_variables()
        }


# ---- profile likelihood --------------------------------------------------------------------------
SAME_COST = 1e-9
"""Relative fall of the cost at which the others count as fitted, where one of them walks."""
FARTHEST = 1e4
"""Standard errors (or, if more, values of the coefficient) as far as which a walk seeks an end."""


@dataclass(frozen=True)
class Ends:
    """An interval; ``reason`` says in words why an end is infinite."""

    low: float
    high: float
    reason: str = ""


def profile_ends(
    fit: Optimum, names: Sequence[str], reach: float, executor: Place = None
) -> dict[str, Ends]:
    """Ends of the profile intervals of several coefficients, ``reach`` standard errors away.

    A standard error that is larger than that of independent errors widens the interval as much.

    executor : where coefficients walk; a sweep takes milliseconds for all, and is done here.
    """
    placed(executor)
    plain = dict(zip(fit.free, fit.linearisation.independent.stderr().tolist(), strict=True))
    sweep = Sweep.of(fit)
    ends = [(name, side) for name in names for side in (-1.0, 1.0)]
    limits = {
        n: fit.cost + (reach * fit.coefficients[n].stderr / plain[n] * fit.sigma) ** 2
        for n in names
    }
    if sweep is not None:
        answers = sweep.ends([(fit.free.index(n), side, limits[n]) for n, side in ends])
    else:
        walks = [(n, side * fit.coefficients[n].stderr, limits[n]) for n, side in ends]
        answers = results_of(partial(_end, fit), walks, executor=executor, chunk=1, what="profiles")
    found = {}
    for name, (low, below), (high, above) in zip(names, answers[::2], answers[1::2], strict=True):
        reasons = dict.fromkeys(why for why in (below, above) if why)
        found[name] = Ends(low, high, "; ".join(reasons))
    return found


def _end(fit: Optimum, walk: tuple[str, float, float]) -> tuple[float, str]:
    """Of a walk: a coefficient, a first step, and a limit."""
    return profile_end(fit, *walk)


def _others(fit: Optimum, place: int, start: Array) -> tuple[Array, float]:
    """The best of all but coefficient number ``place``, near ``start``, and what they cost.
    Censored cells ask for a whole fit; a place where the law cannot be slack costs more than any
    limit.
    """
    problem, beyond = fit.problem, float(np.finfo(float).max)
    if not problem.censored:
        return refitted(problem, start, (place,))
    best, cost, held = start, problem.cost(start), {n: fit.law.values[n] for n in fit.held}
    held[problem.names[place]] = float(start[place])
    if len(held) < len(problem.names):
        whole = LeastSquares.of(type(fit.law), fit.table, held, fit.root_weights, fit.terms)
        try:
            found = minimise(whole)
        except FitError:
            return start, beyond
        best, cost = found.coefficients, found.cost
    pull = problem.tension_where_slack(best)[0]
    return best, cost if np.all(pull <= 1.001 * problem.slack_tolerance) else beyond


def refitted(problem: Problem, start: Array, held: Sequence[int]) -> tuple[Array, float]:
    """The best of the unknowns near ``start`` that are not ``held``, and what they cost."""
    free = list(problem.free)
    low, high = (
        np.where([i in held for i in free], start[free], end)[None] for end in problem.bounds()
    )
    ended = descend(problem, start[None], low, high, SAME_COST)
    return ended.coefficients[0], float(ended.cost[0])


def profile_end(fit: Optimum, name: str, step: float, limit: float) -> tuple[float, str]:
    """Value of ``name``, on the side of ``step``, at which the profiled cost reaches ``limit``, or
    why there is none; see :func:`walked`.
    """
    place, problem = list(fit.law.values).index(name), fit.problem
    variable, best = problem.variables[place], float(fit.law.values[name])
    reach = max(FARTHEST * abs(step), max(abs(best), variable.nominal) * 10.0 ** DECADES[1])
    if place in problem.nonlinear:
        reach = min(reach, float(np.max(np.abs(sizes(variable) - best))))
    bounds, others = (variable.min, variable.max), partial(_others, fit, place)
    end, why = walked(others, fit.vector, place, step, limit, bounds, reach)
    return end, why.format(name=name)


def walked(
    others: Callable[[Array], tuple[Array, float]],
    start: Array,
    place: int,
    step: float,
    limit: float,
    bounds: tuple[float, float],
    reach: float,
) -> tuple[float, str]:
    """Where the cost reaches ``limit`` on the side of ``step`` of unknown number ``place``. others
    : the best of the others near given unknowns, and what they cost. bounds : of the unknown. reach
    : how far it is followed. Infinite, with the reason, where the cost stays below.
    """
    from scipy.optimize import brentq

    best, far_out = float(start[place]), float(np.copysign(np.inf, step))
    bound, inside = bounds[step > 0], start
    while True:
        trial = inside.copy()
        trial[place] = np.clip(inside[place] + step, *bounds)
        outside, cost = others(trial)
        if not np.isfinite(cost):
            return far_out, "the law gives no finite force further out"
        if cost > limit:
            break
        if trial[place] == bound:
            return float(bound), "" if np.isfinite(bound) else "the others make up for it"
        if abs(trial[place] - best) > reach:
            return far_out, (
                f"at {{name}} = {trial[place]:.3g} the other coefficients still make up for it"
            )
        inside, step = outside, 1.6 * step
    far = float(outside[place])

    def excess(value: float) -> float:
        trial = inside.copy()
        trial[place] = value
        return float(min(others(trial)[1], 2 * limit) - limit)

    tolerance = max(5e-7 * abs(far - best), 5e-10 * abs(step))
    return float(brentq(excess, float(inside[place]), far, xtol=tolerance)), ""


# ---- by a sweep ----------------------------------------------------------------------------------
TRIED = np.concatenate([-np.geomspace(8, 0.05, 24), [0.0], np.geomspace(0.05, 8, 24)])
"""Standard errors from the optimum at which the nonlinear coefficient is tried, beside its scan."""
NODES = -np.cos(np.pi * np.arange(11) / 10)
"""Chebyshev points between two values of q, on whose polynomials an end is sought."""
THROUGH = np.linalg.inv(chebvander(NODES, NODES.size - 1))
"""From values at the nodes to the coefficients of the polynomial through them."""
SMOOTH = 1e-7
"""Of the polynomials' last two coefficients, in parts of the largest: they follow what is told."""
ZOOMS = {True: (3, 201), False: (5, 41)}
"""Times that the bracket of an end is narrowed, and values of q within it, by whether polynomials
follow.
"""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Profile intervals and bands of a law with one nonlinear coefficient q, over all of its range.
    For a given q the cost is least + (c - best)^2/variance in each linear coefficient c.
    """

    problem: LeastSquares
    place: int
    best: float
    values: Array
    results: tuple[Array, Array, Array]
    """Costs (m,), best linear coefficients (m, k) and roots of their covariances (m, k, k) at
    ``values``.
    """

    @classmethod
    def of(cls, fit: Optimum) -> Sweep | None:
        """None for laws with other than one nonlinear coefficient, or bounds of linear ones."""
        problem = fit.problem
        if len(problem.nonlinear) != 1 or problem.limited or fit.terms.loss != "squares":
            return None
        if any(
            np.isfinite([problem.variables[i].min, problem.variables[i].max]).any()
            for i in problem.linear
        ):
            return None
        place = problem.nonlinear[0]
        name, variable = problem.names[place], problem.variables[place]
        best, error = float(fit.law.values[name]), fit.coefficients[name].stderr
        near = best + (error if np.isfinite(error) else 0.1 * abs(best)) * TRIED
        wide = sizes(variable)
        reach = np.abs(wide)
        if not np.isfinite(variable.max - variable.min):
            near = near[(np.abs(near) >= reach.min()) & (np.abs(near) <= reach.max())]
        near = near[(near >= variable.min) & (near <= variable.max)]
        values = np.unique(np.concatenate([near, wide, [best]]))
        return cls(problem, place, best, values, cls._projected(problem, values))

    @staticmethod
    def _projected(problem: LeastSquares, values: Array) -> tuple[Array, Array, Array]:
        return projected(*problem.triangles(values[:, None])[1:])

    def ends(self, asked: Sequence[tuple[int, float, float]]) -> list[tuple[float, str]]:
        """Ends of intervals, for (number among the free coefficients, side, limit), or why none."""
        last, count = len(self.values) - 1, len(asked)
        first = [
            int(np.argmax(self._reached(self.values, self._told(self.results, *one), *one)))
            for one in asked
        ]
        low = self.values[[max(j - 1, 0) for j in first]]
        high = self.values[[min(j + 1, last) for j in first]]
        nodes = low + (high - low) * (NODES[:, None] + 1) / 2
        results = self._projected(self.problem, nodes.T.ravel())
        best = np.zeros(count)
        for row, one in enumerate(asked):
            part = slice(row * NODES.size, (row + 1) * NODES.size)
            told = self._told(tuple(r[part] for r in results), *one)
            best[row] = one[1] * self._farthest(nodes[:, row], told, *one)
        return [
            self._open_end(i, side, j) or (float(end), "")
            for (i, side, _), j, end in zip(asked, first, best, strict=True)
        ]

    def _told(self, results: tuple[Array, ...], free: int, _: float, limit: float) -> Array:
        """(3, m) at values of q: costs above the limit, and the best and the variance of a free
        coefficient.
        """
        (cost, best, root), i = results, self.problem.free[free]
        if i == self.place:
            return np.stack([cost - limit, np.zeros(cost.size), np.zeros(cost.size)])
        column = self.problem.linear.index(i)
        return np.stack([cost - limit, best[:, column], np.sum(root[:, column] ** 2, axis=1)])

    def _farthest(self, nodes: Array, told: Array, free: int, side: float, limit: float) -> float:
        """How far the coefficient reaches between the first and the last of the nodes: on the
        polynomials through what is told there; by new values where the law ends or bends among
        them.
        """
        smooth, through = bool(np.isfinite(told).all()), np.empty(0)
        if smooth:
            through = THROUGH @ told.T
            smooth = bool(np.all(np.abs(through[-2:]) <= SMOOTH * np.abs(through).max(axis=0)))
        low, high, reached = -1.0, 1.0, np.array([-np.inf])
        zooms, points = ZOOMS[smooth]
        for _ in range(zooms):
            at = np.linspace(low, high, points)
            values = nodes[0] + (nodes[-1] - nodes[0]) * (at + 1) / 2
            if smooth:
                told = np.asarray(chebval(at, through), float)
            else:
                told = self._told(self._projected(self.problem, values), free, side, limit)
            reached = self._reached(values, told, free, side, limit)
            j = int(np.argmax(reached))
            low, high = at[max(j - 1, 0)], at[min(j + 1, points - 1)]
        return float(reached.max())

    def _open_end(self, free: int, side: float, j: int) -> tuple[float, str] | None:
        """Of an interval that the law reaches farthest at an edge, value number j; None within."""
        variable = self.problem.variables[self.place]
        if self.problem.free[free] != self.place:
            return (side * np.inf, self._open_words()) if self._at_edge(j) else None
        if j != (len(self.values) - 1 if side > 0 else 0):
            return None
        bound = float(variable.max if side > 0 else variable.min)
        return bound, "" if np.isfinite(bound) else self._open_words()

    def _reached(self, values: Array, told: Array, free: int, side: float, _: float) -> Array:
        """How far to a side the coefficient may go at each value (m,) of q; -inf where the cost is
        too high.
        """
        above, best, variance = told
        if self.problem.free[free] == self.place:
            far = side * values
        else:
            with np.errstate(invalid="ignore"):
                far = side * best + np.sqrt(np.maximum(-above * variance, 0.0))
        return np.where((above <= 0) & np.isfinite(far), far, -np.inf)

    def band(self, p: Array, kappa: Array, limits: Array) -> tuple[Array, Array]:
        """Lowest and highest force (n,) at places (n,) over laws of no more than these costs."""
        cost, best, root = self.results
        kept = cost <= max(float(limits.max()), float(cost.min()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnitWarning)  # said where the places came in
            cells = ForceTable(p, kappa, np.zeros(p.size))
        there = replace(self.problem, cells=cells, weights=np.ones(p.size))
        _, target, columns, good = there.linear_in(self.values[kept][:, None], there.evaluate)
        force = np.einsum("mnk,mk->mn", columns, best[kept]) - target
        along = np.einsum("mnk,mkl->mnl", columns, root[kept])
        room = limits - cost[kept][:, None]
        half = np.sqrt(np.maximum(room, 0.0) * np.sum(along**2, axis=2))
        inside = (room >= 0) & good[:, None]
        low, high = np.where(inside, force - half, np.inf), np.where(inside, force + half, -np.inf)
        return np.asarray(low.min(axis=0)), np.asarray(high.max(axis=0))

    def _at_edge(self, j: int) -> bool:
        """Whether the law degenerates at this value: an end of the scan, or beside zero."""
        if j in (0, len(self.values) - 1):
            return True
        variable = self.problem.variables[self.place]
        smallest = np.abs(sizes(variable)).min()
        unlimited = not np.isfinite(variable.max - variable.min)
        return bool(unlimited and abs(self.values[j]) <= 1.001 * smallest)

    def _open_words(self) -> str:
        name, reach = self.problem.names[self.place], np.abs(self.values)
        return (
            f"the data allow {name} at an end of the range in which it is sought "
            f"(of size {reach.min():.3g} to {reach.max():.3g}), where the law degenerates"
        )
