"""Formats that libraries of others read: their limits are asked before anything is unpacked."""

from __future__ import annotations

import io
import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .exceptions import InputError, UnknownNameError
from .files import (
    MOST_SHEET_BYTES,
    MOST_SHEET_CELLS,
    MOST_UNPACKED,
    content_of,
    most_unpacked,
    reading,
    require_file,
    require_size,
    require_unpacked,
)
from .interrupts import interruptible

if TYPE_CHECKING:
    import pandas as pd

Array: TypeAlias = NDArray[Any]

_HEADER = 128
"""Bytes before the first element."""
_STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
    16: "u1",  # UTF-8
    17: "u2",  # UTF-16
}
"""Kinds of elements that hold numbers."""
_UTF8, _MATRIX, _PACKED = 16, 14, 15
_CELL, _STRUCTURE, _CHARACTERS, _DOUBLE, _LAST, _OPAQUE = 1, 2, 4, 6, 15, 17
"""Classes of matrices; from double to the last they are numbers."""
_COMPLEX = 0x0800
MOST_ENTRIES = 1_000_000
"""Of all cells and structures of a file, each of which becomes an object of Python (of HDF5: texts,
characters of MATLAB, and cells).
"""
MOST_OBJECTS = 20_000
"""Groups, datasets and references of an HDF5 file."""
MOST_CHARACTERS = 10_000_000
"""Of all its text."""
HEADERS = 8
"""Elements of a matrix that are none of its entries, at most."""
MOST_LEVELS = 16
"""Cells and structures, or groups, within each other."""


class _Budget:
    """What may still be made of a file."""

    def __init__(self) -> None:
        self.entries, self.characters = MOST_ENTRIES, MOST_CHARACTERS

    def text(self, size: int, rows: int) -> None:
        self.characters -= size
        if self.characters < 0:
            raise ValueError(f"its text has more than {MOST_CHARACTERS} characters")
        self.take(rows, 0)

    def take(self, entries: int, level: int) -> None:
        self.entries -= entries
        if self.entries < 0:
            raise ValueError(f"its cells and structures have more than {MOST_ENTRIES} entries")
        if level > MOST_LEVELS:
            raise ValueError(f"it is nested more than {MOST_LEVELS} deep")


