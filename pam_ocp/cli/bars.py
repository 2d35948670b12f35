"""Progress bars with the time left, on a terminal; silence elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..core.progress import Bar, listening

__all__ = ["bars"]

SHORT = 1.0
"""What takes no longer shows no bar [s]."""


@contextmanager
def bars(wanted: bool = True) -> Iterator[None]:
    """For this block, long work shows a bar on the terminal's error stream."""
    if not wanted or not sys.stderr.isatty():
        yield
        return
    with listening(_bar):
        yield


def _bar(what: str, total: int | None) -> Bar:
    from tqdm import tqdm

    return _Shown(tqdm(total=total, desc=what, delay=SHORT, leave=False, file=sys.stderr))


class _Shown:
    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def step(self, more: int = 1, note: str = "") -> None:
        """See :class:`Bar`."""
        if note:
            self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(more)

    def close(self) -> None:
        """See :class:`Bar`."""
        self._bar.close()
