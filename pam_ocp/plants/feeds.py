"""A muscle as part of a plant: its constants become parameters, its pressure a feed's business."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import casadi as ca

from ..core.errors import require_positive
from ..core.system import Declares
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .body import limit_strength, moving_half
from .components import as_losses, as_muscle, component
from .damping import Loss, Motion
from .kinds import FEEDS
from .meters import meter_pneumatics, meter_work
from .valves import GasFeed, OnOffValves, SpoolValve, Tube

__all__ = [
    "AttachedMuscle",
    "Feed",
    "IdealPressure",
    "OnOffValves",
    "Regulator",
    "SpoolValve",
    "Tube",
    "as_feed",
    "attach",
]


@dataclass(frozen=True)
class AttachedMuscle:
    """Expressions of a muscle inside a plant."""

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
    """How the pressure of a muscle comes about."""

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
    """

    max_pressure: float | None = None
    totals: bool = False

    def __post_init__(self) -> None:
        _in_si(self, {"max_pressure": "Pa"})

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        return plant.input(
            f"{name}.pressure",
            **_pressure_attributes(muscle, self.max_pressure),
            description=f"gauge pressure in {name}",
        )


@FEEDS.register(units={"lag": "s", "max_pressure": "Pa", "max_rate": "Pa/s"})
@dataclass(frozen=True)
class Regulator:
    """First-order pressure regulator: p' = (u - p)/lag, u the commanded pressure.

    lag : time constant [s]; 0.05-0.2 s are usual.
    max_pressure : largest command [Pa]; by default the end of the muscle's measured range.
    max_rate : largest |p'| [Pa/s] a plan may ask for, as path constraint ``<name>.pressure_rate``;
        None for no limit. A simulation is not limited by it.
    totals : add the states ``<name>.work`` (mechanical) and ``<name>.pneumatic_work`` (the integral
        of p dV) [J] and the output ``<name>.efficiency``, their ratio. Off by default: pure
        integrals make every equilibrium singular.
    """

    lag: float = 0.05
    max_pressure: float | None = None
    max_rate: float | None = None
    totals: bool = False

    def __post_init__(self) -> None:
        _in_si(self, {"lag": "s", "max_pressure": "Pa", "max_rate": "Pa/s"})

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        attributes = _pressure_attributes(muscle, self.max_pressure)
        pressure = plant.state(
            f"{name}.pressure", **attributes, description=f"gauge pressure in {name}"
        )
        command = plant.input(
            f"{name}.command", **attributes, description=f"commanded gauge pressure of {name}"
        )
        lag = plant.parameter(
            f"{name}.lag",
            self.lag,
            unit="s",
            min=1e-6,
            nominal=0.1,
            description=f"time constant of the pressure regulator of {name}",
        )
        change = (command - pressure) / lag
        plant.der(pressure, change)
        if self.max_rate is not None:
            plant.constraint(
                f"{name}.pressure_rate",
                change,
                unit="Pa/s",
                nominal=1e6,
                min=-self.max_rate,
                max=self.max_rate,
                description=f"rate of the pressure in {name}",
            )
        return pressure


def as_feed(value: Any) -> Feed:
    """A feed; by default a :class:`Regulator`."""
    example = "Regulator(0.05) or SpoolValve()"
    return (
        Regulator() if value is None else cast(Feed, component("feed", value, "connect", example))
    )


def _in_si(component: Any, units: Mapping[str, str]) -> None:
    """Check these fields of a frozen component: numbers > 0, a text with its unit is one; None
    stays.
    """
    for argument, unit in units.items():
        value = getattr(component, argument)
        if value is not None:
            number = require_positive(f"{type(component).__name__}.{argument}", value, unit)
            object.__setattr__(component, argument, number)


def _pressure_attributes(muscle: Muscle, limit: float | None) -> dict[str, Any]:
    top = muscle.pressure_range[1] if limit is None else limit
    return {"unit": "Pa", "min": 0.0, "max": top, "start": top / 2, "nominal": 1e5}


