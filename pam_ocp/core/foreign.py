"""Formats that libraries of others read: their limits are asked before anything is unpacked."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .exceptions import InputError
from .files import (
    MOST_SHEET_BYTES,
    MOST_SHEET_CELLS,
    MOST_UNPACKED,
    content_of,
    reading,
    require_file,
    require_size,
    require_unpacked,
)
from .mat import matrices_of

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["frame", "read_arrays", "read_frame", "read_mat", "read_sheet"]


@contextmanager
def _library(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
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
                f"({missing}): pip install pam_ocp[studies], or save the table as CSV"
            ) from None


def read_arrays(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The arrays of an .npz file by name. Raises InputError."""
    require_file(path)
    with _library(path, "an .npz file"):
        require_unpacked(path)
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)


def frame(
    rows: Sequence[Sequence[Any]], columns: Sequence[str], index: Sequence[Any], name: str
) -> pd.DataFrame:
    """Rows as a DataFrame with an index of this name. Raises InputError where pandas is missing."""
    try:
        import pandas as pd
    except ImportError:
        raise InputError("to_pandas needs pandas: pip install pam_ocp[studies]") from None
    return pd.DataFrame(rows, columns=list(columns), index=pd.Index(index, name=name))


def read_frame(path: str | os.PathLike[str]) -> pd.DataFrame:
    """A Parquet file as a DataFrame. Raises InputError, also without pandas and pyarrow."""
    require_file(path)
    with _library(path, "a Parquet file"):
        import pandas as pd
        from pyarrow import parquet

        with parquet.ParquetFile(path) as file:
            told = file.metadata
            require_size(Path(path).name, told.num_rows, told.num_columns)
            groups = (told.row_group(i) for i in range(told.num_row_groups))
            _require_bytes(path, sum(group.total_byte_size for group in groups))
        return pd.read_parquet(path, engine="pyarrow")


def read_sheet(path: str | os.PathLike[str]) -> tuple[list[str], list[Sequence[Any]]]:
    """(headers, rows) of the first sheet of an .xlsx file; empty rows and columns are left out.

    Rows are read one by one and counted: what a sheet says of its own size is not believed.
    Raises InputError, also without openpyxl.
    """
    require_file(path)
    name = Path(path).name
    with _library(path, "an .xlsx file"):
        from openpyxl import load_workbook

        require_unpacked(path, MOST_SHEET_BYTES)
        book = load_workbook(path, read_only=True, data_only=True, keep_links=False)
        try:
            sheet = book.worksheets[0]
            sheet.reset_dimensions()
            rows: list[Sequence[Any]] = []
            cells = 0
            for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
                cells += len(row) + 1
                require_size(name, number, len(row))
                if cells > MOST_SHEET_CELLS:
                    raise InputError(
                        f"{name} has more than the {MOST_SHEET_CELLS} cells allowed in a "
                        "spreadsheet; save it as CSV"
                    )
                if any(cell is not None and cell != "" for cell in row):
                    rows.append(row)
        finally:
            book.close()
    if not rows:
        return [], []
    kept = [i for i, head in enumerate(rows[0]) if head is not None]
    kept += [
        i
        for i in range(len(rows[0]), max(map(len, rows)))
        if any(len(row) > i and row[i] is not None for row in rows)
    ]
    heads = [str(rows[0][i]) if i < len(rows[0]) else f"column {i + 1}" for i in kept]
    return heads, [[row[i] if i < len(row) else None for i in kept] for row in rows[1:]]


def read_mat(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The matrices of a MAT file (-v6, -v7) by name. Raises InputError."""
    content = content_of(path)
    with reading(path, "a .mat file", "save it anew, or as CSV"):
        return matrices_of(content, MOST_UNPACKED)


def _require_bytes(path: str | os.PathLike[str], size: int) -> None:
    if size > MOST_UNPACKED:
        raise InputError(
            f"{os.fspath(path)} unpacks to more than the {MOST_UNPACKED / 2**20:g} MiB allowed; "
            "keep what is needed, or save the table as CSV in parts"
        )
