"""The least-squares problem of one force law on a table.

A law is linear in most of its coefficients. For given values of the others the best linear ones
are a linear least-squares problem (variable projection: G. Golub, V. Pereyra, SIAM J. Numer. Anal.
10 (1973) 413-432).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any, Literal, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.variables import Variable
from ...muscles.law import ForceLaw
from ..statistics import Array, forces, forces_and_slopes, in_blocks, second_places
from ..tables.force_table import ForceTable

DECADES = (-2.0, 1.5)
"""A nonlinear coefficient is sought from 10^-2 to 10^1.5 of its nominal size, of either sign."""
POINTS_PER_DECADE = 12
SLACK_TOLERANCE = 1.0
"""Force [N] with which a law still counts as slack: the width of the muscle's clamp."""
AT_ONCE = 100_000
"""Cells times scan points that are held in memory at once."""
REWEIGHTINGS = 12
"""Iterations of reweighted least squares in the scan of a robust loss; IPOPT does the rest."""
ENOUGH = 1000
"""Cells that a scan looks at."""
HUBER = 1.345
"""Standard deviations at which Huber's loss goes over: 95 % efficient for normal errors."""
BISQUARE = 4.685
"""Standard deviations from which Tukey's bisquare counts a cell no more: also 95 % efficient."""


@cache
def nonlinear_coefficients(
    law: type[ForceLaw], held: frozenset[str] = frozenset()
) -> tuple[str, ...]:
    """The fewest coefficients which, once fixed, leave the law linear in all others together."""
    function = law.function()
    c = ca.SX.sym("c", function.size1_in(2))
    tension = function(ca.SX.sym("p"), ca.SX.sym("kappa"), c)[0]
    names = [v.name for v in law.coefficient_variables()]
    rows, columns = ca.hessian(tension, c)[0].sparsity().get_triplet()
    pairs = {frozenset((names[i], names[j])) for i, j in zip(rows, columns, strict=True)}
    pairs = {pair for pair in pairs if not pair & held}
    alone = {n for pair in pairs if len(pair) == 1 for n in pair}
    linked = {pair for pair in pairs if not pair & alone}
    open_names = [n for n in names if any(n in pair for pair in linked)]
    for size in range(len(open_names) + 1):
        for chosen in itertools.combinations(open_names, size):
            if all(pair & set(chosen) for pair in linked):
                return tuple(n for n in names if n in alone or n in chosen)
    raise AssertionError("the full set always covers every pair")


Loss: TypeAlias = Literal["squares", "huber", "l1", "bisquare"]


@dataclass(frozen=True)
class Terms:
    """What a fit minimises beside plain squares, and within which limits.

    loss : "squares"; "huber" (squares up to ``threshold``, then straight); "l1" (absolute values);
        "bisquare" (Tukey's: constant from ``threshold`` on, such cells count no more).
    threshold : the slope of the straight part [N, of a measurement of weight 1]; for "huber" where
        it begins.
    censored : whether the law must be slack where the muscle was.
    bounds, priors : (name, low, high) and (name, mean, standard deviation) of coefficients [SI].
    noise : standard deviation of a measurement of weight 1 [N], against which priors weigh.
    independent : whether errors are known to be serially independent; else residuals tell.
    """

    loss: Loss = "squares"
    threshold: float = float("inf")
    censored: bool = False
    bounds: tuple[tuple[str, float, float], ...] = ()
    priors: tuple[tuple[str, float, float], ...] = ()
    noise: float = 1.0
    independent: bool = False

    def rho(self, residuals: Array) -> Array:
        """Twice the loss of each residual: its square, for "squares"."""
        size = np.abs(residuals)
        edge = self.threshold
        if self.loss == "l1":
            return np.asarray(2 * edge * size)
        if self.loss == "bisquare":
            return np.asarray(edge**2 / 3 * (1 - (1 - np.minimum((size / edge) ** 2, 1.0)) ** 3))
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(size <= edge, size**2, edge * (2 * size - edge)))

    def reweighting(self, residuals: Array, smallest: float) -> Array:
        """Factors of the residuals whose squares have the slope of the loss (IRLS)."""
        if self.loss == "bisquare":
            return np.asarray(1 - np.minimum(np.abs(residuals) / self.threshold, 1.0) ** 2)
        size = np.maximum(np.abs(residuals), smallest)
        factors = self.threshold / size
        return np.asarray(np.sqrt(factors if self.loss == "l1" else np.minimum(1.0, factors)))

    def to_json(self) -> dict[str, Any]:
        """For JSON, which has no infinity: null in its place."""
        bounds = [(n, finite(low), finite(high)) for n, low, high in self.bounds]
        return asdict(self) | {"threshold": finite(self.threshold), "bounds": bounds}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Terms:
        """What :meth:`to_json` gave; plain squares of nothing."""
        if not content:
            return cls()
        threshold = np.inf if content["threshold"] is None else content["threshold"]
        bounds = tuple(
            (n, -np.inf if low is None else low, np.inf if high is None else high)
            for n, low, high in content["bounds"]
        )
        priors = tuple((n, mean, deviation) for n, mean, deviation in content["priors"])
        return cls(**{**content, "threshold": threshold, "bounds": bounds, "priors": priors})


