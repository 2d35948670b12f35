"""Collocation on 0 .. 1: the points, the polynomials through them, and their matrices.

Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, Springer 1996, sections
IV.3 and IV.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
PointKind: TypeAlias = Literal["radau", "gauss"]

HIGHEST_DEGREE = 9
"""CasADi's points end here."""


def collocation_points(kind: PointKind, degree: int) -> Array:
    """The ``degree`` points in 0 .. 1, rising; Radau's last one is 1, Gauss's are all inside."""
    return np.array(_points(kind, degree))


@cache
def _points(kind: PointKind, degree: int) -> tuple[float, ...]:
    found = list(ca.collocation_points(degree, "legendre" if kind == "gauss" else kind))
    if kind == "radau":
        found[-1] = 1.0  # CasADi's is off by rounding
    return tuple(found)


def collocation_matrices(taus: Array) -> tuple[Array, Array, Array]:
    """(slopes, end, weights) of the polynomial through 0 and ``taus`` (d points).

    slopes : (d + 1, d), values (start first) @ slopes are d/dtau at ``taus``.
    end : (d + 1,), values @ end is the polynomial at 1.
    weights : (d,), of the quadrature over 0 .. 1 by values at ``taus``.
    """
    slopes, end, _ = (np.asarray(m) for m in ca.collocation_coeff(list(map(float, taus))))
    # CasADi's own go through 0 too, and leave out its weight: half a weight for one Radau point
    places, shares = np.polynomial.legendre.leggauss(len(taus))
    weights = [shares @ values / 2 for values in lagrange(taus.tolist(), (places + 1) / 2)]
    return slopes, end.ravel(), np.array(weights)


def lagrange(nodes: Sequence[float], at: Any, order: int = 0) -> list[Any]:
    """Weights of the values at ``nodes`` that give their polynomial (1: its slope) at ``at``.

    at : a number, an array or a CasADi expression, which the weights are then too.
    """
    return [_basis(nodes, j, at, order) for j in range(len(nodes))]


def _basis(nodes: Sequence[float], j: int, at: Any, order: int) -> Any:
    """The polynomial that is 1 at node j and 0 at the others, or its slope."""
    a = nodes[j]
    others = [b for b in nodes if b != a]
    if not order:
        return _product([(at - b) / (a - b) for b in others], at)
    total = 0.0 * at
    for left in others:
        factors = [(at - b) / (a - b) for b in others if b != left]
        total = total + _product(factors, at) / (a - left)
    return total


def _product(factors: Sequence[Any], at: Any) -> Any:
    result = 1.0 + 0.0 * at  # of the kind and shape of at, also where there is no factor
    for factor in factors:
        result = result * factor
    return result
