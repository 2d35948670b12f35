"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError

__all__ = ["atomic_path", "read_json", "write_json"]


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


def write_json(path: str | os.PathLike[str], content: dict[str, Any]) -> Path:
    """Write a mapping as JSON; numbers must be finite. Returns the path."""
    with atomic_path(path) as temporary:
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def read_json(path: str | os.PathLike[str], kind: str, form: str, remedy: str) -> dict[str, Any]:
    """The mapping in a file whose "format" is ``form``.

    kind : what should be in it, for the message. Raises InputError for any other file.
    """
    name = os.fspath(path)
    try:
        content = json.loads(Path(path).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{name} cannot be read as {kind}: {error}") from None
    if not isinstance(content, dict) or content.get("format") != form:
        raise InputError(f"{name} is no {kind.removeprefix('a ')}; {remedy}")
    return content
