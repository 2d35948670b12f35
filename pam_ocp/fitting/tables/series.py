"""Signals that carry their name and unit beside their values, as columns: To Workspace structures
of Simulink, captures of dSPACE, channels in JSON.

A tree of nested data is rewritten before tables are sought in it: ``{"p": {"unit": "bar",
"values": [...]}}`` becomes ``{"p [bar]": [...]}``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .headers import TIME_NAMES, is_unit, plain

__all__ = ["flat", "rewritten"]

_VALUES = ("values", "value", "data", "samples", "y")
_NAMES = ("label", "name", "signal", "channel", "title", "id")
_UNITS = ("unit", "units", "y_unit", "unit_string")
MOST_LEVELS = 20
MOST_SIGNALS = 2000
MOST_WIDTH = 64
"""Signals of one array."""


def rewritten(tree: Any, level: int = 0, owner: str = "") -> Any:
    """The tree with signals as columns, and records within records flattened."""
    if level > MOST_LEVELS:
        return tree
    if isinstance(tree, Mapping):
        return _of_dspace(tree) or _of_simulink(tree, owner) or _of_mapping(tree, level)
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
            made[_headed(str(key), inside)] = inside[at]
        else:
            made[key] = value
    return dict(flat(made))


def _of_mapping(tree: Mapping[Any, Any], level: int) -> dict[str, Any]:
    made: dict[str, Any] = {}
    tree = _with_units(tree)
    for key, value in tree.items():
        named = _signals(value, str(key)) if isinstance(value, Mapping) else {}
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
        named = _signals(one, "") if isinstance(one, Mapping) else {}
        if not named:
            return {}
        for name, column in named.items():
            name = name or f"signal {number}"
            found[name if name not in found else f"{name} ({number})"] = column
    return found


def _signals(one: Mapping[Any, Any], key: str, length: int | None = None) -> dict[str, list[Any]]:
    """The columns of one signal; {} where the mapping is none. key : its name if it has none."""
    inside = _lower(one)
    at = next((n for n in _VALUES if n in inside), None)
    if at is None or any(n in inside for n in (*TIME_NAMES, "x")):
        return {}
    columns = _columns(inside[at], length)
    if not columns:
        return {}
    own = next((t for n in _NAMES if (t := _text(inside.get(n)))), "")
    header = _headed(key if key and (not own or at != "values") else own, inside)
    if len(columns) == 1:
        return {header: columns[0]}
    name, _, tail = header.partition(" [")
    return {f"{name} {i}{f' [{tail}' if tail else ''}": c for i, c in enumerate(columns, start=1)}


def _headed(name: str, inside: Mapping[str, Any]) -> str:
    said = next((t for n in _UNITS if (t := _text(inside.get(n)))), "").strip("[]() ")
    return f"{name} [{said}]" if said and said != "-" and "[" not in name and name else name


def _columns(values: Any, length: int | None) -> list[list[Any]]:
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
    time = _columns(tree.get("time"), None)
    length = len(time[0]) if time else None
    block = _text(tree.get("blockName")).rpartition("/")[2]
    made: dict[str, Any] = {"time [s]": time[0]} if time else {}
    for number, one in enumerate(several, start=1):
        fallback = owner or block or "signal"
        fallback += f" {number}" if len(several) > 1 else ""
        said = _text(one.get("label")) or _text(one.get("title"))
        for name, column in _signals({**one, "label": said or fallback}, "", length).items():
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
        columns, at = _columns(signal["Data"], None), place - first
        if not columns:
            continue
        table = tables.setdefault(at, {"time [s]": (_columns(clocks[at]["Data"], None) or [[]])[0]})
        name = _headed(_of_path(signal), _lower(signal))
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
