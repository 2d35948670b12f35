"""Tables within nested data (MATLAB structures, HDF5, JSON, npz): found, or chosen by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, UnknownNameError
from ...core.files import MOST_CELLS, require_size
from .cells import decimal_of, is_number
from .dialect import Grid, Unsaid
from .headers import TIME_NAMES, plain
from .raw import RawTable
from .series import rewritten
from .topics import clocked, merged

__all__ = ["Found", "chosen_table", "left_out"]

Found = Mapping[str, Sequence[Any]] | Grid
"""Columns by name, or cells that a layout must be found in."""
TIME_OF = {*TIME_NAMES, *(f"{name} [s]" for name in TIME_NAMES)}
GENERIC = frozenset({"v", "value", "values", "data", "samples", "y", "messages", "signal"})
"""Names that say nothing of what was measured."""
MOST_LEVELS = 20
MOST_TABLES = 2000


def chosen_table(
    tree: Any, label: str, pick: str | Sequence[str] | None
) -> tuple[Found | RawTable, tuple[str, ...]]:
    """(the table of a tree, which it is).

    pick : its name, as ``run.data`` or ``runs[2]``, or several to be put on one clock; needed where
    there are several that do not have clocks of their own. Raises an InputError that names them.
    """
    _require_few(label, list(_arrays(tree, 0)))
    tables = _renamed(dict(_tables(rewritten(tree), "", label, 0)))
    wanted = [pick] if isinstance(pick, str) else list(pick or ())
    for name in wanted:
        if name.strip() not in tables:
            raise UnknownNameError(f"table of {label}", name, tables)
    if len(wanted) == 1:
        return tables[wanted[0].strip()], _beside(tables, wanted[0].strip())
    if wanted:
        several = {n.strip(): tables[n.strip()] for n in wanted}
        if not clocked(several):
            raise InputError(
                f"pick = {wanted!r}: to put tables on one clock each needs a time of its own, and "
                "columns of other names; choose one"
            )
        return merged(several, label), ()  # type: ignore[arg-type]
    if not tables:
        raise InputError(
            f"{label} holds no table: it needs columns of one length, or a matrix of numbers"
        )
    whole = [n for n in tables if n == ""]
    top = whole or list(tables)
    if clocked({n: tables[n] for n in top}):
        return merged({n: tables[n] for n in top}, label), ()  # type: ignore[misc]
    if len(top) > 1:
        shown = ", ".join(f"{n!r} ({_size(tables[n])})" for n in top[:8])
        more = f" and {len(top) - 8} more" if len(top) > 8 else ""
        raise Unsaid(
            f"{label} holds {len(top)} tables: {shown}{more}; choose one with pick={top[0]!r}"
        )
    return tables[top[0]], _beside(tables, top[0])


def _renamed(tables: dict[str, Found]) -> dict[str, Found]:
    """Tables of a time and one value each, which is called by its place: ``sensors.p.samples``."""
    if len(tables) < 2 or not all(
        isinstance(t, Mapping) and len(t) == 2 and sum(n in TIME_OF for n in map(plain, t)) == 1
        for t in tables.values()
    ):
        return tables
    made: dict[str, Found] = {}
    for name, table in tables.items():
        assert isinstance(table, Mapping)
        parts = [p for p in name.split(".") if p.lower() not in GENERIC]
        columns = {parts[-1] if plain(n) in GENERIC and parts else n: c for n, c in table.items()}
        made[name] = columns if len(columns) == 2 else table
    return made


def left_out(tree: Any, label: str, found: Found | RawTable) -> tuple[str, ...]:
    """Which rows of numbers of a tree are not in its table, in words."""
    if not isinstance(tree, Mapping) or isinstance(found, Grid):
        return ()
    columns = found.columns if isinstance(found, RawTable) else found
    taken = set(columns)
    lost = []
    for key, value in rewritten(tree).items():
        inside = value.items() if isinstance(value, Mapping) else [(key, value)]
        for name, one in inside:
            column = _vector(one)
            known = {str(name), f"{key} {name}", str(key)} & taken
            if column and len(column) > 2 and not _is_text(column) and not known:
                lost.append(f"{name if name == key else f'{key}.{name}'} ({len(column)})")
    if not lost:
        return ()
    more = f" and {len(lost) - 8} more" if len(lost) > 8 else ""
    return (f"not in the table, for they have other lengths: {', '.join(lost[:8])}{more}",)


def _require_few(label: str, arrays: Sequence[NDArray[Any]]) -> None:
    """Bounds what arrays hold before they become lists, which take four times as much."""
    require_size(label, max((max(a.shape, default=0) for a in arrays), default=0), 1)
    cells = sum(a.size for a in arrays)
    if cells > MOST_CELLS:
        raise InputError(
            f"{label} holds {cells} numbers, more than the {MOST_CELLS} allowed; keep what is "
            "needed, or cut it into several files"
        )


def _arrays(tree: Any, level: int) -> Iterator[NDArray[Any]]:
    """The arrays of numbers within a tree."""
    if isinstance(tree, np.ndarray) and tree.dtype != object:
        yield tree
    elif isinstance(tree, Mapping | list | tuple | np.ndarray) and level <= MOST_LEVELS:
        inner = tree.values() if isinstance(tree, Mapping) else tree
        nested = (Mapping, list, tuple, np.ndarray)
        yield from (a for i in inner if isinstance(i, nested) for a in _arrays(i, level + 1))


def _beside(tables: Mapping[str, Found], taken: str) -> tuple[str, ...]:
    return (f"table {taken!r}",) if taken else ()


def _size(table: Found) -> str:
    if isinstance(table, Grid):
        return f"{len(table.rows)} x {max(map(len, table.rows), default=0)}"
    return f"{', '.join(list(table)[:4])}: {max(map(len, table.values()))} rows"


def _tables(tree: Any, name: str, label: str, level: int) -> Iterator[tuple[str, Found]]:
    """(name, table) of all that are in a tree, by depth."""
    if level > MOST_LEVELS:
        return
    if isinstance(tree, Mapping):
        yield from _of_mapping(tree, name, label, level)
    elif isinstance(tree, np.ndarray) and tree.dtype == object:
        yield from _of_cells(tree, name, label, level)
    elif isinstance(tree, np.ndarray) and tree.dtype.names:
        fields = {n: tree[n].ravel().tolist() for n in tree.dtype.names}
        yield from _tables(fields, name, label, level + 1)
    elif isinstance(tree, np.ndarray):
        matrix = _matrix(tree)
        if matrix is not None and min(matrix.shape) >= 2:
            yield name, _grid(matrix.tolist(), label)
    elif isinstance(tree, list | tuple):
        yield from _of_list(tree, name, label, level)


def _of_mapping(
    tree: Mapping[str, Any], name: str, label: str, level: int
) -> Iterator[tuple[str, Found]]:
    columns = _columns(tree)
    headed = None if columns else _headed(tree)
    if headed is not None:
        yield name, _grid(headed, label)
        return
    if columns:
        yield name, columns
    below = [k for k in tree if _vector(tree[k]) is None or not columns]
    for count, key in enumerate(below):
        if count > MOST_TABLES:
            break
        if not (columns and isinstance(tree[key], np.ndarray) and tree[key].dtype != object):
            yield from _tables(tree[key], f"{name}.{key}" if name else str(key), label, level + 1)


def _columns(tree: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The columns of a mapping: its rows of the commonest length; {} where fewer than two are.

    A matrix of as many rows gives several columns.
    """
    vectors = {str(k): v for k, v in ((k, _vector(v)) for k, v in tree.items()) if v is not None}
    lengths = Counter(len(v) for v in vectors.values() if len(v) > 1 and not _is_text(v))
    if not lengths:
        return {}
    length = max(lengths, key=lambda n: (lengths[n], n))
    found = {k: v for k, v in vectors.items() if len(v) == length}
    for key, value in tree.items():
        for name, column in _signals(value):
            if len(column) == length:
                found[name if name not in found else f"{key} {name}"] = column
    for key, value in tree.items():
        matrix = _matrix(value) if isinstance(value, np.ndarray) and value.ndim == 2 else None
        if matrix is not None and min(matrix.shape) >= 2 and length in matrix.shape and found:
            upright = matrix if matrix.shape[0] == length else matrix.T
            found |= {f"{key} {i + 1}": c.tolist() for i, c in enumerate(upright.T)}
    return found if len(found) >= 2 else {}


