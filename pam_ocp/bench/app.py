"""The page as a web application: routes, sessions by their address, the wall around it; and the
frame around the tabs: header with undo and redo, messages, footer with the work.
"""

from __future__ import annotations

import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.responses import RedirectResponse
from nicegui import app as nicegui_app
from nicegui import ui
from nicegui.events import KeyEventArguments

from ..core.errors import InputError, PamError
from .elements import STATIC, tag
from .guard import Guard
from .jobs import prepare
from .rig_room import RigRoom
from .session import Session, safe_name, saved_sessions
from .tab import Page, Tab
from .tabs.control import Control
from .tabs.data import Data
from .tabs.export import Export
from .tabs.motion import Motion
from .tabs.muscle import MuscleTab
from .tabs.plant import PlantTab
from .tabs.rig import RigTab
from .work import Job, JobStopped, Workshop

KEPT = 600.0
"""Seconds that a session without a browser stays open, with its work."""
MOST_SHOWN = 12
"""Sessions on the first page."""
HEAD = '<link rel="stylesheet" href="/bench/bench.css"><script src="/bench/focus.js"></script>'


@dataclass
class _Open:
    session: Session
    benches: set[Bench] = field(default_factory=set)
    left: float = 0.0


class _Sessions:
    """Sessions that are open here, by id."""

    def __init__(self, root: Path, shop: Workshop) -> None:
        self.root, self.shop = root, shop
        self.open: dict[str, _Open] = {}

    def new(self) -> Session:
        session = Session.new(self.root)
        self.open[session.id] = _Open(session, left=time.monotonic())
        return session

    def get(self, id: str) -> _Open:
        if id not in self.open:
            if id != safe_name(id) or not (self.root / id / "session.json").is_file():
                raise InputError(f"there is no session {id!r}")
            self.open[id] = _Open(Session(self.root / id), left=time.monotonic())
        return self.open[id]

    def forget(self) -> None:
        """Close what nobody looks at any more."""
        for id, one in [*self.open.items()]:
            if not one.benches and time.monotonic() - one.left > KEPT:
                self.close(id)

    def close(self, id: str) -> None:
        self.shop.stop_all(id)
        self.open.pop(id).session.close()


def application(
    root: Path, *, allow_code: bool = False, room: RigRoom | None = None, **guard: Any
) -> Guard:
    """The ASGI application; one in a process, for the framework has one of each.

    root : folder of the sessions. room : the rig, if there is one. guard : arguments of
    :class:`Guard`.
    """
    shop = Workshop(prepare=prepare)
    sessions = _Sessions(root, shop)

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        shop.warm_up()
        yield
        shop.close()
        if room is not None:
            room.close()
        for id in [*sessions.open]:
            sessions.close(id)

    outer = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=life)
    nicegui_app.add_static_files("/bench", STATIC)

    @ui.page("/", title="pam_ocp bench")
    def start() -> RedirectResponse | None:
        known = saved_sessions(root)
        if not known:
            return RedirectResponse("/new", 303)
        _start_page(known)
        return None

    @ui.page("/new")
    def new() -> RedirectResponse:
        return RedirectResponse(f"/s/{sessions.new().id}", 303)

    @ui.page("/s/{id}", title="pam_ocp bench")
    def page(id: str) -> RedirectResponse | None:
        ui.add_head_html(HEAD)
        try:
            one = sessions.get(id)
        except InputError as error:
            ui.label(str(error)).props("role=alert")
            ui.link("All sessions", "/")
            return None
        bench = Bench(one.session, shop, allow_code=allow_code, room=room)
        one.benches.add(bench)

        def gone() -> None:
            bench.close()
            one.benches.discard(bench)
            one.left = time.monotonic()

        bench.client.on_delete(gone)
        bench.build()
        return None

    # what is raised on purpose stands on the page; the log is for faults
    logging.getLogger("nicegui").addFilter(
        lambda record: not isinstance(record.msg, PamError | JobStopped)
    )
    nicegui_app.timer(60.0, sessions.forget)
    ui.run_with(
        outer,
        title="pam_ocp bench",
        language="en-US",
        dark=None,
        # a browser that is busy for some seconds must not be taken for gone: what is clicked while
        # it connects again would be lost (pings are awaited for 0.4 of this)
        reconnect_timeout=60.0,
        message_history_length=100,  # of each browser: curves that follow a slider fill it
        tailwind=False,
        binding_refresh_interval=None,
        show_welcome_message=False,
        favicon=STATIC / "bench.svg",
    )
    return Guard(outer, framed=None if room is None else room.vent_port, **guard)


