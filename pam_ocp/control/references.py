"""References: what a position is to do, with its velocity and acceleration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from ..core.errors import InputError, require_positive

__all__ = ["Reference", "hold", "moves", "sine"]

Reference: TypeAlias = Callable[[float], tuple[float, float, float]]
"""t [s] -> (position, velocity, acceleration)."""


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
    require_positive("duration", duration, "s")
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
