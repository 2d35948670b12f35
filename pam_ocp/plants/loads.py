"""Loads: forces that act on what a muscle moves. Components that a plant is built with.

Each adds its parameters under its name and gives a force (or a torque, on a joint) in the positive
direction of the plant's coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.stop import turns
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from .components import components
from .kinds import LOADS

__all__ = [
    "Coordinate",
    "Damper",
    "DryFriction",
    "ExternalForce",
    "Inertia",
    "Load",
    "Spring",
    "Wall",
    "applied",
    "as_loads",
]


WIDEST = 100.0
"""Rounding of dry friction where planning a motion begins, in parts of its own."""
FACTOR_WIDTH = 0.1
"""Half width of the smooth end of a wall's damping, in parts of its elastic force."""


@dataclass(frozen=True)
class Coordinate:
    """Where loads act: a position, its velocity, and whether it is an angle.

    Examples
    --------
    >>> import casadi as ca
    >>> at = pam.loads.Coordinate(ca.SX.sym("x"), ca.SX.sym("v"))
    >>> at.length, at.effort
    ('m', 'N')
    """

    position: ca.SX
    velocity: ca.SX
    rotary: bool = False

    @property
    def length(self) -> str:
        """Unit of the position."""
        return "rad" if self.rotary else "m"

    @property
    def effort(self) -> str:
        """Unit of a force along it."""
        return "N.m" if self.rotary else "N"


class Load(Protocol):
    """A force on the moved mass, and where it has ``inertia``, more mass that moves along.

    ``inertia(plant, at)`` gives an expression, or ``inertia`` is a number: [kg], or [kg.m2] on a
    joint.

    Examples
    --------
    >>> load: pam.loads.Load = pam.loads.Spring(1e3)
    >>> sprung = pam.HangingLoad(muscle, loads=[load, pam.loads.ExternalForce("push")])
    >>> [v.name for v in sprung.inputs]
    ['muscle.command', 'push']
    """

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """Declare parameters; the force [N] or torque [N.m] in positive direction."""


@LOADS.register(units={"start": ("N", "N.m")})
@dataclass(frozen=True)
class ExternalForce:
    """The input ``<name>``: a force (or torque) from outside, a disturbance to plans.

    Examples
    --------
    >>> pushed = pam.HangingLoad(muscle, 10.0, loads=pam.loads.ExternalForce("push"))
    >>> [(v.name, v.disturbance) for v in pushed.inputs]
    [('muscle.command', False), ('push', True)]
    """

    name: str = "external_force"
    start: float = 0.0

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`."""
        scope = Scope(plant).of(at.effort, 10.0, start=self.start, disturbance=True)
        return scope.input(self.name, "from outside, in positive direction")


@LOADS.register(units={"stiffness": ("N/m", "N.m/rad"), "rest": ("m", "rad")})
@dataclass(frozen=True)
class Spring:
    """F = -k (position - rest).

    Examples
    --------
    >>> sprung = pam.HangingLoad(muscle, 10.0, loads=pam.loads.Spring(1e3))
    >>> force = sprung.equilibrium(x=0.04)["muscle.force"]
    >>> print(f"{force:.2f} N")  # 10 kg and 40 mm of spring
    138.07 N
    """

    stiffness: float
    rest: float = 0.0
    name: str = "spring"

    def __post_init__(self) -> None:
        require_positive("Spring.stiffness", self.stiffness, zero=True)
        require_finite("Spring.rest", self.rest)

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`."""
        scope = Scope(plant, self.name)
        k = scope.of(f"{at.effort}/{at.length}", 1e3, min=0.0, tunable=True).parameter(
            "stiffness", self.stiffness, f"stiffness of the {self.name}"
        )
        rest = scope.of(at.length, 0.1, tunable=True).parameter(
            "rest", self.rest, f"position at which the {self.name} is relaxed"
        )
        return ca.SX(-k * (at.position - rest))


@LOADS.register(units={"coefficient": ("N.s/m", "N.m.s/rad")})
@dataclass(frozen=True)
class Damper:
    """F = -c velocity.

    Examples
    --------
    >>> damped = pam.HangingLoad(muscle, 10.0, loads=pam.loads.Damper(50.0))
    >>> damped.variable("damper.coefficient").start
    50.0
    """

    coefficient: float
    name: str = "damper"

    def __post_init__(self) -> None:
        require_positive("Damper.coefficient", self.coefficient, zero=True)

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`."""
        c = (
            Scope(plant, self.name)
            .of(f"{at.effort}.s/{at.length}", 10.0, min=0.0, tunable=True)
            .parameter("coefficient", self.coefficient, f"viscous coefficient of the {self.name}")
        )
        return ca.SX(-c * at.velocity)


