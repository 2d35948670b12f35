"""Where measurements come from: files, DataFrames and mappings, as columns with their headers."""

from __future__ import annotations

import difflib
import gzip
import io
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, UnknownNameError, require_count
from ...core.files import (
    MOST_BYTES,
    MOST_JSON_PARTS,
    content_of,
    json_of,
    reading,
    require_file,
    require_local,
    require_size,
)
from ...core.foreign import (
    read_array,
    read_arrays,
    read_frame,
    read_hdf5,
    read_mat,
    read_sheets,
)
from .cell_units import parted, without_units
from .cells import decimal_of, is_empty
from .dialect import Grid, Unsaid, grid_of_text
from .headers import NAMES, parse_header
from .layout import has_table, require_distinct, tabulated
from .raw import RawTable
from .trees import chosen_table

__all__ = ["ENDINGS", "Reading", "is_source", "load", "naming", "sources_of"]


@dataclass(frozen=True)
class Reading:
    """How a file is to be read, where it does not say it itself.

    columns : names of the columns from the left. skip : lines or rows at the beginning that are
    left out. sheet : of a workbook, its name or its number from 1. pick : table within nested data.
    delimiter, decimal : of a text. pivot : what runs down, across, and stands in the cells.
    """

    columns: tuple[str | None, ...] | None = None
    skip: int = 0
    sheet: str | int | None = None
    pick: str | None = None
    delimiter: str | None = None
    decimal: str | None = None
    pivot: tuple[str, ...] | None = None

    @classmethod
    def of(cls, columns: Any, **said: Any) -> Reading:
        """Checked. Raises InputError."""
        require_count("skip", said.get("skip", 0), 0)
        for name, allowed in (("decimal", (".", ",")),):
            if said.get(name) not in (None, *allowed):
                raise InputError(f"{name} = {said[name]!r}: choose '.' or ','")
        delimiter = said.get("delimiter")
        if delimiter is not None and (not isinstance(delimiter, str) or len(delimiter) != 1):
            raise InputError(f"delimiter = {delimiter!r}: give one character, ' ' for blanks")
        names = None
        if columns is not None and not isinstance(columns, Mapping):
            if isinstance(columns, str) or not isinstance(columns, Sequence):
                raise InputError(
                    f"columns = {columns!r}: give {{quantity: header}}, or a list of names from "
                    "the left, as ['length [mm]', 'pressure [bar]', 'force [N]']"
                )
            names = tuple(None if name is None else str(name) for name in columns)
        pivot = said.pop("pivot", None)
        return cls(names, **said, pivot=None if pivot is None else _pivot(pivot))


def _pivot(said: Any) -> tuple[str, ...]:
    if isinstance(said, str) or not isinstance(said, Sequence):
        raise InputError(
            f"pivot = {said!r}: say what runs down, across and stands in the cells, as "
            "pivot=('contraction [%]', 'pressure [bar]', 'force [N]')"
        )
    return tuple(str(s) for s in said)


def load(source: Any, how: Reading | None = None) -> RawTable:
    """Columns of a file, DataFrame or mapping; bundled tables too."""
    how = how or Reading()
    if isinstance(source, str | Path):
        raw = _load_file(source, how)
    elif isinstance(source, Mapping):
        raw = _from_mapping(source, "the table")
    elif hasattr(source, "columns") and hasattr(source, "to_numpy"):
        raw = _from_frame(source, "the DataFrame")
    elif isinstance(source, np.ndarray):
        raw = _from_tree(source, "the array", how)
    else:
        raise InputError(
            f"source is a {type(source).__name__}; give a path, a pandas DataFrame or a mapping "
            "such as {'pressure_Pa': ..., 'length_m': ..., 'force_N': ...}"
        )
    require_size(raw.label, len(raw), len(raw.columns))
    counts = {name: len(values) for name, values in raw.columns.items()}
    if not counts or not max(counts.values()):
        raise InputError(f"{raw.label} is empty: it needs a header and at least one row")
    if len(set(counts.values())) > 1:
        raise InputError(f"{raw.label}: the columns differ in length: {counts}")
    return replace(raw, decimal_given=how.decimal is not None)


def is_source(source: Any) -> bool:
    """Whether this is one source, not several."""
    if isinstance(source, str | Path):
        return not (any(c in str(source) for c in "*?") or os.path.isdir(source))
    return not isinstance(source, list | tuple)


