"""Where measurements come from: files, DataFrames and mappings, as columns with their headers."""

from __future__ import annotations

import difflib
import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, UnknownNameError, kind_of
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
    sheets_named,
)
from ...core.recorders import is_bag, read_bag, read_calamine, read_mcap, read_tdms
from .cells import (
    NAMES,
    TIME_NAMES,
    decimal_of,
    is_empty,
    is_number,
    is_unit,
    parse_header,
    parted,
    without_units,
)
from .dialect import (
    Grid,
    Unsaid,
    grid_of_text,
    is_lvm,
    is_markup,
    nothing_in,
    segments_of,
    tables_of,
)
from .layout import given_names, has_table, require_distinct, tabulated
from .raw import RawTable, Reading, labels_of, with_constants
from .trees import chosen_table, flat, left_out, not_applied


def load(source: Any, how: Reading | None = None) -> RawTable:
    """Columns of a file, DataFrame or mapping; bundled tables too. Constants are columns, too."""
    how = how or Reading()
    name = Path(source).name if isinstance(source, str | Path) else None
    constants = {**labels_of(name, how.pattern), **how.constants}
    raw = _loaded(source, how)
    return with_constants(raw, constants) if constants else raw


def _loaded(source: Any, how: Reading) -> RawTable:
    if isinstance(source, str | Path):
        raw = _load_file(source, how)
    elif isinstance(source, Mapping):
        columns = {str(n): np.ravel(v).tolist() for n, v in source.items()}
        raw = _of_columns(columns, "the table", how)
    elif hasattr(source, "columns") and hasattr(source, "to_numpy"):
        raw = _from_frame(source, "the DataFrame", how)
    elif isinstance(source, np.ndarray):
        raw = _from_tree(source, "the array", how)
    else:
        raise InputError(
            f"source is {kind_of(source)}; give a path, a pandas DataFrame or a mapping "
            "such as {'pressure_Pa': ..., 'length_m': ..., 'force_N': ...}"
        )
    require_size(raw.label, len(raw), len(raw.columns))
    counts = {name: len(values) for name, values in raw.columns.items()}
    if not counts or not max(counts.values()):
        raise nothing_in(raw.label)
    if len(set(counts.values())) > 1:
        raise InputError(f"{raw.label}: the columns differ in length: {counts}")
    return replace(raw, decimal_given=how.decimal is not None)


def is_source(source: Any) -> bool:
    """Whether this is one source, not several."""
    if isinstance(source, str | Path):
        several = any(c in str(source) for c in "*?") and not os.path.exists(source)
        return not (several or (os.path.isdir(source) and not is_bag(source)))
    return not isinstance(source, list | tuple)


def sources_of(source: Any) -> list[Any]:
    """Several sources: of a list, a folder (its readable files by name), or a pattern."""
    if not isinstance(source, str | Path):
        found = [s for one in source for s in ([one] if is_source(one) else sources_of(one))]
        if not found:
            raise InputError("sources is empty: give at least one file or table")
        return found
    require_local(source)
    path = Path(source)
    if path.is_dir():
        found = [f for f in sorted(path.iterdir()) if is_readable(f)]
        words = f"{path} is a folder without files that can be read"
    else:
        import glob

        there = sorted(glob.glob(str(path), recursive=True))
        found = [Path(f) for f in there if os.path.isfile(f) or is_bag(f)]
        words = f"no file fits {str(path)!r}"
    if not found:
        raise InputError(f"{words}; known endings are {', '.join(sorted(ENDINGS))}")
    return found


def is_readable(path: Path) -> bool:
    """Whether a file of a folder is taken for a table, by its ending; bags are folders."""
    return (path.is_file() and _ending(path) in ENDINGS) or is_bag(path)


def naming(source: Any) -> AbstractContextManager[None]:
    """A block whose errors name the file that was read, where it is one."""
    if not isinstance(source, str | Path):
        return nullcontext()
    return reading(source, "a table", "save it as CSV anew")


# ---- mappings and frames -------------------------------------------------------------------------
def _from_frame(frame: Any, label: str, how: Reading) -> RawTable:
    names = [_column_name(c) for c in frame.columns]
    require_distinct(names, label)
    columns = {n: _cells(frame.iloc[:, i]) for i, n in enumerate(names)}
    across = getattr(frame.columns, "name", None)
    return _of_columns({**_index(frame.index, names), **columns}, label, how, across=across)


def _of_columns(
    columns: Mapping[str, Sequence[Any]],
    label: str,
    how: Reading,
    dialect: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
    across: Any = None,
) -> RawTable:
    """Columns with names, or a pivot, whose names are numbers. across : what these are."""
    names = list(columns)
    if how.names is not None:
        given = given_names(label, how.names, len(names))
        columns = {n: columns[old] for n, old in zip(given, names, strict=True) if n}
    elif len({len(c) for c in columns.values()}) == 1 and (
        how.pivot is not None or (not how.columns and _names_values(names))
    ):
        corner = f"{names[0]} \\ {across}" if across else names[0]
        rows = list(zip(*columns.values(), strict=True))[how.skip :]
        grid = Grid(label, [[corner, *names[1:]], *rows], list(range(len(rows) + 1)))
        return tabulated(grid, how)
    require_distinct(list(columns), label)
    kept = {n: list(c)[how.skip :] for n, c in columns.items()}
    return _bare(RawTable(label, kept, dialect=dialect, notes=notes))


