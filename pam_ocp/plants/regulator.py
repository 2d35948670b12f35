"""Pressure regulators as rigs have them: lags, dead time, slew limit, a command in volts.

A command u takes effect a dead time later, as the pressure r = gain u + bias. The regulator brings
the muscle's pressure p there,

    p' = sat((r - p)/lag),  lag that of filling for r > p, of venting for r < p,

with sat the largest rates of filling and venting. Both kinks are smoothed by polynomials: the
switch of the lag within ``<name>.switch_width`` of r, the limits of the rate within the part
``<name>.slew_rounding`` of them. Outside of that the equations hold to the last digit, and p = r is
the equilibrium whatever these widths are. One command may regulate both muscles of a pair: a base
pressure, and a difference about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core import units
from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .dead_time import DeadTime, as_dead_time
from .kinds import FEEDS

SWITCH_WIDTH = 1e3
"""Half width [Pa] of the passage from the lag of venting to that of filling."""
SLEW_ROUNDING = 0.1
"""Half width of the passage to a limit of the rate, as a part of the limit."""
REGULATOR_UNITS: dict[str, str | tuple[str, ...]] = {
    "lag": "s",
    "max_pressure": "Pa",
    "max_rate": "Pa/s",
    "venting_lag": "s",
    "slew": "Pa/s",
    "venting_slew": "Pa/s",
    "dead_time": "s",
    "gain": ("Pa/V", "Pa/A", "Pa"),
    "bias": "Pa",
}


@FEEDS.register(units=REGULATOR_UNITS)
@dataclass(frozen=True)
class Regulator:
    """First-order pressure regulator: p' = (u - p)/lag, u the commanded pressure.

    lag : time constant [s]; 0.05-0.2 s are usual.
    max_pressure : largest command [Pa]; by default the end of the muscle's measured range.
    max_rate : largest |p'| [Pa/s] a plan may ask for, as path constraint ``<name>.pressure_rate``;
        None for no limit. A simulation is not limited by it.
    totals : add the states ``<name>.work`` (mechanical) and ``<name>.pneumatic_work`` (the integral
        of p dV) [J] and the output ``<name>.efficiency``, their ratio. Off by default: pure
        integrals make every equilibrium singular.

    What rigs have besides; each is left out where it is None:

    venting_lag : time constant of falling pressure [s]; ``lag`` is then that of rising.
    slew : largest p' that the regulator gives [Pa/s]; venting_slew : largest -p', by default the
        same.
    dead_time : from the command to its effect, a :class:`DeadTime` or its time [s].
    gain : pressure per command [Pa/V]: the command is then ``unit``, by default in V.
    bias : pressure at command zero [Pa].
    unit : of the command where there is a gain: "V", "A" or "1" (counts).

    All of them are parameters of the plant (``<name>.lag``, ``.venting_lag``, ``.slew``,
    ``.venting_slew``, ``.dead_time``, ``.gain``, ``.bias``); the output ``<name>.set_pressure``
    shows what the command asks for, where that is not the command itself.

    Examples
    --------
    >>> feed = pam.feeds.Regulator(lag=0.05, max_pressure=6e5, gain=1e5)
    >>> pam.HangingLoad(muscle, feed=feed).variable("muscle.command").unit
    'V'
    """

    lag: float = 0.05
    max_pressure: float | None = None
    max_rate: float | None = None
    totals: bool = False
    venting_lag: float | None = None
    slew: float | None = None
    venting_slew: float | None = None
    dead_time: DeadTime | float | None = None
    gain: float | None = None
    bias: float | None = None
    unit: str = "V"

    def __post_init__(self) -> None:
        plain = ("lag", "max_pressure", "max_rate", "venting_lag", "slew", "venting_slew")
        in_si(self, {n: str(REGULATOR_UNITS[n]) for n in plain})
        kind = type(self).__name__
        if self.venting_slew is not None and self.slew is None:
            raise InputError(f"{kind}.venting_slew: give slew, that of filling, too")
        object.__setattr__(self, "dead_time", as_dead_time(self.dead_time))
        units.unit(self.unit)
        in_si(self, {"gain": _per("Pa", self.unit)})
        if self.bias is not None:
            object.__setattr__(self, "bias", require_finite(f"{kind}.bias", self.bias, "Pa"))

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """See :class:`Feed`."""
        pressure = self.chamber(plant, name, muscle)
        command = plant.input(f"{name}.command", **self._command(name, muscle))
        effect = command
        if isinstance(self.dead_time, DeadTime):
            effect = plant.delayed(command, self.dead_time, name)
        wanted = self.calibrated(plant, name, effect)
        if wanted is not command:
            show_set_pressure(plant, name, wanted)
        self.follow(plant, name, pressure, wanted)
        return pressure

    # ---- parts, which other regulators share ----------------------------------------------------
    def chamber(self, plant: Declares, name: str, muscle: Muscle) -> ca.SX:
        """Declare the pressure in the muscle, a state."""
        scope = Scope(plant, name).of(**pressure_attributes(muscle, self.max_pressure))
        return scope.state("pressure", f"gauge pressure in {name}")

    def _command(self, name: str, muscle: Muscle) -> dict[str, Any]:
        """What the command is called, and its range: pressures from 0 to the largest."""
        attributes = pressure_attributes(muscle, self.max_pressure)
        words = f"commanded gauge pressure of {name}"
        if self.gain is None and not self.bias:
            return {**attributes, "description": words}
        gain, unit = (self.gain, self.unit) if self.gain else (1.0, "Pa")
        low, high = ((attributes[end] - (self.bias or 0.0)) / gain for end in ("min", "max"))
        nominal = 1.0 if self.gain else attributes["nominal"]
        start = (low + high) / 2
        found = {"unit": unit, "min": low, "max": high, "start": start, "nominal": nominal}
        return {**found, "description": f"command of the regulator of {name}"}

    def calibrated(self, plant: Declares, name: str, effect: ca.SX, base: Any = None) -> ca.SX:
        """The pressure that a command asks for: base + gain effect + bias. base : [Pa] or None."""
        wanted = effect
        scope = Scope(plant, name)
        if self.gain is not None:
            wanted = wanted * scope.of(
                _per("Pa", self.unit), self.gain, min=1e-6 * self.gain, tunable=True
            ).parameter("gain", self.gain, f"pressure per command ({name})")
        if self.bias is not None:
            wanted = wanted + scope.of("Pa", 1e4, tunable=True).parameter(
                "bias", self.bias, f"pressure at command zero ({name})"
            )
        return wanted if base is None else base + wanted

    def follow(self, plant: Declares, name: str, pressure: ca.SX, wanted: ca.SX) -> None:
        """State how the pressure follows what is wanted, within its limits."""
        error = wanted - pressure
        change = self._limited(plant, name, self._lagging(plant, name, error))
        plant.der(pressure, change)
        if self.max_rate is not None:
            Scope(plant, name).of("Pa/s", 1e6, min=-self.max_rate, max=self.max_rate).constraint(
                "pressure_rate", change, f"rate of the pressure in {name}"
            )

    def _lagging(self, plant: Declares, name: str, error: ca.SX) -> ca.SX:
        """error/lag, the lag that of filling or of venting."""

        def lag(key: str, value: float, words: str) -> ca.SX:
            scope = Scope(plant, name)
            return scope.of("s", 0.1, min=1e-6).parameter(
                key, value, f"time constant of the pressure regulator of {name}{words}"
            )

        if self.venting_lag is None:
            return ca.SX(error / lag("lag", self.lag, ""))
        filling = lag("lag", self.lag, " while filling")
        venting = lag("venting_lag", self.venting_lag, " while venting")
        scope = Scope(plant, name)
        width = scope.of("Pa", 1e4, min=1.0, widest=1e5).parameter(
            "switch_width",
            SWITCH_WIDTH,
            f"half width of the passage from venting to filling ({name})",
        )
        # a share, not a sum of two clamps: at error zero the rate is zero, too
        share = _step(error / width)
        return ca.SX(error * (share / filling + (1 - share) / venting))

    def _limited(self, plant: Declares, name: str, change: ca.SX) -> ca.SX:
        """The rate within its limits."""
        if self.slew is None:
            return change

        def limit(key: str, value: float, words: str) -> ca.SX:
            scope = Scope(plant, name).of("Pa/s", 1e6, min=1.0, display_unit="bar/s")
            return scope.parameter(key, value, f"largest rate of the pressure of {name}{words}")

        if self.venting_slew is None:
            up = down = limit("slew", self.slew, "")
        else:
            up = limit("slew", self.slew, " while filling")
            down = limit("venting_slew", self.venting_slew, " while venting")
        scope = Scope(plant, name)
        part = scope.of("1", 0.1, min=1e-6, max=1.0, widest=1.0).parameter(
            "slew_rounding",
            SLEW_ROUNDING,
            f"passage to a limit of the rate, half width in parts of it ({name})",
        )
        return ca.SX(clamp(change + down, part * down) - clamp(change - up, part * up) - down)


def show_set_pressure(plant: Declares, name: str, wanted: ca.SX) -> None:
    """Declare the output ``<name>.set_pressure``."""
    Scope(plant, name).of("Pa", 1e5).output(
        "set_pressure", wanted, f"gauge pressure that the command asks for, in {name}"
    )


def _step(s: ca.SX) -> ca.SX:
    """From 0 below s = -1 to 1 above s = 1 with two continuous derivatives (quintic smoothstep)."""
    t = ca.fmin(ca.fmax((s + 1) / 2, 0), 1)
    return ca.SX(t**3 * (10 - 15 * t + 6 * t**2))


def _per(unit: str, other: str) -> str:
    return unit if other == "1" else f"{unit}/{other}"


def in_si(component: Any, by_argument: Mapping[str, str]) -> None:
    """Check these fields of a frozen component: numbers > 0, a text with its unit is one; None
    stays.
    """
    for argument, unit in by_argument.items():
        value = getattr(component, argument)
        if value is not None:
            number = require_positive(f"{type(component).__name__}.{argument}", value, unit)
            object.__setattr__(component, argument, number)


def pressure_attributes(muscle: Muscle, limit: float | None) -> dict[str, Any]:
    """Unit, range, start and nominal of a pressure that may reach ``limit`` [Pa]."""
    top = muscle.pressure_range[1] if limit is None else limit
    return {"unit": "Pa", "min": 0.0, "max": top, "start": top / 2, "nominal": 1e5}


COMMAND = "difference"
"""The pair's one input, and what its dead time is named by."""


