"""Where the states begin that nobody measured: pressures, spools, heat, creep, slip.

Each record gets a start of its own for them, estimated with all else. Runs from moments in the
middle of a record begin where the plant has brought these states by then, along the measured
inputs, the measured states set to what was measured at each start.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import casadi as ca
import numpy as np

from ...numerics.rosenbrock import ros2
from ...plants.plant import Plant
from ..statistics import Array
from .runs import Runs

__all__ = ["hidden_states", "settled_starts"]

SETTLING = np.concatenate([2e-3 * 2.0 ** np.arange(12), np.full(8, 0.5)])
"""Steps [s] of rest before a record: 12 s in all."""


def hidden_states(
    plant: Plant, measured: Sequence[str], known: Collection[str], whole: bool
) -> list[int]:
    """Positions of the states whose starts are found by default: those that were not measured and
    are not ``known``; of ``whole`` records all, as one sample's noise would count in all of it.
    """
    given = set(known)
    if not whole:
        given |= {*measured, *(v for q, v in plant.positions.items() if q in measured)}
    return [i for i, v in enumerate(plant.states) if v.name not in given]


def settled_starts(plant: Plant, runs: Runs, records: int, places: Sequence[int]) -> Array:
    """Guesses (records, len(places)): the measured states and their velocities as at the first run
    of a record, the others at rest under its first inputs; at the plant's start values where they
    do not come to rest.
    """
    order = [v.name for v in plant.states]
    seen = {*runs.names, *(v for q, v in plant.positions.items() if q in runs.names)}
    loose = [i for i, n in enumerate(order) if n not in seen]
    x, u, h = ca.SX.sym("x", len(order)), ca.SX.sym("u", len(plant.inputs)), ca.SX.sym("h")
    p = ca.SX(plant.vector("parameter"))
    own = ca.SX.sym("own", len(loose))

    def rates(part: ca.SX) -> ca.SX:
        every = ca.SX(x)
        every[loose] = part
        return plant.function(every, u, p)[0][loose]

    after = ros2(lambda q: (rates(q), ca.jacobian(rates(q), q)), rates, own, h)
    step = ca.Function("settle", [own, x, u, h], [after])
    low, high = (plant.vector("state", attribute=a) for a in ("min", "max"))
    found = np.empty((records, len(places)))
    for r in range(records):
        rows = np.nonzero(runs.record == r)[0]
        if not rows.size:
            found[r] = plant.vector("state")[list(places)]
            continue
        first = rows[np.argmin(runs.first[rows])]
        begin = runs.x0[first].copy()
        part = begin[loose]
        for length in SETTLING if loose else ():
            now = runs.inputs[r].u[int(runs.first[first])]
            part = np.asarray(step(part, begin, now, length)).ravel()
        if np.all(np.isfinite(part)) and np.all((part >= low[loose]) & (part <= high[loose])):
            begin[loose] = part
        found[r] = np.clip(begin, low, high)[list(places)]
    return found