def _signals(value: Any) -> Iterator[tuple[str, list[Any]]]:
    """Columns one level below those beside them, where they have no clock of their own."""
    several = value if isinstance(value, list | tuple) else [value]
    for one in several[:MOST_TABLES]:
        if not isinstance(one, Mapping) or any(plain(str(n)) in TIME_OF for n in one):
            continue
        for name, column in one.items():
            values = _vector(column)
            if values is not None and not _is_text(values):
                yield str(name), values


def _is_text(cells: Sequence[Any]) -> bool:
    return all(isinstance(c, str) and not is_number(c, decimal_of([c])) for c in cells)


def _headed(tree: Mapping[str, Any]) -> list[list[Any]] | None:
    """A matrix with the list of its names beside it, as rows; None where there is no such pair."""
    matrices = []
    for value in tree.values():
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "biuf":
            matrices.append(value.tolist())
        elif isinstance(value, list) and value and all(isinstance(r, list) for r in value):
            rows = [[_plain(c) for c in row] for row in value]
            if all(c is not _NESTED for r in rows for c in r):
                matrices.append(rows)
    texts = [v for v in map(_vector, tree.values()) if v and len(v) > 1 and _is_text(v)]
    if len(matrices) != 1:
        return None
    for names in texts:
        if all(len(row) == len(names) for row in matrices[0]):
            return [names, *matrices[0]]
        if len(matrices[0]) == len(names):
            return [names, *map(list, zip(*matrices[0], strict=True))]
    return None