def matrices_of(content: bytes, most: int) -> dict[str, Any]:
    """{name: what it holds} of a file's content.

    Matrices are arrays, rows of characters arrays of text, cells arrays of objects, structures
    dicts (several: lists of dicts). Objects (tables, timeseries), sparse matrices and functions are
    left out. most : bytes that it may unpack to.

    Raises InputError for another version, and ValueError, struct.error or zlib.error where it is
    damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:_HEADER])
    if order is None or content[:10] != b"MATLAB 5.0":
        raise InputError("it is no MAT file of version 5; save it with -v7, or as CSV")
    found, budget, objects = {}, _Budget(), []
    # views: parts within parts are copied nowhere
    for kind, part in _elements(memoryview(content)[_HEADER:], order):
        if kind == _PACKED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(part, most + 1)
            most -= len(unpacked)
            if most < 0:
                raise InputError("it unpacks to more than is allowed; save it as CSV in parts")
            if not unpacker.eof:
                raise ValueError("a packed matrix is cut off")
            kind, part = next(_elements(memoryview(unpacked), order))
        if kind == _MATRIX:
            name, value = _matrix(part, order, budget)
            if value is None and name:
                objects.append(name)
            elif name:
                found[name] = value
    if objects and not found:
        raise InputError(
            f"{', '.join(objects[:5])} is an object (such as a table), which only MATLAB reads; "
            "save a structure, as S = table2struct(T, 'ToScalar', true), or CSV by writetable(T)"
        )
    return found


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """(kind, bytes) of the elements that follow each other."""
    at = 0
    while at < len(content):
        (first,) = struct.unpack_from(f"{order}I", content, at)
        if first >> 16:  # small: kind, length and data in eight bytes
            kind, length, start, end = first & 0xFFFF, first >> 16, at + 4, at + 8
        else:
            kind, (length,) = first, struct.unpack_from(f"{order}I", content, at + 4)
            start = at + 8
            end = start + length + (-length % 8 if kind != _PACKED else 0)
        if start + length > len(content) or (first >> 16 and length > 4):
            raise ValueError("it is cut off")
        yield kind, content[start : start + length]
        at = end


def _matrix(content: memoryview, order: str, budget: _Budget, level: int = 0) -> tuple[str, Any]:
    """(name, what it holds); None for what is left out."""
    if not content:  # an entry of a cell that was never set
        return "", np.empty((0, 0))
    most = budget.entries + HEADERS
    parts = list(islice(_elements(content, order), most + 1))
    if len(parts) > most:
        budget.take(len(parts), level)
    flags = int(_numbers(*parts[0], order)[0])
    kind = flags & 0xFF
    if kind == _OPAQUE:
        return str(parts[1][1], "ascii"), None
    shape = [int(n) for n in _numbers(*parts[1], order)]
    name = str(parts[2][1], "ascii")
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"variable {name!r} has the shape {shape}")
    if kind == _CELL:
        return name, _cells(parts[3:], shape, order, budget, level)
    if kind == _STRUCTURE:
        return name, _structure(parts[3:], shape, order, budget, level)
    if kind != _CHARACTERS and not _DOUBLE <= kind <= _LAST:
        return name, None
    if flags & _COMPLEX:
        raise InputError(f"variable {name!r} is complex; save its parts as real numbers")
    stored, data = parts[3]
    if kind == _CHARACTERS:
        budget.text(len(data), shape[0])
    if kind == _CHARACTERS and stored == _UTF8 and shape[0] == 1:  # characters of several bytes
        return name, np.array([str(data, "utf-8").rstrip()])
    numbers = _numbers(stored, data, order)
    if float(np.prod(np.array(shape, float))) != numbers.size:
        raise ValueError(f"variable {name!r} has {numbers.size} entries, its shape says {shape}")
    matrix = numbers.reshape(shape, order="F")
    if kind != _CHARACTERS:
        return name, matrix
    if not matrix.size:
        return name, np.array([""])
    return name, np.array(["".join(map(chr, row)).rstrip() for row in matrix.reshape(shape[0], -1)])


def _inside(
    parts: list[tuple[int, memoryview]], order: str, budget: _Budget, level: int
) -> Iterator[Any]:
    budget.take(len(parts), level + 1)
    for kind, part in parts:
        if kind != _MATRIX:
            raise ValueError(f"an element of kind {kind} stands where a matrix is expected")
        yield _matrix(part, order, budget, level + 1)[1]


def _cells(
    parts: list[tuple[int, memoryview]], shape: list[int], order: str, budget: _Budget, level: int
) -> Array:
    count = float(np.prod(np.array(shape, float)))
    if count != len(parts):
        raise ValueError(f"a cell array has {len(parts)} entries, its shape says {shape}")
    made = np.empty(len(parts), dtype=object)
    for i, value in enumerate(_inside(parts, order, budget, level)):
        made[i] = value
    return made.reshape(shape, order="F")


def _structure(
    parts: list[tuple[int, memoryview]], shape: list[int], order: str, budget: _Budget, level: int
) -> Any:
    """A dict, or a list of dicts where there are several (or none)."""
    width = int(_numbers(*parts[0], order)[0])
    letters = bytes(parts[1][1])
    if width <= 0 or len(letters) % width:
        raise ValueError(f"names of fields are {width} long, {len(letters)} bytes hold them")
    names = [
        letters[i : i + width].split(b"\0")[0].decode("utf-8")
        for i in range(0, len(letters), width)
    ]
    count = float(np.prod(np.array(shape, float)))
    if count * len(names) != len(parts) - 2:
        raise ValueError(f"a structure has {len(parts) - 2} entries, its shape says {shape}")
    values = iter(_inside(parts[2:], order, budget, level))
    budget.take(int(count), level + 1)
    made = [{name: next(values) for name in names} for _ in range(int(count) if names else 0)]
    return made[0] if len(made) == 1 else made


def _numbers(kind: int, content: memoryview, order: str) -> Array:
    if kind not in _STORED:
        raise ValueError(f"an element of kind {kind} stands where numbers are expected")
    return np.frombuffer(content, f"{order}{_STORED[kind]}")


@contextmanager
def library(path: str | os.PathLike[str], kind: str, extra: str = "studies") -> Iterator[None]:
    """A block in which a library reads: its errors become one sentence, its warnings none."""
    with (
        reading(path, kind, "save it anew, or as CSV", foreign=True),
        warnings.catch_warnings(),
        np.errstate(all="ignore"),
    ):
        warnings.simplefilter("ignore")
        try:
            yield
        except ImportError as missing:
            raise InputError(
                f"{os.fspath(path)}: reading {kind} needs a package that is not installed "
                f"({missing}): pip install 'pam_ocp[{extra}]', or save the table as CSV"
            ) from None


def read_arrays(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The arrays of an .npz file by name. Raises InputError."""
    require_file(path)
    with library(path, "an .npz file"):
        require_unpacked(path, most_unpacked(os.path.getsize(path)))
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)


