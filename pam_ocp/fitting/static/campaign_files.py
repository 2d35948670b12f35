"""Which muscle a table of a campaign belongs to: words of the user, columns, the file's name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...core.errors import InputError, PamError, kind_of, require_positive
from ...core.files import require_local
from ...core.units import unit
from ..tables.cells import branch_of, is_unit, parse_header
from ..tables.force_table import ForceTable, joined_tables, read_table
from ..tables.sources import ENDINGS, is_readable, load

__all__ = ["Measured", "collected", "joined"]

IDLE = {"static", "isometric", "force", "forces", "table", "measured", "data", "cells", "map"}
"""Words of a file's name that say nothing of the muscle."""
_NUMBER = r"(\d+(?:[.p]\d+)?)"
_SIZED = re.compile(
    rf"(?:^|[^0-9a-z.]){_NUMBER}[-_x]{_NUMBER}(?:mm|n)?(?=$|[^0-9a-z])", re.IGNORECASE
)
_LENGTH = re.compile(
    rf"(?:^|[^a-z])(?:l0?|len|length)[=_-]?{_NUMBER}(mm|cm|m)?(?=$|[^0-9a-z])", re.I
)
_DIAMETER = re.compile(
    rf"(?:^|[^a-z])(?:d0?|dia|diameter)[=_-]?{_NUMBER}(mm|cm|m)?(?=$|[^0-9a-z])", re.I
)
_RUN = re.compile(r"^(?:run|rep|repeat|trial|r|no)[-=]?(\d+)$", re.IGNORECASE)
_COLUMNS = {
    "muscle": ("muscle", "specimen", "sample", "name"),
    "rest_length": ("rest length", "l0"),
    "diameter": ("diameter", "d0", "inner diameter"),
}
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True, eq=False)
class Measured:
    """A table and whose it is. rest_length, diameter : [m], None where nothing says it."""

    muscle: str
    table: ForceTable
    diameter: float | None


def collected(
    source: Any,
    rest_length: float | Mapping[str, float] | None,
    diameter: float | Mapping[str, float] | None,
    reading: Mapping[str, Any],
) -> tuple[list[Measured], dict[str, str]]:
    """The tables of a campaign, and the files that could not be read, with the reason.

    Raises InputError where there is none.
    """
    found: list[Measured] = []
    failed: dict[str, str] = {}
    for name, one in _sources(source):
        if isinstance(one, ForceTable):
            size = _said(diameter, name) or _sizes(name)[1]
            length = _said(rest_length, name) or one.rest_length or _sizes(name)[0]
            found.append(Measured(name, replace(one, rest_length=length), size))
            continue
        try:
            found += _read(name, one, rest_length, diameter, reading)
        except PamError as error:
            failed[name] = str(error)
    if not found:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(failed.items())[:3])
        raise InputError(f"no table of a campaign could be read: {reasons or 'there is no file'}")
    return found, failed


def _sources(source: Any) -> list[tuple[str, Any]]:
    if isinstance(source, ForceTable):
        return [(source.source or "table", source)]
    if isinstance(source, Mapping):
        return [(str(n), t) for n, t in source.items()]
    if isinstance(source, (str, Path)):
        require_local(source)
        folder = Path(source)
        if not folder.is_dir():
            raise InputError(
                f"{folder} is no folder: give a folder of tables, a list of files, or "
                "{muscle: table}"
            )
        paths = sorted(p for p in folder.rglob("*") if is_readable(p))
        return [(p.name, p) for p in paths]
    if not isinstance(source, Iterable):
        raise InputError(f"tables is {kind_of(source)}: give a folder, files or tables")
    return [
        (t.source or str(i + 1), t) if isinstance(t, ForceTable) else (Path(t).name, t)
        for i, t in enumerate(source)
    ]


def _read(
    name: str,
    source: Any,
    rest_length: Any,
    diameter: Any,
    reading: Mapping[str, Any],
) -> list[Measured]:
    """The tables of one file, one for each muscle that a column names."""
    muscle, branch, run = _named(name if isinstance(source, (str, Path)) else f"{name}.table")
    parts: list[tuple[str, Any, dict[str, float]]] = [(muscle, source, {})]
    raw = load(source)
    columns = {
        key: header
        for key, words in _COLUMNS.items()
        for header in raw.columns
        if parse_header(str(header))[0] in words
    }
    if columns:
        parts = _split(raw.columns, columns, muscle)
    found = []
    for own, part, told in parts:
        length = _said(rest_length, own) or told.get("rest_length") or _sizes(own)[0]
        width = _said(diameter, own) or told.get("diameter") or _sizes(own)[1]
        table = read_table(part, rest_length=length, **reading)
        labels: dict[str, Any] = {"source": name}
        if branch and not table.branch:
            labels["branch"] = (branch,) * len(table)
        if run and not table.run:
            labels["run"] = (run,) * len(table)
        found.append(Measured(own, replace(table, **labels), width))
    return found


