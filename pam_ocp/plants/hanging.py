"""One muscle against a load, a spring or a tendon: motion both ways against a counterforce."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ..core.errors import require_finite
from ..core.system import Scope
from ..muscles.law import SLACK_WIDTH, clamp
from ..muscles.pneumatic_muscle import Muscle
from .components import as_damping, as_muscle
from .damping import ConstantDamping, Damping, Loss, StiffnessDamping
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
    m = scope.of("kg", 1.0, min=1e-6, tunable=True).positive("mass", mass, "load")
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


@PLANTS.register(
    units={"mass": "kg", "spring_stiffness": "N/m", "preload": "N", "inclination": "rad"}
)
class SpringOverMuscle(Plant):
    """A muscle inside a bias spring: m x'' + c x' = F - (preload + k_som x) - m g sin(inclination).

    The spring over the muscle (SOM) stretches it back, so that one muscle moves a load both ways.
    x is the contraction [m].

    Parameters
    ----------
    muscle : the muscle. mass : moved [kg].
    spring_stiffness : k_som [N/m]. preload : force of the spring at x = 0 [N].
    inclination : of the +x direction above the horizontal [rad].
    damping, feed, losses, loads : components; by default 2 zeta sqrt(m k) with zeta = 0.1 (k with
        the spring) and a ``Regulator()``.

    States x [m], v [m/s], those of feed and losses; outputs of the muscle, ``spring_force``,
    ``stiffness`` (muscle and spring).

    Examples
    --------
    >>> sprung = pam.SpringOverMuscle(muscle, mass=2.0, spring_stiffness=5e3, preload=100.0)
    >>> print(f"{sprung.equilibrium(x=0.02)['muscle.force']:.1f} N")  # 100 N + 5 kN/m 20 mm
    200.0 N
    """

    def __init__(
        self,
        muscle: Muscle | str,
        mass: float = 2.0,
        spring_stiffness: float = 5e3,
        preload: float = 100.0,
        *,
        inclination: float = 0.0,
        damping: Damping | float | None = None,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
        loads: Load | Sequence[Load] = (),
        name: str = "spring_over_muscle",
    ) -> None:
        super().__init__(name, "a pneumatic muscle inside a bias spring")
        muscle = as_muscle(muscle)
        x, v, m = moved_mass(self, muscle, mass)
        scope = Scope(self)
        k_som = scope.of("N/m", 1e3, min=1e-9).positive(
            "spring_stiffness", spring_stiffness, "stiffness of the spring over the muscle"
        )
        f0 = scope.of("N", 100.0).parameter(
            "preload",
            require_finite("preload", preload, "N"),
            "force of the spring at x = 0, against contraction",
        )
        attached = self.add_muscle("muscle", muscle, shortening=x, rate=v, feed=feed, losses=losses)
        spring = scope.of("N", 100.0).output("spring_force", f0 + k_som * x, "of the spring")
        stiffness = scope.of("N/m", 1e4).output(
            "stiffness",
            attached.stiffness + k_som,
            "stiffness of muscle and spring at constant pressure",
        )
        c = as_damping(damping, StiffnessDamping()).coefficient(self, m, stiffness)
        outside, added = applied(self, loads, Coordinate(x, v))
        self.der(x, v)
        own = attached.moving_mass
        against = weight(self, m, inclination)
        against += own * (against / m)
        self.der(v, (attached.force - spring - against - c * v + outside) / (m + own + added))


@PLANTS.register(
    units={"mass": "kg", "tendon_stiffness": "N/m", "tendon_damping": "N.s/m", "fitting_mass": "kg"}
)
class SeriesLoad(Plant):
    """A muscle pulls a hanging mass by an elastic tendon: two masses, the tendon only pulls.

    m x'' = T - m g + loads and m_e y'' + c y' = F - T with T = k_t (y - x) + c_t (y' - x') >= 0:
    y is the contraction of the muscle, x the position of the mass, m_e its end fitting.

    Parameters
    ----------
    muscle : the muscle. mass : hanging [kg].
    tendon_stiffness : k_t [N/m]. tendon_damping : c_t [N s/m].
    fitting_mass : of the muscle's moving end [kg].
    damping : of the muscle (default ``ConstantDamping(50)``). feed, losses, loads : components;
        loads act on the mass.

    States x, v, ``muscle.shortening`` y, ``muscle.velocity``, those of feed and losses; outputs of
    the muscle, ``tendon_force`` and ``stiffness`` (muscle and tendon in series).

    Examples
    --------
    >>> hung = pam.SeriesLoad(muscle, mass=10.0, tendon_stiffness=1e5)
    >>> rest = hung.equilibrium(x=0.04)
    >>> print(f"{1e3 * (rest['muscle.shortening'] - rest['x']):.3f} mm")  # 98 N on 1e5 N/m
    0.981 mm
    """

    def __init__(
        self,
        muscle: Muscle | str,
        mass: float = 20.0,
        tendon_stiffness: float = 1e5,
        *,
        tendon_damping: float = 20.0,
        fitting_mass: float = 0.2,
        damping: Damping | float | None = None,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
        loads: Load | Sequence[Load] = (),
        name: str = "series_load",
    ) -> None:
        super().__init__(name, "a pneumatic muscle pulling a hanging mass by an elastic tendon")
        muscle = as_muscle(muscle)
        x, v, m = moved_mass(self, muscle, mass, slack=0.1)
        low, high = (k * float(muscle.rest_length) for k in muscle.contraction_range)
        scope = Scope(self)
        y = scope.of("m", 0.01, min=low, max=high, start=max(low, 0.0)).state(
            "muscle.shortening", "shortening of the muscle"
        )
        w = scope.of("m/s", 0.1).state("muscle.velocity", "of its shortening")
        end = scope.of("kg", 0.1, min=1e-6).positive(
            "fitting_mass", fitting_mass, "mass of the muscle's moving end"
        )
        k_t = scope.of("N/m", 1e5, min=1e-9).positive(
            "tendon_stiffness", tendon_stiffness, "stiffness of the tendon"
        )
        c_t = scope.of("N.s/m", 10.0, min=0.0).positive(
            "tendon_damping", tendon_damping, "damping of the tendon", zero=True
        )
        attached = self.add_muscle("muscle", muscle, shortening=y, rate=w, feed=feed, losses=losses)
        pull = clamp(k_t * (y - x) + c_t * (w - v), SLACK_WIDTH)
        scope.of("N", 100.0).output("tendon_force", pull, "in the tendon")
        scope.of("N/m", 1e4).output(
            "stiffness",
            attached.stiffness * k_t / (attached.stiffness + k_t),
            "stiffness of muscle and tendon in series",
        )
        c = as_damping(damping, ConstantDamping(50.0)).coefficient(self, end, attached.stiffness)
        outside, added = applied(self, loads, Coordinate(x, v))
        self.der(x, v)
        against = weight(self, m)
        self.der(v, (pull - against + outside) / (m + added))
        self.der(y, w)
        own = attached.moving_mass
        carried = own * (against / m)
        self.der(w, (attached.force - pull - carried - c * w) / (end + own))

    def sketch(self) -> Sketch | None:
        """The mass hangs on a tendon that can be seen."""
        return hanging_sketch(self, gap=0.25)
