"""A plant's sketch as plain shapes for the page's films: points in metres, frame by frame."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.trajectory import Trajectory
from ..figures.shapes import Places, outline, rim
from ..plants.hanging import hanging_sketch
from ..plants.plant import Plant
from ..plants.sketch import Line, Polygon, Spindle

__all__ = ["scene_of"]

Array: TypeAlias = NDArray[np.float64]

LEAST_PRESSURE = 1e4
"""[Pa] at which muscles are coloured as under the largest pressure, at least."""


def scene_of(plant: Plant, motion: Trajectory, largest: float | None = None) -> dict[str, Any]:
    """The plant as it moves; {} for one that says nothing of how it looks.

    motion : a frame for each of its times. largest : the pressure of the full colour [Pa], by
        default the motion's.

    Returns "t", "view" (left, low, right, high) and "shapes": each with "kind" ("polygon", "line",
    "muscle"), "style", "frames" (lists x, y, x, y, ...; one where it stands still) and, of muscles,
    "pressure" (0..1 for each frame).
    """
    sketch = plant.sketch() or hanging_sketch(plant)
    if sketch is None:
        return {}
    places = Places(plant, motion)
    ((left, low), (right, high)) = places.along(
        list(zip(sketch.width, sketch.height, strict=True))
    )[0]
    shapes = []
    names = [s.muscle for s in sketch.shapes if isinstance(s, Spindle)]
    if largest is None:
        seen = [float(motion[f"{n}.pressure"].max()) for n in names]
        largest = max((LEAST_PRESSURE, *seen))
    for shape in sketch.shapes:
        if isinstance(shape, Spindle):
            shapes.append(_muscle(plant, motion, shape, places, largest))
        elif isinstance(shape, Polygon | Line):
            kind = "polygon" if isinstance(shape, Polygon) else "line"
            points = places.along(shape.points)
            shapes.append({"kind": kind, "style": shape.style, "frames": _frames(points)})
        else:
            points = places.along(rim(shape))
            shapes.append({"kind": "polygon", "style": "disc", "frames": _frames(points)})
    view = [float(v) for v in (left, low, right, high)]
    return {"t": motion.t.tolist(), "view": view, "shapes": shapes}


def _muscle(
    plant: Plant, motion: Trajectory, shape: Spindle, places: Places, largest: float
) -> dict[str, Any]:
    ends = places.along([shape.start, shape.end])
    length = float(plant.variable(f"{shape.muscle}.rest_length").start or 0.0)
    kappa = motion[f"{shape.muscle}.contraction"]
    points = np.stack([outline(a, b, length, k) for (a, b), k in zip(ends, kappa, strict=True)])
    pressure = np.clip(motion[f"{shape.muscle}.pressure"] / largest, 0.0, 1.0)
    return {
        "kind": "muscle",
        "style": shape.muscle,
        "frames": _frames(points),
        "pressure": np.round(pressure, 3).tolist(),
    }


def _frames(points: Array) -> list[list[float]]:
    """To a hundredth of a millimetre, which no screen shows."""
    flat = np.round(points.reshape(len(points), -1), 5)
    if len(flat) > 1 and np.all(flat == flat[0]):
        flat = flat[:1]
    found: list[list[float]] = flat.tolist()
    return found
