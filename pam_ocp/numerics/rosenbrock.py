"""Rosenbrock methods with equal steps, as CasADi expressions: linearly implicit, for stiff plants.

The adaptive one of simulations is CasADi's own integrator.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import casadi as ca
import numpy as np

Slopes: TypeAlias = Callable[[ca.SX], tuple[ca.SX, ca.SX]]
"""x -> (x', its Jacobian over x)."""

GAMMA = 1 - 1 / np.sqrt(2)
"""Of ROS2: with this value it is L-stable, so stiff friction does no harm."""

_RODAS3_M = (2.0, 0.0, 1.0, 1.0)
_RODAS3_A = ((), (0.0,), (2.0, 0.0), (2.0, 0.0, 1.0))
_RODAS3_C = ((), (4.0,), (1.0, -1.0), (1.0, -1.0, -8.0 / 3.0))
"""Sandu, Verwer, Blom, Spee, Carmichael, Potra, Atmospheric Environment 31 (1997) 3459; gamma 1/2.
"""


def rodas3(slopes: Slopes, x: ca.SX, h: float | ca.SX) -> ca.SX:
    """One step h of RODAS3 (order 3, L-stable): four stages of linear equations, one matrix."""
    matrix = ca.SX.eye(x.numel()) * (2.0 / h) - slopes(x)[1]
    stages: list[ca.SX] = []
    for row_a, row_c in zip(_RODAS3_A, _RODAS3_C, strict=True):
        inner = x + sum((a * k for a, k in zip(row_a, stages, strict=True)), ca.SX(0))
        right = slopes(inner)[0]
        right += sum((c / h * k for c, k in zip(row_c, stages, strict=True)), ca.SX(0))
        stages.append(ca.solve(matrix, right))
    return ca.SX(x + sum((m * k for m, k in zip(_RODAS3_M, stages, strict=True)), ca.SX(0)))


def ros2(early: Slopes, late: Callable[[ca.SX], ca.SX], x: ca.SX, h: float | ca.SX) -> ca.SX:
    """One step h of ROS2, x' going from ``early`` (x) at its begin to ``late`` (x) at its end.

    (I - gamma h A) k1 = f(x, u), (I - gamma h A) k2 = f(x + h k1, late) - 2 k1, A = df/dx,
    x+ = x + 3/2 h k1 + 1/2 h k2. Of second order for any A, so df/dt may be left out.
    """
    first, jacobian = early(x)
    matrix = ca.SX.eye(x.numel()) - GAMMA * h * jacobian
    k1 = ca.solve(matrix, first)
    k2 = ca.solve(matrix, late(x + h * k1) - 2 * k1)
    return ca.SX(x + 1.5 * h * k1 + 0.5 * h * k2)


def ros2_with_slopes(
    first: ca.SX,
    late: Callable[[ca.SX], ca.SX],
    state: tuple[ca.SX, ca.SX],
    unknowns: tuple[ca.SX, int],
    h: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """A step of :func:`ros2` and its exact derivatives, stage by stage with the matrix of the step:
    far smaller expressions than what differentiating the step gives.

    first : x' at its begin. state : x, and its derivatives (nx, nz + more). unknowns : z, on which
    ``first``, ``late`` and h depend, too, and how many more there are.
    """
    (x, s), (z, more) = state, unknowns
    w, m = ca.SX.sym("w", x.numel()), ca.SX.sym("m", x.numel())

    def over_z(value: ca.SX) -> ca.SX:
        return ca.horzcat(ca.jacobian(value, z), ca.SX(value.numel(), more))

    def at(value: list[ca.SX], symbol: ca.SX, place: ca.SX) -> list[ca.SX]:
        return list(ca.substitute(value, [symbol], [ca.densify(place)]))

    jacobian = ca.jacobian(first, x)
    matrix = ca.SX.eye(x.numel()) - GAMMA * h * jacobian
    pull = GAMMA * h * (jacobian @ w)  # how the matrix changes, times a stage
    pulled = [ca.jacobian(pull, x), over_z(pull)]
    k1 = ca.solve(matrix, first)
    pull_x, pull_z = at(pulled, w, k1)
    s1 = ca.solve(matrix, (jacobian + pull_x) @ s + over_z(first) + pull_z)
    middle, grown = x + h * k1, over_z(h)
    second = late(m)
    value, slope, own = at([second, ca.jacobian(second, m), over_z(second)], m, middle)
    k2 = ca.solve(matrix, value - 2 * k1)
    pull_x, pull_z = at(pulled, w, k2)
    moved = slope @ (s + h * s1 + k1 @ grown) + own - 2 * s1
    s2 = ca.solve(matrix, moved + pull_x @ s + pull_z)
    after = x + 1.5 * h * k1 + 0.5 * h * k2
    return after, s + 1.5 * h * s1 + 0.5 * h * s2 + (1.5 * k1 + 0.5 * k2) @ grown
