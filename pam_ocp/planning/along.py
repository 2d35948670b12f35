"""A plan's replay in a few sweeps: its motion, and expressions at all its points by NumPy.

A re-solve looks at thousands of points; CasADi's map over them, and the conversions to it and back,
took as long as the solver. What is evaluated is kept with the plant's expressions, so neighbours of
a plan find it ready.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.signals import signals
from ..core.trajectory import Trajectory
from ..numerics.columns import Columns
from ..plants.plant import Plant
from ..simulation.integrate import Integration
from ..simulation.simulator import evaluated, simulate
from .problem.problem import Problem

__all__ = ["PlantColumns", "moved", "values_along"]

Array: TypeAlias = NDArray[np.float64]

KEPT = 8
"""Expressions that are kept ready for a plant at a time."""


class PlantColumns:
    """A plant's rates and outputs at many points."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def _of(self, which: int) -> Columns:
        plant = self._plant

        def build() -> Columns:
            arguments = [plant.x, plant.u, plant.p]
            return Columns(arguments, plant.function(*arguments)[which])

        found: Columns = plant.cached(("columns", which), build)
        return found

    def rates(self, x: Array, u: Array, p: Array) -> Array:
        """(nx, n) x' [SI] at states (nx, n), inputs (nu, n) and parameters (np,)."""
        return self._of(0)(x, u, p)

    def outputs(self, x: Array, u: Array, p: Array) -> Array:
        """(n, ny) outputs at states (n, nx), inputs (n, nu) and parameters (np,)."""
        y: Array = self._of(1)(x.T, u.T, p).T
        return y


def moved(plant: Plant, samples: Trajectory, times: Array, rtol: float) -> Trajectory:
    """The motion from the first of the samples under their inputs, at ``times``.

    Raises SimulationError as :func:`simulate`, of which this is the default way.
    """
    u = signals(plant, samples, times, "previous")
    # a solver may leave the range by rounding; start values are held to it elsewhere
    start = {v.name: float(np.clip(samples[v.name][0], v.min, v.max)) for v in plant.states}
    run = Integration.over(plant, u, times, plant.vector("state", start), rtol=rtol)
    states = run()
    if states is None:
        return simulate(plant, samples, t=times, rtol=rtol)  # which says how far it came
    return evaluated(plant, times, run.at(times, states), u, machine=PlantColumns(plant))


def values_along(
    problem: Problem, plant: Plant, expressions: Sequence[ca.SX], arguments: tuple[Array, ...]
) -> Array:
    """(expressions, n) values at (x, u, p, t, r, q, m), the arguments of a Problem's functions."""
    symbols = [plant.x, plant.u, plant.p, *problem.given]
    kept: OrderedDict[tuple[int, ...], Columns] = plant.cached(("columns along",), OrderedDict)
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *expressions))
    every = (*ca.vertsplit(column), *(e for s in problem.given for e in ca.vertsplit(s)))
    key = tuple(e.element_hash() for e in every)
    if key not in kept:
        kept[key] = Columns(symbols, column)
        while len(kept) > KEPT:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key](*arguments)