@LOADS.register(units={"coulomb": ("N", "N.m"), "speed": ("m/s", "rad/s")})
@dataclass(frozen=True)
class DryFriction:
    """F = -F_c tanh(velocity/v0): Coulomb friction of a guide, smoothed below the speed v0.

    Examples
    --------
    >>> rubbed = pam.HangingLoad(muscle, 10.0, loads=pam.loads.DryFriction(5.0))
    >>> rubbed.variable("friction.coulomb").start
    5.0
    """

    coulomb: float
    speed: float = 1e-3
    name: str = "friction"

    def __post_init__(self) -> None:
        require_positive("DryFriction.coulomb", self.coulomb, zero=True)
        require_positive("DryFriction.speed", self.speed)

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`."""
        scope = Scope(plant, self.name)
        coulomb = scope.of(at.effort, 10.0, min=0.0, tunable=True).parameter(
            "coulomb", self.coulomb, f"Coulomb {self.name} of the guide"
        )
        speed = scope.of(f"{at.length}/s", 1e-3, min=1e-9, widest=WIDEST * self.speed).parameter(
            "speed", self.speed, f"speed below which {self.name} is smoothed"
        )
        return ca.SX(-coulomb * ca.tanh(at.velocity / speed))


@LOADS.register(units={"value": ("kg", "kg.m2")})
@dataclass(frozen=True)
class Inertia:
    """Added mass [kg] (or moment of inertia [kg.m2]); no force.

    Examples
    --------
    >>> heavier = pam.HangingLoad(muscle, 10.0, loads=pam.loads.Inertia(5.0))
    >>> heavier.equilibrium(x=0.04)["muscle.pressure"] == point["muscle.pressure"]
    True
    """

    value: float
    name: str = "load_inertia"

    def __post_init__(self) -> None:
        require_positive("Inertia.value", self.value, zero=True)

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`; always zero."""
        return ca.SX(0)

    def inertia(self, plant: Declares, at: Coordinate) -> ca.SX:
        """What is added to the moving mass."""
        scope = Scope(plant).of("kg.m2" if at.rotary else "kg", min=0.0, tunable=True)
        return scope.parameter(self.name, self.value, "inertia of the load that moves along")


@LOADS.register(
    units={
        "position": ("m", "rad"),
        "stiffness": ("N/m", "N.m/rad"),
        "damping": ("N.s/m", "N.m.s/rad"),
        "width": ("N", "N.m"),
    }
)
@dataclass(frozen=True)
class Wall:
    """A stop at ``position``, met from below (side +1) or above (-1): smooth unilateral contact.

    F = k d + c d' for a penetration d > 0, never pulling; contact begins smoothly over ``width``
    [N or N.m] of k d (the polynomial of :func:`force.clamp`), and damping with it, so the force has
    no jump. Adds the output ``<name>.gap``, whose zero crossing
    is the event of contact.

    Examples
    --------
    >>> stopped = pam.HangingLoad(muscle, 10.0, loads=pam.loads.Wall(0.040))
    >>> rest = stopped.equilibrium({"muscle.command": 4e5})
    >>> 0.040 < rest["x"] < 0.045 < plant.equilibrium({"muscle.command": 4e5})["x"]
    True
    """

    position: float
    stiffness: float = 1e5
    damping: float = 50.0
    side: int = 1
    width: float = 1.0
    name: str = "wall"

    def __post_init__(self) -> None:
        require_finite("Wall.position", self.position)
        require_positive("Wall.stiffness", self.stiffness)
        require_positive("Wall.damping", self.damping, zero=True)
        require_positive("Wall.width", self.width)
        if self.side not in (1, -1):
            raise InputError(
                f"Wall.side = {self.side!r}: +1 stops motion upwards, -1 motion downwards"
            )

    def force(self, plant: Declares, at: Coordinate) -> ca.SX:
        """See :class:`Load`."""
        scope = Scope(plant, self.name)
        where = scope.of(at.length, 0.1, tunable=True).parameter(
            "position", self.position, f"where the {self.name} stands"
        )
        k = scope.of(f"{at.effort}/{at.length}", 1e5, min=1e-9).parameter(
            "stiffness", self.stiffness, f"contact stiffness of the {self.name}"
        )
        c = scope.of(f"{at.effort}.s/{at.length}", 100.0, min=0.0).parameter(
            "damping", self.damping, f"contact damping of the {self.name}"
        )
        width = scope.of(at.effort, min=1e-6).parameter(
            "width", self.width, f"contact of the {self.name} begins smoothly over this force"
        )
        penetration = self.side * (at.position - where)
        speed = self.side * at.velocity
        scope.of(at.length, 0.01).output("gap", -penetration, f"distance to the {self.name}")
        elastic = clamp(k * penetration, width)
        # k d (1 + c d'/(k d)), rounded where k d is small; no contact, no force; the factor never
        # below zero, so a wall that the load leaves quickly does not pull it back
        factor = clamp(1 + c * speed / (elastic + width), FACTOR_WIDTH)
        return ca.SX(-self.side * elastic * factor)


def as_loads(value: Any) -> tuple[Load, ...]:
    """Loads: one of them, several, or none.

    Examples
    --------
    >>> pam.loads.as_loads(None), len(pam.loads.as_loads(pam.loads.Spring(1e3)))
    ((), 1)
    """
    return cast("tuple[Load, ...]", components("loads", value, "Spring(1e3)"))


@turns
def applied(plant: Declares, loads: Load | Sequence[Load], at: Coordinate) -> tuple[ca.SX, ca.SX]:
    """(sum of the forces, sum of the added inertias) of all loads at a coordinate.

    Examples
    --------
    >>> import casadi as ca
    >>> own = pam.Plant("own")
    >>> at = pam.loads.Coordinate(ca.SX.sym("x"), ca.SX.sym("v"))
    >>> force, inertia = pam.loads.applied(own, pam.loads.Inertia(2.0), at)
    >>> [p.name for p in own.parameters]
    ['load_inertia']
    """
    force, inertia = ca.SX(0), ca.SX(0)
    for load in as_loads(loads):
        force += load.force(plant, at)
        inertia += _inertia(plant, load, at)
    return force, inertia


def _inertia(plant: Declares, load: Load, at: Coordinate) -> ca.SX:
    """What a load adds to the moving mass: its ``inertia(plant, at)``, or a number of that name."""
    own = getattr(load, "inertia", 0.0)
    added = own(plant, at) if callable(own) else own
    if isinstance(added, ca.SX):
        return added
    argument = f"{type(load).__name__}.inertia"
    return ca.SX(require_positive(argument, added, "kg.m2" if at.rotary else "kg", zero=True))
