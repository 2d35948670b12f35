"""Tables within nested data (MATLAB structures, HDF5, JSON, npz): found, or chosen by name.

Signals that carry their name and unit beside their values (To Workspace structures of Simulink,
captures of dSPACE, channels in JSON) are rewritten as columns before tables are sought:
``{"p": {"unit": "bar", "values": [...]}}`` becomes ``{"p [bar]": [...]}``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, UnknownNameError
from ...core.files import MOST_CELLS, require_size
from ...core.foreign import unpacked
from .blocks import clocked, merged
from .cells import TIME_NAMES, decimal_of, is_number, is_unit, plain
from .dialect import Grid, Unsaid
from .raw import RawTable

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
    """(the table of a tree, which it is). pick : its name, as ``run.data`` or ``runs[2]``, or
    several to be put on one clock; needed where there are several that do not have clocks of their
    own.
    """
    _require_few(label, list(_arrays(tree, 0)))
    tables = _renamed(dict(_tables(rewritten(tree), "", label, 0)))
    wanted = [n.strip() for n in ([pick] if isinstance(pick, str) else pick or ())]
    for name in wanted:
        if name not in tables:
            raise UnknownNameError(f"table of {label}", name, tables)
    if not tables:
        raise InputError(
            f"{label} holds no table: it needs columns of one length, or a matrix of numbers"
        )
    top = wanted or ([""] if "" in tables else list(tables))
    if len(top) == 1:
        return tables[top[0]], (f"table {top[0]!r}",) if top[0] else ()
    several = {n: tables[n] for n in top}
    if clocked(several):
        return merged(several, label), ()  # type: ignore[arg-type]
    if wanted:
        raise InputError(
            f"pick = {wanted!r}: to put tables on one clock each needs a time of its own, and "
            "columns of other names; choose one"
        )
    shown = ", ".join(f"{n!r} ({_size(tables[n])})" for n in top[:8])
    more = f" and {len(top) - 8} more" if len(top) > 8 else ""
    raise Unsaid(f"{label} holds {len(top)} tables: {shown}{more}; choose one with pick={top[0]!r}")


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


_FACTORS = {"scale": 1.0, "scaling": 1.0, "factor": 1.0, "gain": 1.0, "slope": 1.0, "offset": 0.0}
"""Words for a calibration, with the number that changes nothing. CF's are applied."""


def not_applied(tree: Any, name: str = "", level: int = 0) -> tuple[str, ...]:
    """In words, which numbers beside values look like a calibration that nobody applied."""
    if level > MOST_LEVELS or not isinstance(tree, Mapping | list):
        return ()
    if isinstance(tree, list):
        inner = [t for one in tree[:MOST_SIGNALS] for t in not_applied(one, name, level + 1)]
        return tuple(dict.fromkeys(inner))
    inside = _lower(tree)
    own = next((t for n in _NAMES if (t := _text(inside.get(n)))), name)
    beside = [
        f"{word} = {inside[word]:g}"
        for word, plain in _FACTORS.items()
        if isinstance(inside.get(word), int | float) and inside[word] != plain
    ]
    if beside and any(n in inside for n in _VALUES):
        return (
            f"{own}: {' and '.join(beside)} beside its values taken as applied already; if not, "
            "multiply them, or say a calibration in units=",
        )
    several = (not_applied(v, str(k), level + 1) for k, v in tree.items())
    return tuple(dict.fromkeys(t for found in several for t in found))


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


def _size(table: Found) -> str:
    if isinstance(table, Grid):
        return f"{len(table.rows)} x {max(map(len, table.rows), default=0)}"
    return f"{', '.join(list(table)[:4])}: {max(map(len, table.values()))} rows"


def _tables(tree: Any, name: str, label: str, level: int) -> Iterator[tuple[str, Found]]:
    """(name, table) of all that are in a tree, by depth."""
    if level > MOST_LEVELS:
        return
    if isinstance(tree, Grid):
        yield name, tree
    elif isinstance(tree, Mapping):
        yield from _of_mapping(tree, name, label, level)
    elif isinstance(tree, list | tuple) or (isinstance(tree, np.ndarray) and tree.dtype == object):
        yield from _of_several(tree, name, label, level)
    elif isinstance(tree, np.ndarray) and tree.dtype.names:
        fields = {n: tree[n].ravel().tolist() for n in tree.dtype.names}
        yield from _tables(fields, name, label, level + 1)
    elif isinstance(tree, np.ndarray):
        matrix = _matrix(tree)
        if matrix is not None and min(matrix.shape) >= 2:
            yield name, _grid(matrix.tolist(), label)


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
    """The columns of a mapping: its rows of the commonest length (two at least; also matrices')."""
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
            rows = _rows(value)
            matrices += [rows] if rows is not None else []
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
        return _row(value.ravel()) if value.dtype == object else list(value.ravel().tolist())
    return _row(value) if isinstance(value, list | tuple) else None


