"""Channels: what is read of a rig and what is sent to it, with units, calibration and limits; and
clocks: time of this host, or simulated, which passes only while somebody waits.

A driver hands over raw numbers by the names of the channels (counts, volts, bar, ...); a channel
says once what they mean.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from ..core.calibration import AMBIENT, Scale, scale_of
from ..core.errors import InputError, require_finite, require_positive
from ..core.quantities import known_keys, quantity
from ..core.units import per_second, unit
from ..core.variables import Variable
from ..plants.plant import Plant

FORMATS = ("float32", "int16", "uint16", "int32", "uint32")
"""What a channel may be on a bus of registers."""
STRAIGHT = 1e-9
"""Part of its range by which a calibration may bend that is to be a straight line."""
Kind = TypeVar("Kind", bound="Channel")


@dataclass(frozen=True)
class Channel:
    """One quantity on its way between a driver's raw numbers and SI; see Reading and Command.

    name : as the plant's variable is called. unit : SI unit of the quantity; by default that of the
    plant's variable. scale : what the raw number is: a unit ("bar", "bar abs", "mm"), or a
    calibration as readers of files take it ("V * 2 bar/V - 0.3 bar"); by default SI.
    low, high : [unit]. rate : largest |change| [unit/s].
    address, format : place on a bus: the number of a register (Modbus) or the identifier of a node
    (OPC UA), and what stands there. Numbers may be texts with units.
    """

    kind: ClassVar[str] = "channel"

    name: str
    unit: str = ""
    scale: str = ""
    low: float = -math.inf
    high: float = math.inf
    rate: float = math.inf
    address: int | str | None = None
    format: str = "float32"

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"name = {self.name!r} of a channel: give a text such as 'x'")
        if self.format not in FORMATS:
            raise InputError(
                f"{self.name}: format = {self.format!r}: choose one of {', '.join(FORMATS)}"
            )
        if self.unit:
            unit(self.unit)
            self._settle(self.unit)

    def _settle(self, own: str) -> None:
        """All numbers in SI, checked; called once the unit is known."""
        for argument, its in (("low", own), ("high", own), ("rate", per_second(own))):
            value = quantity(f"{self.name}.{argument}", getattr(self, argument), its)
            object.__setattr__(self, argument, value)
        if not self.low < self.high:
            raise InputError(f"{self.name}: low = {self.low:g} must lie below high = {self.high:g}")
        if not self.rate > 0:
            raise InputError(f"{self.name}: rate = {self.rate:g} must be > 0, or left out")
        said, where = self.scale or self.unit, f"scale of {self.name}"
        scale = scale_of(where, said, unit(self.unit), None, AMBIENT)
        object.__setattr__(self, "_scale", scale)

    def of(self: Kind, variable: Variable | None) -> Kind:
        """The same with what the plant's variable says of it. Raises InputError without a unit."""
        if not self.unit and variable is None:
            raise InputError(
                f"{self.name}: its unit is not known; give unit='m', or a plant that has it"
            )
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        if variable is not None:
            if self.unit and not unit(self.unit).compatible(unit(variable.unit)):
                raise InputError(
                    f"{self.name}: unit {self.unit!r} does not measure what the plant's "
                    f"{variable.unit!r} does"
                )
            given["unit"] = self.unit or variable.unit
            open_ = (None, -math.inf, math.inf)
            given |= {n: v for n, v in self._from(variable).items() if given[n] in open_}
        return type(self)(**given)

    def _from(self, variable: Variable) -> dict[str, float]:
        return {}

    def si(self, raw: float) -> float:
        """A raw number in SI; NaN stays."""
        scale: Scale = self.__dict__["_scale"]
        return float(scale.si(np.asarray(raw, dtype=float)))

    def line(self, why: str) -> tuple[float, float]:
        """(gain, zero) of SI = gain raw + zero. Raises InputError, which ends in ``why``, for a
        calibration that is no straight line.
        """
        zero, one, far = self.si(0.0), self.si(1.0), self.si(1000.0)
        gain = one - zero
        bend = abs(far - zero - 1000 * gain)
        if not math.isfinite(gain) or gain == 0 or bend > STRAIGHT * abs(far - zero):
            raise InputError(f"{self.name}: scale = {self.scale!r} is no straight line{why}")
        return gain, zero

    def variable(self, plant: Plant | None) -> Variable:
        """As a variable of the rig."""
        if plant is not None and self.name in {v.name for v in plant.variables}:
            return plant.variable(self.name)
        ends = [abs(e) for e in (self.low, self.high) if math.isfinite(e) and e]
        causality: Any = "input" if isinstance(self, Command) else "output"
        bounds: dict[str, Any] = {"min": self.low, "max": self.high} if causality == "input" else {}
        return Variable(
            self.name, causality, unit=self.unit, nominal=max(ends, default=1.0), **bounds
        )


