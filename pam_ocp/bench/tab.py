"""What a tab of the page is, and what it sees of the page; each stands in a file of ``tabs/`` and
is listed in app.py.

A tab draws itself once (when it is first opened) and again draws what a change of the session
concerns. It computes nothing itself: quick looks (some ms) by made.py here, all else by functions
that run in other processes::

    class Plant(Tab):
        title, parts = "Plant", ("muscle", "plant", "point")

        def build(self) -> None:                    # NiceGUI's elements, within the tab's panel
            with elements.section("Load"):
                self._form = elements.Form()
        def update(self, changed) -> None:          # called then, and after a change of ``parts``
            self._form.show([(MASS, self.state["plant"]["mass"], self._moved)])

        def _moved(self, mass) -> None:             # an event: one change, one step of undo
            self.session.change("mass", plant={**self.state["plant"], "mass": mass})

        async def _map(self) -> None:               # long: in a process, stoppable, in the footer
            found = await self.work(jobs.equilibrium_map)

What an event raises is shown on the page. What the exported script says of a tab: script.py.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import background_tasks, ui

from ..core.errors import InputError, PamError
from .elements import Form, Row, buttons, words
from .made import World
from .rig_room import RigRoom
from .session import Session
from .words import page_words
from .work import Job, JobFailed, JobStopped, Workshop, manner_of

log = logging.getLogger(__name__)


class Page:
    """What a tab sees of the page in one browser; app.py draws it.

    session : state, undo, files. allow_code : whether files may name code to be run (as the start
    of the page said). room : the rig that the page was started with.
    """

    def __init__(
        self, session: Session, shop: Workshop, *, allow_code: bool, room: RigRoom | None = None
    ) -> None:
        self.session, self.shop, self.allow_code, self.room = session, shop, allow_code, room
        self.client = ui.context.client
        self.client.on_exception(self.failed)

    def open(self, title: str) -> None:
        """Show a tab."""
        raise NotImplementedError

    def told(self, job: Job) -> None:
        """Show what a job does."""
        raise NotImplementedError

    def message(self, text: str, kind: str) -> None:
        """Show a line below the header."""
        raise NotImplementedError

    def failed(self, error: Exception) -> None:
        """An error in words on the page; the trace of what was not raised on purpose in the log."""
        if isinstance(error, JobStopped):
            if "overtaken" not in str(error):
                self.say(str(error))
        elif isinstance(error, PamError):
            if isinstance(error, JobFailed) and error.trace:
                log.error("%s", error.trace)
            self.say(str(error), "error")
        else:
            self.say(f"{type(error).__name__}: {error}; please report it", "error")

    @contextmanager
    def shown_errors(self) -> Iterator[None]:
        """Errors outside of an event, too."""
        try:
            yield
        except Exception as error:
            if not isinstance(error, PamError | JobStopped):
                log.exception("in the page")
            self.failed(error)

    async def work(self, function: Callable[..., Any], *args: Any, of: str = "", **how: Any) -> Any:
        """The result of ``function(say, *args)``, done in another process as :func:`work.job` says.

        of : what it is done to, in its title. how : otherwise than it says. Raises JobFailed,
        JobStopped.
        """
        manner = {**asdict(manner_of(function)), **how}
        title, quiet = manner.pop("title").format(of), manner.pop("quiet")
        changed = None if quiet else self.told
        return await self.shop.start(
            self.session.id, title, function, *args, changed=changed, **manner
        )

    def soon(self, work: Coroutine[Any, Any, Any]) -> None:
        """Do what an event awaits where nothing can be awaited; its errors are shown."""
        background_tasks.create(work, context=self.client)

    def words(self, text: str) -> str:
        """What the library says in the words of the page (words.py)."""
        known = {d["file"]: d["name"] for d in self.session.state["data"] if "file" in d}
        return page_words(text, self.session.folder, {**known, **self.session.names})

    def say(self, text: str, kind: str = "info") -> None:
        """A line below the header, read out to the blind; an error stays until it is closed."""
        with suppress(Exception), self.client:
            self.message(self.words(text), kind)

    def download(self, content: bytes | str, name: str) -> None:
        """Hand a file to the browser; what was pressed may be drawn anew, or gone, meanwhile."""
        with self.client:
            ui.download.content(content, name)

    def deliver(self, path: Path) -> None:
        """A file that a job has written."""
        self.download(path.read_bytes(), path.name)


class Tab:
    """One tab in one browser."""

    title: str = ""
    parts: tuple[str, ...] = ()
    """Parts of the session whose change concerns it."""

    def __init__(self, bench: Page) -> None:
        self.bench, self.session = bench, bench.session

    @property
    def state(self) -> dict[str, Any]:
        """The session's state; never changed in place."""
        return self.session.state

    @property
    def world(self) -> World:
        """What is made of the state."""
        return World(self.session.folder, self.state, self.bench.allow_code)

    async def work(self, function: Callable[..., Any], *args: Any, of: str = "", **how: Any) -> Any:
        """The result of ``function(say, world, *args)``; see :meth:`Page.work`."""
        return await self.bench.work(function, self.world, *args, of=of, **how)

    def view(self, name: str, default: Any = None) -> Any:
        """What the tab remembers of itself."""
        return self.session.view(self.title, name, default)

    def remember(self, **values: Any) -> None:
        """Keep what the tab shows: saved, but no step of undo."""
        self.session.remember(self.title, **values)

    def keep_figures(self, id: str, of: Any, values: Mapping[str, float]) -> None:
        """Keep what is shown of a member, made of this, for the check of the script."""
        self.session.remember("figures", **{id: {"of": of, "values": values}})

    def build(self) -> None:
        """Make the tab's elements; :meth:`update` with all ``parts`` fills them."""

    def update(self, changed: frozenset[str]) -> None:
        """Show what has changed; only called after :meth:`build`."""

    def close(self) -> None:
        """The browser is gone."""

    @contextmanager
    def rows(self, *forms: Form) -> Iterator[list[list[Row]]]:
        """Rows to be filled in for each form: shown at the end, also where that is an error."""
        found: list[list[Row]] = [[] for _ in forms]
        try:
            yield found
        finally:
            for form, own in zip(forms, found, strict=True):
                form.show(own)

    def without_muscle(self, what: str) -> list[Row]:
        """Rows that say that a motion, a controller needs one."""
        return [
            words(f"{what} needs a muscle: choose or fit one in the tab Muscle."),
            buttons({"To the tab Muscle": partial(self.bench.open, "Muscle")}),
        ]


