"""Where measurements come from: files, DataFrames and mappings, as columns with their headers.

A header says what a column holds and in which unit, in the usual spellings (``length_m``,
``p [kPa]``, ``pressure (bar)``, ``F/N``, ``kappa [%]``).
"""

from __future__ import annotations

import csv
import difflib
import io
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, UnknownNameError
from ...core.files import MOST_NAME, content_of, reading, require_file, require_size
from ...core.foreign import read_arrays, read_frame, read_mat, read_sheet

__all__ = ["SPELLINGS", "RawTable", "load", "naming", "parse_header", "plain"]

# What people write, in lower case, and the name in pam_ocp.core.units
SPELLINGS = {
    "pa": "Pa",
    "hpa": "hPa",
    "kpa": "kPa",
    "mpa": "MPa",
    "mbar": "mbar",
    "bar": "bar",
    "barg": "bar",
    "psi": "psi",
    "psig": "psi",
    "n": "N",
    "kn": "kN",
    "lbf": "lbf",
    "m": "m",
    "cm": "cm",
    "mm": "mm",
    "in": "in",
    "inch": "in",
    "s": "s",
    "ms": "ms",
    "rad": "rad",
    "deg": "deg",
    "%": "%",
    "percent": "%",
    "pct": "%",
    "1": "1",
    "-": "1",
    "fraction": "1",
}

_BRACKETED = re.compile(
    r"(?P<name>.+?)\s*[\[(](?P<unit>[^\])]*)[\])]$|(?P<left>.+?)\s*/\s*(?P<right>\S+)$"
)
_SUFFIXED = re.compile(r"(?P<name>.+?)(?:[_\s]+in)?[_\s]+(?P<unit>[^_\s]+)$")


@dataclass(frozen=True)
class RawTable:
    """Columns as they stand in the source; ``lines`` are line numbers of a text file."""

    label: str
    columns: Mapping[str, Sequence[Any]]
    lines: list[int] | None = None

    def row(self, index: int) -> str:
        """``row 3 (line 5)``, for messages."""
        line = f" (line {self.lines[index]})" if self.lines else ""
        return f"row {index + 1}{line}"

    def header(
        self, quantity: str, spellings: Collection[str], columns: Mapping[str, str]
    ) -> str | None:
        """The header of a quantity: the user's choice, else the one spelled so; None without.

        Raises InputError where two are.
        """
        if quantity in columns:
            return columns[quantity]
        free = [h for h in self.columns if h not in columns.values()]
        fitting = [h for h in free if parse_header(h)[0] in spellings]
        if len(fitting) > 1:
            raise InputError(
                f"{self.label}: {' and '.join(map(repr, fitting))} both read as {quantity}; "
                f"choose one with columns={{{quantity!r}: {fitting[0]!r}}}"
            )
        return fitting[0] if fitting else None

    def numbers(self, header: str) -> NDArray[np.float64]:
        """A column as finite numbers, in the unit in which they stand."""
        return np.array([self._number(header, i) for i in range(len(self.columns[header]))])

    def _number(self, header: str, index: int) -> float:
        cell = self.columns[header][index]
        place = f"{self.label}: column {header!r}, {self.row(index)}"
        if cell is None or cell == "":
            raise InputError(f"{place} is empty; fill it or take the row out")
        try:
            number = float(cell)
        except (TypeError, ValueError, OverflowError):
            shown = repr(cell)[:MOST_NAME]
            raise InputError(f"{place} holds {shown}, which is no number") from None
        if not np.isfinite(number):
            raise InputError(f"{place} holds {number}; fill it or take the row out")
        return number


def load(source: Any) -> RawTable:
    """Columns of a file (CSV, TSV, NPZ, MAT, Parquet, XLSX), DataFrame or mapping; bundled tables
    too.
    """
    if isinstance(source, str | Path):
        raw = _load_file(source)
    elif isinstance(source, Mapping):
        raw = _from_mapping(source, "the table")
    elif hasattr(source, "columns") and hasattr(source, "to_numpy"):
        raw = _from_frame(source, "the DataFrame")
    else:
        raise InputError(
            f"source is a {type(source).__name__}; give a path, a pandas DataFrame or a mapping "
            "such as {'pressure_Pa': ..., 'length_m': ..., 'force_N': ...}"
        )
    require_size(raw.label, max(map(len, raw.columns.values()), default=0), len(raw.columns))
    counts = {name: len(values) for name, values in raw.columns.items()}
    if not counts or not max(counts.values()):
        raise InputError(f"{raw.label} is empty: it needs a header and at least one row")
    if len(set(counts.values())) > 1:
        raise InputError(f"{raw.label}: the columns differ in length: {counts}")
    return raw


