"""Progress of long work: verbs say how far they are, and who wants to know listens.

Nobody listens by default, and then it costs nothing. The command line shows bars
(:mod:`pam_ocp.cli.output`); in Python ``with listening(listener):`` does what one likes.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import Protocol, TypeVar

T = TypeVar("T")


class Bar(Protocol):
    """What a listener makes of a piece of work."""

    def step(self, more: int = 1, note: str = "") -> None:
        """So many parts more are done."""

    def close(self) -> None:
        """The work has ended, however."""


Listener = Callable[[str, "int | None"], Bar]
_listeners: list[Listener] = []
_inside: list[str] = []
"""The work under way: what lies within another is not told."""


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """For this block: called as listener(what, how many or None) when long work begins."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.pop()


def heard() -> bool:
    """Whether anybody listens to work that begins now."""
    return bool(_listeners) and not _inside


class _Silent:
    def step(self, more: int = 1, note: str = "") -> None:
        pass

    def close(self) -> None:
        pass


@contextmanager
def working(what: str, total: int | None = None) -> Iterator[Bar]:
    """A piece of work of ``total`` parts (None: nobody knows): a Bar to be told of each."""
    if not _listeners or _inside:
        yield _Silent()
        return
    bar = _listeners[-1](what, total)
    _inside.append(what)
    try:
        yield bar
    finally:
        _inside.pop()
        bar.close()


def counted(items: Iterable[T], what: str, total: int | None = None) -> Generator[T, None, None]:
    """The items, each told as done when the next is asked for."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with working(what, total) as bar:
        for item in items:
            yield item
            bar.step()
