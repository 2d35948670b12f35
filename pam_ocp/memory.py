"""What states with memory hold at rest: with hysteresis rest is a continuum, and a point is chosen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

import numpy as np

from .errors import InputError
from .plant.plant import Plant
from .plant.stillness import resting

__all__ = ["Memory", "held", "held_names"]

Memory: TypeAlias = 'Literal["virgin", "above", "below"] | Mapping[str, float]'

SIDES = {"above": -1.0, "below": 1.0}
"""Way in which the positions moved before they came to rest."""


def held_names(plant: Plant) -> tuple[str, ...]:
    """The states that keep at rest whatever the past has left in them."""
    return tuple(v.name for v in plant.states if v.memory == "held")


def held(plant: Plant, memory: Memory = "virgin") -> dict[str, float]:
    """{state: value} of all held memories of a plant at rest.

    memory : "virgin" (start values: nothing has slid yet), "above" or "below" (the side from which
        all positions came, from afar: every element has slid fully), or {state: value}, the rest
        virgin. The way in which a position drives a memory is read off the plant's Jacobian.

    Raises InputError for another word, a name that is no held memory, or a value out of its range.
    """
    variables = {name: plant.variable(name) for name in held_names(plant)}
    found = {name: float(v.start or 0.0) for name, v in variables.items()}
    if isinstance(memory, Mapping):
        for name, value in memory.items():
            variable = plant.variable(name)
            if variable.name not in found:
                known = ", ".join(found) or "none"
                raise InputError(f"memory: {name} is no state with a held memory; known: {known}")
            found[variable.name] = variable.check(value, "memory")
        return found
    if memory not in ("virgin", *SIDES):
        raise InputError(
            f"memory = {memory!r}: choose 'virgin', 'above', 'below', or give {{state: value}}"
        )
    if memory == "virgin" or not found:
        return found
    names = [v.name for v in plant.states]
    x = plant.vector("state")
    for name, variable in variables.items():
        x[names.index(name)] = (variable.min + variable.max) / 2
    slopes = np.asarray(plant.jacobians(x, plant.vector("input"), plant.vector("parameter"))[0])
    positions = resting(plant)
    places = [names.index(q.name) for q in positions]
    velocities = sorted({names.index(v) for q in positions for v in q.velocities})
    wanted = SIDES[memory] * np.array([plant.variable(q.name).nominal for q in positions])
    way = np.linalg.pinv(slopes[np.ix_(places, velocities)]) @ wanted
    drives = slopes[:, velocities] @ way
    for name, variable in variables.items():
        drive = drives[names.index(name)]
        if drive:
            found[name] = variable.max if drive > 0 else variable.min
    return found
