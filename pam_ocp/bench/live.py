"""Elements that are held by hand: stops on a stroke, and what runs live (static/*.js)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from nicegui.element import Element

__all__ = ["Stops", "Strip"]

STATIC = Path(__file__).with_name("static")


class Stops(Element, component=STATIC / "stops.js"):
    """Stops and the motion between them.

    slide : called with {"stop", "at", "leg"} (leg: seconds that the leg before it takes, or None)
        while a stop moves; call :meth:`shown` when its plan is there. settle : when it is let go.
    add, remove : with {"at", "t"} and {"stop"}.
    """

    def __init__(
        self,
        slide: Callable[[dict[str, Any]], Any],
        settle: Callable[[dict[str, Any]], Any],
        add: Callable[[dict[str, Any]], Any],
        remove: Callable[[dict[str, Any]], Any],
    ) -> None:
        super().__init__()
        self._props.update(stops=[], factor=1.0, low=0.0, high=1.0, seen=0, others=[])
        for name, act in (("slide", slide), ("settle", settle), ("add", add), ("remove", remove)):
            self.on(name, lambda e, act=act: act(e.args) if isinstance(e.args, dict) else None)

    def show(self, **props: Any) -> None:
        """Show other stops, curves, bounds (names of stops.js)."""
        self._props.update(props)
        self.update()

    def shown(self, **props: Any) -> None:
        """As :meth:`show`, and the next position of the hand may come."""
        self._props["seen"] += 1
        self.show(**props)


class Strip(Element, component=STATIC / "strip.js"):
    """The last seconds of a run. reference : called with what is to be reached, as shown."""

    def __init__(self, label: str, reference: Callable[[float], Any]) -> None:
        super().__init__()
        self._props.update(label=label, low=0.0, high=1.0, reference=0.0, inputs=[])
        self.on("reference", lambda e: reference(float(e.args)))

    def show(self, **props: Any) -> None:
        """Names of strip.js."""
        self._props.update(props)
        self.update()

    def add(self, chunk: Mapping[str, Any]) -> None:
        """What has happened since: {"t": [...], "rows": {name: [...]}, "restart": bool}."""
        self.run_method("add", chunk)
