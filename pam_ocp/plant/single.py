"""One muscle and a load: two-direction motion against a counterforce."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import require_positive
from ..muscle.losses import Damping, Loss, StiffnessDamping
from ..muscle.muscle import Muscle
from .actuator import Feed
from .plant import Plant

__all__ = ["GRAVITY", "HangingLoad"]

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""


class HangingLoad(Plant):
    """A load hanging on one muscle: m x'' + c x' = F(p, kappa) - m g, x the contraction [m].

    Our reconstruction of the source paper's dynamic model (its equation of motion is not
    available); the damping c is a component, by default 2 zeta sqrt(m k).

    Parameters
    ----------
    muscle : the muscle; its rest length sets the stroke.
    mass : load [kg].
    damping : ``StiffnessDamping(ratio)`` (default 0.1) or ``ConstantDamping(value)``.
    feed : how the pressure comes about; default ``Regulator()``.
    losses : friction, hysteresis, creep of the muscle, as ``(CoulombFriction(), Creep())``.

    States x [m] (upwards), v [m/s], those of feed and losses; outputs of the muscle, and ``stiffness``.
    """

    def __init__(
        self,
        muscle: Muscle,
        mass: float = 20.0,
        *,
        damping: Damping | None = None,
        feed: Feed | None = None,
        losses: Sequence[Loss] = (),
        name: str = "hanging_load",
    ) -> None:
        super().__init__(name, "a load hanging on one pneumatic muscle")
        require_positive("mass", mass, "kg")
        low, high = (k * float(muscle.rest_length) for k in muscle.contraction_range)
        x = self.state(
            "x", unit="m", min=low, max=high, nominal=0.01,
            description="position: shortening of the muscle, upwards",
        )  # fmt: skip
        v = self.state("v", unit="m/s", nominal=0.1, description="velocity")
        m = self.parameter(
            "mass", mass, unit="kg", min=1e-6, nominal=1.0, tunable=True, description="load"
        )
        g = self.parameter(
            "gravity", GRAVITY, unit="m/s2", min=0.0, nominal=10.0, description="gravity"
        )
        attached = self.add_muscle("muscle", muscle, shortening=x, rate=v, feed=feed, losses=losses)
        c = (damping or StiffnessDamping()).coefficient(self, m, attached.stiffness)
        self.der(x, v)
        self.der(v, (attached.force - m * g - c * v) / m)
        self.output(
            "stiffness", attached.stiffness, unit="N/m", nominal=1e4,
            description="stiffness felt by the load at constant pressure",
        )  # fmt: skip
