"""Whether a plant rests: at stops along a motion, and before it begins.

At a stop every position stands still for a moment: its rate and its acceleration, found along the
run, are zero, or there are admissible inputs that make them so at once. Before the first stop the
plant has rested: there are admissible inputs under which nothing moves, and what no input could
have brought about is what its surroundings bring about by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import SimulationError
from ..operating.held import Memory, require_memory
from ..plants.plant import Plant
from ..plants.stillness import settled_names, store_names, totals
from ..simulation.simulator import simulate
from .asked import Limit, Point
from .driven import Driven
from .statement import TIME, Profile, subject

Array: TypeAlias = NDArray[np.float64]

LONG = 300.0
"""Seconds after which surroundings have settled."""
STAYS = 1e-4
"""Way in that time, in nominals, that counts as none."""
NEUTRAL = 1e-6
"""Rates [1/s] below which a state keeps whatever it is given."""
HELD = 1e-9
"""What is left of what should vanish, in nominals, where inputs hold a plant."""
STEPS = 20
"""Of Newton's method towards such inputs."""
STEP = 1e-4
"""Difference of an input, in nominals, from which slopes are taken."""
LEVELS, WIDE = 41, 100.0
"""Of each input, from end to end of its range, or as far as so many nominals."""
BISECTIONS = 40
"""Between two of these."""
SPEED = 10.0
"""Times its nominal in a second: the unit of a state's rate."""
CREEP = 0.03
"""Rate of a held memory [nominal/s] below which it stays: rounded laws creep."""
FOREVER = 1e5
"""Seconds in which a memory comes to where it would stay for good."""


Row: TypeAlias = "tuple[str, ca.SX, float, bool]"
"""What vanishes where positions rest: (label, expression, nominal, by inputs at once)."""


def rows_of(plant: Plant, points: Sequence[Point], names: Mapping[str, object]) -> list[Row]:
    """Rate and acceleration of each position, but for what a stop says itself (``names``)."""
    named = _spoken(plant, points)
    positions = plant.resting(named)
    rates = plant.function(plant.x, plant.u, plant.p)[0]
    order = [v.name for v in plant.states]
    found: list[Row] = []
    for position in positions:
        i = order.index(position.name)
        variable, rate = plant.states[i], rates[i]
        literal = [v for v in plant.states if ca.is_equal(rate, plant.expression(v.name))]
        speed = literal[0].nominal if literal else SPEED * variable.nominal
        words = literal[0].name if literal else f"der({variable.name})"
        velocities = position.velocities
        jumps = _by_inputs(plant, rate)
        said = f"der({position.name})" in names or (velocities and set(velocities) <= set(names))
        if not said:
            found.append((words, rate, speed, jumps))
        if jumps or position.driven or {f"der({v})" for v in velocities} <= set(names):
            continue
        second = ca.jtimes(rate, plant.x, rates)
        found.append((f"der({words})", second, SPEED * speed, _by_inputs(plant, second)))
    if not positions:  # a level of a tank, a sum of states: what stops name stands still
        for name in dict.fromkeys(n for p in points for n in p.stop.values if "(" not in n):
            variable, expression = subject(plant, name)
            rate = ca.jtimes(expression, plant.x, rates)
            row = (f"der({variable.name})", rate, SPEED * variable.nominal, _by_inputs(plant, rate))
            found.append(row)
    return found


def _spoken(plant: Plant, points: Sequence[Point]) -> list[str]:
    """The states that stops speak of."""
    limits = [limit.expression for p in points for limit in p.limits]
    if not limits:
        return []
    spoken = ca.which_depends(ca.vertcat(*limits), plant.x, 1, False)
    return [v.name for v, is_spoken in zip(plant.states, spoken, strict=False) if is_spoken]


def _by_inputs(plant: Plant, expression: ca.SX) -> bool:
    chosen = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    return bool(chosen) and bool(ca.depends_on(expression, plant.u[chosen]))


