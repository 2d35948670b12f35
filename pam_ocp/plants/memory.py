"""Losses with memory: hysteresis (Bouc-Wen, Maxwell-slip), creep, and preconditioning (the first
contractions soften the rubber, up to the largest so far: Mullins). Each adds states to a muscle.

Not in the force law, and of this size when measured: hysteresis 0.6 to 3 % of the largest force
(isometric), creep 20 % of the stroke over a hold of 3.5 s. Published parameters of the structures
were not available: identify them from data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from .damping import Motion
from .kinds import LOSSES
from .slip import Limits, PressureScale, passage, require_scale, rounded_speed

WIDEST_RATE = 0.03
"""Rate [1/s] below which the speed of a Bouc-Wen state is smoothed where planning a motion
begins. At rates below it the state follows them as (rate / it)^(1/n): with wider roundings a whole
motion would run along this root, whose slope at 0 is infinite.
"""
EDGE = 0.02
"""Part of the full friction over which BoucWen's |z| <= 1 is kept also in motion below REST_RATE.
"""


@LOSSES.register(units={"friction": "N", "yield_contraction": "1", "per_pressure": "1/Pa"})
@dataclass(frozen=True)
class BoucWen:
    """F = F0 z, dz/dkappa = [1 - (beta sign(kappa' z) + 1 - beta) |z|^n]/yield, |z| <= 1.

    F0 is the friction when fully slid, and F0/yield the stiffness after a reversal. It dissipates
    in every motion (since beta >= 1/2), but its minor loops do not close: under a small
    oscillation the force drifts towards the middle (known of Bouc-Wen; MaxwellSlip does not).

    friction : F0 [N]. yield_contraction : contraction that it takes to slide [1].
    beta : share of the term that differs between loading and unloading, 1/2 .. 1.
    order : n >= 1; the larger, the sharper the passage from sticking to sliding.
    per_pressure : [1/Pa] F0 is that at no pressure, and (1 + per_pressure p) F0 that at p; the
        stiffness stays. What a falling pressure does not hold any more is let go, so it dissipates
        also while pressures change (our choice of form).

    Source: R. Bouc 1967, Y.-K. Wen, J. Eng. Mech. Div. 102 (1976) 249-263; dissipation for
    beta >= |gamma|: F. Ikhouane, J. Rodellar, Systems with Hysteresis, 2007. Normalised so that
    beta + gamma = 1.

    Examples
    --------
    >>> sticky = pam.HangingLoad(muscle, 10.0, losses=pam.losses.BoucWen(friction=20.0))
    >>> up = sticky.equilibrium({"muscle.command": 3e5}, memory="below")
    >>> down = sticky.equilibrium({"muscle.command": 3e5}, memory="above")
    >>> up["x"] < down["x"]
    True
    """

    friction: float = 20.0
    yield_contraction: float = 0.005
    beta: float = 0.5
    order: float = 2.0
    per_pressure: float = 0.0

    def __post_init__(self) -> None:
        require_positive("BoucWen.friction", self.friction, "N", zero=True)
        require_scale("BoucWen.per_pressure", self.per_pressure)
        require_positive("BoucWen.yield_contraction", self.yield_contraction)
        if not 0.5 <= require_finite("BoucWen.beta", self.beta) <= 1:
            raise InputError(
                f"BoucWen.beta = {self.beta:g} must lie in 0.5 .. 1, or it gains energy"
            )
        if require_finite("BoucWen.order", self.order) < 1:
            raise InputError(f"BoucWen.order = {self.order:g} must be >= 1")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        scope = Scope(plant, name)
        friction, width, beta, order = (
            scope.of(unit, nominal, min=low, max=high).parameter(
                f"hysteresis_{key}", value, f"Bouc-Wen hysteresis of {name}: {words}"
            )
            for key, value, unit, low, high, nominal, words in (
                ("force", self.friction, "N", 0.0, ca.inf, 10.0, "force when sliding"),
                ("yield", self.yield_contraction, "1", 1e-9, 1.0, 0.01, "contraction to slide"),
                ("beta", self.beta, "1", 0.5, 1.0, 1.0, "share of loading and unloading"),
                ("order", self.order, "1", 1.0, 50.0, 1.0, "sharpness"),
            )
        )
        z = scope.of(min=-1.0, max=1.0, memory="held").state(
            "hysteresis", f"Bouc-Wen state of {name}: force/friction"
        )
        scale = PressureScale.of(plant, name, "hysteresis", self.per_pressure, motion)
        full = ca.SX(1) if scale is None else scale.present / scale.largest
        share = z / full
        size = (share**2 + 1e-12) ** (order / 2)  # |z|^n with a finite slope at 0
        signed = share * (share**2 + 1e-12) ** ((order - 1) / 2)  # |z|^(n-1) z
        rate = motion.rate
        fast = rounded_speed(plant, name, "hysteresis", rate, WIDEST_RATE)
        # Both vanish at rest like rate^2, so that a memory keeps; |onward| <= speed: it dissipates.
        # At the edge they are those that keep |z| <= 1 however slow the motion.
        keeps, moving = passage(ca.sqrt(share**2 + 1e-12), EDGE), (rate / fast) ** 2
        speed = fast * (1 - keeps * (1 - moving))
        onward = rate * (1 - keeps * (1 - moving))
        slipping = beta * speed * signed + (1 - beta) * onward * size
        if scale is None:
            plant.der(z, (rate - slipping) / width)
            return ca.SX(friction * z)
        limits = Limits(full, full)
        plant.der(z, (rate - slipping) / (width * scale.largest) + limits.release(z))
        return ca.SX(friction * scale.largest * limits.held(z))


@LOSSES.register(units={"friction": "N", "yield_contraction": "1", "per_pressure": "1/Pa"})
@dataclass(frozen=True)
class MaxwellSlip:
    """F = sum F_i z_i: springs in series with dry friction, each sliding at its own |z_i| = 1.

    dz_i/dkappa = 1/yield_i while it sticks; over the last ``edge`` before |z_i| = 1 it goes over
    into sliding (a Dahl model that is sharp at the end), so derivatives are finite. Minor loops
    close to within ``edge`` of the elements' forces; every motion dissipates.

    friction : F_i [N]. yield_contraction : contraction at which each slides [1], as many.
    edge : width of the passage from sticking to sliding, as a part of F_i.
    per_pressure : [1/Pa] F_i are those at no pressure, and (1 + per_pressure p) F_i those at p; see
        :class:`BoucWen`.

    Source: W. D. Iwan, J. Appl. Mech. 33 (1966) 893-900; for muscles T. Vo-Minh et al.,
    IEEE/ASME Trans. Mechatronics 16 (2011) 177-186. The default is an example, no measurement.

    Examples
    --------
    >>> loss = pam.losses.MaxwellSlip(friction=(6.0, 4.0), yield_contraction=(0.002, 0.01))
    >>> sticky = pam.HangingLoad(muscle, 10.0, losses=loss)
    >>> rest = sticky.equilibrium({"muscle.command": 3e5}, memory="below")
    >>> print(f"{rest['muscle.loss']:.1f} N")  # both have slid: 6 + 4
    10.0 N
    """

    friction: Sequence[float] = (6.0, 6.0, 4.0, 4.0)
    yield_contraction: Sequence[float] = (0.002, 0.005, 0.012, 0.03)
    edge: float = 0.02
    per_pressure: float = 0.0

    def __post_init__(self) -> None:
        require_scale("MaxwellSlip.per_pressure", self.per_pressure)
        require_elements(self, "friction", "yield_contraction")
        for argument, zero in (("friction", True), ("yield_contraction", False)):
            values = tuple(
                require_positive(f"MaxwellSlip.{argument}", v, zero=zero)
                for v in getattr(self, argument)
            )
            object.__setattr__(self, argument, values)
        if not 0 < require_finite("MaxwellSlip.edge", self.edge) <= 1:
            raise InputError(f"MaxwellSlip.edge = {self.edge:g} must lie in 0 .. 1")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        rate, speed = motion.rate, rounded_speed(plant, name, "slip", motion.rate)
        scope = Scope(plant, name)
        edge = scope.of("1", 0.1, min=1e-6, max=1.0, widest=1.0).parameter(
            "slip_edge",
            self.edge,
            f"Maxwell-slip of {name}: passage from sticking to sliding, as part of the force",
        )
        scale = PressureScale.of(plant, name, "slip", self.per_pressure, motion)
        full = ca.SX(1) if scale is None else scale.present / scale.largest
        limits = Limits(full, full)
        total = ca.SX(0)
        for i, (force, width) in enumerate(
            zip(self.friction, self.yield_contraction, strict=True), start=1
        ):
            friction = scope.of("N", 10.0, min=0.0).parameter(
                f"slip{i}_force", force, f"Maxwell-slip element {i} of {name}: force when sliding"
            )
            yielding = scope.of("1", 0.01, min=1e-9, display_unit="%").parameter(
                f"slip{i}_yield", width, f"Maxwell-slip element {i} of {name}: contraction to slide"
            )
            z = scope.of(min=-1.0, max=1.0, memory="held").state(
                f"slip{i}", f"Maxwell-slip element {i} of {name}: force/friction"
            )
            passing = limits.passing(z, rate, speed, edge)
            if scale is None:
                plant.der(z, passing / yielding)
                total += friction * z
            else:
                plant.der(z, passing / (yielding * scale.largest) + limits.release(z))
                total += friction * scale.largest * limits.held(z)
        return total


@LOSSES.register(units={"stiffness": "N", "time": "s"})
@dataclass(frozen=True)
class Creep:
    """F = sum K_i (kappa - e_i), de_i/dt = (kappa - e_i)/tau_i: Kelvin-Voigt elements.

    A spring with a dashpot in series, beside the force law. A muscle under a constant load
    contracts at once against the stiffer sum, then creeps on as the e_i follow. Against a linear
    law of slope K the creep is that of a Kelvin-Voigt element in series with a spring: a part
    K_i/(K + K_i) of the stroke, with the retardation time tau_i (1 + K_i/K). This form rather than
    that chain, because it dissipates whatever the law (our choice).

    stiffness : K_i [N] per unit contraction. time : tau_i [s], as many.

    The states start at 0, as after a long rest at rest length; set them to the contraction for a
    muscle that has settled there.

    Examples
    --------
    >>> loss = pam.losses.Creep(stiffness=(500.0, 300.0), time=(1.0, 10.0))
    >>> [v.name for v in pam.HangingLoad(muscle, losses=loss).states][-2:]
    ['muscle.creep1', 'muscle.creep2']
    """

    stiffness: Sequence[float] = (500.0,)
    time: Sequence[float] = (1.0,)

    def __post_init__(self) -> None:
        require_creep(self)

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        return creep_force(plant, name, "creep", self.stiffness, self.time, motion)


def require_creep(component: Any) -> None:
    """Make ``stiffness`` [N] and ``time`` [s] of a component series of numbers, equally long."""
    require_elements(component, "stiffness", "time")
    for argument, unit, zero in (("stiffness", "N", True), ("time", "s", False)):
        label = f"{type(component).__name__}.{argument}"
        values = (require_positive(label, v, unit, zero=zero) for v in getattr(component, argument))
        object.__setattr__(component, argument, tuple(values))


def creep_force(
    plant: Declares,
    name: str,
    key: str,
    stiffnesses: Sequence[float],
    times: Sequence[float],
    motion: Motion,
    *,
    quicker: ca.SX | float = 1.0,
    words: str = "relaxation time",
) -> ca.SX:
    """Sum of K_i (kappa - e_i), de_i/dt = quicker (kappa - e_i)/tau_i: springs on dashpots [N].

    key : of what is declared, ``<name>.<key>1``, ... words : what the times are.
    """
    total = ca.SX(0)
    scope = Scope(plant, name)
    for i, (value, time) in enumerate(zip(stiffnesses, times, strict=True), start=1):
        stiffness = scope.of("N", 1e3, min=0.0).parameter(
            f"{key}{i}_stiffness", value, f"creep element {i} of {name}: force per contraction"
        )
        tau = scope.of("s", 1.0, min=1e-6).parameter(
            f"{key}{i}_time", time, f"creep element {i} of {name}: {words}"
        )
        settled = scope.of("1", 0.1, display_unit="%", memory="settling").state(
            f"{key}{i}", f"creep element {i} of {name}: contraction to which it has settled"
        )
        plant.der(settled, quicker * (motion.contraction - settled) / tau)
        total += stiffness * (motion.contraction - settled)
    return total


def require_elements(component: object, *arguments: str) -> None:
    """Make a single value a series of one; InputError where the series are not equally long."""
    kind = type(component).__name__
    for argument in arguments:
        value = getattr(component, argument)
        if isinstance(value, Real | str):
            object.__setattr__(component, argument, (value,))
        elif not isinstance(value, Sequence | np.ndarray):
            raise InputError(f"{kind}.{argument} = {value!r}: give a number per element")
    counts = {argument: len(getattr(component, argument)) for argument in arguments}
    if len(set(counts.values())) > 1 or 0 in counts.values():
        said = " and ".join(f"{count} of {argument}" for argument, count in counts.items())
        raise InputError(f"{kind}: {said}; give one of each per element")


@LOSSES.register(units={"stiffness": "N", "time": "s", "load": "N"})
@dataclass(frozen=True)
class LoadCreep:
    """F = sum K_i (kappa - e_i), de_i/dt = (1 + T/load) (kappa - e_i)/tau_i, T the law's tension.

    :class:`Creep` whose dashpots flow the more quickly, the more the muscle carries: in a hold of
    given length it creeps the farther, the larger the load, and as the load goes to zero, or
    ``load`` to infinity, it is Creep itself. It dissipates whatever the load does, since no energy
    depends on it.

    stiffness : K_i [N] per unit contraction. time : tau_i without load [s], as many.
    load : tension [N] at which it creeps twice as quickly.

    Source: flow helped by load, H. Eyring, J. Chem. Phys. 4 (1936) 283-291, of which this is the
    first order; the form for a muscle is our choice. Where a record of one load only is at hand,
    use Creep. The states start at 0; see there.

    Examples
    --------
    >>> loss = pam.losses.LoadCreep(stiffness=(500.0,), time=(2.0,), load=500.0)
    >>> [v.name for v in pam.HangingLoad(muscle, losses=loss).states][-1]
    'muscle.load_creep1'
    """

    stiffness: Sequence[float] = (500.0,)
    time: Sequence[float] = (2.0,)
    load: float = 500.0

    def __post_init__(self) -> None:
        require_creep(self)
        require_positive("LoadCreep.load", self.load, "N")

    def force(self, plant: Declares, name: str, motion: Motion) -> ca.SX:
        """See :class:`Loss`."""
        scope = Scope(plant, name)
        load = scope.of("N", 100.0, min=1e-3).parameter(
            "creep_load",
            self.load,
            f"tension at which {name} creeps twice as quickly as without",
        )
        muscle = motion.muscle
        carried = clamp(muscle.tension(motion.pressure, motion.contraction), muscle.slack_width)
        return creep_force(
            plant,
            name,
            "load_creep",
            self.stiffness,
            self.time,
            motion,
            quicker=1 + carried / load,
            words="relaxation time without load",
        )


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
