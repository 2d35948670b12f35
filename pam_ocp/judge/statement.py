"""The statement of a motion in a user's words: stops, phases, constraints, profiles, keywords.

What a plan is asked for, what a planner reads and what a judge reads, each by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeAlias, TypedDict

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import (
    InputError,
    require_finite,
    require_flag,
    require_instance,
    require_numbers,
    require_positive,
)
from ..core.expressions import scalar_expression
from ..core.registry import Registry
from ..core.variables import Variable
from ..operating.held import Memory
from ..plants.plant import Plant

Array: TypeAlias = NDArray[np.float64]

TIME = ca.SX.sym("time")
"""Seconds since the motion began, for expressions of a plan's costs and constraints."""

Duration: TypeAlias = "float | tuple[float, float] | None"


@dataclass(frozen=True)
class Stop:
    """A point that the motion visits; a plain mapping is a Stop with all else at its default.

    values : {state, input or output: value, or (low, high) with None for an open end}, SI.
    rest : all positions have zero velocity and acceleration there (or inputs that would hold them
        so, where an input sets the acceleration at once); False makes it a via point. None follows
        the plan's own ``rest``.
    dwell : how long the motion stays [s], or (shortest, longest); all named values are then held.
    within : how far they may stray during the dwell, scaled by nominals.

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
        object.__setattr__(self, "within", require_positive("Stop.within", self.within))
        require_flag("Stop.rest", self.rest, none="as the plan's own rest=")

    @property
    def dwells(self) -> bool:
        """Whether the motion stays here for a time."""
        return isinstance(self.dwell, tuple) or self.dwell > 0


@dataclass(frozen=True)
class Constraint:
    """low <= expression <= high all along, for an expression of one's own.

    expression : of the plant's symbols (``plant.expression(NAME)``) and ``pam_ocp.planning.TIME``.
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

    @property
    def ends(self) -> tuple[float, float]:
        """(low, high) as numbers; InputError where they limit nothing."""
        argument = f"Constraint {self.name!r}"
        require_positive(f"{argument}: nominal", self.nominal)
        low, high = (
            default if value is None else require_finite(argument, value, self.unit)
            for value, default in ((self.low, -math.inf), (self.high, math.inf))
        )
        if low > high or (self.low is None and self.high is None):
            raise InputError(
                f"{argument}: low = {self.low}, high = {self.high}; give one of them, or both with "
                "low <= high"
            )
        return low, high


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

    def axes(self, plant: Plant) -> list[ca.SX]:
        """Distances from the centre along each axis, in half widths."""
        if not self.region:
            raise InputError("Avoid: the region is empty; give {'x': (centre, half width)}")
        found = []
        for key, value in self.region.items():
            if not (isinstance(value, Sequence) and len(value) == 2):
                raise InputError(f"Avoid: {key} = {value!r}: give (centre, half width)")
            unit, expression = "s", TIME
            if key != "time":
                variable, expression = subject(plant, key)
                unit = variable.unit
            centre = require_finite(f"Avoid: centre of {key}", value[0], unit)
            width = require_positive(f"Avoid: half width of {key}", value[1], unit)
            found.append((expression - centre) / width)
        return found


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


@dataclass(frozen=True, eq=False)
class Profile:
    """Values over the time since the motion began: a bound or an aim for :func:`pam_ocp.plan`.

    t : (n,) rising times [s], n >= 2. values : (n,) values in SI.
    smooth : a cubic spline through the values (n >= 4), two times differentiable, which solvers
        like; by default straight lines. Before the first and behind the last time the end values
        are held.

    Raises InputError for times that do not rise, values that are not finite, or lengths that
    differ.

    Examples
    --------
    >>> roof = pam.Profile([0.0, 0.03, 0.2], [0.0, 0.011, 0.011])
    >>> under = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], bounds={"x": (None, roof)})
    >>> under.verified
    True
    """

    t: Array
    values: Array
    smooth: bool = False

    def __init__(self, t: ArrayLike, values: ArrayLike, smooth: bool = False) -> None:
        times = np.asarray(require_numbers("Profile.t", t, "s"))
        samples = np.asarray(require_numbers("Profile.values", values))
        if times.ndim != 1 or times.shape != samples.shape or len(times) < 2:
            raise InputError(
                f"Profile: {times.shape} times and {samples.shape} values; give two lists of equal "
                "length, at least two entries each"
            )
        if not np.all(np.diff(times) > 0):
            raise InputError("Profile: the times must rise")
        if smooth and len(times) < 4:
            raise InputError(f"Profile: smooth=True needs at least 4 values, not {len(times)}")
        for name, value in (("t", times), ("values", samples), ("smooth", bool(smooth))):
            object.__setattr__(self, name, value)

    def function(self) -> ca.Function:
        """CasADi function t [s] -> value, for use in a symbolic graph."""
        kind = "bspline" if self.smooth else "linear"
        table = ca.interpolant("profile", kind, [self.t.tolist()], self.values.tolist())
        t = ca.MX.sym("t")
        held = ca.fmin(ca.fmax(t, self.t[0]), self.t[-1])
        return ca.Function("profile", [t], [table(held)])

    def __call__(self, t: Any) -> Array:
        """Values at times [s] (any shape)."""
        times = np.asarray(t, float)
        found = np.asarray(self.function()(times.reshape(1, -1)), float)
        return found.reshape(times.shape)


