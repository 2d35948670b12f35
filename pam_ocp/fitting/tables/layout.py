"""The layout of a grid of cells: titles, names, units, numbers; or a pivot.

Columns in which most of the lower rows are numbers are columns of numbers; numbers begin in the
first row that fits them. What stands above are a row of units, the names, and titles.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ...core.errors import InputError
from ...core.files import MOST_NAME, require_size
from .blocks import periods, pivoted, side_by_side, stacked
from .cells import (
    NAMES,
    TIME_NAMES,
    is_empty,
    is_number,
    is_unit,
    parse_header,
    parted,
    says_no_quantity,
    without_units,
    words_of,
)
from .dialect import Grid, Unsaid, nothing_in
from .raw import RawTable, Reading

LOOKED_AT = 400
"""Rows at the end of a grid whose cells say what its columns hold."""
MOST_TURNED = 50
"""Rows of a grid whose names may run down."""
MOST_BAD = 0.5
"""Share of lines that ``bad_lines="drop"`` leaves out at most."""
CUT_OFF = 10
"""Rows from which on a last line that is too short was cut off, as by a logger without power."""


def tabulated(grid: Grid, how: Reading) -> RawTable:
    """Columns of a grid; of ``how`` the names, pivot, pick and bad_lines count."""
    names, drop = how.names, how.bad_lines == "drop"
    grid = _upright(_trimmed(grid))
    grid, in_cells = _bare(grid, names)
    numeric = _numeric(grid, drop)
    start = _start(grid, numeric)
    head = start - 1
    table = pivoted(grid, start, how.pivot) if how.pivot is not None or names is None else None
    if table is not None:
        return table
    stated: Sequence[Any] = ()
    if head >= 1 and (_is_units(grid, head) or _is_mostly_units(grid, head, numeric)):
        stated, head = grid.rows[head], head - 1
    elif head >= 1 and _is_units(grid, head - 1) and _is_head(grid, head, numeric):
        stated = grid.rows[head - 1]  # above the names
    named = names is None and head >= 0
    if named:
        grid = stacked(grid, head, start)
        numeric = _numeric(grid, drop)
    width = len(numeric)
    found = _names(grid, head, numeric, names, stated)
    require_size(grid.label, len(grid.rows), width)
    parts = periods(found) if named else []
    if parts:
        block = Reading(bad_lines=how.bad_lines)
        return side_by_side(grid, parts, head, how.pick, lambda g: tabulated(g, block))
    if named:
        found = _grouped(grid, head, found)
    heads = [grid.rows[i] for i in range(max(head, 0), start)]
    body, lines, notes = _body(grid, start, found, heads, numeric if drop else None)
    kept = [i for i, name in enumerate(found) if name]
    labels = [found[i] for i in kept]
    require_distinct(labels, grid.label)
    told = ((n, str(c)) for n, c in zip(found, stated, strict=False) if not is_empty(c))
    units = {n: text.strip(" []()") for n, text in told if is_unit(text)}
    units |= {found[i]: u for i, u in in_cells.items()}
    titles = head if named else start
    said = [*grid.dialect, *([f"names in line {grid.lines[head]}"] if named else [])]
    said += [f"units in line {grid.lines[start - 1]}"] if len(stated) else []
    said += ["units in the cells"] if in_cells else []
    said += [f"{titles} title rows"] if titles else []
    return RawTable(
        grid.label,
        {name: [row[i] for row in body] for i, name in zip(kept, labels, strict=True)},
        lines,
        decimal=grid.decimal,
        stated=units,
        dialect=tuple(said),
        notes=(*grid.notes, *notes),
    )


def has_table(grid: Grid) -> bool:
    """Whether a grid holds at least two columns of numbers, two rows long."""
    try:
        trimmed = _trimmed(grid)
        numeric = _numeric(trimmed)
        return sum(numeric) >= 2 and len(trimmed.rows) - _start(trimmed, numeric) >= 2
    except InputError:
        return False


# ---- where things are ----------------------------------------------------------------------------
def _trimmed(grid: Grid) -> Grid:
    """Without empty rows, and without columns that are empty in all."""
    filled = [any(c is not None and c != "" for c in row) for row in grid.rows]
    rows = [row for row, keep in zip(grid.rows, filled, strict=True) if keep]
    if not rows:
        raise nothing_in(grid.label)
    width = max(map(len, rows))
    used = [False] * width
    for row in rows:
        for i, cell in enumerate(row):
            if not used[i] and cell is not None and cell != "":
                used[i] = True
    kept = [i for i, u in enumerate(used) if u]
    if len(kept) < width:
        rows = [[row[i] for i in kept if i < len(row)] for row in rows]
    lines = [line for line, keep in zip(grid.lines, filled, strict=True) if keep]
    words = [[w[i] for i in kept] if len(kept) < width == len(w) else w for w in grid.comments]
    return replace(grid, rows=rows, lines=lines, comments=words)


def _upright(grid: Grid) -> Grid:
    """A grid whose names run down its left side, turned."""
    rows, width = grid.rows, max(map(len, grid.rows))
    few = width < 3 * len(rows) or width < 20
    if not 2 <= len(rows) <= MOST_TURNED or (few and not _names_run_down(rows)):
        return grid
    for row in rows:
        rest = [c for c in row[2:] if not is_empty(c)]
        numbers = sum(map(grid.holds, rest))
        if is_empty(row[0]) or is_number(row[0], grid.decimal) or numbers < len(rest) or not rest:
            return grid
    turned: list[Sequence[Any]] = [
        [row[i] if i < len(row) else None for row in rows] for i in range(width)
    ]
    said = (*grid.dialect, "names run down")
    return replace(grid, rows=turned, lines=list(range(1, width + 1)), dialect=said, text=False)


def _names_run_down(rows: Sequence[Sequence[Any]]) -> bool:
    """Whether rows begin with the names of three quantities."""
    begins = {parse_header(str(row[0]))[0] for row in rows}
    return sum(not begins.isdisjoint(names) for names in (*NAMES.values(), TIME_NAMES)) >= 3


def _bare(grid: Grid, names: Sequence[str | None] | None) -> tuple[Grid, dict[int, str]]:
    """The grid with plain numbers where cells name their units, and these by column."""
    lower = grid.rows[len(grid.rows) // 2 :][-LOOKED_AT:]
    suspect = {i for row in lower for i, c in enumerate(row) if parted(c) is not None}
    if not suspect:
        return grid, {}
    begin = next(
        i for i, row in enumerate(grid.rows) if any(parted(row[k]) for k in suspect if k < len(row))
    )
    rows, lines = [list(row) for row in grid.rows], grid.lines[begin:]
    made: list[Sequence[Any]] = [*rows]
    columns = {
        i: [row[i] if i < len(row) else None for row in rows[begin:]] for i in sorted(suspect)
    }
    head = names if names is not None else rows[begin - 1] if begin else ()
    headers = {i: str(head[i]) for i in suspect if i < len(head) and head[i]}
    plain, units, decimal = without_units(grid.label, columns, lines, headers)
    for i, cells in plain.items():
        for row, cell in zip(rows[begin:], cells, strict=True):
            if i < len(row):
                row[i] = cell
    return replace(grid, rows=made, decimal=decimal or grid.decimal), units


def _numeric(grid: Grid, drop: bool = False) -> list[bool]:
    """Which columns hold numbers, by the rows below. drop : wider rows than usual are none."""
    lower = grid.rows[len(grid.rows) // 2 :][-LOOKED_AT:]
    width = Counter(map(len, lower)).most_common(1)[0][0]
    found = []
    for i in range(width if drop else max(width, max(map(len, lower)))):
        cells = [row[i] for row in lower if i < len(row) and not is_empty(row[i])]
        fitting = sum(map(grid.holds, cells))
        found.append(bool(cells) and fitting >= 0.6 * len(cells))
    return found


def _start(grid: Grid, numeric: Sequence[bool]) -> int:
    """The first row of numbers."""
    columns = [i for i, n in enumerate(numeric) if n]
    if not columns:
        raise nothing_in(grid.label, " of numbers")
    for start, row in enumerate(grid.rows):
        cells = [row[i] for i in columns if i < len(row) and not is_empty(row[i])]
        fitting = sum(map(grid.holds, cells))
        whole = fitting == len(cells) and fitting >= min(2, len(columns))
        if whole or fitting > len(columns) / 2:
            return start + _properties(grid, start, columns)
    raise nothing_in(grid.label, " of numbers")


def _properties(grid: Grid, start: int, columns: Sequence[int]) -> int:
    """Rows of properties (``t0``, ``delta t``) above the names, though they hold numbers."""
    if columns[0] != 0:
        return 0
    for i, row in enumerate(grid.rows[start : start + 12]):
        cells = [c for c in row if not is_empty(c)]
        worded = bool(cells) and not grid.holds(cells[0])
        if not worded:
            return 0
        if len(cells) >= len(columns) and not any(map(grid.holds, cells)):
            return i + 1 if start + i + 1 < len(grid.rows) else 0
    return 0


def _is_units(grid: Grid, row: int) -> bool:
    cells = [str(c) for c in grid.rows[row] if not is_empty(c) or c == "-"]
    return bool(cells) and all(map(is_unit, cells)) and any(c not in ("-", "1") for c in cells)


def _is_mostly_units(grid: Grid, row: int, numeric: Sequence[bool]) -> bool:
    """Whether a row below one of names holds units beside words: ``s, bar, N, text``."""
    cells = [str(c) for c, n in zip(grid.rows[row], numeric, strict=False) if n and not is_empty(c)]
    units = sum(map(is_unit, cells))
    above = [str(c).strip() for c in grid.rows[row - 1] if not is_empty(c)]
    return (
        units >= 2
        and units >= 0.6 * len(cells)
        and _is_head(grid, row - 1, numeric)
        and not all(map(is_unit, above))
    )


# ---- names ---------------------------------------------------------------------------------------
def _names(
    grid: Grid,
    head: int,
    numeric: Sequence[bool],
    given: Sequence[str | None] | None,
    stated: Sequence[Any] = (),
) -> list[str]:
    """A name for each column; "" for those that are left out. A name over several columns with
    units (cells that were merged) is that of each, numbered.
    """
    width = len(numeric)
    if given is not None:
        return given_names(grid.label, given, width)
    if head >= 0 and _is_head(grid, head, numeric):
        cells = [*grid.rows[head], *[None] * width][: max(width, len(grid.rows[head]))]
        if head >= 1:
            cells = [_above(grid, head, i) if is_empty(c) else c for i, c in enumerate(cells)]
        names = _unmerged(["" if c is None else str(c).strip() for c in cells], stated)
        return [n or (f"column {i + 1}" if i < width else "") for i, n in enumerate(names)]
    for words in reversed(grid.comments):
        if len(words) == width and not any(is_number(w, grid.decimal) for w in words):
            return [str(w).strip() for w in words]
    first = " ".join(str(c) for c in grid.rows[head + 1])[:60]
    raise Unsaid(
        f"{grid.label}: no line names the {width} columns (the first row of numbers is "
        f"{first!r}); say what they are, from the left, with their units, as "
        f"columns={_example(width)} (of a record 'time [s]', ...)"
    )


def given_names(label: str, given: Sequence[str | None], width: int) -> list[str]:
    """The user's names of columns, "" for those left out. Raises InputError for another number."""
    if len(given) != width:
        raise InputError(
            f"{label} has {width} columns, columns= names {len(given)}; name each, from the left "
            "(None leaves one out)"
        )
    return [str(name) if name else "" for name in given]