def rest_at(
    run: Driven, point: Point, rows: Sequence[Row], limits: Sequence[Limit]
) -> Iterator[tuple[str, float]]:
    """(what moves at a stop, by how much in nominals)."""
    plant, p = run.plant, run.plant.vector("parameter")
    label = f"{point.label}: {{}} at rest".format
    direct = [row for row in rows if not row[3]]
    if direct:
        every = ca.vertcat(*(e / nominal for _, e, nominal, _ in direct))
        function = ca.Function("moving", [plant.x, plant.u, plant.p], [every])
        for x, u in run.sides(point.time):
            values = np.abs(np.asarray(function(x, u, p), float).ravel())
            yield from ((label(row[0]), float(v)) for row, v in zip(direct, values, strict=True))
    jumping = [row for row in rows if row[3]]
    if jumping:
        x, u = run.sides(point.time)[-1]
        every = ca.vertcat(*(e / nominal for _, e, nominal, _ in jumping))
        best = _holding(plant, every, x, u, limits, point.time)[1]
        yield from ((label(row[0]), float(v)) for row, v in zip(jumping, best, strict=True))


def _holding(
    plant: Plant,
    wanted: ca.SX,
    x: Array,
    near: Array,
    limits: Sequence[Limit],
    time: float,
    also: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array]:
    """(admissible inputs that bring ``wanted`` next to zero, what is left of it, or of a limit).

    also : what is to vanish as well, by all inputs; its slopes are differences.
    """
    p = plant.vector("parameter")
    free = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    nominal = plant.vector("input", attribute="nominal")[free]
    own = [[c for c in limits if ca.is_equal(c.expression, plant.u[i])] for i in free]
    low = np.array([max(end_at(c.low, time) for c in each) for each in own])
    high = np.array([min(end_at(c.high, time) for c in each) for each in own])
    moving, simple = ca.vertcat(*(plant.u[i] for i in free)), {c for each in own for c in each}
    others = [c for c in limits if c not in simple and ca.depends_on(c.expression, moving)]
    column = ca.vertcat(wanted, *(c.expression / c.nominal for c in others))
    arguments = [plant.x, plant.u, plant.p, TIME]
    function = ca.Function("held", arguments, [column, ca.jacobian(column, moving)])
    floor = np.array([end_at(c.low, time) / c.nominal for c in others])
    roof = np.array([end_at(c.high, time) / c.nominal for c in others])
    rows = wanted.numel()

    def at(w: Array) -> tuple[Array, Array]:
        u = np.array(near, float)
        u[free] = w * nominal
        value, slope = (np.asarray(e, float) for e in function(x, u, p, time))
        value, slope = value.ravel(), slope * nominal
        beyond = np.maximum(floor - value[rows:], 0.0) - np.maximum(value[rows:] - roof, 0.0)
        value = np.concatenate([value[:rows], beyond])
        slope = np.vstack([slope[:rows], np.where(beyond[:, None] != 0, -slope[rows:], 0.0)])
        if also is None:
            return value, slope
        base, steps = also(u), STEP * np.eye(u.size)[free] * nominal[:, None]
        differences = np.array([also(u + step) - base for step in steps]).T / STEP
        return np.concatenate([value, base]), np.vstack([slope, differences])

    high = np.maximum(high, low + 1e-9 * nominal)
    box = (low / nominal, high / nominal)
    starts = plant.vector("input")[free]
    known = np.isfinite(low) & np.isfinite(high)
    middle = np.where(known, (np.where(known, low, 0.0) + np.where(known, high, 0.0)) / 2, starts)
    tried: list[tuple[float, int, Array]] = []
    guesses = [np.clip(guess / nominal, *box) for guess in (near[free], starts, middle)]
    methods = (_newton, _scanning, _least_squares)  # the first need no SciPy, and mostly do
    for method in methods if also is None else (_newton,):
        for guess in guesses if also is None else guesses[:1]:
            w = method(at, guess, box)
            tried.append((float(np.abs(at(w)[0]).max(initial=0.0)), len(tried), w))
            if tried[-1][0] < HELD:
                break
        else:
            continue
        break
    w = min(tried)[2]
    u, residual = np.array(near, float), np.abs(at(w)[0])
    u[free] = w * nominal
    return u, np.maximum(residual[:rows], residual[rows:].max(initial=0.0))


_Residual: TypeAlias = "Callable[[Array], tuple[Array, Array]]"


def _newton(at: _Residual, w: Array, box: tuple[Array, Array]) -> Array:
    """Gauss and Newton's steps inside a box."""
    for _ in range(STEPS):
        value, slope = at(w)
        if np.abs(value).max(initial=0.0) < HELD or not np.isfinite(slope).all():
            break
        before, w = w, np.clip(w - np.linalg.lstsq(slope, value, rcond=1e-12)[0], *box)
        if np.abs(w - before).max(initial=0.0) < HELD:
            break
    return w


