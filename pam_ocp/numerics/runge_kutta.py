"""The classical method of Runge and Kutta, of order 4."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

X = TypeVar("X")
"""What is integrated: a CasADi expression (SX, MX, DM) or a NumPy array."""


def rk4(slope: Callable[[X, float], X], x: X, h: Any, steps: int = 1) -> X:
    """x after ``steps`` equal steps of length ``h`` of x' = slope(x, at).

    at : where in time the slope is asked for, counted in steps: 0, 1/2, 1, 3/2, ..., ``steps``;
        the time itself is ``at * h``, and what varies with it is the caller's to look up.

    Numbers and CasADi graphs alike, h too. Source: W. Kutta, Z. Math. Phys. 46 (1901) 435-453.
    """
    z: Any = x
    for k in range(steps):
        k1: Any = slope(z, k)
        k2: Any = slope(z + h / 2 * k1, k + 0.5)
        k3: Any = slope(z + h / 2 * k2, k + 0.5)
        k4: Any = slope(z + h * k3, k + 1)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    result: X = z
    return result
