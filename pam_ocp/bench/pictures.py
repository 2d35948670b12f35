"""Pictures in the page: plots, the plant to scale, stops on a stroke, and what runs live.

Those that are held by hand are components of their own (static/*.js).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nicegui import ui

from . import look
from .elements import STATIC, Component, tag

_ids = itertools.count()


class Plot:
    """A picture (look.figure), named ``label``; a sentence says to the blind what it shows.

    on_click : with the point that is clicked. empty : what will be there, where there is nothing.
    """

    def __init__(
        self,
        label: str,
        on_click: Callable[[dict[str, Any]], Any] | None = None,
        *,
        empty: str,
    ) -> None:
        name = f"plot-{next(_ids)}"
        self.element = ui.plotly({})
        self._empty = empty
        # no "img": that would hide the picture's own buttons from a screen reader
        self.element._props.update({"role": "figure", "aria-label": label})
        self.element._props["aria-describedby"] = name
        self._words = tag("p", "", "bench-unseen", id=name)
        self.clear()
        if on_click is not None:
            self.element.on("plotly_click", lambda e: self._clicked(e, on_click), js_handler=_PICK)

    def clear(self) -> None:
        """Show that there is nothing yet."""
        self.draw(look.figure([]))

    @staticmethod
    def _clicked(event: Any, act: Callable[[dict[str, Any]], Any]) -> Any:
        return act(event.args) if isinstance(event.args, dict) and event.args else None

    def draw(self, figure: dict[str, Any], label: str = "") -> None:
        """Show another figure; zoom stays while ``keep`` of it does. label : another name."""
        self._words.set_text(look.described(figure) if figure["data"] else self._empty)
        if label:
            self.element._props["aria-label"] = label
        self.element.update_figure(figure if figure["data"] else look.blank(figure, self._empty))

    def curves(self, traces: Sequence[int], **values: Sequence[Any]) -> None:
        """New values of some lines or markers: ``curves([3, 4], y=[..., ...])``. Quick: axes stay
        as they are, and nothing else is drawn anew (a quarter of the time of ``restyle``).
        """
        figure: Any = self.element.figure
        for name, each in values.items():
            for i, one in zip(traces, each, strict=True):
                figure["data"][i][name] = one
        fresh = [
            dict(zip(values, each, strict=True)) for each in zip(*values.values(), strict=True)
        ]
        frame = {"data": fresh, "traces": list(traces)}
        self.element.run_plot_method("animate", frame, _AT_ONCE)


_AT_ONCE = {
    "mode": "immediate",
    "transition": {"duration": 0},
    "frame": {"duration": 0, "redraw": False},
}
_PICK = """(e) => { const p = e.points && e.points[0];
  if (p) emit({curve: p.curveNumber, point: p.pointNumber ?? p.pointIndex, x: p.x, y: p.y, z: p.z,
    data: p.customdata}); }"""


class Scene(Component, component=STATIC / "scene.js"):
    """A plant drawn to scale and moving. ``set(scene=...)`` : of figures.film.scene_of, or None
    for nothing.

    label : for who cannot see it. words, unit : of what its slider moves along ("time", "s").
    seconds : that playing it takes. A scene's ``still`` is the moment that is shown first.
    pull : called with {"x", "y"} [pixels, right and up] while a pointer pulls it.
    """

    def __init__(
        self,
        label: str,
        *,
        height: int = 300,
        words: str = "time",
        unit: str = "s",
        seconds: float = 4.0,
        pull: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__()
        self._props.update(label=label, height=height, words=words, unit=unit, seconds=seconds)
        self._props.update(scene=None, held=pull is not None)
        if pull is not None:
            self.on("pull", lambda e: pull(e.args) if isinstance(e.args, dict) else None)


class Stops(Component, component=STATIC / "stops.js"):
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

    def shown(self) -> None:
        """The next position of the hand may come."""
        self.set(seen=self._props["seen"] + 1)


class Strip(Component, component=STATIC / "strip.js"):
    """The last seconds of a run. reference : called with what is to be reached, as shown."""

    def __init__(self, label: str, reference: Callable[[float], Any]) -> None:
        super().__init__()
        self._props.update(label=label, low=0.0, high=1.0, reference=0.0, inputs=[])
        self.on("reference", lambda e: reference(float(e.args)))

    def add(self, chunk: Mapping[str, Any]) -> None:
        """What has happened since: {"t": [...], "rows": {name: [...]}, "restart": bool}."""
        self.run_method("add", chunk)
