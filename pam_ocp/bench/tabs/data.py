"""The tab Data."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["Data"]


class Data(Tab):
    """Not built yet."""

    title = "Data"

    def build(self) -> None:
        ui.label("Not built yet.")
