"""One muscle and a load: two-direction motion against a counterforce."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ..core.errors import require_finite, require_positive
from ..core.system import Scope
from ..muscles.pneumatic_muscle import Muscle
from .components import as_damping, as_muscle
from .damping import Damping, Loss, StiffnessDamping
from .feeds import Feed
from .kinds import PLANTS
from .loads import Coordinate, Load, applied
from .plant import Plant
from .sketch import Line, Mark, Polygon, Sketch, Spindle, box

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""


def moved_mass(
    plant: Plant, muscle: Muscle, mass: float, slack: float = 0.0
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Declare position (within the muscle's stroke, wider by ``slack`` m below), velocity, mass."""
    low, high = (k * float(muscle.rest_length) for k in muscle.contraction_range)
    scope = Scope(plant)
    x = scope.of("m", 0.01, min=low - slack, max=high, start=max(low - slack, 0.0)).state(
        "x", "position of the load, in the direction of contraction"
    )
    v = scope.of("m/s", 0.1).state("v", "velocity of the load")
    m = scope.of("kg", 1.0, min=1e-6, tunable=True).parameter(
        "mass", require_positive("mass", mass, "kg"), "load"
    )
    return x, v, m


def weight(plant: Plant, mass: ca.SX, inclination: float | None = None) -> ca.SX:
    """Weight against +x [N]: of a vertical motion, or times sin(inclination) of an inclined one."""
    scope = Scope(plant)
    g = scope.of("m/s2", 10.0, min=0.0).parameter("gravity", GRAVITY, "gravity")
    if inclination is None:
        return ca.SX(mass * g)
    angle = scope.of("rad", min=-1.5708, max=1.5708).parameter(
        "inclination",
        require_finite("inclination", inclination, "rad"),
        "of the direction of motion above the horizontal",
    )
    return ca.SX(mass * g * ca.sin(angle))


def hanging_sketch(plant: Plant, gap: float = 0.06) -> Sketch | None:
    """A muscle under the ceiling and what it moves below it; None for a plant that has no such
    variables (x, muscle.contraction, muscle.rest_length).

    gap : between the muscle's end and the load at x = 0, in parts of its length.
    """
    known = {v.name for v in plant.variables}
    if not {"x", "muscle.contraction", "muscle.rest_length"} <= known:
        return None
    x, length = plant.expression("x"), plant.expression("muscle.rest_length")
    shorter = plant.expression("muscle.contraction") * length
    zero = ca.SX(0)
    if "muscle.pre_contraction" in known:
        zero = plant.expression("muscle.pre_contraction") * length
    half, top, end = 0.16 * length, x + zero - (1 + gap) * length, shorter - length
    return Sketch(
        (
            Polygon(box((-1.6 * half, 0.0), (1.6 * half, 0.08 * length)), "ground"),
            Line([(0.0, end), (0.0, top)], "rope"),
            Spindle("muscle", (0.0, end), (0.0, 0.0)),
            Polygon(box((-half, top - 1.4 * half), (half, top))),
            Line([(half, top), (1.15 * half, top)], "needle"),
        ),
        (-3.4 * half, 3.4 * half),
        (-(1.15 + gap) * length - 1.6 * half, 0.12 * length),
        (Mark("x", [(1.15 * half, top), (1.9 * half, top)], "right"),),
    )


@PLANTS.register(units={"mass": "kg", "inclination": "rad"})
class HangingLoad(Plant):
    """A load hanging on one muscle: m x'' + c x' = F(p, kappa) - m g + loads, x the contraction
    [m].

    Our reconstruction of the source paper's dynamic model (its equation of motion is not
    available); the damping c is a component, by default 2 zeta sqrt(m k).

    Parameters
    ----------
    muscle : the muscle, or its name in the catalogue; its rest length sets the stroke.
    mass : load [kg].
    inclination : of +x above the horizontal [rad]: a load pulled up a slope; None for a vertical
        one.
    damping : ``StiffnessDamping(ratio)`` (default 0.1), ``ConstantDamping(value)`` or just its
        value.
    feed : how the pressure comes about; default ``Regulator()``.
    losses : friction, hysteresis, creep of the muscle, as ``(CoulombFriction(), Creep())``.
    loads : what else acts on the mass, as ``(Spring(1e3), ExternalForce())``.

    States x [m] (upwards), v [m/s], those of feed and losses; outputs of the muscle, and
    ``stiffness``.

    Examples
    --------
    >>> plant = pam.HangingLoad(muscle, mass=10.0)
    >>> print(f"{plant.equilibrium(x=0.04)['muscle.force']:.2f} N")  # 10 kg
    98.07 N
    """

    def __init__(
        self,
        muscle: Muscle | str,
        mass: float = 20.0,
        *,
        inclination: float | None = None,
        damping: Damping | float | None = None,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
        loads: Load | Sequence[Load] = (),
        name: str = "hanging_load",
    ) -> None:
        super().__init__(name, "a load hanging on one pneumatic muscle")
        muscle = as_muscle(muscle)
        x, v, m = moved_mass(self, muscle, mass)
        against = weight(self, m, inclination)
        attached = self.add_muscle("muscle", muscle, shortening=x, rate=v, feed=feed, losses=losses)
        own = attached.moving_mass
        against += own * (against / m)
        c = as_damping(damping, StiffnessDamping()).coefficient(self, m, attached.stiffness)
        outside, added = applied(self, loads, Coordinate(x, v))
        self.der(x, v)
        self.der(v, (attached.force - against - c * v + outside) / (m + own + added))
        Scope(self).of("N/m", 1e4).output(
            "stiffness", attached.stiffness, "stiffness felt by the load at constant pressure"
        )
