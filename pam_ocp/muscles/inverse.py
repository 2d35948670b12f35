"""Roots of a force law: the pressure for a force, the contraction without force."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError

__all__ = ["first_zero", "solve_pressure"]

Array = NDArray[np.float64]

LOWEST, HIGHEST = -1e6, 1e8
"""Where an inverse pressure is looked for [Pa gauge]."""


def first_zero(tension: Callable[[Any], Any], largest: float) -> float:
    """Smallest kappa in 0 .. ``largest`` at which ``tension(kappa)`` falls to zero, else NaN."""
    grid = np.linspace(0.0, largest, 451)
    values = np.asarray(tension(grid))
    slack = np.nonzero(values <= 0)[0]
    if values[0] <= 0 or not slack.size:
        return float("nan")
    low, high = float(grid[slack[0] - 1]), float(grid[slack[0]])
    while high - low > 1e-14:  # bisection: the bracket holds exactly one sign change
        middle = (low + high) / 2
        if tension(middle) > 0:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def solve_pressure(
    function: ca.Function, coefficients: Mapping[str, Any], tension: Any, kappa: Any, name: str
) -> Any:
    """Root in p of F(p, kappa) = tension by Newton's method, kept in a bracket by bisection.

    ``function`` is that of a ForceLaw; arrays broadcast, scalars give a float.
    Raises InputError when no pressure between LOWEST and HIGHEST gives the tension.
    """
    wanted, contraction = np.broadcast_arrays(
        np.asarray(tension, dtype=float), np.asarray(kappa, dtype=float)
    )
    shape, wanted, contraction = wanted.shape, wanted.ravel(), contraction.ravel()
    constants = ca.DM(list(coefficients.values()))

    def residual(p: Array) -> tuple[Array, Array]:
        force, _, slope = function(p.reshape(1, -1), contraction.reshape(1, -1), constants)
        return np.asarray(force).ravel() - wanted, np.asarray(slope).ravel()

    low, high = _bracket(lambda p: residual(p)[0], wanted, contraction, name)
    p = (low + high) / 2
    for _ in range(200):
        error, slope = residual(p)
        low, high = np.where(error < 0, p, low), np.where(error < 0, high, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = p - error / slope
        # a step of rounding ends it: at a root an end of the bracket is the iterate itself
        settled = np.abs(newton - p) <= 1e-14 * np.abs(p) + 1e-12
        inside = (newton > low) & (newton < high)
        following = np.where(inside | settled, newton, (low + high) / 2)
        p = following
        if np.all(settled | (error == 0)):
            break
    result = p.reshape(shape)
    return result if result.ndim else float(result)


def _bracket(
    error: Callable[[Array], Array], wanted: Array, contraction: Array, name: str
) -> tuple[Array, Array]:
    low, high = np.zeros_like(wanted), np.full_like(wanted, 1e5)
    while np.any(error(high) < 0) and high.max() < HIGHEST:
        high = np.where(error(high) < 0, 2 * high, high)
    while np.any(error(low) > 0) and low.min() > LOWEST:
        low = np.where(error(low) > 0, 2 * low - 1e5, low)
    lost = (error(high) < 0) | (error(low) > 0)
    if np.any(lost):
        first = int(np.nonzero(lost)[0][0])
        raise InputError(
            f"{name} law: no pressure up to {HIGHEST / 1e5:g} bar gives a force of "
            f"{wanted[first]:g} N at kappa = {contraction[first]:g}; ask for less contraction"
        )
    return low, high
