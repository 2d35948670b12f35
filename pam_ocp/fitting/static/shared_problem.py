"""The least-squares problem of one law on several muscles that share coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError
from ...core.variables import Variable
from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..statistics import Array, SolverStatistics
from .least_squares import LeastSquares, least_squares, sizes
from .local_optimum import STATIONARY, cosine

__all__ = ["JointOptimum", "JointProblem"]

SCANNED = 600
"""Scan points for two or more nonlinear coefficients (always the same ones)."""
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

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 1 + max(int(p.max()) for p in self.places)

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
        """All coefficients of each law (m, all) at unknowns (m, size)."""
        found = []
        for part, place in zip(self.parts, self.places, strict=True):
            c = np.tile(part.base, (len(z), 1))
            c[:, list(part.free)] = z[:, place]
            found.append(c)
        return found

    def evaluate(self, z: Array) -> tuple[Array, Array]:
        """Weighted residuals (m, n) and Jacobians (m, n, size) at unknowns (m, size)."""
        residuals, jacobians = [], []
        for part, place, c in zip(self.parts, self.places, self.coefficients(z), strict=True):
            rest, slopes = part.evaluate(c)
            wide = np.zeros((*rest.shape, self.size))
            wide[:, :, place] = slopes[:, :, list(part.free)]
            residuals.append(rest)
            jacobians.append(wide)
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)

    def cost(self, z: Array) -> float:
        """Weighted sum of squares [N2]."""
        return float(np.sum(self.evaluate(z[None])[0] ** 2))

    def project(self, values: Array) -> tuple[Array, Array]:
        """Best linear unknowns for nonlinear ``values`` (m, k): costs (m,), z (m, size)."""
        z = np.zeros((len(values), self.size))
        z[:, self.nonlinear] = values
        linear = [i for i in range(self.size) if i not in self.nonlinear]
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
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
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
        costs, z = self.project(points)
        if not np.any(np.isfinite(costs)):
            raise FitError("the law gives no finite force anywhere in the scan; check the tables")
        found = [
            self.local_optimum(z[i], len(points))
            for i in np.argsort(costs)[: POLISHED if self.nonlinear else 1]
        ]
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

    @cached_property
    def _solver(self) -> Nlp:
        """min |residuals/unit|^2/2 over scaled unknowns."""
        z, scale, unit = ca.MX.sym("z", self.size), ca.MX.sym("scale", self.size), ca.MX.sym("unit")
        weights = ca.MX.sym("weights", self.cells)
        objective, first = ca.MX(0), 0
        for part, place in zip(self.parts, self.places, strict=True):
            n, cells = len(part.cells), part.cells
            lift = ca.DM(len(part.base), self.size)
            for i, column in zip(part.free, place, strict=True):
                lift[i, int(column)] = 1
            c = ca.DM(part.base) + lift @ (scale * z)
            tension = part.law.function().map(n)(
                ca.DM(cells.pressure).T, ca.DM(cells.contraction).T, ca.repmat(c, 1, n)
            )[0]
            rest = weights[first : first + n].T * (tension - ca.DM(cells.force).T) / unit
            objective += ca.sumsqr(rest) / 2
            first += n
        options = quiet_ipopt(tol=1e-11, max_iter=300, honor_original_bounds="yes")
        nlp: Any = {"x": z, "p": ca.vertcat(scale, unit, weights), "f": objective}
        return nlpsol("joint", "ipopt", nlp, options)

    def local_optimum(
        self, start: Array, scanned: int = 0, held: int | None = None
    ) -> JointOptimum:
        """The optimum next to ``start``; with unknown number ``held`` kept where it is."""
        low, high = self._near(start)
        start = np.clip(start, low, high)
        if held is not None:
            low[held] = high[held] = start[held]
        residuals, jacobian = (a[0] for a in self.evaluate(start[None]))
        size = float(np.sqrt(sum(np.sum((p.weights * p.cells.force) ** 2) for p in self.parts)))
        norms = np.linalg.norm(jacobian, axis=0)
        scale = np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 1.0)
        unit = max(float(np.linalg.norm(residuals)), 1e-9 * size)
        weights = np.concatenate([p.weights for p in self.parts])
        answer = self._solver(
            x0=start / scale,
            p=np.concatenate([scale, [unit], weights]),
            lbx=low / scale,
            ubx=high / scale,
        )
        z = np.clip(np.asarray(answer["x"]).ravel() * scale, low, high)
        statistics = self._solver.stats()
        tight = (z - low <= 1e-6 * np.abs(z)) | (high - z <= 1e-6 * np.abs(z))
        rest, slopes = (a[0] for a in self.evaluate(z[None]))
        return JointOptimum(
            z,
            float(rest @ rest),
            SolverStatistics(
                str(statistics["return_status"]),
                int(statistics["iter_count"]),
                cosine(rest, slopes[:, ~tight], size),
                scanned,
                tuple(str(i) for i in np.nonzero(tight)[0] if i != held),
            ),
        )

    def weighted(self, factors: Sequence[float]) -> JointProblem:
        """The same with all weights of each table multiplied."""
        parts = (
            replace(p, weights=p.weights * f) for p, f in zip(self.parts, factors, strict=True)
        )
        same = JointProblem(tuple(parts), self.places)
        same.__dict__["_solver"] = self._solver  # weights are its parameters
        return same
