"""The least-squares problem of one law on several muscles that share coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError
from ...core.variables import Variable
from ..statistics import Array, SolverStatistics
from .descent import descend
from .least_squares import AT_ONCE, LeastSquares, Sums, least_squares, sizes
from .local_optimum import STATIONARY, cosine, ending
from .search import ENOUGH, thinned

__all__ = ["JointOptimum", "JointProblem"]

SCANNED = 600
"""Scan points for two or more nonlinear coefficients (always the same ones)."""
FEWEST = 100
"""Cells of each table that a scan looks at."""
POLISHED = 12
"""How many of the best are followed up."""


@dataclass(frozen=True, eq=False)
class JointOptimum:
    """Unknowns z and what they cost [N2]."""

    z: Array
    cost: float
    solver: SolverStatistics


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Fits of one law to several tables; ``places[i]`` says where in z each free coefficient of
    table i stands (in the order of ``parts[i].free``)."""

    parts: tuple[LeastSquares, ...]
    places: tuple[NDArray[np.intp], ...]

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

    def project(self, values: Array) -> tuple[Array, Array]:
        """Best linear unknowns for nonlinear ``values`` (m, k): costs (m,), z (m, count)."""
        few = max(1, AT_ONCE // max(self.cells, 1))
        pairs = [self._project(values[i : i + few]) for i in range(0, len(values), few)]
        return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])

    def _project(self, values: Array) -> tuple[Array, Array]:
        z = np.zeros((len(values), self.count))
        z[:, self.nonlinear] = values
        linear = [i for i in range(self.count) if i not in self.nonlinear]
        with np.errstate(all="ignore"):
            target, jacobian = self.evaluate(z)
            columns = jacobian[:, :, linear]
            good = np.isfinite(target).all(axis=1) & np.isfinite(columns).all(axis=(1, 2))
        columns[~good], target[~good] = 0.0, 0.0
        parts = least_squares(columns, target)
        cost = np.sum((target - np.einsum("mnk,mk->mn", columns, parts)) ** 2, axis=1)
        z[:, linear] = parts
        return np.where(good, cost, np.inf), z

    def bounds(self) -> tuple[Array, Array]:
        """Of z: the narrowest of all tables that share an unknown."""
        low, high = np.full(self.count, -np.inf), np.full(self.count, np.inf)
        for part, place in zip(self.parts, self.places, strict=True):
            for i, z in zip(part.free, place, strict=True):
                low[z] = max(low[z], part.variables[i].min)
                high[z] = min(high[z], part.variables[i].max)
        return low, high

    # ---- the optimum ------------------------------------------------------------------------
    def minimise(self, starts: Sequence[Array] = ()) -> JointOptimum:
        """The best of many scan points (and of ``starts``, values of the nonlinear unknowns),
        followed up.
        """
        points = self._scan_points()
        if len(starts):
            points = np.concatenate([points, np.array(starts).reshape(len(starts), -1)])
        enough = max(ENOUGH // len(self.parts), FEWEST)
        few = JointProblem(tuple(thinned(p, enough) for p in self.parts), self.places)
        costs, z = few.project(points)
        if not np.any(np.isfinite(costs)):
            raise FitError("the law gives no finite force anywhere in the scan; check the tables")
        best = np.argsort(costs)[: POLISHED if self.nonlinear else 1]
        found = self.local_optima(z[best], len(points))
        stationary = [o for o in found if o.solver.gradient <= STATIONARY]
        if not stationary:
            raise FitError(
                f"the joint fit came to no stationary point ({found[0].solver.status}); share "
                "fewer coefficients, or hold the nonlinear ones with fixed=..."
            )
        return min(stationary, key=lambda o: o.cost)

    @cached_property
    def _scales(self) -> list[Array]:
        """Values at which each nonlinear unknown is scanned."""
        variables: dict[int, Variable] = {}
        for part, place in zip(self.parts, self.places, strict=True):
            variables |= {int(z): part.variables[i] for i, z in zip(part.free, place, strict=True)}
        return [sizes(variables[z]) for z in self.nonlinear]

    def _near(self, start: Array) -> tuple[Array, Array]:
        """Bounds within the reach of the scan: beyond it a law degenerates,
        and nothing is reached.
        """
        low, high = self.bounds()
        for i, scale in zip(self.nonlinear, self._scales, strict=True):
            if not np.isfinite(high[i] - low[i]):
                reach = np.sort(np.copysign([np.abs(scale).min(), np.abs(scale).max()], start[i]))
                low[i], high[i] = max(low[i], reach[0]), min(high[i], reach[1])
        return low, high

    def _scan_points(self) -> Array:
        scales = self._scales
        if len(scales) < 2:
            return np.sort(scales[0])[:, None] if scales else np.zeros((1, 0))
        random = np.random.default_rng(20150101)
        return np.stack([random.choice(s, SCANNED) for s in scales], axis=1)

    def local_optima(
        self, starts: Array, scanned: int = 0, held: int | None = None
    ) -> list[JointOptimum]:
        """The optima next to ``starts`` (m, size); unknown number ``held`` is kept where it is."""
        limits = [self._near(start) for start in starts]
        low, high = (np.array([pair[i] for pair in limits]) for i in (0, 1))
        if held is not None:
            low[:, held] = high[:, held] = starts[:, held]
        ended = descend(self, starts, low, high)
        found = []
        for z, cost, steps, resting in zip(
            ended.coefficients, ended.cost, ended.steps, ended.resting, strict=True
        ):
            rest, slopes = (a[0] for a in self.evaluate(z[None]))
            gradient = cosine(rest, slopes[:, ~resting], self.size)
            at_bound = tuple(str(i) for i in np.nonzero(resting)[0] if i != held)
            statistics = SolverStatistics(ending(gradient), int(steps), gradient, scanned, at_bound)
            found.append(JointOptimum(z, float(cost), statistics))
        return found

    def weighted(self, factors: Sequence[float]) -> JointProblem:
        """The same with all weights of each table multiplied."""
        parts = (
            replace(p, weights=p.weights * f) for p, f in zip(self.parts, factors, strict=True)
        )
        return JointProblem(tuple(parts), self.places)
