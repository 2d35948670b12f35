"""What must vanish where a plant stands still, read off the structure of its equations.

Coordinates are a matter of taste: velocities may be states in other units, momenta, combinations
(x' = v + w) or functions (x' = T(q) w, x' = sinh(v)). What tells a position from a lag, a pressure
or a velocity is this: where its rate vanishes, the rate stays zero whatever the position is.

No single point answers that: where muscles are slack there, or a dead band is not left, an
equation says nothing. What a rate depends on is the sparsity of its expression; that a dependence
goes at rest, or that one equation follows from others, is believed only where it is seen at points
all over the region of operation, and where the same points do show what is said to have gone.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable
from dataclasses import dataclass
from functools import cached_property
from random import Random  # NumPy's take 8 ms to load
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import units
from ..core.system import System

Array: TypeAlias = NDArray[np.float64]
Pattern: TypeAlias = NDArray[np.bool_]

POINTS = 16
"""Spread over the region of operation."""
REACHES = (0.3, 1.0, 3.0, np.inf)
"""How far from the start values the points lie, in turn: in nominals, inside the bounds."""
WIDEST, OPEN = 100.0, 3.0
"""How many nominals the region goes from the start values: to bounds, and where there are none."""
LEVELS = np.linspace(0.0, 1.0, 5)
"""Of the region's width: the values that one variable is given while the others stay."""
STEPS = 30
"""Of Newton's method towards points where equations hold."""
FLAT = 1e-3
"""A slope at rest that counts as none, as a part of the steepest."""
NONE, ROUNDING = 1e-7, 1e-12
"""What counts as zero: this part of the slopes there, and this part of a typical value."""


@dataclass(frozen=True)
class Position:
    """A state that can stand anywhere. velocities : the states that its rate depends on at rest.

    driven : its rate depends on an input, so it has no acceleration to speak of (x' = u).
    """

    name: str
    velocities: tuple[str, ...]
    driven: bool = False