class Members(Tab):
    """A tab of a list of the session's, ``part``, one member of which is at hand."""

    part: str = ""

    @property
    def at_hand(self) -> dict[str, Any] | None:
        """The chosen member, else the last one."""
        members = self.state[self.part]
        chosen = self.session.item(self.part, self.view("chosen"))
        return chosen or (members[-1] if members else None)

    @property
    def held(self) -> dict[str, Any]:
        """The same for an event, which raises InputError where it is gone."""
        if self.at_hand is None:
            raise InputError(f"none of the {self.part} is left")
        return self.at_hand

    @property
    def names(self) -> dict[str, str]:
        """{id: name}"""
        return {m["id"]: m["name"] for m in self.state[self.part]}

    def choose(self, id: str) -> None:
        """Another one at hand."""
        self.remember(chosen=id)
        self.update(frozenset((self.part,)))

    def change(self, label: str, **values: Any) -> None:
        """One step of undo of the one at hand."""
        self.session.put(label, self.part, {**self.held, **values})

    def change_in(self, label: str, *path: Any) -> None:
        """The same of one value within it: ``change_in("stop 1", "stops", 0, "at", 0.01)``."""
        *places, key, value = path
        changed = inner = copy.deepcopy(self.held)
        for place in places:
            inner = inner[place]
        inner[key] = value
        self.session.put(label, self.part, changed)

    def rename(self, name: str) -> None:
        """Of the one at hand."""
        self.change("rename", name=name[:60])

    def add(self, made: dict[str, Any], label: str = "add") -> None:
        """A new one, at hand at once."""
        self.remember(chosen=made["id"])
        self.session.put(f"{label} {made['name']}", self.part, made)

    def drop(self) -> None:
        """The one at hand."""
        self.session.drop(f"delete {self.held['name']}", self.part, self.held["id"])