def finite(value: float) -> float | None:
    """JSON has no infinity: null for an open end."""
    return float(value) if np.isfinite(value) else None


class Sums(NamedTuple):
    """What Newton's method wants of a sum of squares. cost (m,): |r|^2. right (m, all): J^T r,
    downhill. normal (m, all, all): J^T J. second (m, all, all): what the second derivatives of r
    add to it.
    """

    cost: Array
    right: Array
    normal: Array
    second: Array


PLAIN = Terms()
"""Least squares, and nothing else."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The fit of one law on taut cells; ``base`` holds the held coefficients."""

    law: type[ForceLaw]
    cells: ForceTable
    weights: Array
    base: Array
    free: tuple[int, ...]
    nonlinear: tuple[int, ...]
    slack: ForceTable
    terms: Terms = PLAIN

    @classmethod
    def of(
        cls,
        law: type[ForceLaw],
        table: ForceTable,
        held: Mapping[str, float],
        weights: Array,
        terms: Terms = PLAIN,
        few: bool = False,
    ) -> LeastSquares:
        """few : whether fewer cells than coefficients will do, for a part of a fit."""
        names = [v.name for v in law.coefficient_variables()]
        free = tuple(i for i, n in enumerate(names) if n not in held)
        bent = nonlinear_coefficients(law, frozenset(held))
        cells = table.taut
        if not len(cells):
            raise InputError(
                f"all {len(table)} cells of the table are slack: there is nothing to fit"
            )
        if not free:
            raise InputError("fixed holds every coefficient: leave at least one free")
        known = sum(n not in held for n, _, _ in terms.priors)
        if len(cells) + known < len(free) and not few:
            raise InputError(
                f"the table has {len(cells)} taut cells, fewer than the {len(free)} coefficients "
                f"of the {law.name} law to be fitted; measure more, hold some with fixed=..., or "
                "take a smaller law"
            )
        base = np.array([held.get(n, 0.0) for n in names])
        nonlinear = tuple(i for i in free if names[i] in bent)
        return cls(law, cells, weights, base, free, nonlinear, table.subset(table.slack), terms)

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The law's coefficients, their ranges narrowed by the user's bounds."""
        narrowed = {n: (low, high) for n, low, high in self.terms.bounds}
        return tuple(
            replace(v, min=max(v.min, narrowed[v.name][0]), max=min(v.max, narrowed[v.name][1]))
            if v.name in narrowed
            else v
            for v in self.law.coefficient_variables()
        )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(v.name for v in self.variables)

    @property
    def linear(self) -> list[int]:
        return [i for i in self.free if i not in self.nonlinear]

    @cached_property
    def size(self) -> float:
        """Norm of the weighted forces [N]."""
        return float(np.linalg.norm(self.weights * self.cells.force))

    @property
    def limited(self) -> bool:
        """Whether there are inequalities other than the law's own."""
        return self.censored or bool(self.terms.bounds)

    @property
    def censored(self) -> bool:
        return self.terms.censored and len(self.slack) > 0

    @property
    def smooth(self) -> bool:
        """Whether it is plain squares, with no inequalities but bounds."""
        return self.terms.loss == "squares" and not self.censored

    @property
    def scales(self) -> list[Array]:
        """Values at which each nonlinear coefficient is scanned."""
        return [sizes(self.variables[i]) for i in self.nonlinear]

    def thinned(self, enough: int = ENOUGH) -> LeastSquares:
        """The problem on so many cells as a scan needs, evenly over contraction and pressure."""
        n, cells, weights = len(self.cells), self.cells, self.weights
        if n <= enough or np.max(weights) > 10 * np.min(weights):
            return self
        order = np.lexsort((cells.pressure, cells.contraction))
        chosen = order[np.linspace(0, n - 1, enough).astype(int)]
        weights = weights[chosen] * np.sqrt(n / enough)
        return replace(self, cells=cells.subset(chosen), weights=weights)

    def bounds(self) -> tuple[Array, Array]:
        """Of the free coefficients: the law's own, narrowed by the user's."""
        variables = [self.variables[i] for i in self.free]
        return np.array([v.min for v in variables]), np.array([v.max for v in variables])

    def near(self, start: Array) -> tuple[Array, Array]:
        """Bounds of the free coefficients near ``start`` (all): the law's own; what the scan left
        at its edge stays there, as the law degenerates beyond and has no optimum.
        """
        lower, upper = self.bounds()
        for place, i in enumerate(self.free):
            if i in self.nonlinear and not np.isfinite(upper[place] - lower[place]):
                reach = np.abs(sizes(self.variables[i]))
                if not 1.01 * reach.min() < abs(start[i]) < 0.99 * reach.max():
                    lower[place] = upper[place] = start[i]
        return lower, upper

    @property
    def slack_tolerance(self) -> float:
        """Force [N] with which the law counts as slack: of the clamp or the load cell's floor."""
        floor = self.slack.floor_found
        return max(SLACK_TOLERANCE, floor.limit if floor else 0.0)

    @cached_property
    def priors(self) -> tuple[Array, Array]:
        """Rows (r, all) and targets (r,) of the priors on free coefficients, as residuals [N]."""
        held = [(n, m, s) for n, m, s in self.terms.priors if self.names.index(n) in self.free]
        rows = np.zeros((len(held), len(self.base)))
        for row, (name, _, deviation) in zip(rows, held, strict=True):
            row[self.names.index(name)] = self.terms.noise / deviation
        return rows, np.array([self.terms.noise * m / s for _, m, s in held])

    def evaluate(self, coefficients: Array) -> tuple[Array, Array]:
        """Weighted residuals (m, n) and Jacobians (m, n, all) at coefficients (m, all)."""
        cells = self.cells
        tension, jacobian = forces_and_slopes(
            self.law, cells.pressure, cells.contraction, coefficients
        )
        tension -= cells.force
        tension *= -self.weights
        jacobian *= self.weights[:, None]
        return tension, jacobian

    def residuals(self, coefficients: Array) -> Array:
        """The residuals (m, n) of :meth:`evaluate` alone."""
        cells = self.cells
        tension = forces(self.law, cells.pressure, cells.contraction, coefficients)
        return self.weights * (cells.force - tension)

    def sums(self, coefficients: Array, second: bool = False) -> Sums:
        """The quadratic model at coefficients (m, all)."""
        cells = self.cells
        data = (cells.pressure, cells.contraction, cells.force, self.weights)
        return summed(self.law, data, self.priors, coefficients, second)

    def with_priors(self, coefficients: Array) -> tuple[Array, Array]:
        """As :meth:`evaluate`, with one more row for each prior."""
        residuals, jacobians = self.evaluate(coefficients)
        rows, targets = self.priors
        if not len(rows):
            return residuals, jacobians
        more = np.broadcast_to(rows, (len(coefficients), *rows.shape))
        return (
            np.concatenate([residuals, targets - coefficients @ rows.T], axis=1),
            np.concatenate([jacobians, more], axis=1),
        )

    def tension_where_slack(self, coefficients: Array) -> tuple[Array, Array]:
        """Tension (s,) at the slack cells and its derivatives (s, all)."""
        slack = self.slack
        tension, jacobian = forces_and_slopes(
            self.law, slack.pressure, slack.contraction, coefficients[None]
        )
        return tension[0], jacobian[0]

    def cost(self, coefficients: Array) -> float:
        """Sum of the losses, of squares for priors [N2]."""
        rows, targets = self.priors
        with np.errstate(over="ignore", invalid="ignore"):
            own = np.sum(self.terms.rho(self.residuals(coefficients[None])[0]))
            return float(own + np.sum((targets - rows @ coefficients) ** 2))

    def linear_in(
        self, values: Array, rows: Callable[[Array], tuple[Array, Array]]
    ) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Coefficients (m, all) with the linear ones 0, targets (m, n), columns (m, n, linear), and
        which of the m are finite, at nonlinear ``values`` (m, k); rows by ``evaluate`` or
        ``with_priors``.
        """
        c = np.tile(self.base, (len(values), 1))
        c[:, list(self.nonlinear)] = values
        with np.errstate(all="ignore"):
            target, jacobian = rows(c)
            columns = jacobian[:, :, self.linear]
            good = np.isfinite(target).all(axis=1) & np.isfinite(columns).all(axis=(1, 2))
        return c, target, columns, np.asarray(good)

    def triangles(self, values: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Coefficients (m, all), the linear ones 0; R (m, <= linear + 1, linear + 1) with |R (-c,
        1)| the residual of linear coefficients c (QR of columns and target, block by block); which
        are finite.
        """
        m, columns = len(values), [1 + i for i in self.linear]
        c = np.tile(self.base, (m, 1))
        c[:, list(self.nonlinear)] = values
        rows, targets = self.priors
        whole = np.concatenate([rows[:, self.linear], targets[:, None]], axis=1)
        found = np.repeat(whole[None], m, axis=0)
        if rows.any():
            found[:, :, -1] -= c @ rows.T
        good, size = np.ones(m, dtype=bool), len(columns) + 1
        cells = (self.cells.pressure, self.cells.contraction)
        with np.errstate(all="ignore"):
            for part, block in in_blocks(self.law, 1, *cells, c):
                block[:, 0] = self.cells.force[part] - block[:, 0]
                stack = np.empty((m, size, found.shape[1] + block.shape[2]))
                stack[:, :, : found.shape[1]] = found.transpose(0, 2, 1)
                for i, column in enumerate([*columns, 0]):
                    rows_of = stack[:, i, found.shape[1] :]
                    np.multiply(block[:, column], self.weights[part], out=rows_of)
                found = np.asarray(np.linalg.qr(stack.transpose(0, 2, 1), mode="r"))
                lost = ~np.isfinite(found).all(axis=(1, 2))
                good &= ~lost
                found[lost] = 0.0
        return c, found, good

    def project(self, values: Array) -> tuple[Array, Array]:
        """Costs (m,), all (m, c) with the best linear coefficients at ``values`` (m, k), no
        inequalities.
        """
        if self.terms.loss == "squares":
            c, whole, good = self.triangles(values)
            cost, c[:, self.linear], _ = projected(whole, good)
            return cost, c
        few = max(1, AT_ONCE // max(len(self.cells), 1))
        pairs = [self._reweighted(values[i : i + few]) for i in range(0, len(values), few)]
        return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])

    def _reweighted(self, values: Array) -> tuple[Array, Array]:
        c, target, columns, good = self.linear_in(values, self.with_priors)
        columns[~good], target[~good] = 0.0, 0.0
        n = len(self.cells)
        smallest = 1e-6 * self.size
        factors = np.ones_like(target)
        for _ in range(REWEIGHTINGS):
            parts, _ = least_squares(columns * factors[:, :, None], target * factors)
            rest = target - np.einsum("mnk,mk->mn", columns, parts)
            factors[:, :n] = self.terms.reweighting(rest[:, :n], smallest)
        c[:, self.linear] = parts
        cost = np.sum(self.terms.rho(rest[:, :n]), axis=1) + np.sum(rest[:, n:] ** 2, axis=1)
        return np.where(good, cost, np.inf), c


