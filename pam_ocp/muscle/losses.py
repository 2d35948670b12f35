"""Losses: what takes energy out of a muscle's motion. Components that a plant is built with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import casadi as ca

from ..errors import require_positive

if TYPE_CHECKING:
    from ..plant.plant import Plant

__all__ = ["ConstantDamping", "Damping", "StiffnessDamping"]

STIFFNESS_FLOOR = 1.0
"""Below about this stiffness [N/m] the square root of StiffnessDamping is rounded off."""


class Damping(Protocol):
    """A viscous damping c [N.s/m] that may depend on the state."""

    def coefficient(self, plant: Plant, mass: ca.SX, stiffness: ca.SX) -> ca.SX:
        """c [N.s/m] for a moving ``mass`` [kg] on ``stiffness`` [N/m]; adds its parameters."""


@dataclass(frozen=True)
class ConstantDamping:
    """c = constant [N.s/m]."""

    value: float = 20.0

    def __post_init__(self) -> None:
        require_positive("ConstantDamping.value", self.value, "N.s/m", zero=True)

    def coefficient(self, plant: Plant, mass: ca.SX, stiffness: ca.SX) -> ca.SX:
        return plant.parameter(
            "damping", self.value, unit="N.s/m", min=0.0, nominal=10.0, tunable=True,
            description="viscous damping coefficient",
        )  # fmt: skip


@dataclass(frozen=True)
class StiffnessDamping:
    """c = 2 zeta sqrt(m k): a constant damping ratio, so c is a nonlinear function of displacement.

    Our reconstruction of the source paper's damping "as nonlinear function of displacement"; k is
    the stiffness at the present pressure and contraction. Where it falls to zero (slack) the root
    is rounded off below STIFFNESS_FLOOR, so that its slope stays finite.
    """

    ratio: float = 0.1

    def __post_init__(self) -> None:
        require_positive("StiffnessDamping.ratio", self.ratio, zero=True)

    def coefficient(self, plant: Plant, mass: ca.SX, stiffness: ca.SX) -> ca.SX:
        ratio = plant.parameter(
            "damping_ratio", self.ratio, min=0.0, nominal=0.1, tunable=True,
            description="damping ratio zeta of c = 2 zeta sqrt(m k)",
        )  # fmt: skip
        rounded = (stiffness + ca.sqrt(stiffness**2 + STIFFNESS_FLOOR**2)) / 2
        return 2 * ratio * ca.sqrt(mass * rounded)
