"""Pivots: one quantity down, one across, the force in the cells."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from ...core.errors import InputError
from ...core.units import unit
from .cells import is_empty, is_number, number
from .dialect import Grid, Unsaid
from .headers import NAMES, is_unit, parse_header
from .raw import RawTable

__all__ = ["looks_pivoted", "pivoted", "with_unit"]

_KINDS = ("pressure", "length", "contraction", "force")
_WITH_UNIT = re.compile(
    r"(?P<words>[^\d.,+-]*?)[\s=:@(_]*(?P<number>[+-]?\d+(?:[.,]\d+)?)\s*(?P<unit>[^\W\d]+|%)\)?$"
)


def _heads(grid: Grid, row: Sequence[Any]) -> list[tuple[float, str | None, str]] | None:
    """(number, unit, words) of each cell behind the corner; None where one is no number."""
    found: list[tuple[float, str | None, str]] = []
    for cell in row[1:]:
        if is_number(cell, grid.decimal) and not isinstance(cell, bool):
            found.append((number(cell, grid.decimal), None, ""))
            continue
        match = _WITH_UNIT.match(str(cell).strip())
        if match is None or not is_unit(match["unit"]):
            return None
        value = float(match["number"].replace(",", "."))
        found.append((value, match["unit"], match["words"].strip()))
    return found


def _corner_row(grid: Grid, start: int) -> int | None:
    """The row that holds what runs across: values that differ, behind a corner without one."""
    for place in (start, start - 1):
        if not 0 <= place < len(grid.rows) - 1 or len(grid.rows[place]) < 3:
            continue
        row = grid.rows[place]
        if not is_empty(row[0]) and is_number(row[0], grid.decimal):
            continue
        heads = _heads(grid, row)
        if heads is None or len({h[0] for h in heads}) < len(heads):
            continue
        below = grid.rows[place + 1 : place + 6]
        if all(r and not is_empty(r[0]) and is_number(r[0], grid.decimal) for r in below):
            return place
    return None


def looks_pivoted(grid: Grid, start: int) -> bool:
    """Whether a row of numbers stands above the cells, and a column of them beside."""
    place = _corner_row(grid, start)
    if place is None:
        return False
    steps = [h[0] for h in _heads(grid, grid.rows[place]) or ()]
    rising = all(a < b for a, b in pairwise(steps))
    falling = all(a > b for a, b in pairwise(steps))
    return rising or falling


def pivoted(grid: Grid, start: int, said: Sequence[str] | None) -> RawTable:
    """The cells of a pivot as rows of three columns; empty cells are left out, and counted.

    said : (down, across) or (down, across, cells), as headers. Raises InputError where they must
    be said.
    """
    place = _corner_row(grid, start)
    if place is None:
        raise InputError(
            f"{grid.label} is no pivot: a row of values must stand above the numbers and a column "
            "of them beside; leave pivot= away"
        )
    heads = _heads(grid, grid.rows[place]) or []
    down, across, cells = _quantities(grid, place, heads, said)
    columns: dict[str, list[Any]] = {down: [], across: [], cells: []}
    lines, empty = [], 0
    for row, line in zip(grid.rows[place + 1 :], grid.lines[place + 1 :], strict=True):
        for cell, (value, _, _) in zip(row[1:], heads, strict=False):
            if is_empty(cell):
                empty += 1
                continue
            for name, entry in zip((down, across, cells), (row[0], value, cell), strict=True):
                columns[name].append(entry)
            lines.append(line)
        empty += max(0, len(heads) - len(row) + 1)
    words = f"a pivot: {down} down, {len(heads)} x {across} across, {cells} in the cells"
    notes = (f"{empty} empty cells of the pivot left out",) if empty else ()
    return RawTable(
        grid.label,
        columns,
        lines,
        decimal=grid.decimal,
        dialect=(*grid.dialect, words),
        notes=notes,
    )


def _quantities(
    grid: Grid, place: int, heads: list[tuple[float, str | None, str]], said: Sequence[str] | None
) -> tuple[str, str, str]:
    """Headers of what runs down, across, and stands in the cells."""
    if said is not None:
        given = [str(s) for s in said]
        if isinstance(said, str) or not 2 <= len(given) <= 3:
            raise InputError(
                "pivot: say what runs down and across (and stands in the cells), as "
                "pivot=('contraction [%]', 'pressure [bar]', 'force [N]')"
            )
        return given[0], given[1], given[2] if len(given) > 2 else "force"
    corner = "" if is_empty(grid.rows[place][0]) else str(grid.rows[place][0]).strip()
    parts = [p.strip() for p in re.split(r"\\|\s/\s|->|→|\|", corner) if p.strip()]
    above = [str(c) for row in grid.rows[:place] for c in row if not is_empty(c)]
    words = [w for text in [*above, *(" ".join(c) for c in grid.comments)] for w in _named(text)]
    down = parts[0] if parts and _kind(parts[0]) else None
    across = parts[1] if len(parts) > 1 and _kind(parts[1]) else None
    with_unit = next((h for h in heads if h[1]), None)
    if across is None and with_unit is not None:
        across = _from_unit(with_unit)
    known = {_kind(h): h for h in words if _kind(h)}
    cells = known.get("force", "force")
    for side in ("across", "down"):
        taken = {_kind(h) for h in (down, across) if h}
        left = [h for k, h in known.items() if k != "force" and k not in taken]
        if across is None and side == "across":
            left = [h for h in left if down or _kind(h) == "pressure"]
            across = left[0] if len(left) == 1 else None
        elif down is None and side == "down":
            down = left[0] if len(left) == 1 else None
    kinds = {_kind(down or ""), _kind(across or "")}
    if "pressure" not in kinds or not kinds & {"length", "contraction"}:
        raise Unsaid(
            f"{grid.label} looks like a pivot ({len(heads)} values from {heads[0][0]:g} to "
            f"{heads[-1][0]:g} stand across): say what runs down, across and stands in the cells, "
            "as pivot=('contraction [%]', 'pressure [bar]', 'force [N]')"
        )
    assert down is not None
    assert across is not None
    return down, across, cells


def _kind(header: str) -> str | None:
    """The quantity that a header names."""
    name = parse_header(header)[0]
    return next((k for k in _KINDS if name in NAMES[k]), None)


def _named(text: str) -> list[str]:
    """Headers among words: ``Force [N] over pressure [bar]``."""
    if _kind(text):
        return [text]
    pattern = r"([^\W\d]+)\s*([\[(][^\])]*[\])])?"
    found = [
        f"{name} {said.replace('(', '[').replace(')', ']')}".strip()
        for name, said in re.findall(pattern, text)
    ]
    # a single letter among words is a name only beside its unit
    return [h for h in found if _kind(h) and (len(h) > 2 or "[" in h)]


def with_unit(text: str) -> tuple[str, float] | None:
    """(header, value) of words such as ``l = 285 mm``; None where they say no quantity."""
    match = _WITH_UNIT.match(text.strip())
    if match is None or not is_unit(match["unit"]):
        return None
    value = float(match["number"].replace(",", "."))
    words = match["words"].strip()
    header = _from_unit((value, match["unit"], words))
    if words and header and _kind(words) is None:
        return None  # a title of something else
    return None if header is None else (header, value)


def _from_unit(head: tuple[float, str | None, str]) -> str | None:
    """A header of values such as ``p = 2 bar``."""
    _, name, words = head
    assert name is not None
    if words and _kind(words):
        return f"{words} [{name}]"
    if name == "%":
        return "contraction [%]"
    measured = unit(parse_header(f"x [{name}]")[1].removesuffix(" abs"))  # type: ignore[union-attr]
    for base, kind in (("Pa", "pressure"), ("m", "length")):
        if measured.compatible(unit(base)):
            return f"{kind} [{name}]"
    return None