def summed(
    law: type[ForceLaw],
    data: Sequence[Array],
    priors: tuple[Array, Array],
    coefficients: Array,
    second: bool,
) -> Sums:
    """The quadratic model at coefficients (m, all), summed cell by cell in little memory. data :
    pressure, contraction, force, weight (n,), or (m, n) for a table of each row's own.
    """
    m, size = coefficients.shape
    cost, right = np.zeros(m), np.zeros((m, size))
    normal, bent = np.zeros((m, size, size)), np.zeros((m, len(second_places(law))))
    force, every = np.atleast_2d(data[2]), np.atleast_2d(data[3])
    with np.errstate(all="ignore"):
        for part, block in in_blocks(law, 2 if second else 1, data[0], data[1], coefficients):
            weights = every[:, part]
            rest = weights * (force[:, part] - block[:, 0])
            slopes = block[:, 1 : 1 + size]
            slopes *= weights[:, None]
            cost += np.einsum("mn,mn->m", rest, rest)
            right += (slopes @ rest[:, :, None])[:, :, 0]
            normal += slopes @ slopes.transpose(0, 2, 1)
            if second:
                bent += (block[:, 1 + size :] @ (weights * rest)[:, :, None])[:, :, 0]
        rows, targets = priors
        rest = targets - coefficients @ rows.T
        whole = np.zeros_like(normal)
        for (row, column), value in zip(second_places(law), bent.T, strict=True):
            whole[:, row, column] = whole[:, column, row] = -value
        return Sums(
            cost + np.sum(rest**2, axis=1), right + rest @ rows, normal + rows.T @ rows, whole
        )


