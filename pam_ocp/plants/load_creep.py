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
from .memory import require_elements

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
    """

    stiffness: Sequence[float] = (500.0,)
    time: Sequence[float] = (2.0,)
    load: float = 500.0

    def __post_init__(self) -> None:
        require_elements(self, "stiffness", "time")
        for argument, unit, zero in (("stiffness", "N", True), ("time", "s", False)):
            values = tuple(
                require_positive(f"LoadCreep.{argument}", v, unit, zero=zero)
                for v in getattr(self, argument)
            )
            object.__setattr__(self, argument, values)
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
        total = ca.SX(0)
        for i, (value, time) in enumerate(zip(self.stiffness, self.time, strict=True), start=1):
            stiffness = plant.parameter(
                f"{name}.load_creep{i}_stiffness",
                value,
                unit="N",
                min=0.0,
                nominal=1e3,
                description=f"creep element {i} of {name}: force per contraction",
            )
            tau = plant.parameter(
                f"{name}.load_creep{i}_time",
                time,
                unit="s",
                min=1e-6,
                nominal=1.0,
                description=f"creep element {i} of {name}: relaxation time without load",
            )
            settled = plant.state(
                f"{name}.load_creep{i}",
                nominal=0.1,
                display_unit="%",
                memory="settling",
                description=f"creep element {i} of {name}: contraction to which it has settled",
            )
            plant.der(settled, (1 + carried / load) * (motion.contraction - settled) / tau)
            total += stiffness * (motion.contraction - settled)
        return total
