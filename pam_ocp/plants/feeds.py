"""A muscle as part of a plant: its constants become parameters, its pressure a feed's business."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import casadi as ca

from ..core.expressions import scalar_expression
from ..core.stop import turns
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .airflow import show
from .components import as_losses, as_muscle, component
from .damping import Loss, Motion
from .dead_time import DeadTime
from .kinds import FEEDS
from .receiver import Compressor, PressureRegulator, Receiver
from .regulator import PairRegulator, Regulator, in_si, pressure_attributes
from .servo_valve import ServoValve
from .spools import FirstOrderSpool, SecondOrderSpool
from .tubes import LumpedTube, QuickExhaust, Tube
from .valves import (
    EXERGY_FLOOR,
    Filling,
    GasFeed,
    OnOffValves,
    SpoolValve,
    valve,
    valve_names,
)

__all__ = [
    "AttachedMuscle",
    "Compressor",
    "DeadTime",
    "Feed",
    "FirstOrderSpool",
    "IdealPressure",
    "LumpedTube",
    "OnOffValves",
    "PairRegulator",
    "PressureRegulator",
    "QuickExhaust",
    "Receiver",
    "Regulator",
    "SecondOrderSpool",
    "ServoValve",
    "SpoolValve",
    "Tube",
    "as_feed",
    "attach",
    "valve",
    "valve_names",
]


def _meter_work(
    plant: Declares, name: str, force: ca.SX, velocity: ca.SX, mass: float | None, totals: bool
) -> ca.SX | None:
    """Declare ``<name>.power`` = F times the speed of shortening [m/s], and what follows from it.

    mass : of the muscle [kg]; known, power (and work) per mass are outputs too.
    totals : add the state ``<name>.work``, the integral of the power, which is returned.
    """
    power = ca.SX(force * velocity)
    per_mass = [("power_per_mass", power, "W/kg", "mechanical power per mass")]
    scope = Scope(plant, name)
    scope.of("W", 100.0).output("power", power, f"mechanical power out of {name}")
    work = None
    if totals:
        work = scope.of("J", 10.0).state("work", f"mechanical work of {name}")
        plant.der(work, power)
        per_mass.append(("work_per_mass", work, "J/kg", "mechanical work per mass"))
    if mass is not None:
        own = scope.of("kg", 0.1, min=1e-6).parameter("own_mass", mass, f"mass of {name} itself")
        show(plant, name, *((k, value / own, unit, 100.0, w) for k, value, unit, w in per_mass))
    return work


def _meter_pneumatics(
    plant: Declares, name: str, pressure: ca.SX, gain: ca.SX, velocity: ca.SX, work: ca.SX
) -> None:
    """Declare what a feed without gas puts into the muscle, the integral of p dV, and the
    efficiency.

    gain : dF/dp = -dV/dl [N/Pa], so that p dV/dt = p gain velocity whatever the volume at rest. In
    this sense a law that is linear in pressure loses nothing over a cycle; losses take their share.
    """
    scope = Scope(plant, name)
    spent = scope.of("J", 10.0).state(
        "pneumatic_work", f"pressure times change of volume, put into {name}"
    )
    plant.der(spent, pressure * gain * velocity)
    scope.of().output(
        "efficiency",
        work / ca.sqrt(spent**2 + EXERGY_FLOOR**2),
        f"work per pneumatic work ({name})",
    )


def _moving_half(plant: Declares, name: str, muscle: Muscle, symbolic: Muscle) -> ca.SX:
    """Declare the mass of a muscle's body; half of it [kg], 0 (and nothing) where it has none.

    One end stands and the other moves with the load: the body is put to both ends in equal parts.
    (With a speed that rises evenly along it, a third would be its inertia and half its weight.)
    """
    if not muscle.body_mass:
        return ca.SX(0)
    per_length, ends = (
        Scope(plant, name).of(unit, 0.1, min=0.0).parameter(key, value, f"{words} of {name}")
        for key, value, unit, words in (
            ("mass_per_length", muscle.mass_per_length, "kg/m", "mass per length of the body"),
            ("end_mass", muscle.end_mass, "kg", "mass of both ends together"),
        )
    )
    return ca.SX((symbolic.rest_length * per_length + ends) / 2)


def _limit_strength(
    plant: Declares, name: str, muscle: Muscle, pressure: ca.SX, force: ca.SX
) -> None:
    """Declare the path constraints of burst and pull-off where the muscle says what it bears."""
    scope = Scope(plant, name)
    for key, largest, value, unit, nominal, what, end in (
        ("burst", muscle.burst_pressure, pressure, "Pa", 1e5, "pressure", "it bursts"),
        ("pull_off", muscle.pull_off, force, "N", 100.0, "force", "an end comes off"),
    ):
        if largest is None:
            continue
        limit = scope.of(unit, nominal, min=1e-6).parameter(
            key, largest, f"{what} that {name} just bears"
        )
        scope.of(unit, nominal, min=0.0).constraint(
            f"to_{key}", limit - value, f"left of {what} before {end} ({name})"
        )


@dataclass(frozen=True)
class AttachedMuscle:
    """Expressions of a muscle inside a plant.

    Examples
    --------
    >>> own = pam.Plant("lifter")
    >>> x, v = own.state("x", unit="m"), own.state("v", unit="m/s")
    >>> attached = own.add_muscle("muscle", muscle, shortening=x, rate=v)
    >>> own.der(x, v)
    >>> own.der(v, (attached.force - 98.0665) / 10.0)
    >>> print(f"{own.equilibrium(x=0.04)['muscle.pressure'] / 1e5:.3f} bar")
    2.687 bar
    """

    name: str
    muscle: Muscle
    """The muscle with symbols for its constants."""
    pressure: ca.SX
    """Gauge pressure [Pa]."""
    contraction: ca.SX
    force: ca.SX
    """Pulling force with losses [N], >= 0."""
    stiffness: ca.SX
    """Stiffness of the force law at constant pressure [N/m]."""
    moving_mass: ca.SX = field(default_factory=lambda: ca.SX(0))
    """Half the mass of its body [kg], which moves with the load; 0 where it has none."""


class Feed(Protocol):
    """How the pressure of a muscle comes about.

    Examples
    --------
    >>> feed: pam.feeds.Feed = pam.feeds.IdealPressure(max_pressure=5e5)
    >>> pam.HangingLoad(muscle, feed=feed).variable("muscle.pressure").max
    500000.0
    """

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """Declare the feed's variables under ``name``; return the gauge pressure [Pa].

        Where none of them is called ``<name>.pressure``, an output of this name shows it.

        contraction [1] and its rate [1/s] are there for feeds whose gas is compressed by motion.
        """


@FEEDS.register(units={"max_pressure": "Pa"})
@dataclass(frozen=True)
class IdealPressure:
    """The input ``<name>.pressure`` is the pressure itself.

    max_pressure : largest pressure [Pa]; by default the end of the muscle's measured range.
    totals : see :class:`Regulator`.

    Examples
    --------
    >>> ideal = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.IdealPressure())
    >>> [v.name for v in ideal.inputs]
    ['muscle.pressure']
    """

    max_pressure: float | None = None
    totals: bool = False

    def __post_init__(self) -> None:
        in_si(self, {"max_pressure": "Pa"})

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        scope = Scope(plant, name).of(**pressure_attributes(muscle, self.max_pressure))
        return scope.input("pressure", f"gauge pressure in {name}")


def as_feed(value: Any) -> Feed:
    """A feed; by default a :class:`Regulator`.

    Examples
    --------
    >>> type(pam.feeds.as_feed(None)).__name__
    'Regulator'
    """
    example = "Regulator(0.05) or SpoolValve()"
    return (
        Regulator() if value is None else cast(Feed, component("feed", value, "connect", example))
    )


_UNITS = {"rest_length": ("m", 0.1), "slack_width": ("N", 1.0)}


@turns
def attach(
    plant: Declares,
    name: str,
    muscle: Muscle | str,
    *,
    shortening: Any,
    rate: Any,
    pre_contraction: Any,
    feed: Feed | None,
    losses: Loss | Sequence[Loss] = (),
) -> AttachedMuscle:
    """See :meth:`Plant.add_muscle`.

    losses : components such as ``CoulombFriction()``, ``BoucWen()`` or ``Creep()``, whose forces
        are taken off the law's tension before the clamp: a slack muscle has no friction either.

    Examples
    --------
    >>> own = pam.Plant("lifter")
    >>> x, v = own.state("x", unit="m"), own.state("v", unit="m/s")
    >>> feed = pam.feeds.IdealPressure()
    >>> attached = pam.feeds.attach(
    ...     own, "muscle", muscle, shortening=x, rate=v, pre_contraction=0.0, feed=feed
    ... )
    >>> attached.name
    'muscle'
    """
    muscle, feed, losses = as_muscle(muscle), as_feed(feed), as_losses(losses)
    shortening = scalar_expression(f"{name}: shortening", shortening)
    rate = scalar_expression(f"{name}: rate", rate)
    symbolic = _with_parameters(plant, name, muscle)
    scope = Scope(plant, name)
    if not isinstance(pre_contraction, ca.SX):
        pre_contraction = scope.of("1", 0.1, min=-0.1, max=0.45, display_unit="%").parameter(
            "pre_contraction", pre_contraction, f"contraction of {name} at zero displacement"
        )
    contraction = pre_contraction + shortening / symbolic.rest_length
    relative_rate = rate / symbolic.rest_length
    bounded = _within_reach(contraction)
    air: Filling | None = None
    if isinstance(feed, GasFeed):
        air = feed.fill(plant, name, symbolic, bounded, relative_rate)
        pressure = air.pressure
    else:
        pressure = feed.connect(plant, name, symbolic, bounded, relative_rate)
    if f"{name}.pressure" not in {v.name for v in plant.variables}:
        scope.of("Pa", 1e5).output("pressure", pressure, f"gauge pressure in {name}")
    tension = symbolic.tension(pressure, bounded)
    gain = ca.jacobian(tension, pressure)
    force = symbolic.force(pressure, bounded)
    stiffness = symbolic.stiffness(pressure, bounded)
    if air is not None and air.stiffening is not None:
        tension, stiffness = _warmed(symbolic, pressure, bounded, air.stiffening)
        force = clamp(tension, symbolic.slack_width)
    if losses:
        motion = Motion(symbolic, pressure, bounded, relative_rate)
        lost = sum((loss.force(plant, name, motion) for loss in losses), ca.SX(0))
        scope.of("N", 100.0).output(
            "loss", lost, f"friction, hysteresis and creep of {name} against its contraction"
        )
        tension, lossless = tension - lost, force
        force = clamp(tension, symbolic.slack_width)
        if air is not None and air.warm is not None:
            air.warm((lossless - force) * rate)  # a slack muscle has no losses
    attached = AttachedMuscle(
        name,
        symbolic,
        pressure,
        contraction,
        force,
        stiffness,
        _moving_half(plant, name, muscle, symbolic),
    )
    _limit_strength(plant, name, muscle, pressure, force)
    _declare_outputs(plant, attached, tension)
    totals = bool(getattr(feed, "totals", False))
    drawn = None
    if totals and isinstance(feed, GasFeed) and air is not None:
        drawn = feed.drawn(plant, name, air)
    work = _meter_work(plant, name, force, rate, muscle.known_mass, totals)
    if isinstance(feed, GasFeed) and air is not None:
        feed.meter(plant, name, air, drawn, work)
    elif work is not None:
        _meter_pneumatics(plant, name, pressure, gain, rate, work)
    return attached


def _warmed(
    muscle: Muscle, pressure: ca.SX, contraction: ca.SX, stiffening: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """(tension, stiffness) of a muscle whose wall's own force has grown by a part of it."""
    kappa = ca.SX.sym("kappa")
    tension = muscle.tension(pressure, kappa) + stiffening * muscle.tension(ca.SX(0), kappa)
    force = clamp(tension, muscle.slack_width)
    both = ca.vertcat(tension, -ca.jacobian(force, kappa) / muscle.rest_length)
    at = ca.substitute(both, kappa, contraction)
    return at[0], at[1]


