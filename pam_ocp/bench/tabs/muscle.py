"""The tab Muscle."""

from __future__ import annotations

from nicegui import ui

from ..tab import Tab

__all__ = ["MuscleTab"]


class MuscleTab(Tab):
    """Not built yet."""

    title = "Muscle"

    def build(self) -> None:
        ui.label("Not built yet.")
