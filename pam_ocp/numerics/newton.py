"""Newton's method with an honest reason when it fails, and zero crossings to high order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import PamError
from ..core.trajectory import Trajectory
from ..plants.plant import Plant

__all__ = [
    "Equations",
    "NewtonError",
    "Root",
    "Smooth",
    "casadi_equations",
    "iterate",
    "least_squares",
    "newton",
    "smooth",
]

Array: TypeAlias = NDArray[np.float64]
Equations: TypeAlias = Callable[[Array], tuple[Array, Callable[[Array], Array]]]
"""w -> (residual, solver): solver(right) is the step with Jacobian . step = right."""

HALVINGS = 11
"""How often a step is halved, at most, to lessen the residual."""


class NewtonError(PamError):
    """Newton's method found no root; says why.

    ``last`` : the unknowns where it gave up, or None.
    """

    def __init__(self, message: str, last: Array | None = None) -> None:
        super().__init__(message)
        self.last = last


@dataclass(frozen=True)
class Root:
    """Where Newton's method ended."""

    w: Array
    size: float
    """Largest residual there; infinite where it is no number."""
    reason: str = ""
    """Why it is no root; "" when it is one."""


def newton(
    equations: Equations, w: Array, *, tolerance: float = 1e-12, steps: int = 30
) -> tuple[Array, float]:
    """Solve equations(w) = 0 by damped steps; ``equations`` gives residual and Jacobian's solver.

    Steps are halved while they do not lessen the residual. Ends when the residual is below
    ``tolerance``, or at the level of rounding (below 100 times it, and no step helps any more).
    Returns (w, largest residual); NewtonError with the reason otherwise.
    """
    root = iterate(equations, w, tolerance=tolerance, steps=steps)
    if root.reason:
        raise NewtonError(root.reason, root.w)
    return root.w, root.size


def iterate(
    equations: Equations,
    w: Array,
    *,
    tolerance: float = np.inf,
    settled: float = np.inf,
    steps: int = 30,
    halvings: int = HALVINGS,
    longest: float = np.inf,
    within: tuple[Array, Array] | None = None,
) -> Root:
    """Newton's method wherever it leads: for searches that go on from the last point themselves.

    tolerance, settled : a root has no larger residual, and the next step moves no unknown by more;
        one of the two is finite.
    steps : at most. halvings : of a step that does not lessen the residual; with 0 all steps are
        full, whatever the residual does.
    longest : a step's largest entry; longer ones are shortened. within : (lowest, highest) values
        of the unknowns, which every step keeps.
    """
    residual, solve = equations(w)
    size = _largest(residual)
    if not np.isfinite(size):
        return Root(w, size, "the equations give no finite numbers at the starting guess")
    for count in range(steps):
        if size <= tolerance and settled == np.inf:
            return Root(w, size)
        try:
            step = solve(residual)
        except (RuntimeError, np.linalg.LinAlgError):
            return Root(w, size, f"the Jacobian is singular at Newton step {count + 1}")
        step = step * min(1.0, longest / max(_largest(step), 1e-300))
        if size <= tolerance and _largest(_moved(w, step, within) - w) <= settled:
            return Root(w, size)
        for halving in range(halvings + 1):
            trial = _moved(w, step * 0.5**halving, within)
            trial_residual, trial_solve = equations(trial)
            trial_size = _largest(trial_residual)
            if trial_size < size or not halvings:
                break
        else:
            break
        w, residual, solve, size = trial, trial_residual, trial_solve, trial_size
        if not np.isfinite(size):
            return Root(w, size, f"no finite numbers are left at Newton step {count + 1}")
    if size <= 100 * tolerance and settled == np.inf:
        return Root(w, size)
    above = f", above {tolerance:.0e}" if np.isfinite(tolerance) else ""
    return Root(
        w,
        size,
        f"Newton's method stops at a residual of {size:.1e} (scaled by nominals){above}",
    )


def _moved(w: Array, step: Array, within: tuple[Array, Array] | None) -> Array:
    return w - step if within is None else np.clip(w - step, *within)


def casadi_equations(function: ca.Function, *constants: Any) -> Equations:
    """Equations for :func:`newton` of a function (w, *constants) -> (residual, Jacobian in w)."""

    def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
        residual, jacobian = (np.asarray(m) for m in function(w, *constants))
        return residual.ravel(), lambda right: np.linalg.solve(jacobian, right)

    return equations


def least_squares(jacobian: Array, rcond: float | None = None) -> Callable[[Array], Array]:
    """The solver of a Jacobian of any shape or rank: shortest steps of least squares."""

    def solve(right: Array) -> Array:
        if not np.isfinite(jacobian).all():
            raise np.linalg.LinAlgError("the Jacobian is not finite")
        return np.asarray(np.linalg.lstsq(jacobian, right, rcond=rcond)[0], dtype=float)

    return solve


def _largest(residual: Array) -> float:
    size = np.max(np.abs(residual), initial=0.0)
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
