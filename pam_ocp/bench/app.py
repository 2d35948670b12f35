"""The page as a web application: routes, sessions by their address, and the wall around it."""

from __future__ import annotations

import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.responses import RedirectResponse
from nicegui import app as nicegui_app
from nicegui import ui

from ..core.errors import InputError, PamError
from .frame import Bench
from .guard import Guard
from .jobs import prepare
from .rig_room import RigRoom
from .session import Session, safe_name, saved_sessions
from .work import JobStopped, Workshop

KEPT = 600.0
"""Seconds that a session without a browser stays open, with its work."""
MOST_SHOWN = 12
"""Sessions on the first page."""
STATIC = Path(__file__).with_name("static")
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
    logging.getLogger("nicegui").addFilter(_is_fault)
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


def _is_fault(record: logging.LogRecord) -> bool:
    return not isinstance(record.msg, PamError | JobStopped)


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
