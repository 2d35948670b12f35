"""The thick-wall law: braid geometry and the energy in the stretched rubber."""

# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from ...core.errors import UnknownNameError
from ..law import FloatOrSX, ForceLaw, coefficient, register
from ..validity import Validity

__all__ = ["ThickWallLaw"]

# diameter, rest length [m]; c0 .. c3 [Pa, Pa/m, Pa/m2, Pa/m3]; correction of the angle [rad]
_PUBLISHED = {
    "DMSP-10-250": (0.010, 0.250, (74.085e6, -689.20e6, 1.837e9, -848.79e6), -0.1),
    "DMSP-20-300": (0.020, 0.300, (93.232e6, -715.29e6, 1.5483e9, -502.95e6), -0.073),
}


@register
@dataclass(frozen=True)
class ThickWallLaw(ForceLaw):
    """F = -p dV/dL + sigma_pe H0 L pi dD/dL - sigma_L H0 pi D.

    The wall is strained along the axis, sigma_L = E(L) (L - L0)/L0, and around it,
    sigma_pe = E(L) (D - D0)/D0; fibres of length Lf do not stretch, so
    D = sqrt(Lf^2 - L^2)/(n pi) with Lf = L0/cos(theta), n = L0 tan(theta)/(pi D0); the gas fills
    V = pi D^2 L/4. E(L) = c0 + c1 L + c2 L^2 + c3 L^3 is fitted, as is the correction dtheta of
    the fibres' angle (in radians).

    As printed. The axial term has the sign opposite to that of a spring, so E is an effective
    modulus rather than that of the rubber (our observation). Affine in pressure.

    Source: M. Martens, I. Boblan, Actuators 2017, 6(4), 33.

    Examples
    --------
    >>> law = pam.muscle("DMSP-20-300-wall").law
    >>> print(f"{law.tension(3e5, 0.10):.0f} N")
    227 N
    """

    c0: FloatOrSX = coefficient("Pa", 1e8, "effective modulus, constant")
    c1: FloatOrSX = coefficient("Pa/m", 1e9, "effective modulus, per length")
    c2: FloatOrSX = coefficient("Pa/m2", 1e9, "effective modulus, per length squared")
    c3: FloatOrSX = coefficient("Pa/m3", 1e9, "effective modulus, per length cubed")
    angle_correction: FloatOrSX = coefficient(
        "rad", 0.1, "correction of the fibres' angle", minimum=-0.4, maximum=0.4
    )
    rest_diameter: FloatOrSX = coefficient(
        "m", 1e-2, "inner diameter at rest D0", minimum=1e-4, fixed=True
    )
    rest_length: FloatOrSX = coefficient("m", 0.1, "rest length L0", minimum=1e-6, fixed=True)
    wall: FloatOrSX = coefficient(
        "m", 1e-3, "thickness of the wall H0", minimum=1e-6, fixed=True, default=1.8e-3
    )
    fibre_angle: FloatOrSX = coefficient(
        "rad",
        0.5,
        "fibres' angle before its correction",
        minimum=0.1,
        maximum=0.95,
        fixed=True,
        default=math.radians(28.6),
    )

    name: ClassVar[str] = "thick-wall"
    title: ClassVar[str] = "Thick-wall energy law (Martens-Boblan)"
    reference: ClassVar[str] = "Martens, Boblan, Actuators 2017, 6(4), 33"
    validity: ClassVar[Validity] = Validity(
        pressure=(0.0, 7e5),
        contraction=(-0.01, 0.27),
        note="E(L) is a cubic fitted to contractions of 0 to 26 %",
    )

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        theta = self.fibre_angle + self.angle_correction
        L0, D0, H0 = self.rest_length, self.rest_diameter, self.wall
        L = L0 * (1 - kappa)
        Lf = L0 / ca.cos(theta)
        n = L0 * ca.tan(theta) / (math.pi * D0)
        D = ca.sqrt(Lf**2 - L**2) / (n * math.pi)
        dD_dL = -L / (n**2 * math.pi**2 * D)
        dV_dL = math.pi / 4 * (D**2 + 2 * L * D * dD_dL)
        E = self.c0 + self.c1 * L + self.c2 * L**2 + self.c3 * L**3
        sigma_L = E * (L - L0) / L0
        sigma_pe = E * (D - D0) / D0
        return -p * dV_dL + sigma_pe * H0 * L * math.pi * dD_dL - sigma_L * H0 * math.pi * D

    @classmethod
    def from_published(cls, muscle: str) -> ThickWallLaw:
        """One of the two published sets: "DMSP-10-250" or "DMSP-20-300"."""
        if muscle not in _PUBLISHED:
            raise UnknownNameError("set of the thick-wall law", muscle, _PUBLISHED)
        diameter, length, moduli, correction = _PUBLISHED[muscle]
        return cls(*moduli, correction, rest_diameter=diameter, rest_length=length)
