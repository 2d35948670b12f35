"""The form that every planning problem takes: nodes, legs, conditions, objective."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, UnknownNameError, require_finite, require_positive
from ...core.variables import Variable
from ...judge.statement import (
    COSTS,
    TIME,
    Profile,
    aim_and_weight,
    budget_range,
    mechanical_power,
    muscles_of,
    require_expression,
    subject,
    times_seconds,
)
from ...plants.plant import Plant

Array: TypeAlias = NDArray[np.float64]
Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Condition:
    """low <= expression(x, u, p, ...) <= high; at one node of the motion, or all along a leg."""

    label: str
    expression: ca.SX
    low: float
    high: float
    nominal: float
    shown: Variable
    """The variable whose unit the value is shown in."""
    defining: bool = False
    """Whether it says what an auxiliary is, rather than limits the motion."""


@dataclass(frozen=True, eq=False)
class Leg:
    """The motion between two nodes: bounds of its duration [s], conditions and bounds along it."""

    duration: Range
    path: tuple[Condition, ...]
    bounds: dict[str, Range]
    """{state or input: (low, high)}."""
    dwell: bool = False
    """A rest at the stop before it, not a motion."""


@dataclass(frozen=True, eq=False)
class Budget:
    """low <= integral of ``integrand`` over the motion <= high."""

    label: str
    integrand: ca.SX
    low: float
    high: float
    nominal: float
    shown: Variable


@dataclass(frozen=True, eq=False)
class Auxiliary:
    """An unknown wherever costs and budgets are evaluated, so that their kinks are stated exactly.

    The integral of max(P, 0) is the least integral of s with s >= P and s >= 0, and the largest of
    c P with 0 <= c <= 1: smooth for a solver, and exact.
    """

    symbol: ca.SX
    value: ca.SX
    """What it is at the optimum: an expression of x, u, p, ... with kinks."""
    low: float
    high: float
    conditions: tuple[Condition, ...] = ()
    """What holds wherever it stands."""


@dataclass(frozen=True)
class Objective:
    """What is minimised: a weighted sum."""

    time: float
    """Weight of the duration."""
    rate: float
    """Weight of the squared rate of the inputs, in units of nominal."""
    integrand: ca.SX
    """Running cost: its integral is added."""
    final: ca.SX
    """Cost of the last node."""
    peaks: tuple[float, ...]
    """Weight of each further unknown: of peaks; 0 for inputs that would hold the plant at a stop.
    """
    economical: bool = False
    """Whether work, air or exergy counts."""
    words: str = ""
    """The sum in words, with the unit of each term."""

    @property
    def only_time(self) -> bool:
        """Whether nothing but the duration counts."""
        rest = (self.integrand, self.final)
        return (
            self.time > 0
            and not self.rate
            and not any(self.peaks)
            and all(e.is_zero() for e in rest)
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """A motion of a plant through nodes, with a leg between each two.

    stops : values at the nodes, for the first guess.
    nodes : conditions at each node (stops, and rest there).
    closing : None, or {state: (sign, image)}: the last node's image is the first node.
    design : {parameter: (low, high)} to be chosen with the motion.
    profiles, aims : what the symbols ``r`` and ``q`` stand for: values of time profiles, constant
        aims. ``m`` are further unknowns, in units of nominal: largest values along the motion,
        inputs that would hold the plant at a stop.
    auxiliaries : unknowns of costs and budgets, wherever these are evaluated.
    typical : of each leg [s], where a program was built with other numbers; it knows no others.
        Of other legs than these it says nothing.
    """

    plant: Plant
    stops: tuple[dict[str, Any], ...]
    nodes: tuple[tuple[Condition, ...], ...]
    legs: tuple[Leg, ...]
    closing: dict[str, tuple[float, str]] | None
    objective: Objective
    budgets: tuple[Budget, ...] = ()
    design: dict[str, Range] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()
    aims: tuple[float, ...] = ()
    r: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    q: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    m: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    auxiliaries: tuple[Auxiliary, ...] = ()
    typical: tuple[float, ...] | None = None

    @property
    def given(self) -> tuple[ca.SX, ...]:
        """(time, r, q, m): what expressions may depend on besides the plant's x, u and p."""
        return TIME, self.r, self.q, self.m

    def function(self, name: str, expressions: Sequence[ca.SX], *more: ca.SX) -> ca.Function:
        """CasADi function (x, u, p, time, r, q, m, more) -> one column of the expressions."""
        plant = self.plant
        arguments = [plant.x, plant.u, plant.p, *self.given, *more]
        return ca.Function(
            name, arguments, [ca.vertcat(*expressions) if expressions else ca.SX(0, 1)]
        )

    def running(self, name: str, expressions: Sequence[ca.SX]) -> ca.Function:
        """The same of running costs: (x, u, p, time, r, q, m, auxiliaries) -> one column."""
        a = ca.vertcat(ca.SX(0, 1), *(a.symbol for a in self.auxiliaries))
        return self.function(name, expressions, a)

    def arguments(
        self, plant: Plant, t: Array, x: Array, u: Array, peaks: Array
    ) -> tuple[Array, ...]:
        """Of these functions, at times and columns of states and inputs; plant : whose parameters
        count.
        """
        profiles = [profile(t) for profile in self.profiles]
        r = np.vstack(profiles) if profiles else np.zeros((0, len(t)))
        return x, u, plant.vector("parameter"), t[None], r, np.array(self.aims), peaks

    def explicit(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """Running costs with the auxiliaries' values in their place."""
        if not self.auxiliaries:
            return list(expressions)
        symbols, values = zip(*((a.symbol, a.value) for a in self.auxiliaries), strict=True)
        found: list[ca.SX] = ca.substitute(list(expressions), list(symbols), list(values))
        return found

    def conditions(self, name: str, conditions: Sequence[Condition]) -> ca.Function:
        """The same of the conditions' values, in units of their nominals."""
        return self.function(name, [c.expression / c.nominal for c in conditions])

    def depends_on_inputs(self, leg: Leg) -> tuple[Condition, ...]:
        """The path conditions that jump when an input jumps."""
        u = self.plant.u
        return tuple(c for c in leg.path if u.numel() and ca.depends_on(c.expression, u))

    @property
    def time_nominals(self) -> Array:
        """A typical duration of each leg [s]: the unit of durations in a program."""
        if self.typical is not None and len(self.typical) == len(self.legs):
            return np.array(self.typical)
        return np.array([np.sqrt(leg.duration[0] * leg.duration[1]) for leg in self.legs])

    @property
    def design_nominals(self) -> Array:
        """A typical size of each design parameter."""
        return np.array([self.plant.variable(name).nominal for name in self.design])


def limits(conditions: Sequence[Condition | Budget]) -> tuple[Array, Array]:
    """(low, high) of conditions in units of their nominals."""
    low = np.array([c.low / c.nominal for c in conditions])
    high = np.array([c.high / c.nominal for c in conditions])
    return low, high


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
    wanted: Literal["small", "large"] = "small"
    """How the integral that is being stated is wanted."""

    def aim(self, name: str, value: Any, unit: str = "") -> ca.SX:
        """The symbol of a constant aim [unit], or of a Profile's value."""
        if isinstance(value, Profile):
            self.profiles.append(value)
            self.r.append(ca.SX.sym(f"profile_{len(self.r)}"))
            return self.r[-1]
        self.aims.append(require_finite(name, value, unit))
        self.q.append(ca.SX.sym(f"aim_{len(self.q)}"))
        return self.q[-1]

    def positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """max(expression, 0), stated smoothly for an integral that is ``wanted`` small or large."""
        small = self.wanted == "small"
        return (self._at_least_positive if small else self._at_most_positive)(variable, expression)

    def differ(self, one: ca.SX, other: ca.SX) -> bool:
        """Whether two integrands have not the same auxiliaries: one is wanted small, one large."""
        both = [ca.depends_on(e, a.symbol) for a in self.auxiliaries.values() for e in (one, other)]
        return both[::2] != both[1::2]

    def _at_least_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
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

    def _at_most_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
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


FORMS = ("integral", "square", "final", "peak")
_FORM = re.compile(rf"({'|'.join(FORMS)})\((.+)\)$")

FLAT = 1e-5
"""Weight of the squared inputs, in units of their largest values, beside economical terms. These
are often the same for many motions (a load that is let down takes no work at all): then a solver
has no way to choose, and wanders. It adds less than 1e-3 of what such objectives are judged by.
"""


def follows_inputs(plant: Plant, weights: Mapping[str, float]) -> bool:
    """Whether costs are counted that jump with an input: work of muscles whose pressure it is."""
    powers = (
        (mechanical_power(plant, name) for name in muscles_of(plant)) if "work" in weights else ()
    )
    return any(bool(ca.depends_on(each, plant.u)) for each in powers)


def _running(
    plant: Plant, symbols: Symbols, term: str, wanted: Literal["small", "large"] = "small"
) -> tuple[ca.SX, Variable]:
    """(integrand in SI, variable that names the unit of its integral) of a running term."""
    symbols.wanted = wanted
    if term in COSTS:
        return COSTS[term].expression(plant, symbols), COSTS[term].total
    form = _FORM.match(term)
    if form and form[1] in ("integral", "square"):
        variable, expression = subject(plant, form[2])
        if form[1] == "square":
            return (expression / variable.nominal) ** 2, Variable("square", "output", unit="s")
        unit = times_seconds(variable.unit)
        return expression, Variable("integral", "output", unit=unit, nominal=variable.nominal)
    forms: tuple[str, ...] = ("integral(NAME)", "square(NAME)")
    if not form and term != "rate":  # misspelt; budgets are of what adds up alone
        forms = ("rate", *(f"{f}(NAME)" for f in FORMS))
    raise UnknownNameError("objective", term, (*COSTS, *forms))


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
    units = {"time": "s"}
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
            units[term] = _counted(variable)
        else:
            require_positive(f"minimise[{term!r}]", weight, zero=True)
    running += _tracking(plant, symbols, track or {})
    for argument, given in (("integrand", integrand), ("final", final)):
        if given is not None:
            require_expression(plant, argument, given)
    economical = sum(weights[n] for n in weights if n in COSTS and COSTS[n].economical)
    if economical:
        running += FLAT * economical * _squared_inputs(plant)
    if not (any(weights.values()) or track or integrand is not None or final is not None):
        raise InputError(f"minimise = {weights}: at least one weight must be > 0")
    return Objective(
        weights.get("time", 0.0),
        weights.get("rate", 0.0),
        running + (0 if integrand is None else integrand),
        last + (0 if final is None else final),
        tuple(weight for weight, _ in symbols.peaks),
        bool(economical),
        _in_words(weights, units, track or {}, (integrand, final)),
    )


def is_nonnegative(problem: Problem) -> bool:
    """Whether no motion has an objective below 0: it counts positive work and squares, say, and no
    more.
    """
    goal = problem.objective
    if any(goal.peaks) or not goal.final.is_zero():  # all other weights are >= 0
        return False
    counted = ca.vertcat(*(a.symbol for a in problem.auxiliaries if a.low >= 0))
    if not counted.numel():
        return False
    slopes = ca.jacobian(goal.integrand, counted)
    alone = ca.substitute(goal.integrand, counted, ca.DM.zeros(counted.shape))
    if not slopes.is_constant() or not np.all(np.asarray(ca.DM(slopes)) >= 0):
        return False
    return _is_square(alone)


def _is_square(expression: ca.SX) -> bool:
    """Whether an expression is a constant >= 0 and a sum of squares of its symbols."""
    symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(expression))
    curvature, slope = ca.hessian(expression, symbols)
    if not curvature.is_constant():
        return False
    origin = ca.DM.zeros(symbols.shape)
    least, slopes = (ca.DM(ca.substitute(e, symbols, origin)) for e in (expression, slope))
    centred = not np.any(np.asarray(slopes)) and float(least) >= 0
    return centred and bool(np.all(np.linalg.eigvalsh(np.asarray(ca.DM(curvature))) >= 0))


