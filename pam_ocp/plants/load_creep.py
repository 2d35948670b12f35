"""Creep that is the quicker and the larger, the more the muscle carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from ..core.errors import require_positive
from ..core.system import Declares
from ..muscles.law import clamp
from .damping import Motion
from .kinds import LOSSES
from .memory import creep_force, require_creep

__all__ = ["LoadCreep"]


@LOSSES.register(units={"stiffness": "N", "time": "s", "load": "N"})
@dataclass(frozen=True)
class LoadCreep:
    """F = sum K_i (kappa - e_i), de_i/dt = (1 + T/load) (kappa - e_i)/tau_i, T the law's tension.

    :class:`Creep` whose dashpots flow the more quickly, the more the muscle carries: in a hold of
    given length it creeps the farther, the larger the load, and as the load goes to zero, or
    ``load`` to infinity, it is Creep itself. It dissipates whatever the load does, since no energy
    depends on it.

    stiffness : K_i [N] per unit contraction. time : tau_i without load [s], as many.
    load : tension [N] at which it creeps twice as quickly.

    Source: flow helped by load, H. Eyring, J. Chem. Phys. 4 (1936) 283-291, of which this is the
    first order; the form for a muscle is our choice. Where a record of one load only is at hand,
    use Creep. The states start at 0; see there.

    Examples
    --------
    >>> loss = pam.losses.LoadCreep(stiffness=(500.0,), time=(2.0,), load=500.0)
    >>> [v.name for v in pam.HangingLoad(muscle, losses=loss).states][-1]
    'muscle.load_creep1'
    """

    stiffness: Sequence[float] = (500.0,)
    time: Sequence[float] = (2.0,)
    load: float = 500.0

    def __post_init__(self) -> None:
        require_creep(self)
        require_positive("LoadCreep.load", self.load, "N")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        load = plant.parameter(
            f"{name}.creep_load",
            self.load,
            unit="N",
            min=1e-3,
            nominal=100.0,
            description=f"tension at which {name} creeps twice as quickly as without",
        )
        muscle = motion.muscle
        carried = clamp(muscle.tension(motion.pressure, motion.contraction), muscle.slack_width)
        return creep_force(
            plant,
            name,
            "load_creep",
            self.stiffness,
            self.time,
            motion,
            quicker=1 + carried / load,
            words="relaxation time without load",
        )