def least_squares(columns: Array, target: Array) -> tuple[Array, Array]:
    """Least-norm solutions (m, k) of many small problems (m, n, k), in columns of unit length, and
    roots (m, k, k) of their covariances for errors of variance 1.
    """
    with np.errstate(over="ignore"):  # such columns count as zero
        norms: Array = np.asarray(np.linalg.norm(columns, axis=1))
    norms[norms == 0] = 1.0
    if not columns.shape[2]:
        return norms, np.empty((len(norms), 0, 0))
    u, s, vt = np.linalg.svd(columns / norms[:, None, :], full_matrices=False)
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=s > 1e-10 * s[:, :1])
    parts = np.einsum("mnk,mn->mk", u, target) * inverse
    root = vt.transpose(0, 2, 1) * inverse[:, None, :] / norms[:, :, None]
    return np.asarray(np.einsum("mkl,mk->ml", vt, parts) / norms), np.asarray(root)


def projected(triangles: Array, good: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Costs (m,) (infinite where not ``good``), best linear coefficients (m, k) and roots of their
    covariances (m, k, k), of what :meth:`LeastSquares.triangles` gives.
    """
    columns, target = triangles[:, :, :-1], triangles[:, :, -1]
    best, root = least_squares(columns, target)
    rest = target - np.einsum("mnk,mk->mn", columns, best)
    return np.where(good, np.sum(rest**2, axis=1), np.inf), best, root


@lru_cache(maxsize=64)
def sizes(variable: Variable) -> Array:
    """Values at which a nonlinear coefficient is scanned, the nominal size first."""
    magnitudes = variable.nominal * np.logspace(
        *DECADES, round((DECADES[1] - DECADES[0]) * POINTS_PER_DECADE) + 1
    )
    if np.isfinite(variable.max - variable.min):
        values = np.linspace(variable.min, variable.max, 2 * magnitudes.size + 1)[1:-1]
    else:
        values = np.concatenate([-magnitudes, magnitudes])
        values = values[(values >= variable.min) & (values <= variable.max)]
    if not values.size:  # narrow bounds beyond the scan
        values = np.array([variable.min if np.isfinite(variable.min) else variable.max])
    order = np.argsort(np.abs(values - variable.nominal), kind="stable")
    values = np.asarray(values[order])
    values.setflags(write=False)
    return values


# ---- scales of robust fits -----------------------------------------------------------------------
def spread(residuals: Array, fitted: int) -> float:
    """Standard deviation of normal errors: the median of the largest n - fitted residuals (as k are
    0).
    """
    size = np.sort(np.abs(residuals))[min(fitted, residuals.size - 1) :]
    return float(np.median(size) / 0.6745)


def robust_scale(terms: Terms, residuals: Array, fitted: int) -> float:
    """The factor s of the covariance s^2 (J^T J)^-1 of a robust fit (weighted residuals [N]).
    Huber, bisquare: P. Huber, Robust Statistics (1981), eq. 7.6.6, corrected for small samples.
    Absolute values: 1/(2 f(0)), the density f of the residuals by a normal kernel of Silverman's
    width (asymptotic; G. Bassett, R. Koenker, J. Am. Stat. Assoc. 73 (1978) 618-622).
    """
    n = residuals.size
    if terms.loss != "l1":
        slopes = np.clip(residuals, -terms.threshold, terms.threshold)
        bends = np.where(np.abs(residuals) <= terms.threshold, 1.0, 0.0)
        if terms.loss == "bisquare":
            near = terms.reweighting(residuals, 0.0)  # 1 - u2
            slopes, bends = residuals * near**2, near * (5 * near - 4)  # (1 - u2)(1 - 5 u2)
        mean = float(np.mean(bends))
        correction = 1 + fitted / n * float(np.var(bends)) / mean**2
        return float(correction * np.sqrt(np.sum(slopes**2) / (n - fitted)) / mean)
    width = 1.06 * spread(residuals, fitted) * n**-0.2
    if not width > 0:
        return 0.0  # most residuals are zero: the fit is exact
    density = np.mean(np.exp(-((residuals / width) ** 2) / 2)) / (width * np.sqrt(2 * np.pi))
    return float(1 / (2 * density) * np.sqrt(n / (n - fitted)))
