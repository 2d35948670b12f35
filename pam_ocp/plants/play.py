"""Sharp play operators on numbers: what a history of contractions leaves, and its exact inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, require_positive

__all__ = ["SlipElements"]

Array: TypeAlias = NDArray[np.float64]
ROUNDING = 1e-14
"""Contractions no farther apart are the same."""
SMALLEST = 0.01
"""Part of an element's friction that its envelopes keep, however far the muscle is stretched."""


@dataclass
class SlipElements:
    """Springs that hold within -lower (1 + lower_growth kappa) .. upper (1 + upper_growth kappa).

    The force of their sum over a history of contractions is a Prandtl-Ishlinskii operator with
    generalised (asymmetric) play; on each monotone stroke it is a broken line in kappa, so both
    ways are exact. The elements remember: :meth:`force` and :meth:`contraction` go on from where
    the last call ended, :meth:`reset` forgets.

    stiffness : of each spring [N per unit of contraction]. upper, lower : [N], as many.

    Raises InputError for series of different length, or what is not > 0.

    Examples
    --------
    >>> elements = pam.losses.SlipElements([1000.0], upper=[5.0], lower=[3.0])
    >>> elements.force([0.01, 0.0])
    array([ 5., -3.])
    """

    stiffness: Sequence[float]
    upper: Sequence[float]
    lower: Sequence[float]
    upper_growth: float = 0.0
    lower_growth: float = 0.0
    held: Array = field(init=False)
    """Force of each element [N]."""
    kappa: float = field(init=False, default=0.0)
    """Contraction at which it stands."""

    def __post_init__(self) -> None:
        series = {n: getattr(self, n) for n in ("stiffness", "upper", "lower")}
        if len({len(v) for v in series.values()}) != 1:
            counts = ", ".join(f"{len(v)} of {n}" for n, v in series.items())
            raise InputError(f"SlipElements: {counts}; give one of each per element")
        self._k, self._up, self._low = (
            np.array([require_positive(f"SlipElements.{n}", x) for x in v])
            for n, v in series.items()
        )
        self.reset()

    def reset(self, kappa: float = 0.0, held: ArrayLike | None = None) -> None:
        """Begin anew at a contraction, with nothing held (virgin) or these forces [N]."""
        self.kappa = float(kappa)
        values = np.zeros(len(self._k)) if held is None else np.asarray(held, dtype=float)
        if values.shape != self._k.shape:
            raise InputError(f"held = {held!r}: give {len(self._k)} forces, one per element")
        self.held = np.clip(values, *self._ends(self.kappa))

    def _ends(self, kappa: float) -> tuple[Array, Array]:
        return (
            -self._low * max(1 + self.lower_growth * kappa, SMALLEST),
            self._up * max(1 + self.upper_growth * kappa, SMALLEST),
        )

    def _reach(self, way: float) -> float:
        """The farthest contraction that way, within -1 .. 1, at which both envelopes are lines."""
        ends = [way]
        for growth in (self.lower_growth, self.upper_growth):
            if way * growth < 0:
                ends.append((SMALLEST - 1) / growth)
        return min(ends, key=abs)

    def _moved(self, kappa: float) -> Array:
        return np.clip(self.held + self._k * (kappa - self.kappa), *self._ends(kappa))

    def force(self, kappa: Any) -> Any:
        """Force [N] at a contraction, or at each of a history (straight between them)."""
        history = np.asarray(kappa, dtype=float)
        found = np.empty(history.size)
        for i, value in enumerate(history.ravel().tolist()):
            self.held = self._moved(value)
            self.kappa = value
            found[i] = self.held.sum()
        return found.reshape(history.shape) if history.ndim else float(found[0])

    def contraction(self, total: Any, slope: float) -> Any:
        """The inverse: kappa (or a history of it) at which slope kappa + force(kappa) = total.

        slope : of a spring beside the elements [N per unit of contraction], > 0: the muscle's own
            at constant pressure. On each way the sum is a broken line that rises; the break at
            which it passes ``total`` is found by sorting, and the last piece is solved: exact to
            rounding.

        Raises InputError where the sum does not rise (an envelope that falls steeper than
        ``slope``).
        """
        require_positive("slope", slope, "N")
        wanted = np.asarray(total, dtype=float)
        found = np.empty(wanted.size)
        for i, value in enumerate(wanted.ravel().tolist()):
            found[i] = self._solved(value, slope)
            self.force(found[i])
        return found.reshape(wanted.shape) if wanted.ndim else float(found[0])

    def _solved(self, total: float, slope: float) -> float:
        """The contraction on the way from here where the sum is ``total``."""
        here = slope * self.kappa + self.held.sum()
        way = 1.0 if total >= here else -1.0
        end = self._reach(way)
        breaks = [k for k in self._breaks(way) if way * (end - k) > 0]
        for low, high in pairwise([self.kappa, *breaks, end]):
            if abs(high - low) <= ROUNDING:
                continue
            first, last = (slope * k + self._moved(k).sum() for k in (low, high))
            if way * (last - first) <= 0:
                raise InputError(
                    f"slope = {slope:g} N is too small: the sum with the friction does not rise "
                    f"at a contraction of {low:g}, so no inverse is unique"
                )
            if way * (last - total) >= 0:
                return float(low + (total - first) * (high - low) / (last - first))
        raise InputError(
            f"total = {total:g} N is beyond what contractions up to {end:g} give; ask for less"
        )

    def _breaks(self, way: float) -> list[float]:
        """Contractions beyond this one at which an element begins to slide, the nearest first."""
        found: list[float] = []
        limits = (
            (self._up, self.upper_growth * self._up),
            (-self._low, -self.lower_growth * self._low),
        )
        for base, growth in limits:
            rise = self._k - growth
            with np.errstate(divide="ignore", invalid="ignore"):
                meet = self.kappa + (base + growth * self.kappa - self.held) / rise
            found += [float(k) for k in meet if np.isfinite(k) and way * (k - self.kappa) > 0]
        return sorted(found, key=lambda k: way * k)
