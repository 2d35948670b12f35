"""Several equilibria: all that a search finds, and paths of them along a variable, round their
folds by arc length, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_finite, require_positive
from ..core.shown import shown
from ..core.stop import TimeIsUp, deadline, spared, turns, verb
from ..numerics.continuation import ImplicitCurve, Walk
from ..numerics.newton import NewtonError
from ..plants.plant import Plant, Values, require_plant
from .held import Memory, held
from .rest import TOLERANCE, Rest, posed
from .resting_point import EquilibriumError, OperatingPoint, equilibrium, why_not

Array: TypeAlias = NDArray[np.float64]

NEWTON = 8
"""Newton steps allowed to come back to the branch."""
LEAST_COSINE = 0.95
"""Between neighbouring tangents: at most about 18 degrees."""
GROWTH = 1.4
"""By what steps grow again."""
SHORTEST = 1e-7
"""Shortest step, as a part of the first one."""
STEPS = 4
"""From the virgin point of a band to its end."""
SAME = 1e-6
"""Equilibria nearer to each other than this (scaled by nominals) are one."""


@verb
def equilibria(
    plant: Plant,
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    starts: int = 30,
    seed: int = 0,
    memory: Memory | None = None,
    time_limit: float | None = None,
    **more: Any,
) -> Equilibria:
    """All equilibria under conditions that a search from many starts finds, each once.

    Arguments as in :func:`equilibrium`; ``starts`` points are spread over the bounds (a state or
    input without bounds: five nominals to either side of its start). Sorted by their states; see
    ``point.stability`` and ``point.poles``. A search by samples: it can miss one with a small
    basin.

    With hysteresis there is an equilibrium for all that it may keep, in bands. Without ``memory``
    the virgin point of each band is returned, and ``.bands`` holds their ends; with it (see
    :func:`equilibrium`) the equilibria with just that memory. Raises InputError for bad
    conditions, EquilibriumError when there is none.

    time_limit : [s]; when it is over, what was found is returned (without bands), and ``.ended``
        says so; OutOfTime when that is nothing.

    Examples
    --------
    >>> found = pam.operating.equilibria(plant, {"muscle.command": 3e5})
    >>> [f"{1e3 * p['x']:.1f} mm" for p in found]
    ['45.4 mm']
    """
    given = {**(conditions or {}), **more}
    search = posed(plant, given, free, memory=memory or "virgin")
    require_count("starts", starts, 1)
    require_count("seed", seed, 0)
    found: list[Array] = []
    bands: tuple[Band, ...] = ()
    ended = ""
    try:
        for guess in search.starts(starts, seed, reach=5.0):
            _search_from(search, guess, found)
        if not found:
            raise EquilibriumError(why_not(search, search.nearest(search.start)))
        points = _sorted(search, found)
        if memory is None and search.pinned:
            bands = tuple(_band(search, point) for point in points)
    except TimeIsUp:
        if not found:
            raise
        points, ended = _sorted(search, found), f"{deadline()} was over"
    return Equilibria(points, bands, ended)


def _search_from(search: Rest, guess: Array, found: list[Array]) -> None:
    """Add the equilibrium to which a guess leads, unless it is there."""
    for rough in (search.newton(guess, steps=30), search.nearest(guess)):
        point = search.converged(rough)
        if point is None:
            continue
        if all(np.abs((point - other) / search.nominal).max() > SAME for other in found):
            found.append(point)
        return


def _sorted(search: Rest, found: list[Array]) -> list[OperatingPoint]:
    return [search.point(z) for z in sorted(found, key=lambda z: tuple(z / search.nominal))]


def _band(search: Rest, point: OperatingPoint) -> Band:
    below, above = (_end(search, point, held(search.plant, s)) for s in ("below", "above"))
    return Band(point, below, above)


def _end(rest: Rest, point: OperatingPoint, memory: Mapping[str, float]) -> OperatingPoint | None:
    """The equilibrium with another memory, on the way there from a point; None outside bounds."""
    z = rest.vector(point)
    other = rest
    for share in np.linspace(0, 1, STEPS + 1)[1:]:
        pinned = {n: v + share * (memory[n] - v) for n, v in rest.pinned.items()}
        other = Rest(rest.plant, rest.values, rest.free, rest.more, pinned)
        found = other.converged(other.newton(z, steps=30))
        if found is None:
            return None
        z = found
    return other.point(z)


@shown
@dataclass(frozen=True)
class Band:
    """The equilibria that differ in what hysteresis keeps, by its ends and its virgin point."""

    virgin: OperatingPoint
    """Nothing has slid yet."""
    below: OperatingPoint | None
    """Come to from below, from afar; None where that leaves the bounds."""
    above: OperatingPoint | None
    """Come to from above, from afar; None where that leaves the bounds."""

    @turns
    def __getitem__(self, name: str) -> tuple[float, float]:
        """Lowest and highest value [SI] of a variable among the ends and the virgin point."""
        values = [p[name] for p in (self.virgin, self.below, self.above) if p is not None]
        return min(values), max(values)

    def __str__(self) -> str:
        plant = self.virgin.plant
        lines = []
        for variable in (v for v in (*plant.states, *plant.inputs) if v.memory != "held"):
            if np.ptp(self[variable.name]) <= SAME * variable.nominal:
                continue
            low, high = map(variable.shown, self[variable.name])
            middle = variable.shown(self.virgin[variable.name])
            lines.append(f"{variable.name:<24} {low} .. {high} (virgin {middle})")
        return "\n".join(lines)


@shown
class Equilibria(list[OperatingPoint]):
    """Equilibria, a list; with hysteresis ``bands`` tells the band that each one stands for.

    ended : why the search was broken off; "" when it was not.
    """

    def __init__(
        self,
        points: Iterable[OperatingPoint] = (),
        bands: tuple[Band, ...] = (),
        ended: str = "",
    ) -> None:
        super().__init__(points)
        self.bands, self.ended = bands, ended

    def _brief(self) -> str:
        return f"{len(self)} equilibria" + (f" of {self[0].plant.name}" if self else "")


@shown
@dataclass(frozen=True, eq=False)
class EquilibriumPath:
    """Equilibria along one variable; ``path["x"]`` gives a value at each of them [SI]."""

    name: str
    values: Array
    """Of the variable, as far as the path came."""
    points: tuple[OperatingPoint, ...]
    end: str = ""
    """Why the path stops before the last value asked for; "" when it does not."""
    folds: tuple[OperatingPoint, ...] = ()
    """Points at which the path turns back (of :func:`equilibrium_branch` only)."""

    @turns
    def __getitem__(self, name: str) -> Array:
        return np.array([point[name] for point in self.points])

    def __len__(self) -> int:
        return len(self.points)


@verb
def equilibrium_path(
    plant: Plant,
    name: str,
    values: Iterable[float],
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: Any,
) -> EquilibriumPath:
    """Equilibria while one variable (condition or parameter) runs through values, in order.

    ``equilibrium_path(plant, "mass", np.linspace(5, 60, 40), {"muscle.command": 3e5})``. Each point
    starts from its neighbour, so the path stays on one branch; it ends where that branch leaves the
    bounds or turns back (a fold), and says so in ``end``; :func:`equilibrium_branch` goes round
    folds. What hysteresis keeps (``memory``, see :func:`equilibrium`) is the same along the path.
    Raises InputError for bad conditions, EquilibriumError when the first point does not exist.

    time_limit : [s]; when it is over, the path so far is returned, and ``end`` says so (OutOfTime
        before the first point).

    Examples
    --------
    >>> path = pam.operating.equilibrium_path(plant, "mass", [5.0, 10.0], {"muscle.command": 3e5})
    >>> [f"{1e3 * p['x']:.1f} mm" for p in path.points]
    ['51.1 mm', '45.4 mm']
    """
    points: list[OperatingPoint] = []
    done: list[float] = []
    end = ""
    unit = require_plant(plant).variable(name).unit
    for value in (require_finite(name, v, unit) for v in values):
        if points and deadline().over:
            end = f"{deadline()} was over"
            break
        given = {**(conditions or {}), **more, name: value}
        if not points:
            points.append(equilibrium(plant, given, free=free, memory=memory))
        else:
            try:
                rest = posed(plant, given, free, memory=memory)
            except InputError as error:  # the value itself leaves its range
                end = str(error)
                break
            with spared(1.0):  # one more than the time allows, and the loop ends
                point = rest.converged(rest.newton(rest.vector(points[-1]), steps=30))
            if point is None:
                shown = plant.variable(name).shown
                end = f"no neighbour within the bounds from {shown(done[-1])} to {shown(value)}"
                break
            points.append(rest.point(point))
        done.append(float(value))
    if not points:
        raise InputError("values is empty: give at least one")
    return EquilibriumPath(plant.variable(name).name, np.array(done), tuple(points), end)


@verb
def equilibrium_branch(
    plant: Plant,
    name: str,
    start: float,
    stop: float,
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    step: float = 0.05,
    longest: float = 0.25,
    max_points: int = 2000,
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: Any,
) -> EquilibriumPath:
    """Equilibria while one variable runs from ``start`` towards ``stop``, round folds.

    ``equilibrium_branch(plant, "mass", 5.0, 60.0, {"muscle.command": 3e5})``: as
    :func:`equilibrium_path`, but by pseudo-arclength continuation (H. B. Keller, in Applications of
    Bifurcation Theory, Academic Press 1977, 359-384): where the branch turns back, the variable
    runs backwards along it, and stable points become unstable or the other way round.

    step, longest : first and longest step along the branch, scaled by nominals of all states,
        inputs and the variable together; steps follow the branch's curvature.
    memory : what hysteresis keeps, the same along the branch; see :func:`equilibrium`.

    The path ends where the variable reaches ``stop`` or comes back to ``start``, where it leaves
    the bounds of a variable, or after ``max_points``; ``path.end`` says which unless ``stop`` was
    reached. ``path.folds`` are the turning points, found to 1e-9.
    time_limit : [s]; when it is over, the path so far is returned, and ``path.end`` says so
        (OutOfTime before the first point).

    Raises InputError for bad conditions, EquilibriumError when there is no equilibrium at
    ``start``.

    Examples
    --------
    >>> rest = {"muscle.command": 3e5}
    >>> path = pam.operating.equilibrium_branch(plant, "mass", 5.0, 20.0, rest)
    >>> len(path.folds)
    0
    """
    unit = require_plant(plant).variable(name).unit
    start, stop = require_finite("start", start, unit), require_finite("stop", stop, unit)
    step, longest = require_positive("step", step), require_positive("longest", longest)
    if start == stop:
        raise InputError(f"start and stop are the same ({start:g}); give the way to go")
    given = {**(conditions or {}), **more, name: start}
    branch = _Branch(plant, name, given, free, memory)
    place = branch.place(equilibrium(plant, given, free=free, memory=memory))
    tangent = branch.curve.tangent(place)
    if branch.rate(place, tangent) * (stop - start) < 0:
        tangent = -tangent
    walk = Walk(branch.curve, place, tangent, step, longest, SHORTEST * step, GROWTH, LEAST_COSINE)
    places, folds, end = [place], [], f"after {max_points} points"
    try:
        while len(places) < max_points:
            place, tangent = walk.place, walk.tangent
            try:
                length = walk.advance()
            except NewtonError:
                end = "the branch cannot be followed further (it may branch here)"
                break
            if outside := branch.leaves(walk.place):
                end = f"{outside} reaches the end of its range"
                break
            if branch.rate(walk.place, walk.tangent) * branch.rate(place, tangent) < 0:
                folds.append(branch.fold(place, tangent, length))
            value = branch.value(walk.place)
            if not min(start, stop) <= value <= max(start, stop):
                border = stop if (value - stop) * (stop - start) > 0 else start
                places.append(branch.crossing(place, tangent, length, border))
                end = "" if border == stop else "the branch comes back to the start value"
                break
            places.append(walk.place)
    except TimeIsUp:
        end = f"{deadline()} was over"
    return EquilibriumPath(
        branch.variable.name,
        np.array([branch.value(w) for w in places]),
        tuple(branch.point(w) for w in places),
        end,
        tuple(branch.point(w) for w in folds),
    )


class _Branch:
    """The equations of rest without the condition on the variable: one unknown more than equations.

    A place w holds states, inputs and free variables scaled by nominals.
    """

    def __init__(
        self, plant: Plant, name: str, given: Values, free: Sequence[str], memory: Memory
    ) -> None:
        self.variable = plant.variable(name)
        self.rest = posed(plant, given, free, memory=memory).along(self.variable.name)
        self.of = self.rest.of(self.variable.name)
        self.curve = ImplicitCurve(self.rest.equations, TOLERANCE, NEWTON)

    def place(self, point: OperatingPoint) -> Array:
        return np.asarray(self.rest.vector(point) / self.rest.nominal)

    def point(self, w: Array) -> OperatingPoint:
        return self.rest.point(np.clip(w * self.rest.nominal, self.rest.low, self.rest.high))

    def value(self, w: Array) -> float:
        """Of the variable [SI]."""
        return self.of(w)[0] * self.variable.nominal

    def rate(self, w: Array, tangent: Array) -> float:
        """Change of the variable along the branch, scaled by nominals."""
        return float(self.of(w)[1] @ tangent)

    def leaves(self, w: Array) -> str:
        """The first unknown outside its range, or ""."""
        z, margin = w * self.rest.nominal, 1e-9 * self.rest.nominal
        outside = (z < self.rest.low - margin) | (z > self.rest.high + margin)
        return self.rest.unknown[int(np.argmax(outside))] if outside.any() else ""

    def fold(self, place: Array, tangent: Array, length: float) -> Array:
        """Where the variable turns back within a step."""

        def rate(w: Array) -> float:
            direction = self.curve.tangent(w)
            return self.rate(w, direction * np.sign(direction @ tangent))

        return self.curve.where(rate, place, tangent, length)

    def crossing(self, place: Array, tangent: Array, length: float, value: float) -> Array:
        """Where the variable has a value within a step."""
        goal = value / self.variable.nominal
        return self.curve.where(lambda w: self.of(w)[0] - goal, place, tangent, length)
