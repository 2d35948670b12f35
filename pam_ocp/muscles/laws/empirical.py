"""Laws fitted to measurements: few coefficients, no geometry of the braid."""

# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from ...core.errors import UnknownNameError
from ..law import FloatOrSX, ForceLaw, clamp, coefficient, register
from ..validity import Validity


@register
@dataclass(frozen=True)
class FiveParameterLaw(ForceLaw):
    """F = (a1 p + a2) exp(a3 kappa) + a4 kappa p + a5 p - a2: eq. (3) with a6 = -a2.

    The force at p = 0 then vanishes at kappa = 0, as the definition of the rest length demands.
    That this is how the five-parameter variant is meant is our inference.

    Examples
    --------
    >>> found = pam.fit_force(table, "five-parameter")
    >>> print(f"{found.rmse:.1f} N")
    9.3 N
    """

    a1: FloatOrSX = coefficient("N/Pa", 1e-4, "exponential term, per pressure")
    a2: FloatOrSX = coefficient("N", 100.0, "exponential term; minus the constant")
    a3: FloatOrSX = coefficient("1", 10.0, "exponent of the contraction")
    a4: FloatOrSX = coefficient("N/Pa", 1e-2, "contraction times pressure")
    a5: FloatOrSX = coefficient("N/Pa", 1e-3, "pressure")

    name: ClassVar[str] = "five-parameter"
    title: ClassVar[str] = "Five-parameter law (Sárosi-Fabulya, a6 = -a2)"
    reference: ClassVar[str] = "Sárosi et al., Mech. Mach. Theory 85 (2015) 25-34, eq. (3)"

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        return (
            (self.a1 * p + self.a2) * ca.exp(self.a3 * kappa)
            + self.a4 * kappa * p
            + self.a5 * p
            - self.a2
        )


@register
@dataclass(frozen=True)
class HildebrandtLaw(ForceLaw):
    """F = p (c0 + c1 kappa + c2 kappa^2) - (b0 kappa^(2/3) + b1 + b2 kappa + b3 kappa^2).

    As printed, kappa^(2/3) has an infinite slope at kappa = 0 (infinite stiffness, and poison for
    a solver of Newton's kind). Here it stands as (kappa^2 + delta^2)^(1/3) - delta^(2/3), with
    delta = ``smoothing``: smooth, zero at 0, and for kappa >> delta the printed law with b1 less by
    b0 delta^(2/3), which a fit takes up. Towards delta = 0 it becomes the printed law.

    Source: A. Hildebrandt, O. Sawodny, R. Neumann, A. Hartmann, Proc. American Control
    Conference 2005, for the structure.

    Examples
    --------
    >>> found = pam.fit_force(table, "hildebrandt")
    >>> print(f"{found.rmse:.1f} N")
    4.0 N
    """

    c0: FloatOrSX = coefficient("N/Pa", 1e-3, "pressure")
    c1: FloatOrSX = coefficient("N/Pa", 1e-2, "pressure times contraction")
    c2: FloatOrSX = coefficient("N/Pa", 1e-2, "pressure times contraction squared")
    b0: FloatOrSX = coefficient("N", 1e3, "contraction to the power 2/3")
    b1: FloatOrSX = coefficient("N", 100.0, "constant")
    b2: FloatOrSX = coefficient("N", 1e3, "contraction")
    b3: FloatOrSX = coefficient("N", 1e3, "contraction squared")
    smoothing: FloatOrSX = coefficient(
        "1",
        1e-3,
        "contraction below which the root is smoothed",
        minimum=1e-9,
        fixed=True,
        default=1e-3,
    )

    name: ClassVar[str] = "hildebrandt"
    title: ClassVar[str] = "Polynomial law with a root (Hildebrandt type)"
    reference: ClassVar[str] = "Hildebrandt et al., Proc. American Control Conference 2005"

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        delta = self.smoothing
        root = (kappa**2 + delta**2) ** (1 / 3) - delta ** (2 / 3)
        active = self.c0 + self.c1 * kappa + self.c2 * kappa**2
        return p * active - (self.b0 * root + self.b1 + self.b2 * kappa + self.b3 * kappa**2)

    def _gain_area(self, kappa: Any) -> Any:
        return self.c0 * kappa + self.c1 * kappa**2 / 2 + self.c2 * kappa**3 / 3


_SCALED = {"10": "DMSP-10-scaled", "20": "DMSP-20-scaled", "40": "DMSP-40"}
"""Published sets: diameter [mm] -> where the catalogue has it."""


