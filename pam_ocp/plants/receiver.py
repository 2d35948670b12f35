"""A receiver of finite volume that several muscles draw from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca

from ..core.errors import require_positive
from ..core.system import Declares
from ..core.variables import Variable
from ..muscles.gas import (
    AMBIENT_PRESSURE,
    GAS_CONSTANT,
    REFERENCE_TEMPERATURE,
    air_mass,
    energy_balance,
)
from .airflow import Air, Place, boundless, holding
from .components import component
from .kinds import SUPPLIES
from .sources import PressureRegulator, Source

__all__ = ["Receiver", "Supply"]


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
        def declare(key: str, value: float, **attributes: Any) -> ca.SX:
            words = attributes.pop("description", key.replace("_", " "))
            return plant.parameter(
                f"{self.name}.{key}", value, description=f"{words} of {self.name}", **attributes
            )

        highest = 0.0 if self.source is None else self.source.highest
        pressure = plant.state(
            f"{self.name}.air_pressure",
            unit="Pa",
            min=0.0,
            max=1.2 * max(self.pressure, highest, 1e5),
            start=self.pressure,
            nominal=1e5,
            memory="held" if self.source is None else "settling",
            description=f"gauge pressure in {self.name}",
        )
        volume = declare("volume", self.volume, unit="m3", min=1e-9, nominal=1e-3)
        outside = declare("temperature", self.temperature, unit="K", min=1.0, nominal=300.0)
        p0 = declare("ambient", self.ambient, unit="Pa", min=1.0, nominal=1e5)
        warm = outside
        if self.wall_conductance is not None:
            warm = plant.state(
                f"{self.name}.air_temperature",
                unit="K",
                min=100.0,
                max=1000.0,
                start=self.temperature,
                nominal=30.0,
                memory="settling",
                description=f"temperature of the air in {self.name}",
            )
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
            self._output(plant, "heat_flow", heat, "W", 1.0, "heat from the wall into the air")
        self._output(plant, "inflow", inflow, "kg/s", 1e-3, "air from the source")
        mass = air_mass(pressure + p0, volume, warm)
        self._output(plant, "air_mass", mass, "kg", 1e-3, "air in it")
        return place

    def _output(
        self, plant: Declares, key: str, value: ca.SX, unit: str, nominal: float, words: str
    ) -> None:
        plant.output(
            f"{self.name}.{key}",
            value,
            unit=unit,
            nominal=nominal,
            description=f"{words} ({self.name})",
        )
