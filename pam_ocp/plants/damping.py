"""Losses without memory: damping, dry friction, and what levels off with speed.

Two kinds of component. A :class:`Damping` belongs to a plant (``damping=``) and gives its viscous
coefficient. A :class:`Loss` belongs to a muscle (``losses=(...)``): it adds its parameters, its
states if it has a memory (see ``memory.py``), and a force against the contraction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .kinds import DAMPINGS, LOSSES

WIDEST_SPEED = 0.1
"""Speed [m/s] below which dry friction is smoothed where planning a motion begins."""
STIFFNESS_FLOOR = 1.0
"""Below about this stiffness [N/m] the square root of StiffnessDamping is smoothed."""


class Damping(Protocol):
    """A viscous damping c [N.s/m] that may depend on the state.

    Examples
    --------
    >>> damping: pam.losses.Damping = pam.losses.ConstantDamping(50.0)
    >>> pam.HangingLoad(muscle, damping=damping).variable("damping").unit
    'N.s/m'
    """

    def coefficient(
        self, plant: Declares, mass: ca.SX, stiffness: ca.SX, unit: str = "N.s/m"
    ) -> ca.SX:
        """c [N.s/m] for a moving ``mass`` [kg] on ``stiffness`` [N/m]; adds its parameters."""


@DAMPINGS.register(units={"value": ("N.s/m", "N.m.s/rad")})
@dataclass(frozen=True)
class ConstantDamping:
    """c = constant [N.s/m].

    Examples
    --------
    >>> damped = pam.HangingLoad(muscle, 10.0, damping=pam.losses.ConstantDamping(50.0))
    >>> damped.variable("damping").start
    50.0
    """

    value: float = 20.0

    def __post_init__(self) -> None:
        require_positive("ConstantDamping.value", self.value, "N.s/m", zero=True)

    def coefficient(
        self, plant: Declares, mass: ca.SX, stiffness: ca.SX, unit: str = "N.s/m"
    ) -> ca.SX:
        scope = Scope(plant).of(unit, 10.0, min=0.0, tunable=True)
        return scope.parameter("damping", self.value, "viscous damping coefficient")


@DAMPINGS.register()
@dataclass(frozen=True)
class StiffnessDamping:
    """c = 2 zeta sqrt(m k): a constant damping ratio, so c is a nonlinear function of displacement.

    Our reconstruction of the source paper's damping "as nonlinear function of displacement"; k is
    the stiffness at the present pressure and contraction. Where it falls to zero (slack) the root
    is smoothed below STIFFNESS_FLOOR, so that its slope stays finite.

    Examples
    --------
    >>> damped = pam.HangingLoad(muscle, 10.0, damping=pam.losses.StiffnessDamping(0.1))
    >>> system = damped.linearize(damped.equilibrium(x=0.04))
    >>> print(f"{pam.operating.modes(system)[0][1]:.2f}")
    0.10
    """

    ratio: float = 0.1

    def __post_init__(self) -> None:
        require_positive("StiffnessDamping.ratio", self.ratio, zero=True)

    def coefficient(
        self, plant: Declares, mass: ca.SX, stiffness: ca.SX, unit: str = "N.s/m"
    ) -> ca.SX:
        ratio = (
            Scope(plant)
            .of("1", 0.1, min=0.0, tunable=True)
            .parameter("damping_ratio", self.ratio, "damping ratio zeta of c = 2 zeta sqrt(m k)")
        )
        rounded = (stiffness + ca.sqrt(stiffness**2 + STIFFNESS_FLOOR**2)) / 2
        return 2 * ratio * ca.sqrt(mass * rounded)


# ---- losses of a muscle ----------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """What a loss may look at: expressions of an attached muscle."""

    muscle: Muscle
    pressure: ca.SX
    contraction: ca.SX
    rate: ca.SX
    """d(contraction)/dt [1/s]."""

    @property
    def velocity(self) -> ca.SX:
        """Speed of shortening [m/s], positive while the muscle contracts."""
        return ca.SX(self.rate * self.muscle.rest_length)


class Loss(Protocol):
    """A force against the contraction of a muscle.

    Examples
    --------
    >>> loss: pam.losses.Loss = pam.losses.Creep()
    >>> pam.HangingLoad(muscle, losses=[loss, pam.losses.CoulombFriction()]).states[-1].name
    'muscle.creep1'
    """

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """Declare what is needed under ``name``; force [N],
        positive where it hinders shortening.
        """


Line = tuple[float, float]
"""Constant [N.s/m] and slope over pressure [N.s/(m.Pa)]."""


@LOSSES.register(units={"speed": "m/s", "rounding": "N.s/m"})
@dataclass(frozen=True)
class DirectionalDamping:
    """F = B(p) v, with one B while the muscle contracts and another while it relaxes.

    contracting, relaxing : lines (constant [N.s/m], per pressure [N.s/(m.Pa)]); B is the largest
        of them, and never negative.
    speed : below about this speed [m/s] the two B go over into each other (tanh).
    rounding : half width [N.s/m] of the rounded kinks between lines; beyond it B is exact.

    Examples
    --------
    >>> loss = pam.losses.DirectionalDamping(contracting=[(50.0, 0.0)], relaxing=[(20.0, 0.0)])
    >>> run = pam.simulate(pam.HangingLoad(muscle, 10.0, losses=loss), duration=0.5)
    >>> bool((run["muscle.loss"] * run["v"]).min() > -1e-6)  # it only takes
    True
    """

    contracting: Sequence[Line]
    relaxing: Sequence[Line]
    speed: float = 1e-3
    rounding: float = 5.0

    def __post_init__(self) -> None:
        for argument in ("contracting", "relaxing"):
            lines = tuple(
                (require_finite(argument, a), require_finite(argument, b))
                for a, b in getattr(self, argument)
            )
            if not lines:
                raise InputError(f"DirectionalDamping.{argument}: give at least one line (B0, B1)")
            object.__setattr__(self, argument, lines)
        require_positive("DirectionalDamping.speed", self.speed, "m/s")
        require_positive("DirectionalDamping.rounding", self.rounding, "N.s/m")

    @classmethod
    def reynolds(cls) -> DirectionalDamping:
        """B = 1.01 + 0.00691 P inflating, 0.6 - 0.000803 P deflating (N.s/mm, P in kPa, 207-621).

        Source: Reynolds et al., Annals of Biomedical Engineering 31 (2003) 310-317. Inflating is
        read as contracting, deflating as relaxing.
        """
        return cls([(1.01e3, 6.91e-3)], [(0.6e3, -0.803e-3)])

    @classmethod
    def festo(cls) -> DirectionalDamping:
        """B = 2.90 contracting; relaxing 1.57 to 372 kPa, then 0.311 + 0.00338 P (N.s/mm, kPa).

        Source: J. L. Serres et al., Comput. Methods Biomech. Biomed. Engin. 12(4) (2009) 423-430,
        doi 10.1080/10255840802654327, as printed in its abstract, for 150-550 kPa.
        """
        return cls([(2.90e3, 0.0)], [(1.57e3, 0.0), (0.311e3, 3.38e-3)])

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        contracting, relaxing = (self._damping(plant, name, way, motion.pressure) for way in _WAYS)
        v = motion.velocity
        share = (1 + ca.tanh(v / self.speed)) / 2
        return ca.SX((relaxing + (contracting - relaxing) * share) * v)

    def _damping(self, plant: Declares, name: str, way: str, pressure: ca.SX) -> ca.SX:
        largest = ca.SX(0)
        scope = Scope(plant, name)
        for i, (constant, slope) in enumerate(getattr(self, way), start=1):
            b0 = scope.of("N.s/m", 1e3).parameter(
                f"{way}{i}", constant, f"damping of {name} while {way}, line {i}"
            )
            b1 = scope.of("N.s/(m.Pa)", 1e-3).parameter(
                f"{way}{i}_per_pressure",
                slope,
                f"damping of {name} while {way}, line {i}, per pressure",
            )
            largest = largest + clamp(b0 + b1 * pressure - largest, self.rounding)
        return largest


_WAYS = ("contracting", "relaxing")


@LOSSES.register(
    units={"constant": "N", "per_pressure": "N/Pa", "speed": "m/s", "stribeck_speed": "m/s"}
)
@dataclass(frozen=True)
class CoulombFriction:
    """F = [Fc + (Fs - Fc) exp(-(v/vs)^2)] tanh(v/v0), Fc = constant + per_pressure max(p, 0).

    Dry friction, smoothed below the speed v0, so a muscle at rest creeps instead of sticking.
    With ``excess`` = (Fs - Fc)/Fc > 0 it falls with speed (Stribeck). It still only resists: it can
    make a driven motion stick and slip, but sustains no vibration of its own.

    constant : [N]. per_pressure : [N/Pa]. excess : static over kinetic friction, less 1.
    speed : v0 [m/s]. stribeck_speed : vs [m/s], to be well above v0.

    Examples
    --------
    >>> rubbed = pam.HangingLoad(muscle, 10.0, losses=pam.losses.CoulombFriction(10.0))
    >>> run = pam.simulate(rubbed, {"muscle.command": 3e5}, duration=1.0)
    >>> bool(abs(run["muscle.loss"]).max() <= 10.0)
    True
    """

    constant: float = 20.0
    per_pressure: float = 0.0
    excess: float = 0.0
    speed: float = 1e-3
    stribeck_speed: float = 0.02

    def __post_init__(self) -> None:
        for argument, unit in (("constant", "N"), ("per_pressure", "N/Pa"), ("excess", "")):
            require_positive(
                f"CoulombFriction.{argument}", getattr(self, argument), unit, zero=True
            )
        for argument in ("speed", "stribeck_speed"):
            require_positive(f"CoulombFriction.{argument}", getattr(self, argument), "m/s")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        scope = Scope(plant, name)
        constant, slope, excess, speed, stribeck = (
            scope.of(
                unit, nominal, min=low, tunable=True, widest=WIDEST_SPEED if key == "speed" else 0.0
            ).parameter(f"friction_{key}", getattr(self, key), f"{words} ({name})")
            for key, unit, low, nominal, words in (
                ("constant", "N", 0.0, 10.0, "dry friction"),
                ("per_pressure", "N/Pa", 0.0, 1e-4, "dry friction per pressure"),
                ("excess", "1", 0.0, 1.0, "static over kinetic friction, less 1"),
                ("speed", "m/s", 1e-9, 1e-3, "speed below which dry friction is smoothed"),
                ("stribeck_speed", "m/s", 1e-9, 1e-2, "speed over which static friction falls"),
            )
        )
        v = motion.velocity
        kinetic = constant + slope * ca.fmax(motion.pressure, 0)
        return ca.SX(kinetic * (1 + excess * ca.exp(-((v / stribeck) ** 2))) * ca.tanh(v / speed))


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
