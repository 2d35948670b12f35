"""Losses of muscles: damping, friction, hysteresis, creep, each defined in a file of its kind."""

from __future__ import annotations

from .damping import (
    ConstantDamping,
    CoulombFriction,
    Damping,
    DirectionalDamping,
    ForceVelocity,
    Loss,
    StiffnessDamping,
)
from .memory import BoucWen, Creep, LoadCreep, MaxwellSlip, Preconditioning
from .prandtl_ishlinskii import PrandtlIshlinskii, SlipElements
from .strand_friction import StrandFriction

__all__ = [
    "BoucWen",
    "ConstantDamping",
    "CoulombFriction",
    "Creep",
    "Damping",
    "DirectionalDamping",
    "ForceVelocity",
    "LoadCreep",
    "Loss",
    "MaxwellSlip",
    "PrandtlIshlinskii",
    "Preconditioning",
    "SlipElements",
    "StiffnessDamping",
    "StrandFriction",
]
