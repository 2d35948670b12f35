"""Files: read within limits, and written so that a reader never sees half of one.

What stands in a file was written by anybody, and may be damaged: whatever is wrong with it ends in
one sentence, and quickly. Limits are far above what measurements and plans need.
"""

from __future__ import annotations

import io
import json
import os
import re
import struct
import sys
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path as atomic_path
from .atomic import make_folder as make_folder
from .atomic import require_local as require_local
from .atomic import require_place as require_place
from .atomic import spelled as spelled
from .exceptions import InputError, PamError
from .interrupts import interruptible

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]

Array: TypeAlias = NDArray[Any]

MOST_BYTES = 512 * 2**20
"""Of a file that is read."""
MOST_UNPACKED = 2 * 2**30
"""Bytes that a packed file (.npz, .mat) may hold, asked of its directory before it is unpacked."""
FREELY_UNPACKED = 64 * 2**20
"""Bytes to which any file of measurements may unpack, however small it is."""
MOST_RATIO = 300
"""Of the bytes beyond, to those of the file: nothing but constants is packed a thousandfold."""
MOST_MEMBERS = 1000
"""Files in a packed file."""
MOST_DIRECTORY = 4 * 2**20
"""Bytes of a packed file's directory, each entry of which becomes an object of Python."""
MOST_JSON = 64 * 2**20
"""Bytes of JSON that says what something is (a fit, a session, what stands beside arrays)."""
MOST_JSON_PARTS = 2_000_000
"""Lists and mappings in JSON, or lines of it."""
MOST_JSON_VALUES = 20_000_000
"""Numbers and texts in JSON."""
MOST_COLUMNS = 2000
"""Of a table."""
MOST_ROWS = 20_000_000
"""Of a table."""
MOST_CELLS = 100_000_000
"""Rows times columns of a table."""
MOST_LINE = 2**20
"""Characters of a line of text."""
MOST_SHEET_BYTES = 64 * 2**20
"""Bytes that a spreadsheet (.xlsx) may hold: its cells are text, unpacked and read one by one."""
MOST_SHEET_CELLS = 2_000_000
"""Cells of a spreadsheet."""
MOST_TOML_BYTES = 2**20
"""Of a TOML file, which people write."""
MOST_DEPTH = 64
"""Brackets within brackets of a JSON or TOML file."""
MOST_PARTS = 32
"""Of a TOML key, as a.b.c has three."""
MOST_NAME = 200
"""Characters of a column's header or of a variable's name."""
MOST_WORDS = 500
"""Characters of what a message repeats of a file."""

DAMAGE = (
    ArithmeticError,
    AttributeError,
    BadZipFile,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    RuntimeError,  # of CasADi; and RecursionError
    TypeError,
    ValueError,
    struct.error,
    zlib.error,
)
"""What damage in a file leads to in the libraries and the code that read it."""


# ---- reading -------------------------------------------------------------------------------------
@contextmanager
def reading(
    path: str | os.PathLike[str], kind: str, remedy: str, foreign: bool = False
) -> Iterator[None]:
    """A block that makes something of a file: whatever it raises becomes an InputError.

    An InputError of our own stays one, and names the file in front. What damage leads to
    (:data:`DAMAGE`) becomes "FILE cannot be read as KIND". Anything else is said with its name and
    kept as the cause, for it may be a fault of ours.

    kind : what should be in the file, as "a plan file". remedy : what to do.
    foreign : a library of others reads here: all that it raises is damage.
    """
    name = os.fspath(path)
    try:
        # numbers beyond all bounds are said by checks; libraries are loaded in here
        with interruptible(), np.errstate(all="ignore"):
            yield
    except InputError as error:
        said = _short(str(error))
        named = name in said or Path(name).name in said
        error.args = (said if named else f"{spelled(path)}: {said}",)  # its class and the rest stay
        raise
    except PamError as error:
        raise InputError(f"{spelled(path)}: {_short(str(error))}") from error
    except Exception as error:
        words = f"{spelled(path)} cannot be read as {kind}: {_told(error)}"
        if foreign or isinstance(error, DAMAGE):
            raise InputError(f"{words}; {remedy}") from None
        raise InputError(f"{words}, which reading should not meet; please report it") from error


def _told(error: Exception) -> str:
    """An error of others in a few words on one line."""
    words = str(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, KeyError):
        return f"it lacks {_short(words)}"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, MemoryError):
        return "it asks for more memory than there is"
    return _short(f"{type(error).__name__}: {words}" if words else type(error).__name__)


def _short(words: str) -> str:
    """On one line, and not longer than :data:`MOST_WORDS` characters."""
    words = " ".join(words.split())
    half = MOST_WORDS // 2
    return words if len(words) <= MOST_WORDS else f"{words[:half]} ... {words[-half:]}"


def require_ending(path: str | os.PathLike[str], ending: str, what: str) -> None:
    """InputError unless the name of a file ends so (in small or capital letters)."""
    if Path(path).suffix.lower() != ending:
        raise InputError(f"path = {os.fspath(path)!r}: the name of {what} ends in {ending}")


