"""Files that are there as a whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import errno
import os
import platform
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .exceptions import InputError, WriteError
from .interrupts import interruptible

if sys.platform != "win32":
    import fcntl

_MARK = "pam-part"
"""In the names of temporary files, so that those left behind by a killed process are known."""
_LOCK = ".in-use"
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(.*)", re.DOTALL)
"""Of two letters and more before the colon: one is a drive. A Path has one slash left of two."""
_REMEDIES = {
    errno.ENOSPC: "free some space, or write elsewhere",
    errno.EDQUOT: "free some space, or write elsewhere",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f), or write elsewhere",
    errno.EACCES: "give yourself the right to write there, or write elsewhere",
    errno.EPERM: "give yourself the right to write there, or write elsewhere",
    errno.EROFS: "write elsewhere",
    errno.ENAMETOOLONG: "give a shorter name",
}


@contextmanager
def atomic_path(target: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside ``target``, renamed to it when the block ends without an error.

    Until then, and after any error, ``target`` is as it was. A link is followed: the file that it
    leads to is replaced. An existing file keeps its permissions. The temporary file is hidden; one
    that a killed process left is removed by the next write to the same target.

    Raises WriteError (an InputError, and an OSError) for a target that cannot be a file, and for
    whatever the system refuses within the block: no space, no right, a read-only file system.
    """
    place, mode = require_place(target)
    _clear(place)
    try:
        temporary, handle = _made(place)
    except OSError as error:
        raise _refused(target, error) from None
    try:
        with interruptible():
            yield temporary
            _settled(temporary, mode)
            temporary.replace(place)
    except OSError as error:
        if isinstance(error, WriteError):
            raise
        raise _refused(target, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)  # and with it the lock


def spelled(path: str | os.PathLike[str]) -> str:
    """A path for a message: on one line, whatever stands in it."""
    name = os.fspath(path)
    return name if isinstance(name, str) and name.isprintable() else repr(name)


def is_url(name: str | bytes) -> bool:
    """Whether a name is that of something elsewhere, such as s3://bucket/runs."""
    return isinstance(name, str) and _URL.match(name) is not None


def require_local(target: str | os.PathLike[str]) -> None:
    """Raises WriteError for a URL, which would be taken for a folder of that name."""
    name = os.fspath(target)
    found = _URL.match(name) if isinstance(name, str) else None
    if found is not None:
        raise WriteError(
            f"{found[1]}://{found[2]} is a URL; give the path of a file or folder of this machine "
            "(a bucket or share can be mounted as one)"
        )


def require_place(target: str | os.PathLike[str]) -> tuple[Path, int | None]:
    """(the file that ``target`` leads to, its permissions or None where it is new).

    Raises WriteError where no file can be written: a missing folder, a folder or a device of that
    name, a file that is write-protected, a name that no file can have.
    """
    require_local(target)
    name, said = os.fspath(target), spelled(target)
    try:
        place = Path(os.path.realpath(name) if os.path.islink(name) else name)
        if os.path.islink(place):
            raise WriteError(f"{said} is a link that leads to itself; give the name of a file")
        _require_folder(said, place.parent)
        seen = place.stat().st_mode
    except FileNotFoundError:
        effective = os.access in os.supports_effective_ids
        if not os.access(place.parent, os.W_OK | os.X_OK, effective_ids=effective):
            raise _refused(target, PermissionError(errno.EACCES, "Permission denied")) from None
        return place, None
    except ValueError as error:  # a NUL
        if isinstance(error, WriteError):
            raise
        raise WriteError(f"{said} is no name for a file: {error}") from None
    except OSError as error:
        raise _refused(target, error) from None
    if stat.S_ISDIR(seen):
        raise WriteError(f"{said} is a folder; give the name of a file")
    if not stat.S_ISREG(seen):
        raise WriteError(f"{said} is a device or a pipe, not a file; give the name of a file")
    if not os.access(place, os.W_OK):
        raise WriteError(
            f"{said} is write-protected; allow writing to it, or give another name", errno.EACCES
        )
    return place, stat.S_IMODE(seen)


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """The folder, made with its parents where it is missing. Raises WriteError where it cannot."""
    require_local(folder)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise WriteError(f"{spelled(folder)} is a file; give the name of a folder") from None
    except OSError as error:
        words = error.strerror or error
        raise WriteError(
            f"{spelled(folder)}: cannot make this folder ({words}); give another", error.errno
        ) from None
    return Path(folder)