def _above(grid: Grid, head: int, column: int) -> Any:
    """What stands above an empty cell of the names, where it was merged down; no title."""
    for row in reversed(grid.rows[max(0, head - 2) : head]):
        if column < len(row) and not is_empty(row[column]):
            return row[column] if sum(not is_empty(c) for c in row) > 1 else None
    return None


def _unmerged(names: list[str], stated: Sequence[Any]) -> list[str]:
    spans: list[list[int]] = []
    for i, name in enumerate(names):
        if name:
            spans.append([i])
        elif spans and i == spans[-1][-1] + 1 and i < len(stated) and not is_empty(stated[i]):
            spans[-1].append(i)
    for span in (s for s in spans if len(s) > 1):
        for k, i in enumerate(span, start=1):
            names[i] = f"{names[span[0]] if k == 1 else names[span[0]].removesuffix(' 1')} {k}"
    return names


def _grouped(grid: Grid, head: int, names: list[str]) -> list[str]:
    """Names that stand twice or say no quantity, with that of the group above them, whose cells
    were merged: ``muscle 1`` and ``muscle 2`` over ``p, F``, ``pressure`` over ``actual, set``.
    """
    twice = {n for n, count in Counter(names).items() if n and (count > 1 or says_no_quantity(n))}
    above = grid.rows[head - 1] if head >= 1 else []
    groups = [str(c).strip() if not is_empty(c) else "" for c in above]
    if not twice or sum(map(bool, groups)) < 2:
        return names
    group, made = "", []
    for i, name in enumerate(names):
        group = groups[i] if i < len(groups) and groups[i] else group
        made.append(f"{group} {name}".strip() if name in twice else name)
    return made


