"""Parts that tabs are made of: sections, forms of fields with units and sliders, tables, uploads.

All are plain HTML with labels, so that keyboards and screen readers know them; bench.css aligns
them. A form is a list of rows (description of a field, value, what another value does): values go
in and out in SI, a field shows them in the unit that its menu says. Texts of files and users go in
as text only, never as HTML.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement

from ..core.errors import InputError, PamError
from ..core.quantities import quantity
from ..core.units import display_unit
from ..core.units import unit as unit_of

STATIC = Path(__file__).with_name("static")
Row = tuple[Any, Any, Any]
"""Description, value, what another value does."""
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
TYPED = str.maketrans(",\u2212", ".-")
"""Decimal commas and the typesetter's minus, as people type or paste them."""
_ids = itertools.count()


def tag(name: str, text: str = "", classes: str = "", **attributes: Any) -> TextElement:
    """A plain HTML element with a text; attributes by name ("aria_label" is "aria-label")."""
    made = TextElement(tag=name, text=text)
    made.classes(classes)
    for key, value in attributes.items():
        if value is not None and value is not False:
            made._props[key.rstrip("_").replace("_", "-")] = value
    return made


def split() -> Element:
    """Controls (:func:`side`) at the left, pictures (:func:`plots`) at the right."""
    return ui.element("div").classes("bench-split")


def side() -> Element:
    """The left part of a :func:`split`: sections below each other."""
    return ui.element("div").classes("bench-side")


def plots() -> Element:
    """The right part of a :func:`split`: sections in two columns."""
    return ui.element("div").classes("bench-plots")


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


class Verdict:
    """Words that are read out whenever they change."""

    def __init__(self) -> None:
        self.element = note("", "bench-verdict")
        self.element._props["aria-live"] = "polite"

    def say(self, text: str = "", good: bool | None = None) -> None:
        """Say this, in the colour of what is good or bad."""
        colour = {True: "bench-good", False: "bench-bad", None: ""}[good]
        self.element.set_text(text)
        self.element.classes(remove="bench-good bench-bad", add=colour)


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


# ---- fields --------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Number:
    """A number with a unit; value and range in SI, None is "not given" (``optional``).

    shown : unit at first, by default the usual one.
    """

    label: str
    unit: str = "1"
    low: float = -math.inf
    high: float = math.inf
    optional: bool = False
    shown: str = ""
    hint: str = ""

    kind = "number"

    @property
    def options(self) -> list[str]:
        """Units."""
        return units_like(self.unit)

    def text(self, value: float | None, unit: str) -> str:
        """As it stands in the field."""
        return "" if value is None else f"{value / unit_of(unit).factor:.8g}"

    def read(self, said: Any, unit: str) -> float | None:
        """Of what was typed. Raises InputError."""
        text = str(said).strip().translate(TYPED)
        factor = unit_of(unit).factor
        if not text:
            if self.optional:
                return None
            raise InputError(f"{self.label} is empty; give a number")
        try:
            value = float(text) * factor
        except ValueError:
            value = quantity(self.label, text, self.unit)
        if not math.isfinite(value):
            raise InputError(f"{self.label} = {text}: give a finite number")
        if not self.low <= value <= self.high:
            shown = "" if unit == "1" else f" {unit}"
            low, high = (f"{end / factor:.6g}{shown}" for end in (self.low, self.high))
            raise InputError(f"{self.label} = {value / factor:.6g}{shown}: give {low} .. {high}")
        return value


def parts_of(text: str) -> list[str]:
    """Numbers between commas; between semicolons, where commas are decimal ones."""
    sign = ";" if ";" in text else ","
    return [p.strip().translate(TYPED) for p in text.split(sign) if p.strip()]


@dataclass(frozen=True)
class Text:
    """A text."""

    label: str
    hint: str = ""

    kind = "text"
    options: ClassVar[list[str]] = []

    def text(self, value: Any, unit: str) -> Any:
        """As it stands in the field."""
        return str(value)

    def read(self, said: Any, unit: str) -> Any:
        """What was typed."""
        return str(said)


@dataclass(frozen=True)
class Menu:
    """One of several. words : {value: its words}."""

    label: str
    words: Mapping[str, str]
    hint: str = ""

    kind = "menu"

    @property
    def options(self) -> list[tuple[str, str]]:
        """Values with their words."""
        return [*self.words.items()]

    def text(self, value: str | None, unit: str) -> str:
        """Which one is chosen."""
        return value or ""

    def read(self, said: Any, unit: str) -> str:
        """What was chosen. Raises InputError for what the menu does not hold."""
        if said not in self.words:
            raise InputError(f"{self.label}: {str(said)[:60]!r} is not in the menu")
        return str(said)


