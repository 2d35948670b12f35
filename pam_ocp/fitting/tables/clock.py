"""The clock of a record: found, read as seconds, and mended where it stands still or wraps.

Dates are read by patterns of our own: dateutil reads 16 of the 17 forms that the tests hold, eight
times slower, but takes an unknown time zone for none, leaves out nanoseconds, and reads no minutes
and seconds (12:34.5), no zones of cities ([Europe/Berlin]) and no hours beyond 24; pandas reads 15.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import date, datetime
from datetime import time as clock_time
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import scale_of
from ...core.errors import InputError, UnknownNameError, require_positive
from ...core.quantities import MEASURED, inside_by
from ...core.units import unit
from .cells import TIME_NAMES, is_empty, is_stamp, parse_header
from .columns import column_scale
from .raw import Doubt, RawTable

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
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_YEAR_FIRST = re.compile(
    rf"(?P<y>\d{{4}})[-/.] ?(?P<a>\d{{1,2}})[-/.] ?(?P<b>\d{{1,2}})\.?(?:[T ,]+{_TIME})?$"
)
_YEAR_LAST = re.compile(
    rf"(?P<a>\d{{1,2}})(?P<sign>[-/.])(?P<b>\d{{1,2}}|(?i:{'|'.join(_MONTHS)}))[-/.](?P<y>\d{{2,4}})"
    rf"(?:[T ,]+{_TIME})?$",
)
ZONES = {
    **{"GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2},
    **{"EET": 2, "EEST": 3, "EST": -5, "EDT": -4, "CDT": -5, "MST": -7, "MDT": -6},
    **{"PST": -8, "PDT": -7, "JST": 9},
}
"""Hours ahead of UTC of zones that are called by one name only."""
_OF_DAY = re.compile(_TIME + "$")


def seconds_of_stamps(cells: Sequence[Any], place: Any) -> tuple[Array, str]:
    """(seconds since the first stamp with NaN for empty cells, what they are) of dates or times."""
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
    zone = re.search(r"\d\s*([A-Z]{3,4})(?:\[.*)?$", text)
    if zone is not None and zone[1] not in (*ZONES, "UTC"):
        return None
    if match:
        return (int(match["y"]), int(match["a"]), int(match["b"]), "y"), _of_day(match)
    match = _YEAR_LAST.match(text)
    if match:
        year = int(match["y"]) + (2000 if len(match["y"]) == 2 else 0)
        if match["b"].isalpha():  # as MATLAB writes it
            month = _MONTHS.index(match["b"].lower()) + 1
            return (year, month, int(match["a"]), "y"), _of_day(match)
        return (year, int(match["a"]), int(match["b"]), match["sign"]), _of_day(match)
    match = _OF_DAY.match(text)
    return (None, _of_day(match)) if match else None


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
    """(times, what was made of them) of numbers in seconds (``settled`` : surely), or of none."""
    known = values[~np.isnan(values)]
    if known.size < 2:
        return values, ""
    low, high = float(known.min()), float(known.max())
    steps = np.abs(np.diff(known))
    step = usual_step(known, steps)
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


GAP = 10.0
"""A step of time longer than this many usual ones is a gap."""
COARSE = 0.3
"""Share of steps of no length from which on the clock is coarser than the record."""
FEW = 20
"""Rows below which a single wrong stamp cannot be told from two clocks."""
DECLARED = 60.0
"""A file that names the unit may have steps so much shorter or longer than usual ones."""
WRAPS = (2.0**16, 2.0**24, 2.0**32)
"""Counts at which a counter begins anew."""
PERIODS = (60.0, 3600.0, 43200.0, 86400.0)
"""Seconds after which a time of day does."""


def clock_words(header: str, kind: str, t: Array) -> str:
    """How evenly times [s] run, and their gaps. kind : what they were, in words."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if steps.size else 0.0
    named = f"{header!r} ({kind})" if kind else repr(header)
    if usual <= 0:
        return f"{named}: more than one row for each time"
    inside = steps[(steps > 0) & (steps <= GAP * usual)]
    jitter = float(np.std(inside)) / usual if inside.size else 0.0
    words = "even" if jitter < 1e-3 else f"jitter {100 * jitter:.2g} %"
    gaps = int(np.sum(steps > GAP * usual))
    if gaps:
        words += f", {gaps} gap{'s' * (gaps != 1)} up to {float(steps.max()):g} s"
    return f"{named}: every {usual:.4g} s, {words}"


def usual_step(t: Array, steps: Array | None = None) -> float:
    """The median of the steps of times forwards; 0 where there is none. steps : if not of t."""
    steps = np.diff(t) if steps is None else steps
    forwards = steps[steps > 0]
    return float(np.median(forwards)) if forwards.size else 0.0