_NESTED = object()


def _row(values: Iterable[Any]) -> list[Any] | None:
    """Plain values; None where one holds more."""
    cells = [_plain(v) for v in values]
    return None if any(c is _NESTED for c in cells) else cells


def _rows(values: Iterable[Iterable[Any]]) -> list[list[Any]] | None:
    """Rows of plain values; None where one holds more."""
    rows = []
    for one in values:
        row = _row(one)
        if row is None:
            return None
        rows.append(row)
    return rows


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


def _of_several(
    tree: Sequence[Any] | np.ndarray[Any, Any], name: str, label: str, level: int
) -> Iterator[tuple[str, Found]]:
    """Records (mappings of plain values), rows of cells, or tables within."""
    inside: Sequence[Any] | np.ndarray[Any, Any] = tree
    if isinstance(tree, np.ndarray):
        rowed, inside = tree.ndim == 2, tree.ravel(order="F")
    else:
        rowed = all(isinstance(r, list | tuple) for r in tree)
    if len(tree) > 1 and all(isinstance(r, Mapping) for r in tree):
        keys = list(dict.fromkeys(str(k) for r in tree for k in r))
        flat = [{str(k): _plain(v) for k, v in r.items()} for r in tree]
        values = [v for r in flat for v in r.values()]
        nested = any(v is _NESTED for v in values)
        if len(keys) >= 2 and not nested and any(isinstance(v, int | float) for v in values):
            yield name, {k: [r.get(k) for r in flat] for k in keys}
            return
    elif len(tree) > 1 and rowed:
        rows = _rows(tree)
        if rows is not None and max(map(len, rows)) >= 2:
            yield name, _grid(rows, label)
            return
    for number, value in enumerate(inside[:MOST_TABLES], start=1):
        yield from _tables(value, f"{name}[{number}]", label, level + 1)


# ---- signals with their names and units beside them ----------------------------------------------
_VALUES = ("values", "value", "data", "samples", "y")
_NAMES = ("label", "name", "signal", "channel", "title", "id")
_UNITS = ("unit", "units", "y_unit", "unit_string")
MOST_SIGNALS = 2000
MOST_WIDTH = 64
"""Signals of one array."""


def rewritten(tree: Any, level: int = 0, owner: str = "") -> Any:
    """The tree with signals as columns, and records within records flattened."""
    if level > MOST_LEVELS:
        return tree
    if isinstance(tree, Mapping):
        return _of_dspace(tree) or _of_simulink(tree, owner) or _rewritten_mapping(tree, level)
    cells = isinstance(tree, np.ndarray) and tree.dtype == object and tree.ndim <= 2
    if cells and tree.size and all(isinstance(v, Mapping) for v in tree.flat):
        tree = list(tree.flat)
    if isinstance(tree, list | tuple) and tree and all(isinstance(v, Mapping) for v in tree):
        found = _channels(tree)
        if found:
            return found
        inner = [v for one in tree[:20] for v in one.values() if isinstance(v, Mapping | list)]
        if any(isinstance(v, list) and len(v) >= max(len(tree), 2) for v in inner):
            return [rewritten(one, level + 1) for one in tree]  # runs, each with its columns
        if inner:
            return [_of_record(one) for one in tree]
    return tree


def flat(record: Mapping[Any, Any], prefix: str = "", level: int = 0) -> Iterator[tuple[str, Any]]:
    """(path, plain value) of all in a record of records: ``sensors.p``, ``q.1``."""
    for key, value in record.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, Mapping) and level < MOST_LEVELS:
            yield from flat(value, name, level + 1)
        elif isinstance(value, list | tuple) and 0 < len(value) <= MOST_WIDTH:
            labels = record.get("name")
            named = isinstance(labels, list) and len(labels) == len(value) and key != "name"
            tails = labels if named and labels else list(range(len(value)))
            for i, one in enumerate(value):
                inner = f"{name}.{tails[i]}"
                if isinstance(one, Mapping) and level < MOST_LEVELS:
                    yield from flat(one, inner, level + 1)
                elif not isinstance(one, list | tuple):
                    yield inner, one
        elif not isinstance(value, list | tuple):
            yield name, value


