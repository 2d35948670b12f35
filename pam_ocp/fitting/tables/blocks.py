"""Several tables in one: pivots (one quantity down, one across, the force in the cells), blocks
beside or below each other, and tables with clocks of their own (topics of a bag, groups of a
logger).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from .cells import (
    NAMES,
    QUANTITIES,
    TIME_NAMES,
    branch_of,
    is_command,
    is_empty,
    is_number,
    is_unit,
    measures,
    number,
    parse_header,
)
from .clock import GAP, find_clock, read_clock, usual_step
from .dialect import Grid, Unsaid
from .raw import Doubt, RawTable

_WITH_UNIT = re.compile(
    r"(?P<words>[^\d.,+-]*?)[\s=:@(_]*(?P<number>[+-]?\d+(?:[.,]\d+)?)\s*(?P<unit>[^\W\d]+|%)\)?$"
)


Head: TypeAlias = tuple[float, str | None, str]
"""Number, unit and words of ``p = 2 bar``."""


def _measured(text: str) -> Head | None:
    """What words that end in a number with its unit say; None of others."""
    match = _WITH_UNIT.match(text.strip())
    if match is None or not is_unit(match["unit"]):
        return None
    return float(match["number"].replace(",", ".")), match["unit"], match["words"].strip()


def _heads(grid: Grid, row: Sequence[Any]) -> list[Head] | None:
    """What stands behind the corner of a pivot; None where a cell is no number."""
    found: list[Head] = []
    for cell in row[1:]:
        plain = is_number(cell, grid.decimal) and not isinstance(cell, bool)
        head = (number(cell, grid.decimal), None, "") if plain else _measured(str(cell))
        if head is None:
            return None
        found.append(head)
    return found


def _corner(grid: Grid, start: int) -> tuple[int, list[Head]] | None:
    """The row that holds what runs across, and this: values that differ, behind a corner without
    one.
    """
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
            return place, heads
    return None


def pivoted(grid: Grid, start: int, said: Sequence[str] | None) -> RawTable | None:
    """The cells of a pivot (a row of rising or falling numbers above them, a column beside) as rows
    of three columns said (down, across[, cells]), empty ones counted; None where the grid is none.
    """
    corner = _corner(grid, start)
    if said is not None and corner is None:
        raise InputError(
            f"{grid.label} is no pivot: a row of values must stand above the numbers and a column "
            "of them beside; leave pivot= away"
        )
    steps = np.diff([h[0] for h in corner[1]]) if corner else np.zeros(1)
    if corner is None or (said is None and not (np.all(steps > 0) or np.all(steps < 0))):
        return None
    place, heads = corner
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
    grid: Grid, place: int, heads: list[Head], said: Sequence[str] | None
) -> tuple[str, str, str]:
    """Headers of what runs down, across, and stands in the cells."""
    if said is not None:
        given = [str(s) for s in said]
        if not 2 <= len(given) <= 3:
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
    return next((k for k in QUANTITIES if name in NAMES[k]), None)


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
    head = _measured(text)
    if head is None:
        return None
    value, _, words = head
    header = _from_unit(head)
    if words and header and _kind(words) is None:
        return None  # a title of something else
    return None if header is None else (header, value)


def _from_unit(head: Head) -> str | None:
    """A header of values such as ``p = 2 bar``."""
    _, name, words = head
    assert name is not None
    if words and _kind(words):
        return f"{words} [{name}]"
    if name == "%":
        return "contraction [%]"
    said = parse_header(f"x [{name}]")[1]
    kinds = (kind for base, kind in (("Pa", "pressure"), ("m", "length")) if measures(said, base))
    kind = next(kinds, None)
    return f"{kind} [{name}]" if kind else None


_NUMBERED = re.compile(
    r"(?P<label>run|rep|repeat|cycle|trial|lauf|zyklus|versuch|essai|ciclo)[\s_#.:=-]*(?P<number>\d+)$",
    re.I,
)


def periods(names: Sequence[str]) -> list[list[int]]:
    """Columns of each block; [] where names do not repeat in blocks."""
    count = len(names)
    for width in range(2, count // 2 + 1):
        again = count % width == 0 and all(names[i] == names[i % width] for i in range(count))
        if again and len(set(names[:width])) == width:
            return [list(range(a, a + width)) for a in range(0, count, width)]
    clocks = [i for i, name in enumerate(names) if parse_header(name)[0] in TIME_NAMES]
    repeated = len({names[i] for i in clocks}) < len(clocks)
    if (
        repeated
        and clocks[0] == 0
        and all(b - a > 1 for a, b in zip(clocks, [*clocks[1:], count], strict=False))
    ):
        return [list(range(a, b)) for a, b in zip(clocks, [*clocks[1:], count], strict=True)]
    return []


def side_by_side(
    grid: Grid,
    parts: Sequence[Sequence[int]],
    head: int,
    pick: Any,
    table_of: Callable[[Grid], RawTable],
) -> RawTable:
    """One table of all blocks, the value in the title above each as a column of its own; or the
    blocks with clocks of their own on one. Raises Unsaid where nothing says what tells them apart.
    """
    titles = [_title(grid, part, head) for part in parts]
    names = [title or f"block {i}" for i, title in enumerate(titles, start=1)]
    tables = [table_of(_cut(grid, part, head)) for part in parts]
    chosen = pick if isinstance(pick, str) else None
    for i, table in enumerate(tables):
        if chosen in (names[i], f"block {i + 1}"):
            return replace(table, dialect=(*table.dialect, f"block {i + 1}, {names[i]!r}"))
    by_name = {f"block {i}": t.columns for i, t in enumerate(tables, start=1)}
    if clocked(by_name):
        united = {
            n: {f"{h} [{t.stated[h]}]" if h in t.stated else h: c for h, c in own.items()}
            for (n, own), t in zip(by_name.items(), tables, strict=True)
        }
        return merged(united, grid.label)
    keys = [_key(title) for title in titles]
    timed = any(parse_header(h)[0] in TIME_NAMES for h in tables[0].columns)
    if timed or None in keys or len({k[0] for k in keys if k}) != 1:
        raise Unsaid(
            f"{grid.label} has {len(parts)} blocks side by side ({', '.join(map(repr, names[:8]))})"
            + ("" if timed else ", and no value with its unit above each, as 'contraction 5 %'")
            + f": choose one with pick={names[0]!r}"
            + ("" if timed else " (and say the rest with constants={'contraction': '5 %'})")
        )
    header = keys[0][0]  # type: ignore[index]
    columns: dict[str, list[Any]] = {header: []}
    lines: list[int] = []
    for key, table in zip(keys, tables, strict=True):
        assert key is not None
        for name, cells in table.columns.items():
            columns.setdefault(name, []).extend(cells)
        columns[header] += [key[1]] * len(table)
        lines += list(table.lines or [])
    first = tables[0]
    said = f"{len(parts)} blocks side by side, {header!r} from the titles above them"
    return replace(
        first,
        columns=columns,
        lines=lines,
        dialect=(*first.dialect, said),
        notes=tuple(note for t in tables for note in t.notes),
    )


def stacked(grid: Grid, head: int, start: int) -> Grid:
    """The grid with a further column where blocks stand below each other, each with a title that
    holds a value (``contraction 5 %``, ``Run 2``) and the same names; else as it is.
    """
    names, units = grid.rows[head], list(grid.rows[head + 1 : start])
    first = _key(_title(grid, range(len(names)), head))
    places = [i for i in range(start, len(grid.rows)) if grid.rows[i] == names]
    keys = {}
    for i in places:
        filled = [str(c) for c in grid.rows[i - 1] if not is_empty(c)]
        keys[i] = _key(filled[0]) if len(filled) == 1 else None
    if first is None or not keys or any(k is None or k[0] != first[0] for k in keys.values()):
        return grid
    rows: list[Sequence[Any]] = [*grid.rows[:head], [*names, first[0]]]
    lines, value = list(grid.lines[: head + 1]), first[1]
    for i in range(head + 1, len(grid.rows)):
        row = grid.rows[i]
        key = keys.get(i)
        if key is not None:
            value = key[1]
        if i in keys or i + 1 in keys or (i >= start and list(row) in units):
            continue
        rows.append([*row, value if i >= start else None])
        lines.append(grid.lines[i])
    said = f"{1 + len(keys)} blocks below each other, {first[0]!r} from the titles above them"
    return replace(grid, rows=rows, lines=lines, dialect=(*grid.dialect, said))


def _cut(grid: Grid, part: Sequence[int], head: int) -> Grid:
    """A block, from its names down to its last row."""
    rows: list[Sequence[Any]] = [
        [row[i] if i < len(row) else None for i in part] for row in grid.rows[head:]
    ]
    while rows and all(is_empty(c) for c in rows[-1]):
        rows.pop()
    return replace(grid, rows=rows, lines=grid.lines[head : head + len(rows)], text=False)


def _title(grid: Grid, part: Sequence[int], head: int) -> str:
    """What stands above a block, next to its names."""
    for row in reversed(grid.rows[:head]):
        cells = [row[i] for i in part if i < len(row) and not is_empty(row[i])]
        if cells:
            return " ".join(str(c).strip() for c in cells)
    return ""


def _key(title: str) -> tuple[str, Any] | None:
    """(header, value) that a title says: ``contraction 5 %``, ``l = 285 mm``, ``Run 2``, ``up``."""
    numbered = _NUMBERED.match(title.strip())
    if numbered:
        return "run", numbered["number"]
    branch = branch_of(title)
    return ("branch", branch) if branch else with_unit(title)


# ---- tables with clocks of their own -------------------------------------------------------------
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
    """The columns of all on the clock of the one with most rows, where all were recorded. Commands
    are held between their samples, what is measured interpolated, never across a gap.
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
    """(times [s] from one zero, what is doubted of them, whether they were said to be seconds)."""
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
    return any(is_command(" ".join(words[i:])) for i in range(len(words)))


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
