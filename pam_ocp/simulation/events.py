"""Events: where a quantity of a simulation crosses zero (slack, a wall, a limit), found exactly.

The crossing is bracketed on the simulation's grid and located by bisection on the
integrator itself; from there the integration starts anew, so that no step crosses a kink.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.signals import PiecewisePolynomial
from ..core.trajectory import Event
from ..plants.plant import Plant
from .integrate import Integration

__all__ = ["integrate_with_events"]

Array: TypeAlias = NDArray[np.float64]

TIME_TOLERANCE = 1e-11
"""A crossing is located to this [s]; the integrator's own error comes on top."""
MAX_EVENTS = 10_000


class _Crossings:
    """The watched expressions as functions of time and state."""

    def __init__(self, plant: Plant, names: tuple[str, ...], u: PiecewisePolynomial) -> None:
        self.plant, self.u = plant, u
        self.names = tuple(n if n.startswith("der(") else plant.variable(n).name for n in names)
        expressions = ca.vertcat(*(plant.expression(n) for n in self.names))
        self.function = ca.Function("events", [plant.x, plant.u, plant.p], [expressions])
        self.parameters = plant.vector("parameter")

    def __call__(self, t: Array, states: Array) -> Array:
        """Values (number of times, number of names)."""
        values = self.function(states.T, self.u(t).T, self.parameters)
        table: Array = np.asarray(values, dtype=float).reshape(len(self.names), len(t))
        return np.ascontiguousarray(table.T)


def integrate_with_events(
    run: Integration, names: tuple[str, ...]
) -> tuple[Array | None, tuple[Event, ...], int]:
    """States over the grid of ``run``, the crossings of ``names``, and the intervals that
    succeeded.

    The states are None when the integrator gave up; the number then says how far it came.
    """
    crossings = _Crossings(run.plant, names, run.u)
    grid = run.grid
    rows = [run.x0[None, :]]
    events: list[Event] = []
    start, x, k = float(grid[0]), run.x0, 0  # integrating from ``start`` inside interval k
    sign = np.sign(crossings(grid[:1], x[None, :])[0])
    while k < len(grid) - 1:
        times = np.concatenate([[start], grid[k + 1 :]])
        ahead = run.u.breaks > start + 1e-12 * (1 + abs(start))
        part = replace(
            run, grid=times, x0=x, u=run.u.shifted(np.append(start, run.u.breaks[ahead]))
        )
        states = part()
        usable = states if states is not None else part(part.longest)
        assert usable is not None
        values = crossings(times[: len(usable)], usable)
        unsure = sign == 0  # a start on the border: the side it leaves to
        sign = np.where(unsure & (len(values) > 1), np.sign(values[min(1, len(values) - 1)]), sign)
        changed = (np.sign(values[1:]) * sign < 0).any(axis=1)
        first = int(np.argmax(changed)) if changed.any() else len(usable) - 1
        rows.append(usable[1 : first + 1])
        k += first
        if not changed.any():
            return (None if states is None else np.vstack(rows)), tuple(events), k
        start, x, which = _located(crossings, part, times, usable, first, sign)
        for i in which:
            events.append(Event(start, crossings.names[i], bool(sign[i] < 0)))
            sign[i] = -sign[i]
        if len(events) > MAX_EVENTS:
            return None, tuple(events), k
    return np.vstack(rows), tuple(events), k


def _located(
    crossings: _Crossings, part: Integration, times: Array, states: Array, k: int, sign: Array
) -> tuple[float, Array, list[int]]:
    """Time and state just behind the first crossing in (times[k], times[k + 1]],
    and which crossed.
    """
    low, a, b = float(times[k]), float(times[k]), float(times[k + 1])
    x_b = states[k + 1]
    while b - a > TIME_TOLERANCE:
        middle = (a + b) / 2
        x = part.advance(low, states[k], middle)
        if (crossings(np.array([middle]), x[None, :])[0] * sign < 0).any():
            b, x_b = middle, x
        else:
            a = middle
    value = crossings(np.array([b]), x_b[None, :])[0]
    return b, x_b, [int(i) for i in np.flatnonzero(value * sign < 0)]
