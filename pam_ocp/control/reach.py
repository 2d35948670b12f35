"""How far inputs go before what they move moves no faster: what a linear design does not see."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..plants.plant import Plant

__all__ = ["effort_units"]

Array: TypeAlias = NDArray[np.float64]

HALVINGS = 6
"""From a nominal value down: steps of an input that are looked at, and as many up."""
FLAT = 1.2
"""An input whose step of twice the size does less than this much more has gone far enough."""
SEEN = 2.0
"""Times nominal: a direction in which an input has less room is not asked."""
SHARE = 0.2
"""Of what an input reaches: the step that counts as one in a weight, see Weighting."""


def effort_units(plant: Plant, x: Array, u: Array, inputs: list[str]) -> Array:
    """The step of each input [SI] that a weight of one is for: its nominal value, or ``SHARE`` of
    the step from which on more of it does no more, where that is less.

    A servo valve is fully open at an error of half a bar, and a slew rate at its end; a feedback
    that asks for more than these give swings. The ends of an input's own range are not meant, nor
    what ends in one direction alone (a muscle that goes slack).
    """
    names = [v.name for v in plant.inputs]
    units = []
    for name in inputs:
        variable = plant.variable(name)
        at = names.index(name)
        room = {-1.0: u[at] - variable.min, 1.0: variable.max - u[at]}
        wide = [s for s, r in room.items() if r >= SEEN * variable.nominal]
        reach = max(_reach(plant, x, u, at, s) for s in wide or [max(room, key=lambda s: room[s])])
        units.append(min(variable.nominal, SHARE * reach))
    return np.array(units)


def _reach(plant: Plant, x: Array, u: Array, at: int, sign: float) -> float:
    """The least step of an input in one direction that a step twice as large does not surpass."""
    variable, p = plant.inputs[at], plant.vector("parameter")
    room = variable.max - u[at] if sign > 0 else u[at] - variable.min
    steps = variable.nominal * 2.0 ** np.arange(-HALVINGS, HALVINGS + 1)
    steps = steps[steps <= room]
    if len(steps) < 2:
        return np.inf
    columns = np.tile(u[:, None], len(steps) + 1)
    columns[at, 1:] += sign * steps
    here = np.tile(x[:, None], len(steps) + 1)
    rates = np.asarray(plant.function(here, columns, p)[0], dtype=float)
    sizes = plant.vector("state", attribute="nominal")[:, None]
    effect = np.linalg.norm((rates[:, 1:] - rates[:, :1]) / sizes, axis=0)
    flat = (effect[1:] < FLAT * effect[:-1]) & (effect[:-1] > 0)
    return float(steps[int(np.argmax(flat))]) if flat.any() else np.inf