def require_file(
    path: str | os.PathLike[str], most: int = MOST_BYTES, remedy: str = "give a smaller one"
) -> Path:
    """The path of an ordinary file of at most ``most`` bytes.

    Raises InputError for none, a folder, a device (which may have no end), and a larger file.
    """
    name = os.fspath(path)
    if not isinstance(name, str):
        raise InputError(f"path = {name!r}: give the name of a file as text")
    require_local(name)
    said = spelled(name)
    try:
        there, size = os.path.isfile(name), os.path.getsize(name)
    except (OSError, ValueError):
        there, size = False, 0
    if os.path.isdir(name):
        raise InputError(f"{said} is a folder; give a file")
    if not there:
        exists = "\0" not in name and os.path.exists(name)
        words = "is a device or a pipe; give a file" if exists else "no such file; look at its name"
        raise InputError(f"{said}: {words}" if not exists else f"{said} {words}")
    if size > most:
        raise InputError(
            f"{said} has {size / 2**20:.0f} MiB, more than the {most / 2**20:g} allowed; {remedy}"
        )
    return Path(name)


def content_of(path: str | os.PathLike[str], most: int = MOST_BYTES) -> bytes:
    """The bytes of a file. Raises InputError; see :func:`require_file`."""
    source = require_file(path, most)
    with reading(path, "a file", "look at its permissions"):
        return source.read_bytes()


def require_size(
    label: str, rows: int, columns: int, cells: int = MOST_CELLS, widest: int = MOST_COLUMNS
) -> None:
    """Raises InputError for a table with too many rows, columns or cells."""
    for count, most, what in (
        (columns, widest, "columns"),
        (rows, MOST_ROWS, "rows"),
        (rows * columns, cells, "cells"),
    ):
        if count > most:
            raise InputError(
                f"{label} has {count} {what}, more than the {most} allowed; "
                "keep what is needed, or cut it into several files"
            )


class _Cautious(io.FileIO):
    """A zip file whose directory is looked at: not more of it than it may have is read at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = os.fstat(self.fileno()).st_size - self.tell()
        if (left if size is None or size < 0 else min(size, left)) > MOST_DIRECTORY:
            raise InputError(
                f"its directory has more than {MOST_DIRECTORY / 2**20:g} MiB; pack fewer files"
            )
        return super().read(size)


def members_of(path: str | os.PathLike[str]) -> list[ZipInfo]:
    """The directory of a zip file, of a size that is bounded before it is read.

    What is stored or deflated, as the formats ask, unpacks to what the directory says at most, and
    in bounded steps (of bzip2 and LZMA zipfile unpacks a whole step, which can be gigabytes).

    Raises InputError for a larger directory and for other methods, BadZipFile for what is no zip.
    """
    with _Cautious(os.fspath(path)) as file, ZipFile(file) as archive:
        members = archive.infolist()
    for member in members:
        if member.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise InputError(
                f"{member.filename[:80]!r} is packed by method {member.compress_type}; "
                "pack it anew, deflated"
            )
    return members


def most_unpacked(packed: int) -> int:
    """To how many bytes a file of so many may unpack: what was measured is no constant."""
    return min(MOST_UNPACKED, max(FREELY_UNPACKED, MOST_RATIO * packed))


def require_unpacked(
    path: str | os.PathLike[str], most: int = MOST_UNPACKED, *, meta: int = MOST_UNPACKED
) -> None:
    """Raises InputError for a packed file that would unpack to more than ``most`` bytes.

    meta : bytes that the member of this name (.npy) may have. Only the directory is read.
    """
    members = members_of(path)
    size = sum(m.file_size for m in members)
    told = max((m.file_size for m in members if m.filename in ("meta", "meta.npy")), default=0)
    if told > meta:
        raise InputError(
            f"its 'meta' unpacks to {told / 2**20:.0f} MiB, more than the {meta / 2**20:g} allowed"
        )
    if size > most or len(members) > MOST_MEMBERS:
        raise InputError(
            f"{os.fspath(path)} unpacks to {len(members)} parts of {size / 2**20:.0f} MiB; at most "
            f"{MOST_MEMBERS} parts of {most / 2**20:g} MiB are allowed: save the table as CSV"
        )


def read_json(path: str | os.PathLike[str], kind: str, form: str, remedy: str) -> dict[str, Any]:
    """The mapping in a file of JSON whose "format" is ``form``.

    kind : what should be in it, for the message. Raises InputError for any other file.
    """
    text = content_of(path, MOST_JSON)
    with reading(path, kind, remedy):
        content = json_of(text)
    return require_format(path, content, kind, form, remedy)


def said_in(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a file of JSON, or beside the arrays of a .npz, of whatever kind.

    Raises InputError for any other file.
    """
    if Path(path).suffix.lower() == ".npz":
        return read_npz(path, "a file of pam_ocp")[0]
    text = content_of(path, MOST_JSON)
    with reading(path, "a file of pam_ocp", "give one that it wrote"):
        content = json_of(text)
    if not isinstance(content, dict):
        raise InputError(f"{os.fspath(path)} is no file of pam_ocp; give one that it wrote")
    return content


