"""The muscle's own body in a plant: the half of its mass that moves, and what it bears."""

from __future__ import annotations

import casadi as ca

from ..core.system import Declares
from ..muscles.pneumatic_muscle import Muscle

__all__ = ["limit_strength", "moving_half"]


def moving_half(plant: Declares, name: str, muscle: Muscle, symbolic: Muscle) -> ca.SX:
    """Declare the mass of a muscle's body; half of it [kg], 0 (and nothing) where it has none.

    One end stands and the other moves with the load: the body is put to both ends in equal parts.
    (With a speed that rises evenly along it, a third would be its inertia and half its weight.)
    """
    if not muscle.body_mass:
        return ca.SX(0)
    per_length, ends = (
        plant.parameter(
            f"{name}.{key}",
            value,
            unit=unit,
            min=0.0,
            nominal=0.1,
            description=f"{words} of {name}",
        )
        for key, value, unit, words in (
            ("mass_per_length", muscle.mass_per_length, "kg/m", "mass per length of the body"),
            ("end_mass", muscle.end_mass, "kg", "mass of both ends together"),
        )
    )
    return ca.SX((symbolic.rest_length * per_length + ends) / 2)


def limit_strength(
    plant: Declares, name: str, muscle: Muscle, pressure: ca.SX, force: ca.SX
) -> None:
    """Declare the path constraints of burst and pull-off where the muscle says what it bears."""
    for key, largest, value, unit, nominal, words in (
        (
            "to_burst",
            muscle.burst_pressure,
            pressure,
            "Pa",
            1e5,
            "left of pressure before it bursts",
        ),
        (
            "to_pull_off",
            muscle.pull_off,
            force,
            "N",
            100.0,
            "left of force before an end comes off",
        ),
    ):
        if largest is None:
            continue
        limit = plant.parameter(
            f"{name}.{key.removeprefix('to_')}",
            largest,
            unit=unit,
            min=1e-6,
            nominal=nominal,
            description=f"{'pressure' if unit == 'Pa' else 'force'} that {name} just bears",
        )
        plant.constraint(
            f"{name}.{key}",
            limit - value,
            unit=unit,
            nominal=nominal,
            min=0.0,
            description=f"{words} ({name})",
        )
