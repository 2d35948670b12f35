"""Parts that tabs are made of: sections, fields with units, sliders, tables, plots.

All are plain HTML with labels, so that keyboards and screen readers know them; bench.css aligns
them. Values go in and out in SI; a field shows them in the unit that its menu says. Texts of files
and users go in as text only, never as HTML.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement

from ..core.errors import InputError, PamError
from ..core.quantities import quantity
from ..core.units import display_unit
from ..core.units import unit as unit_of
from . import look

__all__ = [
    "Field",
    "Plot",
    "Scene",
    "Slider",
    "button",
    "check",
    "choice",
    "note",
    "plots",
    "section",
    "side",
    "split",
    "table",
    "tag",
    "text_field",
    "units_like",
    "upload",
]

UNITS: tuple[tuple[str, ...], ...] = (
    ("bar", "kPa", "MPa", "psi", "Pa"),
    ("mm", "cm", "m", "in"),
    ("deg", "rad"),
    ("ms", "s"),
    ("g", "kg"),
    ("N", "kN", "lbf"),
    ("N/mm", "N/m"),
    ("mm/s", "m/s"),
    ("%", "1"),
    ("l", "m3"),
    ("bar/s", "Pa/s"),
    ("deg/s", "rad/s"),
    ("bar/mm", "Pa/m"),
)
"""Of each quantity, what people use."""
_ids = itertools.count()


def tag(name: str, text: str = "", classes: str = "", **attributes: Any) -> TextElement:
    """A plain HTML element with a text; attributes by name ("aria_label" is "aria-label")."""
    made = TextElement(tag=name, text=text)
    made.classes(classes)
    for key, value in attributes.items():
        if value is not None and value is not False:
            made._props[key.rstrip("_").replace("_", "-")] = value
    return made


@contextmanager
def split() -> Iterator[None]:
    """Controls (:func:`side`) at the left, pictures (:func:`plots`) at the right."""
    with ui.element("div").classes("bench-split"):
        yield


@contextmanager
def side() -> Iterator[None]:
    """The left part of a :func:`split`: sections below each other."""
    with ui.element("div").classes("bench-side"):
        yield


@contextmanager
def plots() -> Iterator[None]:
    """The right part of a :func:`split`: sections in two columns."""
    with ui.element("div").classes("bench-plots"):
        yield


@contextmanager
def section(title: str, small: str = "", *, wide: bool = False) -> Iterator[TextElement]:
    """A framed part with a heading; yields its small words, to be set."""
    name = f"section-{next(_ids)}"
    with ui.element("section").classes("bench-section" + (" is-wide" if wide else "")) as made:
        made._props["aria-labelledby"] = name
        with tag("h2", id=name):
            tag("span", title)
            words = tag("small", small)
        yield words


def note(text: str = "", classes: str = "bench-note") -> TextElement:
    """Small words."""
    return tag("p", text, classes, style="margin: 2px 0")


def button(
    text: str, act: Callable[..., Any], *, main: bool = False, **attributes: Any
) -> ui.button:
    """A button; ``main`` for the one that is usually pressed."""
    style = "unelevated" if main else "outline"
    made = ui.button(text, on_click=act).props(f"{style} dense no-caps padding='2px 10px'")
    for key, value in attributes.items():
        made._props[key.replace("_", "-")] = value
    return made


def units_like(unit: str) -> list[str]:
    """Units that measure the same as an SI unit, the usual one first."""
    if not unit:
        return []
    own = unit_of(unit)
    for group in UNITS:
        if unit_of(group[0]).compatible(own):
            usual = display_unit(unit)
            rest = [u for u in group if u != usual]
            return [usual, *rest] if usual != "1" else list(group)
    return [unit]


class Field:
    """Label, number and unit on one line.

    value : in SI, or None (empty: "not given"). unit : in SI. act : called with the new value in
    SI; what it raises stays with it. low, high : allowed, in SI. shown : unit at first, by default
    the usual one. chosen : is told the unit that the menu is set to.
    """

    def __init__(
        self,
        label: str,
        value: float | None,
        unit: str,
        act: Callable[[Any], Any],
        *,
        low: float = -math.inf,
        high: float = math.inf,
        optional: bool = False,
        shown: str | None = None,
        chosen: Callable[[str], Any] | None = None,
        hint: str = "",
    ) -> None:
        self.value, self.unit = value, unit
        self._act, self._low, self._high = act, low, high
        self._optional, self._label, self._chosen = optional, label, chosen
        units = units_like(unit)
        self.shown = shown if shown in units else units[0]
        name = f"field-{next(_ids)}"
        with ui.element("div").classes("bench-field") as self.element:
            tag("label", label, for_=name, title=hint or label)
            self._input = tag(
                "input", id=name, type="text", inputmode="decimal", autocomplete="off"
            )
            self._input.on("change", self._typed, js_handler="(e) => emit(e.target.value)")
            if len(units) > 1:
                with tag("select", aria_label=f"unit of {label}") as menu:
                    for one in units:
                        tag(
                            "option",
                            one,
                            value=one,
                            selected=one == self.shown,
                        )
                menu.on("change", self._turned, js_handler="(e) => emit(e.target.value)")
            else:
                tag("span", "" if self.shown == "1" else self.shown, "bench-unit")
        self._show()

    def set(self, value: float | None) -> None:
        """Show another value."""
        self.value = value
        self._show()

    def _show(self, wrong: bool = False) -> None:
        if not wrong:
            factor = unit_of(self.shown).factor
            text = "" if self.value is None else f"{self.value / factor:.8g}"
            self._input._props["value"] = text
        self._input._props["aria-invalid"] = "true" if wrong else "false"
        self._input.update()

    def _typed(self, event: Any) -> Any:
        text = str(event.args).strip().replace(",", ".")
        try:
            if not text and self._optional:
                value = None
            else:
                try:
                    value = float(text) * unit_of(self.shown).factor
                except ValueError:
                    value = quantity(self._label, text, self.unit)
                if not (math.isfinite(value) and self._low <= value <= self._high):
                    raise InputError(self._range(value))
        except PamError as error:
            self._input._props["value"] = str(event.args)
            self._input._props["title"] = str(error)
            self._show(wrong=True)
            return None
        self._input._props.pop("title", None)
        self.value = value
        self._show()
        return self._act(value)

    def _range(self, value: float) -> str:
        factor = unit_of(self.shown).factor
        low, high = (f"{end / factor:.6g} {self.shown}" for end in (self._low, self._high))
        return f"{self._label} = {value / factor:.6g} {self.shown}: give {low} .. {high}"

    def _turned(self, event: Any) -> None:
        if event.args in units_like(self.unit):
            self.shown = event.args
            self._show()
            if self._chosen is not None:
                self._chosen(self.shown)


def text_field(label: str, value: str, act: Callable[[str], Any], hint: str = "") -> TextElement:
    """Label and text on one line."""
    name = f"field-{next(_ids)}"
    with ui.element("div").classes("bench-field is-wide"):
        tag("label", label, for_=name, title=hint or label)
        made = tag("input", id=name, type="text", value=value, autocomplete="off")
        made.props("style='text-align:left'")
        made.on("change", lambda e: act(str(e.args)), js_handler="(e) => emit(e.target.value)")
    return made


def choice(
    label: str,
    options: Sequence[str] | Mapping[str, str],
    value: str | None,
    act: Callable[[str], Any],
    hint: str = "",
) -> TextElement:
    """Label and menu on one line. options : values, or {value: its words}."""
    words = options if isinstance(options, Mapping) else {one: one for one in options}
    name = f"field-{next(_ids)}"
    with ui.element("div").classes("bench-field is-wide"):
        tag("label", label, for_=name, title=hint or label)
        with tag("select", id=name) as made:
            for one, text in words.items():
                tag("option", text, value=one, selected=one == value)

    def chosen(event: Any) -> Any:
        return act(str(event.args)) if event.args in words else None

    made.on("change", chosen, js_handler="(e) => emit(e.target.value)")
    return made


def check(label: str, value: bool, act: Callable[[bool], Any], hint: str = "") -> TextElement:
    """Label and tick on one line."""
    name = f"field-{next(_ids)}"
    with ui.element("div").classes("bench-field is-wide"):
        tag("label", label, for_=name, title=hint or label)
        made = tag("input", id=name, type="checkbox", checked=value)
        made.on("change", lambda e: act(bool(e.args)), js_handler="(e) => emit(e.target.checked)")
    return made


class Slider(Element, component=Path(__file__).with_name("static") / "slider.js"):
    """A coefficient on a slider and in a number, in its own unit.

    slide : called with each value while it moves, and must be quick; settle : when it is let go.
    log : even in the logarithm; its lower end is 0, then.
    """

    def __init__(
        self,
        label: str,
        value: float,
        low: float,
        high: float,
        unit: str,
        slide: Callable[[float], Any],
        settle: Callable[[float], Any],
        *,
        log: bool = False,
    ) -> None:
        super().__init__()
        self._props.update(label=label, value=value, low=low, high=high, unit=unit, seen=0, log=log)

        def moved(event: Any) -> None:
            slide(float(event.args))
            self._props["seen"] += 1  # the next may come
            self.update()

        self.on("slide", moved)
        self.on("settle", lambda event: settle(float(event.args)))

    def set(self, value: float) -> None:
        """Show another value."""
        self._props["value"] = value
        self.update()


class Scene(Element, component=Path(__file__).with_name("static") / "scene.js"):
    """A plant drawn to scale and moving. scene : of figures.scene.scene_of, or None for nothing.

    label : for who cannot see it. words, unit : of what its slider moves along ("time", "s").
    seconds : that playing it takes. A scene's ``still`` is the moment that is shown first.
    pull : called with {"x", "y"} [pixels, right and up] while a pointer pulls it.
    """

    def __init__(
        self,
        label: str,
        scene: Mapping[str, Any] | None = None,
        *,
        height: int = 300,
        words: str = "time",
        unit: str = "s",
        seconds: float = 4.0,
        pull: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__()
        self._props.update(label=label, height=height, words=words, unit=unit, seconds=seconds)
        self._props.update(scene=scene, held=pull is not None)
        if pull is not None:
            self.on("pull", lambda e: pull(e.args) if isinstance(e.args, dict) else None)

    def show(self, scene: Mapping[str, Any] | None, **said: Any) -> None:
        """Another scene; further arguments as at first."""
        self._props.update(said)
        self._props["scene"] = scene
        self.update()


def table(
    heads: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    act: Callable[[int], Any] | None = None,
    chosen: int | None = None,
    label: str = "",
) -> Element:
    """A table; numbers stand right, already as text or to four digits. act : of a row's button."""
    with tag("table", "", "bench-table", aria_label=label or None) as made:
        with tag("thead"), tag("tr"):
            for j, head in enumerate(heads):
                number = bool(rows) and isinstance(rows[0][j], int | float)
                tag("th", head, "is-number" if number else "", scope="col")
        with tag("tbody"):
            for i, row in enumerate(rows):
                kind = ("is-choice " if act else "") + ("is-chosen" if i == chosen else "")
                with tag("tr", "", kind) as line:
                    for j, cell in enumerate(row):
                        _cell(cell, act and j == 0)
                if act is not None:
                    line.on("click", lambda _, i=i: act(i))
    return made


