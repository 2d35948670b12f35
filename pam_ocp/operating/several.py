"""Several equilibria: all that a search finds, and paths of them along a variable."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count
from ..core.shown import shown
from ..core.stop import TimeIsUp, deadline, spared, turns, verb
from ..plants.plant import Plant, Values
from .held import Memory, held
from .rest import Rest, posed
from .rest_search import Search
from .resting_point import EquilibriumError, OperatingPoint, equilibrium, why_not

__all__ = ["Band", "Equilibria", "EquilibriumPath", "equilibria", "equilibrium_path"]

Array: TypeAlias = NDArray[np.float64]

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
    search = posed(Search, plant, given, free, memory=memory or "virgin")
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


def _search_from(search: Search, guess: Array, found: list[Array]) -> None:
    """Add the equilibrium to which a guess leads, unless it is there."""
    for rough in (search.newton(guess, steps=30), search.nearest(guess)):
        point = search.converged(rough)
        if point is None:
            continue
        if all(np.abs((point - other) / search.nominal).max() > SAME for other in found):
            found.append(point)
        return


def _sorted(search: Search, found: list[Array]) -> list[OperatingPoint]:
    return [search.point(z) for z in sorted(found, key=lambda z: tuple(z / search.nominal))]


def _band(search: Search, point: OperatingPoint) -> Band:
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
@dataclass(frozen=True)
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
    for value in values:
        if points and deadline().over:
            end = f"{deadline()} was over"
            break
        given = {**(conditions or {}), **more, name: float(value)}
        if not points:
            points.append(equilibrium(plant, given, free=free, memory=memory))
        else:
            try:
                rest = posed(Rest, plant, given, free, memory=memory)
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
