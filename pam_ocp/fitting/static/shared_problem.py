"""The least-squares problem of one law on several muscles that share coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...muscles.law import ForceLaw
from ..statistics import Array
from .least_squares import ENOUGH, PLAIN, LeastSquares, Sums, Terms, least_squares, sizes

__all__ = ["JointProblem"]

FEWEST = 100
"""Cells of each table that a scan looks at."""


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Fits of one law to several tables; ``places[i]`` says where in z each free coefficient of
    table i stands (in the order of ``parts[i].free``)."""

    parts: tuple[LeastSquares, ...]
    places: tuple[NDArray[np.intp], ...]
    names: tuple[str, ...] = ()
    """Of the unknowns."""

    @property
    def law(self) -> type[ForceLaw]:
        return self.parts[0].law

    @property
    def terms(self) -> Terms:
        """Plain squares."""
        return PLAIN

    @property
    def limited(self) -> bool:
        """Whether there are inequalities other than the law's own."""
        return any(p.limited for p in self.parts)

    @cached_property
    def count(self) -> int:
        """Number of unknowns."""
        return 1 + max(int(p.max()) for p in self.places)

    @property
    def free(self) -> range:
        """Positions of the unknowns: all are free."""
        return range(self.count)

    @cached_property
    def size(self) -> float:
        """Norm of the weighted forces of all tables [N]."""
        return float(np.sqrt(sum(p.size**2 for p in self.parts)))

    @property
    def cells(self) -> int:
        """Number of taut cells of all tables."""
        return sum(len(p.cells) for p in self.parts)

    @cached_property
    def nonlinear(self) -> list[int]:
        """Positions in z of the coefficients in which the law is not linear."""
        found = {
            int(z)
            for part, place in zip(self.parts, self.places, strict=True)
            for i, z in zip(part.free, place, strict=True)
            if i in part.nonlinear
        }
        return sorted(found)

    def coefficients(self, z: Array) -> list[Array]:
        """All coefficients of each law (m, all) at unknowns (m, count)."""
        found = []
        for part, place in zip(self.parts, self.places, strict=True):
            c = np.tile(part.base, (len(z), 1))
            c[:, list(part.free)] = z[:, place]
            found.append(c)
        return found

    def evaluate(self, z: Array) -> tuple[Array, Array]:
        """Weighted residuals (m, n) and Jacobians (m, n, count) at unknowns (m, count)."""
        residuals, jacobians = [], []
        for part, place, c in zip(self.parts, self.places, self.coefficients(z), strict=True):
            rest, slopes = part.evaluate(c)
            wide = np.zeros((*rest.shape, self.count))
            wide[:, :, place] = slopes[:, :, list(part.free)]
            residuals.append(rest)
            jacobians.append(wide)
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)

    def sums(self, z: Array, second: bool = False) -> Sums:
        """The quadratic model at unknowns (m, count)."""
        m, size = len(z), self.count
        found = Sums(
            np.zeros(m), np.zeros((m, size)), np.zeros((m, size, size)), np.zeros((m, size, size))
        )
        for part, place, c in zip(self.parts, self.places, self.coefficients(z), strict=True):
            own, free = part.sums(c, second), list(part.free)
            block = (slice(None), place[:, None], place[None, :])
            found.cost[:] += own.cost
            found.right[:, place] += own.right[:, free]
            found.normal[block] += own.normal[:, free][:, :, free]
            found.second[block] += own.second[:, free][:, :, free]
        return found

    def cost(self, z: Array) -> float:
        """Weighted sum of squares [N2]."""
        return float(self.sums(z[None]).cost[0])

    def with_priors(self, z: Array) -> tuple[Array, Array]:
        """As :meth:`evaluate`: there are no priors on what several tables share."""
        return self.evaluate(z)

    def project(self, values: Array) -> tuple[Array, Array]:
        """Best linear unknowns for nonlinear ``values`` (m, k): costs (m,), z (m, count)."""
        z, good = np.zeros((len(values), self.count)), np.ones(len(values), dtype=bool)
        z[:, self.nonlinear] = values
        linear = [i for i in range(self.count) if i not in self.nonlinear]
        rows = []
        for part, place in zip(self.parts, self.places, strict=True):
            at = dict(zip(part.free, place.tolist(), strict=True))
            _, whole, finite = part.triangles(z[:, [at[i] for i in part.nonlinear]])
            wide = np.zeros((*whole.shape[:2], len(linear) + 1))
            wide[:, :, [*(linear.index(at[i]) for i in part.linear), -1]] = whole
            rows.append(wide)
            good &= finite
        stacked = np.concatenate(rows, axis=1)
        columns, target = stacked[:, :, :-1], stacked[:, :, -1]
        z[:, linear] = parts = least_squares(columns, target)[0]
        cost = np.sum((target - np.einsum("mnk,mk->mn", columns, parts)) ** 2, axis=1)
        return np.where(good, cost, np.inf), z

    def bounds(self) -> tuple[Array, Array]:
        """Of z: the narrowest of all tables that share an unknown."""
        low, high = np.full(self.count, -np.inf), np.full(self.count, np.inf)
        for part, place in zip(self.parts, self.places, strict=True):
            for i, z in zip(part.free, place, strict=True):
                low[z] = max(low[z], part.variables[i].min)
                high[z] = min(high[z], part.variables[i].max)
        return low, high

    @cached_property
    def scales(self) -> list[Array]:
        """Values at which each nonlinear unknown is scanned."""
        variables: dict[int, Variable] = {}
        for part, place in zip(self.parts, self.places, strict=True):
            variables |= {int(z): part.variables[i] for i, z in zip(part.free, place, strict=True)}
        return [sizes(variables[z]) for z in self.nonlinear]

    def near(self, start: Array) -> tuple[Array, Array]:
        """Bounds within the reach of the scan: beyond it a law degenerates,
        and nothing is reached.
        """
        low, high = self.bounds()
        for i, scale in zip(self.nonlinear, self.scales, strict=True):
            if not np.isfinite(high[i] - low[i]):
                reach = np.sort(np.copysign([np.abs(scale).min(), np.abs(scale).max()], start[i]))
                low[i], high[i] = max(low[i], reach[0]), min(high[i], reach[1])
        return low, high

    def thinned(self) -> JointProblem:
        """The problem on so many cells as a scan needs."""
        enough = max(ENOUGH // len(self.parts), FEWEST)
        return replace(self, parts=tuple(p.thinned(enough) for p in self.parts))

    def weighted(self, factors: Sequence[float]) -> JointProblem:
        """The same with all weights of each table multiplied."""
        parts = (
            replace(p, weights=p.weights * f) for p, f in zip(self.parts, factors, strict=True)
        )
        return replace(self, parts=tuple(parts))