def _squared_inputs(plant: Plant) -> ca.SX:
    """Sum of the squared inputs in units of their largest values, where these are known."""
    sizes = [max(abs(v.min), abs(v.max)) for v in plant.inputs]
    known = [
        size if 0 < size < float("inf") else v.nominal
        for v, size in zip(plant.inputs, sizes, strict=True)
    ]
    return ca.sumsqr(plant.u / ca.DM(known))


def _counted(variable: Variable) -> str:
    """The unit in which an integral counts: its nominal."""
    factor = "" if variable.nominal == 1 else f"{variable.nominal:g} "
    return "" if variable.unit == "1" else f"{factor}{variable.unit}"


def _in_words(
    weights: Mapping[str, float],
    units: Mapping[str, str],
    track: Mapping[str, Any],
    more: tuple[Any, Any],
) -> str:
    """``time [s] + 0.001 rate + 2 tracking of x``."""
    tracked = {f"tracking of {n}": aim_and_weight(n, wanted)[1] for n, wanted in track.items()}
    said = [
        ("" if weight == 1 else f"{weight:g} ")
        + term
        + (f" [{units[term]}]" if units.get(term) else "")
        for term, weight in {**weights, **tracked}.items()
        if weight
    ]
    names = ("integrand", "final")
    return " + ".join(said + [n for n, given in zip(names, more, strict=True) if given is not None])


