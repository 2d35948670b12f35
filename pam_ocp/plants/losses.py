"""Losses of muscles: damping, friction, hysteresis, creep, each defined in a file of its kind."""

from __future__ import annotations

from .damping import (
    ConstantDamping,
    CoulombFriction,
    Damping,
    DirectionalDamping,
    Loss,
    StiffnessDamping,
)
from .memory import BoucWen, Creep, MaxwellSlip

__all__ = [
    "BoucWen",
    "ConstantDamping",
    "CoulombFriction",
    "Creep",
    "Damping",
    "DirectionalDamping",
    "Loss",
    "MaxwellSlip",
    "StiffnessDamping",
]
