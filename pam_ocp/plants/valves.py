"""Feeds of air: valves by ISO 6358, a tube, a leak, and what air and work they cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares
from ..muscles.dead_zone import LEAST_OVERLAP, beyond_dead_zone, dead_zone_inverse, two_ways
from ..muscles.gas import Chamber, Gas, conductance_from_flow, iso6358, specific_exergy
from ..muscles.pneumatic_muscle import Muscle
from .kinds import FEEDS, TUBES

__all__ = ["Air", "GasFeed", "OnOffValves", "SpoolValve", "Tube"]

LOWEST_PRESSURE = -2e4
"""Lower bound of a gas pressure [Pa gauge]: below ambient the membrane collapses."""
EXERGY_FLOOR = 0.1
"""Below about this exergy [J] the efficiency is rounded off: nothing drawn, nothing gained is 0."""
GAS_UNITS = {
    "conductance": "m3/(s.Pa)",
    "exhaust_conductance": "m3/(s.Pa)",
    "supply": "Pa",
    "leak": "m3/(s.Pa)",
    "max_pressure": "Pa",
}
"""Units of what every feed that knows the gas takes; see :class:`GasFeed`."""


@TUBES.register(units={"volume": "m3", "lag": "s"})
@dataclass(frozen=True)
class Tube:
    """A tube between valve and muscle: a volume, and a first-order lag to the muscle's pressure.

    The flow is linear (laminar) in the difference of pressures, with the resistance at which the
    pressure in the tube settles to the muscle's within ``lag``. Sound is not modelled: for tubes
    of more than a metre the delay of length/343 m/s is missing.

    volume : [m3]. lag : time constant [s].
    """

    volume: float = 10e-6
    lag: float = 5e-3

    def __post_init__(self) -> None:
        require_positive("Tube.volume", self.volume, "m3")
        require_positive("Tube.lag", self.lag, "s")


@dataclass(frozen=True)
class Air:
    """Expressions of a gas feed: gauge pressure in the muscle, air and exergy drawn per second."""

    pressure: ca.SX
    supply_flow: ca.SX
    """From the supply [kg/s]."""
    exergy_flow: ca.SX
    """Work that this air could do, per second [W]."""
    temperature: ca.SX
    ambient: ca.SX
    supply: ca.SX
    """Absolute supply pressure [Pa]."""


@dataclass(frozen=True, kw_only=True)
class GasFeed(ABC):
    """Base of the feeds that know the gas: the state ``<name>.pressure`` follows from air flows.

    conductance : sonic conductance C from supply to muscle, valve open [m3/(s Pa)]; see
        :func:`conductance_from_flow`. exhaust_conductance : to ambient; by default the same.
    critical_ratio : b of ISO 6358.
    supply : gauge pressure of the supply [Pa].
    leak : sonic conductance of a leak from muscle to ambient [m3/(s Pa)].
    tube : a :class:`Tube` between valve and muscle, or None.
    gas : volume, dead volume, polytropic exponent, temperature; see :class:`Gas`.
    max_pressure : largest pressure [Pa gauge] a plan may use; by default the muscle's range.
    totals : add the states ``<name>.air_drawn`` [kg] and ``<name>.work`` [J] and the outputs
        ``.exergy_drawn`` [J] and ``.efficiency``. Off by default: pure integrals make every
        equilibrium singular.

    Outputs: ``<name>.volume``, ``.mass_flow`` (into the muscle), ``.supply_flow`` and
    ``.exergy_flow``.
    """

    conductance: float = field(default_factory=lambda: conductance_from_flow(700.0))
    exhaust_conductance: float | None = None
    critical_ratio: float = 0.3
    supply: float = 6e5
    leak: float = 0.0
    tube: Tube | None = None
    gas: Gas = field(default_factory=Gas)
    max_pressure: float | None = None
    totals: bool = False

    def __post_init__(self) -> None:
        kind = type(self).__name__
        require_positive(f"{kind}.conductance", self.conductance, "m3/(s.Pa)")
        for argument in ("exhaust_conductance", "max_pressure"):
            if getattr(self, argument) is not None:
                require_positive(f"{kind}.{argument}", getattr(self, argument))
        require_positive(f"{kind}.supply", self.supply, "Pa")
        require_positive(f"{kind}.leak", self.leak, "m3/(s.Pa)", zero=True)
        if not 0 <= require_finite(f"{kind}.critical_ratio", self.critical_ratio) < 1:
            raise InputError(f"{kind}.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1")

    @abstractmethod
    def openings(self, plant: Declares, name: str) -> tuple[ca.SX, ca.SX]:
        """Declare the inputs; how far the ways from supply and to ambient are open (0 .. 1)."""

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """See :class:`Feed`."""
        return self.fill(plant, name, muscle, contraction, rate).pressure

    def fill(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> Air:
        """Declare states, inputs and parameters of the gas; give its expressions."""

        def declare(key: str, value: float, **attributes: Any) -> ca.SX:
            description = f"{attributes.pop('description', key)} ({name})"
            return plant.parameter(
                f"{name}.gas.{key}", value, description=description, **attributes
            )

        pressure = self._pressure_state(plant, name, muscle, f"{name}.pressure")
        chamber = self.gas.chamber(muscle, contraction, declare)
        supply = chamber.ambient + declare(
            "supply",
            self.supply,
            unit="Pa",
            min=0.0,
            nominal=1e5,
            description="gauge supply pressure",
        )
        node = pressure
        if self.tube is not None:
            node = self._pressure_state(plant, name, muscle, f"{name}.tube_pressure")
        drawn, vented, leaked = self._flows(
            plant,
            name,
            declare,
            chamber,
            supply,
            node + chamber.ambient,
            pressure + chamber.ambient,
        )
        entering = drawn - vented
        if self.tube is not None:
            entering = self._through(self.tube, plant, declare, chamber, node, pressure, entering)
        net = entering - leaked
        plant.der(pressure, chamber.pressure_rate(pressure + chamber.ambient, net, rate))
        for key, value, unit, nominal, words in (
            ("volume", chamber.volume, "m3", 1e-4, "volume of the gas with dead volume"),
            ("mass_flow", net, "kg/s", 1e-3, "air flowing into the muscle"),
            ("supply_flow", drawn, "kg/s", 1e-3, "air drawn from the supply"),
        ):
            plant.output(
                f"{name}.{key}", value, unit=unit, nominal=nominal, description=f"{words} ({name})"
            )
        exergy = drawn * specific_exergy(supply, chamber.ambient, chamber.temperature)
        return Air(pressure, drawn, exergy, chamber.temperature, chamber.ambient, supply)

    def drawn(self, plant: Declares, name: str, air: Air) -> ca.SX:
        """Declare the state ``<name>.air_drawn`` [kg] of the totals."""
        drawn = plant.state(
            f"{name}.air_drawn", unit="kg", nominal=1e-3, description=f"air drawn by {name}"
        )
        plant.der(drawn, air.supply_flow)
        return drawn

    def meter(
        self, plant: Declares, name: str, air: Air, drawn: ca.SX | None, work: ca.SX | None
    ) -> None:
        """Declare what the feed costs; with the totals, air drawn and work done, the efficiency."""
        meters = [
            ("exergy_flow", air.exergy_flow, "W", 100.0, "exergy drawn from the supply per second")
        ]
        if drawn is not None and work is not None:
            exergy = drawn * specific_exergy(air.supply, air.ambient, air.temperature)
            share = work / ca.sqrt(exergy**2 + EXERGY_FLOOR**2)
            meters += [
                ("exergy_drawn", exergy, "J", 100.0, "exergy drawn from the supply"),
                ("efficiency", share, "1", 1.0, "work per exergy drawn"),
            ]
        for key, value, unit, nominal, words in meters:
            plant.output(
                f"{name}.{key}", value, unit=unit, nominal=nominal, description=f"{words} ({name})"
            )

    # ---- parts ------------------------------------------------------------------------------
    def _pressure_state(self, plant: Declares, name: str, muscle: Muscle, state: str) -> ca.SX:
        top = muscle.pressure_range[1] if self.max_pressure is None else self.max_pressure
        tube = "" if state.endswith(f"{name}.pressure") else "the tube of "
        return plant.state(
            state,
            unit="Pa",
            min=LOWEST_PRESSURE,
            max=top,
            start=top / 2,
            nominal=1e5,
            description=f"gauge pressure in {tube}{name}",
        )

    def _flows(
        self,
        plant: Declares,
        name: str,
        declare: Any,
        chamber: Chamber,
        supply: ca.SX,
        node: ca.SX,
        inside: ca.SX,
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Air from the supply, to ambient through the valve, and through the leak [kg/s]."""
        outward = self.conductance if self.exhaust_conductance is None else self.exhaust_conductance
        ways = {
            "conductance": (self.conductance, "sonic conductance from the supply"),
            "exhaust_conductance": (outward, "sonic conductance to ambient"),
            "leak": (self.leak, "sonic conductance of the leak"),
        }
        inlet, outlet, leak = (
            declare(k, v, unit="m3/(s.Pa)", min=0.0, nominal=1e-8, description=words)
            for k, (v, words) in ways.items()
        )
        b = declare(
            "critical_ratio",
            self.critical_ratio,
            min=0.0,
            max=0.99,
            description="critical pressure ratio b",
        )
        filling, venting = self.openings(plant, name)
        t, ambient = chamber.temperature, chamber.ambient
        return (
            filling * iso6358(supply, node, inlet, b, t),
            venting * iso6358(node, ambient, outlet, b, t),
            iso6358(inside, ambient, leak, b, t),
        )

    def _through(
        self,
        tube: Tube,
        plant: Declares,
        declare: Any,
        chamber: Chamber,
        node: ca.SX,
        pressure: ca.SX,
        entering: ca.SX,
    ) -> ca.SX:
        """Flow out of the tube's far end [kg/s]; the tube's own pressure takes up the rest."""
        volume = declare(
            "tube_volume",
            tube.volume,
            unit="m3",
            min=1e-12,
            nominal=1e-5,
            description="volume of the tube",
        )
        lag = declare(
            "tube_lag",
            tube.lag,
            unit="s",
            min=1e-6,
            nominal=1e-2,
            description="time constant of the tube",
        )
        own = Chamber(volume, ca.SX(0), chamber.exponent, chamber.temperature, chamber.ambient)
        per_flow = own.pressure_rate(node + chamber.ambient, 1.0, 0.0)  # Pa/s for 1 kg/s
        leaving = (node - pressure) / (lag * per_flow)
        plant.der(node, per_flow * (entering - leaving))
        return ca.SX(leaving)


