"""The terms of a plan's objective and its budgets, by name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import casadi as ca

from ...core.errors import InputError, UnknownNameError, require_finite, require_positive
from ...core.variables import Variable
from ...plants.plant import Plant
from .problem import Auxiliary, Budget, Condition, Objective
from .profile import Profile
from .wording import require_expression, subject, times_seconds

__all__ = ["OBJECTIVES", "Symbols", "budget", "objective"]

OBJECTIVES = ("time", "effort", "rate", "work", "air", "exergy")
ECONOMICAL = ("work", "air", "exergy")
FORMS = ("integral", "square", "final", "peak")
_FORM = re.compile(rf"({'|'.join(FORMS)})\((.+)\)$")

POWER = 10.0
"""A typical power of a muscle [W]."""


@dataclass
class Symbols:
    """Symbols that a problem needs besides the plant's; see Problem."""

    profiles: list[Profile] = field(default_factory=list)
    aims: list[float] = field(default_factory=list)
    peaks: list[tuple[float, Condition]] = field(default_factory=list)
    r: list[ca.SX] = field(default_factory=list)
    q: list[ca.SX] = field(default_factory=list)
    m: list[ca.SX] = field(default_factory=list)
    auxiliaries: dict[str, Auxiliary] = field(default_factory=dict)

    def aim(self, name: str, value: Any) -> ca.SX:
        """The symbol of a constant aim, or of a Profile's value."""
        if isinstance(value, Profile):
            self.profiles.append(value)
            self.r.append(ca.SX.sym(f"profile_{len(self.r)}"))
            return self.r[-1]
        self.aims.append(require_finite(name, value))
        self.q.append(ca.SX.sym(f"aim_{len(self.q)}"))
        return self.q[-1]

    def at_least_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """What is max(expression, 0) where its integral is wanted small."""
        name = f"positive {variable.name}"
        if name not in self.auxiliaries:
            symbol = ca.SX.sym(name)
            missed = expression - variable.nominal * symbol
            inf, nominal = float("inf"), variable.nominal
            held = Condition(name, missed, -inf, 0.0, nominal, variable, defining=True)
            value = ca.fmax(expression / nominal, 0)
            self.auxiliaries[name] = Auxiliary(symbol, value, 0.0, inf, (held,))
        return variable.nominal * self.auxiliaries[name].symbol

    def at_most_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """What is max(expression, 0) where its integral is wanted large."""
        name = f"counted {variable.name}"
        if name not in self.auxiliaries:
            counted = Auxiliary(ca.SX.sym(name), expression > 0, 0.0, 1.0)
            self.auxiliaries[name] = counted
        return expression * self.auxiliaries[name].symbol

    def unknown(self) -> ca.SX:
        """The symbol of a further unknown of the motion, of order one."""
        self.m.append(ca.SX.sym(f"unknown_{len(self.m)}"))
        return self.m[-1]

    def peak(self, variable: Variable, expression: ca.SX, weight: float) -> None:
        """A new unknown that no value of the expression exceeds, in units of nominal."""
        excess = expression - variable.nominal * self.unknown()
        label = f"peak of {variable.name}"
        self.peaks.append(
            (weight, Condition(label, excess, -float("inf"), 0.0, variable.nominal, variable))
        )


def _total(plant: Plant, kind: str, term: str) -> ca.SX:
    """Sum of the outputs ``<muscle>.<kind>``."""
    found = [v.name for v in plant.outputs if v.name.endswith(f".{kind}")]
    if not found:
        raise InputError(
            f"{term!r} needs the outputs '<muscle>.{kind}', which plant {plant.name!r} has not; "
            "feed "
            "its muscles by valves (feed=SpoolValve(...)), or give an expression as integrand"
        )
    return ca.sum1(ca.vertcat(*(plant.expression(name) for name in found)))


def _work(plant: Plant, symbols: Symbols, wanted: Literal["small", "large"]) -> ca.SX:
    """Mechanical power out of the muscles, each counted where it is positive [W]."""
    positive = symbols.at_least_positive if wanted == "small" else symbols.at_most_positive
    names = [v.name.removesuffix(".force") for v in plant.outputs if v.name.endswith(".force")]
    muscles = [n for n in names if any(v.name == f"{n}.contraction" for v in plant.outputs)]
    if not muscles:
        raise InputError(f"'work': plant {plant.name!r} has no muscle with force and contraction")
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    total = ca.SX(0)
    for name in muscles:
        rate = ca.jtimes(plant.expression(f"{name}.contraction"), plant.x, xdot)
        length = plant.expression(f"{name}.rest_length")
        power = plant.expression(f"{name}.force") * rate * length
        total += positive(Variable(f"{name}.power", "output", unit="W", nominal=POWER), power)
    return total