def _names_values(names: Sequence[str]) -> bool:
    """Whether numbers stand behind the name of a quantity."""
    named = any(parse_header(names[0])[0] in known for known in NAMES.values())
    return named and len(names) > 2 and all(map(is_number, names[1:]))


def _column_name(name: Any) -> str:
    """Of a header of several rows, what each says: ``p [bar]`` of ("p", "bar")."""
    if not isinstance(name, tuple):
        return str(name)
    parts = [str(p).strip() for p in name if str(p).strip() and not str(p).startswith("Unnamed:")]
    if len(parts) > 1 and is_unit(parts[-1]):
        return f"{' '.join(parts[:-1])} [{parts[-1].strip('[]()')}]"
    return " ".join(parts)


def _cells(column: Any) -> list[Any]:
    """Cells of a column; durations in seconds, None for what is missing (NA of a nullable column,
    NaT); NaN stays.
    """
    cells = (column.dt.total_seconds() if column.dtype.kind == "m" else column).tolist()
    gone = column.isna().tolist()
    pairs = zip(cells, gone, strict=True)
    return [None if empty and not isinstance(c, float) else c for c, empty in pairs]


def _index(index: Any, names: Sequence[str]) -> dict[str, list[Any]]:
    """The index of a DataFrame as columns, where it is more than the numbers of the rows."""
    found = {}
    for level, name in enumerate(index.names):
        column = index.get_level_values(level).to_series()
        kind = column.dtype.kind
        header = str(name) if name is not None else "time" if kind in "mM" else "index"
        if (name is None and kind not in "mMf") or header in names:
            continue
        found[f"{header} [s]" if kind == "m" and "[" not in header else header] = _cells(column)
    return found


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
    if isinstance(found, RawTable):
        return found
    notes = left_out(tree, label, found) if how.pick is None else ()
    notes += not_applied(tree)
    if isinstance(found, Grid):
        grid = replace(found, rows=found.rows[how.skip :], lines=found.lines[how.skip :])
        raw = tabulated(grid, how)
        return replace(raw, dialect=(*said, *raw.dialect))
    return _of_columns(found, label, how, said, notes)


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
    suffix = ".db3" if is_bag(path) else require_file(path).suffix.lower()
    with reading(path, "a table", "save it as CSV anew"):
        if suffix in _READERS:
            return _READERS[suffix](path, how)
        if suffix == ".gz":
            return _unpacked(path, how)
        content = content_of(path)
        kind = next((s for magic, s in _MAGIC.items() if content.startswith(magic)), None)
        if kind is not None:
            return _READERS[kind](path, how)
        return _from_text(_decoded(content, path.name, how.encoding), path.name, suffix, how)


_MAGIC = {
    b"\x89HDF": ".h5",
    b"MATLAB": ".mat",
    b"\x93NUMPY": ".npy",
    b"PAR1": ".parquet",
    b"TDSm": ".tdms",
    b"#ROSBAG": ".bag",
    b"\x89MCAP": ".mcap",
    b"PK\x03\x04": ".xlsx",
    b"\xd0\xcf\x11\xe0": ".xlsb",
}
"""How files of other endings begin."""


