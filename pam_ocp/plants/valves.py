"""Feeds of air: valves by ISO 6358, a tube, a leak, and what air and work they cost."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, cast

import casadi as ca

from ..core.errors import (
    InputError,
    UnknownNameError,
    require_finite,
    require_instance,
    require_positive,
)
from ..core.stop import verb
from ..core.system import Declares, Scope
from ..muscles.dead_zone import LEAST_OVERLAP, beyond_dead_zone, dead_zone_inverse
from ..muscles.gas import Chamber, Gas, conductance_from_flow, specific_exergy
from ..muscles.pneumatic_muscle import Muscle
from .airflow import (
    Air,
    Place,
    Stream,
    air_temperature,
    balance,
    boundless,
    declaring,
    holding,
    show,
    through,
)
from .components import component
from .kinds import FEEDS
from .opening import WAYS
from .receiver import Supply
from .spools import FirstOrderSpool, Spool
from .tubes import Around, QuickExhaust, Tube, TubeComponent

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]

__all__ = [
    "Filling",
    "GasFeed",
    "OnOffValves",
    "SpoolValve",
    "Tube",
    "valve",
    "valve_entry",
    "valve_names",
]

LOWEST_PRESSURE = -2e4
"""Lower bound of a gas pressure [Pa gauge]: below ambient the membrane collapses."""
EXERGY_FLOOR = 0.1
"""Below about this exergy [J] the efficiency is smoothed: nothing drawn, nothing gained is 0."""
GAS_UNITS = {
    "conductance": "m3/(s.Pa)",
    "exhaust_conductance": "m3/(s.Pa)",
    "supply": "Pa",
    "supply_temperature": "K",
    "leak": "m3/(s.Pa)",
    "max_pressure": "Pa",
}
"""Units of what every feed that knows the gas takes; see :class:`GasFeed`."""


@dataclass(frozen=True)
class Filling:
    """Expressions of a gas feed: gauge pressure in the muscle, air and exergy drawn per second."""

    pressure: ca.SX
    supply_flow: ca.SX
    """From the supply [kg/s]."""
    exergy_flow: ca.SX
    """Work that this air could do, per second [W]."""
    specific: ca.SX | None
    """Exergy of a supply that stays as it is [J/kg]; None of one that does not."""
    stiffening: ca.SX | None = None
    """Part by which the wall's own force has grown with its temperature; None: not at all."""
    warm: Callable[[Any], None] | None = None
    """Takes the power that losses give to the wall [W]."""


