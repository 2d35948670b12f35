"""Profile intervals and bands of a law with one nonlinear coefficient, by a sweep over its whole
range.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from ...core.plausible import UnitWarning
from ..statistics import Array
from ..tables.force_table import ForceTable
from .least_squares import LeastSquares, sizes
from .optimum import Optimum

__all__ = ["Sweep"]

NEAR = np.concatenate([-np.geomspace(8, 0.05, 24), [0.0], np.geomspace(0.05, 8, 24)])
"""Standard errors from the optimum at which the nonlinear coefficient is tried, beside its scan."""
ZOOMS = 5
POINTS = 13


@dataclass(frozen=True, eq=False)
class Sweep:
    """Costs and ends of all linear coefficients over values q of the nonlinear one.

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
        near = best + (error if np.isfinite(error) else 0.1 * abs(best)) * NEAR
        wide = sizes(variable)
        reach = np.abs(wide)
        if not np.isfinite(variable.max - variable.min):
            near = near[(np.abs(near) >= reach.min()) & (np.abs(near) <= reach.max())]
        near = near[(near >= variable.min) & (near <= variable.max)]
        values = np.unique(np.concatenate([near, wide, [best]]))
        return cls(problem, place, best, values, _projected(problem, values))

    def end(self, free: int, side: float, limit: float) -> tuple[float, str]:
        """End of the interval of the coefficient ``problem.free[free]``, and why it is infinite."""
        i = self.problem.free[free]
        if i == self.place:
            return self._own_end(side, limit)
        column = self.problem.linear.index(i)
        values, results = self.values, self.results
        for _ in range(ZOOMS):
            reached = _reached(results, column, side, limit)
            j = int(np.argmax(reached))
            if values is self.values and self._at_edge(j):
                return side * np.inf, self._open_words()
            low, high = values[max(j - 1, 0)], values[min(j + 1, len(values) - 1)]
            values = np.linspace(low, high, POINTS)
            results = _projected(self.problem, values)
        reached = _reached(results, column, side, limit)
        return float(side * reached.max()), ""

    def band(self, p: Array, kappa: Array, limits: Array) -> tuple[Array, Array]:
        """Lowest and highest force (n,) at places (n,) over all laws that cost no more than
        ``limits`` (n,).
        """
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

    def _own_end(self, side: float, limit: float) -> tuple[float, str]:
        inside = np.nonzero(self.results[0] <= limit)[0]
        last = (
            int(inside[-1 if side > 0 else 0]) if inside.size else int(np.argmin(self.results[0]))
        )
        beyond = last + int(side)
        if not 0 <= beyond < len(self.values):
            variable = self.problem.variables[self.place]
            bound = variable.max if side > 0 else variable.min
            return float(bound), "" if np.isfinite(bound) else self._open_words()
        low, high = self.values[last], self.values[beyond]
        for _ in range(40):
            middle = (low + high) / 2
            if _projected(self.problem, np.array([middle]))[0][0] <= limit:
                low = middle
            else:
                high = middle
            if abs(high - low) <= 1e-6 * abs(high - self.best):
                break
        return float((low + high) / 2), ""

    def _at_edge(self, j: int) -> bool:
        """Whether the law degenerates at this value: the ends of the scan, and where it passes
        zero.
        """
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


def _reached(results: tuple[Array, Array, Array], column: int, side: float, limit: float) -> Array:
    """How far to a side the coefficient of ``column`` may go at each value (m,); -inf where the
    cost is too high.
    """
    cost, best, root = results
    room, variance = limit - cost, np.sum(root**2, axis=2)
    with np.errstate(invalid="ignore"):
        far = side * best[:, column] + np.sqrt(np.maximum(room, 0.0) * variance[:, column])
    return np.where((room >= 0) & np.isfinite(far), far, -np.inf)


def _projected(problem: LeastSquares, values: Array) -> tuple[Array, Array, Array]:
    _, whole, good = problem.triangles(values[:, None])
    columns, target = whole[:, :, :-1], whole[:, :, -1]
    norms = np.linalg.norm(columns, axis=1)
    norms = np.where(norms > 0, norms, 1.0)
    u, s, vt = np.linalg.svd(columns / norms[:, None, :], full_matrices=False)
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=s > 1e-10 * s[:, :1])
    along = np.einsum("mnk,mn->mk", u, target)
    best = np.einsum("mkl,mk->ml", vt, along * inverse) / norms
    rest = target - np.einsum("mnk,mk->mn", u, along * (inverse > 0))
    root = vt.transpose(0, 2, 1) * inverse[:, None, :] / norms[:, :, None]
    cost = np.sum(rest**2, axis=1)
    return np.where(good, cost, np.inf), np.asarray(best), np.asarray(root)
