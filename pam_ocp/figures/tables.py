"""Any result as a table: rows of names, numbers and texts; for pandas, files and a picture."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import InputError, kind_of, require_instance
from ..core.files import atomic_path, write_json
from ..core.interrupts import interruptible
from ..core.lazy import library
from .canvas import COLOURS, caption, new_figure
from .sheets import SHEETS, Grid, cell_text, number_in, sheet_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENDINGS = (".csv", ".html", ".json", ".txt", ".xlsx")
MOST_PANELS, MOST_ROWS, WIDEST = 6, 40, 60
_BY_COLUMN = {"ForceTable"}
"""Of these the notebook shows a summary only."""


def table_of(thing: Any) -> Grid:
    """The table of a result: the largest that it shows in a notebook; else the rows that it names
    (``_table_rows``), or its parts, if it is made of several; else its own numbers.

    Values are as the object has them: SI, but for what stands in units in the notebook's table.
    """
    known = {cls.__name__ for cls in type(thing).__mro__} & set(SHEETS)
    if known - _BY_COLUMN:
        grid = max(sheet_of(thing).grids, key=lambda g: len(g.rows), default=None)
        if grid is not None:
            return Grid(grid.head, tuple(tuple(map(number_in, row)) for row in grid.rows))
    own = getattr(thing, "_table_rows", None)
    rows = own() if own else _cases(thing) or [_flat(p) for p in _parts(thing)]
    if rows:
        heads = tuple(dict.fromkeys(n for row in rows for n in row))
        if heads:
            return Grid(heads, tuple(tuple(row.get(n, "") for n in heads) for row in rows))
    columns = _columns(thing)
    if columns:
        arrays = zip(*columns.values(), strict=True)
        return Grid(tuple(columns), tuple(tuple(map(float, row)) for row in arrays))
    flat = _flat(thing)
    return Grid(("name", "value"), tuple(flat.items()))


def _cases(thing: Any) -> list[dict[str, Any]]:
    """Of many simulations: what each case sets, and where it ended."""
    if not (hasattr(thing, "cases") and hasattr(thing, "results")):
        return []
    rows = []
    for case, result in zip(thing.cases, thing.results, strict=True):
        row = {n: v for key in case for n, v in _flat(case[key]).items()}
        failed = isinstance(result, Exception)
        last = {"failure": str(result)} if failed else result.row(-1)
        rows.append(row | {n if failed else f"{n}.last": v for n, v in last.items()})
    return rows


def _parts(thing: Any) -> Sequence[Any]:
    """What it consists of, where that is several of a kind."""
    if isinstance(thing, Sequence) and not isinstance(thing, str):
        return [p for p in thing if is_dataclass(p)]
    for f in fields(thing) if is_dataclass(thing) else ():
        value = getattr(thing, f.name)
        many = isinstance(value, tuple | list) and len(value) > 0
        if many and all(is_dataclass(p) and not _is_heavy(p) for p in value):
            return list(value)
    return ()


def _is_heavy(part: Any) -> bool:
    """No row of a table: a motion, a plan, a plant."""
    return any(hasattr(part, n) for n in ("trajectory", "variables", "states", "signals"))


def _columns(thing: Any) -> dict[str, Any]:
    """Its arrays of one length."""
    found = {}
    for f in fields(thing) if is_dataclass(thing) else ():
        value = getattr(thing, f.name)
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fi":
            found[f.name] = value
    size = max((len(v) for v in found.values()), default=0)
    return {n: v for n, v in found.items() if len(v) == size} if size > 1 else {}


def _flat(thing: Any, prefix: str = "") -> dict[str, Any]:
    """Numbers and texts of an object, those of its parts behind a dot."""
    found: dict[str, Any] = {}
    pairs: Iterator[tuple[Any, Any]] = (
        ((n, getattr(thing, n)) for n in _names(thing))
        if is_dataclass(thing)
        else iter(thing.items() if isinstance(thing, Mapping) else ())
    )
    for key, value in pairs:
        name = f"{key:.6g}" if isinstance(key, float) else str(key)
        if isinstance(value, bool | int | float | str):
            found[f"{prefix}{name}"] = value
        elif isinstance(value, np.number | np.bool_):
            found[f"{prefix}{name}"] = value.item()
        elif hasattr(value, "causality") and hasattr(value, "name"):  # a variable
            found |= {f"{prefix}{name}": value.name, f"{prefix}unit": value.unit}
        elif isinstance(value, Mapping) and not prefix:
            found |= _flat(value, f"{name}.")
    return found


def _names(thing: Any) -> list[str]:
    """Its fields, and the figures that its class derives from them."""
    own = [f.name for f in fields(thing) if not f.name.startswith("_")]
    return [*own[:1], *getattr(type(thing), "_figures", ()), *own[1:]]


# ---- out of it -----------------------------------------------------------------------------------
def frame_of(thing: Any) -> pd.DataFrame:
    """The table as a DataFrame. Raises InputError without pandas."""
    pandas = library("pandas", "studies", "to_pandas")
    table = table_of(thing)
    found: pd.DataFrame = pandas.DataFrame(list(table.rows), columns=list(table.head))
    return found


def report_of(thing: Any) -> str:
    """The result as text."""
    return str(thing)


def save_result(thing: Any, path: str | os.PathLike[str]) -> Path:
    """Write a result as its name ends: a page (.html), its table (.csv, .json, .xlsx), its text.

    Raises InputError for another ending, WriteError where nothing can be written.
    """
    from .report import write_report

    require_instance("path", path, (str, os.PathLike), "give the name of a file")
    target = Path(path)
    ending = target.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"{target}: end the name in one of {', '.join(ENDINGS)}")
    if ending == ".html":
        return write_report(target, {type(thing).__name__: thing}, title=type(thing).__name__)
    if ending == ".txt":
        text = f"{thing}\n"
    else:
        table = table_of(thing)
        if ending == ".xlsx":
            return _book(type(thing).__name__, table, target)
        if ending == ".json":
            rows = [dict(zip(table.head, row, strict=True)) for row in table.rows]
            plain = [{n: _finite_or_none(c) for n, c in row.items()} for row in rows]
            return write_json(target, {"kind": type(thing).__name__, "rows": plain})
        text = _csv(table)
    with atomic_path(target) as temporary:
        temporary.write_text(text, "utf-8")
    return target


def _csv(table: Grid) -> str:
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.head)
    writer.writerows(
        [[repr(float(c)) if isinstance(c, float) else c for c in row] for row in table.rows]
    )  # NumPy's own have their type in their repr
    return text.getvalue()


def _book(name: str, table: Grid, path: Path) -> Path:
    from .workbook import Book

    with Book.writing(path, name) as book:
        page = book.sheet(name)
        book.table(page, 0, table.head, table.rows)
        book.heads(page, 1, 1)
        for j, head in enumerate(table.head):
            longest = max(len(cell_text(c)) for c in (head, *(row[j] for row in table.rows)))
            page.set_column(j, j, min(longest, WIDEST) + 3)
    return path


@interruptible()
def plot_table(thing: Any) -> Figure:
    """The columns of numbers of a result's table as bars, a panel each.

    Raises InputError where there is no column of numbers.
    """
    if hasattr(thing, "causality") or hasattr(thing, "parameters"):
        raise InputError(
            f"{kind_of(thing)} holds no motion to draw; simulate or plan one, and draw that"
        )
    table = table_of(thing)
    rows = table.rows[:MOST_ROWS]
    named = [j for j in range(len(table.head)) if any(isinstance(r[j], str) for r in rows)]
    labels = [str(r[named[0]]) if named else str(i + 1) for i, r in enumerate(rows)]
    units = [r[table.head.index("unit")] for r in rows] if "unit" in table.head else []
    if units:
        labels = [f"{n} [{unit}]" for n, unit in zip(labels, units, strict=True)]
    every = [
        j
        for j in range(len(table.head))
        if j not in named and any(_finite(r[j]) for r in rows) and len(rows) > 0
    ]
    numbers = every[:MOST_PANELS]
    if not numbers:
        raise InputError(f"{type(thing).__name__} holds no column of numbers to draw; print it")
    size = (3.0 + 2.2 * len(numbers), 1.4 + 0.28 * len(rows))
    figure, axes = new_figure(1, len(numbers), size=size)

    def first(ax: Axes) -> bool:
        place = ax.get_subplotspec()
        return place is None or place.is_first_col()

    for ax, j in zip(axes[0], numbers, strict=True):
        values = np.array([float(r[j]) if _finite(r[j]) else 0.0 for r in rows])
        timed = table.head[j] == "time"
        words = "time [s]" if timed else table.head[j]
        below = values < 0
        mixed = len(set(units)) > 1 and bool(np.any(values)) and not timed  # nothing in common
        shown = np.abs(values) if mixed else values
        colours = np.where(below & mixed, COLOURS[1], COLOURS[0])
        ax.barh(range(len(rows)), shown, color=colours.tolist(), height=0.6)
        if mixed:
            ax.set_xscale("log")
            words += "\n(orange: negative)" if below.any() else ""
        ax.set_xlabel(words)
        ax.set_yticks(range(len(rows)), labels if first(ax) else [""] * len(rows))
        ax.invert_yaxis()
    caption(axes[0][0], title=_left_out(len(table.rows), len(rows), len(every), len(numbers)))
    return figure


def _left_out(rows: int, shown: int, columns: int, panels: int) -> str:
    """What a picture says of a table that is larger."""
    parts = [f"{shown} of {rows} rows"] if shown < rows else []
    parts += [f"{panels} of {columns} columns"] if panels < columns else []
    return f"the first {', '.join(parts)}" if parts else ""


def _finite_or_none(cell: Any) -> Any:
    return None if isinstance(cell, float) and not np.isfinite(cell) else cell


def _finite(cell: Any) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool) and bool(np.isfinite(cell))
