"""Formats that libraries of others read: their limits are asked before anything is unpacked."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
from .mat import matrices_of

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "frame",
    "library",
    "read_array",
    "read_arrays",
    "read_frame",
    "read_hdf5",
    "read_mat",
    "read_sheets",
]


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
            names = [s.title for s in book.worksheets]
            chosen = names if sheet is None else [_sheet_named(path, names, sheet)]
            budget = MOST_SHEET_CELLS
            found: dict[str, list[Sequence[Any]]] = {}
            for name in chosen:
                found[name] = _rows(path, book[name], budget)
                budget -= sum(len(row) + 1 for row in found[name])
        finally:
            book.close()
    return found


def _sheet_named(path: str | os.PathLike[str], names: list[str], sheet: str | int) -> str:
    if isinstance(sheet, int) and not isinstance(sheet, bool) and 1 <= sheet <= len(names):
        return names[sheet - 1]
    if sheet not in names:
        raise UnknownNameError(f"sheet of {Path(path).name}", str(sheet), names)
    return str(sheet)


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
    """What a MAT file holds, by name; see :func:`pam_ocp.core.mat.matrices_of`.

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

        from .hdf5 import tree_of

        source = path if content is None else io.BytesIO(content)
        size = os.path.getsize(path) if content is None else len(content)
        with h5py.File(source, "r") as file:
            return tree_of(file, most_unpacked(size))


def _require_bytes(path: str | os.PathLike[str], size: int) -> None:
    if size > MOST_UNPACKED:
        raise InputError(
            f"{os.fspath(path)} unpacks to more than the {MOST_UNPACKED / 2**20:g} MiB allowed; "
            "keep what is needed, or save the table as CSV in parts"
        )