def _scanning(at: _Residual, w: Array, box: tuple[Array, Array]) -> Array:
    """From the best of some levels of each input in turn, and of where something changes its sign
    between two of them: where rates saturate (a slew limit), slopes are zero nearly everywhere, and
    no step leads to where the inputs would hold the plant.
    """
    w = np.array(w, float)

    def values(i: int, level: float) -> Array:
        w[i] = level
        return at(w)[0]

    for i, (low, high) in enumerate(np.clip(box, -WIDE, WIDE).T):
        levels = [*np.linspace(low, high, LEVELS)]
        rows = np.array([values(i, level) for level in levels])
        change = np.where(rows[:-1] * rows[1:] < 0, np.abs(np.diff(rows, axis=0)), 0.0)
        if change.any():
            k, row = np.unravel_index(int(np.argmax(change)), change.shape)
            one, other, below = levels[k], levels[k + 1], rows[k, row] < 0
            for _ in range(BISECTIONS):
                middle = (one + other) / 2
                same = (values(i, middle)[row] < 0) == below
                one, other = (middle, other) if same else (one, middle)
            levels.append(one)
            rows = np.vstack([rows, values(i, one)])
        w[i] = levels[int(np.argmin(np.sum(rows**2, axis=1)))]
    return _newton(at, w, box)


def _least_squares(at: _Residual, w: Array, box: tuple[Array, Array]) -> Array:
    from scipy.optimize import least_squares  # takes 0.1 s to load

    tight = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-14)
    found = least_squares(lambda w: at(w)[0], w, lambda w: at(w)[1], bounds=box, **tight)
    return np.asarray(found.x, float)


def end_at(end: float | Profile, time: float) -> float:
    """An end of a limit at a time [s]."""
    return float(end(time)) if isinstance(end, Profile) else float(end)


# ---- before the first stop ----------------------------------------------------------------------
def begun(
    run: Driven, point: Point, memory: Memory, limits: Sequence[Limit]
) -> list[tuple[str, float, bool]]:
    """(what the plant had not come to before the motion, by how much in nominals, whether the stop
    says so), under those of the inputs that can have held it which leave least.
    """
    plant = run.plant
    x, u = run.sides(point.time)[-1]
    before = _Before.of(plant, point, require_memory(plant, memory), x)
    nominal = plant.vector("state", attribute="nominal")
    rates = plant.function(plant.x, plant.u, plant.p)[0] / (SPEED * nominal)
    groups = [ca.vertcat(*(rates[i] for i in rows)) for rows in (before.kept, before.free)]
    limits = [c for c in limits if c.nominal]
    still, held = _still(plant, x, u, groups, limits, point.time)
    off = before.memories_off(still)
    found = list(before.left(still, off))
    if not held.numel() or np.abs(off[before.slid]).max(initial=0.0) < STAYS:
        return found

    def slid_off(u: Array) -> Array:
        return before.memories_off(u)[before.slid]

    # a plant may be held by more inputs than one, and memories are left as they are by some alone
    still, _ = _holding(plant, held, x, still, limits, point.time, slid_off)
    either = found, list(before.left(still, before.memories_off(still)))
    return min(
        either, key=lambda each: max((off for _, off, said in each if not said), default=0.0)
    )


