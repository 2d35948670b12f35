"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

__all__ = [
    "atomic_path",
    "read_json",
    "read_npz",
    "require_format",
    "write_json",
    "write_npz",
]

Array: TypeAlias = NDArray[Any]


@contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside ``target``, renamed to it when the block ends without an error.

    Raises InputError when the folder does not exist or cannot be written.
    """
    target = Path(target)
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; create it first")
    if target.is_dir():
        raise InputError(f"{target} is a folder; give the name of a file")
    try:
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=".", suffix=target.suffix)
    except OSError as error:
        raise InputError(f"{target}: cannot write here ({error.strerror})") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes files that only their owner may read
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> Path:
    """Write a mapping as JSON; numbers must be finite. Returns the path."""
    with atomic_path(path) as temporary:
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def write_npz(
    path: str | os.PathLike[str], content: Mapping[str, Any], arrays: Mapping[str, Array]
) -> Path:
    """Write arrays by name, and beside them a mapping as JSON under "meta". Returns the path."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        meta = np.array(json.dumps(content, default=float))
        np.savez_compressed(file, allow_pickle=False, meta=meta, **arrays)
    return Path(path)


def read_json(path: str | os.PathLike[str], kind: str, form: str, remedy: str) -> dict[str, Any]:
    """The mapping in a file of JSON whose "format" is ``form``.

    kind : what should be in it, for the message. Raises InputError for any other file.
    """
    try:
        content = json.loads(Path(path).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{os.fspath(path)} cannot be read as {kind}: {error}") from None
    return require_format(path, content, kind, form, remedy)


def read_npz(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """(mapping, arrays by name) of what :func:`write_npz` wrote.

    kind : what should be in it, for the message. Raises InputError for any other file.
    """
    if not Path(path).is_file():
        raise InputError(f"{os.fspath(path)}: no such file")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        content = json.loads(str(arrays.pop("meta")))
    except (
        ValueError,
        OSError,
        KeyError,
        TypeError,
        AttributeError,
        EOFError,
        BadZipFile,
    ) as error:
        raise InputError(f"{os.fspath(path)} cannot be read as {kind}: {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{os.fspath(path)} is no {kind.removeprefix('a ')}")
    return content, arrays


def require_format(
    path: str | os.PathLike[str], content: Any, kind: str, form: str, remedy: str
) -> dict[str, Any]:
    """The content of a file, or an InputError when its "format" is not ``form``."""
    if not isinstance(content, dict) or content.get("format") != form:
        raise InputError(f"{os.fspath(path)} is no {kind.removeprefix('a ')}; {remedy}")
    return content
