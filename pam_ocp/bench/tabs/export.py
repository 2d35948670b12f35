"""The tab Export."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["Export"]


class Export(Tab):
    """Not built yet."""

    title = "Export"

    def build(self) -> None:
        ui.label("Not built yet.")
