"""Times as they are written: seconds, dates, times of day, days of a spreadsheet, epochs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, datetime
from datetime import time as clock_time
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from .cells import is_empty, is_stamp
from .headers import parse_header

__all__ = ["DAYS", "in_days", "in_round_days", "joined", "seconds_of_numbers", "seconds_of_stamps"]

Array: TypeAlias = NDArray[np.float64]

DAY = 86400.0
DATES = frozenset(
    {"date", "datetime", "date time", "timestamp", "time stamp", "datum", "zeitstempel"}
    | {"datum uhrzeit", "messzeit"}
)
"""Names of columns in which numbers may be a spreadsheet's days."""
DAYS = {"days of a spreadsheet": (20_000.0, 80_000.0), "days of MATLAB": (7.1e5, 7.6e5)}
"""(from, to) of numbers that are days of the years around 2000."""
EPOCHS = {
    "counted from 1970 in s": (1e8, 1e11, 1.0),
    "counted from 1970 in ms": (1e11, 1e14, 1e-3),
    "counted from 1970 in us": (1e14, 1e17, 1e-6),
    "counted in 100 ns (Windows, .NET)": (1e17, 7e17, 1e-7),
    "counted from 1970 in ns": (7e17, 1e20, 1e-9),
}
"""(from, to, seconds per count) of numbers that count from a year long ago."""
SHORTEST = 1e-5
"""Steps of days that would be seconds are shorter than this [s]."""
_TIME = (
    r"(?P<h>\d{1,3}):(?P<m>\d{2})(?::(?P<s>\d{2}))?(?:[.,:](?P<f>\d+))?"
    r"\s*(?P<half>[APap][Mm])?"
    r"\s*(?:Z|UTC|(?P<zone>[+-]\d{2}(?::?\d{2})?)|(?P<called>[A-Z]{3,4}))?(?:\[[\w/+-]+\])?"
)
_YEAR_FIRST = re.compile(
    rf"(?P<y>\d{{4}})[-/.](?P<a>\d{{1,2}})[-/.](?P<b>\d{{1,2}})(?:[T ,]+{_TIME})?$"
)
_YEAR_LAST = re.compile(
    rf"(?P<a>\d{{1,2}})(?P<sign>[-/.])(?P<b>\d{{1,2}})[-/.](?P<y>\d{{2,4}})(?:[T ,]+{_TIME})?$"
)
ZONES = {
    **{"GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2},
    **{"EET": 2, "EEST": 3, "EST": -5, "EDT": -4, "CDT": -5, "MST": -7, "MDT": -6},
    **{"PST": -8, "PDT": -7, "JST": 9},
}
"""Hours ahead of UTC of zones that are called by one name only."""
_OF_DAY = re.compile(_TIME + "$")


def seconds_of_stamps(cells: Sequence[Any], place: Any) -> tuple[Array, str]:
    """(seconds since the first stamp with NaN for empty cells, what they are) of dates or times.

    place : a function of the index, for messages. Raises InputError for a cell that is none.
    """
    parsed = [None if is_empty(c) else _parsed(c) for c in cells]
    for i, (cell, one) in enumerate(zip(cells, parsed, strict=True)):
        if one is None and not is_empty(cell):
            raise InputError(f"{place(i)} holds {str(cell)[:40]!r}, which is no time")
    there = [p for p in parsed if p is not None]
    month_first = _month_first(there)
    try:
        since = int(_seconds(there[0], month_first) // DAY) if there and there[0][0] else 0
        t = np.array([np.nan if p is None else _seconds(p, month_first, since) for p in parsed])
    except (ValueError, OverflowError) as error:
        raise InputError(f"{place(0)}: the dates cannot be read ({error})") from None
    if all(p[0] is None for p in there):
        known = np.nonzero(~np.isnan(t))[0]
        turns = np.concatenate([[0.0], np.cumsum(np.diff(t[known]) < -DAY / 2)])
        t[known] += DAY * turns
        kind = "times of day"
    else:
        order = {None: "", True: ", month first", False: ", day first"}[month_first]
        kind = f"dates{order}"
    first = next((float(v) for v in t if not np.isnan(v)), 0.0)
    return t - first, kind


_Stamp: TypeAlias = tuple[tuple[int, int, int, str] | None, float]
"""(year, two numbers, sign between them; None without a date), seconds of the day."""


def _parsed(cell: Any) -> _Stamp | None:
    if isinstance(cell, np.datetime64):
        cell = str(cell)
    if isinstance(cell, datetime):
        seconds = 3600 * cell.hour + 60 * cell.minute + cell.second + 1e-6 * cell.microsecond
        seconds += 1e-9 * getattr(cell, "nanosecond", 0)  # of pandas
        ahead = cell.utcoffset()
        seconds -= ahead.total_seconds() if ahead is not None else 0.0
        return (cell.year, cell.month, cell.day, "y"), seconds
    if isinstance(cell, date):
        return (cell.year, cell.month, cell.day, "y"), 0.0
    if isinstance(cell, clock_time):
        return None, 3600 * cell.hour + 60 * cell.minute + cell.second + 1e-6 * cell.microsecond
    text = str(cell).strip()
    match = _YEAR_FIRST.match(text)
    if _unknown_zone(text):
        return None
    if match:
        return (int(match["y"]), int(match["a"]), int(match["b"]), "y"), _of_day(match)
    match = _YEAR_LAST.match(text)
    if match:
        year = int(match["y"]) + (2000 if len(match["y"]) == 2 else 0)
        return (year, int(match["a"]), int(match["b"]), match["sign"]), _of_day(match)
    match = _OF_DAY.match(text)
    return (None, _of_day(match)) if match else None


def _unknown_zone(text: str) -> bool:
    name = re.search(r"\d\s*([A-Z]{3,4})(?:\[.*)?$", text)
    return name is not None and name[1] not in (*ZONES, "UTC")


def _of_day(match: re.Match[str]) -> float:
    if match["h"] is None:
        return 0.0
    h, m, s = int(match["h"]), int(match["m"]), int(match["s"] or 0)
    fraction = float(f"0.{match['f']}") if match["f"] else 0.0
    if match["s"] is None and match["f"] and match.re is _OF_DAY:  # minutes and seconds
        h, m, s = 0, h, m
    if match["half"]:
        h = h % 12 + (12 if match["half"].lower() == "pm" else 0)
    if match["called"]:
        return 3600 * (h - ZONES[match["called"]]) + 60 * m + s + fraction
    zone = (match["zone"] or "").replace(":", "").ljust(5, "0") if match["zone"] else ""
    ahead = int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:])) if zone else 0
    return 3600 * h + 60 * m + s + fraction - ahead