@interruptible()  # pandas is loaded in here
def frame(
    rows: Sequence[Sequence[Any]], columns: Sequence[str], index: Sequence[Any], name: str
) -> pd.DataFrame:
    """Rows as a DataFrame with an index of this name. Raises InputError where pandas is missing."""
    try:
        import pandas as pd
    except ImportError:
        raise InputError("to_pandas needs pandas: pip install 'pam_ocp[studies]'") from None
    return pd.DataFrame(rows, columns=list(columns), index=pd.Index(index, name=name))


def read_frame(path: str | os.PathLike[str]) -> pd.DataFrame:
    """A Parquet file as a DataFrame. Raises InputError, also without pandas and pyarrow."""
    require_file(path)
    with library(path, "a Parquet file"):
        import pandas as pd
        from pyarrow import parquet

        with parquet.ParquetFile(path) as file:
            told = file.metadata
            require_size(Path(path).name, told.num_rows, told.num_columns)
            groups = (told.row_group(i) for i in range(told.num_row_groups))
            _require_bytes(path, sum(group.total_byte_size for group in groups))
        return pd.read_parquet(path, engine="pyarrow")


def read_sheets(
    path: str | os.PathLike[str], sheet: str | int | None = None
) -> dict[str, list[Sequence[Any]]]:
    """{name: rows} of the sheets of an .xlsx file, all or one; empty rows are empty.

    sheet : its name, or its number from 1. Rows are read one by one and counted: what a sheet says
    of its own size is not believed. Raises InputError, also without openpyxl, and UnknownNameError.
    """
    require_file(path)
    with library(path, "an .xlsx file", "excel"):
        from openpyxl import load_workbook

        require_unpacked(path, MOST_SHEET_BYTES)
        book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
        try:
            chosen = sheets_named(path, [s.title for s in book.worksheets], sheet)
            budget = MOST_SHEET_CELLS
            found: dict[str, list[Sequence[Any]]] = {}
            for name in chosen:
                found[name] = _rows(path, book[name], budget)
                budget -= sum(len(row) + 1 for row in found[name])
        finally:
            book.close()
    return found


def sheets_named(
    path: str | os.PathLike[str], names: list[str], sheet: str | int | None
) -> list[str]:
    """All sheets, or the one of this name or number (from 1). Raises UnknownNameError."""
    if sheet is None:
        return names
    if isinstance(sheet, int) and not isinstance(sheet, bool) and 1 <= sheet <= len(names):
        return [names[sheet - 1]]
    if sheet not in names:
        raise UnknownNameError(f"sheet of {Path(path).name}", str(sheet), names)
    return [str(sheet)]


