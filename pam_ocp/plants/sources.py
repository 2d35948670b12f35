"""What fills a receiver: a compressor, or a regulator at a line of higher pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares
from ..muscles.dead_zone import smooth_step
from ..muscles.gas import REFERENCE_DENSITY, REFERENCE_TEMPERATURE, conductance_from_flow
from .airflow import Air, Place, Stream, between, boundless, through
from .kinds import SOURCES

__all__ = ["Compressor", "PressureRegulator", "Source"]


class Source(Protocol):
    """What brings air into a receiver."""

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, p0: ca.SX
    ) -> Stream:
        """Connect it to the receiver (p0: absolute pressure of the surroundings); its stream."""


@SOURCES.register(units={"flow": "m3/s", "pressure": "Pa", "band": "Pa", "temperature": "K"})
@dataclass(frozen=True)
class Compressor:
    """A compressor: a constant flow of free air that fades out below the pressure where it stops.

    flow : [m3/s] of air at 1 bar absolute and 20 degrees Celsius (100 l/min are 1.67e-3).
    pressure : gauge pressure at which it delivers nothing any more [Pa]. band : below that, over
        which the flow falls, smoothly: in place of the switch's hysteresis, so it never stops short
        and never cycles.
    temperature : of the air delivered, after its cooler [K].
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

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, p0: ca.SX
    ) -> Stream:
        """See :class:`Source`."""
        flow = declare("flow", self.flow, unit="m3/s", min=0.0, nominal=1e-3, tunable=True)
        top = declare("full_pressure", self.pressure, unit="Pa", min=0.0, nominal=1e5)
        band = declare("band", self.band, unit="Pa", min=1.0, nominal=1e4)
        warm = declare("delivery_temperature", self.temperature, unit="K", min=1.0, nominal=300.0)
        share = smooth_step((top + p0 - receiver.air.absolute) / band)
        air = Air(receiver.air.absolute, ca.SX(warm))
        return between(boundless(air), receiver, flow * REFERENCE_DENSITY * share, ca.SX(1))


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
    """A pressure regulator at a line: an orifice, fully open ``band`` below the set pressure.

    pressure : set gauge pressure, at which it closes [Pa]. line : gauge pressure before it [Pa].
    conductance, critical_ratio : C [m3/(s.Pa)] and b of ISO 6358, fully open.
    band : over which it opens [Pa]. temperature : of the line's air [K].

    Its own motion and the relief of too high a pressure are left out.
    """

    pressure: float = 6e5
    line: float = 8e5
    conductance: float = conductance_from_flow(700.0)
    critical_ratio: float = 0.3
    band: float = 3e4
    temperature: float = REFERENCE_TEMPERATURE

    def __post_init__(self) -> None:
        for argument, unit in (
            ("pressure", "Pa"),
            ("line", "Pa"),
            ("conductance", "m3/(s.Pa)"),
            ("band", "Pa"),
            ("temperature", "K"),
        ):
            require_positive(f"PressureRegulator.{argument}", getattr(self, argument), unit)
        if not 0 <= require_finite("PressureRegulator.critical_ratio", self.critical_ratio) < 1:
            raise InputError(
                f"PressureRegulator.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1"
            )

    def fill(
        self, plant: Declares, declare: Callable[..., Any], receiver: Place, p0: ca.SX
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
        opening = smooth_step((top + p0 - receiver.air.absolute) / band)
        return through(boundless(Air(line + p0, ca.SX(warm))), receiver, conductance, b, opening)