Cyclic: TypeAlias = 'bool | Literal["mirrored"]'


class StatementKeywords(TypedDict, total=False):
    """The keywords of :func:`pam_ocp.plan` that say what is asked of the motion; see there."""

    cyclic: Cyclic
    duration: Any
    minimise: str | Mapping[str, float]
    bounds: Mapping[str, Any] | None
    rest: bool
    memory: Memory
    phases: Sequence[Phase | None] | None
    constraints: Sequence[Constraint | Avoid]
    track: Mapping[str, Any] | None
    budgets: Mapping[str, Any] | None
    design: Mapping[str, tuple[float, float]] | None
    integrand: ca.SX | None
    final: ca.SX | None


@dataclass(frozen=True)
class Statement:
    """What is asked of a motion: the arguments of :func:`pam_ocp.plan` that say it; see there.

    Examples
    --------
    >>> pam.judge.Statement([{"x": -0.01}, {"x": 0.01}], minimise="effort").weights
    {'effort': 1.0}
    """

    stops: Sequence[Mapping[str, Any] | Stop]
    cyclic: Cyclic = False
    duration: Any = None
    minimise: str | Mapping[str, float] = "time"
    bounds: Mapping[str, Any] | None = None
    rest: bool = True
    memory: Memory = "virgin"
    jumps: bool = True
    """Whether inputs may jump at the stops."""
    phases: Sequence[Phase | None] | None = None
    constraints: Sequence[Constraint | Avoid] = ()
    track: Mapping[str, Any] | None = None
    budgets: Mapping[str, Any] | None = None
    design: Mapping[str, tuple[float, float]] | None = None
    integrand: ca.SX | None = None
    final: ca.SX | None = None

    def __post_init__(self) -> None:
        lists = (list, tuple)
        shown = 'give a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]'
        require_instance("stops", self.stops, (*lists, Mapping), shown)
        require_instance(
            "minimise", self.minimise, (str, Mapping), "give a term, or {term: weight}"
        )
        require_flag("rest", self.rest)
        for argument in ("bounds", "track", "budgets", "design"):
            value = getattr(self, argument)
            require_instance(argument, value, Mapping, "give a mapping by name", none=True)
        require_instance("phases", self.phases, lists, "give a list of Phase or None", none=True)
        for i, phase in enumerate(self.phases or ()):
            require_instance(f"phases[{i}]", phase, Phase, "give a Phase or None", none=True)
        remedy = "give a list of Constraint and Avoid"
        require_instance("constraints", self.constraints, lists, remedy)
        for own in (self.constraints, *(p.constraints for p in self.phases or () if p)):
            for each in own:
                if not isinstance(each, Constraint | Avoid):
                    raise InputError(f"constraints: {each!r} is neither a Constraint nor an Avoid")
        if self.cyclic not in (None, False, True, "mirrored"):
            raise InputError(f"cyclic = {self.cyclic!r}: choose True, False or 'mirrored'")

    @property
    def weights(self) -> Mapping[str, float]:
        """The terms of the objective by name."""
        return {self.minimise: 1.0} if isinstance(self.minimise, str) else self.minimise

    def of_legs(self, count: int) -> list[tuple[Phase, Duration]]:
        """What holds on each leg only, and how long it may take."""
        phases = list(self.phases or [None] * count)
        if len(phases) != count:
            raise InputError(
                f"phases holds {len(phases)} entries for {count} phases; give a Phase or None for "
                "each"
            )
        given = self.duration
        listed = isinstance(given, Sequence) and not isinstance(given, tuple | str)
        each = list(given) if listed else [given] * count
        if len(each) != count:
            raise InputError(
                f"duration holds {len(each)} entries for {count} phases; give one per phase"
            )
        own = [phase or Phase() for phase in phases]
        return [
            (p, d if p.duration is None else p.duration) for p, d in zip(own, each, strict=True)
        ]

    @property
    def inputs_jump(self) -> bool:
        """Whether inputs may jump: linear ones cannot, and where their rate costs they better do
        not.
        """
        return self.jumps and "rate" not in self.weights