_UNITS = {"rest_length": ("m", 0.1), "slack_width": ("N", 1.0)}


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
    """
    muscle, feed, losses = as_muscle(muscle), as_feed(feed), as_losses(losses)
    symbolic = _with_parameters(plant, name, muscle)
    if not isinstance(pre_contraction, ca.SX):
        pre_contraction = plant.parameter(
            f"{name}.pre_contraction",
            pre_contraction,
            min=-0.1,
            max=0.45,
            nominal=0.1,
            display_unit="%",
            description=f"contraction of {name} at zero displacement",
        )
    contraction = pre_contraction + shortening / symbolic.rest_length
    relative_rate = rate / symbolic.rest_length
    bounded = _within_reach(contraction)
    if isinstance(feed, GasFeed):
        air = feed.fill(plant, name, symbolic, bounded, relative_rate)
        pressure = air.pressure
    else:
        pressure = feed.connect(plant, name, symbolic, bounded, relative_rate)
    if f"{name}.pressure" not in {v.name for v in plant.variables}:
        plant.output(
            f"{name}.pressure",
            pressure,
            unit="Pa",
            nominal=1e5,
            description=f"gauge pressure in {name}",
        )
    tension = symbolic.tension(pressure, bounded)
    gain = ca.jacobian(tension, pressure)
    force = symbolic.force(pressure, bounded)
    if losses:
        motion = Motion(symbolic, pressure, bounded, relative_rate)
        lost = sum((loss.force(plant, name, motion) for loss in losses), ca.SX(0))
        plant.output(
            f"{name}.loss",
            lost,
            unit="N",
            nominal=100.0,
            description=f"friction, hysteresis and creep of {name} against its contraction",
        )
        tension = tension - lost
        force = clamp(tension, symbolic.slack_width)
    attached = AttachedMuscle(
        name,
        symbolic,
        pressure,
        contraction,
        force,
        symbolic.stiffness(pressure, bounded),
        moving_half(plant, name, muscle, symbolic),
    )
    limit_strength(plant, name, muscle, pressure, force)
    _declare_outputs(plant, attached, tension)
    totals = bool(getattr(feed, "totals", False))
    drawn = feed.drawn(plant, name, air) if totals and isinstance(feed, GasFeed) else None
    work = meter_work(plant, name, force, rate, muscle.known_mass, totals)
    if isinstance(feed, GasFeed):
        feed.meter(plant, name, air, drawn, work)
    elif work is not None:
        meter_pneumatics(plant, name, pressure, gain, rate, work)
    return attached


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
        if constant in described and constant not in _UNITS:
            variable = described[constant]
            return plant.parameter(
                f"{name}.{constant}",
                value,
                unit=variable.unit,
                nominal=variable.nominal,
                min=variable.min,
                max=variable.max,
                description=f"{variable.description} ({muscle.law.name} law of {name})",
            )
        unit, nominal = _UNITS[constant]
        words = re.sub("_", " ", constant)
        return plant.parameter(
            f"{name}.{constant}",
            value,
            unit=unit,
            nominal=nominal,
            min=1e-6,
            description=f"{words} of {name}",
        )

    return muscle.substituted(symbol)


def _declare_outputs(plant: Declares, attached: AttachedMuscle, tension: ca.SX) -> None:
    name = attached.name
    plant.output(
        f"{name}.force",
        attached.force,
        unit="N",
        nominal=100.0,
        description=f"pulling force of {name}",
    )
    plant.output(
        f"{name}.contraction",
        attached.contraction,
        nominal=0.1,
        display_unit="%",
        description=f"contraction ratio of {name}",
    )
    plant.output(
        f"{name}.stiffness",
        attached.stiffness,
        unit="N/m",
        nominal=1e4,
        description=f"stiffness of {name} at constant pressure",
    )
    plant.constraint(
        f"{name}.tension",
        tension,
        unit="N",
        nominal=100.0,
        min=0.0,
        description=f"tension of {name} before the clamp at zero: never slack",
    )