@dataclass(frozen=True, kw_only=True)
class GasFeed(ABC):
    """Base of the feeds that know the gas: the state ``<name>.pressure`` follows from air flows.

    conductance : sonic conductance C from supply to muscle, valve open [m3/(s Pa)]; see
        :func:`conductance_from_flow`. exhaust_conductance : to ambient; by default the same.
    critical_ratio : b of ISO 6358.
    supply : gauge pressure of the supply [Pa], or one that sags: ``Receiver(...)``, which all
        feeds of the plant share.
    supply_temperature : of the air from a supply of constant pressure [K]; by default the gas's.
    leak : sonic conductance of a leak from muscle to ambient [m3/(s Pa)].
    tube : ``Tube(...)`` or ``LumpedTube(...)`` between valve and muscle, or None.
    quick_exhaust : ``QuickExhaust(...)`` at the tube's end, or None.
    gas : volume, dead volume, temperature, polytropic exponent or heat; see :class:`Gas`.
    max_pressure : largest pressure [Pa gauge] a plan may use; by default the muscle's range.
    totals : add the states ``<name>.air_drawn`` [kg] and ``<name>.work`` [J] and the outputs
        ``.exergy_drawn`` [J] and ``.efficiency``. Off by default: pure integrals make every
        equilibrium singular.

    Outputs: ``<name>.volume``, ``.mass_flow`` (into the muscle), ``.supply_flow`` and
    ``.exergy_flow``; with a gas that has heat also ``.air_mass``, ``.vent_flow`` (to ambient),
    ``.enthalpy_flow`` and ``.heat_flow`` (into the air).
    """

    conductance: float = field(default_factory=lambda: conductance_from_flow(700.0))
    exhaust_conductance: float | None = None
    critical_ratio: float = 0.3
    supply: float | Supply = 6e5
    supply_temperature: float | None = None
    leak: float = 0.0
    tube: TubeComponent | None = None
    quick_exhaust: QuickExhaust | None = None
    gas: Gas = field(default_factory=Gas)
    max_pressure: float | None = None
    totals: bool = False

    def __post_init__(self) -> None:
        kind = type(self).__name__
        require_positive(f"{kind}.conductance", self.conductance, "m3/(s.Pa)")
        for argument in ("exhaust_conductance", "max_pressure", "supply_temperature"):
            if getattr(self, argument) is not None:
                require_positive(f"{kind}.{argument}", getattr(self, argument))
        if hasattr(self.supply, "connect"):
            component("supply", self.supply, "connect", "Receiver(2e-3)")
            if self.supply_temperature is not None:
                raise InputError(
                    f"{kind}.supply_temperature is that of a supply of constant pressure: give "
                    "the receiver's source its temperature"
                )
        else:
            require_positive(f"{kind}.supply", self.supply, "Pa")
        if self.tube is not None:
            component("tube", self.tube, "port", "Tube(10e-6) or LumpedTube(1.0)")
        if self.quick_exhaust is not None:
            component("quick_exhaust", self.quick_exhaust, "vent", "QuickExhaust()")
            if self.tube is None:
                raise InputError(
                    f"{kind}.quick_exhaust sits between tube and muscle: give tube= as well"
                )
        require_positive(f"{kind}.leak", self.leak, "m3/(s.Pa)", zero=True)
        if not 0 <= require_finite(f"{kind}.critical_ratio", self.critical_ratio) < 1:
            raise InputError(f"{kind}.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1")
        require_instance(f"{kind}.gas", self.gas, Gas, "give a Gas, such as Gas(exponent=1.2)")

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
    ) -> Filling:
        """Declare states, inputs and parameters of the gas; give its expressions."""

        declare = declaring(plant, f"{name}.gas", f"({name})")

        def pressure_state(state: str) -> ca.SX:
            return self._pressure_state(plant, name, muscle, state)

        pressure = pressure_state(f"{name}.pressure")
        chamber = self.gas.chamber(muscle, contraction, declare)
        inside = Air(pressure + chamber.ambient, air_temperature(plant, name, self.gas, chamber))
        place, net = holding(plant, inside)
        source, specific = self._source(plant, declare, chamber)
        outside = boundless(Air(chamber.ambient, chamber.temperature))
        port = place
        if self.tube is not None:
            exponent = chamber.exponent if self.gas.heat is None else ca.SX(1)
            around = Around(
                name, chamber.ambient, chamber.temperature, exponent, declare, pressure_state
            )
            port = self.tube.port(plant, around, place)
        drawn, vented = self._valve(plant, name, declare, source, port, place, outside)
        if self.quick_exhaust is not None:
            quick = self.quick_exhaust.vent(declare, place, port, outside)
            vented = Stream(vented.mass + quick.mass, vented.carried + quick.carried)
        warmth = balance(plant, name, self.gas, chamber, pressure, inside, net, rate, declare)
        shown = [
            ("volume", chamber.volume, "m3", 1e-4, "volume of the gas with dead volume"),
            ("mass_flow", net.mass, "kg/s", 1e-3, "air flowing into the muscle"),
            ("supply_flow", drawn.mass, "kg/s", 1e-3, "air drawn from the supply"),
        ]
        if self.gas.heat is not None:
            shown.append(("vent_flow", vented.mass, "kg/s", 1e-3, "air to the surroundings"))
        show(plant, name, *shown)
        each = specific
        if each is None:
            air, t0 = source.air, chamber.temperature
            each = specific_exergy(air.absolute, chamber.ambient, t0, air.temperature)
        return Filling(
            pressure, drawn.mass, drawn.mass * each, specific, warmth.stiffening, warmth.warm
        )

    def drawn(self, plant: Declares, name: str, air: Filling) -> ca.SX:
        """Declare the state ``<name>.air_drawn`` [kg] of the totals."""
        drawn = Scope(plant, name).of("kg", 1e-3).state("air_drawn", f"air drawn by {name}")
        plant.der(drawn, air.supply_flow)
        return drawn

    def meter(
        self, plant: Declares, name: str, air: Filling, drawn: ca.SX | None, work: ca.SX | None
    ) -> None:
        """Declare what the feed costs; with the totals, air drawn and work done, the efficiency.

        From a supply that does not stay as it is the exergy drawn is a state.
        """
        words = "exergy drawn from the supply"
        meters = [("exergy_flow", air.exergy_flow, "W", 100.0, f"{words} per second")]
        if drawn is not None and work is not None:
            if air.specific is not None:
                exergy = drawn * air.specific
                meters.append(("exergy_drawn", exergy, "J", 100.0, words))
            else:
                exergy = (
                    Scope(plant, name).of("J", 100.0).state("exergy_drawn", f"{words} ({name})")
                )
                plant.der(exergy, air.exergy_flow)
            share = work / ca.sqrt(exergy**2 + EXERGY_FLOOR**2)
            meters.append(("efficiency", share, "1", 1.0, "work per exergy drawn"))
        show(plant, name, *meters)

    # ---- parts ------------------------------------------------------------------------------
    def _pressure_state(self, plant: Declares, name: str, muscle: Muscle, state: str) -> ca.SX:
        top = muscle.pressure_range[1] if self.max_pressure is None else self.max_pressure
        tube = "" if state.endswith(f"{name}.pressure") else "the tube of "
        memory = "settling" if tube else ""
        scope = Scope(plant).of(
            "Pa", 1e5, min=LOWEST_PRESSURE, max=top, start=top / 2, memory=memory
        )
        return scope.state(state, f"gauge pressure in {tube}{name}")

    def _source(
        self, plant: Declares, declare: Any, chamber: Chamber
    ) -> tuple[Place, ca.SX | None]:
        """Where the air comes from; the exergy of its air [J/kg] where that stays as it is."""
        if not isinstance(self.supply, float | int):
            return self.supply.connect(plant), None
        gauge = declare("supply", self.supply, "Pa", 1e5, "gauge supply pressure", min=0.0)
        absolute, warm = chamber.ambient + gauge, None
        if self.supply_temperature is not None:
            words = "temperature of the supply's air"
            warm = declare(
                "supply_temperature", self.supply_temperature, "K", 300.0, words, min=1.0
            )
        t0 = chamber.temperature
        place = boundless(Air(absolute, t0 if warm is None else warm))
        return place, specific_exergy(absolute, chamber.ambient, t0, warm)

    def _valve(
        self,
        plant: Declares,
        name: str,
        declare: Any,
        source: Place,
        port: Place,
        muscle: Place,
        outside: Place,
    ) -> tuple[Stream, Stream]:
        """Air from the supply, and to ambient through the valve and the leak."""
        outward = self.conductance if self.exhaust_conductance is None else self.exhaust_conductance
        ways = {
            "conductance": (self.conductance, "sonic conductance from the supply"),
            "exhaust_conductance": (outward, "sonic conductance to ambient"),
            "leak": (self.leak, "sonic conductance of the leak"),
        }
        inlet, outlet, leak = (
            declare(k, v, "m3/(s.Pa)", 1e-8, words, min=0.0) for k, (v, words) in ways.items()
        )
        words = "critical pressure ratio b"
        b = declare("critical_ratio", self.critical_ratio, description=words, min=0.0, max=0.99)
        filling, venting = self.openings(plant, name)
        drawn = through(source, port, inlet, b, filling)
        vented = through(port, outside, outlet, b, venting)
        leaked = through(muscle, outside, leak, b)
        return drawn, Stream(vented.mass + leaked.mass, vented.carried + leaked.carried)