def sources_of(source: Any) -> list[Any]:
    """Several sources: of a list, a folder (its readable files by name), or a pattern.

    Raises InputError where there are none.
    """
    if not isinstance(source, str | Path):
        found = [s for one in source for s in ([one] if is_source(one) else sources_of(one))]
        if not found:
            raise InputError("sources is empty: give at least one file or table")
        return found
    require_local(source)
    path = Path(source)
    if path.is_dir():
        found = [f for f in sorted(path.iterdir()) if f.is_file() and _ending(f) in ENDINGS]
        words = f"{path} is a folder without files that can be read"
    else:
        import glob

        found = [Path(f) for f in sorted(glob.glob(str(path), recursive=True)) if os.path.isfile(f)]
        words = f"no file fits {str(path)!r}"
    if not found:
        raise InputError(f"{words}; known endings are {', '.join(sorted(ENDINGS))}")
    return found


def naming(source: Any) -> AbstractContextManager[None]:
    """A block whose errors name the file that was read, where it is one."""
    if not isinstance(source, str | Path):
        return nullcontext()
    return reading(source, "a table", "save it as CSV anew")


# ---- mappings and frames -------------------------------------------------------------------------
def _from_mapping(columns: Mapping[Any, Any], label: str) -> RawTable:
    return _bare(RawTable(label, {str(n): np.ravel(v).tolist() for n, v in columns.items()}))


def _from_frame(frame: Any, label: str) -> RawTable:
    names = [str(c) for c in frame.columns]
    require_distinct(names, label)
    return _bare(RawTable(label, {n: frame.iloc[:, i].tolist() for i, n in enumerate(names)}))


def _bare(raw: RawTable) -> RawTable:
    """The table with plain numbers where cells name their units."""
    names = list(raw.columns)
    texts = {i: c for i, c in enumerate(raw.columns.values()) if any(map(parted, c[:50]))}
    if not texts:
        return raw
    rows = range(1, len(raw) + 1)
    plain, units, decimal = without_units(raw.label, texts, rows, dict(enumerate(names)))
    return replace(
        raw,
        columns={n: plain.get(i, c) for i, (n, c) in enumerate(raw.columns.items())},
        stated={**raw.stated, **{names[i]: text for i, text in units.items()}},
        decimal=raw.decimal or decimal,
    )


def _from_tree(tree: Any, label: str, how: Reading) -> RawTable:
    """The table of nested data."""
    found, said = chosen_table(tree, label, how.pick)
    if isinstance(found, Grid):
        grid = replace(found, rows=found.rows[how.skip :], lines=found.lines[how.skip :])
        raw = tabulated(grid, how.columns, how.pivot)
        return replace(raw, dialect=(*said, *raw.dialect))
    names = list(found)
    if how.columns is not None:
        if len(how.columns) != len(names):
            raise InputError(
                f"{label} has {len(names)} columns, columns= names {len(how.columns)}; name each, "
                "from the left (None leaves one out)"
            )
        found = {n: found[old] for n, old in zip(how.columns, names, strict=True) if n}
    require_distinct(list(found), label)
    columns = {n: list(c)[how.skip :] for n, c in found.items()}
    return _bare(RawTable(label, columns, dialect=said))


# ---- files ---------------------------------------------------------------------------------------
def _load_file(source: str | Path, how: Reading) -> RawTable:
    path = Path(source)
    require_local(source)
    if "\0" in str(source) or not os.path.exists(path):
        bundled = {f.name: f for f in files("pam_ocp.data").iterdir() if f.name.endswith(".csv")}
        if str(source) in bundled:
            return _from_text(bundled[str(source)].read_text("utf-8"), path.name, ".csv", how)
        folder = path.parent
        beside = [f.name for f in folder.iterdir() if f.is_file()] if folder.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, n=3, cutoff=0.6)
        known = [str(folder / name) for name in near] + list(bundled)
        raise UnknownNameError("table file", str(source), known)
    suffix = require_file(path).suffix.lower()
    with reading(path, "a table", "save it as CSV anew"):
        if suffix in _READERS:
            return _READERS[suffix](path, how)
        if suffix == ".gz":
            return _unpacked(path, how)
        content = content_of(path)
        kind = next((s for magic, s in _MAGIC.items() if content.startswith(magic)), None)
        if kind is not None:
            return _READERS[kind](path, how)
        return _from_text(_decoded(content, path.name), path.name, suffix, how)


_MAGIC = {
    b"\x89HDF": ".h5",
    b"MATLAB": ".mat",
    b"\x93NUMPY": ".npy",
    b"PAR1": ".parquet",
}
"""How files of other endings begin."""


