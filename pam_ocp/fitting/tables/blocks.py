"""Blocks side by side: the same columns again for each contraction, run or muscle; or pairs of
columns with a time of their own each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from .cells import is_empty
from .dialect import Grid, Unsaid
from .headers import TIME_NAMES, parse_header
from .labels import branch_of
from .pivot import with_unit
from .raw import RawTable
from .topics import clocked, merged

__all__ = ["periods", "side_by_side", "stacked"]

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
