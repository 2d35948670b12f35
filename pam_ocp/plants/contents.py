"""The air in a muscle as states of a plant: pressure alone, or with temperatures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.system import Declares
from ..muscles.gas import HEAT_CAPACITY, Chamber, Gas, air_mass, energy_balance
from ..muscles.heat import Rubber
from .airflow import Air, Stream

__all__ = ["Warmth", "air_temperature", "balance"]

COLDEST, HOTTEST = 150.0, 700.0
"""Bounds of temperatures [K]: adiabatic venting and filling stay within."""


@dataclass(frozen=True)
class Warmth:
    """What a warm wall does; see :class:`pam_ocp.plants.valves.Filling`."""

    stiffening: ca.SX | None = None
    warm: Callable[[Any], None] | None = None


def _temperature_state(plant: Declares, name: str, start: float, words: str) -> ca.SX:
    return plant.state(
        name,
        unit="K",
        min=COLDEST,
        max=HOTTEST,
        start=start,
        nominal=30.0,
        memory="settling",
        description=words,
    )


def air_temperature(plant: Declares, name: str, gas: Gas, chamber: Chamber) -> ca.SX:
    """Of the air in the muscle: a state where the gas has heat, else that of the surroundings."""
    if gas.heat is None:
        return chamber.temperature
    words = f"temperature of the air in {name}"
    return _temperature_state(plant, f"{name}.temperature", gas.temperature, words)


def balance(
    plant: Declares,
    name: str,
    gas: Gas,
    chamber: Chamber,
    pressure: ca.SX,
    air: Air,
    net: Stream,
    rate: ca.SX,
    declare: Callable[..., Any],
) -> Warmth:
    """State the equations of the air in a muscle; pressure : its state, gauge.
    rate = dkappa/dt [1/s].
    """
    if gas.heat is None:
        plant.der(pressure, chamber.pressure_rate(air.absolute, net.mass, rate))
        return Warmth()
    h = gas.heat.coefficient(air.absolute, air.temperature, declare)
    wall, warmth = chamber.temperature, Warmth()
    if gas.rubber is not None:
        wall = _temperature_state(
            plant, f"{name}.rubber_temperature", gas.temperature, f"temperature of {name} itself"
        )
    heat = h * chamber.area * (wall - air.temperature)
    if gas.rubber is not None:
        warmth = _rubber(plant, gas.rubber, wall, -heat, chamber, declare)
    growing = chamber.slope * rate
    rates = energy_balance(
        air.absolute, air.temperature, chamber.volume, growing, net.mass, net.carried, heat
    )
    plant.der(pressure, rates[0])
    plant.der(air.temperature, rates[1])
    mass = air_mass(air.absolute, chamber.volume, air.temperature)
    for key, value, unit, nominal, words in (
        ("air_mass", mass, "kg", 1e-3, "air in the muscle"),
        ("enthalpy_flow", HEAT_CAPACITY * net.carried, "W", 100.0, "enthalpy into the muscle"),
        ("heat_flow", heat, "W", 10.0, "heat from the wall into the air"),
    ):
        plant.output(
            f"{name}.{key}", value, unit=unit, nominal=nominal, description=f"{words} ({name})"
        )
    return warmth


def _rubber(
    plant: Declares,
    rubber: Rubber,
    temperature: ca.SX,
    heat: ca.SX,
    chamber: Chamber,
    declare: Callable[..., Any],
) -> Warmth:
    """The wall's own temperature, and its effect."""
    capacity, outward, stiffening, reference, share = (
        declare(f"rubber_{key}", value, **attributes)
        for key, value, attributes in (
            ("capacity", rubber.capacity, {"unit": "J/K", "min": 1e-6, "nominal": 100.0}),
            ("outward", rubber.outward, {"unit": "W/K", "min": 0.0}),
            ("stiffening", rubber.stiffening, {"unit": "1/K", "nominal": 1e-3}),
            ("reference", rubber.reference, {"unit": "K", "min": 1.0, "nominal": 300.0}),
            ("warming", rubber.warming, {"min": 0.0}),
        )
    )
    lost, warm = plant.gathered()
    cooling = outward * (temperature - chamber.temperature)
    plant.der(temperature, (heat - cooling + share * lost) / capacity)
    return Warmth(stiffening * (temperature - reference), warm)