def _month_first(stamps: Sequence[_Stamp]) -> bool | None:
    """Whether 3/4/2024 is the fourth of March; None where the year stands first."""
    dates = {d for d, _ in stamps if d is not None and d[3] != "y"}
    if not dates:
        return None
    if any(d[3] == "." for d in dates) or any(d[1] > 12 for d in dates):
        return False
    if any(d[2] > 12 for d in dates):
        return True
    # both can be: a record runs through neighbouring days, not through neighbouring months
    return len({d[1] for d in dates}) < len({d[2] for d in dates})


def _seconds(stamp: _Stamp, month_first: bool | None, since: int = 0) -> float:
    """Seconds since the beginning of a day, by its number: of days long ago they lose digits."""
    if stamp[0] is None:
        return stamp[1]
    year, a, b, sign = stamp[0]
    month, day = (a, b) if sign == "y" or month_first else (b, a)
    return (date(year, month, day).toordinal() - since) * DAY + stamp[1]


def seconds_of_numbers(
    values: Array, header: str, said: str | None, *, settled: bool = False
) -> tuple[Array, str]:
    """(times, what was made of them) of numbers in seconds, or without a unit.

    settled : they are seconds, since 1970 at most.
    """
    known = values[~np.isnan(values)]
    if known.size < 2:
        return values, ""
    low, high = float(known.min()), float(known.max())
    steps = np.abs(np.diff(known))
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for kind, (least, most) in DAYS.items():
        fine = 0 < step < (0.01 if in_days(header) else SHORTEST) or in_round_days(step)
        if said is None and least < low and high < most and fine:
            return (values - known[0]) * DAY, kind
    for kind, (least, most, factor) in EPOCHS.items():
        if least <= low and high < most and not (settled and factor < 1.0):
            return (values - known[0]) * factor, kind
    return values, ""


def in_days(header: str) -> bool:
    """Whether a header says that its numbers may be days."""
    return parse_header(header)[0] in DATES


def in_round_days(step: float) -> bool:
    """Whether a step is 1, 2 or 5 times a power of ten in seconds if it counts days: 1.1574e-5."""
    size = step * DAY
    if not 1e-3 <= size <= 60.0:
        return False
    digits = size / 10.0 ** np.floor(np.log10(size))
    return any(abs(digits / d - 1) < 1e-3 for d in (1.0, 2.0, 5.0, 10.0))


def joined(days: Sequence[Any], times: Sequence[Any]) -> list[Any] | None:
    """Stamps of a column of days and one of times of day; None where they are no such pair."""
    made: list[Any] = []
    for day, time in zip(days, times, strict=True):
        if is_empty(day) or is_empty(time):
            made.append(None)
            continue
        if isinstance(day, datetime):
            day = day.date()
        if not is_stamp(day) or not is_stamp(time) or ":" in str(day) or ":" not in str(time):
            return None
        made.append(f"{day} {time}")
    return made