class _Region:
    """Some expressions of a plant's states and inputs over its region of operation.

    Disturbances stay at their start values. Points are columns (states and inputs, points).
    """

    def __init__(self, plant: System, expressions: ca.SX) -> None:
        z, variables = ca.vertcat(plant.x, plant.u), (*plant.states, *plant.inputs)
        slopes = ca.jacobian(expressions, z)
        self.pattern: Pattern = np.array(ca.DM(slopes.sparsity(), 1), dtype=bool)
        self.steady: Pattern = np.zeros_like(self.pattern)  # whose slopes are constants, not 0
        for i, j in zip(*slopes.sparsity().get_triplet(), strict=True):
            slope = ca.SX(slopes[i, j])
            self.steady[i, j] = slope.is_constant() and float(slope) != 0.0
        self._values = ca.Function("values", [z, plant.p], [expressions])
        self._slopes = ca.Function("slopes", [z, plant.p], [expressions, ca.densify(slopes)])
        self._p = plant.vector("parameter")
        self.free = np.array([not v.disturbance for v in variables])
        self.nominal = np.array([v.nominal for v in variables], float)
        self.start = np.array([v.start or 0.0 for v in variables], float)
        bounds = np.array([(v.min, v.max) for v in variables]).reshape(-1, 2).T
        reach = np.where(np.isfinite(bounds), WIDEST, OPEN) * self.nominal * self.free
        self.low = np.maximum(bounds[0], self.start - reach[0])
        self.high = np.minimum(bounds[1], self.start + reach[1])

    def at(self, z: Array) -> tuple[Array, Array]:
        """(values (m, points), slopes (points, m, n) by nominals)."""
        found, slopes = (np.asarray(e, float) for e in self._slopes(z, self._p))
        by_point = slopes.reshape(len(self.pattern), z.shape[1], len(z)).swapaxes(0, 1)
        return found, by_point * (self.nominal * self.free)

    @cached_property
    def points(self) -> Array:
        """Each variable has a value in each of as many equal parts of its range: a Latin hypercube
        (McKay et al., Technometrics 21 (1979) 239-245). Points without finite values are left out.
        """
        draw = Random(0)
        parts = [draw.sample(range(POINTS), POINTS) for _ in self.start]
        reach = np.resize(REACHES, POINTS) * self.nominal[:, None]
        low = np.maximum(self.low[:, None], self.start[:, None] - reach)
        high = np.minimum(self.high[:, None], self.start[:, None] + reach)
        z = low + (np.array(parts) + 0.5) / POINTS * (high - low)
        values, slopes = self.at(z)
        sound = np.isfinite(values).all(axis=0) & np.isfinite(slopes).all(axis=(1, 2))
        return np.asarray(z[:, sound], float)

    @cached_property
    def size(self) -> Array:
        """A typical value of each expression: the middle one of what is not zero; 1 without one."""
        # sorted: NumPy's median loads masked arrays, a tenth of a first plan
        rows = [np.sort(row[row > 0]) for row in np.abs(self.at(self.points)[0])]
        return np.array([float(row[len(row) // 2]) if len(row) else 1.0 for row in rows])

    def roots(self, rows: list[int]) -> tuple[Array, int]:
        """(points at which these expressions vanish, the one of ``rows`` to give up where there are
        none), by Gauss and Newton's steps inside the region.
        """
        z, size = self.points, self.size[rows]
        missed, before = np.zeros((len(rows), 0)), np.full(z.shape[1], np.inf)
        for step in range(STEPS):
            values, slopes = self.at(z)
            sound = np.isfinite(values).all(axis=0) & np.isfinite(slopes).all(axis=(1, 2))
            z, values, slopes, before = z[:, sound], values[:, sound], slopes[sound], before[sound]
            missed = values[rows] / size[:, None]
            worst = np.abs(missed).max(axis=0, initial=0.0)
            if np.all((worst <= 0.1 * ROUNDING) | (worst > before / 2)):
                break  # each point has arrived or stands still
            if step % 4 == 0:
                before = worst
            z = self._step(z, slopes[:, rows] / size[:, None], missed)
        missed = np.abs(self.at(z)[0][rows]) / size[:, None]
        found = z[:, np.all(missed <= ROUNDING, axis=0)]
        if found.size or not missed.size:
            return found, rows[0]
        nearest = missed[:, np.argmin(missed.max(axis=0))]
        # what depends on itself is hardly a position: it goes first
        own = np.array([i < len(self.start) and self.pattern[i, i] for i in rows])
        pool = own & (nearest > ROUNDING) if np.any(own & (nearest > ROUNDING)) else nearest > 0
        return found, rows[int(np.argmax(np.where(pool, nearest, -1.0)))]

    def _step(self, z: Array, slopes: Array, missed: Array) -> Array:
        """The points after Newton's step of least length; what it presses onto a bound stays there
        and the others do its part.
        """
        at = z.T
        low, high, free = at <= self.low, at >= self.high, np.tile(self.free, (len(at), 1))
        for _ in range(2):
            inverse = np.linalg.pinv(slopes * free[:, None, :], rcond=1e-10)
            to = at - (inverse @ missed.T[:, :, None])[:, :, 0] * self.nominal
            pressed = free & (low & (to < self.low) | high & (to > self.high))
            if not pressed.any():
                break
            free &= ~pressed
        return np.asarray(np.where(self.free, np.clip(to, self.low, self.high), at).T)

    def moved(self, z: Array) -> Pattern:
        """(m, n): which expressions change at any of these points when one variable alone takes
        other values of its range.
        """
        base, slopes = self.at(z)
        level = NONE * np.abs(slopes).sum(axis=2).T + ROUNDING * self.size[:, None]
        columns = np.flatnonzero(self.pattern.any(axis=0) & self.free)
        found = np.zeros(self.pattern.shape, bool)
        if not columns.size or not z.size:
            return found
        varied = np.tile(z[:, None, None, :], (1, len(columns), len(LEVELS), 1))
        for k, j in enumerate(columns):
            varied[j, k] = (self.low[j] + LEVELS * (self.high[j] - self.low[j]))[:, None]
        values = np.asarray(self._values(varied.reshape(len(z), -1), self._p), float)
        change = np.abs(values.reshape(-1, *varied.shape[1:]) - base[:, None, None])
        beyond = np.isfinite(change) & (change > level[:, None, None])
        found[:, columns] = beyond.any(axis=(2, 3))
        return found & self.pattern

    @cached_property
    def seen(self) -> Pattern:
        """(m, n): which dependences show anywhere in the region."""
        return self.moved(self.points)

    def follows(self, row: int, rows: list[int]) -> bool:
        """Whether an expression is seen to vanish wherever ``rows`` do."""
        others = ~self.pattern[rows].any(axis=0)  # with these the rows stay zero
        if (self.steady[row] & self.free & others).any():
            return False
        z, _ = self.roots(rows)
        if not z.size or (self.pattern & ~self.seen & self.free)[row].any():
            return False
        value, slopes = self.at(z)
        level = NONE * np.abs(slopes[:, row]).sum(axis=1) + ROUNDING * self.size[row]
        return bool(np.all(np.abs(value[row]) <= level) and not self.moved(z)[row, others].any())


def _numbers(plant: System) -> Hashable:
    """What answers depend on besides expressions, as a key: where the region lies, and which terms
    there are. Of a parameter that is its sign and its power of ten: 2.0 or 2.2 kg rest alike, and a
    re-solve or a draw of a study need not ask again (a quarter of a re-solve's time).
    """
    p = plant.vector("parameter")
    powers = np.floor(np.log10(np.abs(p), out=np.zeros_like(p), where=p != 0))
    numbers = (np.sign(p), powers, plant.vector("input"), plant.vector("state"))
    return tuple(np.concatenate(numbers))


def _measures(plant: System, name: str) -> int:
    """0 for a length or an angle, 1 for a pure number, 2 for anything else."""
    exponents = units.unit(plant.variable(name).unit).base_exponents
    return 0 if exponents in ({"m": 1}, {"rad": 1}) else 2 if exponents else 1


def resting(plant: System, named: Collection[str] = ()) -> tuple[Position, ...]:
    """The positions of a plant, whose rates and accelerations vanish where it rests.

    Pressures, lags and states with memory are none. Where the equations leave open which of two
    states is the position (x' = v, v' = -x), or where one integrates the other, ``named`` ones come
    first: those that a motion's stops speak of. Units decide next: lengths and angles are
    positions; states in other units are only where there is nothing else.
    """
    key = ("resting", tuple(sorted(named)), _numbers(plant))
    found: tuple[Position, ...] = plant.cached(key, lambda: _resting(plant, named))
    return found


def _resting(plant: System, named: Collection[str]) -> tuple[Position, ...]:
    names = [v.name for v in plant.states]
    neutral, used = plant.cached(("neutral", _numbers(plant)), lambda: _neutral(plant))
    nx = len(names)
    driven = set(neutral) & _dependent(plant)[1]
    undriven = [i for i in neutral if i not in driven]
    uses = {i: [j for j in range(nx) if j != i and used[i, j]] for i in neutral}
    for worst in (1, 2):  # lengths, angles and numbers; then anything
        pool = [i for i in undriven if uses[i] and _measures(plant, names[i]) <= worst]
        pool.sort(
            key=lambda i: (names[i] not in named, _measures(plant, names[i]), len(uses[i]), i)
        )
        chosen = _heads(pool, uses)
        wide = 1 if not chosen and worst == 1 else 0 if worst == 1 else 2
        moved = {j for i in chosen for j in uses[i]}
        chosen += [
            i for i in sorted(driven) if i not in moved and _measures(plant, names[i]) <= wide
        ]
        if chosen:
            return tuple(
                Position(names[i], tuple(names[j] for j in uses[i]), i in driven)
                for i in sorted(chosen)
            )
    return ()


def _heads(pool: list[int], uses: dict[int, list[int]]) -> list[int]:
    """Of chains x' = v, v' = a the first links: no velocity of another, no integral of one."""
    chosen: list[int] = []
    velocities: set[int] = set()
    for i in pool:
        if i not in velocities and not set(uses[i]) & set(chosen):
            chosen.append(i)
            velocities |= set(uses[i])
    return chosen


def _dependent(plant: System) -> tuple[frozenset[int], frozenset[int]]:
    """(states whose rates depend on anything; those whose rates depend on what controls set), by
    their expressions.
    """

    def build() -> tuple[frozenset[int], frozenset[int]]:
        rates = [plant.expression(f"der({v.name})") for v in plant.states]
        controls = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
        everything, set_by = ca.vertcat(plant.x, plant.u), plant.u[controls]
        moving = frozenset(i for i, rate in enumerate(rates) if ca.depends_on(rate, everything))
        if not controls:
            return moving, frozenset()
        return moving, frozenset(i for i, rate in enumerate(rates) if ca.depends_on(rate, set_by))

    found: tuple[frozenset[int], frozenset[int]] = plant.cached(("dependent rates",), build)
    return found


def _neutral(plant: System) -> tuple[list[int], Pattern]:
    """States whose rates, where they vanish, do not depend on themselves; and what they depend on
    there.
    """
    moving, _ = _dependent(plant)
    chosen = [i for i, v in enumerate(plant.states) if not v.memory and i in moving]
    region = _Region(plant, plant.function(plant.x, plant.u, plant.p)[0])
    while chosen:
        z, worst = region.roots(chosen)
        if not region.points.size:  # no numbers to be had: what the expressions say
            return [i for i in chosen if not region.pattern[i, i]], region.pattern
        if not z.size:
            chosen.remove(worst)
            continue
        moved = region.moved(z)
        lost = {i for i in chosen if moved[i, i]}
        if not lost:
            sums = _only_sums(region, z)
            return [i for i in chosen if i not in sums], moved | (region.pattern & ~region.seen)
        chosen = [i for i in chosen if i not in lost]
    return [], region.pattern


def _only_sums(region: _Region, z: Array) -> set[int]:
    """States that no rate needs and whose own rates have no slope at rest (a way, a loss of energy:
    v^2): they only sum up, for a position goes either way.
    """
    slopes = (region.at(points)[1] for points in (z, region.points))
    steep, typical = (np.abs(each).max(axis=(0, 2)) for each in slopes)
    unneeded = ~region.pattern[:, : len(region.pattern)].any(axis=0)
    return {int(i) for i in np.flatnonzero(unneeded & (steep <= FLAT * typical))}


def rate_of(plant: System, name: str) -> ca.SX:
    """The rate of a state, or of an output while the inputs stand."""
    if plant.variable(name).causality == "state":
        return plant.expression(f"der({name})")
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    return ca.SX(ca.jtimes(plant.expression(name), plant.x, xdot))


def rest_rows(plant: System, positions: tuple[Position, ...]) -> list[tuple[Position, int, ca.SX]]:
    """[(position, order, expression)]: rates (order 1) and accelerations (2), without repetitions.

    What is seen to follow from the rows before it (a wheel that counts the same motion) is left
    out; what cannot be seen to is kept.
    """
    key = ("rest rows", positions, _numbers(plant))
    found: list[tuple[Position, int, ca.SX]]
    found = plant.cached(key, lambda: _rest_rows(plant, positions))
    return list(found)


def _rest_rows(plant: System, positions: tuple[Position, ...]) -> list[tuple[Position, int, ca.SX]]:
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    rows: list[tuple[Position, int, ca.SX]] = []
    for position in positions:
        rate = rate_of(plant, position.name)
        rows.append((position, 1, rate))
        if not position.driven:
            rows.append((position, 2, ca.jtimes(rate, plant.x, xdot)))
    rows = [row for row in rows if not row[2].is_zero()]
    if not rows:
        return []
    rows.sort(key=lambda row: row[1])
    region = _Region(plant, ca.vertcat(*(row[2] for row in rows)))
    kept: list[int] = []
    for i in range(len(rows)):
        if not kept or not region.follows(i, kept):
            kept.append(i)
    order = {p.name: i for i, p in enumerate(positions)}
    return sorted((rows[i] for i in kept), key=lambda row: (order[row[0].name], row[1]))


def _structure(plant: System) -> tuple[list[str], Pattern, Pattern]:
    """(states, what each rate depends on: states, inputs that are chosen); not to be changed."""

    def build() -> tuple[list[str], Pattern, Pattern]:
        xdot = plant.function(plant.x, plant.u, plant.p)[0]
        a, b = (
            np.array(ca.DM(ca.jacobian(xdot, z).sparsity(), 1)).astype(bool)
            for z in (plant.x, plant.u)
        )
        chosen = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
        names = [v.name for v in plant.states]
        return names, a, b.reshape(len(names), len(plant.inputs))[:, chosen]

    found: tuple[list[str], Pattern, Pattern] = plant.cached("what rates depend on", build)
    return found


def totals(plant: System) -> tuple[str, ...]:
    """States that only sum up (air drawn, work done): no equation, not even their own,
    needs them.
    """
    names, a, _ = _structure(plant)
    found = [n for i, n in enumerate(names) if not a[:, i].any() and not plant.variable(n).memory]
    positions = {p.name for p in resting(plant)} if found else set()  # which takes its time
    return tuple(n for n in found if n not in positions)


def store_names(plant: System) -> tuple[str, ...]:
    """Held memories that inputs or the like of pressures fill and empty (a tank without a source):
    whatever they hold, they keep it at rest. Shapes (slip, play) follow motion alone.
    """
    names, a, b = _structure(plant)
    moving = {n for p in resting(plant) for n in (p.name, *p.velocities)}
    held = {v.name for v in plant.states if v.memory == "held"}
    others = [i for i, n in enumerate(names) if n not in moving | held]
    return tuple(
        n
        for i, n in enumerate(names)
        if n in held and _measures(plant, n) == 2 and (b[i].any() or a[i, others].any())
    )


def settled_names(plant: System) -> tuple[str, ...]:
    """States that a long rest brings to their place: marked as settling, and lags of positions.

    A lag of positions (a sensor's filter) follows positions, velocities and its like only: no
    pressure, no input.
    """
    names, a, b = _structure(plant)
    positions = resting(plant)
    moving = {n for p in positions for n in (p.name, *p.velocities)}
    allowed = [i for i, n in enumerate(names) if n in moving]
    memory = {v.name for v in plant.states if v.memory}
    lags = {
        i
        for i, n in enumerate(names)
        if n not in moving and n not in memory and not b[i].any() and a[i, i]
    }
    while True:
        kept = {i for i in lags if set(np.flatnonzero(a[i])) <= {*allowed, *lags}}
        if kept == lags:
            break
        lags = kept
    marked = {v.name for v in plant.states if v.memory == "settling"}
    return tuple(n for i, n in enumerate(names) if n in marked or i in lags)