class Tick(Text):
    """Yes or no."""

    kind = "tick"

    def text(self, value: Any, unit: str) -> Any:
        """As it stands in the field."""
        return bool(value)

    def read(self, said: Any, unit: str) -> Any:
        """What was said."""
        return bool(said)


class Component(Element):
    """A component of static/, whose properties are named there."""

    def set(self, **props: Any) -> None:
        """Show other values of its properties."""
        if any(self._props.get(name) != value for name, value in props.items()):
            self._props.update(props)
            self.update()


class Field(Component, component=STATIC / "field.js"):
    """A field as it is described, on one line with its label."""

    def __init__(self, described: Number | Text | Menu) -> None:
        super().__init__()
        self._described = described
        options = described.options
        self._unit = getattr(described, "shown", "")
        if isinstance(described, Number) and self._unit not in options:
            self._unit = str(options[0])
        self._props.update(kind=described.kind, label=described.label, hint=described.hint)
        self._props.update(options=options, unit=self._unit, heard=0, wrong="")
        self.on("say", self._heard)
        self.on("unit", self._turned)

    def show(self, value: Any, act: Callable[[Any], Any]) -> None:
        """Show a value; ``act`` is called with another one, what it raises stays with it."""
        self._value, self._act = value, act
        self.set(value=self._described.text(value, self._unit), wrong="")

    def _heard(self, event: Any) -> Any:
        said = event.args["value"]
        self.set(heard=int(event.args["number"]))
        try:
            value = self._described.read(said, self._unit)
        except PamError as error:
            self.set(value=said, wrong=str(error))
            return None
        self.show(value, self._act)
        return self._act(value)

    def _turned(self, event: Any) -> None:
        if event.args in self._described.options and isinstance(self._described, Number):
            self._unit = event.args
            value = self._described.text(self._value, self._unit)
            self.set(unit=self._unit, value=value, wrong="")


@dataclass(frozen=True)
class Slide:
    """A number on a slider, in the unit that is shown. act : (while it moves, when it is let go),
    of which the first must be quick. log : even in the logarithm; its lower end is 0, then.

    of : whose it is; the range stays while that does.
    """

    label: str
    low: float = field(compare=False)
    high: float = field(compare=False)
    unit: str = ""
    log: bool = False
    hint: str = ""
    of: Any = None


class Slider(Component, component=STATIC / "slider.js"):
    """A :class:`Slide` and its number."""

    def __init__(self, said: Slide) -> None:
        super().__init__()
        self._props.update(label=said.label, low=said.low, high=said.high, unit=said.unit)
        self._props.update(log=said.log, seen=0, heard=0, title=said.hint or said.label)

        def moved(event: Any) -> None:
            self._slide(float(event.args))
            self.set(seen=self._props["seen"] + 1)  # the next may come

        def settled(event: Any) -> None:
            try:
                self._settle(float(event.args))
            finally:
                self.set(heard=self._props["heard"] + 1)  # what was not taken is taken back

        self.on("slide", moved)
        self.on("settle", settled)

    def show(
        self, value: float, act: tuple[Callable[[float], Any], Callable[[float], Any]]
    ) -> None:
        """Show a value."""
        self._slide, self._settle = act
        self.set(value=value)


# ---- what stands between fields ------------------------------------------------------------------
@dataclass(frozen=True)
class Words:
    """Small words, or a heading ("h3")."""

    text: str
    classes: str = "bench-note"
    tag: str = "p"


@dataclass(frozen=True)
class Buttons:
    """Buttons beside each other. names : {text: what a screen reader says instead}."""

    texts: tuple[str, ...]
    main: str = ""
    names: Mapping[str, str] = field(default_factory=dict)
    strong: str = ""
    """Before them."""
    hint: str = ""


@dataclass(frozen=True)
class Part:
    """A part of a form; its value is its rows."""

    name: str
    classes: str = "bench-component"


class _Buttons:
    def __init__(self, said: Buttons) -> None:
        with ui.element("div").classes("bench-row").style("margin-top: 6px") as self.element:
            if said.strong:
                tag("strong", said.strong, title=said.hint)
            for text in said.texts:
                name = {"aria_label": said.names[text]} if text in said.names else {}
                button(text, partial(self._press, text), main=text == said.main, **name)

    def _press(self, text: str) -> Any:
        return self._acts[text]()

    def show(self, value: Any, act: Mapping[str, Callable[[], Any]]) -> None:
        self._acts = act


