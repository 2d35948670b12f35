"""A plant of the user's own for the tab Plant: where the start of the page allows code."""

from __future__ import annotations

from collections.abc import Callable

from nicegui import events

from ...core.errors import InputError
from .. import elements as el
from ..made import own_plants
from ..tab import Page

__all__ = ["own_plant_upload"]

MOST_FILE = 2**20


def own_plant_upload(bench: Page, choose: Callable[[str], None]) -> None:
    """An upload for a Python file that makes plants; a single one in it is chosen at once.

    choose : is called with FILE.py:NAME. The menu of arrangements offers all of them.
    """

    async def dropped(event: events.UploadEventArguments) -> None:
        with bench.shown_errors():
            before = own_plants(bench.folder)
            file = bench.session.store(event.file.name, await event.file.read())
            made = [name for name in own_plants(bench.folder) if name.startswith(f"{file}:")]
            if not made:
                raise InputError(
                    f"{event.file.name} names no plant: at its top, define a Plant or a function "
                    "that takes a muscle and returns one"
                )
            choose(next((name for name in made if name not in before), made[0]))

    el.upload(
        "A plant of your own (.py)",
        dropped,
        lambda: bench.say(f"the file was refused: a .py up to {MOST_FILE / 2**20:g} MiB", "error"),
        max_file_size=MOST_FILE,
        accept=".py",
    )
