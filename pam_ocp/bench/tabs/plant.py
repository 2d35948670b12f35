"""The tab Plant."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["PlantTab"]


class PlantTab(Tab):
    """Not built yet."""

    title = "Plant"

    def build(self) -> None:
        ui.label("Not built yet.")
