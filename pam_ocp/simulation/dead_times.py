"""Simulation with exact dead times: commands take effect later, as the pieces of polynomials that
they are.

No delay line is integrated. Its states are the command as it was: they are computed behind the
integration, so that the motion has the columns of one with the line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.signals import PiecewisePolynomial, joined
from ..plants.dead_time import DelayLine
from ..plants.plant import Plant
from ..plants.undelayed import without_dead_times

__all__ = ["exactly_delayed", "line_states"]

Array: TypeAlias = NDArray[np.float64]
LEVEL = 1e-6
"""States along a line differ by at most this part of their nominal where it begins at one value."""


def exactly_delayed(
    plant: Plant, u: PiecewisePolynomial, times: Array, x0: Array
) -> tuple[Plant, PiecewisePolynomial, Array, Callable[[Array], Array]]:
    """(plant without delay lines, its inputs, its initial states, states of it -> of the plant).

    u : the plant's inputs. times : of the samples; before the first, commands stood at the start
    values of their lines. Raises InputError where a line does not begin at one value.
    """
    reduced = without_dead_times(plant)
    order = [v.name for v in plant.states]
    starts = dict(zip(order, x0.tolist(), strict=True))
    begins = {line.outlet: _level(plant, line, starts) for line in plant.delay_lines}
    sources = [v.name for v in plant.inputs]

    def effect(line: DelayLine, part: float) -> PiecewisePolynomial:
        own = PiecewisePolynomial(u.breaks, u.coefficients[:, :, [sources.index(line.source)]])
        shift = part * float(plant.variable(line.time).start or 0.0)
        return _later(own, shift, begins[line.outlet], float(times[0]))

    by_outlet = {line.outlet: line for line in plant.delay_lines}
    pieces = [
        effect(by_outlet[v.name], 1.0)
        if v.name in by_outlet
        else PiecewisePolynomial(u.breaks, u.coefficients[:, :, [sources.index(v.name)]])
        for v in reduced.inputs
    ]
    kept = [order.index(v.name) for v in reduced.states]

    def whole(states: Array) -> Array:
        found = np.empty((len(times), len(order)))
        found[:, kept] = states
        for line in plant.delay_lines:
            for name, part in zip(line.states, line.dead_time.places, strict=True):
                found[:, order.index(name)] = effect(line, float(part))(times)[:, 0]
        return found

    return reduced, joined(pieces, times), x0[kept], whole


def line_states(plant: Plant, line: DelayLine, t: Array, command: Array, at: float) -> Array:
    """The states of a delay line at a moment, from samples of its command up to then (held).

    t, command : times and samples. Before the first sample the command counts as having stood.
    """
    ago = line.dead_time.places * float(plant.variable(line.time).start or 0.0)
    place = np.searchsorted(t, at - ago + 1e-12 * (1 + abs(at)), side="right") - 1
    return np.asarray(command[np.maximum(place, 0)], float)


def _level(plant: Plant, line: DelayLine, starts: dict[str, float]) -> float:
    values = np.array([starts[n] for n in line.states])
    if np.ptp(values) > LEVEL * plant.variable(line.outlet).nominal:
        raise InputError(
            f"start of {line.states[0]} .. {line.outlet} runs from {values.min():g} to "
            f"{values.max():g}: exact dead times begin with commands that stood; start all of them "
            "at one value"
        )
    return float(values[-1])


def _later(
    signal: PiecewisePolynomial, shift: float, before: float, start: float
) -> PiecewisePolynomial:
    """The signal a time later, ``before`` until its own start arrives."""
    if shift <= 0:
        return signal
    inside = signal.breaks > start
    breaks = np.concatenate([[start], signal.breaks[inside]])
    own = signal.shifted(breaks)
    first = np.zeros((1, *own.coefficients.shape[1:]))
    first[0, 0] = before
    # a piece behind the end holds the last value there
    last = np.zeros_like(first)
    last[0, 0] = own.final()
    return PiecewisePolynomial(
        np.concatenate([[start], breaks + shift, [breaks[-1] + 2 * shift]]),
        np.concatenate([first, own.coefficients, last]),
    )