def _split(
    columns: Mapping[str, Sequence[Any]], keys: Mapping[str, str], muscle: str
) -> list[tuple[str, Any, dict[str, float]]]:
    """(muscle, its columns, sizes that columns tell [m])."""
    count = len(next(iter(columns.values())))
    names = [str(n) for n in columns[keys["muscle"]]] if "muscle" in keys else [muscle] * count
    sized = {key: [float(v) for v in columns[keys[key]]] for key in keys if key != "muscle"}
    rows: dict[tuple[Any, ...], list[int]] = {}
    for i in range(count):
        rows.setdefault((names[i], *(sized[k][i] for k in sized)), []).append(i)
    found = []
    for key, chosen in rows.items():
        told = {k: v * _scale(keys[k], v) for k, v in zip(sized, key[1:], strict=True)}
        own = names[chosen[0]]
        if "muscle" not in keys and len(rows) > 1:
            own = f"{muscle} {', '.join(f'{1e3 * v:g} mm' for v in told.values())}"
        rest = {h: [c[i] for i in chosen] for h, c in columns.items() if h not in keys.values()}
        found.append((own, rest, told))
    return found


def _scale(header: str, value: float) -> float:
    """Of a size in metres; no muscle is 2 m long, or 2 mm."""
    said = parse_header(str(header))[1]
    return unit(said).factor if said and is_unit(said) else 1.0 if value < 2.0 else 1e-3


def _said(words: Any, muscle: str) -> float | None:
    """What the user said of a muscle [m]: one number for all, or by (a part of) its name."""
    if words is None:
        return None
    if isinstance(words, Mapping):
        for key, value in words.items():
            if str(key) == muscle or str(key) in muscle:
                return require_positive(f"size of {key}", value, "m")
        return None
    return require_positive("size", words, "m")


def _sizes(name: str) -> tuple[float | None, float | None]:
    """(rest length, diameter) [m] that a name tells: DMSP-20-300, l300_d20, 20x300mm."""
    length, width = _LENGTH.search(name), _DIAMETER.search(name)
    if length or width:
        both = [
            None if m is None else float(m[1].replace("p", ".")) * _UNITS[(m[2] or "mm").lower()]
            for m in (length, width)
        ]
        return both[0], both[1]
    pair = _SIZED.search(name)
    if pair is None:
        return None, None
    small, large = sorted(1e-3 * float(pair[i].replace("p", ".")) for i in (1, 2))
    return (large, small) if 2e-3 <= small <= 0.1 and 2 * small < large < 5 else (None, None)


def _named(file: str) -> tuple[str, str, str]:
    """(muscle, branch, run) that a file's name tells."""
    stem = file
    while Path(stem).suffix.lower() in (*ENDINGS, ".gz", ".table"):
        stem = stem[: -len(Path(stem).suffix)]
    branch = run = ""
    kept = []
    for word in re.split(r"[_\s]+", stem):
        numbered = _RUN.match(word)
        if branch_of(word):
            branch = branch_of(word) or ""
        elif numbered:
            run = numbered[1]
        elif word.lower() not in IDLE:
            kept.append(word)
    if len(kept) > 1 and kept[-1].isdigit() and len(kept[-1]) < 3 and not run:
        run = kept.pop()
    return "_".join(kept) or stem, branch, run


def joined(parts: Sequence[Measured]) -> ForceTable:
    """The tables of one muscle in one; those without labels are runs of their own."""
    tables = [p.table for p in parts]
    if len(tables) == 1:
        return tables[0]
    lengths = {t.rest_length for t in tables}
    if len(lengths) > 1:
        raise InputError(
            f"{parts[0].muscle}: its tables have different rest lengths "
            f"({', '.join(f'{v:g} m' if v else 'none' for v in lengths)}); name muscles apart"
        )
    several = len({t.source for t in tables}) > 1
    if several:
        tables = [t if t.run else replace(t, run=(t.source,) * len(t)) for t in tables]
    whole = joined_tables(tables)
    named = ", ".join(dict.fromkeys(t.source for t in tables))
    return replace(whole, source=named, file=whole.file if several else ())