def _ending(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return "" if name.startswith(".") else Path(name).suffix


def _decoded(content: bytes, name: str) -> str:
    """The text of a file in UTF-8, in UTF-16 with its mark (as Excel writes it), or in Latin-1."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252", "replace")
    if "\0" in text:
        raise InputError(f"{name} is no text file; save the table as CSV")
    return text


def _from_text(text: str, label: str, suffix: str, how: Reading) -> RawTable:
    grid = grid_of_text(text, label, suffix, how.skip, how.delimiter, how.decimal)
    return tabulated(grid, how.columns, how.pivot)


def _unpacked(path: Path, how: Reading) -> RawTable:
    """A text, JSON or MAT file within .gz."""
    inner = _ending(path)
    with gzip.open(io.BytesIO(content_of(path))) as packed:
        try:
            content = packed.read(MOST_BYTES + 1)
        except (EOFError, OSError, zlib.error) as error:
            raise InputError(f"{path.name} is damaged ({error}); pack it anew") from None
    if len(content) > MOST_BYTES:
        raise InputError(
            f"{path.name} unpacks to more than the {MOST_BYTES / 2**20:g} MiB allowed; cut it"
        )
    if inner == ".json":
        return _from_tree(_json(content), path.name, how)
    if inner == ".mat":
        return _from_tree(read_mat(path, content), path.name, how)
    if inner in _READERS:
        raise InputError(f"{path.name}: unpack it first, {inner} files are packed already")
    return _from_text(_decoded(content, path.name), path.name, inner, how)


def _json(content: bytes) -> Any:
    """JSON, or one JSON object a line."""
    lines = content.strip().splitlines() if content.count(b"\n") <= MOST_JSON_PARTS else []
    if len(lines) > 1 and all(line.strip().startswith(b"{") for line in lines[:2]):
        try:
            return [json_of(line, infinite=True) for line in lines if line.strip()]
        except ValueError:
            pass
    return json_of(content.removeprefix(b"\xef\xbb\xbf"), infinite=True)


def _read_sheet(path: Path, how: Reading) -> RawTable:
    """The sheet that is named, or the only one with a table."""
    sheets = read_sheets(path, how.sheet)
    grids = {}
    for name, rows in sheets.items():
        numbered = [(i, row) for i, row in enumerate(rows, start=1) if i > how.skip]
        texts = [c for _, row in numbered[:2000] for c in row if isinstance(c, str)]
        sign = how.decimal or decimal_of(texts)
        said = (f"sheet {name!r}", *(["decimal comma"] if sign == "," else []))
        grids[name] = Grid(path.name, [r for _, r in numbered], [i for i, _ in numbered], sign)
        grids[name].dialect = said
    filled = {n: g for n, g in grids.items() if any(not is_empty(c) for r in g.rows for c in r)}
    tables = {n: g for n, g in filled.items() if has_table(g)}
    found = sorted(tables or filled, key=lambda name: -_promise(filled[name]))
    if len(found) > 1:
        shown = ", ".join(map(repr, found[:8]))
        raise Unsaid(
            f"{path.name} has {len(found)} sheets with numbers, {shown}: choose one with "
            f"sheet={found[0]!r}"
        )
    if not found:
        raise InputError(f"{path.name} is empty: it needs a header and at least one row")
    return tabulated((tables or filled)[found[0]], how.columns, how.pivot)


def _promise(grid: Grid) -> int:
    """How many quantities the words at the top of a sheet name."""
    words = {parse_header(c)[0] for row in grid.rows[:12] for c in row if isinstance(c, str)}
    return sum(bool(words & names) for names in NAMES.values())


def _read_parquet(path: Path, how: Reading) -> RawTable:
    return _from_frame(read_frame(path), path.name)


_READERS: dict[str, Callable[[Path, Reading], RawTable]] = {
    ".npz": lambda path, how: _from_tree(read_arrays(path), path.name, how),
    ".npy": lambda path, how: _from_tree(read_array(path), path.name, how),
    ".mat": lambda path, how: _from_tree(read_mat(path), path.name, how),
    ".h5": lambda path, how: _from_tree(read_hdf5(path), path.name, how),
    ".hdf5": lambda path, how: _from_tree(read_hdf5(path), path.name, how),
    ".json": lambda path, how: _from_tree(_json(content_of(path)), path.name, how),
    ".jsonl": lambda path, how: _from_tree(_json(content_of(path)), path.name, how),
    ".parquet": _read_parquet,
    ".xlsx": _read_sheet,
    ".xlsm": _read_sheet,
}
"""How files that are no tables of text are read, by their ending."""
ENDINGS = frozenset({*_READERS, ".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm"})
"""Files of a folder that are taken for tables."""
