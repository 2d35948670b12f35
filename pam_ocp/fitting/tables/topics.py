"""Tables with clocks of their own, put on one: topics of a bag, groups of a logger, rasters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from .clock import GAP, find_clock, read_clock, usual_step
from .dialect import Unsaid
from .headers import COMMANDS, parse_header
from .raw import Doubt, RawTable

__all__ = ["clocked", "merged"]

OVERLAP = 0.5
"""Share of the longest span in which all of them must have been recorded."""


def clocked(tables: Mapping[str, Any]) -> bool:
    """Whether these are columns with clocks of their own, whose names differ: no repeated runs."""
    if len(tables) < 2 or not all(isinstance(t, Mapping) for t in tables.values()):
        return False
    names: list[str] = []
    for table in tables.values():
        header = find_clock(RawTable("", table))[1]
        if header is None:
            return False
        names += [n for n in table if n != header]
    return len(names) == len(set(names))


def merged(tables: Mapping[str, Mapping[str, Sequence[Any]]], label: str) -> RawTable:
    """The columns of all on the clock of the one with most rows, where all were recorded.

    Commands are held between their samples, what is measured is interpolated linearly, never
    across a gap. Raises InputError where they were not recorded together.
    """
    raws = {n: RawTable(f"{label}: {n}", t) for n, t in tables.items()}
    heads: dict[str, str] = {n: str(find_clock(raw)[1]) for n, raw in raws.items()}
    times, doubts, named = _on_one_scale(raws, heads, label)
    main = max(times, key=lambda n: times[n].size)
    orders = {
        n
        for n, raw in raws.items()
        if n != main and all(map(_is_command, {*raw.columns} - {heads[n]}))
    }
    measured = [t for n, t in times.items() if n not in orders]  # the last order holds on
    start, end = max(t.min() for t in times.values()), min(t.max() for t in measured)
    longest = max(float(np.ptp(t)) for t in measured)
    if end - start < OVERLAP * longest:
        spans = ", ".join(f"{n!r} {t.min():g} .. {t.max():g} s" for n, t in list(times.items())[:6])
        raise Unsaid(
            f"{label}: its tables were not recorded together ({spans}); choose one with "
            f"pick={main!r}, or those that were with pick=[{', '.join(map(repr, list(times)[:2]))}]"
        )
    inside = np.nonzero((times[main] >= start) & (times[main] <= end))[0]
    clock = times[main][inside]
    header = "time [s]" if named else "time"  # that no unit is named stays to be doubted
    columns: dict[str, Sequence[Any]] = {header: (clock - clock[0]).tolist()}
    held, left = [], []
    for name, raw in raws.items():
        for header in raw.columns:
            if header == heads[name]:
                continue
            if name == main:
                columns[header] = [raw.columns[header][int(i)] for i in inside]
                continue
            try:
                values = raw.numbers(header)
            except InputError:
                left.append(header)  # words
                continue
            command = _is_command(header)
            held += [header] if command else []
            columns[header] = _at(clock, times[name], values, command).tolist()
    notes = [
        f"{len(raws)} tables with clocks of their own ({', '.join(list(raws)[:8])}) on that of "
        f"{main!r}, {clock.size} rows"
        + (f"; held between samples: {', '.join(held)}" if held else "")
    ]
    notes += [f"no numbers, left out: {', '.join(left)}"] if left else []
    return RawTable(label, columns, dialect=("merged onto one clock",), notes=(*notes, *doubts))


def _on_one_scale(
    raws: Mapping[str, RawTable], heads: Mapping[str, str], label: str
) -> tuple[dict[str, NDArray[np.float64]], tuple[Doubt, ...], bool]:
    """(times [s] from one zero, what is doubted of them, whether they say that they are seconds).

    Raises InputError where clocks are of several kinds, or go back.
    """
    units = {raw.unit(heads[n]) for n, raw in raws.items()}
    cells = [c for n, raw in raws.items() for c in raw.columns[heads[n]]]
    first = heads[next(iter(heads))]
    if len(units) > 1:
        raise InputError(
            f"{label}: the clocks of its tables are in several units ({', '.join(map(str, units))})"
            f"; choose one table with pick={next(iter(raws))!r}"
        )
    whole = RawTable(label, {first: cells})
    t, kind, doubts = read_clock(whole, first, None)
    found, at = {}, 0
    for name, raw in raws.items():
        own = t[at : at + len(raw)]
        at += len(raw)
        if own.size < 2 or np.any(np.isnan(own)) or np.any(np.diff(own) < 0):
            raise InputError(
                f"{label}: the clock of {name!r} is empty or runs backwards, so it cannot be "
                f"put on one with others; choose one table with pick={name!r}"
            )
        found[name] = own
    return found, doubts, bool(kind) or units != {None}


def _is_command(header: str) -> bool:
    words = parse_header(header)[0].replace(".", " ").split()
    return any(" ".join(words[i:]) in COMMANDS for i in range(len(words)))


def _at(
    clock: NDArray[np.float64], t: NDArray[np.float64], values: NDArray[np.float64], held: bool
) -> NDArray[np.float64]:
    """Values at these times; NaN across gaps of t."""
    after = np.clip(np.searchsorted(t, clock, side="right"), 1, t.size - 1)
    steps = np.diff(t)
    usual = usual_step(t)
    if held:
        last = np.clip(np.searchsorted(t, clock, side="right") - 1, 0, t.size - 1)
        return np.asarray(values[last])
    made = np.interp(clock, t, values)
    made[steps[after - 1] > GAP * usual] = np.nan
    return made