def _ending(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return "" if name.startswith(".") else Path(name).suffix


def _decoded(content: bytes, name: str, encoding: str | None = None) -> str:
    """The text of a file: UTF-8, UTF-16 (as Excel writes it), or the encoding of one byte or two
    in which most words are names of quantities, Latin-1 where none are.
    """
    if encoding is not None:
        try:
            return content.decode(encoding).removeprefix("\ufeff")
        except UnicodeDecodeError as error:
            raise InputError(
                f"{name} is not written in {encoding} ({error}); name another"
            ) from None
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16", "replace")
    elif content[1:400:2].count(0) > 0.7 * len(content[1:400:2]) > 2:
        text = content.decode("utf-16-le", "replace")
    elif content[0:400:2].count(0) > 0.7 * len(content[0:400:2]) > 2:
        text = content.decode("utf-16-be", "replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = max((content.decode(e, "replace") for e in ENCODINGS), key=_names_in)
    if "\0" in text:
        raise InputError(f"{name} is no text file; save the table as CSV")
    return text.replace("\u2212", "-")  # the typesetter's minus


ENCODINGS = (
    *("cp1252", "cp1251", "cp1250", "shift_jis", "gb18030", "euc_jp", "mac_roman"),
    *("big5", "cp949", "koi8_r", "cp1253", "cp1254"),
)
"""What texts that are no Unicode are written in, the likelier ones first. Of ten headers in these
chardet 7 and charset-normalizer 3 name the encoding of four, for a table holds few words; names of
quantities tell all ten.
"""


def _names_in(text: str) -> int:
    """How many words at the beginning are names of quantities with letters beyond ASCII."""
    words = re.split(r"[\t;,|\n\r\"{}:]|  ", text[:4000])
    known = frozenset().union(*NAMES.values(), TIME_NAMES)
    return sum(not w.isascii() and parse_header(w)[0] in known for w in words)


def _from_text(text: str, label: str, suffix: str, how: Reading) -> RawTable:
    if is_lvm(text):
        return _from_tree(segments_of(text, label), label, how)
    if text.lstrip()[:1] in ("{", "[") and text.rstrip()[-1:] in ("}", "]"):
        try:
            return _from_tree(_json(text.encode()), label, how)
        except ValueError as error:
            if isinstance(error, InputError):
                raise
    if is_markup(text):
        tables = tables_of(text)
        chosen = sheets_named(label, list(tables), how.sheet) if len(tables) > 1 else tables
        return _of_sheets({n: tables[n] for n in chosen}, label, how)
    return tabulated(grid_of_text(text, label, suffix, how), how)


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
    return _from_text(_decoded(content, path.name, how.encoding), path.name, inner, how)


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
    """Of a workbook; of one that only calls itself so, whatever it is."""
    start = path.read_bytes()[:4]
    if start in (b"PK\x03\x04", b""):
        return _of_sheets(read_sheets(path, how.sheet), path.name, how)
    if start[:2] == b"\xd0\xcf":
        return _read_calamine(path, how)
    return _from_text(_decoded(content_of(path), path.name, how.encoding), path.name, ".csv", how)


def _read_calamine(path: Path, how: Reading) -> RawTable:
    return _of_sheets(read_calamine(path, how.sheet), path.name, how)


def _of_sheets(sheets: Mapping[str, Sequence[Any]], label: str, how: Reading) -> RawTable:
    """The only sheet with a table."""
    grids = {}
    for name, rows in sheets.items():
        numbered = [(i, row) for i, row in enumerate(rows, start=1) if i > how.skip]
        texts = [c for _, row in numbered[:2000] for c in row if isinstance(c, str)]
        sign = how.decimal or decimal_of(texts)
        said = (f"sheet {name!r}", *(["decimal comma"] if sign == "," else []))
        grids[name] = Grid(label, [r for _, r in numbered], [i for i, _ in numbered], sign)
        grids[name].dialect = said
    filled = {n: g for n, g in grids.items() if any(not is_empty(c) for r in g.rows for c in r)}
    tables = {n: g for n, g in filled.items() if has_table(g)}
    found = sorted(tables or filled, key=lambda name: -_promise(filled[name]))
    if len(found) > 1:
        shown = ", ".join(map(repr, found[:8]))
        raise Unsaid(
            f"{label} has {len(found)} sheets with numbers, {shown}: choose one with "
            f"sheet={found[0]!r}"
        )
    if not found:
        raise nothing_in(label)
    return tabulated((tables or filled)[found[0]], how)


def _promise(grid: Grid) -> int:
    """How many quantities the words at the top of a sheet name."""
    words = {parse_header(c)[0] for row in grid.rows[:12] for c in row if isinstance(c, str)}
    return sum(bool(words & names) for names in NAMES.values())


_READERS: dict[str, Callable[[Path, Reading], RawTable]] = {
    ".npz": lambda path, how: _from_tree(read_arrays(path), path.name, how),
    ".npy": lambda path, how: _from_tree(read_array(path), path.name, how),
    ".mat": lambda path, how: _from_tree(read_mat(path), path.name, how),
    ".h5": lambda path, how: _from_tree(read_hdf5(path), path.name, how),
    ".hdf5": lambda path, how: _from_tree(read_hdf5(path), path.name, how),
    ".json": lambda path, how: _from_tree(_json(content_of(path)), path.name, how),
    ".jsonl": lambda path, how: _from_tree(_json(content_of(path)), path.name, how),
    ".parquet": lambda path, how: _from_frame(read_frame(path), path.name, how),
    ".xlsx": _read_sheet,
    ".xlsm": _read_sheet,
    ".xlsb": _read_calamine,
    ".ods": _read_calamine,
    ".tdms": lambda path, how: _from_tree(read_tdms(path), path.name, how),
    ".bag": lambda path, how: _from_tree(read_bag(path, flat), path.name, how),
    ".db3": lambda path, how: _from_tree(read_bag(path, flat), path.name, how),
    ".mcap": lambda path, how: _from_tree(read_mcap(path, flat), path.name, how),
}
"""How files that are no tables of text are read, by their ending."""
ENDINGS = frozenset(
    {*_READERS, ".csv", ".tsv", ".txt", ".dat", ".asc", ".log", ".lvm", ".xls", ".htm", ".html"}
)
"""Files of a folder that are taken for tables."""
