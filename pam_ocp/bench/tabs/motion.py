"""The tab Motion."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["Motion"]


class Motion(Tab):
    """Not built yet."""

    title = "Motion"

    def build(self) -> None:
        ui.label("Not built yet.")