def _of_record(record: Mapping[Any, Any]) -> dict[str, Any]:
    """A record flattened; a number with its unit is one: ``{"p": {"value": 2, "unit": "bar"}}``."""
    made: dict[Any, Any] = {}
    for key, value in record.items():
        inside = _lower(value) if isinstance(value, Mapping) else {}
        if {"sec", "nanosec"} == set(inside) or {"secs", "nsecs"} == set(inside):
            seconds, rest = inside.values()
            made[f"{key} [s]"] = seconds + 1e-9 * rest
            continue
        at = next((n for n in _VALUES if n in inside), None)
        if at is not None and not isinstance(inside[at], Mapping | list):
            made[_with_unit(str(key), inside)] = inside[at]
        else:
            made[key] = value
    return dict(flat(made))


def _rewritten_mapping(tree: Mapping[Any, Any], level: int) -> dict[str, Any]:
    made: dict[str, Any] = {}
    tree = _with_units(tree)
    for key, value in tree.items():
        named = _signal_columns(value, str(key)) if isinstance(value, Mapping) else {}
        if not named and isinstance(value, list | tuple):
            named = _channels(value)
            if named and (len(named) > 1 and len({len(c) for c in named.values()}) > 1):
                named = {}
        if named:
            for name, column in named.items():
                made[name if name not in made else f"{key} {name}"] = column
        else:
            made[str(key)] = rewritten(value, level + 1, str(key))
    return made


