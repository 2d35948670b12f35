"""A receiver of finite volume that several muscles draw from, and what fills it: a compressor, or a
regulator at a line of higher pressure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..core.variables import Variable
from ..muscles.dead_zone import smooth_step, two_ways
from ..muscles.gas import (
    AMBIENT_PRESSURE,
    GAS_CONSTANT,
    REFERENCE_DENSITY,
    REFERENCE_TEMPERATURE,
    air_mass,
    conductance_from_flow,
    energy_balance,
)
from .airflow import Air, Place, Stream, between, boundless, declaring, holding, show, through
from .components import component
from .kinds import SOURCES, SUPPLIES


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


class Supply(Protocol):
    """Where valves get their air from, with states of its own."""

    def connect(self, plant: Declares) -> Place:
        """The place that a valve draws from; declared once, however many valves there are."""


@SUPPLIES.register(
    units={
        "volume": "m3",
        "pressure": "Pa",
        "wall_conductance": "W/K",
        "temperature": "K",
        "ambient": "Pa",
    }
)
@dataclass(frozen=True)
class Receiver:
    """A receiver of finite volume, shared by the muscles that it supplies.

    volume : [m3], with the manifold. pressure : gauge pressure at the start [Pa].
    source : what fills it, ``PressureRegulator(...)`` (default) or ``Compressor(...)``; None:
        nothing does, and it is emptied.
    wall_conductance : heat from its wall to its air [W/K]: its temperature becomes the state
        ``<name>.air_temperature``, 0 is adiabatic; None holds it isothermal.
    temperature : of the surroundings and the wall [K]. ambient : [Pa absolute].
    name : of its variables. All feeds of a plant whose receivers are equal share one.

    State ``<name>.air_pressure`` [Pa gauge]; outputs ``<name>.air_mass`` [kg] and ``<name>.inflow``
    (from the source [kg/s]).

    Examples
    --------
    >>> tank = pam.feeds.Receiver(2e-3, pressure=6e5)
    >>> both = pam.AntagonisticSlide(muscle, feed=pam.feeds.SpoolValve(supply=tank))
    >>> [v.name for v in both.states if "receiver" in v.name]  # one for both muscles
    ['receiver.air_pressure']
    """

    volume: float = 2e-3
    pressure: float = 6e5
    source: Source | None = field(default_factory=PressureRegulator)
    wall_conductance: float | None = None
    temperature: float = REFERENCE_TEMPERATURE
    ambient: float = AMBIENT_PRESSURE
    name: str = "receiver"

    def __post_init__(self) -> None:
        require_positive("Receiver.volume", self.volume, "m3")
        require_positive("Receiver.pressure", self.pressure, "Pa", zero=True)
        require_positive("Receiver.temperature", self.temperature, "K")
        require_positive("Receiver.ambient", self.ambient, "Pa")
        if self.wall_conductance is not None:
            require_positive("Receiver.wall_conductance", self.wall_conductance, "W/K", zero=True)
        if self.source is not None:
            component("source", self.source, "fill", "PressureRegulator() or Compressor()")
        Variable(self.name, "parameter")  # the rule for names

    def connect(self, plant: Declares) -> Place:
        """See :class:`Supply`."""
        return plant.shared(self.name, self, lambda: self._declared(plant))

    def _declared(self, plant: Declares) -> Place:
        declare = declaring(plant, self.name, f"of {self.name}")
        highest = 0.0 if self.source is None else self.source.highest
        scope = Scope(plant, self.name)
        pressure = scope.of(
            "Pa",
            1e5,
            min=0.0,
            max=1.2 * max(self.pressure, highest, 1e5),
            start=self.pressure,
            memory="held" if self.source is None else "settling",
        ).state("air_pressure", f"gauge pressure in {self.name}")
        volume = declare("volume", self.volume, unit="m3", min=1e-9, nominal=1e-3)
        outside = declare("temperature", self.temperature, unit="K", min=1.0, nominal=300.0)
        p0 = declare("ambient", self.ambient, unit="Pa", min=1.0, nominal=1e5)
        warm = outside
        if self.wall_conductance is not None:
            warm = scope.of(
                "K", 30.0, min=100.0, max=1000.0, start=self.temperature, memory="settling"
            ).state("air_temperature", f"temperature of the air in {self.name}")
        place, net = holding(plant, Air(pressure + p0, warm))
        inflow = ca.SX(0)
        if self.source is not None:
            around = boundless(Air(p0, outside))
            inflow = self.source.fill(plant, declare, place, around).mass
        if self.wall_conductance is None:
            plant.der(pressure, GAS_CONSTANT * warm * net.mass / volume)
        else:
            conductance = declare(
                "wall_conductance", self.wall_conductance, unit="W/K", min=0.0, nominal=1.0
            )
            heat = conductance * (outside - warm)
            rates = energy_balance(pressure + p0, warm, volume, 0.0, net.mass, net.carried, heat)
            plant.der(pressure, rates[0])
            plant.der(warm, rates[1])
            words = "heat from the wall into the air"
            show(plant, self.name, ("heat_flow", heat, "W", 1.0, words))
        mass = air_mass(pressure + p0, volume, warm)
        show(
            plant,
            self.name,
            ("inflow", inflow, "kg/s", 1e-3, "air from the source"),
            ("air_mass", mass, "kg", 1e-3, "air in it"),
        )
        return place
