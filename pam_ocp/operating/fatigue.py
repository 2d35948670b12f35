"""Fatigue: rainflow cycles of a motion, Miner's sum with the user's own S-N curve, derating.

There is no S-N curve here: endurance of a muscle is its maker's or its tester's to state.

The damage rate of :func:`with_damage` bounds rainflow damage. A closed path is made up of its
rainflow cycles, up and down once each, what is left of an open one of single ways (half cycles). On
the way from a to b the rate m/(2 S) (2 |q - c|/S)^(m-1) |dq/dt| integrates to a quarter of
(2 (b - c)/S)^m + (2 (c - a)/S)^m with c inside, and to a quarter of the difference of the two with
c outside; as m >= 1, neither is less than half of ((b - a)/S)^m (a convex, a
superadditive function). It is level-crossing counting (ASTM E1049-85, 5.1) about c, written as an
integral.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import units
from ..core.errors import (
    InputError,
    require_finite,
    require_flag,
    require_instance,
    require_numbers,
    require_positive,
)
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant, require_plant

Array: TypeAlias = NDArray[np.float64]

ROUNDING = 1e-2
"""Widths, in nominal values (and those per second), over which |.| of a damage rate is rounded."""
HALVINGS = 200
"""Of a bracket: more than a float has digits."""
MOST_ROWS = 10
"""Of cycles that are printed."""


@verb
def cycles(
    trajectory: Trajectory | ArrayLike, name: str | None = None, *, periodic: bool = False
) -> Array:
    """Rainflow cycles of one variable, after ASTM E1049-85, section 5.4.4.

    trajectory : a Trajectory of which ``name`` is the column, or the samples themselves, (n,).
    periodic : the motion repeats: it is counted from its largest value round to it (5.4.5, "simple
        rainflow counting for repeating histories"), so that all cycles are whole; the way from the
        last sample to the first counts, too.

    Returns (k, 3): range, mean [unit of the variable] and count, 1 or 0.5; no rows where nothing
    changes. Turning points are samples: sample densely enough to have the peaks.

    Raises InputError for samples that are not a row of finite numbers, UnknownNameError.

    Examples
    --------
    >>> asterisk = [-2, 1, -3, 5, -1, 3, -4, 4, -2]  # the example of the standard
    >>> for row in pam.operating.cycles(asterisk)[:3]:
    ...     print(*map(float, row))
    3.0 -0.5 0.5
    4.0 -1.0 0.5
    4.0 1.0 1.0
    """
    require_flag("periodic", periodic)
    return _rainflow(_samples(trajectory, name)[0], periodic)


def _samples(trajectory: Any, name: str | None) -> tuple[Array, str]:
    """Samples, and their unit ("" of an array)."""
    if isinstance(trajectory, Trajectory):
        if name is None:
            raise InputError(f"name is None: name a column, such as {trajectory.names[0]!r}")
        variable = trajectory.variable(name)
        row, unit = trajectory[variable.name], variable.unit
    else:
        row, unit = trajectory, ""
    samples = np.asarray(require_numbers(name or "trajectory", row))
    if samples.ndim != 1 or not samples.size:
        raise InputError(
            f"{name or 'trajectory'} has shape {samples.shape}; give a Trajectory and the name of "
            "a column, or a row of samples"
        )
    return samples, unit


def _rainflow(samples: Array, periodic: bool) -> Array:
    """Rows of range, mean, count."""
    if periodic:
        top = int(np.argmax(samples))
        samples = np.concatenate([samples[top:], samples[: top + 1]])
    steps = np.diff(samples)
    row = np.concatenate([samples[:1], samples[1:][steps != 0]])
    turns = np.sign(np.diff(row))
    inner = np.flatnonzero(turns[1:] != turns[:-1]) + 1
    found: list[tuple[float, float, float]] = []

    def count(one: float, other: float, times: float) -> None:
        found.append((abs(other - one), (one + other) / 2, times))

    stack: list[float] = []
    for point in row[[0, *inner, len(row) - 1] if len(row) > 1 else []]:
        stack.append(float(point))
        while len(stack) > 2 and abs(stack[-1] - stack[-2]) >= abs(stack[-2] - stack[-3]):
            if len(stack) == 3 and not periodic:  # it holds the start: half a cycle
                count(stack[0], stack[1], 0.5)
                del stack[0]
            else:
                count(stack[-3], stack[-2], 1.0)
                del stack[-3:-1]
    for one, other in pairwise(stack):
        count(one, other, 0.5)
    return np.array(found, dtype=float).reshape(-1, 3)


@dataclass(frozen=True)
class SNCurve:
    """Cycles to failure over the range of a variable: an S-N (Wöhler) curve of the user's own.

    Give ``points``, or Basquin's law N = (range/strength)^-slope:

    points : {range: cycles to failure}, at least two, falling; joined by straight lines in log-log,
        the first and the last of which go on.
    strength : range at which N = 1 (the law put back to there). slope : > 0; often 3 to 15.
    endurance : ranges up to this do no damage (default: 0, none such).
    ultimate : Goodman's correction with this value: a range counts as range/(1 - mean/ultimate);
        means below 0 are given no credit. Default: means do not count.
    unit : the SI unit of ranges, strength, endurance and ultimate; numbers are in it, texts such as
        "2 bar" have their own.

    Ranges are peak to peak, twice the amplitude on which some curves are stated.

    Raises InputError where neither or both are given, and for values that are not > 0.

    Examples
    --------
    >>> curve = pam.operating.SNCurve({"2 bar": 1e8, "6 bar": 1e6}, endurance="0.5 bar")
    >>> float(curve.cycles_to_failure(6e5).round())
    1000000.0
    >>> basquin = pam.operating.SNCurve(strength="100 bar", slope=5)
    >>> float(basquin.cycles_to_failure(1e5).round())
    10000000000.0
    """

    points: Mapping[Any, float] | Sequence[tuple[Any, float]] = ()
    _: KW_ONLY
    strength: float | str | None = None
    slope: float | None = None
    endurance: float | str = 0.0
    ultimate: float | str | None = None
    unit: str = "Pa"

    def __post_init__(self) -> None:
        require_instance("unit", self.unit, str, "give a unit in quotes, such as 'Pa'")
        if units.unit(self.unit).factor != 1:
            raise InputError(f"unit = {self.unit!r}: give the SI unit, and texts as '2 bar'")
        points, law = _points(self.points, self.unit), (self.strength, self.slope)
        if (law == (None, None)) == (not points) or (None in law) != (law == (None, None)):
            raise InputError("SNCurve: give points, or strength and slope, and not both")
        changed: dict[str, Any] = {
            "points": points,
            "endurance": require_positive("endurance", self.endurance, self.unit, zero=True),
        }
        if not points:
            changed["strength"] = require_positive("strength", self.strength, self.unit)
            changed["slope"] = require_positive("slope", self.slope)
        if self.ultimate is not None:
            changed["ultimate"] = require_positive("ultimate", self.ultimate, self.unit)
        for field, value in changed.items():
            object.__setattr__(self, field, value)

    def cycles_to_failure(self, ranges: ArrayLike, means: ArrayLike = 0.0) -> Array:
        """N of each range and mean (arrays that broadcast) [``unit``]; inf where no damage is done.

        Raises InputError for ranges < 0, and for means that reach ``ultimate``.
        """
        size = np.asarray(require_numbers("ranges", ranges, self.unit, 0.0), dtype=float)
        mean = np.asarray(require_numbers("means", means, self.unit), dtype=float)
        if self.ultimate is not None:
            ultimate = float(self.ultimate)
            if np.any(mean >= ultimate):
                raise InputError(
                    f"means reach {mean.max():g} {self.unit}; Goodman's correction needs them "
                    f"below ultimate = {ultimate:g}"
                )
            size = size / (1 - np.maximum(mean, 0.0) / ultimate)
        size, _ = np.broadcast_arrays(size, mean)
        with np.errstate(divide="ignore", over="ignore"):
            found = np.exp(self._log_cycles(np.log(size)))
        return np.where(size <= float(self.endurance), np.inf, found)

    def _log_cycles(self, x: Array) -> Array:
        if self.strength is not None and self.slope is not None:
            return np.asarray(-self.slope * (x - math.log(float(self.strength))))
        a, b = (np.log(np.array(column, dtype=float)) for column in zip(*self.points, strict=True))
        piece = np.clip(np.searchsorted(a, x) - 1, 0, len(a) - 2)  # beyond the ends: the nearest
        return np.asarray(b[piece] + (np.diff(b) / np.diff(a))[piece] * (x - a[piece]))


def _points(given: Any, unit: str) -> tuple[tuple[float, float], ...]:
    """(range, N), sorted. Raises InputError."""
    try:
        pairs = [(r, n) for r, n in (given.items() if isinstance(given, Mapping) else given)]
    except (TypeError, ValueError):
        raise InputError(f"points = {given!r}: give {{range: cycles to failure}}") from None
    found = sorted(
        (require_positive("range of points", r, unit), require_positive(f"points[{r!r}]", n))
        for r, n in pairs
    )
    rises = np.diff(np.array(found).reshape(-1, 2), axis=0)
    if len(found) == 1 or np.any(rises[:, 0] <= 0) or np.any(rises[:, 1] >= 0):
        raise InputError(
            f"points = {given!r}: give two or more ranges, each once, whose cycles to failure fall "
            "as the range grows"
        )
    return tuple(found)


@shown
@dataclass(frozen=True, eq=False)
class FatigueDamage:
    """What :func:`damage` found; ``print`` shows its cycles, damage and life.

    Examples
    --------
    >>> curve = pam.operating.SNCurve(strength="100 bar", slope=5)
    >>> worn = pam.operating.damage([0.0, 1e5, 0.0], None, curve)
    >>> print(worn)
    1e-10 of the life in one run: 1e+10 runs to failure
           range        mean  count  of the damage
          100000       50000      1          100 %
    """

    name: str
    curve: SNCurve
    cycles: Array
    """(k, 3): range, mean [unit of the curve] and count; see :func:`cycles`."""
    per_run: float
    """Miner's sum of one run of the motion; failure is where it has summed up to 1."""
    duration: float | None
    """Of one run [s]; None of an array."""

    @property
    def life(self) -> float:
        """Runs to failure; inf where no cycle does damage."""
        return 1 / self.per_run if self.per_run else math.inf

    @property
    def seconds(self) -> float | None:
        """Time to failure [s]; None of an array."""
        return None if self.duration is None else self.life * self.duration

    def derating(self, runs: float) -> float:
        """The factor on all ranges, about means that stay, with which Miner's sum of ``runs`` is 1.

        Below 1: so far must ranges shrink; above: so far may they grow. inf where nothing changes.
        With Basquin's law alone it is (life/runs)^(1/slope); else by bisection, as the largest
        factor with a sum of at most 1 (an endurance limit makes the sum jump).

        Raises InputError where ``runs`` is not > 0.
        """
        wanted = require_positive("runs", runs)
        if not len(self.cycles):
            return math.inf
        if self.curve.slope is not None and not self.curve.endurance:
            return float((self.life / wanted) ** (1 / self.curve.slope))
        return _largest(lambda f: _miner(self.curve, self.cycles * [f, 1, 1]) * wanted <= 1)

    def __str__(self) -> str:
        of = f"{self.name}: " if self.name else ""
        after = "" if self.seconds is None else f", after {self.seconds:.4g} s"
        head = f"{of}{self.per_run:.4g} of the life in one run: {self.life:.4g} runs to failure"
        lines = [head + after, f"{'range':>12}{'mean':>12}{'count':>7}  of the damage"]
        done = _each(self.curve, self.cycles)
        order = np.lexsort((-self.cycles[:, 0], -done))
        for (size, mean, count), part in zip(
            self.cycles[order][:MOST_ROWS], done[order] / (self.per_run or 1.0), strict=False
        ):
            lines.append(f"{size:>12.6g}{mean:>12.6g}{count:>7g}{part * 100:>13.3g} %")
        more = len(order) - MOST_ROWS
        return "\n".join([*lines, f"and {more} more"] if more > 0 else lines)


def _each(curve: SNCurve, rows: Array) -> Array:
    """Palmgren and Miner's n/N of each row."""
    return np.asarray(rows[:, 2] / curve.cycles_to_failure(rows[:, 0], rows[:, 1]))


def _miner(curve: SNCurve, rows: Array) -> float:
    return float(_each(curve, rows).sum())


def _largest(allowed: Callable[[float], bool]) -> float:
    """The largest factor that is allowed, of a condition that once left is not met again."""
    low = high = 1.0
    while not allowed(low):
        high, low = low, low / 2
    while allowed(high):
        low, high = high, high * 2
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return low


@verb
def damage(
    trajectory: Trajectory | ArrayLike,
    name: str | None,
    curve: SNCurve,
    periodic: bool = True,
) -> FatigueDamage:
    """Damage of one run of a motion by the rule of Palmgren and Miner: the sum of n/N(range).

    trajectory, name, periodic : as for :func:`cycles`; the trajectory of a plan is
        ``plan.trajectory``. Here a motion repeats by default.
    curve : whose unit is that of the variable.

    The rule takes no note of the order of cycles, and single tests scatter by factors: what it
    gives compares motions, and orders of magnitude of life. Raises InputError, UnknownNameError.

    Examples
    --------
    >>> curve = pam.operating.SNCurve(strength="100 bar", slope=5)
    >>> worn = pam.operating.damage(motion, "muscle.pressure", curve)
    >>> worn.life > 1, round(worn.derating(worn.life), 9)
    (True, 1.0)
    """
    require_flag("periodic", periodic)
    require_instance("curve", curve, SNCurve, "give an SNCurve")
    samples, unit = _samples(trajectory, name)
    if unit:
        _require_unit(str(name), unit, curve)
    rows = _rainflow(samples, periodic)
    duration = trajectory.duration if isinstance(trajectory, Trajectory) else None
    return FatigueDamage(name or "", curve, rows, _miner(curve, rows), duration)


@verb
def with_damage(
    plant: Plant, name: str, curve: SNCurve, centre: float | str, output: str = "damage_rate"
) -> Plant:
    """A plant with a damage rate [1/s] as one more output, for ``minimise`` and ``budgets``.

    ``minimise={"integral(damage_rate)": 1.0}`` or ``budgets={"integral(damage_rate)": 1e-7}``. Its
    integral is a smooth surrogate of Miner's sum with Basquin's law, and an upper bound of it:

        rate = m/(2 S) (2 |q - c|/S)^(m-1) |dq/dt|,   S strength, m slope, c centre

    Cycles centred at c count their own damage, all others more (the module's docstring derives it):
    so it bounds ``damage(..., periodic=False)``, and of closed motions ``periodic=True``. |.| is
    rounded upwards over 1 % of the nominal value.

    name : a variable that follows from states alone. centre : [its unit] about which cycles are
    expected; the nearer it is, the tighter the bound. curve : Basquin's law, slope >= 1, without
    ``ultimate``; its endurance limit is passed over (more damage, never less). output : its name.

    Raises InputError, UnknownNameError.

    Examples
    --------
    >>> curve = pam.operating.SNCurve(strength="100 bar", slope=5)
    >>> lasting = pam.operating.with_damage(plant, "muscle.pressure", curve, centre="3 bar")
    >>> lasting.variable("damage_rate").unit
    '1/s'
    """
    variable = require_plant(plant).variable(name)
    _require_rate(variable, curve)
    q = plant.expression(variable.name)
    if variable.causality == "input" or ca.depends_on(q, plant.u):
        raise InputError(
            f"{variable.name} depends on inputs, which may jump; name a variable that follows "
            f"from states, such as {plant.states[0].name!r}"
        )
    rate = ca.jtimes(q, plant.x, plant.function(plant.x, plant.u, plant.p)[0])
    strength, width = float(curve.strength or 0.0), ROUNDING * variable.nominal
    apart = ca.sqrt((q - require_finite("centre", centre, variable.unit)) ** 2 + width**2)
    speed = ca.sqrt(rate**2 + width**2)
    m = float(curve.slope or 0.0)
    return plant.with_output(
        output,
        m / (2 * strength) * (2 * apart / strength) ** (m - 1) * speed,
        unit="1/s",
        nominal=(variable.nominal / strength) ** m,
        description=f"damage rate of {variable.name}, an upper bound",
    )


def _require_rate(variable: Variable, curve: Any) -> None:
    """Raises InputError for a curve that has no bound, or is of another unit."""
    require_instance("curve", curve, SNCurve, "give an SNCurve")
    if curve.slope is None or curve.slope < 1 or curve.ultimate is not None:
        raise InputError(
            "curve: a damage rate needs Basquin's law, SNCurve(strength=..., slope=...), with "
            "slope >= 1 and without ultimate"
        )
    _require_unit(variable.name, variable.unit, curve)


def _require_unit(name: str, unit: str, curve: SNCurve) -> None:
    if not units.unit(unit).compatible(units.unit(curve.unit)):
        raise InputError(
            f"{name} is in {unit!r}, the curve in {curve.unit!r}; give a curve of the variable "
            f"(SNCurve(..., unit={unit!r}))"
        )