@FEEDS.register(units={**REGULATOR_UNITS, "base": "Pa"})
@dataclass(frozen=True)
class PairRegulator(Regulator):
    """Regulators of a pair with one command: pressures base + difference and base - difference.

    The input ``difference`` [Pa, or ``unit`` with a gain] raises the first muscle's pressure and
    lowers the second's about the parameter ``base_pressure``. Its dead time is that of both,
    ``difference.dead_time``; lags, slew limits, gains and biases are each muscle's own.

    base : pressure of both muscles at difference zero [Pa]. All else as of :class:`Regulator`.

    The feed of a plant with two muscles. In a plant of your own, with muscles "flexor" and
    "extensor", ``first, second = feed.pair(plant, muscle)`` gives the feed of each.

    Examples
    --------
    >>> pair = pam.AntagonisticSlide(muscle, 2.0, feed=pam.feeds.PairRegulator(base=2.5e5))
    >>> [v.name for v in pair.inputs]
    ['difference']
    """

    base: float = 2.5e5

    def __post_init__(self) -> None:
        super().__post_init__()
        base = require_positive("PairRegulator.base", self.base, "Pa")
        if self.max_pressure is not None and not base < self.max_pressure:
            raise InputError(
                f"PairRegulator.base = {base:g} Pa must lie below max_pressure = "
                f"{self.max_pressure:g} Pa"
            )
        object.__setattr__(self, "base", base)

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """Refused: the command belongs to two muscles."""
        raise InputError(
            f"feed of {name}: a PairRegulator feeds two muscles by one command; take it for a "
            "slide or a joint, or feed.pair(plant, muscle) in a plant of your own"
        )

    def pair(self, plant: Declares, muscle: Muscle) -> tuple[PairSide, PairSide]:
        """Declare the command; the feeds of the muscle that it fills and of the one that it vents.

        muscle : whose range of pressure limits the command where max_pressure does not.
        """
        attributes = pressure_attributes(muscle, self.max_pressure)
        reach = min(self.base, attributes["max"] - self.base) / (self.gain or 1.0)
        if not reach > 0:
            raise InputError(
                f"PairRegulator.base = {self.base:g} Pa must lie below the largest pressure, "
                f"{attributes['max']:g} Pa"
            )
        scope = Scope(plant)
        unit, nominal = (self.unit, 1.0) if self.gain else ("Pa", 1e5)
        command = scope.of(unit, nominal, min=-reach, max=reach).input(
            COMMAND, "command of the pair: raises the first pressure, lowers the second"
        )
        base = scope.of("Pa", 1e5, min=0.0, tunable=True).parameter(
            "base_pressure", self.base, "pressure of both muscles at difference zero"
        )
        effect = command
        if isinstance(self.dead_time, DeadTime):
            effect = plant.delayed(command, self.dead_time)
        return PairSide(self, base, effect, 1), PairSide(self, base, effect, -1)


@dataclass(frozen=True, eq=False)
class PairSide:
    """The feed of one muscle of the pair."""

    of: PairRegulator
    base: ca.SX
    effect: ca.SX
    sign: int

    @property
    def totals(self) -> bool:
        return self.of.totals

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """See :class:`pam_ocp.feeds.Feed`."""
        pressure = self.of.chamber(plant, name, muscle)
        wanted = self.of.calibrated(plant, name, self.sign * self.effect, self.base)
        show_set_pressure(plant, name, wanted)
        self.of.follow(plant, name, pressure, wanted)
        return pressure


def feeds_of_pair(plant: Declares, feed: Any, muscles: Sequence[Muscle]) -> tuple[Any, Any]:
    """What feeds the first and the second muscle: twice the same, or the sides of a pair's feed."""
    if isinstance(feed, PairRegulator):
        smallest = min(muscles, key=lambda m: m.pressure_range[1])
        return feed.pair(plant, smallest)
    return feed, feed
