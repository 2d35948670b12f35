"""The folder of many simulations: what study.json says, where the Parquet files are, digests.

A file says in its metadata from which cases and arguments it was made (a digest of both, and of all
code that they lead to), so that a run that was broken off goes on where it stood. The folder may be
one of this machine or in an object store.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core import exceptions
from ..core.atomic import in_use
from ..core.digest import built_with, own_digest
from ..core.errors import InputError, PamError, WriteError
from ..core.files import json_of, read_json, reading, require_format, spelled, write_json
from ..core.stores import Folder, Remote, opened, write_bytes

__all__ = [
    "FILES",
    "about_file",
    "arrow",
    "digest_held",
    "files_of",
    "metadata",
    "opened_folder",
    "part_of",
    "read_table",
    "revived",
    "said",
    "study_of",
    "write_study",
]

STUDY = "study.json"
FILES = "cases"
BLOCK = 1000
"""Files per folder."""
SOURCES = "files of pam_ocp"
REMEDY = "give an empty folder, or one that simulate_many(into=...) wrote"


def files_of(folder: Folder) -> Folder:
    """Where the Parquet files are: alone, as readers want them (once they lay beside the study)."""
    apart = folder / FILES
    return apart if isinstance(apart, Remote) or apart.is_dir() else folder


def part_of(folder: Folder, index: int) -> Folder:
    """The file of a part."""
    files = files_of(folder)
    name = f"part-{index:06d}.parquet"
    return files / name if files == folder else files / f"block-{index // BLOCK:04d}" / name


def study_of(folder: Folder, form: str) -> dict[str, Any]:
    """What study.json says. Raises InputError where it is none of this form."""
    path, kind = folder / STUDY, "a folder of simulations"
    if isinstance(path, Path):
        return read_json(path, kind, form, REMEDY)
    with reading(str(path), kind, REMEDY):
        content = json_of(path.read_bytes())
    return require_format(str(path), content, kind, form, REMEDY)


def said(folder: Folder) -> str:
    """For a message."""
    return spelled(folder) if isinstance(folder, Path) else str(folder)


@contextmanager
def opened_folder(
    folder: Folder, form: str, arguments: str, chunk: int | None, usual: int
) -> Iterator[int]:
    """Make the folder, or see that it holds this study: cases per file (None: as before).

    While it is open no other process of this machine may work on it. Raises InputError.
    """
    if not (folder / STUDY).exists():
        _made(folder)
    with in_use(folder) if isinstance(folder, Path) else _nothing():
        if not (folder / STUDY).exists():
            write_study(folder, form, arguments, chunk or usual, None)
            yield chunk or usual
            return
        content = study_of(folder, form)
        other = _changed(content.get("program") or {}, _program())
        if other:
            raise InputError(
                f"into = {said(folder)} holds simulations of another program ({other}); give "
                "another folder, or delete this one"
            )
        if content["arguments"] != arguments:
            raise InputError(
                f"into = {said(folder)} holds simulations of another plant or with other "
                "arguments; give another folder, or delete this one"
            )
        chunk = chunk or int(content["chunk"])
        write_study(folder, form, arguments, chunk, None)
        yield chunk


@contextmanager
def _nothing() -> Iterator[None]:
    yield


def _made(folder: Folder) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        empty = not any(p for p in folder.iterdir() if not p.name.startswith("."))
        if empty:
            (folder / FILES).mkdir(exist_ok=True)
    except WriteError:
        raise
    except OSError as error:
        raise InputError(f"into = {said(folder)}: {error.strerror}; {REMEDY}") from None
    if not empty:
        raise InputError(f"into = {said(folder)} holds other files; {REMEDY}")


def write_study(
    folder: Folder, form: str, arguments: str, chunk: int, parts: int | None, **more: Any
) -> None:
    """Write study.json; ``parts`` is None until all are there."""
    content = {"format": form, "arguments": arguments, "chunk": chunk, "parts": parts, **more}
    content["program"] = _program()
    path = folder / STUDY
    if isinstance(path, Path):
        write_json(path, content)
        return
    write_bytes(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False).encode())


# ---- one file -----------------------------------------------------------------------------------
def arrow(what: str = "simulate_many(into=...)") -> Any:
    """pyarrow's Parquet. Raises InputError where it is not installed."""
    try:
        import pyarrow.parquet
    except ImportError:
        raise InputError(f"{what} needs pyarrow: pip install pam_ocp[studies]") from None
    return pyarrow.parquet


def read_table(path: Folder, columns: Sequence[str] | None = None) -> Any:
    """A file as a table of pyarrow's, or columns of it."""
    with opened(path) as file:
        return arrow().read_table(file, columns=columns)


def metadata(content: Mapping[str, Any]) -> dict[bytes, bytes]:
    """What a file says about itself, for its schema."""
    return {b"pam_ocp": json.dumps(content).encode()}


def about_file(path: Folder) -> dict[str, Any]:
    """What a file says about itself. Raises InputError when it is none of ours."""
    try:
        with opened(path) as file:
            content = json.loads(arrow().read_schema(file).metadata[b"pam_ocp"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} cannot be read ({error}); delete it and run the same simulate_many again"
        ) from None
    return dict(content)


def digest_held(path: Folder) -> str | None:
    """The digest of a whole file; None where there is none or it is damaged."""
    try:
        if not path.is_file():
            return None
        read_table(path)  # a damaged page shows only when it is read
        return str(about_file(path)["digest"])
    except (InputError, OSError, ValueError):
        return None


def revived(error: Sequence[str]) -> Exception:
    """The error of a case, by its class and its sentence."""
    kind, message = error
    known = getattr(exceptions, kind, None)
    if known in (InputError, exceptions.SimulationError):
        return known(message)  # type: ignore[no-any-return]
    return PamError(message if known is not None else f"{kind}: {message}")


# ---- digests ------------------------------------------------------------------------------------
def _program() -> dict[str, str]:
    """What computes: packages by version, pam_ocp by the content of its files, too."""
    return {**built_with("casadi", "numpy", "scipy"), SOURCES: own_digest()}


def _changed(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """In what a program differs from this one; empty where it does not."""
    return ", ".join(
        n if n == SOURCES else f"{n} {before.get(n, 'of an unknown version')}, not {now[n]}"
        for n in now
        if before.get(n) != now[n]
    )
