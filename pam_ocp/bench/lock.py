"""A folder that one process at a time holds; the lock of a killed process is free again."""

from __future__ import annotations

import os
import sys
from pathlib import Path

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["FolderLock"]


class FolderLock:
    """Holds the file ``path``, if nobody else does; ``taken`` says whether."""

    def __init__(self, path: Path) -> None:
        self._handle: int | None = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            if sys.platform == "win32":
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._handle)
            self._handle = None

    @property
    def taken(self) -> bool:
        """Whether this process holds it."""
        return self._handle is not None

    def release(self) -> None:
        """Let others have it."""
        if self._handle is None:
            return
        os.close(self._handle)
        self._handle = None
