"""Curves followed by their arc length, round folds: pseudo-arclength continuation.

Source: H. B. Keller, in Applications of Bifurcation Theory, Academic Press 1977, 359-384.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from .newton import NewtonError, iterate, least_squares

Array: TypeAlias = NDArray[np.float64]
P = TypeVar("P")
"""A place on a curve."""
T = TypeVar("T")
"""A direction there, of length 1."""

SHRINK = 0.5
"""By what a step is shortened that fails or turns too far."""


class Curve(Protocol[P, T]):
    """What can be followed."""

    def step(self, place: P, tangent: T, length: float) -> tuple[P, T, float]:
        """(place, direction, cosine): the curve's point in the plane across ``tangent``, ``length``
        away, its own direction there (ahead), and the cosine between the two directions.

        Raises NewtonError where there is none.
        """


@dataclass
class Walk(Generic[P, T]):
    """Where one stands on a curve; :meth:`advance` goes on.

    length : of the next step; it grows by ``growth`` at each, up to ``longest``.
    shortest : a step that has to be shortened to this fails.
    least_cosine : between neighbouring directions; where the curve bends more, steps are shorter.
    """

    curve: Curve[P, T]
    place: P
    tangent: T
    length: float
    longest: float
    shortest: float
    growth: float
    least_cosine: float

    def advance(self) -> float:
        """One step along the curve; returns its length. Raises NewtonError with the reason."""
        length, reason = self.length, ""
        while length > self.shortest:
            try:
                place, tangent, cosine = self.curve.step(self.place, self.tangent, length)
            except NewtonError as error:
                reason = str(error)
            else:
                if cosine > self.least_cosine:
                    self.place, self.tangent = place, tangent
                    self.length = min(self.growth * length, self.longest)
                    return length
                reason = "it bends too sharply"
            length *= SHRINK
        raise NewtonError(f"even steps of {length:.1e} fail: {reason}")


@dataclass(frozen=True)
class ImplicitCurve:
    """The curve g(w) = 0 of n equations for n + 1 unknowns of like size.

    equations : w -> (g (n,), its Jacobian (n, n + 1)).
    tolerance : largest |g| on the curve. steps : of Newton's method to come back to it.
    """

    equations: Callable[[Array], tuple[Array, Array]]
    tolerance: float = 1e-9
    steps: int = 8

    def tangent(self, w: Array) -> Array:
        """A unit vector along the curve, one way or the other."""
        return np.asarray(np.linalg.svd(self.equations(w)[1])[2][-1])

    def corrected(self, place: Array, tangent: Array, length: float) -> Array:
        """The curve's point in the plane across ``tangent`` at ``length``; see :class:`Curve`."""

        def bordered(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            residual, jacobian = self.equations(w)
            across = tangent @ (w - place) - length
            return np.append(residual, across), least_squares(np.vstack([jacobian, tangent]))

        start = place + length * tangent
        root = iterate(bordered, start, settled=1e-13, steps=self.steps, halvings=0)
        if not root.size < self.tolerance:
            raise NewtonError(root.reason or "no point of the curve is near", root.w)
        return root.w

    def step(self, place: Array, tangent: Array, length: float) -> tuple[Array, Array, float]:
        """As of :class:`Curve`."""
        new = self.corrected(place, tangent, length)
        direction = self.tangent(new)
        cosine = float(direction @ tangent)
        return new, direction * np.sign(cosine), abs(cosine)

    def where(
        self, of: Callable[[Array], float], place: Array, tangent: Array, length: float
    ) -> Array:
        """The point within a step at which ``of(w)``, of opposite signs at its ends, is zero."""
        from scipy.optimize import brentq

        def at(s: float) -> Array:
            if s <= 0:
                return place
            try:
                return self.corrected(place, tangent, s)
            except NewtonError:
                return place + s * tangent

        return at(brentq(lambda s: of(at(s)), 0.0, length, xtol=1e-14, rtol=1e-14))