def _start_page(known: list[tuple[str, float]]) -> None:
    ui.add_head_html(HEAD)
    with ui.element("div").classes("bench-start"):
        ui.html("<h1>pam_ocp bench</h1>", sanitize=False)
        ui.button("New session", on_click=lambda: ui.navigate.to("/new")).props("no-caps")
        ui.html("<h2>Resume</h2>", sanitize=False)
        with ui.element("ul"):
            for id, changed in known[:MOST_SHOWN]:
                with ui.element("li"):
                    when = time.strftime("%d %b %Y, %H:%M", time.localtime(changed))
                    ui.link(f"{id}, last changed {when}", f"/s/{id}")


# ---- the frame -----------------------------------------------------------------------------------
TABS: tuple[type[Tab], ...] = (Data, MuscleTab, PlantTab, Motion, Control, Export)


class Bench(Page):
    """The page in one browser: its session, its work and its tabs."""

    def __init__(
        self, session: Session, shop: Workshop, *, allow_code: bool, room: RigRoom | None = None
    ) -> None:
        super().__init__(session, shop, allow_code=allow_code, room=room)
        self.tabs = [kind(self) for kind in (TABS if room is None else (*TABS, RigTab))]
        self._built: set[str] = set()
        self._jobs: dict[Job, _JobLine] = {}
        self._end = session.listen(self._changed)

    # ---- for tabs ------------------------------------------------------------------------------
    def open(self, title: str) -> None:
        """Show a tab."""
        self._tabs.set_value(title)

    def told(self, job: Job) -> None:
        """A line in the footer for a job on its way."""
        with suppress(Exception), self.client:
            line = self._jobs.get(job)
            if line is None and not job.over:
                with self._work:
                    line = self._jobs[job] = _JobLine(job)
            if line is not None:
                line.show()
                if job.over:
                    del self._jobs[job]
                    line.remove()

    def message(self, text: str, kind: str) -> None:
        """Show a line below the header."""
        self._message.say(text, kind)

    # ---- the page ------------------------------------------------------------------------------
    def build(self) -> None:
        """Make header, tabs, messages and footer."""
        ui.colors(primary="#0072b2", negative="#b3261e", positive="#00734f", warning="#9a5b00")
        dark = ui.dark_mode(self.session.view("page", "dark"))
        with ui.header().classes("bench-header"):
            tag("h1", "pam_ocp bench", "bench-brand")
            with ui.tabs().props("dense no-caps inline-label").classes("bench-tabs") as tabs:
                for tab in self.tabs:
                    ui.tab(tab.title).props(f"aria-label={tab.title}")
            ui.space()
            self._undo = _icon("undo", "Undo", self.session.undo)
            self._redo = _icon("redo", "Redo", self.session.redo)

            def turn() -> None:
                dark.value = {None: True, True: False, False: None}[dark.value]
                self.session.remember("page", dark=dark.value)
                words = {None: "as the system", True: "dark", False: "light"}[dark.value]
                self.say(f"Colours: {words}")

            _icon("contrast", "Light, dark, or as the system", turn)
            with _icon("folder_open", "Sessions"), ui.menu():
                ui.menu_item("New session", lambda: ui.navigate.to("/new"))
                ui.menu_item("All sessions", lambda: ui.navigate.to("/"))
        self._message = _Message()
        first = self.session.view("page", "open", self.tabs[0].title)
        if first not in [tab.title for tab in self.tabs]:
            first = self.tabs[0].title
        self._bodies = {}
        with ui.element("div").classes("bench-panels"):  # the framework's page is the main part
            for tab in self.tabs:
                body = ui.element("div").classes("bench-main").props("role=tabpanel")
                body._props["aria-label"] = tab.title
                self._bodies[tab.title] = body
        with ui.footer().classes("bench-footer"):
            self._status = ui.label().classes("bench-status")
            self._work = ui.row().classes("bench-work")
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
        self._tabs = tabs
        tabs.on_value_change(self._opened)
        tabs.set_value(first)
        self._show_panel(first)
        self._show_state()

    def close(self) -> None:
        """The browser is gone."""
        self._end()
        for tab in self.tabs:
            tab.close()

    def _opened(self, event: Any) -> None:
        if event.value in self._bodies:
            self.session.remember("page", open=event.value)
            self._show_panel(event.value)

    def _show_panel(self, title: str) -> None:
        # hidden ones keep their width (bench.css): pictures in them need not be laid out anew
        for name, body in self._bodies.items():
            body.classes(**{"remove" if name == title else "add": "is-hidden"})
        self._build(title)

    def _build(self, title: str) -> None:
        if title in self._built:
            return
        self._built.add(title)
        tab = next(t for t in self.tabs if t.title == title)
        with self._bodies[title], self.shown_errors():
            tab.build()
            tab.update(frozenset(tab.parts))

    def _changed(self, changed: frozenset[str]) -> None:
        with self.client:
            self._show_state()
            for tab in self.tabs:
                if tab.title in self._built and changed & set(tab.parts):
                    with self.shown_errors():
                        tab.update(changed)

    def _show_state(self) -> None:
        for button, word, what in (
            (self._undo, "Undo", self.session.undo_label),
            (self._redo, "Redo", self.session.redo_label),
        ):
            button.set_enabled(what is not None)
            button.props(f'aria-label="{word}: {_quoted(what)}"' if what else f"aria-label={word}")
        self._status.set_text(f"session {self.session.id}, saved")

    def _key(self, event: KeyEventArguments) -> None:
        if not event.action.keydown or not (event.modifiers.ctrl or event.modifiers.meta):
            return
        name = str(event.key).lower()
        if name == "y" or (name == "z" and event.modifiers.shift):
            self.session.redo()
        elif name == "z":
            self.session.undo()