def json_of(text: bytes, infinite: bool = False) -> Any:
    """What JSON says. Raises ValueError for what is no JSON, or nested too deeply.

    infinite : Infinity and NaN, which JSON does not know, are numbers too.
    """
    codes = np.frombuffer(re.sub(rb'"(?:[^"\\]|\\.)*"', b"", text, flags=re.DOTALL), np.uint8)
    opening = ((codes == ord("[")) | (codes == ord("{"))).astype(np.int8)
    closing = ((codes == ord("]")) | (codes == ord("}"))).astype(np.int8)
    _require_shallow(np.cumsum(opening - closing, dtype=np.int32))
    parts, values = int(np.count_nonzero(opening)), int(np.count_nonzero(codes == ord(",")))
    if parts > MOST_JSON_PARTS or values > MOST_JSON_VALUES:
        raise ValueError(
            f"it has {parts} lists and mappings with {values} values, more than the "
            f"{MOST_JSON_PARTS} and {MOST_JSON_VALUES} allowed"
        )
    return json.loads(text.decode("utf-8"), parse_constant=float if infinite else _no_number)


def _require_shallow(depths: Array) -> None:
    if depths.size and depths.max() > MOST_DEPTH:
        raise ValueError(f"it is nested {depths.max()} deep, {MOST_DEPTH} is the most allowed")


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number that JSON knows")


_TOML_TEXT = re.compile(
    r'"""(?:[^\\]|\\.)*?"""' r"|'''.*?'''" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'" r"|#[^\n]*",
    re.DOTALL,
)
_TOML_KEY = re.compile(r"[\w\-. \t]+")


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a TOML file; InputError when there is none, or it is no TOML."""
    content = content_of(path, MOST_TOML_BYTES)
    with reading(path, "a TOML file", "mend it there, or write it anew"):
        text = content.decode("utf-8-sig")
        bare = _TOML_TEXT.sub("s", text)
        parts = max((found[0].count(".") for found in _TOML_KEY.finditer(bare)), default=0) + 1
        if parts > MOST_PARTS:
            raise ValueError(f"a key has {parts} parts, {MOST_PARTS} are the most allowed")
        steps = [(c in "[{") - (c in "]}") for c in bare if c in "[{]}"]
        _require_shallow(np.cumsum(steps, dtype=np.int64))
        found: dict[str, Any] = tomllib.loads(text)
    return found


def read_npz(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """(mapping, arrays by name) of what :func:`write_npz` wrote.

    kind : what should be in it, for the message. Raises InputError for any other file.
    """
    require_file(path)
    with reading(path, kind, "give a whole one, as it was saved", foreign=True):
        require_unpacked(path, meta=4 * MOST_JSON)  # NumPy has four bytes for each character
        with np.load(path, allow_pickle=False) as file:
            meta = file["meta"]
            if meta.shape != () or meta.dtype.kind != "U":
                raise InputError("its 'meta' is not one text")
            content = json_of(str(meta).encode(), infinite=True)
            arrays = {name: file[name] for name in file.files if name != "meta"}
    if not isinstance(content, dict):
        raise InputError(f"{os.fspath(path)} is no {kind.removeprefix('a ')}; save one anew")
    return content, arrays


def require_format(
    path: str | os.PathLike[str], content: Any, kind: str, form: str, remedy: str
) -> dict[str, Any]:
    """The content of a file, or an InputError when its "format" is not ``form``."""
    if not isinstance(content, dict) or content.get("format") != form:
        raise InputError(f"{os.fspath(path)} is no {kind.removeprefix('a ')}; {remedy}")
    return content


# ---- writing -------------------------------------------------------------------------------------
def _require_short(path: str | os.PathLike[str], text: str | bytes) -> None:
    if len(text) > MOST_JSON:  # it could not be read again
        raise InputError(
            f"{os.fspath(path)} was not written: {len(text) / 2**20:.0f} MiB of words and numbers, "
            f"at most {MOST_JSON / 2**20:g} are read again; keep less in one"
        )


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> Path:
    """Write a mapping as JSON; numbers must be finite. Returns the path."""
    with atomic_path(path) as temporary:
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False).encode()
        _require_short(path, text)
        temporary.write_bytes(text)
    return Path(path)


def write_npz(
    path: str | os.PathLike[str], content: Mapping[str, Any], arrays: Mapping[str, Array]
) -> Path:
    """Write arrays by name, and beside them a mapping as JSON under "meta". Returns the path."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        text = json.dumps(content, default=float)
        _require_short(path, text)
        meta = np.array(text)
        np.savez_compressed(file, allow_pickle=False, meta=meta, **arrays)
    return Path(path)
