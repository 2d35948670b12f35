"""Cells that hold a number with its unit: ``1 bar``, ``300mm``, ``12,5 %``.

The unit goes to the column, so that the rest of reading sees plain numbers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.calibration import spelled
from ...core.errors import InputError
from .cells import decimal_of, is_empty, is_number
from .headers import is_unit, parse_header

__all__ = ["parted", "without_units"]

_PARTED = re.compile(
    r"(?P<number>[+-]?[\d.,'’ \u00a0\u202f]*\d(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\W\d_]\D*\d?|[%°].*)$"
)
MOSTLY = 0.6
"""Share of a column's cells that must be so written for it to be one of numbers with units."""


def parted(cell: Any) -> tuple[str, str] | None:
    """(number, unit) of a cell that holds both; None of any other."""
    if not isinstance(cell, str):
        return None
    text = cell.strip()
    match = None if any(is_number(text, d) for d in ".,") else _PARTED.match(text)
    if match is None or not is_unit(match["unit"]):
        return None
    number = match["number"].strip()
    return (number, match["unit"].strip()) if any(is_number(number, d) for d in ".,") else None


def without_units(
    label: str,
    columns: Mapping[int, Sequence[Any]],
    places: Sequence[Any],
    headers: Mapping[int, str] | None = None,
) -> tuple[dict[int, list[Any]], dict[int, str], str | None]:
    """(columns of plain numbers, their units, decimal sign) of those columns whose cells name a
    unit; the others are not in it. A bare number has the unit of the others.

    places : of each row, for messages. Raises InputError where one column mixes units.
    """
    found: dict[int, list[Any]] = {}
    units: dict[int, str] = {}
    for i, cells in columns.items():
        filled = [c for c in cells if not is_empty(c)]
        sample = filled[:: max(1, len(filled) // 50)]
        if sum(parted(c) is not None for c in sample) < MOSTLY * max(len(sample), 1):
            continue
        found[i], units[i] = _plain(label, (headers or {}).get(i, f"column {i + 1}"), cells, places)
    numbers = [c for cells in found.values() for c in cells]
    return found, units, decimal_of(numbers) if numbers else None


def _plain(
    label: str, header: str, cells: Sequence[Any], places: Sequence[Any]
) -> tuple[list[Any], str]:
    said = parse_header(header)[1]
    first: tuple[str, Any] | None = None if said is None else (said, "the header")
    made: list[Any] = []
    for cell, place in zip(cells, places, strict=True):
        two = parted(cell)
        made.append(cell if two is None else two[0])
        if two is None:
            continue
        if first is None:
            first = two[1], f"line {place}"
        elif spelled(two[1]) != spelled(first[0]):
            raise InputError(
                f"{label}: column {header!r} mixes units: {first[0]} in {first[1]}, {two[1]} in "
                f"line {place}; write all of a column in one unit"
            )
    assert first is not None
    return made, first[0]
