"""LabVIEW's measurement files (.lvm): a header, then segments with headers of their own.

Format: NI, "Specification for the LabVIEW Measurement File (.lvm)". The package lvm_read is not
used: it reads what is no number as NaN without a word, no unit, and one column of times only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...core.errors import InputError
from .cells import is_empty, number

__all__ = ["is_lvm", "segments_of"]

_END = "***End_of_Header***"


def is_lvm(text: str) -> bool:
    return text.lstrip("\ufeff \t\r\n").startswith("LabVIEW Measurement")


def segments_of(text: str, label: str) -> dict[str, Any]:
    """{segment: {column: numbers}}; where channels have times of their own, a part for each.

    Raises InputError for cells that are no numbers.
    """
    lines = text.splitlines()
    ends = [i for i, line in enumerate(lines) if line.startswith(_END)]
    if not ends:
        raise InputError(f"{label} has no line {_END}, which ends the header of an .lvm file")
    tabs = any(line.split()[0:2] == ["Separator", "Tab"] or "\t" in line for line in lines[:20])
    cut = "\t" if tabs else ","
    told = _told(lines[: ends[0]], cut)
    sign = "," if (told.get("Decimal_Separator") or ["."])[0] == "," else "."
    found, before = {}, ends[0] + 1
    for count, end in enumerate(ends[1:] or ends, start=1):
        until = next((e for e in ends if e > end), len(lines))
        head = _told(lines[before:end], cut) if len(ends) > 1 else told
        body = lines[end + 1 : until]
        stop = next(
            (i for i, one in enumerate(body) if i and one.startswith("Channels")), len(body)
        )
        rows = [(end + 2 + i, one.split(cut)) for i, one in enumerate(body[:stop]) if one.strip()]
        if len(rows) > 1:
            x = (told.get("X_Columns") or ["One"])[0]
            found[f"segment {count}"] = _segment(rows, head, x, sign, label)
        before = end + 1 + stop
    if not found:
        raise InputError(f"{label} is empty: no segment of it has rows of numbers")
    return found if len(found) > 1 else next(iter(found.values()))


def _told(lines: Sequence[str], cut: str) -> dict[str, list[str]]:
    """What lines of a header say, by its first word."""
    parts = ([cell.strip() for cell in line.split(cut)] for line in lines if line.strip())
    return {one[0]: one[1:] for one in parts}


def _segment(
    rows: list[tuple[int, list[str]]], head: dict[str, list[str]], x: str, sign: str, label: str
) -> dict[str, Any]:
    names = [cell.strip() for cell in rows[0][1]]
    clocks = [i for i, name in enumerate(names) if name == "X_Value"]
    units, taken = head.get("Y_Unit_Label") or [], [n for n in names if n not in ("X_Value", "")]
    columns: list[list[float]] = []
    for i, name in enumerate(names):
        cells = [(line, row[i].strip() if i < len(row) else "") for line, row in rows[1:]]
        columns.append([] if name in ("Comment", "") else _numbers(cells, name, sign, label))
    parts: dict[str, dict[str, Any]] = {}
    channel = 0
    for i, name in enumerate(names):
        if i in clocks or name not in taken or name == "Comment":
            continue
        clock = max((c for c in clocks if c < i), default=-1)
        said = units[channel] if channel < len(units) else ""
        kept = [k for k, v in enumerate(columns[i]) if v == v]
        part = parts.setdefault(str(clock), {})
        if clock < 0 or x == "No" or all(v != v for v in columns[clock]):
            times = _waveform(head, channel, len(columns[i]))
        else:
            times = columns[clock]
        if len(clocks) > 1:  # shorter channels end before the others
            times, values = [times[k] for k in kept], [columns[i][k] for k in kept]
        else:
            values = columns[i]
        if times:
            part["time [s]"] = times
        part[f"{name} [{said}]" if said else name] = values
        channel += 1
    if len(parts) == 1:
        return next(iter(parts.values()))
    return {", ".join(n for n in part if n != "time [s]"): part for part in parts.values()}


def _waveform(head: dict[str, list[str]], channel: int, count: int) -> list[float]:
    """Times from X0 and Delta_X; none where these are not said."""
    zero, step = (
        [number(c.replace(",", ".")) for c in head.get(key) or [] if not is_empty(c)]
        for key in ("X0", "Delta_X")
    )
    if not step:
        return []
    at = min(channel, len(step) - 1)
    start = zero[min(channel, len(zero) - 1)] if zero else 0.0
    return [start + step[at] * i for i in range(count)]


def _numbers(cells: Sequence[tuple[int, str]], name: str, sign: str, label: str) -> list[float]:
    made = []
    for line, cell in cells:
        try:
            made.append(number(cell, sign))
        except ValueError:
            raise InputError(
                f"{label}: line {line}, column {name!r} holds {cell[:40]!r}, which is no number "
                f"with the decimal sign {sign!r} that the file names; mend the line"
            ) from None
    return made
