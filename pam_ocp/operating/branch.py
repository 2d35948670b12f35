"""A branch of points of rest, followed round its folds by its arc length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_finite, require_positive
from ..plants.plant import Plant, Values
from .equilibrium import TOLERANCE, OperatingPoint, equilibrium, posed
from .held import Memory
from .several import EquilibriumPath

__all__ = ["equilibrium_branch"]

Array: TypeAlias = NDArray[np.float64]

NEWTON = 8
"""Newton steps allowed to come back to the branch."""
TURN = 0.95
"""Least cosine between neighbouring tangents: at most about 18 degrees."""
GROW, SHRINK = 1.4, 0.5
SHORTEST = 1e-7
"""Shortest step, as a part of the first one."""


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
    **more: Any,
) -> EquilibriumPath:
    """Points of rest while one variable runs from ``start`` towards ``stop``, round folds.

    ``equilibrium_branch(plant, "mass", 5.0, 60.0, {"muscle.command": 3e5})``: as
    :func:`equilibrium_path`, but by pseudo-arclength continuation (H. B. Keller, in Applications of
    Bifurcation Theory, Academic Press 1977, 359-384): where the branch turns back, the variable
    runs backwards along it, and stable points become unstable or the other way round.

    step, longest : first and longest step along the branch, in units of nominal of all states,
        inputs and the variable together; steps follow the branch's curvature.
    memory : what hysteresis keeps, the same along the branch; see :func:`equilibrium`.

    The path ends where the variable reaches ``stop`` or comes back to ``start``, where it leaves
    the bounds of a variable, or after ``max_points``; ``path.end`` says which unless ``stop`` was
    reached. ``path.folds`` are the turning points, found to 1e-9.

    Raises InputError for bad conditions, EquilibriumError when there is no point of rest at
    ``start``.
    """
    start, stop = require_finite("start", start), require_finite("stop", stop)
    length = require_positive("step", step)
    require_positive("longest", longest)
    if start == stop:
        raise InputError(f"start and stop are the same ({start:g}); give the way to go")
    given = {**(conditions or {}), **more, name: start}
    curve = _Curve(plant, name, given, free, memory)
    place = curve.place(equilibrium(plant, given, free=free, memory=memory))
    tangent = curve.tangent(place)
    if curve.rate(place, tangent) * (stop - start) < 0:
        tangent = -tangent
    places, folds, end = [place], [], f"after {max_points} points"
    while len(places) < max_points:
        found = curve.advance(place, tangent, length, SHORTEST * step)
        if found is None:
            end = "the branch cannot be followed further (it may branch here)"
            break
        new, direction, length = found
        if outside := curve.leaves(new):
            end = f"{outside} reaches the end of its range"
            break
        if curve.rate(new, direction) * curve.rate(place, tangent) < 0:
            folds.append(curve.fold(place, tangent, length))
        value = curve.value(new)
        if not min(start, stop) <= value <= max(start, stop):
            border = stop if (value - stop) * (stop - start) > 0 else start
            places.append(curve.crossing(place, tangent, length, border))
            end = "" if border == stop else "the branch comes back to the start value"
            break
        places.append(new)
        place, tangent, length = new, direction, min(length * GROW, longest)
    return EquilibriumPath(
        curve.name,
        np.array([curve.value(w) for w in places]),
        tuple(curve.point(w) for w in places),
        end,
        tuple(curve.point(w) for w in folds),
    )


class _Curve:
    """The equations of rest without the condition on the variable: one unknown more than equations.

    A place w holds states, inputs and free variables in units of nominal.
    """

    def __init__(
        self, plant: Plant, name: str, given: Values, free: Sequence[str], memory: Memory
    ) -> None:
        variable = plant.variable(name)
        self.name = variable.name
        self.search = posed(plant, given, free, memory=memory).along(self.name)
        loose = self.search.free
        plant, self.scale = self.search.plant, self.search.nominal
        value = plant.expression(self.name) / variable.nominal
        extra = ca.SX.sym("extra", len(loose))
        z = ca.vertcat(plant.x, plant.u, extra)
        if loose:
            value = ca.substitute(value, ca.vertcat(*(plant.expression(n) for n in loose)), extra)
        self._value = ca.Function("value", [z, plant.p], [value, ca.jacobian(value, z)])
        self._p = plant.vector("parameter")
        self._nominal = variable.nominal
        self._names = [v.name for v in (*plant.states, *plant.inputs)] + loose

    def place(self, point: OperatingPoint) -> Array:
        return np.asarray(self.search.vector(point) / self.scale)

    def point(self, w: Array) -> OperatingPoint:
        return self.search.point(np.clip(w * self.scale, self.search.low, self.search.high))

    def value(self, w: Array) -> float:
        """Of the variable [SI]."""
        return float(self._value(w * self.scale, self._p)[0]) * self._nominal

    def rate(self, w: Array, tangent: Array) -> float:
        """Change of the variable along the branch, in units of nominal."""
        gradient = np.asarray(self._value(w * self.scale, self._p)[1], dtype=float).ravel()
        return float(gradient @ (tangent * self.scale))

    def leaves(self, w: Array) -> str:
        """The first unknown outside its range, or ""."""
        z, margin = w * self.scale, 1e-9 * self.scale
        outside = (z < self.search.low - margin) | (z > self.search.high + margin)
        return self._names[int(np.argmax(outside))] if outside.any() else ""

    def _equations(self, w: Array) -> tuple[Array, Array]:
        found = self.search.function(w * self.scale, self.search.p)
        residual, jacobian = (np.asarray(m, dtype=float) for m in found)
        return residual.ravel(), jacobian * self.scale

    def tangent(self, w: Array) -> Array:
        """A unit vector along the branch."""
        return np.asarray(np.linalg.svd(self._equations(w)[1])[2][-1])

    def corrected(self, place: Array, tangent: Array, length: float) -> Array | None:
        """The point of the branch in the plane across ``tangent`` at ``length`` from ``place``."""
        w = place + length * tangent
        for _ in range(NEWTON):
            residual, jacobian = self._equations(w)
            if not np.all(np.isfinite(jacobian)):
                return None
            across = tangent @ (w - place) - length
            matrix = np.vstack([jacobian, tangent])
            step = np.linalg.lstsq(matrix, np.append(residual, across), rcond=None)[0]
            w = w - step
            if np.abs(step).max() < 1e-13:
                break
        return w if np.abs(self._equations(w)[0]).max() < TOLERANCE else None

    def advance(
        self, place: Array, tangent: Array, length: float, shortest: float
    ) -> tuple[Array, Array, float] | None:
        """The next place, the tangent there and the length of the step; None when there is none."""
        while length > shortest:
            new = self.corrected(place, tangent, length)
            if new is not None:
                direction = self.tangent(new)
                direction = direction * np.sign(direction @ tangent)
                if direction @ tangent > TURN:
                    return new, direction, length
            length *= SHRINK
        return None

    def _solved(self, place: Array, tangent: Array, length: float, of: Any) -> Array:
        """The place within a step at which ``of(place)`` is zero."""
        from scipy.optimize import brentq

        def at(s: float) -> Array:
            w = self.corrected(place, tangent, s) if s > 0 else place
            return place + s * tangent if w is None else w

        return at(brentq(lambda s: of(at(s)), 0.0, length, xtol=1e-14, rtol=1e-14))

    def fold(self, place: Array, tangent: Array, length: float) -> Array:
        """Where the variable turns back within a step."""

        def rate(w: Array) -> float:
            direction = self.tangent(w)
            return self.rate(w, direction * np.sign(direction @ tangent))

        return self._solved(place, tangent, length, rate)

    def crossing(self, place: Array, tangent: Array, length: float, value: float) -> Array:
        """Where the variable has a value within a step."""
        return self._solved(
            place, tangent, length, lambda w: (self.value(w) - value) / self._nominal
        )