@register
@dataclass(frozen=True)
class LengthScaledLaw(ForceLaw):
    """F = Fmax(l0) [a0 (exp(-a1 r) - 1) + P exp(-a3 r^2)], r = kappa/kappa_max, P = p/620 kPa.

    Fmax = b1 P0 atan(b2 P0 (l0 - 7.5 mm)), P0 = 620 kPa, is the blocked force at 620 kPa of a
    muscle of rest length l0; kappa_max is its free contraction at 620 kPa, measured on the muscle
    itself (0.15 to 0.175 for 10 mm, growing with length; 0.25 is the maker's nominal figure).
    The one law here with an effect of length. Affine in pressure. Beyond r = 1 it is not stated.

    Source: B. Bolen, A. Hunt and others (Portland State University), sets for 10, 20, 40 mm;
    that Fmax is taken at 620 kPa follows from their published code. For 40 mm they know no
    effect of length (6398.4 N, from the maker's tool): b2 is so large here that atan is pi/2.

    Examples
    --------
    >>> long = pam.muscle("DMSP-20-scaled", rest_length=0.400)
    >>> print(f"{long.blocked_force(6e5):.0f} N")
    1256 N
    """

    a0: FloatOrSX = coefficient("1", 0.1, "passive part", minimum=0.0)
    a1: FloatOrSX = coefficient("1", 10.0, "passive part, exponent", minimum=0.0)
    a3: FloatOrSX = coefficient("1", 1.0, "active part, exponent", minimum=0.0)
    b1: FloatOrSX = coefficient("N/Pa", 1e-3, "blocked force per pressure", minimum=0.0)
    b2: FloatOrSX = coefficient(
        "1/(m.Pa)", 1e-5, "effect of length on the blocked force", minimum=0.0
    )
    max_contraction_ratio: FloatOrSX = coefficient(
        "1", 0.1, "free contraction at 620 kPa", minimum=0.01, maximum=0.45, fixed=True
    )
    rest_length: FloatOrSX = coefficient("m", 0.1, "rest length", minimum=1e-6, fixed=True)
    dead_length: FloatOrSX = coefficient(
        "m", 1e-2, "length at which the force would vanish", fixed=True, default=7.5e-3
    )
    full_pressure: FloatOrSX = coefficient(
        "Pa", 1e5, "pressure to which the law is scaled", minimum=1.0, fixed=True, default=620e3
    )

    name: ClassVar[str] = "length-scaled"
    title: ClassVar[str] = "Length-scaled law (Bolen)"
    reference: ClassVar[str] = "Bolen, Hunt et al., sets for fluidic muscles of 10, 20 and 40 mm"
    validity: ClassVar[Validity] = Validity(
        pressure=(0.0, 6.2e5), contraction=(0.0, 0.45), note="measured to 620 kPa, not stretched"
    )

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        r, full = kappa / self.max_contraction_ratio, self.full_pressure
        blocked = self.b1 * full * ca.atan(self.b2 * full * (self.rest_length - self.dead_length))
        passive = self.a0 * (ca.exp(-self.a1 * r) - 1)
        return blocked * (passive + p / full * ca.exp(-self.a3 * r**2))

    @classmethod
    def from_published(
        cls, diameter: str, rest_length: FloatOrSX, max_contraction_ratio: FloatOrSX = 0.25
    ) -> LengthScaledLaw:
        """The set for "10", "20" or "40" (mm) at a rest length [m] and free contraction."""
        from ..catalogue import catalogue_entry

        if str(diameter) not in _SCALED:
            raise UnknownNameError("diameter [mm] of the length-scaled law", diameter, _SCALED)
        own = {"max_contraction_ratio": max_contraction_ratio, "rest_length": rest_length}
        return cls(**{**catalogue_entry(_SCALED[str(diameter)])["coefficients"], **own})


_THREE_ELEMENT = "Reynolds, Repperger, Phillips, Bandry, Ann. Biomed. Eng. 31 (2003) 310-317"


