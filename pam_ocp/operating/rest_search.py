"""The equations of rest and conditions, and the search for their solution within the bounds."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..plants.plant import Plant
from .operating_point import OperatingPoint

__all__ = ["TOLERANCE", "Search"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-9
"""Largest residual of an equilibrium, in units of nominal (per second)."""
TAUT = 3
"""Starts under high pressures."""
ROUGH = 1e-6
"""Largest residual from which Newton's method is asked for the rest."""


class Search:
    """The residual of rest and conditions, scaled by nominals, and its solution by IPOPT.

    Unknown are z = (states, inputs, free parameters). Held memories that are ``pinned`` have a
    value in place of their equation; those that are not have neither, and need a condition more.
    """

    def __init__(
        self,
        plant: Plant,
        targets: Mapping[str, float],
        free: Sequence[str] = (),
        more: Mapping[str, ca.SX] | None = None,
        pinned: Mapping[str, float] | None = None,
    ) -> None:
        more, pinned = more or {}, pinned or {}
        self.plant, self.targets, self.free = plant, list(targets), list(free)
        self.more, self.pinned = dict(more), dict(pinned)
        rates = [v for v in plant.states if v.memory != "held"]
        given = {**pinned, **targets}
        self.names = [f"der({v.name})" for v in rates] + list(given)
        # an expression has no nominal: its value says its size
        sizes = [
            abs(v) or 1.0 if n in more else plant.variable(n).nominal for n, v in given.items()
        ]
        rows = [more[n] if n in more else plant.expression(n) for n in self.names]
        values = ca.SX.sym("values", len(given))
        scale = np.array([v.nominal for v in rates] + sizes)
        symbols = [plant.expression(n) for n in free]
        loose = ca.SX.sym("free", len(free))
        z = ca.vertcat(plant.x, plant.u, loose)
        residual = (ca.vertcat(*rows) - ca.vertcat(ca.SX.zeros(len(rates)), values)) / scale
        if free:
            residual = ca.substitute(residual, ca.vertcat(*symbols), loose)
        p = ca.vertcat(plant.p, values)
        self.function = ca.Function("rest", [z, p], [residual, ca.jacobian(residual, z)])
        self.p = np.concatenate([plant.vector("parameter"), list(given.values())])
        unknown = (*plant.states, *plant.inputs, *(plant.variable(n) for n in free))
        self.nominal, self.low, self.high, self.start = (
            np.array([getattr(v, a) for v in unknown], dtype=float)
            for a in ("nominal", "min", "max", "start")
        )
        self._relaxed: dict[tuple[str, bool], Array | None] = {}
        for name, value in pinned.items():
            i = [v.name for v in unknown].index(name)
            self.low[i] = self.high[i] = self.start[i] = value

    def along(self, name: str) -> Search:
        """The same search without the condition on a variable: one unknown more than equations."""
        loose = list(self.free)
        if self.plant.variable(name).causality == "parameter" and name not in loose:
            loose.append(name)
        kept = {n: v for n, v in self.values.items() if n != name}
        return Search(self.plant, kept, loose, self.more, self.pinned)

    def moved(self, name: str, value: float) -> Search:
        """The same search with another value of one condition."""
        other = copy.copy(self)
        other._relaxed = {}
        other.p = self.p.copy()
        other.p[len(self.p) - len(self.targets) + self.targets.index(name)] = value
        return other

    @property
    def values(self) -> dict[str, float]:
        """The conditions."""
        numbers = self.p[len(self.p) - len(self.targets) :].tolist()
        return dict(zip(self.targets, numbers, strict=True))

    def vector(self, point: OperatingPoint) -> Array:
        """The unknowns at a point."""
        return np.concatenate([point.x, point.u, [point[n] for n in self.free]])

    def point(self, z: Array) -> OperatingPoint:
        """The point of given unknowns; its plant has the free parameters' values."""
        n, m = len(self.plant.states), len(self.plant.inputs)
        plant = self.plant
        if self.free:
            plant = plant.with_values(dict(zip(self.free, z[n + m :], strict=True)))
        error = float(np.abs(self.residual(z)).max())
        return OperatingPoint(plant, z[:n], z[n : n + m], error)

    def polished(self, z: Array, high: Array | None = None) -> Array | None:
        """The equilibrium that Newton's method reaches from z, None when outside or none."""
        high = self.high if high is None else high
        point = self.newton(z)
        error = np.abs(self.residual(point)).max()
        margin = 1e-9 * self.nominal
        inside = np.all((point >= self.low - margin) & (point <= high + margin))
        return np.clip(point, self.low, high) if error < TOLERANCE and inside else None

    def residual(self, point: Array) -> Array:
        value: Array = np.asarray(self.function(point, self.p)[0], dtype=float)
        return value.ravel()

    @property
    def _open(self) -> list[int]:
        """The rows that are no pinned value: these are bounds for IPOPT."""
        return [i for i, n in enumerate(self.names) if n not in self.pinned]

    @cached_property
    def _solver(self) -> ca.Function:
        """min |r|^2 s.t. r = residual(z): converges also where no equilibrium exists."""
        w, r = ca.MX.sym("w", len(self.nominal)), ca.MX.sym("r", len(self._open))
        p = ca.MX.sym("p", len(self.p))
        nlp: dict[str, ca.MX] = {
            "x": ca.vertcat(w, r),
            "p": p,
            "f": ca.sumsqr(r),
            "g": self.function(w * self.nominal, p)[0][self._open] - r,
        }
        ipopt: dict[str, Any] = {
            "print_level": 0,
            "sb": "yes",
            "tol": 1e-10,
            "max_iter": 200,
            "mu_init": 1e-3,
        }
        return ca.nlpsol("equilibrium", "ipopt", nlp, {"print_time": False, "ipopt": ipopt})

    def nearest(self, guess: Array, high: Array | None = None, slack: Array | None = None) -> Array:
        """The point within the bounds whose residual is smallest, |r_i| <= slack_i."""
        high = self.high if high is None else high
        slack = np.full(len(self._open), np.inf) if slack is None else slack[self._open]
        result = self._solver(
            x0=np.concatenate([guess / self.nominal, np.zeros(len(slack))]),
            p=self.p,
            lbx=np.concatenate([self.low / self.nominal, -slack]),
            ubx=np.concatenate([high / self.nominal, slack]),
            lbg=0,
            ubg=0,
        )
        w: Array = np.asarray(result["x"], dtype=float).ravel()[: len(self.nominal)]
        return np.asarray(w * self.nominal, dtype=float)

    def solve(self, guess: OperatingPoint | None = None) -> tuple[OperatingPoint | None, Array]:
        """The equilibrium, or None and the point that comes nearest."""
        if guess is not None:
            near = self.polished(self.newton(self.vector(guess), steps=20))
            if near is not None:
                return self.point(near), near
        best, least = self.start, np.inf
        for start in self.starts():
            nearest = self.nearest(start)
            for near in (nearest, self.newton(start, steps=20, inside=True)):
                point = self.polished(near)
                if point is not None:
                    return self.point(point), point
            miss = float(np.abs(self.residual(nearest)).max())
            if miss < least:
                best, least = nearest, miss
        for name in self.targets:  # by way of those that meet all conditions but one
            near = self.relaxed(name, more_pressure=False)
            point = None if near is None else self.polished(self.newton(near, steps=20))
            if point is not None:
                return self.point(point), point
        return None, best

    def relaxed(self, name: str, more_pressure: bool) -> Array | None:
        """The equilibrium with condition ``name`` left as near to its value as the others allow.

        more_pressure : pressures may exceed their range. None when there is no such point.
        """
        key = (name, more_pressure)
        if key not in self._relaxed:
            self._relaxed[key] = self._let_go(name, self.higher if more_pressure else self.high)
        return self._relaxed[key]

    def _let_go(self, name: str, high: Array) -> Array | None:
        i = self.names.index(name)
        slack = np.zeros(len(self.names))
        slack[i] = np.inf
        for guess in self.starts():
            point = self.nearest(guess, high, slack)
            others = np.delete(self.residual(point), i)
            if np.abs(others).max(initial=0.0) < ROUGH:
                return np.asarray(np.clip(point, self.low, high))
        return None

    @cached_property
    def higher(self) -> Array:
        """Upper bounds without those of pressures."""
        high = self.high.copy()
        for i, v in enumerate((*self.plant.states, *self.plant.inputs)):
            if v.unit == "Pa":
                high[i] = np.inf
        return np.asarray(high, dtype=float)

    def starts(self, count: int = 5, seed: int = 0, reach: float = 1.0) -> list[Array]:
        """Start values, points spread over the bounds (fixed seed: the same each time), taut ones.

        States and inputs that are conditions have their value.

        reach : how many nominals to go from the start where there is no bound.
        """
        span = reach * self.nominal
        low = np.where(np.isfinite(self.low), self.low, self.start - span)
        high = np.where(np.isfinite(self.high), self.high, self.start + span)
        spread = np.random.default_rng(seed).uniform(0.1, 0.9, size=(count, len(low)))
        found = np.vstack([self.start, low + spread * (high - low)])
        # under little pressure muscles may be slack, and a slack one gives no slope to leave by
        taut = np.tile(self.start, (TAUT, 1))
        for i, variable in enumerate((*self.plant.states, *self.plant.inputs)):
            if variable.unit == "Pa" and np.isfinite(high[i]):
                taut[:, i] = low[i] + np.linspace(0.6, 0.9, TAUT) * (high[i] - low[i])
        found = np.vstack([found, taut])
        for i, variable in enumerate((*self.plant.states, *self.plant.inputs)):
            if variable.name in self.targets:
                found[:, i] = self.values[variable.name]
        return list(found)

    def newton(self, point: Array, steps: int = 4, inside: bool = False) -> Array:
        """A few Newton steps to rounding; least squares where the Jacobian is singular.

        inside : each step ends within the bounds.
        """
        for _ in range(steps):
            residual, jacobian = (np.asarray(m, dtype=float) for m in self.function(point, self.p))
            if not np.all(np.isfinite(jacobian)):
                break
            # in units of nominal: else pressures alone would decide what is singular
            step = np.linalg.lstsq(jacobian * self.nominal, residual.ravel(), rcond=None)[0]
            point = point - step * self.nominal
            if inside:
                point = np.clip(point, self.low, self.high)
            if np.abs(step).max() < 1e-15:
                break
        return point
