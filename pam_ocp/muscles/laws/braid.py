"""Laws from the geometry of the braid: a thin-walled cylinder in an inextensible helix."""
# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from ..law import FloatOrSX, ForceLaw, coefficient, register
from ..validity import Validity

__all__ = ["CorrectedLaw", "GeometricLaw"]


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