def _vector(value: Any) -> list[Any] | None:
    """A row or a column of plain values; None for anything else."""
    if isinstance(value, np.ndarray):
        if value.dtype.names or value.ndim == 0 or max(value.shape, default=0) != value.size:
            return None
        if value.dtype == object:
            cells = [_plain(v) for v in value.ravel()]
            return cells if all(c is not _NESTED for c in cells) else None
        return list(value.ravel().tolist())
    if isinstance(value, list | tuple):
        cells = [_plain(v) for v in value]
        return cells if all(c is not _NESTED for c in cells) else None
    return None


_NESTED = object()


def _plain(value: Any) -> Any:
    """One number or text; None for nothing; _NESTED for more."""
    if isinstance(value, np.ndarray):
        if value.size == 0:
            return None
        return value.ravel()[0].item() if value.size == 1 and value.dtype != object else _NESTED
    if value is None or isinstance(value, str | int | float | np.generic):
        return value
    return _NESTED


def _matrix(value: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
    """Numbers in rows and columns, the longer way down."""
    if value.ndim != 2 or value.size == 0 or value.dtype.kind not in "biuf":
        return None
    return value if value.shape[0] >= value.shape[1] else value.T


def _grid(rows: list[Any], label: str) -> Grid:
    texts = [c for row in rows[:400] for c in row if isinstance(c, str)]
    return Grid(label, rows, list(range(1, len(rows) + 1)), decimal_of(texts))


def _of_cells(
    tree: np.ndarray[Any, Any], name: str, label: str, level: int
) -> Iterator[tuple[str, Found]]:
    """Cells of MATLAB: rows of names and numbers, or tables within."""
    plain = [[_plain(v) for v in row] for row in tree.reshape(tree.shape[0], -1)]
    if tree.ndim == 2 and min(tree.shape) >= 2 and all(c is not _NESTED for r in plain for c in r):
        yield name, _grid(plain, label)
        return
    for number, value in enumerate(tree.ravel(order="F"), start=1):
        if number > MOST_TABLES:
            break
        yield from _tables(value, f"{name}[{number}]", label, level + 1)


def _of_list(tree: Sequence[Any], name: str, label: str, level: int) -> Iterator[tuple[str, Found]]:
    """Records (mappings of plain values), rows of cells, or tables within."""
    if len(tree) > 1 and all(isinstance(r, Mapping) for r in tree):
        keys = list(dict.fromkeys(str(k) for r in tree for k in r))
        flat = [{str(k): _plain(v) for k, v in r.items()} for r in tree]
        kept = [k for k in keys if all(r.get(k) is not _NESTED for r in flat)]
        if len(kept) >= 2 and any(isinstance(r.get(k), int | float) for r in flat for k in kept):
            rows = {k: [r.get(k) for r in flat] for k in kept}
            nested = len(kept) < len(keys)
            if not nested:
                yield name, rows
                return
    elif len(tree) > 1 and all(isinstance(r, list | tuple) for r in tree):
        rows_ = [[_plain(c) for c in row] for row in tree]
        if all(c is not _NESTED for row in rows_ for c in row) and max(map(len, rows_)) >= 2:
            yield name, _grid(rows_, label)
            return
    for number, value in enumerate(tree[:MOST_TABLES], start=1):
        if isinstance(value, Mapping | list | tuple | np.ndarray):
            yield from _tables(value, f"{name}[{number}]", label, level + 1)