def _within_reach(contraction: ca.SX) -> ca.SX:
    """The contraction, held above -1: no muscle is stretched to twice its length.

    While a muscle is slack nothing limits the steps of an integrator, and a trial step may end far
    beyond any stretch, where the exponentials of the laws overflow.
    """
    return ca.if_else(contraction < -1, -1, contraction)


def _with_parameters(plant: Declares, name: str, muscle: Muscle) -> Muscle:
    """The muscle with a parameter of the plant for each of its constants."""
    described = {v.name: v for v in muscle.law.coefficient_variables()}

    def symbol(constant: str, value: Any) -> ca.SX:
        scope = Scope(plant, name)
        if constant in described and constant not in _UNITS:
            variable = described[constant]
            return scope.of(
                variable.unit, variable.nominal, min=variable.min, max=variable.max
            ).parameter(
                constant, value, f"{variable.description} ({muscle.law.name} law of {name})"
            )
        unit, nominal = _UNITS[constant]
        words = re.sub("_", " ", constant)
        return scope.of(unit, nominal, min=1e-6).parameter(constant, value, f"{words} of {name}")

    return muscle.substituted(symbol)


def _declare_outputs(plant: Declares, attached: AttachedMuscle, tension: ca.SX) -> None:
    name = attached.name
    scope = Scope(plant, name)
    scope.of("N", 100.0).output("force", attached.force, f"pulling force of {name}")
    scope.of("1", 0.1, display_unit="%").output(
        "contraction", attached.contraction, f"contraction ratio of {name}"
    )
    scope.of("N/m", 1e4).output(
        "stiffness", attached.stiffness, f"stiffness of {name} at constant pressure"
    )
    scope.of("N", 100.0, min=0.0).constraint(
        "tension", tension, f"tension of {name} before the clamp at zero: never slack"
    )
