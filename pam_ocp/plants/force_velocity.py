"""A force-velocity relation: what a muscle loses by moving, levelling off with speed."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ..core.errors import require_positive
from ..core.system import Declares, Scope
from .damping import Motion
from .kinds import LOSSES


@LOSSES.register(
    units={
        "contracting": "N",
        "contracting_per_pressure": "N/Pa",
        "relaxing": "N",
        "relaxing_per_pressure": "N/Pa",
        "speed": "m/s",
        "turn": "m/s",
    }
)
@dataclass(frozen=True)
class ForceVelocity:
    """F = A(p) v/(b + |v|), A = A0 + A1 p: Hill's hyperbola, with one A for each way.

    At small speed a damper A/b, at large speed a force that no more grows; with pressure the whole
    curve grows. |v| is rounded from above, so that it dissipates at any speed.

    contracting, relaxing : A0 [N]. contracting_per_pressure, relaxing_per_pressure : A1 [N/Pa].
    speed : b [m/s], at which half of A is lost. turn : below about this speed [m/s] the two ways
        go over into each other (tanh).

    Source: the hyperbola of A. V. Hill, Proc. R. Soc. B 126 (1938) 136-195, in the form of a loss
    taken off the static force; that pressure scales it is our choice of form, the straight lines
    those of Reynolds et al. 2003 (see :class:`DirectionalDamping`). No set of parameters was found.

    Examples
    --------
    >>> loss = pam.losses.ForceVelocity(contracting=20.0, relaxing=15.0)
    >>> run = pam.simulate(pam.HangingLoad(muscle, 10.0, losses=loss), duration=0.5)
    >>> bool((run["muscle.loss"] * run["v"]).min() > -1e-6)  # it only takes
    True
    """

    contracting: float = 20.0
    contracting_per_pressure: float = 1e-4
    relaxing: float = 15.0
    relaxing_per_pressure: float = 5e-5
    speed: float = 0.1
    turn: float = 1e-3

    def __post_init__(self) -> None:
        for argument in ("contracting", "relaxing"):
            for key, unit in ((argument, "N"), (f"{argument}_per_pressure", "N/Pa")):
                require_positive(f"ForceVelocity.{key}", getattr(self, key), unit, zero=True)
        for key in ("speed", "turn"):
            require_positive(f"ForceVelocity.{key}", getattr(self, key), "m/s")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        scope = Scope(plant, name)
        a0, a1, r0, r1, half, turn = (
            scope.of(unit, nominal, min=low).parameter(
                f"velocity_{key}", getattr(self, key), f"force-velocity relation of {name}: {words}"
            )
            for key, unit, low, nominal, words in (
                ("contracting", "N", 0.0, 10.0, "lost at high speed while contracting"),
                ("contracting_per_pressure", "N/Pa", 0.0, 1e-4, "the same, per pressure"),
                ("relaxing", "N", 0.0, 10.0, "lost at high speed while relaxing"),
                ("relaxing_per_pressure", "N/Pa", 0.0, 1e-4, "the same, per pressure"),
                ("speed", "m/s", 1e-9, 0.1, "speed at which half of it is lost"),
                ("turn", "m/s", 1e-9, 1e-3, "speed below which the ways go over"),
            )
        )
        v, p = motion.velocity, ca.fmax(motion.pressure, 0)
        share = (1 + ca.tanh(v / turn)) / 2
        full = r0 + r1 * p + (a0 - r0 + (a1 - r1) * p) * share
        return ca.SX(full * v / (half + ca.sqrt(v**2 + turn**2)))
