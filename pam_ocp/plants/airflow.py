"""Air on its way: places that hold it, streams between them, and what each stream carries.

Absolute pressures, as in :mod:`pam_ocp.muscles.gas`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.system import Declares
from ..muscles.dead_zone import smooth_step
from ..muscles.gas import LAMINAR_RATIO, iso6358

__all__ = ["Air", "Place", "Stream", "between", "boundless", "holding", "through"]

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