def naming(source: Any) -> AbstractContextManager[None]:
    """A block whose errors name the file that was read, where it is one."""
    if not isinstance(source, str | Path):
        return nullcontext()
    return reading(source, "a table", "save it as CSV anew")


def _from_mapping(columns: Mapping[Any, Any], label: str) -> RawTable:
    return RawTable(label, {str(n): np.ravel(v).tolist() for n, v in columns.items()})


def _from_frame(frame: Any, label: str) -> RawTable:
    names = [str(c) for c in frame.columns]
    _require_distinct(names, label)
    return RawTable(label, {n: frame.iloc[:, i].tolist() for i, n in enumerate(names)})


def _require_distinct(names: Sequence[str], label: str) -> None:
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


def _load_file(source: str | Path) -> RawTable:
    path = Path(source)
    if "\0" in str(source) or not os.path.exists(path):
        bundled = {f.name: f for f in files("pam_ocp.data").iterdir() if f.name.endswith(".csv")}
        if str(source) in bundled:
            return _read_text(bundled[str(source)].read_text("utf-8"), path.name, ".csv")
        folder = path.parent
        beside = [f.name for f in folder.iterdir() if f.is_file()] if folder.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, n=3, cutoff=0.6)
        known = [str(folder / name) for name in near] + list(bundled)
        raise UnknownNameError("table file", str(source), known)
    suffix = require_file(path).suffix.lower()
    with reading(path, "a table", "save it as CSV anew"):
        if suffix in _BINARY:
            return _BINARY[suffix](path)
        return _read_text(_decoded(path), path.name, suffix)


def _decoded(path: Path) -> str:
    """The text of a file in UTF-8, in UTF-16 with its mark (as Excel writes it), or in Latin-1."""
    content = content_of(path)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text:
        raise InputError(f"{path.name} is no text file; save the table as CSV")
    return text


def _read_text(text: str, label: str, suffix: str) -> RawTable:
    numbered = [
        (i, line)
        for i, line in enumerate(io.StringIO(text), start=1)
        if line.strip(" \t\r\n,;") and not line.startswith("#")
    ]
    if not numbered:
        raise InputError(f"{label} is empty: it needs a header and at least one row")
    head = numbered[0][1]
    delimiter = "\t" if suffix == ".tsv" else max("\t;,", key=head.count)
    try:
        rows = list(csv.reader((line for _, line in numbered), delimiter=delimiter))
    except csv.Error as error:
        raise InputError(f"{label}: {error}; save the table as CSV anew") from None
    names = [name.strip() for name in rows[0]]
    require_size(label, len(rows), len(names))
    _require_distinct(names, label)
    if all(_is_number(name) for name in names):
        raise InputError(
            f"{label}: the first line {head.strip()[:MOST_NAME]!r} holds numbers; "
            "it must name the columns, as in 'length_m,pressure_Pa,force_N'"
        )
    for (line, _), row in zip(numbered[1:], rows[1:], strict=False):
        if len(row) != len(names):
            raise InputError(
                f"{label}: line {line} has {len(row)} cells where the header has {len(names)}"
            )
    if delimiter != ",":  # beside a semicolon or a tab a comma can only be the decimal sign
        rows[1:] = [[cell.replace(",", ".") for cell in row] for row in rows[1:]]
    cells = {n: [row[i].strip() for row in rows[1:]] for i, n in enumerate(names)}
    return RawTable(label, cells, [i for i, _ in numbered[1:]])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_sheet(path: Path) -> RawTable:
    names, rows = read_sheet(path)
    _require_distinct(names, path.name)
    return RawTable(path.name, {n: [row[i] for row in rows] for i, n in enumerate(names)})


_BINARY: dict[str, Callable[[Path], RawTable]] = {
    ".npz": lambda path: _from_mapping(read_arrays(path), path.name),
    ".mat": lambda path: _from_mapping(read_mat(path), path.name),
    ".parquet": lambda path: _from_frame(read_frame(path), path.name),
    ".xlsx": _read_sheet,
}
"""How files that are no text are read, by their ending."""


# ---- headers -----------------------------------------------------------------------------------
def parse_header(header: str) -> tuple[str, str | None]:
    """(name, unit or None) of a header;
    the unit as pam_ocp.core.units spells it where it is known.
    """
    match = _BRACKETED.match(header.strip())
    if match:
        name, text = match["name"] or match["left"], match["unit"] or match["right"] or ""
        text = text.strip()
        return plain(name), SPELLINGS.get(text.lower(), text) or None
    match = _SUFFIXED.match(header.strip())
    if match and match["unit"].lower() in SPELLINGS:
        return plain(match["name"]), SPELLINGS[match["unit"].lower()]
    return plain(header), None


def plain(name: str) -> str:
    return re.sub(r"[_\s]+", " ", name).strip().lower()
