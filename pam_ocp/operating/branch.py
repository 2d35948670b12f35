"""A branch of equilibria, followed round its folds by its arc length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_finite, require_positive
from ..core.stop import TimeIsUp, deadline, verb
from ..numerics.continuation import ImplicitCurve, Walk
from ..numerics.newton import NewtonError
from ..plants.plant import Plant, Values
from .held import Memory
from .rest import TOLERANCE, Rest, posed
from .resting_point import OperatingPoint, equilibrium
from .several import EquilibriumPath

__all__ = ["equilibrium_branch"]

Array: TypeAlias = NDArray[np.float64]

NEWTON = 8
"""Newton steps allowed to come back to the branch."""
LEAST_COSINE = 0.95
"""Between neighbouring tangents: at most about 18 degrees."""
GROWTH = 1.4
"""By what steps grow again."""
SHORTEST = 1e-7
"""Shortest step, as a part of the first one."""


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
    start, stop = require_finite("start", start), require_finite("stop", stop)
    length = require_positive("step", step)
    require_positive("longest", longest)
    if start == stop:
        raise InputError(f"start and stop are the same ({start:g}); give the way to go")
    given = {**(conditions or {}), **more, name: start}
    branch = _Branch(plant, name, given, free, memory)
    place = branch.place(equilibrium(plant, given, free=free, memory=memory))
    tangent = branch.curve.tangent(place)
    if branch.rate(place, tangent) * (stop - start) < 0:
        tangent = -tangent
    walk = Walk(
        branch.curve, place, tangent, length, longest, SHORTEST * step, GROWTH, LEAST_COSINE
    )
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
        self.rest = posed(Rest, plant, given, free, memory=memory).along(self.variable.name)
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
