"""What elements that stick and slide have in common: their rate, their limits, their release.

An element is a spring that holds until its force comes to a limit, and slides there. A limit that
falls while the element holds (less pressure presses on the strands) lets go what is above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ..core.errors import InputError, require_finite
from ..core.system import Declares, Scope
from .damping import Motion

REST_RATE = 1e-4
"""Rate of contraction [1/s] at which its absolute value is smoothed.

Faster motion is rate-independent. At rest an element keeps its force, but for the last part
``edge`` of what it can hold: smooth derivatives, |z| <= 1 and dissipation in every motion leave no
other way.
"""
WIDEST_RATE = 0.3
"""The same where planning a motion begins [1/s]."""
RELEASE = 0.01
"""Time [s] in which an element lets go what is above a limit that has fallen."""
LARGEST_SCALE = 1e-4
"""Of a friction's growth with pressure [1/Pa]; above, a unit was mistaken."""


def rounded_speed(
    plant: Declares, name: str, key: str, rate: ca.SX, widest: float = WIDEST_RATE
) -> ca.SX:
    """|rate|, smoothed within the parameter ``<name>.<key>_rest_rate``; where planning a motion
    begins, within ``widest`` [1/s].
    """
    scope = Scope(plant, name)
    width = scope.of("1/s", 1e-3, min=1e-9, widest=widest).parameter(
        f"{key}_rest_rate",
        REST_RATE,
        f"rate of contraction of {name} at which its absolute value is smoothed",
    )
    # From above, sqrt(rate^2 + w^2) >= |rate|: only so do the elements dissipate in every motion.
    return ca.SX(ca.sqrt(rate**2 + width**2))


def passage(towards: ca.SX, edge: float | ca.SX, most: float = 1.0) -> ca.SX:
    """1 while it sticks, falling to 0 where sliding begins: 1 - s^3, s from 0 to 1 at the edge.

    With ``most`` > 1 it goes on below 0 from there, which leads back: exact motion never comes
    there, and on a coarse mesh what oversteps the edge does not stay beyond.
    """
    s = ca.fmin(ca.fmax((towards - (1 - edge)) / edge, 0), most)
    return ca.SX(1 - s**3)


def require_scale(argument: str, value: float) -> float:
    """Growth of a friction with pressure [1/Pa], >= 0. InputError for anything else."""
    number = require_finite(argument, value, "1/Pa")
    if not 0 <= number <= LARGEST_SCALE:
        raise InputError(
            f"{argument} = {number:g} 1/Pa must lie in 0 .. {LARGEST_SCALE:g}: the friction at "
            "the pressure p is (1 + per_pressure p) times that at none"
        )
    return number


@dataclass(frozen=True)
class PressureScale:
    """1 + per_pressure p: how many times the friction at no pressure an element can hold.

    present : at the present pressure. largest : at the end of the muscle's range, where the
    element's state z has its own (|z| <= 1).
    """

    present: ca.SX
    largest: ca.SX

    @classmethod
    def of(
        cls, plant: Declares, name: str, key: str, value: float, motion: Motion
    ) -> PressureScale | None:
        """Declare ``<name>.<key>_per_pressure``; None where the friction does not grow."""
        if not value:
            return None
        scope = Scope(plant, name)
        slope = scope.of("1/Pa", 1e-6, min=0.0, max=LARGEST_SCALE).parameter(
            f"{key}_per_pressure",
            value,
            f"growth of the friction of {name} with pressure, as part of its own",
        )
        top = float(motion.muscle.pressure_range[1])
        return cls(1 + slope * ca.fmax(motion.pressure, 0), 1 + slope * top)


@dataclass(frozen=True)
class Limits:
    """Ends of the range in which an element holds, in parts of the largest that it can ever hold.

    upper : while the muscle contracts. lower : while it relaxes. Both > 0.
    """

    upper: ca.SX
    lower: ca.SX

    def held(self, z: ca.SX) -> ca.SX:
        """The part of z that the element holds at present."""
        return ca.SX(ca.fmax(ca.fmin(z, self.upper), -self.lower))

    def passing(self, z: ca.SX, rate: ca.SX, speed: ca.SX, edge: ca.SX) -> ca.SX:
        """The part of the rate that goes into z: all while it sticks, none at the limit."""
        up, down = (rate + speed) / 2, (rate - speed) / 2
        return ca.SX(
            up * passage(z / self.upper, edge, 3.0) + down * passage(-z / self.lower, edge, 3.0)
        )

    def release(self, z: ca.SX) -> ca.SX:
        """Rate at which z comes back to a limit that has fallen below it [1/s].

        Over the first tenth beyond the limit its slope grows from zero, so that it is smooth.
        """
        over, under = (ca.fmax(e, 0) for e in (z - self.upper, -self.lower - z))
        soft = [e * ca.fmin(e / (0.1 * s), 1) for e, s in ((over, self.upper), (under, self.lower))]
        return ca.SX((soft[1] - soft[0]) / RELEASE)
