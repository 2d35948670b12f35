"""What a muscle gives: mechanical power with every feed, and on request work and efficiency."""

from __future__ import annotations

import casadi as ca

from ..core.system import Declares
from .valves import EXERGY_FLOOR

__all__ = ["meter_pneumatics", "meter_work"]


def meter_work(
    plant: Declares, name: str, force: ca.SX, velocity: ca.SX, mass: float | None, totals: bool
) -> ca.SX | None:
    """Declare ``<name>.power`` = F times the speed of shortening [m/s], and what follows from it.

    mass : of the muscle [kg]; known, power (and work) per mass are outputs too.
    totals : add the state ``<name>.work``, the integral of the power, which is returned.
    """
    power = ca.SX(force * velocity)
    per_mass = [("power_per_mass", power, "W/kg", "mechanical power per mass")]
    plant.output(
        f"{name}.power",
        power,
        unit="W",
        nominal=100.0,
        description=f"mechanical power out of {name}",
    )
    work = None
    if totals:
        work = plant.state(
            f"{name}.work", unit="J", nominal=10.0, description=f"mechanical work of {name}"
        )
        plant.der(work, power)
        per_mass.append(("work_per_mass", work, "J/kg", "mechanical work per mass"))
    if mass is not None:
        own = plant.parameter(
            f"{name}.own_mass",
            mass,
            unit="kg",
            min=1e-6,
            nominal=0.1,
            description=f"mass of {name} itself",
        )
        for key, value, unit, words in per_mass:
            plant.output(
                f"{name}.{key}",
                value / own,
                unit=unit,
                nominal=100.0,
                description=f"{words} ({name})",
            )
    return work


def meter_pneumatics(
    plant: Declares, name: str, pressure: ca.SX, gain: ca.SX, velocity: ca.SX, work: ca.SX
) -> None:
    """Declare what a feed without gas puts into the muscle, the integral of p dV, and the
    efficiency.

    gain : dF/dp = -dV/dl [N/Pa], so that p dV/dt = p gain velocity whatever the volume at rest. In
    this sense a law that is linear in pressure loses nothing over a cycle; losses take their share.
    """
    spent = plant.state(
        f"{name}.pneumatic_work",
        unit="J",
        nominal=10.0,
        description=f"pressure times change of volume, put into {name}",
    )
    plant.der(spent, pressure * gain * velocity)
    plant.output(
        f"{name}.efficiency",
        work / ca.sqrt(spent**2 + EXERGY_FLOOR**2),
        description=f"work per pneumatic work ({name})",
    )