def duration_range(value: Any, free: tuple[float, float]) -> tuple[float, float]:
    """(shortest, longest) of a leg [s]; free : where nothing is said."""
    if value is None:
        return free
    if isinstance(value, tuple):
        if len(value) != 2:
            raise InputError(f"duration = {value}: give (shortest, longest) in seconds")
        ends = zip(value, free, strict=True)
        low, high = (end if v is None else require_positive("duration", v, "s") for v, end in ends)
        if low > high:
            raise InputError(f"duration = ({low:g}, {high:g}) s: the bounds are crossed")
        return low, high
    fixed = require_positive("duration", value, "s")
    return fixed, fixed


def budget_range(term: str, value: Any, unit: str) -> tuple[float, float]:
    """(least, most) of a budget [unit]."""
    pair = value if isinstance(value, tuple | list) else (None, value)
    if len(pair) != 2 or (pair[0] is None and pair[1] is None):
        raise InputError(f"budgets[{term!r}] = {value!r}: give the most, or (least, most)")
    low, high = (
        default if v is None else require_finite(f"budgets[{term!r}]", v, unit)
        for v, default in zip(pair, (-math.inf, math.inf), strict=True)
    )
    if low > high:
        raise InputError(f"budgets[{term!r}] = ({low:g}, {high:g}): the bounds are crossed")
    return low, high


def aim_and_weight(name: str, wanted: Any) -> tuple[Any, float]:
    """What a variable is to follow, and how much that counts."""
    pair = wanted if isinstance(wanted, tuple) else (wanted, 1.0)
    if len(pair) != 2:
        raise InputError(f"track[{name!r}] = {wanted!r}: give the aim, or (aim, weight)")
    return pair[0], require_positive(f"track[{name!r}]: weight", pair[1])


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


def ranged_outputs(plant: Plant) -> list[Variable]:
    """The outputs whose values are limited."""
    return [v for v in plant.outputs if math.isfinite(v.min) or math.isfinite(v.max)]


def require_expression(plant: Plant, argument: str, expression: Any) -> None:
    """InputError unless this is a scalar expression of the plant's symbols and TIME."""
    if not isinstance(expression, ca.SX) or expression.shape != (1, 1):
        raise InputError(
            f"{argument} = {expression!r}: give a scalar CasADi SX expression of the plant"
        )
    symbols = ca.symvar(ca.vertcat(plant.x, plant.u, plant.p, TIME))
    known = {s.element_hash() for s in symbols}  # another plant has symbols of the same names
    foreign = {s.name() for s in ca.symvar(expression) if s.element_hash() not in known}
    if foreign:
        raise InputError(
            f"{argument} holds symbols that are not the plant's: {', '.join(sorted(foreign))}; "
            "build it from plant.expression(NAME)"
        )


# ---- running costs by name -----------------------------------------------------------------------
# What a plan may minimise, or keep within a budget, over its motion. A running cost is a function
# that gives an integrand; it registers in the file that defines it:
#
#     @running_cost("tension", unit="N2.s")
#     def tension(plant: Plant, symbols: Symbols) -> ca.SX:
#         '''Integral of the squared force of the first muscle.'''
#         return plant.expression("muscle1.force") ** 2
POWER = 10.0
"""A typical power of a muscle [W]."""


class Symbols(Protocol):
    """What states max(expression, 0) for whoever counts a cost: a planner smoothly, by further
    unknowns, a judge as it stands.
    """

    def positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """max(expression, 0)."""


Integrand: TypeAlias = "Callable[[Plant, Symbols], ca.SX]"


