"""The search for equilibria within the bounds, from nothing: IPOPT from several starts."""

from __future__ import annotations

from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..numerics.solvers import Nlp, nlpsol, quiet_ipopt
from .operating_point import OperatingPoint
from .rest import Rest

__all__ = ["Search"]

Array: TypeAlias = NDArray[np.float64]

TAUT = 3
"""Starts under high pressures."""
ROUGH = 1e-6
"""Largest residual from which Newton's method is asked for the rest."""


class Search(Rest):
    """The equations of rest and their solution within the bounds."""

    def moved(self, name: str, value: float) -> Search:
        """The same search with another value of one condition."""
        other = super().moved(name, value)
        other.__dict__.pop("_relaxed", None)
        return other

    @cached_property
    def _relaxed(self) -> dict[tuple[str, bool], Array | None]:
        """What :meth:`relaxed` has found."""
        return {}

    @property
    def _open(self) -> list[int]:
        """The rows that are no pinned value: these are bounds for IPOPT."""
        return [i for i, n in enumerate(self.names) if n not in self.pinned]

    @cached_property
    def _solver(self) -> Nlp:
        """min |r|^2 s.t. r = residual(z): converges also where no equilibrium exists."""
        w, r = ca.MX.sym("w", len(self.nominal)), ca.MX.sym("r", len(self._open))
        p = ca.MX.sym("p", len(self.p))
        nlp: dict[str, ca.MX] = {
            "x": ca.vertcat(w, r),
            "p": p,
            "f": ca.sumsqr(r),
            "g": self.function(w * self.nominal, p)[0][self._open] - r,
        }
        options = quiet_ipopt(tol=1e-10, max_iter=200, mu_init=1e-3)
        return nlpsol("equilibrium", "ipopt", nlp, options)

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
            near = self.converged(self.newton(self.vector(guess), steps=20))
            if near is not None:
                return self.point(near), near
        best, least = self.start, np.inf
        for start in self.starts():
            nearest = self.nearest(start)
            for near in (nearest, self.newton(start, steps=20, inside=True)):
                point = self.converged(near)
                if point is not None:
                    return self.point(point), point
            miss = float(np.abs(self.residual(nearest)).max())
            if miss < least:
                best, least = nearest, miss
        for name in self.targets:  # by way of those that meet all conditions but one
            near = self.relaxed(name, more_pressure=False)
            point = None if near is None else self.converged(self.newton(near, steps=20))
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
