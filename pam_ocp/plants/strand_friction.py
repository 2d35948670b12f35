"""Dry friction of the strands of a braid on each other, which the pressure presses together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from .damping import WIDEST_SPEED, Motion
from .kinds import LOSSES

NEAREST = 0.05
"""Of 1 - kappa: no muscle contracts so far; keeps the friction positive."""


@LOSSES.register(
    units={
        "contact_radius": "m",
        "angle": "rad",
        "diameter": "m",
        "speed": "m/s",
        "stribeck_speed": "m/s",
    }
)
@dataclass(frozen=True)
class StrandFriction:
    """F = mu(v) 4 pi a r0 p (1 - kappa)/tan(alpha0) tanh(v/v0): friction between crossing strands.

    The pressure presses the two layers of a braid together over its surface, A = 2 pi r l; while
    the muscle shortens, strands turn on each other by 2 alpha, with the moment of friction mu p A
    a, a the radius of their contact. The work of both over d(kappa), with cos(alpha) =
    cos(alpha0) (1 - kappa), gives F: in proportion to pressure, falling with contraction. mu falls
    with speed, mu_k (1 + excess exp(-(v/vs)^2)).

    coefficient : kinetic mu_k. contact_radius : a [m], about half the width of a strand.
    angle : alpha0 of the braid at rest [rad]. diameter : 2 r0 [m]; by default the muscle's.
    excess : static over kinetic friction, less 1. speed : v0 [m/s], below which it is smoothed.
    stribeck_speed : vs [m/s].

    Source: that the hysteresis is essentially strand on strand, pressed by the pressure: B. Tondu,
    J. Intell. Mater. Syst. Struct. 23 (2012) 225-253 (abstract read); a coefficient that goes from
    static to kinetic by an exponential of the speed: B. Tondu, P. Lopez, IEEE Control Syst. Mag. 20
    (2000) 15-38 (abstract read: a three-parameter model of thread on thread). The formula is our
    reconstruction from the geometry of the braid. The default is an example, no measurement.

    Examples
    --------
    >>> loss = pam.losses.StrandFriction(coefficient=0.2)
    >>> run = pam.simulate(pam.HangingLoad(muscle, 10.0, losses=loss), duration=0.5)
    >>> bool((run["muscle.loss"] * run["v"]).min() > -1e-6)  # it only takes
    True
    """

    coefficient: float = 0.3
    contact_radius: float = 5e-4
    angle: float = math.radians(24.42)
    diameter: float | None = None
    excess: float = 0.0
    speed: float = 1e-3
    stribeck_speed: float = 0.02

    def __post_init__(self) -> None:
        for argument, unit in (("coefficient", ""), ("contact_radius", "m"), ("excess", "")):
            value = getattr(self, argument)
            require_positive(f"StrandFriction.{argument}", value, unit, zero=True)
        for argument in ("speed", "stribeck_speed"):
            require_positive(f"StrandFriction.{argument}", getattr(self, argument), "m/s")
        if self.diameter is not None:
            require_positive("StrandFriction.diameter", self.diameter, "m")
        if not 0 < require_finite("StrandFriction.angle", self.angle, "rad") < math.pi / 2:
            raise InputError(f"StrandFriction.angle = {self.angle:g} rad must lie in 0 .. pi/2")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        diameter = motion.muscle.diameter if self.diameter is None else self.diameter
        if diameter is None:
            raise InputError(
                f"muscle {motion.muscle.name!r} has no diameter; give StrandFriction its own "
                "diameter= [m]"
            )
        values = {**vars(self), "diameter": diameter}
        mu, radius, angle, width, excess, speed, stribeck = (
            Scope(plant, name)
            .of(unit, nominal, min=low, max=high, widest=WIDEST_SPEED if key == "speed" else 0.0)
            .parameter(f"strand_{key}", values[key], f"{words} ({name})")
            for key, unit, low, high, nominal, words in (
                ("coefficient", "1", 0.0, ca.inf, 0.1, "kinetic friction of strand on strand"),
                ("contact_radius", "m", 0.0, ca.inf, 1e-3, "radius of the contact of two strands"),
                ("angle", "rad", 1e-3, 1.57, 0.5, "braid angle at rest"),
                ("diameter", "m", 1e-5, ca.inf, 1e-2, "diameter of the braid at rest"),
                ("excess", "1", 0.0, ca.inf, 1.0, "static over kinetic friction, less 1"),
                ("speed", "m/s", 1e-9, ca.inf, 1e-3, "speed below which friction is smoothed"),
                ("stribeck_speed", "m/s", 1e-9, ca.inf, 1e-2, "speed over which it falls"),
            )
        )
        v = motion.velocity
        pressed = ca.fmax(motion.pressure, 0) * ca.fmax(1 - motion.contraction, NEAREST)
        kinetic = mu * 2 * math.pi * radius * width * pressed / ca.tan(angle)
        return ca.SX(kinetic * (1 + excess * ca.exp(-((v / stribeck) ** 2))) * ca.tanh(v / speed))