def _is_head(grid: Grid, head: int, numeric: Sequence[bool]) -> bool:
    """Whether a row names most columns of numbers."""
    row = [_above(grid, head, i) if is_empty(c) else c for i, c in enumerate(grid.rows[head])]
    named = sum(n and i < len(row) and not is_empty(row[i]) for i, n in enumerate(numeric))
    numbers = sum(is_number(c, grid.decimal) for c in row)
    return named > 0.5 * sum(numeric) and numbers < len(row) / 2


def _example(width: int) -> str:
    usual = ["length [mm]", "pressure [bar]", "force [N]"][:width]
    return repr([*usual, *[None] * (width - len(usual))])


# ---- rows ----------------------------------------------------------------------------------------
def _body(
    grid: Grid,
    start: int,
    names: Sequence[str],
    heads: Sequence[Sequence[Any]] = (),
    numeric: Sequence[bool] | None = None,
) -> tuple[list[Sequence[Any]], list[int], tuple[str, ...]]:
    """The rows of numbers, all of one width; names and units that come again are left out. numeric
    : columns of numbers, where rows that do not fit are left out.
    """
    rows, lines, notes = _without_heads(grid.rows[start:], grid.lines[start:], heads)
    width = len(names)
    end = len(rows)
    while end > 1 and not any(map(grid.holds, rows[end - 1])):
        end -= 1
    if end < len(rows):
        notes.append(f"{len(rows) - end} rows of words below the numbers left out")
    whole = end
    while end > 1 and _sums_up(rows[end - 1]):
        end -= 1
    if end < whole and not any(map(_sums_up, rows[:end])):
        said = next(str(c) for c in rows[end] if _sums_up([c]))
        notes.append(f"{whole - end} rows that sum up left out ({said!r} in line {lines[end]})")
        whole = end
    rows = rows[:whole]
    last = len(rows) - 1
    made: list[Sequence[Any]] = []
    where: list[int] = []
    bad: list[int] = []
    for i, row in enumerate(rows):
        if len(row) > width and all(is_empty(c) for c in row[width:]):
            row = row[:width]
        elif len(row) < width and not grid.text:
            row = [*row, *[None] * (width - len(row))]
        if len(row) == width and (numeric is None or _fits(grid, row, numeric)):
            made.append(row)
            where.append(lines[i])
        elif numeric is not None and len(row) == width and _names_columns(grid, row, numeric):
            raise Unsaid(
                f"{grid.label}: line {lines[i]} names columns anew: below it stands another table; "
                "save each in a file of its own"
            )
        elif numeric is not None:
            bad.append(lines[i])
        elif len(row) < width and i == last >= CUT_OFF:
            notes.append(f"line {lines[i]}, the last, is cut off and left out")
        else:
            raise Unsaid(
                f"{grid.label}: line {lines[i]} has {len(row)} cells where the header has "
                f"{width}; mend the line, leave such lines out with bad_lines='drop', or say what "
                "stands between cells (delimiter=';')"
            )
    if len(bad) > MOST_BAD * len(rows):
        raise InputError(
            f"{grid.label}: {len(bad)} of {len(rows)} lines are no rows of {width} cells (first "
            f"line {bad[0]}); bad_lines='drop' leaves out at most {100 * MOST_BAD:g} % of them"
        )
    if bad:
        shown = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        notes.append(f"{len(bad)} of {len(rows)} lines are no rows and left out (line {shown})")
    return made, where, tuple(notes)