def _require_folder(name: str, folder: Path) -> None:
    shown = spelled(folder)
    try:
        if not stat.S_ISDIR(folder.stat().st_mode):
            raise WriteError(f"{name}: {shown} is a file, not a folder; give another name")
    except FileNotFoundError:
        raise WriteError(
            f"{name}: the folder {shown} does not exist; create it first", errno.ENOENT
        ) from None


def _refused(target: str | os.PathLike[str], error: OSError) -> WriteError:
    remedy = _REMEDIES.get(error.errno or 0, "write elsewhere")
    words = error.strerror or " ".join(str(error).split())
    return WriteError(f"{spelled(target)} was not written ({words}); {remedy}", error.errno)


# ---- temporary files -----------------------------------------------------------------------------
def _beside(place: Path) -> str:
    """How names of temporary files for a target begin; other targets of its folder have others."""
    name = os.fsencode(place.name)  # which may be no text in the encoding of this process
    short = name if len(name) <= 120 else name[:120].decode(errors="ignore").encode()
    return f".{os.fsdecode(short)}.{_MARK}-"


def _made(place: Path) -> tuple[Path, int | None]:
    """A new empty file, and the handle whose lock says that its writer lives."""
    while True:
        temporary = place.with_name(f"{_beside(place)}{os.urandom(6).hex()}{place.suffix[:20]}")
        handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if sys.platform == "win32":  # an open file could not be renamed there
            os.close(handle)
            return temporary, None
        with suppress(OSError):  # a file system without locks: left files stay
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        if os.fstat(handle).st_nlink:
            return temporary, handle
        os.close(handle)  # another writer took it for a left one before it was locked


def _clear(place: Path) -> None:
    """Remove temporary files of this target whose writers are dead."""
    if sys.platform == "win32":
        return
    mine = re.compile(re.escape(_beside(place)) + r"[0-9a-f]{12}" + re.escape(place.suffix[:20]))
    with suppress(OSError):
        for entry in os.scandir(place.parent):
            if mine.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                _remove_left(entry.path)


def _remove_left(path: str) -> None:
    if sys.platform == "win32":
        return
    with suppress(OSError):
        handle = os.open(path, os.O_RDWR)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # refused while its writer lives
            os.unlink(path)
        finally:
            os.close(handle)


def _settled(temporary: Path, mode: int | None) -> None:
    """On the disk, with the permissions of the file that it replaces."""
    if mode is not None:
        temporary.chmod(mode)
    handle = os.open(temporary, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# ---- one writer ----------------------------------------------------------------------------------
@contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """For the time of the block this process alone works in a folder.

    The lock goes with the process, however that ends. Raises InputError where another one holds it,
    and names it. A file system without locks lets all of them in.
    """
    if sys.platform == "win32":
        yield
        return
    handle = _locked(folder)
    try:
        os.truncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {platform.node()}".encode(), 0)
        yield
    finally:
        with suppress(OSError):
            os.unlink(folder / _LOCK)
        os.close(handle)


def _locked(folder: Path) -> int:
    """The open file whose lock is ours."""
    while sys.platform != "win32":
        try:
            handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise _refused(folder, error) from None
        try:
            # a record lock: children by fork do not have it, so it ends with this process
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            who = os.pread(handle, 200, 0).decode(errors="replace").strip()
            os.close(handle)
            raise InputError(
                f"{spelled(folder)}: another process is at work in this folder ({who}); wait for "
                "it, end it, or give another folder"
            ) from None
        except OSError:  # a file system without locks
            return handle
        if os.fstat(handle).st_nlink:
            return handle
        os.close(handle)  # its last holder took it away before we had it
    return -1
