"""Folders that are not of this machine: object stores and shares, by fsspec or pyarrow.

A :class:`Remote` has what is used of a ``Path`` here, so that a folder is written and read by the
same words wherever it is.
"""

from __future__ import annotations

import os
import posixpath
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from .atomic import atomic_path, is_url, spelled
from .errors import InputError, kind_of
from .exceptions import WriteError
from .lazy import library

OBJECT_STORES = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "oss", "memory"})
"""Where what is put is seen as a whole or not at all; elsewhere a file is written beside its place
and renamed."""
GIVE = (
    "give a folder, a URL that fsspec knows (s3://bucket/runs), a file system rooted at a folder "
    "(fsspec's DirFileSystem, pyarrow's SubTreeFileSystem), or (file system, path)"
)


@dataclass(frozen=True)
class Remote:
    """A place in a file system of fsspec's."""

    fs: Any
    path: str
    shown: str
    """As messages name it."""

    def __truediv__(self, name: str) -> Remote:
        return Remote(self.fs, posixpath.join(self.path, name), posixpath.join(self.shown, name))

    def __str__(self) -> str:
        return self.shown

    @property
    def name(self) -> str:
        return posixpath.basename(self.path)

    @property
    def parent(self) -> Remote:
        return Remote(self.fs, posixpath.dirname(self.path), posixpath.dirname(self.shown))

    def exists(self) -> bool:
        with _told(self):
            return bool(self.fs.exists(self.path))

    def is_file(self) -> bool:
        with _told(self):
            return bool(self.fs.isfile(self.path))

    def mkdir(self, parents: bool = True, exist_ok: bool = True) -> None:
        """An object store has no folders, and makes none."""
        with _told(self):
            if _protocol(self.fs) not in OBJECT_STORES:
                self.fs.makedirs(self.path, exist_ok=exist_ok)

    def iterdir(self) -> Iterator[Remote]:
        with _told(self):
            found = self.fs.ls(self.path, detail=False) if self.fs.exists(self.path) else []
        return (self / posixpath.basename(str(n).rstrip("/")) for n in found)

    def rglob(self, pattern: str) -> Iterator[Remote]:
        with _told(self):
            found = self.fs.find(self.path) if self.fs.exists(self.path) else []
        base = _bare(self.path)
        inside = (_bare(str(n))[len(base) :].strip("/") for n in found)
        fits = posixpath.basename(pattern).partition("*")
        return (
            self / name
            for name in inside
            if posixpath.basename(name).startswith(fits[0]) and name.endswith(fits[2])
        )

    def read_bytes(self) -> bytes:
        with _told(self):
            return bytes(self.fs.cat_file(self.path))

    def write_bytes(self, content: bytes) -> None:
        """All of it or nothing."""
        with _told(self):
            if _protocol(self.fs) in OBJECT_STORES:
                self.fs.pipe_file(self.path, content)
                return
            beside = self.parent / f".{self.name}.{uuid.uuid4().hex[:8]}.pam-part"
            try:
                self.fs.pipe_file(beside.path, content)
                self.fs.mv(beside.path, self.path)
            except BaseException:
                if self.fs.exists(beside.path):
                    self.fs.rm_file(beside.path)
                raise

    def unlink(self, missing_ok: bool = False) -> None:
        with _told(self):
            if not missing_ok or self.fs.exists(self.path):
                self.fs.rm_file(self.path)


Folder: TypeAlias = "Path | Remote"
Store: TypeAlias = "str | os.PathLike[str] | tuple[Any, str] | Any"
"""What a user may give for a folder; see :func:`folder_of`."""


def folder_of(label: str, given: Store) -> Folder:
    """A folder of this machine, or one elsewhere.

    given : a path; a URL that fsspec knows ("s3://bucket/runs"; its file system takes what it needs
        from the surroundings, as ``AWS_ENDPOINT_URL``); a file system of fsspec or pyarrow that is
        rooted at a folder; or (file system, path).

    Raises InputError, also where the library of that file system is missing.
    """
    if isinstance(given, Path | Remote):
        if isinstance(given, Path) and is_url(str(given)):
            raise InputError(f"{label} = {spelled(given)}: a Path spoils a URL; give it as a text")
        return given
    if isinstance(given, str | os.PathLike):
        text = os.fspath(given)
        return _of_url(label, text) if is_url(text) else Path(text)
    fs, path = given if isinstance(given, tuple) and len(given) == 2 else (given, "")
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{label}: the path is {kind_of(path)}; {GIVE}")
    if hasattr(fs, "base_fs") and hasattr(fs, "base_path"):  # pyarrow's SubTreeFileSystem
        fs, path = fs.base_fs, posixpath.join(fs.base_path, os.fspath(path))
    fs = _of_fsspec(label, fs)
    fs.invalidate_cache()
    path = os.fspath(path).rstrip("/")
    return Remote(fs, path, f"{_protocol(fs)}://{path.lstrip('/')}")


def write_bytes(path: Folder, content: bytes) -> None:
    """Write a file as a whole or not at all, with the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(path, Remote):
        path.write_bytes(content)
        return
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def opened(path: Folder) -> Iterator[Any]:
    """What pyarrow reads from: the path, or a file that asks for what is needed of it."""
    if isinstance(path, Path):
        yield path
        return
    try:
        file = path.fs.open(path.path, "rb")
    except OSError:
        raise
    except Exception as error:  # of a file system that is not known here
        raise OSError(f"{path}: {error}") from error
    with file:
        yield file


# ---- file systems --------------------------------------------------------------------------------
def _of_url(label: str, url: str) -> Remote:
    fsspec = library("fsspec", "studies", f"{label}: a folder elsewhere")
    try:
        fs, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        protocol = url.partition("://")[0]
        needed = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs"}
        raise InputError(
            f"{label} = {url}: {error}: pip install {needed.get(protocol, 'what it names')}"
        ) from None
    except ValueError as error:
        raise InputError(f"{label} = {url}: {error}; {GIVE}") from None
    fs.invalidate_cache()
    return Remote(fs, path.rstrip("/"), url.rstrip("/"))


def _of_fsspec(label: str, fs: Any) -> Any:
    fsspec = library("fsspec", "studies", f"{label}: a folder elsewhere")
    if isinstance(fs, fsspec.AbstractFileSystem):
        return fs
    if type(fs).__module__.partition(".")[0] == "pyarrow":
        from fsspec.implementations.arrow import ArrowFSWrapper

        try:
            return ArrowFSWrapper(fs)
        except Exception:  # another thing of pyarrow's
            pass
    raise InputError(f"{label} is {kind_of(fs)}; {GIVE}")


def _protocol(fs: Any) -> str:
    inner = getattr(fs, "fs", None)  # of a DirFileSystem
    if getattr(fs, "protocol", "") == "dir" and inner is not None:
        return _protocol(inner)
    protocol = fs.protocol
    return str(protocol if isinstance(protocol, str) else protocol[0])


def _bare(path: str) -> str:
    return path.partition("://")[2] if "://" in path else path.strip("/")


@contextmanager
def _told(place: Remote) -> Iterator[None]:
    """Whatever a file system raises, as one sentence."""
    try:
        yield
    except WriteError:
        raise
    except Exception as error:  # of libraries that are not known here
        words = " ".join(str(error).split()) or type(error).__name__
        raise WriteError(
            f"{place}: {words}; see that the store answers, that the bucket is there, and that you "
            "may write to it"
        ) from error
