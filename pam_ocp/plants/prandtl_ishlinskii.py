"""Hysteresis whose branches differ: generalised play operators, summed (Prandtl-Ishlinskii);
and the sharp operators on numbers, with their exact inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from .damping import Motion
from .kinds import LOSSES
from .memory import require_elements
from .slip import Limits, PressureScale, require_scale, rounded_speed


@LOSSES.register(
    units={
        "contracting": "N",
        "relaxing": "N",
        "yield_contraction": "1",
        "contracting_growth": "1",
        "relaxing_growth": "1",
        "per_pressure": "1/Pa",
    }
)
@dataclass(frozen=True)
class PrandtlIshlinskii:
    """F = sum k_i (kappa - w_i), w_i a play operator with one envelope per direction: asymmetric.

    Each term is a spring k_i = contracting_i/yield_i that holds while -R_i(kappa) < F_i <
    C_i(kappa) and slides on these envelopes, C_i = contracting_i (1 + contracting_growth kappa)
    while the muscle contracts, R_i = relaxing_i (1 + relaxing_growth kappa) while it relaxes. So
    w_i = max(kappa - C_i/k_i, min(kappa + R_i/k_i, w_i)): the generalised play operator. Major and
    minor loops are asymmetric, rate-independent, and every motion dissipates (C_i, R_i > 0; our
    inference). Equal envelopes without growth: the classical model, MaxwellSlip.

    contracting, relaxing : friction of each element while it slides either way, at kappa = 0 [N].
    yield_contraction : contraction from rest at which each slides [1], as many.
    contracting_growth, relaxing_growth : of the envelopes per unit of contraction, >= -2.
    edge : width of the passage from sticking to sliding, as a part of the envelope; 0 is the sharp
        model, which :meth:`elements` has with its exact inverse.
    per_pressure : [1/Pa] the envelopes are those at no pressure, (1 + per_pressure p) times these
        at p; see :class:`MaxwellSlip`.

    Source: generalised play operators, M. Al Janaideh, S. Rakheja, C.-Y. Su, Mechatronics 19 (2009)
    656-670, and IEEE/ASME Trans. Mechatronics 16 (2011) 734-744 (inverse); for muscles, separate
    operators for the two ways: Y. Liu et al., Strojniski vestnik 63 (2017) 56-64 (its abstract was
    read: loops of length over pressure; here force over contraction, from which those follow).
    The default is an example, no measurement.

    Examples
    --------
    >>> one = {"contracting": (10.0,), "relaxing": (6.0,), "yield_contraction": (0.004,)}
    >>> loss = pam.losses.PrandtlIshlinskii(**one)
    >>> loss.elements(0.0).force([0.05, -0.05])  # 10 (1 + 2 x 0.05), then -6
    array([11., -6.])
    """

    contracting: Sequence[float] = (10.0, 8.0)
    relaxing: Sequence[float] = (6.0, 5.0)
    yield_contraction: Sequence[float] = (0.004, 0.02)
    contracting_growth: float = 2.0
    relaxing_growth: float = 0.0
    edge: float = 0.02
    per_pressure: float = 0.0

    def __post_init__(self) -> None:
        require_elements(self, "contracting", "relaxing", "yield_contraction")
        for argument, unit in (("contracting", "N"), ("relaxing", "N"), ("yield_contraction", "")):
            values = tuple(
                require_positive(f"PrandtlIshlinskii.{argument}", v, unit)
                for v in getattr(self, argument)
            )
            object.__setattr__(self, argument, values)
        for argument in ("contracting_growth", "relaxing_growth"):
            if require_finite(f"PrandtlIshlinskii.{argument}", getattr(self, argument)) < -2:
                raise InputError(
                    f"PrandtlIshlinskii.{argument} = {getattr(self, argument):g} must be >= -2, or "
                    "the friction would vanish within the stroke"
                )
        if not 0 < require_finite("PrandtlIshlinskii.edge", self.edge) <= 1:
            raise InputError(f"PrandtlIshlinskii.edge = {self.edge:g} must lie in 0 .. 1")
        require_scale("PrandtlIshlinskii.per_pressure", self.per_pressure)

    def elements(self, pressure: float = 0.0) -> SlipElements:
        """The sharp operator (edge = 0) at a constant pressure [Pa], with its exact inverse."""
        scale = 1 + self.per_pressure * max(pressure, 0.0)
        return SlipElements(
            [c / y for c, y in zip(self.contracting, self.yield_contraction, strict=True)],
            [scale * c for c in self.contracting],
            [scale * r for r in self.relaxing],
            self.contracting_growth,
            self.relaxing_growth,
        )

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        rate, speed = motion.rate, rounded_speed(plant, name, "play", motion.rate)
        scope = Scope(plant, name)
        edge = scope.of("1", 0.1, min=1e-6, max=1.0, widest=1.0).parameter(
            "play_edge",
            self.edge,
            f"play operators of {name}: passage from sticking to sliding, as part of the force",
        )
        growth = [
            scope.of(min=-2.0).parameter(
                f"play_{way}_growth",
                getattr(self, f"{way}_growth"),
                f"growth of the friction of {name} while {way}, per contraction",
            )
            for way in ("contracting", "relaxing")
        ]
        scale = PressureScale.of(plant, name, "play", self.per_pressure, motion)
        grown = [ca.fmax(1 + g * motion.contraction, SMALLEST) for g in growth]
        top = motion.muscle.contraction_range[1]
        most = [ca.fmax(1 + g * top, 1) for g in growth]
        if scale is not None:
            grown = [g * scale.present for g in grown]
            most = [g * scale.largest for g in most]
        total = ca.SX(0)
        for i in range(len(self.contracting)):
            total += self._element(plant, name, i, (grown, most), rate, speed, edge)
        return total

    def _element(
        self,
        plant: Declares,
        name: str,
        i: int,
        envelopes: tuple[list[ca.SX], list[ca.SX]],
        rate: ca.SX,
        speed: ca.SX,
        edge: ca.SX,
    ) -> ca.SX:
        """Force of one element [N]; its state is the force in units of its largest envelope."""
        (up, down), (most_up, most_down) = envelopes
        scope = Scope(plant, name)
        contracting, relaxing = (
            scope.of("N", 10.0, min=1e-6).parameter(
                f"play{i + 1}_{way}",
                getattr(self, way)[i],
                f"play operator {i + 1} of {name}: friction while {way}",
            )
            for way in ("contracting", "relaxing")
        )
        yielding = scope.of("1", 0.01, min=1e-9, display_unit="%").parameter(
            f"play{i + 1}_yield",
            self.yield_contraction[i],
            f"play operator {i + 1} of {name}: contraction to slide",
        )
        z = scope.of(min=-1.0, max=1.0, memory="held").state(
            f"play{i + 1}", f"play operator {i + 1} of {name}: force as part of its largest"
        )
        largest = ca.fmax(contracting * most_up, relaxing * most_down)
        limits = Limits(contracting * up / largest, relaxing * down / largest)
        stiffness = contracting / (yielding * largest)
        plant.der(z, stiffness * limits.passing(z, rate, speed, edge) + limits.release(z))
        return ca.SX(largest * limits.held(z))


Array: TypeAlias = NDArray[np.float64]
ROUNDING = 1e-14
"""Contractions no farther apart are the same."""
SMALLEST = 0.01
"""Part of an element's friction that its envelopes keep, however far the muscle is stretched."""


@dataclass(eq=False)
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
