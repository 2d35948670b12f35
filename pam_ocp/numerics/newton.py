"""Newton's method with an honest reason when it fails, and zero crossings to high order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import PamError
from ..core.system import System
from ..core.trajectory import Trajectory

__all__ = ["Equations", "Smooth", "VibrationError", "casadi_equations", "newton", "smooth"]

Array: TypeAlias = NDArray[np.float64]
Equations: TypeAlias = Callable[[Array], tuple[Array, Callable[[Array], Array]]]
"""w -> (residual, solver): solver(right) is the step with Jacobian . step = right."""


class VibrationError(PamError):
    """A border, a limit cycle or an oscillation that was asked for and not found; says why.

    ``last`` : the unknowns where a Newton iteration gave up, or None.
    """

    def __init__(self, message: str, last: Array | None = None) -> None:
        super().__init__(message)
        self.last = last


def newton(
    equations: Equations, w: Array, *, tolerance: float = 1e-12, steps: int = 30
) -> tuple[Array, float]:
    """Solve equations(w) = 0; ``equations`` gives the residual and a solver for its Jacobian.

    Steps are halved while they do not lessen the residual. Ends when the residual is below
    ``tolerance``, or at the level of rounding (below 100 times it, and no step helps any more).
    Returns (w, largest residual); VibrationError with the reason otherwise.
    """
    residual, solve = equations(w)
    size = _largest(residual)
    if not np.isfinite(size):
        raise VibrationError("the equations give no finite numbers at the starting guess")
    for count in range(steps):
        if size <= tolerance:
            return w, size
        try:
            step = solve(residual)
        except (RuntimeError, np.linalg.LinAlgError):
            raise VibrationError(f"the Jacobian is singular at Newton step {count + 1}") from None
        for halving in range(12):
            trial = w - step * 0.5**halving
            trial_residual, trial_solve = equations(trial)
            trial_size = _largest(trial_residual)
            if trial_size < size:
                break
        else:
            break
        w, residual, solve, size = trial, trial_residual, trial_solve, trial_size
    if size <= 100 * tolerance:
        return w, size
    raise VibrationError(
        f"Newton's method stops at a residual of {size:.1e} (scaled by nominals), above "
        f"{tolerance:.0e}",
        w,
    )


def casadi_equations(function: ca.Function, *constants: Any) -> Equations:
    """Equations for :func:`newton` of a function (w, *constants) -> (residual, Jacobian in w)."""

    def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
        residual, jacobian = (np.asarray(m) for m in function(w, *constants))
        return residual.ravel(), lambda right: np.linalg.solve(jacobian, right)

    return equations


def _largest(residual: Array) -> float:
    size = np.max(np.abs(residual))
    return float(size) if np.isfinite(size) else float("inf")


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


def smooth(plant: System, trajectory: Trajectory, name: str) -> Smooth:
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


def _rates(plant: System) -> ca.Function:
    """(x, u, p) -> (x', x'') at constant u."""
    xdot = ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states))
    return ca.Function("rates", [plant.x, plant.u, plant.p], [xdot, ca.jtimes(xdot, plant.x, xdot)])
