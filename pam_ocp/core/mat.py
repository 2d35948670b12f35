"""MAT files of version 5 (MATLAB's -v6 and -v7): their matrices of numbers and of characters.

SciPy's reader runs past its buffers in damaged files, which kills the process; this one reads
slices of what is there. Format: MathWorks, MAT-File Format, R2024a, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .exceptions import InputError

__all__ = ["matrices_of"]

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
_MATRIX, _PACKED = 14, 15
_CHARACTERS, _DOUBLE, _LAST = 4, 6, 15
"""Classes of matrices; from double on they are numbers."""
_COMPLEX = 0x0800


def matrices_of(content: bytes, most: int) -> dict[str, Array]:
    """{name: matrix} of a file's content; cells, structures and objects are left out.

    most : bytes that it may unpack to.

    Raises InputError for another version, and ValueError, struct.error or zlib.error where it is
    damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:_HEADER])
    if order is None or content[:10] != b"MATLAB 5.0":
        raise InputError("it is no MAT file of version 5; save it with -v7, or as CSV")
    found = {}
    for kind, part in _elements(content[_HEADER:], order):
        if kind == _PACKED:
            unpacker = zlib.decompressobj()
            part = unpacker.decompress(part, most + 1)
            most -= len(part)
            if most < 0:
                raise InputError("it unpacks to more than is allowed; save it as CSV in parts")
            if not unpacker.eof:
                raise ValueError("a packed matrix is cut off")
            kind, part = next(_elements(part, order))
        if kind == _MATRIX:
            name, matrix = _matrix(part, order)
            if matrix is not None:
                found[name] = matrix
    return found


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
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


def _matrix(content: bytes, order: str) -> tuple[str, Array | None]:
    parts = list(_elements(content, order))
    flags = int(_numbers(*parts[0], order)[0])
    kind, shape = flags & 0xFF, [int(n) for n in _numbers(*parts[1], order)]
    name = parts[2][1].decode("ascii")
    if kind != _CHARACTERS and not _DOUBLE <= kind <= _LAST:
        return name, None
    if flags & _COMPLEX:
        raise InputError(f"variable {name!r} is complex; save its parts as real numbers")
    numbers = _numbers(*parts[3], order)
    if len(shape) < 2 or min(shape) < 0 or float(np.prod(np.array(shape, float))) != numbers.size:
        raise ValueError(f"variable {name!r} has {numbers.size} entries, its shape says {shape}")
    matrix = numbers.reshape(shape, order="F")
    if kind != _CHARACTERS:
        return name, matrix
    return name, np.array(["".join(map(chr, row)).rstrip() for row in matrix])


def _numbers(kind: int, content: bytes, order: str) -> Array:
    if kind not in _STORED:
        raise ValueError(f"an element of kind {kind} stands where numbers are expected")
    return np.frombuffer(content, f"{order}{_STORED[kind]}")
