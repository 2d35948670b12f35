"""Several points of rest: all that a search finds, and paths of them along a variable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..equilibrium import EquilibriumError, OperatingPoint, equilibrium, posed, why_not
from ..errors import InputError
from ..plant.plant import Plant, Values

__all__ = ["EquilibriumPath", "equilibria", "equilibrium_path"]

Array: TypeAlias = NDArray[np.float64]

SAME = 1e-6
"""Equilibria nearer to each other than this (in units of nominal) are one."""


def equilibria(
    plant: Plant,
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    starts: int = 30,
    seed: int = 0,
    **more: Any,
) -> list[OperatingPoint]:
    """All points of rest under conditions that a search from many starts finds, each once.

    Arguments as in :func:`equilibrium`; ``starts`` points are spread over the bounds (a state or
    input without bounds: five nominals to either side of its start). Sorted by their states; see
    ``point.stability`` and ``point.poles``. A search by samples: it can miss one with a small basin.
    Raises InputError for bad conditions, EquilibriumError when there is none.
    """
    search = posed(plant, {**(conditions or {}), **more}, free)
    if starts < 1:
        raise InputError(f"starts = {starts} must be >= 1")
    found: list[Array] = []
    for guess in search.starts(starts, seed, reach=5.0):
        for rough in (search.newton(guess, steps=30), search.nearest(guess)):
            point = search.polished(rough)
            if point is None:
                continue
            if all(np.abs((point - other) / search.nominal).max() > SAME for other in found):
                found.append(point)
            break
    if not found:
        raise EquilibriumError(why_not(search, search.nearest(search.start)))
    return [search.point(z) for z in sorted(found, key=lambda z: tuple(z / search.nominal))]


@dataclass(frozen=True)
class EquilibriumPath:
    """Points of rest along one variable; ``path["x"]`` gives a value at each of them [SI]."""

    name: str
    values: Array
    """Of the variable, as far as the path came."""
    points: tuple[OperatingPoint, ...]
    end: str = ""
    """Why the path stops before the last value asked for; "" when it does not."""
    folds: tuple[OperatingPoint, ...] = ()
    """Points at which the path turns back (of :func:`equilibrium_branch` only)."""

    def __getitem__(self, name: str) -> Array:
        return np.array([point[name] for point in self.points])

    def __len__(self) -> int:
        return len(self.points)


def equilibrium_path(
    plant: Plant,
    name: str,
    values: Iterable[float],
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    **more: Any,
) -> EquilibriumPath:
    """Points of rest while one variable (condition or parameter) runs through values, in order.

    ``equilibrium_path(plant, "mass", np.linspace(5, 60, 40), {"muscle.command": 3e5})``. Each point
    starts from its neighbour, so the path stays on one branch; it ends where that branch leaves the
    bounds or turns back (a fold), and says so in ``end``; :func:`equilibrium_branch` goes round folds.
    Raises InputError for bad conditions, EquilibriumError when the first point does not exist.
    """
    points: list[OperatingPoint] = []
    done: list[float] = []
    end = ""
    for value in values:
        given = {**(conditions or {}), **more, name: float(value)}
        if not points:
            points.append(equilibrium(plant, given, free=free))
        else:
            try:
                search = posed(plant, given, free)
            except InputError as error:  # the value itself leaves its range
                end = str(error)
                break
            point = search.polished(search.newton(search.vector(points[-1]), steps=30))
            if point is None:
                shown = plant.variable(name).shown
                end = f"no neighbour within the bounds from {shown(done[-1])} to {shown(value)}"
                break
            points.append(search.point(point))
        done.append(float(value))
    return EquilibriumPath(plant.variable(name).name, np.array(done), tuple(points), end)