@dataclass(frozen=True)
class Reading(Channel):
    """A measured quantity. The guard vents where it leaves low .. high or runs faster than
    ``rate``.

    frozen : [s] for which a value may stay the same to the last digit, where its noise moves it; by
        default for ever. slope_of : the reading is the filtered slope of another one (a velocity
        that nothing measures), with the time constant ``filter`` [s]; the driver does not know it.
    follows : a command that this pressure is to follow; away by more than ``deviation`` [unit] for
        longer than ``within`` [s] it does not (supply lost, cable of a valve out).

    Examples
    --------
    >>> x = pam.rig.Reading("x", "m", scale="V * 10 mm/V - 25 mm", low="-20 mm", high="20 mm")
    >>> round(x.si(3.0), 6), x.high
    (0.005, 0.02)
    """

    kind: ClassVar[str] = "reading"

    frozen: float | None = None
    slope_of: str = ""
    filter: float = 0.01
    follows: str = ""
    deviation: float = math.inf
    within: float = 0.2

    def _settle(self, own: str) -> None:
        super()._settle(own)
        for argument, its in (("frozen", "s"), ("filter", "s"), ("within", "s")):
            value = getattr(self, argument)
            if value is not None:
                value = require_positive(f"{self.name}.{argument}", value, its)
                object.__setattr__(self, argument, value)
        size = quantity(f"{self.name}.deviation", self.deviation, own)
        object.__setattr__(self, "deviation", size)