@FEEDS.register(units=GAS_UNITS)
@dataclass(frozen=True, kw_only=True)
class SpoolValve(GasFeed):
    """Proportional 5/3 or 3/3 spool valve: ``<name>.command`` from -1 (exhaust) to +1 (supply).

    The spool is closed at 0 and opens smoothly within ``overlap`` of its travel to either side,
    linearly beyond; so the opening has three continuous derivatives, and vanishing slope at 0.
    The spool's own motion (some 5 ms) is left out.

    overlap : part of the travel, 0 .. 0.5; the parameter ``<name>.valve.overlap`` of the plant. A
        critically lapped valve (0) is rounded over 1e-4.

    Controllers choose ``<name>.opening`` instead, how far the way from the supply (> 0) or to
    ambient (< 0) is open, and send the command that gives exactly that; see
    :meth:`Plant.in_openings`.
    """

    overlap: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= require_finite("SpoolValve.overlap", self.overlap) < 0.5:
            raise InputError(f"SpoolValve.overlap = {self.overlap:g} must lie in 0 .. 0.5")

    def openings(self, plant: Declares, name: str) -> tuple[ca.SX, ca.SX]:
        """See :meth:`GasFeed.openings`."""
        command = plant.input(
            f"{name}.command",
            min=-1.0,
            max=1.0,
            nominal=0.1,
            description=f"spool of the valve of {name}: -1 exhaust, 0 closed, 1 supply",
        )
        overlap = plant.parameter(
            f"{name}.valve.overlap",
            self.overlap,
            min=0.0,
            max=0.5,
            nominal=0.1,
            tunable=True,
            description=f"travel over which the valve of {name} stays closed and begins to open",
        )
        travel = 1 - ca.fmax(overlap, LEAST_OVERLAP) / 2  # of the spool beyond its dead zone
        supply, exhaust = (part / travel for part in beyond_dead_zone(command, overlap))
        filling, venting = plant.opening(
            f"{name}.opening",
            [command],
            supply - exhaust,
            lambda w: [dead_zone_inverse(travel * w, overlap)],
            [(supply, lambda w: two_ways(w)[0]), (exhaust, lambda w: two_ways(w)[1])],
            **_opening(name),
        )
        return filling, venting