def _cell(cell: Any, pressed: Any) -> None:
    number = isinstance(cell, int | float)
    if isinstance(cell, float):
        cell = "" if math.isnan(cell) else f"{cell:.4g}"
    if pressed:  # the row's own click does the work: a button is what a keyboard reaches
        with tag("td"):
            tag("button", str(cell), type="button")
    else:
        tag("td", str(cell), "is-number" if number else "")


class Plot:
    """A picture (look.figure), named ``label``; a sentence says to the blind what it shows.

    on_click : with the point that is clicked. empty : what will be there, where there is nothing.
    """

    def __init__(
        self,
        figure: dict[str, Any],
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
        self.draw(figure)
        if on_click is not None:
            self.element.on("plotly_click", lambda e: self._clicked(e, on_click), js_handler=_PICK)

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


def upload(
    label: str,
    act: Callable[[Any], Any],
    refused: Callable[[], Any],
    *,
    accept: str = "",
    **more: Any,
) -> None:
    """A place to drop files, or to choose them; what became of a file ``act`` and ``refused`` say.

    The framework's own list, whose ticks tell that a file has arrived, not that it was understood,
    is not shown, and its button, an input within a link, is none to a keyboard.
    accept : endings, as ".toml,.json".
    """

    async def arrived(event: Any) -> None:
        try:
            await act(event)
        finally:
            made.run_method("removeUploadedFiles")

    made = ui.upload(auto_upload=True, on_upload=arrived, on_rejected=refused, **more)
    made.props("flat bordered" + (f" accept='{accept}'" if accept else ""))
    made.add_slot("header", _UPLOAD.replace("LABEL", label))
    made.add_slot("list", "<span></span>")


_UPLOAD = """<div class="bench-row">
  <button type="button" class="bench-play" aria-label="LABEL" @click="props.pickFiles">+</button>
  <span>LABEL</span><q-spinner v-if="props.isUploading" />
  <span style="display: none"><q-uploader-add-trigger /></span></div>"""
