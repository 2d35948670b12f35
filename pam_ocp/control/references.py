"""References: what is to be reached when; of a position also its velocity and acceleration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from ..core.errors import InputError, require_finite, require_positive
from ..core.quantities import known_keys, quantity

Reference: TypeAlias = Callable[[float], tuple[float, float, float]]
"""t [s] -> (position, velocity, acceleration)."""
Source: TypeAlias = Callable[[float], float]
"""t [s] -> value [SI]."""
LATE = 1e-9
"""[s]. A sample that rounding puts this little before a switch belongs behind it."""


def visits(
    stops: Sequence[Any],
    dwell: Any = 0.4,
    rest: Any = None,
    rest_from: Any = np.inf,
    *,
    unit: str = "",
    argument: str = "visits",
) -> Source:
    """Stops that follow each other, again and again, each held for ``dwell`` [s].

    rest : value from the time ``rest_from`` [s] on; by default the last stop. Values are numbers
    in SI, or texts with a unit that measures ``unit``.
    """
    values = [require_finite(f"{argument}.stops", s, unit) for s in stops]
    if not values:
        raise InputError(f"{argument}: give stops = [...], or one value")
    span = require_positive(f"{argument}.dwell", quantity(f"{argument}.dwell", dwell, "s"), "s")
    until = quantity(f"{argument}.rest_from", rest_from, "s")
    last = values[-1] if rest is None else require_finite(f"{argument}.rest", rest, unit)

    def at(t: float) -> float:
        return last if t >= until - LATE else values[int((t + LATE) // span) % len(values)]

    return at


def source(argument: str, value: Any, unit: str = "", before: float | None = None) -> Source:
    """What a user may give as a value over time, as a function of time.

    value : a number or a text with a unit, a function of time [s], or {"stops": [...],
        "dwell": ...} (see :func:`visits`). before : what acts before a pair (value, time from which
        it acts); None: such a pair is refused.

    Raises InputError for anything else.
    """
    if callable(value):

        def called(t: float) -> float:
            found = value(float(t))
            if type(found) is float and math.isfinite(found):
                return found  # a message is made only where it is needed
            return require_finite(f"{argument} at t = {t:g} s", found)

        return called
    if isinstance(value, Mapping):
        known_keys(argument, value, ("stops", "dwell", "rest", "rest_from"))
        return visits(**{"stops": (), **value}, unit=unit, argument=argument)
    if before is not None and isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) != 2:
            raise InputError(f"{argument} = {value!r}: give a value, or [value, from when on]")
        size, begin = require_finite(argument, value[0], unit), quantity(argument, value[1], "s")
        return lambda t: size if t >= begin - LATE else before
    constant = require_finite(argument, value, unit)
    return lambda t: constant


def hold(value: float) -> Reference:
    """Rest at ``value``."""
    return lambda t: (value, 0.0, 0.0)


def sine(middle: float, amplitude: float, frequency: float) -> Reference:
    """middle - amplitude cos(2 pi f t): starts at its lower end without velocity.

    frequency : [Hz].
    """
    w = 2 * np.pi * require_positive("frequency", frequency, "Hz")

    def at(t: float) -> tuple[float, float, float]:
        s, c = np.sin(w * t), np.cos(w * t)
        return middle - amplitude * c, amplitude * w * s, amplitude * w**2 * c

    return at


def moves(stops: Sequence[float], begins: Sequence[float], duration: float) -> Reference:
    """From stop to stop by polynomials of degree 5 (at rest, without acceleration at each stop).

    stops : n + 1 positions; begins : n times [s] at which the moves begin; each lasts ``duration``.
    """
    duration = require_positive("duration", duration, "s")
    if len(stops) != len(begins) + 1 or any(b - a < duration for a, b in pairwise(begins)):
        raise InputError(
            f"moves: {len(stops)} stops need {len(stops) - 1} rising begins, at least duration = "
            f"{duration:g} s apart; begins = {list(begins)}"
        )

    def at(t: float) -> tuple[float, float, float]:
        i = int(np.searchsorted(begins, t, side="right")) - 1
        if i < 0:
            return stops[0], 0.0, 0.0
        s, span = min((t - begins[i]) / duration, 1.0), stops[i + 1] - stops[i]
        return (
            stops[i] + span * s**3 * (10 - 15 * s + 6 * s**2),
            span / duration * s**2 * (30 - 60 * s + 30 * s**2),
            span / duration**2 * s * (60 - 180 * s + 120 * s**2),
        )

    return at
