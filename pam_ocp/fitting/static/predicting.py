"""Predictions of a fitted law: places as users write them, and how far the data reach."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import AMBIENT
from ...core.errors import InputError, require_numbers
from ...core.plausible import meant_within, outside
from ...muscles.validity import ValidityWarning
from ..statistics import Array, Prediction
from ..tables.force_table import ForceTable

__all__ = ["beyond", "places", "pulling"]

MARGIN = 0.02
"""Of the range of the data: so far beyond their hull a place still counts as within."""
REACH = (-1.0, 1.0)
"""Contraction ratios: no muscle is stretched to twice its length, or contracts to nothing."""


def places(p: Any, kappa: Any) -> tuple[Array, Array]:
    """Gauge pressures [Pa] and contractions, broadcast: numbers, or texts as "3 bar" and "10 %".

    Warns (UnitWarning) where another unit was probably meant. Raises InputError for what no muscle
    can be.
    """
    pressure = np.asarray(require_numbers("p", p, "Pa", doubted=True))
    kappas = np.asarray(require_numbers("kappa", kappa, "1"))
    low = pressure < -AMBIENT
    if low.any():
        raise InputError(
            f"p = {pressure[low].flat[0]:g} Pa lies below vacuum: give gauge pressures, from "
            f"{-AMBIENT:g} Pa"
        )
    bad = (kappas <= REACH[0]) | (kappas >= REACH[1])
    if bad.any():
        value = float(kappas[bad].flat[0])
        raise InputError(
            f"kappa = {value:g} is no contraction ratio of a muscle: give (l0 - l)/l0 between "
            f"{REACH[0]:g} and {REACH[1]:g}{meant_within(value, '1', 0.0, 0.6)}"
        )
    try:
        both = np.broadcast_arrays(pressure, kappas)
    except ValueError:
        raise InputError(
            f"p has shape {pressure.shape}, kappa {kappas.shape}: give one of each, or arrays that "
            "broadcast"
        ) from None
    return both[0], both[1]


def beyond(table: ForceTable, p: Array, kappa: Array) -> NDArray[np.bool_]:
    """Which places lie outside the convex hull of a table's cells, slack ones included; warns."""
    cells = np.stack([table.pressure, table.contraction], axis=1)
    low, span = cells.min(axis=0), np.ptp(cells, axis=0)
    scale = np.where(span > 0, span, np.array([0.02 * max(abs(low[0]), 1.0), 0.005]))
    asked = (np.stack([p.ravel(), kappa.ravel()], axis=1) - low) / scale
    normals = _hull((cells - low) / scale)
    found = np.any(asked @ normals[:, :2].T + normals[:, 2] > MARGIN, axis=1).reshape(p.shape)
    if found.any():
        high = low + span
        warnings.warn(
            f"{int(found.sum())} of {found.size} predictions lie outside of the data (p "
            f"{low[0] / 1e5:.3g} to {high[0] / 1e5:.3g} bar, kappa {100 * low[1]:.3g} to "
            f"{100 * high[1]:.3g} %, and not every pair of these): the band holds for the law, and "
            "nothing says that the law holds there (prediction.outside says where)",
            ValidityWarning,
            stacklevel=outside(),
        )
    return np.asarray(found)


def _hull(points: Array) -> Array:
    """Half planes (m, 3), n.x + d <= 0 within; those of the box for points on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(ConvexHull(points).equations)
    except (QhullError, ValueError):
        low, high = points.min(axis=0), points.max(axis=0)
        sides = [[-1, 0, low[0]], [1, 0, -high[0]], [0, -1, low[1]], [0, 1, -high[1]]]
        return np.array(sides, dtype=float)


def pulling(
    force: Array,
    stderr: Array,
    confidence: tuple[Array, Array],
    prediction: tuple[Array, Array],
    level: float,
    away: NDArray[np.bool_],
) -> Prediction:
    """What a law and its bands say of a muscle, which is slack where they are below zero."""

    def up(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        return np.asarray(np.maximum(pair[0], 0.0)), np.asarray(np.maximum(pair[1], 0.0))

    slack = np.asarray(force <= 0)
    pull = np.asarray(np.maximum(force, 0.0))
    return Prediction(pull, stderr, up(confidence), up(prediction), level, slack, away)
