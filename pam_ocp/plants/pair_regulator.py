"""One command for both muscles of a pair: a base pressure, and a difference about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.errors import InputError, require_positive
from ..core.system import Declares, Scope
from ..muscles.pneumatic_muscle import Muscle
from .dead_time import DeadTime
from .kinds import FEEDS
from .regulator import REGULATOR_UNITS, Regulator, pressure_attributes, show_set_pressure

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
