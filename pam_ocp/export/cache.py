"""Compiled libraries kept on disk: in a folder that is the user's alone, used only when whole."""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import shutil
import stat
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path


def home_folder() -> Path | None:
    """The user's home; None where there is none: a user whom this machine does not know and who has
    no HOME, or one of a folder that is not there.
    """
    try:
        home = Path(os.path.expanduser("~"))
    except RuntimeError:
        return None
    return home if home.is_absolute() and os.environ.get("HOME") != "" and home.is_dir() else None


def user_folder(variable: str, inside: str) -> Path | None:
    """Folder ``pam_ocp`` in what an XDG variable names, which counts where it is absolute (as XDG
    asks), or ``inside`` the home; on Windows among the user's data. None where there is no home.
    """
    local = os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None
    base = Path(local or os.environ.get(variable) or "")
    home = home_folder()
    if base.is_absolute():
        return base / "pam_ocp"
    return None if home is None else home / inside / "pam_ocp"


def cache_folder() -> Path:
    """Where compiled libraries are kept by choice: $PAM_OCP_CACHE, else ``pam_ocp`` in the user's
    cache folder, else in the temporary folder.

    The folder need not exist; :func:`usable_folder` gives one that can be written and trusted.
    """
    chosen = os.environ.get("PAM_OCP_CACHE")
    if chosen:
        return Path(chosen).absolute()
    return user_folder("XDG_CACHE_HOME", ".cache") or _of_user()


def usable_folder(part: str) -> Path:
    """The folder ``part`` of the cache, made if need be: it can be written, and nobody else can.

    Where the chosen cache cannot be written, one for this user in the temporary folder; where that
    is not this user's alone, one for this process. A cache that others could have filled is left
    alone, with a warning: what lies in it would be run.
    """
    for folder in dict.fromkeys((cache_folder(), _of_user())):
        inner = folder / part
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            doubt = _doubt(folder) or _doubt(inner)
        except (OSError, ValueError):
            continue  # no place to write to
        if doubt:
            warnings.warn(f"compiled code is not kept in {folder}: {doubt}", stacklevel=2)
        elif os.access(inner, os.W_OK | os.X_OK):
            return inner
    inner = _of_process() / part
    inner.mkdir(mode=0o700, exist_ok=True)
    return inner


def _of_user() -> Path:
    """A folder in the temporary folder whose name tells the user (on Windows that is the
    user's).
    """
    user = f"_{os.geteuid()}" if hasattr(os, "geteuid") else ""
    return Path(tempfile.gettempdir()).absolute() / f"pam_ocp{user}"


@cache
def _of_process() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="pam_ocp_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _doubt(folder: Path) -> str:
    """Why a folder, made if need be, cannot be trusted with code to run; empty when it can."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    if not hasattr(os, "geteuid"):
        return ""
    found = folder.lstat()
    if stat.S_ISLNK(found.st_mode) and found.st_uid == os.geteuid():
        found = folder.stat()  # the user's own link
    if not stat.S_ISDIR(found.st_mode):
        return f"{folder} is no folder, or a link that someone else made; remove it"
    if found.st_uid != os.geteuid():
        return f"{folder} belongs to another user; name a folder of your own by PAM_OCP_CACHE"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to {folder}; empty it and say: chmod go-w '{folder}'"
    return ""


# ---- libraries ----------------------------------------------------------------------------------


def digest(content: bytes) -> str:
    """SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def kept(path: Path) -> bytes | None:
    """What :func:`keep` put there; None when it is not there, or damaged."""
    try:
        content, told = path.read_bytes(), _beside(path).read_text("ascii")
    except (OSError, ValueError):
        return None
    return content if told.strip() == digest(content) else None


def keep(path: Path, content: bytes) -> None:
    """Put a library into the cache, its digest beside it; other processes see all of it or nothing.

    A cache that cannot be written costs time only.
    """
    with contextlib.suppress(OSError):
        write_whole(path, content)
        write_whole(_beside(path), digest(content).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it, for this user to read only. Raises OSError."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")
