"""A start that wrong cells cannot pull: least trimmed squares.

The cells with the largest residuals are left out, up to 15 % of all, and the coefficients sought
whose other cells fit best (P. Rousseeuw, K. van Driessen, Computing LTS regression for large data
sets, Data Min. Knowl. Disc. 12 (2006) 29-45). At most half of a contraction level may be left out:
a law that misses a whole level does not bend far enough, which is no error of measurement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError
from ..statistics import Array
from .least_squares import BISQUARE, LeastSquares, least_squares
from .local_optimum import local_optimum

__all__ = ["SUBSETS", "robust_start", "trimmed_start"]

TRIMMED = 0.15
"""Part of the cells that may be wrong."""
SUBSETS = 400
"""Random subsets in all."""
NONLINEAR = (20, 60)
"""Values of one nonlinear coefficient that they are spread over; of several together."""
FOLLOWED = 6
"""How many of the best are followed to the end."""
STEPS = 40


def robust_start(problem: LeastSquares) -> tuple[Array, float]:
    """Coefficients (all) from which to seek the optimum of a bisquare, and where it ends [N].

    Twice: what lies beyond the end at first is taken out before scale and start are found again,
    so that wrong cells do not change how many of the others are left out.

    Raises FitError where no subset gives a finite law.
    """
    least = 1e-9 * problem.size
    within = replace(problem, terms=replace(problem.terms, loss="bisquare"))
    for _ in range(2):
        starts, scale = trimmed_start(within)
        edge = BISQUARE * max(scale, least)
        terms = replace(problem.terms, threshold=edge)
        found = local_optimum(replace(within, terms=terms), starts[0], SUBSETS).coefficients
        near = np.abs(problem.evaluate(found[None])[0][0]) < edge
        if near.all() or int(near.sum()) <= len(problem.free):
            break
        within = replace(within, cells=problem.cells.subset(near), weights=problem.weights[near])
    return found, edge


def trimmed_start(problem: LeastSquares) -> tuple[Array, float]:
    """Coefficients (m, all), the best first, and the standard deviation of the cells kept [N].

    The deviation is that of normal errors whose largest were left out.

    Raises FitError where no subset gives a finite law.
    """
    trim = _Trim.of(problem)
    followed = [_followed(problem, c, trim) for c in _candidates(problem, trim)]
    followed.sort(key=lambda pair: pair[1])
    kept = len(problem.cells) - trim.count
    freedom = max(kept - len(problem.free), 1)
    return np.array([c for c, _ in followed]), float(
        np.sqrt(followed[0][1] / freedom) * _normal_factor(trim.count / len(problem.cells))
    )


def _normal_factor(share: float) -> float:
    """Standard deviation of normal errors over that of those without the largest ``share``."""
    from scipy.special import ndtri

    if not share:
        return 1.0
    q = float(ndtri(1 - share / 2))
    density = float(np.exp(-(q**2) / 2) / np.sqrt(2 * np.pi))
    return float((1 - 2 * q * density / (1 - share)) ** -0.5)


@dataclass(frozen=True, eq=False)
class _Trim:
    """Which cells are left out: the ``count`` largest residuals, at most half of a level.

    groups : the cells of each contraction level.
    """

    count: int
    groups: tuple[NDArray[np.intp], ...]

    @classmethod
    def of(cls, problem: LeastSquares) -> _Trim:
        level = problem.cells.levels()
        groups = tuple(np.nonzero(level == i)[0] for i in range(level.max() + 1))
        spare = max(len(problem.cells) - len(problem.free) - 1, 0)
        allowed = sum(g.size // 2 for g in groups)
        return cls(min(int(TRIMMED * len(problem.cells)), spare, allowed), groups)

    def kept(self, residuals: Array) -> NDArray[np.bool_]:
        """For each row (m, n) of residuals."""
        size = np.abs(residuals)
        open_ = np.zeros_like(size)
        for group in self.groups:
            here = size[:, group]
            rank = np.argsort(np.argsort(-here, axis=1), axis=1)
            open_[:, group] = np.where(rank < group.size // 2, here, -1.0)
        order = np.argsort(-open_, axis=1, kind="stable")[:, : self.count]
        result = np.ones(size.shape, dtype=bool)
        np.put_along_axis(result, order, False, axis=1)
        return result

    def cost(self, residuals: Array) -> Array:
        """Sum of squares (m,) of the cells kept."""
        with np.errstate(over="ignore"):
            squares = np.where(self.kept(residuals), residuals, 0.0) ** 2
            return np.asarray(np.sum(squares, axis=1))


def _candidates(problem: LeastSquares, trim: _Trim) -> Array:
    """The best coefficients (FOLLOWED, all) through random subsets, after two improvements."""
    random = np.random.default_rng(19840701)
    values = _nonlinear_values(problem, random)
    c, target, columns, good = problem.linear_in(values, problem.evaluate)
    if not good.any():
        raise FitError(f"the {problem.law.name} law gives no finite force anywhere in the scan")
    per = max(SUBSETS // int(good.sum()), 10)
    n, k = len(problem.cells), max(len(problem.linear), 1)
    found, costs = [], []
    for row, y, a in zip(c[good], target[good], columns[good], strict=True):
        drawn = np.argsort(random.random((per, n)), axis=1)[:, :k]
        parts, _ = least_squares(a[drawn], y[drawn])
        for _ in range(3):
            weights = trim.kept(y - parts @ a.T).astype(float)
            parts, _ = least_squares(a * weights[:, :, None], y * weights)
        cost = trim.cost(y - parts @ a.T)
        best = int(np.argmin(cost))
        whole = row.copy()
        whole[problem.linear] = parts[best]
        found.append(whole)
        costs.append(cost[best])
    return np.array(found)[np.argsort(costs)[:FOLLOWED]]


def _nonlinear_values(problem: LeastSquares, random: np.random.Generator) -> Array:
    scales = problem.scales
    if not scales:
        return np.zeros((1, 0))
    if len(scales) == 1:
        ordered = np.sort(scales[0])
        places = np.linspace(0, ordered.size - 1, NONLINEAR[0]).astype(int)
        return np.asarray(ordered[places][:, None])
    return np.stack([random.choice(s, NONLINEAR[1]) for s in scales], axis=1)


def _followed(problem: LeastSquares, start: Array, trim: _Trim) -> tuple[Array, float]:
    """Gauss-Newton steps over all coefficients on the cells kept, as long as their squares fall."""
    free = list(problem.free)
    low = np.array([problem.variables[i].min for i in free])
    high = np.array([problem.variables[i].max for i in free])
    c = start.copy()
    c[free] = np.clip(c[free], low, high)
    rest, slopes = (a[0] for a in problem.evaluate(c[None]))
    cost = float(trim.cost(rest[None])[0])
    for _ in range(STEPS):
        kept = trim.kept(rest[None])[0]
        step = least_squares(slopes[kept][:, free][None], rest[kept][None])[0][0]
        before = cost
        for part in (1.0, 0.5, 0.25, 0.1):
            trial = c.copy()
            trial[free] = np.clip(c[free] + part * step, low, high)
            with np.errstate(all="ignore"):
                new, new_slopes = (a[0] for a in problem.evaluate(trial[None]))
            if not (np.all(np.isfinite(new)) and np.all(np.isfinite(new_slopes))):
                continue
            found = float(trim.cost(new[None])[0])
            if found < cost:
                c, rest, slopes, cost = trial, new, new_slopes, found
                break
        if cost > before * (1 - 1e-10):
            break
    return c, cost
