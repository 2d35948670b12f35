"""The search of inverse dynamics: pressures that give an acceleration, in a fixed number of steps.

Newton's method within the range, and where not both are possible one muscle at an end of its range:
one function for Python and for targets, each call of which takes the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

__all__ = ["Search"]

Array: TypeAlias = NDArray[np.float64]

STEPS = 16
"""Of Newton's method where the equations are not straight lines of the pressures."""
MISS = 1e-6
"""Relative miss of acceleration and stiffness that counts as met."""
SETTLED = 1e-5, 1e-2
"""Or a step so short, in parts of the range, that ends within it, and a miss no larger than the
second: in single precision the miss stays above MISS."""
RANK = 4.5e-16
"""Singular values in this ratio count as one (that of NumPy's lstsq)."""


@dataclass(frozen=True)
class Search:
    """Of the pressures in z (states and inputs of a plant) that meet a target.

    equations : z -> (acceleration[, stiffness], slopes over the pressures). size : of z; place :
    where the pressures stand in it. low, high : their range.
    """

    equations: ca.Function
    size: int
    place: Sequence[int]
    low: Array
    high: Array

    @property
    def steps(self) -> int:
        """Of Newton's method in each search; one for straight lines, and one for rounding."""
        z = ca.SX.sym("z", self.size)
        pressures = ca.vertcat(*(z[int(i)] for i in self.place))
        slopes = ca.vec(self.equations(z)[1])
        return STEPS if any(ca.which_depends(slopes, pressures, 1, True)) else 2

    @property
    def function(self) -> ca.Function:
        """(z, acceleration[, stiffness]) -> pressures; those in z do not count."""
        n = len(self.place)
        z, target = ca.MX.sym("z", self.size), ca.MX.sym("target", n)
        middle = ca.DM((self.low + self.high) / 2)
        both = self._search(list(range(n)), list(range(n)))
        found, miss, inside = both(middle, z, target)
        if n == 1:
            return ca.Function("inverse_dynamics", [z, target], [found])
        met = ca.logic_or(ca.fmax(miss[0], miss[1]) <= MISS, inside)
        alone = [self._search([0], [1 - i]) for i in (0, 1)]
        best: Any = middle
        least: Any = (ca.MX(np.inf), ca.MX(np.inf))
        for i, ends in product((0, 1), (self.low, self.high)):
            start = np.array(middle).ravel()
            start[i] = ends[i]
            p, missed, within = alone[i](ca.DM(start), z, target)
            first = ca.if_else(ca.logic_or(missed[0] <= MISS, within), 0, missed[0])
            ahead = ca.logic_and(first == least[0], missed[1] < least[1])
            better = ca.logic_or(first < least[0], ahead)
            best = _either(better, p, best)
            least = tuple(
                ca.if_else(better, new, old)
                for new, old in zip((first, missed[1]), least, strict=True)
            )
        return ca.Function("inverse_dynamics", [z, target], [_either(met, found, best)])

    def _search(self, equations: list[int], unknown: list[int]) -> ca.Function:
        """(pressures to begin from, z, target) ->
        (pressures, what is missed, relative, whether the unknown ones settled within their range).
        """
        n = len(self.place)
        w, z, target = (ca.SX.sym(k, m) for k, m in (("w", n), ("z", self.size), ("t", n)))
        here = ca.SX(z)
        for i, place in enumerate(self.place):
            here[int(place)] = w[i]
        found, slopes = self.equations(here)
        missed = found - target
        step = _shortest(slopes[equations, unknown], missed[equations])
        moved, inside = ca.SX(w), ca.SX(1)
        for k, i in enumerate(unknown):
            low, high = float(self.low[i]), float(self.high[i])
            moved[i] = ca.fmin(ca.fmax(w[i] - step[k], low), high)
            within = ca.logic_and(w[i] > low, w[i] < high)
            settled = ca.fabs(step[k]) <= SETTLED[0] * (high - low)
            inside = ca.logic_and(inside, ca.logic_and(within, settled))
        label = f"newton_{''.join(map(str, equations))}_{''.join(map(str, unknown))}"
        one = ca.Function(label, [w, z, target], [moved], {"cse": True})
        size = ca.fabs(missed) / ca.fmax(ca.fabs(target), 1)
        for i in equations:
            inside = ca.logic_and(inside, size[i] <= SETTLED[1])
        rest = ca.Function(f"{label}_missed", [w, z, target], [size, inside], {"cse": True})
        arguments = [ca.MX.sym(k, m) for k, m in (("w", n), ("z", self.size), ("t", n))]
        p = arguments[0]
        for _ in range(self.steps):
            p = one(p, *arguments[1:])
        results = [p, *rest(p, *arguments[1:])]
        return ca.Function(f"{label}_search", arguments, results)


def _either(condition: Any, yes: Any, no: Any) -> Any:
    pairs = zip(ca.vertsplit(ca.MX(yes)), ca.vertsplit(ca.MX(no)), strict=True)
    return ca.vertcat(*(ca.if_else(condition, a, b) for a, b in pairs))


def _shortest(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """The shortest step of least squares of one or two equations of as many unknowns."""
    if matrix.numel() == 1:
        there = ca.fabs(matrix) > 0
        return ca.if_else(there, right / ca.if_else(there, matrix, 1), 0)
    a, b, c, d = matrix[0, 0], matrix[0, 1], matrix[1, 0], matrix[1, 1]
    determinant, size = a * d - b * c, a * a + b * b + c * c + d * d
    whole = ca.fabs(determinant) > RANK * size
    safe = ca.if_else(whole, determinant, 1)
    exact = ca.vertcat(d * right[0] - b * right[1], a * right[1] - c * right[0]) / safe
    spread = ca.if_else(size > 0, size, 1)
    flat = ca.mtimes(matrix.T, right) / spread
    return ca.vertcat(*(ca.if_else(whole, exact[i], flat[i]) for i in (0, 1)))
