"""Columns of a force table as numbers, and whether they can be what their headers say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.plausible import MEASURED, inside_by
from .doubts import Column
from .raw import RawTable

__all__ = [
    "Series",
    "check_force",
    "check_mixed_pressure",
    "check_pressure",
    "contraction_of",
]

Array: TypeAlias = NDArray[np.float64]

LARGEST_PRESSURE = (1e3, 5e6)
"""Where the largest gauge pressure of a table may lie [Pa]; beyond, its unit is in doubt."""
LARGEST_FORCE = 1e5
"""Beyond any fluidic muscle [N]."""
CONTRACTION_RANGE = (-0.10, 0.60)
"""10 % beyond the rest length; the braid locks at 35-40 %."""


class Series:
    """A column as numbers: ``values`` as they stand, ``si`` converted."""

    def __init__(self, column: Column, raw: RawTable) -> None:
        self.column, self.raw = column, raw
        self.values = raw.numbers(column.header)
        self.si: Array = column.si(self.values)
        # what messages call the numbers that stand in the file
        self.unit = column.unit if column.plain else raw.unit(column.header) or "1"

    def shown(self, index: int) -> str:
        """``pressure 0.35 bar in row 3``."""
        name = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.column.kind} {self.values[index]:g}{name} in {self.raw.row(index)}"

    @property
    def reading(self) -> str:
        return self.column.reading


def check_pressure(pressure: Series) -> None:
    top = int(np.argmax(pressure.si))
    low = int(np.argmin(pressure.si))
    largest, smallest = pressure.si[top], pressure.si[low]
    if smallest < -max(0.02 * largest, 2e3):
        raise InputError(
            f"{pressure.shown(low)} is negative beyond noise{_from_ambient(pressure, low)}; "
            "pressures are gauge pressures >= 0"
        )
    low_end, high_end = LARGEST_PRESSURE
    if not low_end <= largest <= high_end:
        fitting = inside_by({"pressure": float(pressure.values[top])}, pressure.unit)[:2]
        guess = f"it looks like {' or '.join(fitting)}" if fitting else "that cannot be"
        remedy = fitting[0] if fitting else "bar"
        usual = float(np.median(pressure.si))
        mark = f"{pressure.values[top]:g}"
        mixed = (
            f" (half of the rows stay below {usual / 1e5:.3g} bar: where the column mixes units, "
            f"mend it; where {mark} marks a missing value, give missing=[{mark}])"
            if largest > high_end and MEASURED["pressure"].least < usual < high_end / 10
            else ""
        )
        raise InputError(
            f"the largest {pressure.shown(top)} ({pressure.reading}) is {largest / 1e5:g} bar, "
            f"outside {low_end / 1e5:g} .. {high_end / 1e5:g} bar: {guess}; "
            f"correct the header or give units={{'pressure': {remedy!r}}}{mixed}"
        )


def _from_ambient(pressure: Series, low: int) -> str:
    if not pressure.column.shift:
        return ""
    least = pressure.si[low] + pressure.column.shift
    return (
        f" (absolute, {pressure.column.shift:g} Pa taken off: give ambient_pressure={least:.0f} if "
        "that was the weather, or the unit without 'abs')"
    )


def check_mixed_pressure(pressure: Series, p: Array, force: Array, contraction: Array) -> None:
    """A muscle at its rest length or shorter cannot pull hard with next to no pressure."""
    doubtful = (p < p.max() / 500) & (force > 0.2 * force.max()) & (contraction >= 0)
    if np.any(doubtful):
        i = int(np.argmax(doubtful))
        raise InputError(
            f"{pressure.shown(i)} goes with a force of {force[i]:g} N, while other rows reach "
            f"{pressure.values.max():g} {pressure.unit}: the column mixes units"
        )


def check_force(force: Series) -> None:
    top = int(np.argmax(np.abs(force.si)))
    if abs(force.si[top]) > LARGEST_FORCE:
        fitting = inside_by({"force": float(abs(force.values[top]))}, force.unit)[:2]
        guess = f"it looks like {' or '.join(fitting)}; " if fitting else ""
        raise InputError(
            f"{force.shown(top)} ({force.reading}) is beyond any fluidic muscle "
            f"({LARGEST_FORCE:g} N): {guess}correct the header or give "
            f"units={{'force': {fitting[0] if fitting else '...'!r}}}"
        )


def contraction_of(series: Mapping[str, Series], rest_length: float | None) -> Array:
    """kappa from whichever column there is; both must agree where both are."""
    low, high = CONTRACTION_RANGE
    direct = series.get("contraction")
    if direct is not None:
        _check_contraction(direct)
    if "length" not in series:
        assert direct is not None
        return direct.si
    if rest_length is None:
        if direct is not None:
            return direct.si
        raise InputError(
            f"column {series['length'].column.header!r} holds lengths: give rest_length in metres, "
            "as in read_table(..., rest_length=0.300)"
        )
    length = series["length"]
    shortest = int(np.argmin(length.si))
    if length.si[shortest] <= 0:
        raise InputError(f"{length.shown(shortest)} must be > 0")
    kappa: Array = 1.0 - length.si / rest_length
    for i in (int(np.argmin(kappa)), int(np.argmax(kappa))):
        if not low <= kappa[i] <= high:
            side = "more than 10 % beyond" if kappa[i] < low else "far too short for"
            raise InputError(
                f"{length.shown(i)} ({length.reading}) is {side} the rest length {rest_length:g} "
                "m; check rest_length (in metres) and the unit of the lengths (mm?)"
            )
    if direct is not None:
        gap = np.abs(kappa - direct.si)
        i = int(np.argmax(gap))
        if gap[i] > 0.01:
            raise InputError(
                f"{direct.shown(i)} contradicts {length.shown(i)}, which is a contraction of "
                f"{kappa[i]:.4g} at rest_length = {rest_length:g} m; correct one of them"
            )
    return kappa


def _check_contraction(contraction: Series) -> None:
    low, high = CONTRACTION_RANGE
    size = np.abs(contraction.si)
    worst = int(np.argmax(size))
    if size[worst] > 1:
        raise InputError(
            f"{contraction.shown(worst)} ({contraction.reading}) is beyond 1: it looks like "
            "percent; give units={'contraction': '%'}"
        )
    if 0 < size[worst] < 0.006 and contraction.unit == "%":
        raise InputError(
            f"the largest {contraction.shown(worst)} is next to nothing: it looks like a fraction; "
            "correct the header or give units={'contraction': '1'}"
        )
    for i in (int(np.argmin(contraction.si)), int(np.argmax(contraction.si))):
        if not low <= contraction.si[i] <= high:
            raise InputError(
                f"{contraction.shown(i)} is outside {low * 100:g} .. {high * 100:g} %; "
                "contraction is (rest length - length)/rest length, positive when shorter"
            )