def _running(
    plant: Plant, symbols: Symbols, term: str, wanted: Literal["small", "large"] = "small"
) -> tuple[ca.SX, Variable]:
    """(integrand in SI, variable that names the unit of its integral) of a running term."""
    if term == "effort":
        scaled = plant.u / plant.vector("input", attribute="nominal")
        return ca.sumsqr(scaled), Variable("effort", "output", unit="s")
    if term == "work":
        return _work(plant, symbols, wanted), Variable("work", "output", unit="J")
    if term == "air":
        total = _total(plant, "supply_flow", term)
        return total, Variable("air", "output", unit="kg", nominal=1e-3)
    if term == "exergy":
        total = _total(plant, "exergy_flow", term)
        return total, Variable("exergy", "output", unit="J", nominal=10.0)
    form = _FORM.match(term)
    if form and form[1] in ("integral", "square"):
        variable, expression = subject(plant, form[2])
        if form[1] == "square":
            return (expression / variable.nominal) ** 2, Variable("square", "output", unit="s")
        unit = times_seconds(variable.unit)
        return expression, Variable("integral", "output", unit=unit, nominal=variable.nominal)
    raise UnknownNameError("objective", term, (*OBJECTIVES, *(f"{f}(NAME)" for f in FORMS)))


def objective(
    plant: Plant,
    symbols: Symbols,
    minimise: str | Mapping[str, float],
    track: Mapping[str, Any] | None,
    integrand: ca.SX | None,
    final: ca.SX | None,
) -> Objective:
    """The weighted sum that a user asks for; see :func:`pam_ocp.plan`."""
    weights = {minimise: 1.0} if isinstance(minimise, str) else dict(minimise)
    running, last = ca.SX(0), ca.SX(0)
    for term, weight in weights.items():
        require_finite(f"minimise[{term!r}]", weight)
        form = _FORM.match(term)
        if form and form[1] in ("final", "peak"):
            variable, expression = subject(plant, form[2])
            if form[1] == "final":  # a negative weight asks for the most
                last += weight * expression / variable.nominal
            elif require_positive(f"minimise[{term!r}]", weight, zero=True):
                symbols.peak(variable, expression, weight)
        elif term not in ("time", "rate"):
            value, variable = _running(plant, symbols, term)
            if not term.startswith("integral("):
                require_positive(f"minimise[{term!r}]", weight, zero=True)
            running += weight * value / variable.nominal
        else:
            require_positive(f"minimise[{term!r}]", weight, zero=True)
    running += _tracking(plant, symbols, track or {})
    for argument, given in (("integrand", integrand), ("final", final)):
        if given is not None:
            require_expression(plant, argument, given)
    if not (any(weights.values()) or track or integrand is not None or final is not None):
        raise InputError(f"minimise = {weights}: at least one weight must be > 0")
    return Objective(
        weights.get("time", 0.0),
        weights.get("rate", 0.0),
        running + (0 if integrand is None else integrand),
        last + (0 if final is None else final),
        tuple(weight for weight, _ in symbols.peaks),
        any(weights.get(term, 0.0) for term in ECONOMICAL),
    )


def _tracking(plant: Plant, symbols: Symbols, track: Mapping[str, Any]) -> ca.SX:
    """Sum of weight ((value - aim)/nominal)^2."""
    total = ca.SX(0)
    for name, wanted in track.items():
        variable = plant.variable(name)
        aim, weight = wanted if isinstance(wanted, tuple) else (wanted, 1.0)
        require_positive(f"track[{name!r}]: weight", weight)
        error = plant.expression(variable.name) - symbols.aim(f"track[{name!r}]", aim)
        total += weight * (error / variable.nominal) ** 2
    return total


def budget(
    plant: Plant, term: str, value: Any, symbols: Symbols | None = None
) -> tuple[Budget, ...]:
    """Bounds of the integral of a running term, in its own unit; "time" is that of the whole
    motion. Two where the least and the most are not stated alike.
    """
    symbols = symbols or Symbols()
    if term == "time":
        integrand, variable = ca.SX(1), Variable("time", "output", unit="s")
    else:
        integrand, variable = _running(plant, symbols, term)
    pair = value if isinstance(value, tuple | list) else (None, value)
    if len(pair) != 2 or (pair[0] is None and pair[1] is None):
        raise InputError(f"budgets[{term!r}] = {value!r}: give the most, or (least, most)")
    low, high = (
        default if v is None else require_finite(f"budgets[{term!r}]", v, variable.unit)
        for v, default in zip(pair, (-float("inf"), float("inf")), strict=True)
    )
    if low > high:
        raise InputError(f"budgets[{term!r}] = ({low:g}, {high:g}): the bounds are crossed")
    label, nominal, inf = f"budget of {term}", variable.nominal, float("inf")
    if term != "work" or low == -inf:
        return (Budget(label, integrand, low, high, nominal, variable),)
    counted, _ = _running(plant, symbols, term, "large")
    least = Budget(label, counted, low, inf, nominal, variable)
    return (least, *([Budget(label, integrand, -inf, high, nominal, variable)] * (high < inf)))
