"""Passages of a motion through a level, and its turning points, found to high order."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.trajectory import Trajectory
from ..numerics.newton import Array
from ..plants.plant import Plant

__all__ = ["Smooth", "smooth"]


@dataclass(frozen=True)
class Smooth:
    """One state over time, joined by polynomials of degree 5 that keep value, slope, curvature.

    t : (n,) times [s]. derivatives : (3, n) value and first two derivatives at these times.
    """

    t: Array
    derivatives: Array

    def zeros(self, level: float = 0.0, order: int = 0) -> tuple[Array, Array, Array]:
        """Times where the derivative of this order (0 or 1) crosses ``level``.

        Returns (times, values of the state there, +1 rising or -1 falling). Exact zeros at a
        sample count with the interval that follows.
        """
        y = self.derivatives[order] - level
        before = np.where(y[:-1] == 0, -np.sign(y[1:]), np.sign(y[:-1]))
        at = np.flatnonzero(before * np.sign(y[1:]) < 0)
        low, high = np.zeros(len(at)), np.ones(len(at))
        for _ in range(60):
            middle = (low + high) / 2
            short = (self._value(at, middle, order) - level) * before[at] > 0
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        h = np.diff(self.t)[at]
        return self.t[at] + low * h, self._value(at, low, 0), -before[at]

    def _value(self, interval: NDArray[np.intp], s: Array, order: int) -> Array:
        """Value (0) or slope (1) at the fraction s of the intervals."""
        h = np.diff(self.t)[interval]
        y0, v0, a0 = self.derivatives[:, interval] * np.array([h**0, h, h**2])
        y1, v1, a1 = self.derivatives[:, interval + 1] * np.array([h**0, h, h**2])
        rest = np.array([y1 - y0 - v0 - a0 / 2, v1 - v0 - a0, a1 - a0])
        # value, slope and curvature at s = 1 fix the powers 3, 4 and 5
        c3, c4, c5 = np.array([[10, -4, 0.5], [-15, 7, -1], [6, -3, 0.5]]) @ rest
        if order == 0:
            value = y0 + s * (v0 + s * (a0 / 2 + s * (c3 + s * (c4 + s * c5))))
        else:
            value = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h
        return np.asarray(value)


def smooth(plant: Plant, trajectory: Trajectory, name: str) -> Smooth:
    """The state ``name`` of a simulated trajectory with its exact derivatives.

    Inputs must be constant. Slope and curvature come from the plant's equation, so crossings
    are found with an error of order 6 in the sampling interval.
    """
    rates = plant.cached(("rates",), lambda: _rates(plant))
    states = trajectory.array([v.name for v in plant.states]).T
    inputs = trajectory.array([v.name for v in plant.inputs]).T
    first, second = (np.asarray(m) for m in rates(states, inputs, plant.vector("parameter")))
    row = [v.name for v in plant.states].index(plant.variable(name).name)
    return Smooth(trajectory.t, np.array([states[row], first[row], second[row]]))


def _rates(plant: Plant) -> ca.Function:
    """(x, u, p) -> (x', x'') at constant u."""
    xdot = ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states))
    return ca.Function("rates", [plant.x, plant.u, plant.p], [xdot, ca.jtimes(xdot, plant.x, xdot)])
