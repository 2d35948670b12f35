"""Free runs as a function of a plant's parameters, with exact sensitivities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.rosenbrock import ros2
from ...plants.plant import Plant
from ..statistics import Array
from .experiment import Group
from .runs import Runs

__all__ = ["ASTRAY", "Rollout"]

WILD = 1e3
"""A run whose sensitivity (spreads per unit of a scaled unknown) exceeds this steers no step.

It lies beside a parting of the ways (stick or slide) or is unstable: its slope holds for changes
far smaller than any step and would outweigh all other runs. Its error still counts.
"""
ASTRAY = 1e6
"""Stands for a residual that is no number: a motion that diverged is a bad one."""


class Rollout:
    """Runs, residuals and their exact Jacobian in the scaled unknowns z."""

    def __init__(self, plant: Plant, runs: Runs, unknowns: Sequence[Group]) -> None:
        self._runs = runs
        self._whole: dict[str, ca.Function] = {}
        n, k = runs.measured.shape[:2]
        spread = runs.measured.reshape(n * k, -1).std(axis=0)
        nominal = np.array([plant.variable(v).nominal for v in runs.names])
        self._spread = np.where(spread > 1e-9 * nominal, spread, nominal)
        self._nx, self._nz = len(plant.states), len(unknowns)
        self._move, self._tangent, self._read, self._slope = _functions(plant, runs, unknowns)
        self._inputs = [np.ascontiguousarray(np.concatenate(a).T) for a in (runs.begin, runs.end)]

    def predicted(self, z: Array) -> Array:
        """(n, K, ny) in SI."""
        x = self._rolled(self._move, self._runs.x0.T, z)
        return self._shaped(self._read.map(x.shape[1])(x, self._late, z))

    def residuals(self, z: Array) -> Array:
        """Predicted minus measured in units of the spread; their mean square is summed."""
        error = (self.predicted(z) - self._runs.measured) / self._spread
        return np.nan_to_num(
            error.ravel() * self._weight, nan=ASTRAY, posinf=ASTRAY, neginf=-ASTRAY
        )

    def jacobian(self, z: Array) -> Array:
        """d(residuals)/dz by sensitivities along the runs; zero for those that steer no step."""
        scaled, wild = self.sensitivities(z)
        scaled[wild] = 0.0
        return np.asarray(scaled.reshape(-1, self._nz) * self._weight)

    def sensitivities(self, z: Array) -> tuple[Array, NDArray[np.bool_]]:
        """d(prediction)/dz in spreads (n, K ny, nz),
        and which runs (n,) have none to be trusted.
        """
        n, nx, nz = len(self._runs.x0), self._nx, self._nz
        zero = np.zeros((nx * nz, n))
        both = self._rolled(self._tangent, np.vstack([self._runs.x0.T, zero]), z)
        slopes = self._slope.map(both.shape[1])(both[:nx], both[nx:], self._late, z)
        ny = len(self._spread)
        rows = np.asarray(slopes).T.reshape(-1, nz, ny).transpose(0, 2, 1)
        scaled = (
            rows.reshape(n, -1, nz, order="C") / np.tile(self._spread, len(self._runs.t))[:, None]
        )
        wild = ~(np.abs(scaled).max(axis=(1, 2), initial=0.0) < WILD)
        return np.asarray(scaled), np.asarray(wild)

    @property
    def _weight(self) -> float:
        return 1 / float(np.sqrt(self._runs.measured.size))

    @property
    def _late(self) -> Array:
        """The inputs at the samples."""
        return self._inputs[1][:, self._runs.steps - 1 :: self._runs.steps]

    def _rolled(self, step: ca.Function, start: Array, z: Array) -> Array:
        """The states at the samples of all runs, side by side."""
        n = start.shape[1]
        if step.name() not in self._whole:
            along = step.mapaccum(len(self._runs.t) * self._runs.steps)
            self._whole[step.name()] = along.map(n)
        found = self._whole[step.name()](start, *self._inputs, z)
        return np.asarray(np.asarray(found)[:, self._runs.steps - 1 :: self._runs.steps])

    def _shaped(self, columns: Any) -> Array:
        n, k = self._runs.measured.shape[:2]
        return np.asarray(np.asarray(columns).T.reshape(n, k, -1))


def _functions(
    plant: Plant, runs: Runs, unknowns: Sequence[Group]
) -> tuple[ca.Function, ca.Function, ca.Function, ca.Function]:
    """One step; one step with sensitivities; what is measured; its sensitivities."""
    nx, nu, nz = len(plant.states), len(plant.inputs), len(unknowns)
    z, x, s = ca.SX.sym("z", nz), ca.SX.sym("x", nx), ca.SX.sym("s", nx, nz)
    u, late = ca.SX.sym("u", nu), ca.SX.sym("late", nu)
    p = ca.SX(plant.vector("parameter"))
    for j, group in enumerate(unknowns):
        for member in group.members:
            p[member] = z[j] * group.scale
    after = ros2(
        lambda z: plant.function(z, u, p)[0], lambda z: plant.function(z, late, p)[0], x, runs.step
    )
    slopes = ca.jacobian(after, x) @ s + ca.jacobian(after, z)
    seen = ca.vertcat(*(plant.expression(name) for name in runs.names))
    y = ca.Function("seen", [plant.x, plant.u, plant.p], [seen])(x, u, p)
    y_slopes = ca.jacobian(y, x) @ s + ca.jacobian(y, z)
    column = ca.vec(s)
    return (
        ca.Function("move", [x, u, late, z], [after]),
        ca.Function(
            "tangent", [ca.vertcat(x, column), u, late, z], [ca.vertcat(after, ca.vec(slopes))]
        ),
        ca.Function("read", [x, u, z], [y]),
        ca.Function("slope", [x, column, u, z], [ca.densify(ca.vec(y_slopes))]),
    )