class _Message:
    """The line below the header."""

    def __init__(self) -> None:
        with ui.row().classes("bench-message") as self._row:
            self._text = ui.label().props("role=alert aria-live=assertive")
            ui.space()
            ui.button(icon="close", on_click=self._hide).props("flat dense round size=sm").props(
                'aria-label="Close this message"'
            )
        self._hide()

    def _hide(self) -> None:
        self._row.set_visibility(False)

    def say(self, text: str, kind: str) -> None:
        self._text.set_text(text)
        self._row.classes(remove="is-error is-info", add=f"is-{kind}")
        self._row.set_visibility(True)
        if kind != "error":

            def done() -> None:
                if self._text.text == text:
                    self._hide()

            ui.timer(6.0, done, once=True)


class _JobLine:
    """What a job does, and the button that stops it."""

    def __init__(self, job: Job) -> None:
        self._job = job
        with ui.row().classes("bench-job") as self._row:
            self._bar = ui.linear_progress(show_value=False, size="6px").classes("bench-bar")
            self._bar.props(f'aria-label="{_quoted(job.title)}"')
            self._text = ui.label(job.title)
            ui.button(icon="stop", on_click=lambda: job.stop()).props(
                f'flat dense size=sm color=negative aria-label="Stop {_quoted(job.title)}"'
            )

    def show(self) -> None:
        job = self._job
        self._bar.props(remove="indeterminate")
        if job.fraction is None:
            self._bar.props("indeterminate")
        else:
            self._bar.set_value(job.fraction)
        words = f", {job.said}" if job.said else ""
        self._text.set_text(f"{job.title}: {job.state}{words}")

    def remove(self) -> None:
        self._row.delete()


def _icon(name: str, label: str, act: Callable[[], Any] | None = None) -> ui.button:
    button = ui.button(icon=name, on_click=act).props(f'flat dense round aria-label="{label}"')
    with button:
        ui.tooltip(label)
    return button


def _quoted(text: str | None) -> str:
    """Within the double quotes of a property."""
    return (text or "").replace("\\", "/").replace('"', "'")