def _rows(path: str | os.PathLike[str], sheet: Any, budget: int) -> list[Sequence[Any]]:
    name = Path(path).name
    sheet.reset_dimensions()
    rows: list[Sequence[Any]] = []
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        budget -= len(row) + 1
        require_size(name, number, len(row))
        if budget < 0:
            raise InputError(
                f"{name} has more than the {MOST_SHEET_CELLS} cells allowed in a "
                "spreadsheet; save it as CSV"
            )
        rows.append(row)
    return rows


def read_array(path: str | os.PathLike[str]) -> Any:
    """The array of an .npy file. Raises InputError."""
    require_file(path)
    with library(path, "an .npy file"):
        return np.load(path, allow_pickle=False, mmap_mode=None)


def read_mat(path: str | os.PathLike[str], content: bytes | None = None) -> dict[str, Any]:
    """What a MAT file holds, by name; see :func:`matrices_of`.

    Of version 7.3, which is HDF5, the same by h5py. content : of the file, where it was packed.
    Raises InputError, also without h5py.
    """
    content = content_of(path) if content is None else content
    if content[:6] != b"MATLAB" and content[:4] != b"\x89HDF":
        return _read_level_4(path, content)
    if content[:10] == b"MATLAB 7.3" or content[:4] == b"\x89HDF":
        return read_hdf5(path, content)
    with reading(path, "a .mat file", "save it anew, or as CSV"):
        return matrices_of(content, most_unpacked(len(content)))


