"""What a user says of a motion besides numbers: stops, phases, constraints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import casadi as ca

from ...core.errors import InputError, require_finite, require_positive
from ...core.variables import Variable
from ...plants.plant import Plant
from .problem import TIME, Condition

__all__ = ["Avoid", "Constraint", "Phase", "Stop"]

Duration: TypeAlias = "float | tuple[float, float] | None"


@dataclass(frozen=True)
class Stop:
    """A point that the motion visits; a plain mapping is a Stop with all else at its default.

    values : {state, input or output: value, or (low, high) with None for an open end}, SI.
    rest : all positions have zero velocity and acceleration there (or inputs that would hold them
        so, where an input sets the acceleration at once); False makes it a via point. None follows
        the plan's own ``rest``.
    dwell : how long the motion stays [s], or (shortest, longest); all named values are then held.
    within : how far they may stray during the dwell, in units of their nominals.

    Examples
    --------
    >>> held = pam.Stop({"x": 0.01}, dwell=0.05)
    >>> stay = pam.plan(slide, [{"x": -0.01}, held, {"x": -0.01}])
    >>> len(stay.durations)  # the dwell is a leg of its own
    3
    """

    values: Mapping[str, Any]
    rest: bool | None = None
    dwell: float | tuple[float, float] = 0.0
    within: float = 1e-3

    def __post_init__(self) -> None:
        if not isinstance(self.values, Mapping):
            raise InputError(f"Stop({self.values!r}): give a mapping, such as Stop({{'x': 0.01}})")
        ends = self.dwell if isinstance(self.dwell, tuple) else (self.dwell,)
        dwell = tuple(require_positive("Stop.dwell", v, "s", zero=True) for v in ends)
        object.__setattr__(self, "dwell", dwell if isinstance(self.dwell, tuple) else dwell[0])
        require_positive("Stop.within", self.within)

    @property
    def dwells(self) -> bool:
        """Whether the motion stays here for a time."""
        return isinstance(self.dwell, tuple) or self.dwell > 0


@dataclass(frozen=True)
class Constraint:
    """low <= expression <= high all along, for an expression of one's own.

    expression : of the plant's symbols (``plant.expression(NAME)``) and ``pam_ocp.TIME``.
    low, high : numbers, None for an open end. nominal : a typical size of the expression.

    Examples
    --------
    >>> net = slide.expression("muscle1.force") - slide.expression("muscle2.force")
    >>> limit = pam.Constraint(net, -300.0, 300.0, name="net force", nominal=100.0, unit="N")
    >>> gentle = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], constraints=[limit])
    >>> gentle.duration > plan.duration
    True
    """

    expression: ca.SX
    low: float | None = None
    high: float | None = None
    name: str = "constraint"
    nominal: float = 1.0
    unit: str = "1"

    def conditions(self, plant: Plant) -> tuple[Condition, ...]:
        """As the planner's conditions."""
        require_expression(plant, f"Constraint {self.name!r}", self.expression)
        low, high = (
            default
            if value is None
            else require_finite(f"Constraint {self.name!r}", value, self.unit)
            for value, default in ((self.low, -float("inf")), (self.high, float("inf")))
        )
        if low > high or (self.low is None and self.high is None):
            raise InputError(
                f"Constraint {self.name!r}: low = {self.low}, high = {self.high}; give one of "
                "them, or both with low <= high"
            )
        shown = Variable("value", "constraint", unit=self.unit, nominal=self.nominal)
        return (Condition(self.name, self.expression, low, high, self.nominal, shown),)


