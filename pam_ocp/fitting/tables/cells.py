"""Cells as people write them: numbers with points or commas, empty ones, stamps of time."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import date, datetime
from datetime import time as clock_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import spelled
from ...core.errors import InputError
from .headers import is_unit, parse_header

__all__ = [
    "decimal_of",
    "is_empty",
    "is_number",
    "is_stamp",
    "number",
    "numbers_of",
    "parted",
    "without_units",
]

_EMPTY = """
    nan na n/a n.a. k.a. #n/a #nv #na #n/d <na> nat null none nil missing - -- --- nan(ind)
    -nan(ind) nan(snan) +nan -nan 1.#qnan -1.#qnan 1.#ind -1.#ind 1.#inf -1.#inf #div/0! #value!
    #wert! #num! #zahl! #ref! #bezug! over overload overrange overflow underrange ol +ol -ol error
    err fault invalid nodata bad ? ??? * *** #### ##### ######
    """
EMPTY = frozenset(_EMPTY.split()) | {""}
"""What stands in a cell that holds no reading, in lower case."""
_BLANKS = "’' \u00a0\u202f"
_INFINITE = ("inf", "-inf", "+inf", "infinity", "-infinity")


def _written(decimal: str, group: str) -> re.Pattern[str]:
    grouped = rf"[1-9]\d{{0,2}}(?:[{group}{_BLANKS}]\d{{3}})+"
    sign = re.escape(decimal)
    return re.compile(
        rf"[+-]?(?:{grouped}|\d+|(?={sign}\d))(?:{sign}\d*)?(?:[eEdD][+-]?\d+)?$", re.ASCII
    )


_NUMBERS = {".": _written(".", ","), ",": _written(",", ".")}
"""Decimal sign: numbers written with it, thousands in groups allowed."""
_STAMP = re.compile(
    r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}([T ]+\d{1,2}:\d{2}.*)?$"
    r"|\d{1,2}[-/.]\d{1,2}[-/.]\d{2,4}([T ,]+\d{1,2}:\d{2}.*)?$"
    r"|\d{1,3}:\d{2}(:\d{2})?([.,:]\d+)?( ?[AP]M)?$",
    re.IGNORECASE,
)


def is_empty(cell: Any) -> bool:
    """Whether a cell holds nothing, or says so."""
    if cell is None:
        return True
    if isinstance(cell, str):
        return cell.strip().lower() in EMPTY
    return isinstance(cell, float) and cell != cell


def is_stamp(cell: Any) -> bool:
    """Whether a cell is a date, a time of day, or both."""
    if isinstance(cell, datetime | date | clock_time | np.datetime64):
        return True
    return isinstance(cell, str) and _STAMP.match(cell.strip()) is not None


def is_number(cell: Any, decimal: str = ".") -> bool:
    if isinstance(cell, bool | np.bool_):
        return True
    if isinstance(cell, str):
        return (
            _NUMBERS[decimal].match(cell.strip()) is not None or cell.strip().lower() in _INFINITE
        )
    return isinstance(cell, int | float | np.integer | np.floating)


def number(cell: Any, decimal: str = ".") -> float:
    """The number in a cell; NaN where it is empty. Raises ValueError, TypeError, OverflowError."""
    if not isinstance(cell, str):
        return float("nan") if cell is None else float(cell)
    text = cell.strip()
    if text.lower() in EMPTY:
        return float("nan")
    if _NUMBERS[decimal].match(text) is None:
        if text.lower() in _INFINITE:
            return float(text)
        raise ValueError(f"{text!r} is no number")
    text = re.sub(f"[{_BLANKS}]", "", text).replace("D", "e").replace("d", "e")
    text = text.replace("," if decimal == "." else ".", "")
    return float(text.replace(",", "."))


def numbers_of(cells: Sequence[Any], decimal: str = ".") -> tuple[NDArray[np.float64], int | None]:
    """(numbers with NaN for empty cells, index of the first that is no number or None)."""
    plain = cells
    if decimal == "," and not any("." in c for c in cells if isinstance(c, str)):
        plain = [c.replace(",", ".") if isinstance(c, str) else c for c in cells]
    if decimal == "." or plain is not cells:
        try:  # all at once, where every cell is a plain number
            return np.array(plain, dtype=float).reshape(len(cells)), None
        except (TypeError, ValueError, OverflowError):
            pass
    found = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            found[i] = number(cell, decimal)
        except (TypeError, ValueError, OverflowError):
            return found, i
    return found, None


def decimal_of(cells: Iterable[Any]) -> str:
    """The decimal sign of text cells: a comma where more of them are numbers with it."""
    points = commas = signs = 0
    for cell in cells:
        if not isinstance(cell, str):
            continue
        text = cell.strip()
        point, comma = (_NUMBERS[d].match(text) is not None for d in ".,")
        points, commas = points + point, commas + comma
        signs += ("," in text) if point and comma else 0
    return "," if commas > points or (commas == points and signs) else "."


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
