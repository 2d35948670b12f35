"""Preconditioning: the first contractions soften the rubber, up to the largest so far (Mullins)."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from .damping import Motion
from .kinds import LOSSES
from .slip import rounded_speed

LARGEST = 0.45
"""Of all contractions."""
AHEAD = 1e-3
"""Contraction below its largest within which that begins to follow."""


@LOSSES.register(units={"stiffness": "N", "width": "1", "reached": "1"})
@dataclass(frozen=True)
class Preconditioning:
    """F = K kappa [1 - s tanh((m - |kappa|)/width)], m the largest contraction so far (Mullins).

    A spring of rubber beside the force law, which on the first way up is K kappa, and below the
    largest contraction it has seen is softer by up to the part s. A muscle exercised to m =
    ``reached`` keeps the soft branch up to there; beyond, it goes on along the first one. The state
    m only rises, so each new contraction dissipates what the rubber lost, and old ones nothing.
    Where the force law was fitted to an exercised muscle, give K the rubber's share only.

    stiffness : K [N] per unit of contraction. softening : s, 0 .. 1. width : [1].
    reached : contraction to which it has been exercised before; 0 for a virgin one.

    Rest takes m as it starts, or the contraction at rest where that is larger, whatever the side
    from which the load came.
    Source: R. W. Ogden, D. G. Roxburgh, Proc. R. Soc. A 455 (1999) 2861-2877, eta = 1 - (1/r)
    erf[(Wm - W)/m], with tanh for erf and the contraction in place of the energy W (our
    simplifications: for one spring both grow together). L. Mullins, Rubber Chem. Technol. 42 (1969)
    339-362. Neither could be read here: the form is that of the manuals of finite-element codes.

    Examples
    --------
    >>> loss = pam.losses.Preconditioning(stiffness=300.0, softening=0.3, reached=0.1)
    >>> [v.name for v in pam.HangingLoad(muscle, losses=loss).states][-1]
    'muscle.reached'
    """

    stiffness: float = 300.0
    softening: float = 0.3
    width: float = 0.02
    reached: float = 0.0

    def __post_init__(self) -> None:
        require_positive("Preconditioning.stiffness", self.stiffness, "N", zero=True)
        require_positive("Preconditioning.width", self.width)
        for argument, most in (("softening", 1.0), ("reached", LARGEST)):
            value = require_finite(f"Preconditioning.{argument}", getattr(self, argument))
            if not 0 <= value <= most:
                raise InputError(
                    f"Preconditioning.{argument} = {value:g} must lie in 0 .. {most:g}"
                )

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        scope = Scope(plant, name)
        stiffness, softening, width = (
            scope.of(unit, nominal, min=low, max=high).parameter(
                f"softening_{key}", value, f"rubber of {name}: {words}"
            )
            for key, value, unit, low, high, nominal, words in (
                ("stiffness", self.stiffness, "N", 0.0, ca.inf, 100.0, "force per contraction"),
                ("part", self.softening, "1", 0.0, 1.0, 0.1, "part of it lost by exercise"),
                ("width", self.width, "1", 1e-6, 1.0, 0.01, "contraction over which it is lost"),
            )
        )
        reached = scope.of(
            "1", 0.1, start=self.reached, min=0.0, max=LARGEST, display_unit="%", memory="held"
        ).state("reached", f"largest contraction of {name} so far")
        kappa, rate = motion.contraction, motion.rate
        size = ca.sqrt(kappa**2 + 1e-12)
        outward = rate * kappa / size
        speed = rounded_speed(plant, name, "softening", outward)
        ahead = ca.fmax(0, (kappa**2 / size - reached) / AHEAD + 1)
        plant.der(reached, (outward + speed) / 2 * ca.fmin(ahead, 3) ** 3)
        below = ca.fmax(reached - size, 0)
        return ca.SX(stiffness * kappa * (1 - softening * ca.tanh(below / width)))
