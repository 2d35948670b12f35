"""Laws from the geometry of the braid, an inextensible helix around a cylinder: with a thin wall,
and with the energy in a thick one of rubber.
"""
# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from ...core.errors import UnknownNameError
from ..law import FloatOrSX, ForceLaw, coefficient, register
from ..validity import Validity


def _angle() -> Any:
    """alpha0; outside its range a braid is no muscle: from 54.7 degrees on it pushes."""
    return coefficient(
        "rad",
        0.4,
        "braid angle at rest, to the muscle's axis",
        minimum=math.radians(5.0),
        maximum=math.radians(54.7),
    )


def _radius() -> Any:
    return coefficient("m", 1e-2, "inner radius at rest r0", minimum=1e-4, fixed=True)


def _braid_force(p: ca.SX, shortening: ca.SX, radius: FloatOrSX, alpha0: FloatOrSX) -> ca.SX:
    """pi r0^2 p [3 (1-kappa)^2 / tan^2(alpha0) - 1 / sin^2(alpha0)], eq. (2)."""
    active = 3 * (1 - shortening) ** 2 / ca.tan(alpha0) ** 2 - 1 / ca.sin(alpha0) ** 2
    return math.pi * radius**2 * p * active


@register
@dataclass(frozen=True)
class GeometricLaw(ForceLaw):
    """F = pi r0^2 p [3 (1 - kappa)^2 / tan^2(alpha0) - 1 / sin^2(alpha0)]: the ideal McKibben.

    Virtual work of a cylinder whose fibres do not stretch, without wall: F = -p dV/dl.
    It holds only while the wall is thin, about 1/10 of the inner radius; that of a fluidic muscle
    is thicker (1.8 mm on 5 or 10 mm) and takes up work, so even with alpha0 fitted the RMSE is
    11 to 17 % of the largest force measured.

    Source: C.-P. Chou, B. Hannaford, IEEE Trans. Robot. Autom. 12 (1996) 90-102; eq. (2) of the
    source paper.

    Examples
    --------
    >>> law = pam.laws.GeometricLaw(alpha0=0.44, radius=0.010)
    >>> law.tension(0.0, 0.1) == 0.0
    True
    """

    alpha0: FloatOrSX = _angle()
    radius: FloatOrSX = _radius()

    name: ClassVar[str] = "geometric"
    title: ClassVar[str] = "Geometric law (Chou-Hannaford)"
    reference: ClassVar[str] = "Chou, Hannaford, IEEE Trans. Robot. Autom. 12 (1996) 90-102"

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        return _braid_force(p, kappa, self.radius, self.alpha0)


@register
@dataclass(frozen=True)
class CorrectedLaw(ForceLaw):
    """The geometric law at eps(p) kappa, with eps(p) = a_e exp(-p) + b_e (p in bar).

    The factor stands for the ends that stay conical: they shorten the active length, the less
    the higher the pressure. Said to hold to 200 kPa. Not affine in pressure, so its inverse is a
    root.

    Source: B. Tondu, P. Lopez, IEEE Control Systems Magazine 20 (2000) 15-38, and their
    successors, for the pressure-dependent factor.

    Examples
    --------
    >>> law = pam.laws.CorrectedLaw(alpha0=0.44, a_e=0.1, b_e=1.2, radius=0.010)
    >>> bool(law.tension(2e5, 0.05) > law.tension(2e5, 0.10) > 0)
    True
    """

    alpha0: FloatOrSX = _angle()
    a_e: FloatOrSX = coefficient("1", 1.0, "pressure-dependent part of the contraction factor")
    b_e: FloatOrSX = coefficient("1", 1.0, "constant part of the contraction factor")
    radius: FloatOrSX = _radius()
    unit_pressure: FloatOrSX = coefficient(
        "Pa", 1e5, "pressure that counts as 1 in the exponent", minimum=1.0, fixed=True, default=1e5
    )

    name: ClassVar[str] = "corrected"
    title: ClassVar[str] = "Geometric law with corrected contraction (Tondu-Lopez)"
    reference: ClassVar[str] = "Tondu, Lopez, IEEE Control Syst. Mag. 20 (2000) 15-38"
    validity: ClassVar[Validity] = Validity(
        pressure=(0.0, 2e5), note="the correction is stated for at most 200 kPa"
    )

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        eps = self.a_e * ca.exp(-p / self.unit_pressure) + self.b_e
        return _braid_force(p, eps * kappa, self.radius, self.alpha0)


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
        from ..catalogue import catalogue_entry, muscle_names

        known = [n.removesuffix("-wall") for n in muscle_names() if n.endswith("-wall")]
        if muscle not in known:
            raise UnknownNameError("set of the thick-wall law", muscle, known)
        entry = catalogue_entry(f"{muscle}-wall")
        return cls(**entry["coefficients"], rest_length=entry["rest_length"])
