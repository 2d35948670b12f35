"""Where the solver starts: minimum-jerk paths between the stops, or a solution on another mesh."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..signals import PiecewisePolynomial
from .mesh import Mesh, radau
from .problem import Problem

__all__ = ["Unpacked", "initial_guess"]

Array: TypeAlias = NDArray[np.float64]
Signal: TypeAlias = Callable[[Array], Array]
Unpacked: TypeAlias = tuple[Array, Array, PiecewisePolynomial, Array]
"""(times, states, inputs, durations), as Program.unpack gives them."""


def initial_guess(
    problem: Problem, mesh: Mesh, time_nominals: Array, previous: Unpacked | None
) -> Array:
    """Scaled w of a program: by the user's stops, or along a previous solution."""
    plant = problem.plant
    x_nominal = plant.vector("state", attribute="nominal")
    u_nominal = plant.vector("input", attribute="nominal")
    durations, states_at, inputs_at = (
        _by_stops(problem, time_nominals) if previous is None else _along(previous)
    )
    parts, begin = [states_at(np.array([0.0])).ravel() / x_nominal], 0.0
    for interval in mesh.intervals:
        h = float(durations[interval.phase] * interval.fraction)
        parts.append((states_at(begin + h * radau(interval.degree)) / x_nominal).ravel())
        nodes = interval.nodes(mesh.control)
        inside = begin + h * np.clip(nodes, 1e-6, 1 - 1e-6)  # this side of a jump
        parts.append((inputs_at(inside) / u_nominal).ravel())
        begin += h
    return np.concatenate([*parts, durations / time_nominals])


def _along(previous: Unpacked) -> tuple[Array, Signal, Signal]:
    """(durations, states, inputs) of a solution."""
    times, table, signals, durations = previous

    def states(t: Array) -> Array:
        return np.column_stack([np.interp(t, times, column) for column in table.T])

    return durations, states, signals


def _by_stops(problem: Problem, durations: Array) -> tuple[Array, Signal, Signal]:
    """(durations, states, inputs): minimum-jerk paths between the stops, all else at its start."""
    plant = problem.plant
    names = [v.name for v in plant.states]
    ends = np.concatenate([[0.0], np.cumsum(durations)])

    def inputs(t: Array) -> Array:
        return np.tile(plant.vector("input"), (len(t), 1))

    def states(t: Array) -> Array:
        table = np.tile(plant.vector("state"), (len(t), 1))
        for name in names:
            start = plant.variable(name).start or 0.0
            targets = [_middle(stop.get(name), start) for stop in problem.stops]
            for i, (a, b) in enumerate(pairwise(targets)):
                inside = (t >= ends[i]) & (t <= ends[i + 1] * (1 + 1e-12))
                s = np.clip((t[inside] - ends[i]) / durations[i], 0.0, 1.0)
                table[inside, names.index(name)] = a + (b - a) * s**3 * (10 - 15 * s + 6 * s**2)
                velocity = plant.positions.get(name)
                if velocity is not None:
                    speed = (b - a) * 30 * s**2 * (1 - s) ** 2 / durations[i]
                    table[inside, names.index(velocity)] = speed
        return table

    return durations, states, inputs


def _middle(value: object, default: float) -> float:
    if value is None:
        return default
    if isinstance(value, list | tuple):
        ends = [v for v in value if v is not None and np.isfinite(v)]
        return float(np.mean(ends)) if ends else default
    return float(value)  # type: ignore[arg-type]