class _Words:
    def __init__(self, said: Words) -> None:
        style = "margin: 2px 0" if said.tag == "p" else None
        self.element = tag(said.tag, said.text, said.classes, style=style)

    def show(self, value: Any, act: Any) -> None:
        """They stay as they are."""


class Form:
    """Fields and what stands between them, below each other, as rows (description, value, act).

    One whose description is still there keeps its place, the cursor in it and what is being typed.
    """

    def __init__(self, classes: str = "") -> None:
        self.element = ui.element("div").classes(classes)
        self._rows: list[tuple[Any, Any]] = []

    def show(self, rows: Iterable[Row], act: Any = None) -> None:
        """Show these rows, and no others."""
        left, fresh = self._rows, []
        for described, value, acts in rows:
            there = next((row for row in left if row[0] == described), None)
            if there is None:
                with self.element:
                    there = described, _DRAWN[type(described)](described)
            else:
                left.remove(there)
            there[1].show(value, acts)
            fresh.append(there)
        self._rows = fresh
        for _, gone in left:
            getattr(gone, "element", gone).delete()
        parts = [getattr(part, "element", part) for _, part in fresh]
        if parts != self.element.default_slot.children:
            self.element.default_slot.children[:] = parts
            self.element.update()


_DRAWN: dict[type, Callable[[Any], Any]] = {
    **dict.fromkeys((Number, Text, Menu, Tick), Field),
    Slide: Slider,
    Words: _Words,
    Buttons: _Buttons,
    Part: lambda said: Form(said.classes),
}


def form(title: str, small: str = "", classes: str = "") -> Form:
    """A section that holds a form alone."""
    with section(title, small):
        return Form(classes)


def box(title: str, *, wide: bool = False) -> Element:
    """A section that holds what is put into it."""
    with section(title, wide=wide):
        return ui.element("div")


def row() -> Element:
    """What stands beside each other."""
    return ui.element("div").classes("bench-row")


def fields(
    described: Mapping[str, Any], values: Mapping[str, Any], act: Callable[[str, Any], Any]
) -> list[Row]:
    """Rows of a table {name: description}; act(name, value)."""
    return [(one, values[name], partial(act, name)) for name, one in described.items()]


def words(text: str, classes: str = "bench-note") -> Row:
    """A row of small words."""
    return Words(text, classes), None, None


def buttons(acts: Mapping[str, Callable[[], Any]], main: str = "", **more: Any) -> Row:
    """A row of buttons {text: what it does}."""
    return Buttons(tuple(acts), main, **more), None, acts


# ---- tables and uploads --------------------------------------------------------------------------
def table(
    heads: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    act: Callable[[int], Any] | None = None,
    chosen: int | None = None,
    label: str = "",
) -> Element:
    """A table; numbers stand right, already as text or to four digits; what can be called draws
    itself. act : of a row's button.
    """
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
    if callable(cell):
        with tag("td"):
            cell()
    elif pressed:  # the row's own click does the work: a button is what a keyboard reaches
        with tag("td"):
            tag("button", str(cell), type="button")
    else:
        tag("td", str(cell), "is-number" if number else "")


def upload(
    label: str,
    act: Callable[[Any], Any],
    say: Callable[[str, str], Any],
    *,
    most: int,
    accept: str = "",
    count: int = 1,
) -> None:
    """A place to drop files, or to choose them; what became of a file ``act`` and ``say`` tell.

    The framework's own list, whose ticks tell that a file has arrived, not that it was understood,
    is not shown, and its button, an input within a link, is none to a keyboard.
    most : bytes of each. accept : endings, as ".toml,.json". count : at once.
    """
    words = [*([" or ".join(accept.split(","))] if accept else []), f"at most {most / 2**20:g} MiB"]
    words += [f"{count} at once"] if count > 1 else []
    refusal = f"a file was refused: {', '.join(words)}"

    async def arrived(event: Any) -> None:
        try:
            await act(event)
        finally:
            made.run_method("removeUploadedFiles")

    made = ui.upload(
        multiple=count > 1,
        max_file_size=most,
        max_files=count if count > 1 else None,
        on_upload=arrived,
        on_rejected=lambda: say(refusal, "error"),
        auto_upload=True,
    )
    made.props("flat bordered" + (f" accept='{accept}'" if accept else ""))
    made.add_slot("header", _UPLOAD.replace("LABEL", label))
    made.add_slot("list", "<span></span>")


_UPLOAD = """<div class="bench-row">
  <button type="button" class="bench-play" aria-label="LABEL" @click="props.pickFiles">+</button>
  <span>LABEL</span><q-spinner v-if="props.isUploading" />
  <span style="display: none"><q-uploader-add-trigger /></span></div>"""
