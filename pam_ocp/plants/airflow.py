"""Air on its way: places that hold it, streams between them, and what each stream carries.

Absolute pressures, as in :mod:`pam_ocp.muscles.gas`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.system import Declares
from ..muscles.gas import iso6358

__all__ = ["Air", "Place", "Stream", "between", "boundless", "holding", "through"]


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


def between(one: Place, two: Place, mass: Any, forward: Any = None) -> Stream:
    """A flow from one place to another [kg/s], taken from the one and given to the other.

    It has the temperature of where it comes from; forward : whether that is ``one``, by default
    the flow's own sign.
    """
    temperature = one.air.temperature
    if not ca.is_equal(ca.SX(temperature), ca.SX(two.air.temperature)):
        forward = mass >= 0 if forward is None else forward
        temperature = ca.if_else(forward, temperature, two.air.temperature)
    stream = Stream(ca.SX(mass), ca.SX(mass * temperature))
    one.receive(Stream(-stream.mass, -stream.carried))
    two.receive(stream)
    return stream


def through(
    one: Place, two: Place, conductance: Any, critical_ratio: Any, opening: Any = 1.0
) -> Stream:
    """The flow through an orifice by ISO 6358; its density is that of the air upstream."""
    high, low = one.air, two.air
    temperature, forward = high.temperature, high.absolute >= low.absolute
    if not ca.is_equal(ca.SX(temperature), ca.SX(low.temperature)):
        temperature = ca.if_else(forward, temperature, low.temperature)
    mass = opening * iso6358(high.absolute, low.absolute, conductance, critical_ratio, temperature)
    return between(one, two, mass, forward)
