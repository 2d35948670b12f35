"""What fills a receiver: a compressor, or a regulator at a line of higher pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares
from ..muscles.dead_zone import smooth_step, two_ways
from ..muscles.gas import REFERENCE_DENSITY, REFERENCE_TEMPERATURE, conductance_from_flow
from .airflow import Air, Place, Stream, between, boundless, through
from .kinds import SOURCES

__all__ = ["Compressor", "PressureRegulator", "Source"]


class Source(Protocol):
    """What brings air into a receiver."""

    @property
    def highest(self) -> float:
        """The largest gauge pressure [Pa] that it brings about."""

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, outside: Place
    ) -> Stream:
        """Connect it to the receiver (outside: the surroundings); its stream into it."""


@SOURCES.register(units={"flow": "m3/s", "pressure": "Pa", "band": "Pa", "temperature": "K"})
@dataclass(frozen=True)
class Compressor:
    """A compressor: a constant flow of free air that fades out below the pressure where it stops.

    flow : [m3/s] of air at 1 bar absolute and 20 degrees Celsius (100 l/min are 1.67e-3).
    pressure : gauge pressure at which it delivers nothing any more [Pa]. band : below that, over
        which the flow falls to nothing: in place of a switch, so it never cycles.
    temperature : of the air delivered, after its cooler [K].

    Examples
    --------
    >>> tank = pam.feeds.Receiver(2e-3, source=pam.feeds.Compressor(flow=1.67e-3))
    >>> fed = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.SpoolValve(supply=tank))
    >>> fed.variable("receiver.air_pressure").start
    600000.0
    """

    flow: float = 1e-3
    pressure: float = 8e5
    band: float = 5e4
    temperature: float = REFERENCE_TEMPERATURE

    def __post_init__(self) -> None:
        require_positive("Compressor.flow", self.flow, "m3/s")
        require_positive("Compressor.pressure", self.pressure, "Pa")
        require_positive("Compressor.band", self.band, "Pa")
        require_positive("Compressor.temperature", self.temperature, "K")

    @property
    def highest(self) -> float:
        """See :class:`Source`."""
        return self.pressure

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, outside: Place
    ) -> Stream:
        """See :class:`Source`."""
        flow = declare("flow", self.flow, unit="m3/s", min=0.0, nominal=1e-3, tunable=True)
        top = declare("full_pressure", self.pressure, unit="Pa", min=0.0, nominal=1e5)
        band = declare("band", self.band, unit="Pa", min=1.0, nominal=1e4)
        warm = declare("delivery_temperature", self.temperature, unit="K", min=1.0, nominal=300.0)
        missing = top + outside.air.absolute - receiver.air.absolute
        share = ca.fmax(ca.fmin(missing / band, 1.0), 0.0)
        air = Air(receiver.air.absolute, ca.SX(warm))
        return between(boundless(air), receiver, flow * REFERENCE_DENSITY * share)


@SOURCES.register(
    units={
        "pressure": "Pa",
        "line": "Pa",
        "conductance": "m3/(s.Pa)",
        "band": "Pa",
        "temperature": "K",
    }
)
@dataclass(frozen=True)
class PressureRegulator:
    """A self-relieving pressure regulator at a line of higher pressure, shut at its set pressure.

    Its opening is an odd, rounded ramp over the deviation: fully open to the line ``band`` below
    the set pressure, fully open to ambient ``band`` above it, there with ``relief`` of the
    conductance.

    pressure : set gauge pressure [Pa]. line : gauge pressure before it [Pa].
    conductance, critical_ratio : C [m3/(s.Pa)] and b of ISO 6358, fully open.
    band : over which it opens [Pa]. temperature : of the line's air [K].
    relief : 0 .. 1; 0 for none: then any pressure above the set one is one of rest.

    Its own motion is left out.

    Examples
    --------
    >>> source = pam.feeds.PressureRegulator(pressure=5e5, line=8e5)
    >>> feed = pam.feeds.SpoolValve(supply=pam.feeds.Receiver(source=source))
    >>> "receiver.inflow" in [v.name for v in pam.HangingLoad(muscle, feed=feed).outputs]
    True
    """

    pressure: float = 6e5
    line: float = 8e5
    conductance: float = conductance_from_flow(700.0)
    critical_ratio: float = 0.3
    band: float = 3e4
    temperature: float = REFERENCE_TEMPERATURE
    relief: float = 0.1

    def __post_init__(self) -> None:
        for argument, unit in (
            ("pressure", "Pa"),
            ("line", "Pa"),
            ("conductance", "m3/(s.Pa)"),
            ("band", "Pa"),
            ("temperature", "K"),
        ):
            require_positive(f"PressureRegulator.{argument}", getattr(self, argument), unit)
        if not 0 <= require_finite("PressureRegulator.relief", self.relief) <= 1:
            raise InputError(f"PressureRegulator.relief = {self.relief:g} must lie in 0 .. 1")
        if not 0 <= require_finite("PressureRegulator.critical_ratio", self.critical_ratio) < 1:
            raise InputError(
                f"PressureRegulator.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1"
            )

    @property
    def highest(self) -> float:
        """See :class:`Source`."""
        return self.pressure

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, outside: Place
    ) -> Stream:
        """See :class:`Source`."""
        top = declare("set_pressure", self.pressure, unit="Pa", min=0.0, nominal=1e5, tunable=True)
        line = declare("line_pressure", self.line, unit="Pa", min=0.0, nominal=1e5, tunable=True)
        conductance = declare(
            "conductance", self.conductance, unit="m3/(s.Pa)", min=0.0, nominal=1e-8
        )
        b = declare("critical_ratio", self.critical_ratio, min=0.0, max=0.99)
        band = declare("band", self.band, unit="Pa", min=1.0, nominal=1e4)
        warm = declare("line_temperature", self.temperature, unit="K", min=1.0, nominal=300.0)
        relief = declare("relief", self.relief, min=0.0, max=1.0)
        p0 = outside.air.absolute
        missing = top + p0 - receiver.air.absolute
        ramp = 2 * smooth_step((missing / band + 1) / 2) - 1
        place = boundless(Air(line + p0, ca.SX(warm)))
        filling, relieving = two_ways(ca.SX(ramp))
        drawn = through(place, receiver, conductance, b, filling)
        vented = through(receiver, outside, conductance, b, relief * relieving)
        return Stream(drawn.mass - vented.mass, drawn.carried - vented.carried)