def _read_level_4(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """A MAT file of level 4 (MATLAB's -v4), by SciPy: plain arrays, whose sizes it checks."""
    with library(path, "a .mat file"):
        from scipy.io import loadmat
        from scipy.io.matlab import matfile_version

        if matfile_version(io.BytesIO(content), appendmat=False)[0] != 0:
            raise InputError("it is no MAT file; save it with -v7, or as CSV")
        found = loadmat(io.BytesIO(content), appendmat=False, chars_as_strings=True)
    arrays = {n: v for n, v in found.items() if isinstance(v, np.ndarray)}
    wild = [n for n, v in arrays.items() if v.dtype.kind == "c"]
    if wild:
        raise InputError(f"variable {wild[0]!r} is complex; save its parts as real numbers")
    return arrays


def read_hdf5(path: str | os.PathLike[str], content: bytes | None = None) -> dict[str, Any]:
    """The groups and datasets of an HDF5 file, nested by name. Raises InputError, also without
    h5py.
    """
    require_file(path)
    with library(path, "an HDF5 file (MATLAB -v7.3)", "hdf5"):
        import h5py

        source = path if content is None else io.BytesIO(content)
        size = os.path.getsize(path) if content is None else len(content)
        with h5py.File(source, "r") as file:
            return _Tree(file, most_unpacked(size)).group(file, 0)


class _Tree:
    """An HDF5 file as nested mappings: what lies in the file itself, within limits, as links may
    lead in circles.

    Format of MATLAB's: structures are groups, cells are references, text is numbers with the
    attribute ``MATLAB_class`` "char", and matrices stand transposed (MathWorks, "MAT-File
    Versions").
    """

    def __init__(self, file: Any, most: int) -> None:
        self.file, self.left, self.objects = file, most, MOST_OBJECTS
        self.entries = MOST_ENTRIES

    def value(self, thing: Any, level: int) -> Any:
        self.objects -= 1
        if self.objects < 0 or level > MOST_LEVELS:
            raise InputError(
                f"it holds more than {MOST_OBJECTS} parts, or is nested more than {MOST_LEVELS} "
                "deep; save the table as CSV"
            )
        if hasattr(thing, "keys"):
            return self.group(thing, level)
        return self.dataset(thing, level)

    def take(self, entries: int) -> None:
        self.entries -= entries
        if self.entries < 0:
            raise InputError(
                f"it holds more than {MOST_ENTRIES} texts and cells; save the table as CSV"
            )

    def group(self, group: Any, level: int) -> dict[str, Any]:
        import h5py

        found = {}
        for name in group:
            if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue  # MATLAB's own stores, and links that may lead out of the file
            part = group[name]
            if not isinstance(part, h5py.Group | h5py.Dataset):
                continue
            value = self.value(part, level + 1)
            if value is not None:
                found[_named(name, part)] = value
        return found

    def dataset(self, data: Any, level: int) -> Any:
        import h5py

        kind = _text(data.attrs.get("MATLAB_class", ""))
        if data.shape is None or data.is_virtual or data.external:
            return None  # empty, or its numbers stand in other files
        if "MATLAB_empty" in data.attrs:
            return np.empty((0, 0))
        self.left -= data.nbytes
        if self.left < 0:
            raise InputError("it unpacks to more than is allowed; save it as CSV in parts")
        if h5py.check_dtype(ref=data.dtype) is not None:
            return self.cells(data, level)
        if kind == "char" or data.dtype.kind in "OSV":  # becomes an object of Python each
            self.take(data.size)
        values = self.read(data)
        if kind == "char":
            return np.array(["".join(map(chr, row)) for row in np.atleast_2d(values.T)])
        if getattr(values, "dtype", None) is not None and values.dtype.kind in "OS":
            return np.array([_text(v) for v in np.ravel(values)])
        if kind and getattr(values, "ndim", 0) >= 2:
            return values.T
        return unpacked(values, data.attrs)

    def read(self, data: Any) -> Any:
        """What a dataset holds. Texts of any length may all lie in one place of the file, so they
        are read in blocks that hold what is left even if each were as long as the file.
        """
        if data.dtype.kind != "O" or not data.shape:
            return data[()]
        found = np.empty(data.shape, dtype=object)
        row = int(np.prod(data.shape[1:])) * self.file.id.get_filesize()
        for start in range(0, data.shape[0], block := max(1, self.left // max(1, row))):
            found[start : start + block] = part = data[start : start + block]
            self.left -= sum(len(v) for v in np.ravel(part) if hasattr(v, "__len__"))
            if self.left < 0:
                raise InputError("it unpacks to more than is allowed; save it as CSV in parts")
        return found

    def cells(self, data: Any, level: int) -> Any:
        """An array of objects, as MATLAB shows it."""
        self.take(data.size)
        made = np.empty(data.shape, dtype=object)
        for index, reference in np.ndenumerate(data[()]):
            made[index] = self.value(self.file[reference], level + 1) if reference else None
        return made.T


def unpacked(values: Any, said: Mapping[str, Any]) -> Any:
    """Numbers packed by the CF conventions (NetCDF): ``scale_factor * value + add_offset``, where
    ``_FillValue`` is missing."""
    marks = {"scale_factor": 1.0, "add_offset": 0.0, "_FillValue": np.nan}
    if not any(k in said for k in marks) or np.asarray(values).dtype.kind not in "biufO":
        return values
    try:
        scale, offset, fill = (float(np.ravel(said.get(k, v))[0]) for k, v in marks.items())
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError, IndexError):
        raise InputError(
            "values with scale_factor, add_offset or _FillValue must be numbers, as these must; "
            "correct it, or save as CSV"
        ) from None
    return np.where(numbers == fill, np.nan, scale * numbers + offset)


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _named(name: str, part: Any) -> str:
    """``p [bar]`` where an attribute says the unit."""
    for attribute in ("unit", "units", "Unit", "Units"):
        if attribute in part.attrs and "[" not in name:
            return f"{name} [{_text(part.attrs[attribute])}]"
    return name


def _require_bytes(path: str | os.PathLike[str], size: int) -> None:
    if size > MOST_UNPACKED:
        raise InputError(
            f"{os.fspath(path)} unpacks to more than the {MOST_UNPACKED / 2**20:g} MiB allowed; "
            "keep what is needed, or save the table as CSV in parts"
        )
