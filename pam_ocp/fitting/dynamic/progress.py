"""What a long fit tells while it works."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import Any, TypeAlias

from ...core.errors import InputError

__all__ = ["Progress", "Report", "reporter"]

LOG = logging.getLogger(__name__)

Report: TypeAlias = Callable[[str, int, float], Any]
"""Called with the stage, its iterations until now, and the cost."""
Progress: TypeAlias = "bool | Report"


def reporter(progress: Progress) -> Report:
    """What to call: nothing for False, a line on stderr for True, or the user's function."""
    if callable(progress):
        return progress
    if not isinstance(progress, bool):
        raise InputError(
            f"progress = {progress!r}: give True to print, or a function (stage, iteration, cost)"
        )
    return _printed if progress else _logged


def _logged(stage: str, count: int, cost: float) -> None:
    LOG.debug("%s, iteration %d: cost %.6g", stage, count, cost)


def _printed(stage: str, count: int, cost: float) -> None:
    print(f"{stage:<28} {count:>5}  {cost:.6g}", file=sys.stderr, flush=True)