_SUMS = words_of(
    """mean, average, avg, std, stdev, std dev, sd, min, max, minimum, maximum, median, sum, total,
    mittel, mittelwert, standardabweichung, stabw, summe, moyenne, écart type, somme, media,
    promedio, średnia, suma, átlag, szórás, průměr, среднее, сумма, 平均, 平均值, 标准差, 合計"""
)


def _sums_up(row: Sequence[Any]) -> bool:
    """Whether a row says that it is a mean, a sum or the like of others."""
    texts = (c.strip(" :.=").lower().replace("-", " ") for c in row if isinstance(c, str))
    return any(text in _SUMS for text in texts)


def _names_columns(grid: Grid, row: Sequence[Any], numeric: Sequence[bool]) -> bool:
    """Whether words with a unit stand in all columns of numbers."""
    cells = [str(c) for c, n in zip(row, numeric, strict=False) if n and not is_empty(c)]
    words = len(cells) == sum(numeric) and not any(map(grid.holds, cells))
    return words and any(is_unit(parse_header(c)[1] or "") for c in cells)


def _without_heads(
    rows: list[Sequence[Any]], lines: list[int], heads: Sequence[Sequence[Any]]
) -> tuple[list[Sequence[Any]], list[int], list[str]]:
    """(rows, lines, notes) without names and units that come again."""
    again = [i for i, row in enumerate(rows) if any(list(row) == list(h) for h in heads)]
    if not again:
        return rows, lines, []
    note = f"names that come again left out ({len(again)} lines, first {lines[again[0]]})"
    gone = set(again)
    kept = [i for i in range(len(rows)) if i not in gone]
    return [rows[i] for i in kept], [lines[i] for i in kept], [note]


def _fits(grid: Grid, row: Sequence[Any], numeric: Sequence[bool]) -> bool:
    """Whether columns of numbers hold numbers or nothing in this row, and not nothing in all."""
    cells = [c for c, n in zip(row, numeric, strict=False) if n]
    filled = [c for c in cells if not is_empty(c)]
    return bool(filled) and all(map(grid.holds, filled))


def require_distinct(names: Sequence[str], label: str) -> None:
    """Raises InputError for names that are too long, too many, or stand twice."""
    require_size(label, 0, len(names))
    long = [n for n in names if len(n) > MOST_NAME]
    if long:
        raise InputError(
            f"{label}: the header {long[0][:20]!r}... has {len(long[0])} characters; "
            f"shorten it to {MOST_NAME}"
        )
    twice = sorted(n for n, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"{label}: column {twice[0]!r} occurs twice; rename one of them")