@FEEDS.register(units=GAS_UNITS)
@dataclass(frozen=True, kw_only=True)
class SpoolValve(GasFeed):
    """Proportional 5/3 or 3/3 spool valve: ``<name>.command`` from -1 (exhaust) to +1 (supply).

    The spool is closed at 0 and opens smoothly within ``overlap`` of its travel to either side,
    linearly beyond; so the opening has three continuous derivatives, and vanishing slope at 0.

    overlap : part of the travel, 0 .. 0.5; the parameter ``<name>.valve.overlap`` of the plant. A
        critically lapped valve (0) is rounded over 1e-4.
    exhaust_overlap : on the exhaust's side; by default the same.
    offset : where the spool stands at command 0, part of the travel (a zero out of true).
    spool : ``FirstOrderSpool(...)`` or ``SecondOrderSpool(...)``: its own motion, 2 to 20 ms, as
        the state ``<name>.valve.spool``; None leaves it out.

    Controllers choose ``<name>.opening`` instead of the command, how far the way from the supply
    (> 0) or to ambient (< 0) is open, and send the command that gives exactly that; see
    :meth:`Plant.in_openings`. Of a spool that moves, with or without hysteresis, they send the
    command that leaves it at this opening at rest; the time in which it crosses the overlap is not
    in their model.

    Examples
    --------
    >>> valves = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.SpoolValve(supply=6e5))
    >>> filled = pam.simulate(valves, {"muscle.command": 0.5}, duration=1.0)
    >>> print(f"{filled['muscle.pressure'][-1] / 1e5:.1f} bar")
    6.0 bar
    """

    overlap: float = 0.02
    exhaust_overlap: float | None = None
    offset: float = 0.0
    spool: Spool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for argument in ("overlap", "exhaust_overlap"):
            value = getattr(self, argument)
            if value is None:
                continue
            if not 0 <= require_finite(f"SpoolValve.{argument}", value) < 0.5:
                raise InputError(f"SpoolValve.{argument} = {value:g} must lie in 0 .. 0.5")
        if abs(require_finite("SpoolValve.offset", self.offset)) > 0.5:
            raise InputError(f"SpoolValve.offset = {self.offset:g} must lie in -0.5 .. 0.5")
        if self.spool is not None:
            component("spool", self.spool, "position", "FirstOrderSpool(5e-3)")

    def openings(self, plant: Declares, name: str) -> tuple[ca.SX, ca.SX]:
        """See :meth:`GasFeed.openings`."""
        command = (
            Scope(plant, name)
            .of("1", 0.1, min=-1.0, max=1.0)
            .input("command", f"spool of the valve of {name}: -1 exhaust, 0 closed, 1 supply")
        )
        overlaps, offset = self._lands(plant, name)
        travels = [1 - ca.fmax(o, LEAST_OVERLAP) / 2 for o in overlaps]  # beyond the dead zone

        def ways(position: ca.SX) -> tuple[ca.SX, ca.SX]:
            parts = [beyond_dead_zone(position + offset, o)[i] for i, o in enumerate(overlaps)]
            return parts[0] / travels[0], parts[1] / travels[1]

        def inverse(w: ca.SX) -> ca.SX:
            up, down = (dead_zone_inverse(t * w, o) for t, o in zip(travels, overlaps, strict=True))
            return (up if ca.is_equal(*overlaps) else ca.if_else(w >= 0, up, down)) - offset

        behind = None if self.spool is None else self.spool.position(plant, name, command)
        supply, exhaust = ways(command)
        paths = (supply, exhaust) if behind is None else ways(behind)
        filling, venting = plant.opening(
            f"{name}.opening",
            [command],
            supply - exhaust,
            lambda w: [inverse(w)],
            list(zip(paths, WAYS, strict=True)),
            behind,
            **_opening(name),
        )
        return filling, venting

    def _lands(self, plant: Declares, name: str) -> tuple[tuple[ca.SX, ca.SX], ca.SX]:
        """Overlaps on both sides, and the offset; parameters where they are given."""
        words = f"travel over which the valve of {name} stays closed and begins to open"
        attributes: dict[str, Any] = {"nominal": 0.1, "max": 0.5, "tunable": True}
        scope = Scope(plant, name)
        overlap = scope.of(min=0.0, **attributes).parameter("valve.overlap", self.overlap, words)
        other, offset = overlap, ca.SX(0)
        if self.exhaust_overlap is not None:
            other = scope.of(min=0.0, **attributes).parameter(
                "valve.exhaust_overlap", self.exhaust_overlap, f"{words}, to ambient"
            )
        if self.offset or self.spool is not None:
            offset = scope.of(min=-0.5, **attributes).parameter(
                "valve.offset", self.offset, f"position of the spool of {name} at command 0"
            )
        return (overlap, other), offset


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

    Examples
    --------
    >>> switched = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.OnOffValves())
    >>> [v.name for v in switched.inputs]
    ['muscle.fill', 'muscle.vent']
    """

    def openings(self, plant: Declares, name: str) -> tuple[ca.SX, ca.SX]:
        """See :meth:`GasFeed.openings`."""
        words = {"fill": "from the supply", "vent": "to ambient"}
        fill, vent = (
            Scope(plant, name)
            .of(min=0.0, max=1.0)
            .input(way, f"duty of the valve of {name} {where}")
            for way, where in words.items()
        )
        filling, venting = plant.opening(
            f"{name}.opening",
            [fill, vent],
            fill - vent,
            lambda w: [ca.fmax(w, 0), ca.fmax(-w, 0)],
            [(fill, "filling"), (vent, "venting")],
            **_opening(name),
        )
        return filling, venting


# ---- the catalogue, from valves.toml, each with its source ---------------------------------------
_TAKEN = ("conductance", "exhaust_conductance", "critical_ratio")


@cache
def _catalogue() -> dict[str, dict[str, Any]]:
    text = files(__package__).joinpath("valves.toml").read_text("utf-8")
    return cast(dict[str, dict[str, Any]], tomllib.loads(text))


def valve_names() -> list[str]:
    """The names that :func:`valve` knows.

    Examples
    --------
    >>> len(pam.feeds.valve_names()) > 2
    True
    """
    return list(_catalogue())


def valve_entry(name: str) -> dict[str, Any]:
    """What the catalogue says of a valve: figures, ``source``, ``how_sure``.

    Raises UnknownNameError with the nearest names.
    """
    if name not in _catalogue():
        raise UnknownNameError("valve", name, valve_names())
    return dict(_catalogue()[name])


@verb
def valve(name: str, **arguments: Any) -> GasFeed:
    """The feed of a valve of the catalogue, a ``SpoolValve`` or ``OnOffValves``.

    arguments : of the feed besides, such as ``supply=5e5``, ``tube=...``; they go before the
        catalogue's. See :func:`valve_entry` for the source, and what it does not know.

    Raises UnknownNameError with the nearest names.

    Examples
    --------
    >>> feed = pam.feeds.valve(pam.feeds.valve_names()[0], supply=5e5)
    >>> feed.supply
    500000.0
    """
    entry = valve_entry(name)
    known = {key: entry[key] for key in _TAKEN if key in entry}
    if "nominal_flow" in entry:
        known["conductance"] = conductance_from_flow(entry["nominal_flow"])
    if "spool_time" in entry:
        known["spool"] = FirstOrderSpool(entry["spool_time"])
    return cast(GasFeed, FEEDS[entry["feed"]](**{**known, **arguments}))
