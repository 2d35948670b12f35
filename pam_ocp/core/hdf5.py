"""What an HDF5 file holds, as nested mappings: MATLAB's -v7.3, and files of others.

Format of MATLAB: structures are groups, cells are references, text is numbers with the attribute
``MATLAB_class`` "char", and matrices stand transposed (MathWorks, "MAT-File Versions").
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .exceptions import InputError

__all__ = ["tree_of"]

MOST_OBJECTS = 20_000
"""Groups, datasets and references of a file."""
MOST_ENTRIES = 1_000_000
"""Texts, their characters (of MATLAB) and cells of a file."""
MOST_LEVELS = 16


class _Reader:
    """Reads what lies in the file itself, within limits: links may lead in circles."""

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
        return values

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


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _named(name: str, part: Any) -> str:
    """``p [bar]`` where an attribute says the unit."""
    for attribute in ("unit", "units", "Unit", "Units"):
        if attribute in part.attrs and "[" not in name:
            return f"{name} [{_text(part.attrs[attribute])}]"
    return name


def tree_of(file: Any, most: int) -> dict[str, Any]:
    """{name: array, text, array of objects or mapping} of an open file.

    most : bytes that it may unpack to. Raises InputError beyond.
    """
    return _Reader(file, most).group(file, 0)