def _tracking(plant: Plant, symbols: Symbols, track: Mapping[str, Any]) -> ca.SX:
    """Sum of weight ((value - aim)/nominal)^2."""
    total = ca.SX(0)
    for name, wanted in track.items():
        variable = plant.variable(name)
        aim, weight = aim_and_weight(name, wanted)
        error = plant.expression(variable.name) - symbols.aim(
            f"track[{name!r}]", aim, variable.unit
        )
        total += weight * (error / variable.nominal) ** 2
    return total


def budget(
    plant: Plant, term: str, value: Any, symbols: Symbols | None = None
) -> tuple[Budget, ...]:
    """Bounds of the integral of a running term, in its own unit; "time" is that of the whole
    motion. Two where the least and the most are not stated alike.
    """
    symbols = symbols or Symbols()
    integrand, variable = _running(plant, symbols, term)
    low, high = budget_range(term, value, variable.unit)
    label, nominal, inf = f"budget of {term}", variable.nominal, float("inf")
    counted = integrand if low == -inf else _running(plant, symbols, term, "large")[0]
    if low == -inf or not symbols.differ(integrand, counted):
        return (Budget(label, integrand, low, high, nominal, variable),)
    least = Budget(label, counted, low, inf, nominal, variable)
    return (least, *([Budget(label, integrand, -inf, high, nominal, variable)] * (high < inf)))