def _opening(name: str) -> dict[str, Any]:
    return {
        "min": -1.0,
        "max": 1.0,
        "nominal": 0.1,
        "description": f"opening of the valve of {name}: to ambient (-1) or from the supply (1)",
    }


@FEEDS.register(units=GAS_UNITS)
@dataclass(frozen=True, kw_only=True)
class OnOffValves(GasFeed):
    """Two on/off valves with PWM: the inputs ``<name>.fill`` and ``<name>.vent`` are duties 0 .. 1.

    Averaged over the PWM period: the flow is duty times that of the open valve. So the ripple of
    the pressure is not there, and the model holds while the period is short against the filling
    time (some 0.1 s) and long against the valves' switching time.

    Controllers choose ``<name>.opening`` instead, the duty of filling (> 0) or of venting (< 0):
    never are both open. See :meth:`Plant.in_openings`.
    """

    def openings(self, plant: Declares, name: str) -> tuple[ca.SX, ca.SX]:
        """See :meth:`GasFeed.openings`."""
        words = {"fill": "from the supply", "vent": "to ambient"}
        fill, vent = (
            plant.input(
                f"{name}.{way}",
                min=0.0,
                max=1.0,
                description=f"duty of the valve of {name} {where}",
            )
            for way, where in words.items()
        )
        filling, venting = plant.opening(
            f"{name}.opening",
            [fill, vent],
            fill - vent,
            lambda w: [ca.fmax(w, 0), ca.fmax(-w, 0)],
            [(fill, lambda w: two_ways(w)[0]), (vent, lambda w: two_ways(w)[1])],
            **_opening(name),
        )
        return filling, venting
