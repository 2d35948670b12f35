"""Results of steps that are kept: by the digest of all that went into them.

joblib's Memory keeps them, in the user's own folder (whoever could write there could have his code
run: results are pickled). An entry is written beside its place and renamed, so that a process that
is killed leaves all of it or nothing.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..core.atomic import make_folder
from ..core.digest import built_with
from ..export.cache import usable_folder

PACKAGES = ("casadi", "numpy", "scipy", "control", "fmpy", "matplotlib")
"""Whose versions go into every digest, and stand in the report."""
MOST_KEPT = 2 * 2**30
"""Bytes; what was not used for longest goes first."""


class Kept:
    """Where results are kept. folder : None for the user's cache."""

    def __init__(self, folder: str | os.PathLike[str] | None = None) -> None:
        from joblib import Memory

        place = make_folder(folder) if folder is not None else usable_folder("studies")
        self.folder = str(Path(place).absolute())
        self._memory = Memory(place, verbose=0)
        self._results = self._memory.cache(_result, ignore=["made"])

    def __contains__(self, key: str) -> bool:
        return bool(self._results.check_call_in_cache(key, None))

    def get(self, key: str) -> dict[str, Any] | None:
        """What was kept; None where there is nothing, or nothing that can be read."""
        if key not in self:
            return None
        log = logging.getLogger("joblib")
        before = log.level
        log.setLevel(logging.CRITICAL)  # what is damaged is made anew, without a word
        try:
            found: dict[str, Any] = self._results(key, _nothing)
        except _NothingKept:
            return None
        finally:
            log.setLevel(before)
        return found

    def put(self, key: str, result: dict[str, Any]) -> None:
        """Keep a result."""
        self._results(key, lambda: result)

    def trim(self) -> None:
        """Let go of what exceeds ``MOST_KEPT``."""
        self._memory.reduce_size(bytes_limit=MOST_KEPT)


class _NothingKept(Exception):
    pass


def _nothing() -> dict[str, Any]:
    raise _NothingKept


def _result(key: str, made: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What joblib keeps by its key alone."""
    return made()


# ---- digests -------------------------------------------------------------------------------------
def key_of(content: Any) -> str:
    """Of plain data, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def versions() -> Mapping[str, str]:
    """Of Python, pam_ocp, and the packages that its results come from."""
    return built_with(*PACKAGES)