@dataclass(frozen=True)
class _Before:
    """A plant that is to have rested before it stands at a point.

    kept : states that rest has to hold; free : those of them that the point does not name;
    memories : what they hold is what positions left in them.
    """

    plant: Plant
    point: Point
    memory: str | Mapping[str, float]
    x: Array
    said: frozenset[str]
    memories: tuple[int, ...]
    kept: tuple[int, ...]
    free: tuple[int, ...]

    @classmethod
    def of(cls, plant: Plant, point: Point, memory: str | Mapping[str, float], x: Array) -> _Before:
        names = [v.name for v in plant.states]
        positions = plant.resting(_spoken(plant, [point]))
        said = {plant.variable(n).name for n in point.stop.values if "(" not in n}
        said -= {p.name for p in positions}
        said |= {p.name for p in positions if p.velocities and said.issuperset(p.velocities)}
        memories = [i for i, v in enumerate(plant.states) if v.memory == "held"]
        given = {*(names[i] for i in memories), *totals(plant)}
        stores = {*store_names(plant)}
        kept = [i for i, n in enumerate(names) if n not in {*given, *plant.copies} - stores]
        free = [i for i in kept if names[i] not in said]
        columns = (tuple(memories), tuple(kept), tuple(free))
        return cls(plant, point, memory, x, frozenset(said), *columns)

    @property
    def slid(self) -> list[int]:
        """Which of the memories are no stores: those rest with all else."""
        return [k for k, i in enumerate(self.memories) if i not in self.kept]

    def left(self, still: Array, off: Array) -> Iterator[tuple[str, float, bool]]:
        """What had not come to rest under these inputs; off : see :meth:`memories_off`."""
        plant, point, said, free = self.plant, self.point, self.said, self.free
        names = [v.name for v in plant.states]
        yield from self._given(off)
        moving = not point.rest or any(n.startswith("der(") for n in point.stop.values)
        lags = [i for i in free if names[i] in settled_names(plant)] * (not point.rest)
        # what a stop names is as it says, wherever it goes; the rest has settled beside it, and
        # where the plant moves, what no input moves
        others = [i for i in free if i not in lags], [i for i in self.kept if i not in free]
        for group in (lags, *others):
            for i, rate, far in zip(group, *_away(plant, self.x, still, group), strict=True):
                as_stated = names[i] in said or (moving and i not in lags)
                yield f"{point.label}: {names[i]} settled", max(rate, far), as_stated
        for name, by in _unreached(plant, self.x, still):
            if name not in plant.copies:
                yield f"{point.label}: {name} as its surroundings leave it", by, name in said

    def _given(self, off: Array) -> Iterator[tuple[str, float, bool]]:
        """Of totals, which begin at their start values, and of memories."""
        by = dict(zip(self.memories, off.tolist(), strict=True))
        for i, v in enumerate(self.plant.states):
            if v.name in totals(self.plant):
                by[i] = (float(self.x[i]) - float(v.start or 0.0)) / v.nominal
            if i in by and v.name not in self.plant.copies:
                yield f"{self.point.label}: {v.name} at the start", abs(by[i]), v.name in self.said

    def memories_off(self, still: Array) -> Array:
        """By how much each memory is above what rest under these inputs may have left."""
        found = []
        for i in self.memories:
            low = high = _remembered(self.plant, i, self.memory, self.x, still)
            if not isinstance(self.memory, Mapping):
                low, high = sorted(_left(self.plant, i, low, self.x, still))
            here = float(self.x[i])
            found.append((here - np.clip(here, low, high)) / self.plant.states[i].nominal)
        return np.array(found, float)


def _remembered(
    plant: Plant, i: int, memory: str | Mapping[str, float], x: Array, u: Array
) -> float:
    """What a held memory is said to hold: its start value, what is given, or the end of its range
    to which it is driven while all positions come from "above" or "below".
    """
    variable = plant.states[i]
    start = float(variable.start or 0.0)
    if isinstance(memory, Mapping):
        return memory.get(variable.name, start)
    if memory == "virgin":
        return start
    standing = np.array(x, float)
    standing[i] = (variable.min + variable.max) / 2
    rate = _rate(plant, i, u)
    drive = rate(_rising(plant, standing, u)) - rate(standing)
    if memory == "above":
        drive = -drive
    return variable.max if drive > 0 else variable.min if drive < 0 else start


def _rising(plant: Plant, x: Array, u: Array) -> Array:
    """The state with velocities at which every position rises by its nominal in a second."""
    names = [v.name for v in plant.states]
    moved = np.array(x, float)
    for position in plant.resting():
        rate = plant.expression(f"der({position.name})")
        velocities = [names.index(n) for n in position.velocities]
        function = ca.Function("slopes", [plant.x, plant.u, plant.p], [ca.jacobian(rate, plant.x)])
        slopes = np.asarray(function(x, u, plant.vector("parameter")), float)[0, velocities]
        if np.any(slopes):
            moved[velocities] += slopes * plant.variable(position.name).nominal / (slopes @ slopes)
    return moved


def _rate(plant: Plant, i: int, u: Array) -> Callable[[Array], float]:
    """Of a state, by all states."""
    p = plant.vector("parameter")
    return lambda x: float(plant.function(x, u, p)[0][i])