@register
@dataclass(frozen=True)
class ThreeElementLaw(ForceLaw):
    """F = (f0 + f1 p) - (k0 + k1 p) l0 kappa: contractile element less a spring, affine in p.

    The third element, the damping B, is :meth:`DirectionalDamping.reynolds`.

    Source: D. B. Reynolds, D. W. Repperger, C. A. Phillips, G. Bandry, Annals of Biomedical
    Engineering 31 (2003) 310-317; for 207 to 621 kPa.

    Examples
    --------
    >>> law = pam.laws.ThreeElementLaw.reynolds(rest_length=0.3)
    >>> print(f"{law.tension(4e5, 0.0):.1f} N")  # 179.2 + 1.39 x 400 kPa
    735.2 N
    """

    f0: FloatOrSX = coefficient("N", 100.0, "contractile force, constant")
    f1: FloatOrSX = coefficient("N/Pa", 1e-3, "contractile force, per pressure")
    k0: FloatOrSX = coefficient("N/m", 1e4, "spring, constant")
    k1: FloatOrSX = coefficient("N/(m.Pa)", 1e-2, "spring, per pressure")
    rest_length: FloatOrSX = coefficient("m", 0.1, "rest length", minimum=1e-6, fixed=True)

    name: ClassVar[str] = "three-element"
    title: ClassVar[str] = "Three-element law (Reynolds)"
    reference: ClassVar[str] = _THREE_ELEMENT
    validity: ClassVar[Validity] = Validity(
        pressure=(207e3, 621e3), note="measured at 207 to 621 kPa"
    )

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        return self.f0 + self.f1 * p - (self.k0 + self.k1 * p) * self.rest_length * kappa

    @classmethod
    def reynolds(cls, rest_length: FloatOrSX) -> ThreeElementLaw:
        """Published: F = 179.2 + 1.39 P, K = 5.71 + 0.0307 P (P in kPa, N, N/mm)."""
        return cls(179.2, 1.39e-3, 5.71e3, 0.0307, rest_length)


@register
@dataclass(frozen=True)
class TwoSlopeThreeElementLaw(ForceLaw):
    """F = (f0 + f1 p) - K(p) l0 kappa, K(p) = max(k0 + k1 p, k2 + k3 p).

    The kink of K is smoothed over ``rounding`` (see :func:`clamp`), elsewhere the law is as
    printed. Not affine in pressure. Its damping is :meth:`DirectionalDamping.festo`.

    Source: J. L. Serres et al., Comput. Methods Biomech. Biomed. Engin. 12(4) (2009) 423-430, doi
    10.1080/10255840802654327; the coefficients are printed in its abstract, for 150 to 550 kPa.

    Examples
    --------
    >>> law = pam.laws.TwoSlopeThreeElementLaw.festo(rest_length=0.3)
    >>> print(f"{law.tension(4e5, 0.0):.1f} N")  # 44.6 + 2.91 x 400 kPa
    1208.6 N
    """

    f0: FloatOrSX = coefficient("N", 100.0, "contractile force, constant")
    f1: FloatOrSX = coefficient("N/Pa", 1e-3, "contractile force, per pressure")
    k0: FloatOrSX = coefficient("N/m", 1e4, "spring at low pressure, constant")
    k1: FloatOrSX = coefficient("N/(m.Pa)", 1e-2, "spring at low pressure, per pressure")
    k2: FloatOrSX = coefficient("N/m", 1e4, "spring at high pressure, constant")
    k3: FloatOrSX = coefficient("N/(m.Pa)", 1e-2, "spring at high pressure, per pressure")
    rest_length: FloatOrSX = coefficient("m", 0.1, "rest length", minimum=1e-6, fixed=True)
    rounding: FloatOrSX = coefficient(
        "N/m",
        100.0,
        "half width of the rounded kink of the spring",
        minimum=1e-3,
        fixed=True,
        default=200.0,
    )

    name: ClassVar[str] = "three-element-two-slopes"
    title: ClassVar[str] = "Three-element law with two slopes of the spring (Festo set)"
    reference: ClassVar[str] = (
        "Serres et al., Comput. Methods Biomech. Biomed. Engin. 12(4) (2009) 423-430"
    )
    validity: ClassVar[Validity] = Validity(
        pressure=(150e3, 550e3), note="measured at 150 to 550 kPa"
    )

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        low, high = self.k0 + self.k1 * p, self.k2 + self.k3 * p
        spring = high + clamp(low - high, self.rounding)
        return self.f0 + self.f1 * p - spring * self.rest_length * kappa

    @classmethod
    def festo(cls, rest_length: FloatOrSX) -> TwoSlopeThreeElementLaw:
        """Published: F = 2.91 P + 44.6; K = 32.7 - 0.0321 P to 314 kPa, then 17 + 0.0179 P."""
        return cls(44.6, 2.91e-3, 32.7e3, -0.0321, 17e3, 0.0179, rest_length)