@dataclass(frozen=True)
class Avoid:
    """A forbidden region: an ellipsoid around a point in any states, inputs or outputs.

    region : {name: (centre, half width)}; sum of ((value - centre)/half width)^2 >= 1 all along.
        "time" may be one of the names: a place that is taken for a while.

    Examples
    --------
    >>> fast = pam.Avoid({"x": (0.0, 0.004), "v": (0.6, 0.2)}, name="fast in the middle")
    >>> slower = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], constraints=[fast])
    >>> slower.verified, slower.duration > plan.duration
    (True, True)
    """

    region: Mapping[str, tuple[float, float]]
    name: str = "forbidden region"

    def conditions(self, plant: Plant) -> tuple[Condition, ...]:
        """As the planner's conditions."""
        if not self.region:
            raise InputError("Avoid: the region is empty; give {'x': (centre, half width)}")
        distance = ca.SX(0)
        for key, value in self.region.items():
            if not (isinstance(value, Sequence) and len(value) == 2):
                raise InputError(f"Avoid: {key} = {value!r}: give (centre, half width)")
            timed = key == "time"
            unit, expression = ("s", TIME) if timed else _measured(plant, key)
            centre = require_finite(f"Avoid: centre of {key}", value[0], unit)
            width = require_positive(f"Avoid: half width of {key}", value[1], unit)
            distance += ((expression - centre) / width) ** 2
        shown = Variable("distance", "constraint")
        # the root grows evenly with the distance, so a solver far inside sees a slope of order one
        return (Condition(self.name, ca.sqrt(distance + 1e-12), 1.0, float("inf"), 1.0, shown),)


@dataclass(frozen=True)
class Phase:
    """What holds on one leg of the motion only, over what holds on all.

    duration : seconds, (shortest, longest), or None for free.
    bounds : as for :func:`pam_ocp.plan`. constraints : Constraint and Avoid.

    Examples
    --------
    >>> slow = pam.Phase(bounds={"v": (-0.2, 0.2)})
    >>> stops = [{"x": -0.01}, {"x": 0.01}, {"x": -0.01}]
    >>> there = pam.plan(slide, stops, phases=[slow, None])
    >>> there.durations[0] > there.durations[1]
    True
    """

    duration: Duration = None
    bounds: Mapping[str, Any] = field(default_factory=dict)
    constraints: Sequence[Constraint | Avoid] = ()


def times_seconds(unit: str, power: int = 1) -> str:
    """The unit of an integral over time (power 1) or of a rate (-1): "N/m" -> "N.s/m",
    "N/(m.s)".
    """
    numerator, _, denominator = unit.partition("/")
    factors = [f for f in denominator.strip("()").split(".") if f]
    if power > 0:
        numerator = "s" if numerator == "1" else f"{numerator}.s"
    else:
        factors.append("s")
    below = ".".join(factors)
    return f"{numerator}/({below})" if len(factors) > 1 else f"{numerator}/{below}".rstrip("/")


def subject(plant: Plant, name: str) -> tuple[Variable, ca.SX]:
    """The variable and expression behind NAME or der(NAME)."""
    expression = plant.expression(name)
    if not name.startswith("der("):
        return plant.variable(name), expression
    state = plant.variable(name[4:-1])
    variable = Variable(
        f"der_{state.name}",
        "constraint",
        unit=times_seconds(state.unit, -1),
        nominal=10 * state.nominal,
    )
    return variable, expression


def _measured(plant: Plant, name: str) -> tuple[str, ca.SX]:
    """(unit, expression) of NAME or der(NAME)."""
    variable, expression = subject(plant, name)
    return variable.unit, expression


def require_expression(plant: Plant, argument: str, expression: Any) -> None:
    """InputError unless this is a scalar expression of the plant's symbols and TIME."""
    if not isinstance(expression, ca.SX) or expression.shape != (1, 1):
        raise InputError(
            f"{argument} = {expression!r}: give a scalar CasADi SX expression of the plant"
        )
    known = {s.name() for s in ca.symvar(ca.vertcat(plant.x, plant.u, plant.p, TIME))}
    foreign = {s.name() for s in ca.symvar(expression)} - known
    if foreign:
        raise InputError(
            f"{argument} holds symbols that are not the plant's: {', '.join(sorted(foreign))}; "
            "build it from plant.expression(NAME)"
        )
