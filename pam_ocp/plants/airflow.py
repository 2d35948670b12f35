"""Air on its way: places that hold it, streams between them, what each stream carries, and the
balance of the air in a muscle.

Absolute pressures, as in :mod:`pam_ocp.muscles.gas`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.system import Declares, Scope
from ..muscles.dead_zone import smooth_step
from ..muscles.gas import (
    HEAT_CAPACITY,
    LAMINAR_RATIO,
    Chamber,
    Gas,
    air_mass,
    energy_balance,
    iso6358,
)
from ..muscles.heat import Rubber

ROUNDING = 1e-5
"""Flows in tubes [kg/s] below this carry air of both temperatures: some 1 % of a usual flow."""

COLDEST = 20.0
"""No stream is colder [K]: trial steps of integrators go below zero, where its density has no root.
"""


@dataclass(frozen=True)
class Air:
    """Absolute pressure [Pa] and temperature [K] of the air in a place."""

    absolute: ca.SX
    temperature: ca.SX


@dataclass(frozen=True)
class Stream:
    """A flow of air: its mass [kg/s], and that times its temperature [kg.K/s]; cp times this is
    its enthalpy.
    """

    mass: ca.SX
    carried: ca.SX


@dataclass(frozen=True)
class Place:
    """Where air is: its state, and what takes up the streams that come in (negative: go out)."""

    air: Air
    receive: Callable[[Stream], None]


def boundless(air: Air) -> Place:
    """A place that no stream changes: the surroundings, a large supply."""
    return Place(air, lambda _: None)


def holding(plant: Declares, air: Air) -> tuple[Place, Stream]:
    """A place and the sum of the streams into it, whatever is still to be connected there."""
    mass, add_mass = plant.gathered()
    carried, add_carried = plant.gathered()

    def receive(stream: Stream) -> None:
        add_mass(stream.mass)
        add_carried(stream.carried)

    return Place(air, receive), Stream(mass, carried)


def between(one: Place, two: Place, mass: Any) -> Stream:
    """A flow from one place to another [kg/s], taken from the one and given to the other.

    It has the temperature of where it comes from; below ``ROUNDING`` the two are mixed.
    """
    return _passed(one, two, ca.SX(mass), _upwind(one, two, mass / ROUNDING))


def _passed(one: Place, two: Place, mass: ca.SX, temperature: ca.SX) -> Stream:
    stream = Stream(mass, ca.SX(mass * temperature))
    one.receive(Stream(-stream.mass, -stream.carried))
    two.receive(stream)
    return stream


def through(
    one: Place, two: Place, conductance: Any, critical_ratio: Any, opening: Any = 1.0
) -> Stream:
    """The flow through an orifice by ISO 6358, of the temperature upstream.

    Within the laminar part of the flow (pressures nearly equal) the two temperatures are mixed.
    """
    high, low = one.air.absolute, two.air.absolute
    laminar = (high - low) / ((1 - LAMINAR_RATIO) * ca.fmax(high, low))
    temperature = _upwind(one, two, laminar)
    mass = opening * iso6358(high, low, conductance, critical_ratio, temperature)
    return _passed(one, two, ca.SX(mass), temperature)


def _upwind(one: Place, two: Place, flow: Any) -> ca.SX:
    """The temperature of ``one`` from flow 1 on, of ``two`` below -1, smooth between: a kink would
    stop solvers.
    """
    here, there = ca.SX(one.air.temperature), ca.SX(two.air.temperature)
    if ca.is_equal(here, there):
        return here
    mixed = there + smooth_step((flow + 1) / 2) * (here - there)
    return ca.SX(ca.fmax(mixed, COLDEST))


LEAST_TEMPERATURE, LARGEST_TEMPERATURE = 150.0, 700.0
"""Bounds of temperatures [K]: adiabatic venting and filling stay within."""


@dataclass(frozen=True)
class Warmth:
    """What a warm wall does; see :class:`pam_ocp.plants.valves.Filling`."""

    stiffening: ca.SX | None = None
    warm: Callable[[Any], None] | None = None


def _temperature_state(plant: Declares, name: str, start: float, words: str) -> ca.SX:
    low, high = LEAST_TEMPERATURE, LARGEST_TEMPERATURE
    scope = Scope(plant).of("K", 30.0, min=low, max=high, start=start, memory="settling")
    return scope.state(name, words)


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
    show(
        plant,
        name,
        ("air_mass", mass, "kg", 1e-3, "air in the muscle"),
        ("enthalpy_flow", HEAT_CAPACITY * net.carried, "W", 100.0, "enthalpy into the muscle"),
        ("heat_flow", heat, "W", 10.0, "heat from the wall into the air"),
    )
    return warmth


def declaring(plant: Declares, prefix: str, whose: str) -> Callable[..., Any]:
    """What declares parameters ``<prefix>.<key>``, described by its key unless by other words."""

    def declare(
        key: str,
        value: float,
        unit: str = "1",
        nominal: float = 1.0,
        description: str = "",
        **attributes: Any,
    ) -> ca.SX:
        scope = Scope(plant, prefix).of(unit, nominal, **attributes)
        return scope.parameter(key, value, f"{description or key.replace('_', ' ')} {whose}")

    return declare


def show(plant: Declares, name: str, *shown: tuple[str, ca.SX, str, float, str]) -> None:
    """Declare outputs ``<name>.<key>``: (key, value, unit, nominal, words) of each."""
    for key, value, unit, nominal, words in shown:
        Scope(plant, name).of(unit, nominal).output(key, value, f"{words} ({name})")


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
        declare(f"rubber_{key}", value, unit, nominal, min=low)
        for key, value, unit, nominal, low in (
            ("capacity", rubber.capacity, "J/K", 100.0, 1e-6),
            ("outward", rubber.outward, "W/K", 1.0, 0.0),
            ("stiffening", rubber.stiffening, "1/K", 1e-3, -ca.inf),
            ("reference", rubber.reference, "K", 300.0, 1.0),
            ("warming", rubber.warming, "1", 1.0, 0.0),
        )
    )
    lost, warm = plant.gathered()
    cooling = outward * (temperature - chamber.temperature)
    plant.der(temperature, (heat - cooling + share * lost) / capacity)
    return Warmth(stiffening * (temperature - reference), warm)