def _with_units(tree: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """Names with the units that a mapping beside them states: ``{"units": {"p": "bar"}, ...}``."""
    at = next((k for k in tree if str(k).lower() in ("units", "unit", "einheiten")), None)
    if at is None or not isinstance(tree[at], Mapping):
        return tree
    units = {k: t for k, v in tree[at].items() if (t := _text(v))}

    def named(one: Mapping[Any, Any]) -> dict[Any, Any]:
        return {f"{k} [{units[k]}]" if k in units else k: v for k, v in one.items()}

    made = named({k: v for k, v in tree.items() if k != at})
    return {k: named(v) if isinstance(v, Mapping) else v for k, v in made.items()}


def _channels(several: Sequence[Any]) -> dict[str, list[Any]]:
    """Columns of a list of signals, each with its name and values; {} where it is none."""
    found: dict[str, list[Any]] = {}
    for number, one in enumerate(several[:MOST_SIGNALS], start=1):
        named = _signal_columns(one, "") if isinstance(one, Mapping) else {}
        if not named:
            return {}
        for name, column in named.items():
            name = name or f"signal {number}"
            found[name if name not in found else f"{name} ({number})"] = column
    return found


def _signal_columns(
    one: Mapping[Any, Any], key: str, length: int | None = None
) -> dict[str, list[Any]]:
    """The columns of one signal; {} where the mapping is none. key : its name if it has none."""
    inside = _lower(one)
    at = next((n for n in _VALUES if n in inside), None)
    if at is None or any(n in inside for n in (*TIME_NAMES, "x")):
        return {}
    columns = [list(unpacked(c, one)) for c in _array_columns(inside[at], length)]
    if not columns:
        return {}
    own = next((t for n in _NAMES if (t := _text(inside.get(n)))), "")
    header = _with_unit(key if key and (not own or at != "values") else own, inside)
    if len(columns) == 1:
        return {header: columns[0]}
    name, _, tail = header.partition(" [")
    return {f"{name} {i}{f' [{tail}' if tail else ''}": c for i, c in enumerate(columns, start=1)}


def _with_unit(name: str, inside: Mapping[str, Any]) -> str:
    said = next((t for n in _UNITS if (t := _text(inside.get(n)))), "").strip("[]() ")
    return f"{name} [{said}]" if said and said != "-" and "[" not in name and name else name


def _array_columns(values: Any, length: int | None) -> list[list[Any]]:
    """Columns of an array; the way down is the length where it is known, else the longer one."""
    if isinstance(values, list | tuple):
        if len(values) < 2 or any(isinstance(v, Mapping) for v in values):
            return []
        if any(isinstance(v, list | tuple) for v in values):
            if len({len(v) if isinstance(v, list | tuple) else 0 for v in values}) != 1:
                return []
            values = np.array(values)
        else:
            return [list(values)]
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf" or values.size < 2:
        return []
    array = np.squeeze(values)
    if array.ndim == 3:  # k x 1 x n was squeezed; k x m x n is a matrix at each time
        array = array.reshape(-1, array.shape[2])
    if array.ndim == 2:
        across = (
            array.shape[0] != length if length in array.shape else array.shape[0] < array.shape[1]
        )
        array = array.T if across else array
        return [c.tolist() for c in array.T] if array.shape[1] <= MOST_WIDTH else []
    return [array.tolist()] if array.ndim == 1 else []


def _of_simulink(tree: Mapping[Any, Any], owner: str) -> dict[str, Any]:
    """A structure with time, or without: ``time``, ``signals.values``, ``signals.label``."""
    signals = tree.get("signals")
    several = signals if isinstance(signals, list) else [signals]
    if not all(isinstance(s, Mapping) and "values" in s for s in several):
        return {}
    time = _array_columns(tree.get("time"), None)
    length = len(time[0]) if time else None
    block = _text(tree.get("blockName")).rpartition("/")[2]
    made: dict[str, Any] = {"time [s]": time[0]} if time else {}
    for number, one in enumerate(several, start=1):
        fallback = owner or block or "signal"
        fallback += f" {number}" if len(several) > 1 else ""
        said = _text(one.get("label")) or _text(one.get("title"))
        for name, column in _signal_columns({**one, "label": said or fallback}, "", length).items():
            made[name if name not in made else f"{name} ({number})"] = column
    return made if len(made) > bool(time) else {}


def _of_dspace(tree: Mapping[Any, Any]) -> dict[str, Any]:
    """A capture: ``X`` holds the clocks, ``Y`` the signals, each with Name and Data; XIndex says
    which clock a signal has. Signals of several clocks become several tables.
    """
    if not {"X", "Y"} <= set(tree):
        return {}
    clocks, signals = (
        [one for one in (v if isinstance(v, list) else [v]) if isinstance(one, Mapping)]
        for v in (tree["X"], tree["Y"])
    )
    if not clocks or not signals or not all("Data" in one for one in (*clocks, *signals)):
        return {}
    tables: dict[int, dict[str, Any]] = {}
    places = [int(np.ravel(s["XIndex"])[0]) if np.size(s.get("XIndex", ())) else 1 for s in signals]
    first = min(1, *places)  # some count from 0
    if max(places) - first >= len(clocks):
        return {}
    for signal, place in zip(signals, places, strict=True):
        columns, at = _array_columns(signal["Data"], None), place - first
        if not columns:
            continue
        clock = _with_unit("time", {"unit": "s", **_lower(clocks[at])})
        table = tables.setdefault(
            at, {clock: (_array_columns(clocks[at]["Data"], None) or [[]])[0]}
        )
        name = _with_unit(_of_path(signal), _lower(signal))
        table[name if name not in table else f"{name} ({len(table)})"] = columns[0]
    if len(tables) == 1:
        return next(iter(tables.values()))
    return {f"raster {at + 1}": table for at, table in sorted(tables.items())}


def _of_path(signal: Mapping[Any, Any]) -> str:
    """The name of a signal of a model: the last part of its path that says something."""
    whole = _text(signal.get("Name")) or _text(signal.get("Path"))
    parts = [p for p in whole.replace('"', "").replace("'", "").split("/") if p.strip()]
    if len(parts) > 1 and is_unit(parts[-1]) and len(parts) == 2:
        return whole  # p/bar
    more = [p for p in _text(signal.get("Path")).replace('"', "").split("/") if p.strip()]
    kept = [
        p for p in (*more, *parts) if plain(p).rstrip("0123456789 ") not in ("out", "in", "value")
    ]
    return (kept or parts or ["signal"])[-1].strip()


def _lower(one: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(k).lower(): v for k, v in one.items()}


def _text(value: Any) -> str:
    """A text, also of an array of one."""
    if isinstance(value, np.ndarray):
        value = value.flat[0] if value.size else ""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.strip() if isinstance(value, str) else ""