def find_clock(raw: RawTable, time: str | None = None) -> tuple[RawTable, str | None]:
    """(table, header of its time; None without). A column of days beside one of times is joined."""
    if time is not None:
        if time not in raw.columns:
            raise UnknownNameError("column of the time", time, raw.columns)
        return raw, time
    named = [h for h in raw.columns if parse_header(h)[0] in TIME_NAMES]
    if len(named) > 1:
        days, times = (list(raw.columns[h]) for h in named[:2])
        both = joined(days, times) or joined(times, days)
        if both is not None:
            columns = {h: c for h, c in raw.columns.items() if h not in named[:2]}
            name = " ".join(named[:2])
            return replace(raw, columns={name: both, **columns}), name
        numeric = [h for h in named if not any(is_stamp(c) for c in list(raw.columns[h])[:3])]
        named = numeric or named  # seconds beside a date are the finer ones
    return raw, named[0] if named else None


def read_clock(
    raw: RawTable, header: str, wanted: str | None
) -> tuple[Array, str, tuple[Doubt, ...]]:
    """(times [s] with NaN for empty cells, what they were, whether that is doubted)."""
    cells = raw.columns[header]
    there = [c for c in list(cells)[:200] if c is not None and c != ""]

    def place(i: int) -> str:
        return f"{raw.label}: column {header!r}, {raw.row(i)}"

    if there and sum(is_stamp(c) for c in there) > len(there) / 2:
        return *seconds_of_stamps(cells, place), ()
    said = raw.unit(header)
    values = raw.numbers(header)
    if wanted is None and (said is None or said == "s"):
        t, kind = seconds_of_numbers(values, header, said)
        doubted = kind and (said is not None or (kind in DAYS and not in_days(header)))
        how = f"{header!r} is read as {kind}; say units={{'time': 's'}} if it counts seconds"
        return t, kind, ((Doubt(how),) if doubted else ())
    scale = column_scale(raw, header, "time", unit("s"), wanted, exact=True)
    assert scale is not None
    return *seconds_of_numbers(scale.si(values), header, "s", settled=True), ()


def doubts_of_clock(header: str, t: Array, said: str | None, wanted: str | None) -> list[Doubt]:
    """Doubts of the unit of times [s], by steps and length; the file and the user may name it."""
    steps = np.diff(t)
    if wanted is not None or t.size < 3 or not np.any(steps > 0):
        return []
    step, whole = usual_step(t), float(t[-1] - t[0])
    factor = 1.0 if said is None else scale_of(header, said, None, None).measured.factor
    wide = 1.0 if said is None else DECLARED
    sample, run = MEASURED["sample time"], MEASURED["duration"]
    short = t.size >= FEW and said is None and whole < run.least
    read = f"read in {said or 's'}" + ("" if said else ", as no unit was named")
    likely = inside_by({"sample time": step / factor, "duration": whole / factor}, said or "s")
    if said is None and in_round_days(step):
        likely = ["d", *(name for name in likely if name != "d")]
    elif said is None and t.size >= FEW and np.all(steps == 1) and t[0] == round(t[0]):
        return [
            Doubt(
                f"{header!r} counts {t[0]:g}, {t[1]:g}, {t[2]:g}, ... ({read}): if it numbers the "
                "samples, say units={'time': 'count * 1 ms'} with their distance, else "
                "units={'time': 's'}"
            )
        ]
    elif sample.least / wide <= step <= sample.most * wide and whole <= run.most and not short:
        return []
    guess = f"did you mean {' or '.join(likely[:2])}? " if likely else ""
    named = f"units={{'time': {likely[0] if likely else '...'!r}}}"
    how = f"Say {named}" if said is None else "Correct the header"
    return [
        Doubt(
            f"{header!r} steps by {step:.4g} s, {whole:.4g} s in all ({read}), where such rigs "
            f"take a sample each {sample.least:g} .. {sample.most:g} s: {guess}{how}, or "
            f"units={{'time': {said or 's'!r}}} if it is so"
        )
    ]


def mended(raw: RawTable, header: str, t: Array, factor: float) -> tuple[RawTable, Array]:
    """Table and times without stamps that repeat, single wrong ones, wraps at ``factor`` s per
    count.
    """
    if t.size and t.min() == t.max():
        return raw, t
    t, words = _unwrapped(t, factor)
    notes = [words] if words else []
    steps = np.diff(t)
    still = steps == 0
    kept = np.arange(t.size)
    if t.size >= FEW and still.mean() > COARSE and not np.any(steps < 0) and t[-1] > t[0]:
        t, words = _spread(t)
        notes.append(words)
    elif still.any() and t.size >= FEW:
        kept = np.concatenate([[0], 1 + np.nonzero(~still)[0]])
        first = raw.row(int(np.argmax(still)) + 1)
        notes.append(
            f"the clock stands still: {int(still.sum())} rows of a repeated time dropped (first "
            f"{first})"
        )
    if kept.size >= FEW:
        wrong = _glitches(t[kept])
        if wrong.size:
            first = raw.row(int(kept[wrong[0]]))
            notes.append(f"{wrong.size} rows of a single wrong time dropped (first {first})")
            kept = np.delete(kept, wrong)
    if not notes:
        return raw, t
    return raw.taken(kept, *notes), t[kept]


