"""Where the shapes of a plant's sketch are: their points along a motion, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..plants.sketch import Disc, Point

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant

__all__ = ["Places", "outline", "rim"]

Array: TypeAlias = NDArray[np.float64]

THICKNESS = 0.09
"""Radius of a stretched muscle in the picture, in parts of its length."""


class Places:
    """Points of a sketch along a motion, or at given values of the states."""

    def __init__(self, plant: Plant, motion: Trajectory) -> None:
        self._plant = plant
        self._x, self._u = (
            motion.array([v.name for v in each]).T for each in (plant.states, plant.inputs)
        )

    def _at(self, points: Sequence[Point], x: Array, u: Array) -> Array:
        plant = self._plant
        flat = ca.vertcat(*(ca.SX(c) for point in points for c in point))
        function = ca.Function("points", [plant.x, plant.u, plant.p], [ca.densify(flat)])
        p = np.tile(plant.vector("parameter")[:, None], (1, x.shape[1]))
        values = np.asarray(function(x, u, p), float)
        found: Array = values.T.reshape(x.shape[1], len(points), 2)
        return found

    def along(self, points: Sequence[Point]) -> Array:
        """(moments, points, 2) [m]."""
        return self._at(points, self._x, self._u)

    def where(self, points: Sequence[Point], state: str, value: float) -> Array:
        """(points, 2) [m] for one value of a state, all else at its start."""
        plant = self._plant
        x = plant.vector("state", {state: value})
        only: Array = self._at(points, x[:, None], plant.vector("input")[:, None])[0]
        return only


def outline(a: Sequence[float], b: Sequence[float], length: float, kappa: float) -> Array:
    """(points, 2) around a muscle between the points a and b, thicker the more it contracts.

    length : at rest [m]. kappa : contraction.
    """
    start, end = np.asarray(a, float), np.asarray(b, float)
    along = end - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.linspace(0.0, 1.0, 40)
    # a braid's volume hardly shrinks: what it loses in length it gains in girth
    bulge = THICKNESS * length / np.sqrt(max(1.0 - 2.0 * kappa, 0.2))
    half = bulge * (0.35 + 0.65 * np.sin(np.pi * s) ** 0.6)
    middle = start + np.outer(s, along)
    upper, lower = (middle + sign * np.outer(half, across) for sign in (1, -1))
    return np.vstack([upper, lower[::-1]])


def rim(disc: Disc) -> list[Point]:
    """Points around a disc."""
    angles = np.linspace(0.0, 2 * np.pi, 60)
    (x, y), r = disc.centre, disc.radius
    return [(x + r * float(np.cos(a)), y + r * float(np.sin(a))) for a in angles]