def _left(plant: Plant, i: int, value: float, x: Array, u: Array) -> tuple[float, float]:
    """The ends of what a memory that held a value may hold after rest, all else standing as it
    does: from where it has slowed to a creep to where it stays for good.
    """
    from scipy.integrate import solve_ivp  # takes 0.1 s to load

    rate_at, here, nominal = _rate(plant, i, u), np.array(x, float), plant.states[i].nominal

    def rate(t: float, z: Array) -> list[float]:
        here[i] = z[0] * nominal
        return [rate_at(here) / nominal]

    def slowed(t: float, z: Array) -> float:
        return abs(rate(t, z)[0]) - CREEP

    begin = np.array([value / nominal])
    tight = {"rtol": 1e-9, "atol": 1e-12}
    run = solve_ivp(rate, (0.0, FOREVER), begin, "LSODA", events=slowed, **tight)
    last, slow = float(run.y[0, -1]), [float(z[0]) for z in run.y_events[0]]
    first = begin[0] if slowed(0.0, begin) <= 0 else slow[0] if slow else last
    return float(first) * nominal, last * nominal


def _still(
    plant: Plant,
    x: Array,
    u: Array,
    groups: Sequence[ca.SX],
    limits: Sequence[Limit],
    time: float,
) -> tuple[Array, ca.SX]:
    """(inputs under which the first of some groups that can be held stands still, or the last, as
    far as there are any, that group).
    """
    still, held = np.asarray(u, float), ca.SX(0, 1)
    for wanted in groups if any(not v.disturbance for v in plant.inputs) else ():
        if not wanted.numel():
            continue
        held = wanted
        still, left = _holding(plant, wanted, x, u, limits, time)
        if left.max(initial=0.0) < HELD:
            break
    return still, held


def _away(plant: Plant, x: Array, u: Array, kept: Sequence[int]) -> tuple[Array, Array]:
    """(rates, distances from the nearest state where all of them vanish), in nominals.

    The distance is Newton's step of least norm. Directions in which nothing pulls count as none,
    and so do those in which nothing moves in LONG: what leaks through a valve that is shut but for
    a rounding would be far from where it leads.
    """
    nominal = plant.vector("state", attribute="nominal")[list(kept)]
    p = plant.vector("parameter")
    rates = np.asarray(plant.function(x, u, p)[0], float).ravel()[list(kept)] / nominal
    slopes = np.asarray(plant.jacobians(x, u, p)[0], float)[np.ix_(kept, kept)]
    slopes = slopes * nominal / nominal[:, None]
    left, sizes, right = np.linalg.svd(slopes)
    along = left.T @ rates
    pulled = (sizes > NEUTRAL) & (np.abs(along) * LONG > STAYS)
    step = right[pulled].T @ (along[pulled] / sizes[pulled])
    return np.abs(rates) / SPEED, np.abs(step)


def _unreached(plant: Plant, x: Array, u: Array) -> Iterator[tuple[str, float]]:
    """(state, by how much it is off in nominals) of those that keep what they are given, and that
    the plant brings elsewhere from its start values.
    """
    names = [v.name for v in plant.states]
    marked = [names.index(n) for n in settled_names(plant)]
    if not marked:
        return
    p = plant.vector("parameter")
    nominal = plant.vector("state", attribute="nominal")
    moves = np.asarray(plant.jacobians(x, u, p)[0], float) * nominal / nominal[:, None]
    idle = [i for i in marked if np.max(np.abs(moves[:, i])) <= NEUTRAL]
    if not idle:
        return
    inputs = {v.name: float(value) for v, value in zip(plant.inputs, u, strict=True)}
    come = plant.vector("state")
    for span in (LONG, 10 * LONG, 100 * LONG):  # heat from a thick wall takes its time
        try:
            begin = dict(zip(names, map(float, come), strict=True))
            run = simulate(plant, inputs, start=begin, t=[0.0, span], rtol=1e-8)
        except SimulationError:
            return
        come = np.array([run[n][-1] for n in names])
        rates = np.asarray(plant.function(come, u, p)[0], float).ravel() / nominal
        if np.abs(rates[marked]).max() <= NEUTRAL:
            break
    for i in idle:
        yield names[i], abs(float(come[i] - x[i])) / float(nominal[i])