def rows_before_jumps(raw: RawTable, header: str, t: Array) -> NDArray[np.intp]:
    """Rows that a table of held inputs (FMI) repeats at the time of a jump, with the values before;
    none where any repeated time is something else, as the ticks of a coarse clock.
    """
    still = np.nonzero(np.diff(t) == 0)[0]
    none = still[:0]
    if not still.size or still[0] == 0 or np.any(np.diff(still) == 1):
        return none
    columns = [raw.numbers(h) for h in raw.columns if h != header]
    held = all(np.array_equal(c[still], c[still - 1]) for c in columns)
    jumps = any(np.any(c[still] != c[still + 1]) for c in columns)
    return still if held and jumps else none


def _spread(t: Array) -> tuple[Array, str]:
    """Times of a clock that is coarser than the record: evenly between its ticks."""
    starts = np.concatenate([[0], 1 + np.nonzero(np.diff(t) > 0)[0]])
    runs = np.diff(starts)
    step = float(np.median(np.diff(t[starts]) / runs))
    index = np.arange(t.size, dtype=float)
    made = np.interp(index, starts, t[starts])
    made[: starts[1]] = t[starts[1]] - step * (starts[1] - index[: starts[1]])
    last = starts[-1]
    made[last:] = t[last] + step * (index[last:] - last)
    return made, (
        f"the clock ticks every {float(np.median(np.diff(t[starts]))):g} s only, for some "
        f"{float(np.median(runs)):g} rows each: they are spread evenly, {step:.4g} s apart"
    )


def _unwrapped(t: Array, factor: float) -> tuple[Array, str]:
    """Times of a counter, or a time of day, that began anew."""
    steps = np.diff(t)
    back = np.nonzero(steps < 0)[0]
    if not back.size or t.size < FEW:
        return t, ""
    usual = usual_step(t)
    for period in (*(w * factor for w in WRAPS), *PERIODS):
        ahead = steps[back] + period
        if usual > 0 and np.all((ahead > 0) & (ahead < GAP * usual)):
            turns = np.concatenate([[0], np.cumsum(steps < 0)])
            return t + period * turns, (
                f"the clock begins anew after {period:g} s, {back.size} times: counted on"
            )
    return t, ""


def _glitches(t: Array) -> NDArray[np.intp]:
    """Rows whose time is wrong, and whose neighbours' are right without them."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    wrong = []
    for i in np.nonzero(steps <= 0)[0]:
        for j in (int(i), int(i) + 1):
            if j == 0 or j == t.size - 1:
                wrong.append(j)
                break
            if 0 < j < t.size - 1 and 0 < t[j + 1] - t[j - 1] <= 3 * usual:
                wrong.append(j)
                break
    return np.unique(np.array(wrong, dtype=np.intp))


def parts_of(
    raw: RawTable, header: str, t: Array, max_gap: float | None, cut: bool
) -> list[tuple[int, int]]:
    """(first, behind last) of the parts between gaps and backward steps."""
    if len(t) < 2:
        raise InputError(f"{raw.label}: {len(t)} sample; a record needs at least 2")
    steps = np.diff(t)
    usual = usual_step(t)
    limit = GAP * usual if max_gap is None else require_positive("max_gap", max_gap, "s")
    back, wide = steps <= 0, steps > limit * (1 + 1e-9)
    if not cut and np.any(back):
        i = int(np.argmax(back))
        words = "stands still" if steps[i] == 0 else "runs backwards"
        raise InputError(
            f"{raw.label}: time {words} in {raw.row(i + 1)}, from {t[i]:g} to {t[i + 1]:g} s; "
            "sort the rows, or cut there: clock='cut' (read_records then gives all parts, "
            "read_record the longest; a column that numbers them goes by split=...)"
        )
    if not cut and np.any(wide):
        i = int(np.argmax(wide))
        raise InputError(
            f"{raw.label}: a gap of {steps[i]:g} s before {raw.row(i + 1)} (from {t[i]:g} to "
            f"{t[i + 1]:g} s, where {usual:g} s are usual); cut there with clock='cut' "
            "(read_records then gives all parts, read_record the longest), or allow it with "
            f"max_gap={1.01 * steps[i]:.3g}"
        )
    cuts = [0, *(int(i) + 1 for i in np.nonzero(back | wide)[0]), len(t)]
    found = [(a, b) for a, b in pairwise(cuts) if b - a >= 2]
    if not found:
        raise InputError(f"{raw.label}: no two rows follow each other in time; look at {header!r}")
    return found
