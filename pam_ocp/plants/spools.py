"""How the spool of a proportional valve follows its command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from .kinds import SPOOLS
from .slip import Limits

FARTHEST = 1.5
"""Bound of a spool's position, as part of its travel: a second-order one may overshoot."""
OPENING = 0.1
"""Nominal position of a spool. Its place in its play counts by what it shifts of that."""
EDGE = 0.05
"""Over this last part before it is dragged along, a spool with play begins to slide."""
REST_RATE = 0.1
"""Rate of a spool [1/s] at which its absolute value is smoothed: where it is slower, its place in
its play is off by ``EDGE`` at most.
"""
WIDEST_RATE = 3.0
"""The same where planning a motion begins [1/s]."""
WIDEST_TRAVEL = 0.5
"""Travel over which a spool crosses its play where planning a motion begins."""


class Spool(Protocol):
    """The motion of a spool."""

    def position(self, plant: Declares, name: str, command: ca.SX) -> ca.SX:
        """Declare the states ``<name>.valve.*``; the spool's position, 1 at full travel."""


@SPOOLS.register(units={"time": "s"})
@dataclass(frozen=True)
class FirstOrderSpool:
    """The spool follows its command with a lag, time s' = u - s, optionally with play.

    time : [s]; 2 to 20 ms are usual. hysteresis : width between the way up and down as part of the
        travel, 0 .. 0.2 (data sheets say some 0.004); 0 for none.

    Examples
    --------
    >>> feed = pam.feeds.SpoolValve(spool=pam.feeds.FirstOrderSpool(time=0.01))
    >>> "muscle.valve.spool" in [v.name for v in pam.HangingLoad(muscle, feed=feed).states]
    True
    """

    time: float = 5e-3
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        require_positive("FirstOrderSpool.time", self.time, "s")
        _check_hysteresis("FirstOrderSpool", self.hysteresis)

    def position(self, plant: Declares, name: str, command: ca.SX) -> ca.SX:
        """See :class:`Spool`."""
        s = _position_state(plant, name)
        scope = Scope(plant, name).of("s", 1e-2, min=1e-6)
        time = scope.parameter("valve.time", self.time, f"time constant of the spool of {name}")
        rate = (command - s) / time
        plant.der(s, rate)
        return _with_play(plant, name, s, rate, self.hysteresis)


@SPOOLS.register(units={"frequency": "Hz"})
@dataclass(frozen=True)
class SecondOrderSpool:
    """The spool is a mass on a spring: s'' = w^2 (u - s) - 2 damping w s', w = 2 pi frequency.

    frequency : natural frequency [Hz]. damping : ratio; below 0.7 it overshoots visibly, and the
        opening then exceeds 1: end stops are left out.
    hysteresis : see :class:`FirstOrderSpool`.

    Examples
    --------
    >>> feed = pam.feeds.SpoolValve(spool=pam.feeds.SecondOrderSpool(frequency=60.0))
    >>> len(pam.HangingLoad(muscle, feed=feed).states)
    5
    """

    frequency: float = 60.0
    damping: float = 0.8
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        require_positive("SecondOrderSpool.frequency", self.frequency, "Hz")
        require_positive("SecondOrderSpool.damping", self.damping)
        _check_hysteresis("SecondOrderSpool", self.hysteresis)

    def position(self, plant: Declares, name: str, command: ca.SX) -> ca.SX:
        """See :class:`Spool`."""
        s = _position_state(plant, name)
        scope = Scope(plant, name)
        rate = scope.of("1/s", 10.0, memory="settling").state(
            "valve.rate", f"rate of the spool of {name}"
        )
        frequency = scope.of("Hz", 10.0, min=1e-3).parameter(
            "valve.frequency", self.frequency, f"natural frequency of the spool of {name}"
        )
        damping = scope.of(min=0.0).parameter(
            "valve.damping", self.damping, f"damping ratio of the spool of {name}"
        )
        w = 2 * ca.pi * frequency
        plant.der(s, rate)
        plant.der(rate, w**2 * (command - s) - 2 * damping * w * rate)
        return _with_play(plant, name, s, rate, self.hysteresis)


def _check_hysteresis(kind: str, value: Any) -> None:
    if not 0 <= require_finite(f"{kind}.hysteresis", value) <= 0.2:
        raise InputError(f"{kind}.hysteresis = {value:g} must lie in 0 .. 0.2 of the travel")


def _position_state(plant: Declares, name: str) -> ca.SX:
    return (
        Scope(plant, name)
        .of("1", OPENING, min=-FARTHEST, max=FARTHEST, memory="settling")
        .state("valve.spool", f"position of the spool of {name}: -1 exhaust, 0 closed, 1 supply")
    )


def _with_play(plant: Declares, name: str, s: ca.SX, rate: ca.SX, width: float) -> ca.SX:
    """s less the play's half width times z, |z| <= 1: z follows s until it is dragged along.

    z' = s'/half but where it would leave -1 .. 1; its last ``play_edge`` is smooth, and so is the
    turn of s' within ``play_rest_rate``, as in MaxwellSlip: plans narrow both from wide ones, and
    first let z cross over a longer travel, ``play_stretch`` times its own.
    """
    if not width:
        return s
    scope = Scope(plant, name)
    z = scope.of("1", 2 * OPENING / width, min=-1.0, max=1.0, memory="held").state(
        "valve.play", f"where in its play the spool of {name} is: -1 going down, 1 going up"
    )
    whole, edge, turn, stretch = (
        scope.of(
            unit,
            nominal,
            min=1e-6,
            max=largest,
            widest=widest,
            relaxed=WIDEST_TRAVEL / width if key == "play_stretch" else 0.0,
        ).parameter(f"valve.{key}", value, f"{words} of the spool of {name}")
        for key, value, unit, largest, nominal, widest, words in (
            ("hysteresis", width, "1", 0.5, 0.01, 0.0, "hysteresis, part of the travel,"),
            ("play_edge", EDGE, "1", 1.0, 0.1, 1.0, "passage to being dragged along"),
            ("play_rest_rate", REST_RATE, "1/s", ca.inf, 1e-2, WIDEST_RATE, "rate at rest"),
            ("play_stretch", 1.0, "1", ca.inf, 1.0, 0.0, "stretch of the play"),
        )
    )
    one = ca.SX(1)
    passing = Limits(one, one).passing(z, rate, ca.sqrt(rate**2 + turn**2), edge)
    plant.der(z, 2 * passing / (whole * stretch))
    return ca.SX(s - whole / 2 * z)
