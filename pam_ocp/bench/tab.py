"""What a tab of the page is; each stands in a file of ``tabs/`` and is listed in frame.py.

A tab draws itself once (when it is first opened) and again draws what a change of the session
concerns. It computes nothing itself: quick looks (some ms) by made.py here, all else by functions
that run in other processes::

    class Plant(Tab):
        title, parts = "Plant", ("muscle", "plant", "point")

        def build(self) -> None:                    # NiceGUI's elements, within the tab's panel
            with elements.section("Load"):
                ...
            self.update(frozenset(self.parts))

        def update(self, changed) -> None:          # called after a change of one of ``parts``
            ...

        def _moved(self, mass) -> None:             # an event: one change, one step of undo
            with self.bench.shown_errors():
                self.bench.session.change("mass", plant={**self.state["plant"], "mass": mass})

        async def _map(self) -> None:               # long: in a process, stoppable, in the footer
            with self.bench.shown_errors():
                found = await self.bench.work("Equilibrium map", jobs.equilibrium_map, ...)

``lines`` is what the exported script says of the same: made of the state alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from .session import Session

__all__ = ["Page", "Tab"]


class Page(Protocol):
    """What a tab sees of the page in one browser; frame.py has it.

    session : state, undo, files; folder : of the session. allow_code : whether files may name code
    to be run, as it was said when the page was started.
    """

    session: Session
    allow_code: bool

    @property
    def folder(self) -> Path: ...

    def shown_errors(self) -> AbstractContextManager[None]:
        """Errors within the block are shown on the page."""

    async def work(
        self,
        title: str,
        function: Callable[..., Any],
        *args: Any,
        time_limit: float | None = 600.0,
        quiet: bool = False,
        **kwargs: Any,
    ) -> Any:
        """The result of ``function(say, *args, **kwargs)``, done in another process (work.py).

        quiet : not shown in the footer (what takes a blink, again and again). ``warm``, ``latest``
        as of :meth:`Workshop.start`. Raises JobFailed, JobStopped.
        """

    def soon(self, handler: Callable[[], Any]) -> None:
        """Start a coroutine of a tab from where nothing can be awaited; its errors are shown."""

    def script(self) -> str:
        """What was done in this session, as a script."""

    def words(self, text: str) -> str:
        """What the library says in the words of the page (words.py)."""

    def say(self, text: str, kind: str = "info") -> None:
        """A line below the header, read out to the blind; kind "error" stays until it is closed."""

    def download(self, content: bytes | str, name: str) -> None:
        """Hand a file to the browser; what was pressed may be drawn anew, or gone, meanwhile."""

    def open(self, title: str) -> None:
        """Show a tab."""


class Tab:
    """One tab in one browser."""

    title: str = ""
    icon: str = ""
    parts: tuple[str, ...] = ()
    """Parts of the session whose change concerns it."""

    def __init__(self, bench: Page) -> None:
        self.bench = bench

    @property
    def state(self) -> dict[str, Any]:
        """The session's state; never changed in place."""
        return self.bench.session.state

    def build(self) -> None:
        """Make the tab's elements."""

    def update(self, changed: frozenset[str]) -> None:
        """Show what has changed; only called after :meth:`build`."""

    def close(self) -> None:
        """The browser is gone."""

    @staticmethod
    def lines(state: dict[str, Any]) -> Sequence[str]:
        """Lines of the script that repeat what the state says of this tab."""
        return ()
