"""Two muscles on a joint: flexor and extensor on a pulley, or with moment arms of any shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import casadi as ca
import numpy as np

from ..core.errors import InputError, require_finite, require_positive
from ..core.expressions import expression_of
from ..core.quantities import meant_within
from ..core.system import Scope
from ..muscles.pneumatic_muscle import Muscle
from .components import as_damping, as_muscle
from .damping import ConstantDamping, Damping, Loss
from .feeds import Feed
from .hanging import GRAVITY
from .kinds import PLANTS
from .loads import Coordinate, Load, Wall, applied, as_loads
from .plant import Plant
from .regulator import feeds_of_pair
from .sketch import Disc, Line, Mark, Polygon, Shape, Sketch, Spindle, box
from .slide import mirrored_pair, reach

MomentArm: TypeAlias = "float | Callable[[ca.SX], ca.SX]"

QUADRATURE = 16
"""Gauss points over which a user's moment arm is integrated to the muscle's shortening."""


@PLANTS.register(
    units={
        "inertia": "kg.m2",
        "moment_arm": "m",
        "moment_arm2": "m",
        "link_mass": "kg",
        "link_length": "m",
        "limits": "rad",
    }
)
class AntagonisticJoint(Plant):
    """A joint between two muscles: I theta'' + c theta' = r1 F1 - r2 F2 - m g d sin(theta) + loads.

    Flexor (muscle 1) pulls towards +theta, extensor (muscle 2) towards -theta. A moment arm
    r(theta) is the derivative of the shortening s: kappa1 = k0 + s1(theta)/l0, kappa2 = k0 -
    s2(theta)/l0, so the muscles' work is the joint's work.

    Parameters
    ----------
    muscle, muscle2 : flexor and extensor (equal when muscle2 is not given).
    inertia : moment of inertia about the joint [kg m2].
    moment_arm : radius of the pulley [m], or r(theta) as a function of a CasADi expression;
        moment_arm2 for the extensor.
    pre_contraction : contraction k0 of both muscles at theta = 0.
    link_mass, link_length : mass [kg] of a link and the distance [m] of its centre of mass from the
        joint; its weight pulls towards theta = 0 (hanging down).
    limits : (low, high) angles [rad] of the mechanical stops; None for as far as the muscles go and
        no stops.
    damping, feed, losses, loads : components; by default 0.3 N m s/rad and a ``Regulator()`` each.

    States theta [rad], omega [rad/s] and those of feeds and losses. Outputs ``torque`` of the
    muscles [N m], ``stiffness`` [N m/rad] = -d(torque)/d(theta) at constant pressures and losses,
    and the muscles' own.

    Examples
    --------
    >>> joint = pam.AntagonisticJoint(muscle, inertia=0.05, moment_arm=0.04)
    >>> rest = joint.equilibrium(theta=0.2, stiffness=30.0)
    >>> [f"{rest[name] / 1e5:.2f} bar" for name in ("muscle1.pressure", "muscle2.pressure")]
    ['3.64 bar', '2.70 bar']
    """

    def __init__(
        self,
        muscle: Muscle | str,
        inertia: float = 0.05,
        moment_arm: MomentArm = 0.04,
        pre_contraction: float = 0.125,
        *,
        muscle2: Muscle | str | None = None,
        moment_arm2: MomentArm | None = None,
        link_mass: float = 0.0,
        link_length: float = 0.0,
        limits: tuple[float, float] | None = None,
        damping: Damping | float | None = None,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
        loads: Load | Sequence[Load] = (),
        name: str = "antagonistic_joint",
    ) -> None:
        super().__init__(name, "a joint between two pneumatic muscles, flexor and extensor")
        loads = as_loads(loads)
        pre_contraction = require_finite("pre_contraction", pre_contraction, "1")
        first = as_muscle(muscle)
        muscles = (first, first if muscle2 is None else as_muscle(muscle2, "muscle2"))
        arms = (moment_arm, moment_arm if moment_arm2 is None else moment_arm2)
        low, high = _range(muscles, arms, pre_contraction, limits)
        limits = None if limits is None else (low, high)
        scope = Scope(self)
        theta = scope.of("rad", 0.1, min=low, max=high).state(
            "theta", "angle of the joint, towards the flexor"
        )
        omega = scope.of("rad/s", 1.0).state("omega", "angular velocity")
        moment = scope.of("kg.m2", 0.1, min=1e-9, tunable=True).positive(
            "inertia", inertia, "moment of inertia about the joint"
        )
        k0 = scope.of("1", 0.1, min=0.0, max=0.45, display_unit="%").parameter(
            "pre_contraction", pre_contraction, "contraction of both muscles at theta = 0"
        )
        pair = []
        feeds = feeds_of_pair(self, feed, muscles)
        torque, stiffness, carried, turning = (ca.SX(0) for _ in range(4))
        for i, (part, arm, sign) in enumerate(zip(muscles, arms, (1, -1), strict=True), start=1):
            shortening, radius = self._arm(f"muscle{i}", arm, theta)
            attached = self.add_muscle(
                f"muscle{i}",
                part,
                shortening=sign * shortening,
                rate=sign * radius * omega,
                pre_contraction=k0,
                feed=feeds[i - 1],
                losses=losses,
            )
            torque += sign * radius * attached.force
            slope = ca.jacobian(ca.SX(radius), theta)
            stiffness += radius**2 * attached.stiffness - sign * slope * attached.force
            # of a body at the end of a lever r(theta): m r (r theta'' + r' theta'^2)
            carried += attached.moving_mass * radius**2
            turning += attached.moving_mass * radius * slope * omega**2
            pair.append(attached)
        link, muscles_do = (link_mass, link_length), (torque, stiffness, carried, turning)
        self._move(theta, omega, moment, link, damping, loads, limits, muscles_do)
        even = limits is None or limits[0] == -limits[1]
        one_arm = moment_arm2 is None and not callable(moment_arm)
        if muscles[0] == muscles[1] and one_arm and even and not loads:
            self.mirror({"theta": (-1.0, "theta"), "omega": (-1.0, "omega"), **mirrored_pair(self)})

    def sketch(self) -> Sketch:
        """Flexor and extensor below a pulley with a link, as long as their contractions make
        them."""
        theta, k0 = self.expression("theta"), self.expression("pre_contraction")
        names = ("muscle1", "muscle2")
        lengths = [self.expression(f"{n}.rest_length") for n in names]
        arms = [ca.substitute(self.expression(f"{n}.radius"), theta, 0.0) for n in names]
        pulley = ca.fmax(*arms)
        base = -ca.fmax(*lengths) * (1 - k0) - 1.5 * pulley
        link = ca.fmax(self.expression("link_length"), 3.0 * pulley)
        gap = ca.fmax(pulley, 0.117 * lengths[0])
        tip = (ca.sin(theta), ca.cos(theta))
        shapes: list[Shape] = [
            Polygon(box((-2.6 * gap, base - 0.5 * gap), (2.6 * gap, base)), "ground"),
            Disc((0.0, 0.0), pulley),
        ]
        # the flexor turns the link towards +theta: to the right, with its muscle on the right
        for name, length, arm, side in zip(names, lengths, arms, (1, -1), strict=True):
            top = base + length * (1 - self.expression(f"{name}.contraction"))
            shapes.append(Line([(side * gap, top), (side * arm, 0.0)], "rope"))
            shapes.append(Spindle(name, (side * gap, base), (side * gap, top)))
        shapes.append(Line([(0.0, 0.0), (link * tip[0], link * tip[1])], "rod"))
        return Sketch(
            shapes,
            (-1.1 * link - gap, 1.1 * link + gap),
            (base - 0.8 * gap, 1.25 * link),
            (Mark("theta", [(0.0, 0.0), (1.15 * link * tip[0], 1.15 * link * tip[1])]),),
        )

    def _arm(self, name: str, arm: MomentArm, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
        """(shortening s(theta), moment arm r(theta) = ds/dtheta) of one muscle."""
        scope = Scope(self, name)
        if not callable(arm):
            radius = scope.of("m", 0.01, min=1e-6).parameter(
                "radius",
                require_positive("moment_arm", arm, "m"),
                f"radius of the pulley under {name}",
            )
            return radius * theta, radius
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
        shortening = sum(
            (w / 2 * arm(theta * (x + 1) / 2) for x, w in zip(nodes, weights, strict=True)),
            ca.SX(0),
        )
        radius = scope.of("m", 0.01).output("radius", arm(theta), f"moment arm of {name}")
        return ca.SX(theta * shortening), radius

    def _move(
        self,
        theta: ca.SX,
        omega: ca.SX,
        moment: ca.SX,
        link: tuple[float, float],
        damping: Damping | float | None,
        loads: Sequence[Load],
        limits: tuple[float, float] | None,
        muscles_do: tuple[ca.SX, ca.SX, ca.SX, ca.SX],
    ) -> None:
        """Outputs and the equation of motion. muscles_do : torque and stiffness of the muscles,
        inertia [kg m2] and torque of their own masses.
        """
        torque, stiffness, carried, turning = muscles_do
        scope = Scope(self)
        scope.of("N.m", 10.0).output("torque", torque, "of both muscles on the joint")
        scope.of("N.m/rad", 10.0).output(
            "stiffness", stiffness, "stiffness of the joint at constant pressures"
        )
        g = scope.of("m/s2", 10.0, min=0.0).parameter("gravity", GRAVITY, "gravity")
        mass = scope.of("kg", min=0.0, tunable=True).positive(
            "link_mass", link[0], "mass of the link", zero=True
        )
        length = scope.of("m", 0.1, min=0.0).positive(
            "link_length", link[1], "from the joint to the link's centre of mass", zero=True
        )
        stops = (
            []
            if limits is None
            else [
                Wall(angle, 2e3, 5.0, side, 0.1, name)
                for angle, side, name in (
                    (limits[1], 1, "upper_stop"),
                    (limits[0], -1, "lower_stop"),
                )
            ]
        )
        outside, added = applied(self, [*loads, *stops], Coordinate(theta, omega, rotary=True))
        c = as_damping(damping, ConstantDamping(0.3)).coefficient(
            self, moment, stiffness, "N.m.s/rad"
        )
        weight = mass * g * length * ca.sin(theta)
        self.der(theta, omega)
        pulls = torque - weight - turning - c * omega + outside
        self.der(omega, pulls / (moment + carried + added))


def _range(
    muscles: tuple[Muscle, Muscle],
    arms: tuple[MomentArm, MomentArm],
    pre_contraction: float,
    limits: tuple[float, float] | None,
) -> tuple[float, float]:
    """Angles between which both muscles stay in their range of contraction, and the limits."""
    largest = min(
        reach(part, pre_contraction)
        / (_largest(arm) if callable(arm) else require_positive("moment_arm", arm, "m"))
        for part, arm in zip(muscles, arms, strict=True)
    )
    if limits is None:
        return -largest, largest
    if not isinstance(limits, tuple | list) or len(limits) != 2:
        raise InputError(
            f"limits = {limits!r}: give (low, high) angles [rad], or None for no stops"
        )
    low, high = (require_finite("limits", angle, "rad") for angle in limits)
    if not low < high:
        raise InputError(f"limits = ({low:g}, {high:g}) rad: the lower must be the smaller")
    if max(-low, high) > largest:
        raise InputError(
            f"limits = ({low:g}, {high:g}) rad: with pre_contraction = {pre_contraction:g} the "
            f"muscles allow at most {largest:.4g} rad to either side"
            + meant_within(max(-low, high), "rad", 0.0, largest)
        )
    return low, high


def _largest(arm: Callable[[ca.SX], ca.SX]) -> float:
    """The largest moment arm within a right angle to either side."""
    angle = ca.SX.sym("angle")
    expression = expression_of("moment_arm", arm, angle)
    values = np.asarray(
        ca.Function("arm", [angle], [expression])(np.linspace(-1.6, 1.6, 65)[None, :])
    )
    if not np.all(np.isfinite(values)) or values.max() <= 0:
        raise InputError("moment_arm: the function must give a finite length > 0 about theta = 0")
    return float(values.max())
