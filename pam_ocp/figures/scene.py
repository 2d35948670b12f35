"""Where the shapes of a plant's sketch stand along a motion: films and the page draw them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..plants.hanging import hanging_sketch
from ..plants.sketch import Disc, Line, Point, Polygon, Sketch, Spindle

if TYPE_CHECKING:
    from ..plants.plant import Plant

__all__ = ["THICKNESS", "Places", "outline", "rim", "scene_of", "sketch_of"]

Array: TypeAlias = NDArray[np.float64]

THICKNESS = 0.09
"""Radius of a stretched muscle in the picture, in parts of its length."""


def sketch_of(plant: Plant) -> Sketch | None:
    """How a plant looks; None for one that says nothing of it."""
    return plant.sketch() or hanging_sketch(plant)


class Places:
    """Points of a sketch along a motion: states x (n, moments), inputs u (m, moments)."""

    def __init__(self, plant: Plant, x: Array, u: Array) -> None:
        self._plant, self._x, self._u = plant, x, u

    def _at(self, expressions: Sequence[Any], x: Array, u: Array) -> Array:
        """(moments, expressions)."""
        plant = self._plant
        flat = ca.vertcat(*(ca.SX(e) for e in expressions))
        function = ca.Function("points", [plant.x, plant.u, plant.p], [ca.densify(flat)])
        p = np.tile(plant.vector("parameter")[:, None], (1, x.shape[1]))
        values: Array = np.asarray(function(x, u, p), float).T
        return values

    def along(self, points: Sequence[Point]) -> Array:
        """(moments, points, 2) [m]."""
        flat = self._at([c for point in points for c in point], self._x, self._u)
        return flat.reshape(-1, len(points), 2)

    def values(self, name: str) -> Array:
        """A variable of the plant, (moments,)."""
        found: Array = self._at([self._plant.expression(name)], self._x, self._u)[:, 0]
        return found

    def where(self, points: Sequence[Point], state: str, value: float) -> Array:
        """(points, 2) [m] for one value of a state, all else at its start."""
        plant = self._plant
        x = plant.vector("state", {state: value})
        flat = [c for point in points for c in point]
        found = self._at(flat, x[:, None], plant.vector("input")[:, None])
        only: Array = found.reshape(len(points), 2)
        return only


def rim(disc: Disc) -> list[Point]:
    """Points around a disc."""
    angles = np.linspace(0.0, 2 * np.pi, 60)
    (x, y), r = disc.centre, disc.radius
    return [(x + r * float(np.cos(a)), y + r * float(np.sin(a))) for a in angles]


def outline(start: Any, end: Any, kappa: float, rest_length: float) -> Array:
    """Of a muscle between two points [m], thicker the more it contracts: (points, 2)."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = b - a
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.linspace(0.0, 1.0, 40)
    # a braid's volume hardly shrinks: what it loses in length it gains in girth
    bulge = THICKNESS * rest_length / np.sqrt(max(1.0 - 2.0 * kappa, 0.2))
    half = bulge * (0.35 + 0.65 * np.sin(np.pi * s) ** 0.6)
    middle = a + np.outer(s, along)
    upper, lower = (middle + sign * np.outer(half, across) for sign in (1, -1))
    return np.vstack([upper, lower[::-1]])


def scene_of(plant: Plant, t: Array, x: Array, u: Array) -> dict[str, Any] | None:
    """The sketch at moments t, as plain values in mm; None for a plant without one.

    x (n, moments), u (m, moments). Returns ``t``, ``width`` and ``height`` (low, high), and
    ``shapes``: each a ``style`` with its points in ``frames`` (moments, points, 2), or once where
    it does not move; muscles have a ``level`` of pressure (0 .. 1) for each moment, too.
    """
    sketch = sketch_of(plant)
    if sketch is None:
        return None
    places = Places(plant, x, u)
    names = [s.muscle for s in sketch.shapes if isinstance(s, Spindle)]
    pressures = {n: places.values(f"{n}.pressure") for n in names}
    ends = [plant.variable(f"{n}.pressure").max for n in names]
    seen = [float(p.max()) for p in pressures.values()]
    largest = max([1e4, *seen, *(float(e) for e in ends if np.isfinite(e))])
    shapes: list[dict[str, Any]] = []
    for shape in sketch.shapes:
        if isinstance(shape, Spindle):
            tips = places.along([shape.start, shape.end])
            kappa = places.values(f"{shape.muscle}.contraction")
            length = float(plant.variable(f"{shape.muscle}.rest_length").start or 0.0)
            frames = np.array(
                [outline(e[0], e[1], k, length) for e, k in zip(tips, kappa, strict=True)]
            )
            level = np.clip(pressures[shape.muscle] / largest, 0.0, 1.0)
            shapes.append({"style": "muscle", **_frames(frames), "level": level.round(3).tolist()})
        elif isinstance(shape, Polygon | Line):
            shapes.append({"style": shape.style, **_frames(places.along(shape.points))})
        else:
            shapes.append({"style": "disc", **_frames(places.along(rim(shape)))})
    corners = places.along(list(zip(sketch.width, sketch.height, strict=True)))[0]
    return {
        "t": np.asarray(t, float).tolist(),
        "width": (1e3 * corners[:, 0]).tolist(),
        "height": (1e3 * corners[:, 1]).tolist(),
        "largest": largest,
        "shapes": shapes,
    }


def _frames(points: Array) -> dict[str, Any]:
    still = bool(np.all(np.ptp(points, axis=0) < 1e-9))
    shown = points[:1] if still else points
    return {"frames": (1e3 * shown).round(2).tolist()}
