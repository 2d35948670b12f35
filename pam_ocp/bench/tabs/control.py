"""The tab Control."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["Control"]


class Control(Tab):
    """Not built yet."""

    title = "Control"

    def build(self) -> None:
        ui.label("Not built yet.")