@dataclass(frozen=True)
class RunningCost:
    """A term of an objective, or of the budgets: the integral of ``integrand`` over the motion.

    integrand : (plant, symbols) -> expression in the plant's symbols [SI].
    total : the variable that the integral would be: its unit, and the nominal in which it counts
        beside other terms.
    from_supply : it counts air of the supply, so that pressures at the first stop are no gift.
    slower_is_less : a slower motion always takes less, so the term alone wants a fixed duration.
    economical : its optimum is flat and depends on the mesh: meshes grow until it settles.
    """

    integrand: Integrand
    total: Variable
    title: str
    from_supply: bool = False
    slower_is_less: bool = False
    economical: bool = False

    def expression(self, plant: Plant, symbols: Symbols) -> ca.SX:
        """The integrand for this plant; InputError where it is no scalar."""
        return scalar_expression(self.total.name, self.integrand(plant, symbols))


COSTS: Registry[RunningCost] = Registry("running cost", __package__)
"""What may be minimised by name, besides "rate" and the forms "integral(NAME)" and its like."""


def running_cost(
    name: str,
    *,
    unit: str,
    nominal: float = 1.0,
    from_supply: bool = False,
    slower_is_less: bool = False,
    economical: bool = False,
) -> Callable[[Integrand], Integrand]:
    """Decorator that registers a function (plant, symbols) -> integrand [SI] as a running cost.

    unit, nominal : of the integral. The others: see :class:`RunningCost`.
    """

    def entered(integrand: Integrand) -> Integrand:
        title = " ".join((integrand.__doc__ or "").partition("\n\n")[0].split()).rstrip(".")
        total = Variable(name, "output", unit=unit, nominal=nominal)
        cost = RunningCost(integrand, total, title, from_supply, slower_is_less, economical)
        COSTS.register(name, home=integrand)(cost)
        return integrand

    return entered


@running_cost("time", unit="s")
def _time(plant: Plant, symbols: Symbols) -> ca.SX:
    """Duration of the whole motion."""
    return ca.SX(1)


@running_cost("effort", unit="s", slower_is_less=True)
def _effort(plant: Plant, symbols: Symbols) -> ca.SX:
    """Integral of the squared inputs, scaled by nominals; disturbances are nobody's effort."""
    chosen = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    return ca.sumsqr((plant.u / plant.vector("input", attribute="nominal"))[chosen])


@running_cost("air", unit="kg", nominal=1e-3, from_supply=True, economical=True)
def _air(plant: Plant, symbols: Symbols) -> ca.SX:
    """Air drawn from the supply, of muscles fed by valves."""
    return _total(plant, "supply_flow", "air")


@running_cost("exergy", unit="J", nominal=10.0, from_supply=True, economical=True)
def _exergy(plant: Plant, symbols: Symbols) -> ca.SX:
    """Work that the air drawn from the supply could do."""
    return _total(plant, "exergy_flow", "exergy")


def _total(plant: Plant, kind: str, term: str) -> ca.SX:
    """Sum of the outputs ``<muscle>.<kind>``."""
    found = [v.name for v in plant.outputs if v.name.endswith(f".{kind}")]
    if not found:
        raise InputError(
            f"{term!r} needs the outputs '<muscle>.{kind}', which plant {plant.name!r} has not; "
            "feed its muscles by valves (feed=SpoolValve(...)), or give an expression as integrand"
        )
    return ca.sum1(ca.vertcat(*(plant.expression(name) for name in found)))


@running_cost("work", unit="J", economical=True)
def _work(plant: Plant, symbols: Symbols) -> ca.SX:
    """Mechanical work of the muscles, each counted where its power is positive."""
    muscles = muscles_of(plant)
    if not muscles:
        raise InputError(f"'work': plant {plant.name!r} has no muscle with force and contraction")
    total = ca.SX(0)
    for name in muscles:
        variable = Variable(f"{name}.power", "output", unit="W", nominal=POWER)
        total += symbols.positive(variable, mechanical_power(plant, name))
    return total


def muscles_of(plant: Plant) -> list[str]:
    """Names of what has a force and a contraction."""
    outputs = {v.name for v in plant.outputs}
    names = [v.name.removesuffix(".force") for v in plant.outputs if v.name.endswith(".force")]
    return [n for n in names if f"{n}.contraction" in outputs]


def mechanical_power(plant: Plant, muscle: str) -> ca.SX:
    """Mechanical power out of a muscle [W]: its output, or force times speed of shortening."""
    if any(v.name == f"{muscle}.power" for v in plant.outputs):
        return plant.expression(f"{muscle}.power")
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    rate = ca.jtimes(plant.expression(f"{muscle}.contraction"), plant.x, xdot)
    return ca.SX(
        plant.expression(f"{muscle}.force") * rate * plant.expression(f"{muscle}.rest_length")
    )