@dataclass(frozen=True)
class Command(Channel):
    """A quantity that is sent. What a controller asks for is kept within low .. high and ``rate``.

    low, high : by default the range of the plant's input; both must be finite.
    vent : value that lets the air out [unit]; by default 0, where nothing lies below.
    soft : rate of a soft start [unit/s]; by default the whole range in one second.

    Examples
    --------
    >>> p = pam.rig.Command("muscle.command", "Pa", scale="bar", low=0.0, high="6 bar")
    >>> p.raw(2e5), p.vent
    (2.0, 0.0)
    """

    kind: ClassVar[str] = "command"

    vent: float | None = None
    soft: float | None = None

    def _from(self, variable: Variable) -> dict[str, float]:
        return {"low": variable.min, "high": variable.max}

    def _settle(self, own: str) -> None:
        super()._settle(own)
        if self.vent is None and self.low < 0 and math.isfinite(self.low):
            raise InputError(
                f"{self.name}: its range begins below 0, at {self.low:g}; give vent, the value "
                "that lets the air out"
            )
        vent = require_finite(f"{self.name}.vent", 0.0 if self.vent is None else self.vent, own)
        object.__setattr__(self, "vent", vent)
        if math.isfinite(self.low) and math.isfinite(self.high):
            span = self.high - self.low
            soft = require_positive(
                f"{self.name}.soft", span if self.soft is None else self.soft, per_second(own)
            )
            object.__setattr__(self, "soft", soft)
            if not self.low <= vent <= self.high:
                raise InputError(
                    f"{self.name}: vent = {vent:g} lies outside its range {self.low:g} .. "
                    f"{self.high:g}; give the value that lets the air out"
                )
        why = ", and a command is sent through its inverse; give one such as 'V * 1 bar/V'"
        object.__setattr__(self, "_line", self.line(why))

    def require_range(self) -> None:
        """InputError where there is none."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise InputError(
                f"{self.name}: give low and high, both finite: nothing is sent beyond them"
            )

    def raw(self, value: float) -> float:
        """A value in SI as the raw number that is sent."""
        gain, zero = self.__dict__["_line"]
        return float((value - zero) / gain)

    @property
    def raw_vent(self) -> float:
        """The raw number that lets the air out."""
        return self.raw(float(self.vent or 0.0))


def channels_of(
    kind: type[Kind], given: Iterable[Kind] | Mapping[str, Any], plant: Plant | None
) -> dict[str, Kind]:
    """{name: channel}, of channels or of tables as files hold them. Raises InputError."""
    made: list[Kind] = []
    if isinstance(given, Mapping):
        keys = [f.name for f in fields(kind) if f.name != "name"]
        for name, said in given.items():
            if not isinstance(said, Mapping):
                raise InputError(
                    f"{kind.kind} {name} = {said!r}: give a table, as {{ unit = 'm' }}"
                )
            known_keys(f"{kind.kind} {name}", said, keys)
            for key in ("unit", "scale", "format", "slope_of", "follows"):
                if key in said and not isinstance(said[key], str):
                    raise InputError(f"{kind.kind} {name}.{key} = {said[key]!r}: give a text")
            made.append(kind(name, **said))
    else:
        made = list(given)
    known = {} if plant is None else {v.name: v for v in plant.variables}
    known |= {n.replace(".", "_"): v for n, v in known.items()}
    found: dict[str, Kind] = {}
    for channel in made:
        if not isinstance(channel, kind):
            raise InputError(
                f"{channel!r} is no {kind.__name__}; give {kind.__name__}(name, unit, ...)"
            )
        whole = channel.of(known.get(channel.name))
        if whole.name in found:
            raise InputError(f"the {kind.kind} {whole.name!r} is given twice")
        found[whole.name] = whole
    return found


def usual_channels(plant: Plant) -> tuple[dict[str, Reading], dict[str, Command]]:
    """What a rig of this plant usually has: positions and pressures are read, controls are sent."""
    pressures = [v.name for v in plant.states if v.name.endswith(".pressure")]
    names = [*plant.load_positions, *pressures]
    if not names:
        names = [v.name for v in plant.states]
    readings = [Reading(n, address=2 + 2 * i) for i, n in enumerate(names)]
    controls = [v for v in plant.inputs if not v.disturbance]
    commands = [
        Command(v.name, address=2 * i, vent=1.0 if v.name.endswith(".vent") else min(v.min, 0.0))
        for i, v in enumerate(controls)
        if math.isfinite(v.min) and math.isfinite(v.max)
    ]
    return channels_of(Reading, readings, plant), channels_of(Command, commands, plant)


# ---- time ----------------------------------------------------------------------------------------
SPIN = 3e-4
"""The last part of a wait [s] is spent looking at the clock: sleeping is no more exact."""


class Clock(Protocol):
    """What tells and passes time. ``real`` : it is that of the world."""

    real: bool

    def now(self) -> float: ...
    def wait(self, until: float) -> None: ...


class RealClock:
    """``time.monotonic()``.

    Examples
    --------
    >>> clock = pam.rig.RealClock()
    >>> begin = clock.now()
    >>> clock.wait(begin + 0.001)
    >>> clock.now() >= begin + 0.001
    True
    """

    real = True

    def now(self) -> float:
        """[s]."""
        return time.monotonic()

    def wait(self, until: float) -> None:
        """Come back at a time, or at once where it is over."""
        left = until - time.monotonic()
        if left > SPIN:
            time.sleep(left - SPIN)
        while time.monotonic() < until:
            pass


class SimulatedClock:
    """A clock for twins: waiting takes no time, and nothing else passes any.

    Examples
    --------
    >>> clock = pam.rig.SimulatedClock()
    >>> clock.wait(0.25)
    >>> clock.now()
    0.25
    """

    real = False

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """[s]."""
        return self._now

    def wait(self, until: float) -> None:
        """Go on to a time, where it is not over yet."""
        self._now = max(self._now, until)
