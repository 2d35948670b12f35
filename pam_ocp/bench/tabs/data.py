"""The tab Data: files dropped, what is understood of them, units, cells switched off."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import events

from ...core.errors import InputError
from ...core.units import unit as unit_of
from ...fitting.tables.cells import LABELS, QUANTITIES, is_number
from .. import elements as el
from .. import look
from ..elements import Menu, Number, Text, Words
from ..guard import MOST_UPLOAD
from ..jobs.data import look_at
from ..jobs.export import one_page
from ..pictures import Plot
from ..tab import Tab
from ..words import ASKED

BUNDLED = {"DMSP-20-300_static.csv": 0.300, "DMSP-10-250_static.csv": 0.250}
"""Tables at hand, and the rest length of each muscle [m]."""
UNITS = {
    "pressure": ("bar", "kPa", "MPa", "psi", "Pa", "bar abs", "kPa abs"),
    "force": ("N", "kN", "lbf", "kgf"),
    "length": ("mm", "cm", "m", "in"),
    "contraction": ("%", "1"),
    "time": ("s", "ms", "us", "min", "d"),
}
FORCES = "Force over contraction"
NONE = "-"
UNNAMED = " (none named)"
"""Behind the unit that a preview takes where the header names none."""

KIND = Menu("Kind", {"": "as found", "table": "force table", "record": "record in time"})
CLOCK = Menu("Clock", {"": "mend its faults", "cut": "cut at gaps", "refuse": "refuse"})
LENGTH = Number(
    "Rest length",
    "m",
    1e-3,
    10.0,
    optional=True,
    hint="of the muscle at zero pressure and load; needed where the file holds lengths",
)
RAMP = Menu("Rows are", {"": "find out", "yes": "a slow ramp", "no": "single cells"})
RAMPS = {"": None, "yes": True, "no": False}
FLOOR = Menu(
    "Slack cells read",
    {"": "find out", "zero": "the zero of the load cell", "none": "a force"},
)
OFF = Text(
    "Cells off",
    "numbers of cells that are switched off, as 3, 17-20; a click on a cell does the same",
)
MISSING = Text(
    "Missing values",
    "what marks them in the file, as 9999, off; found where nothing is said",
)
SAME_CELLS = {"rest_length", "units"}
"""What readers are told that leaves each cell its number."""
COLOUR = Menu(
    "Colour by", {"pressure": "pressure", "branch": "branch", "run": "repeat", "file": "file"}
)


class Data(Tab):
    title = "Data"
    parts = ("data", "chosen")

    def build(self) -> None:
        self._seen: dict[str, Any] | None = None
        self._seen_of: tuple[Any, ...] = ()
        self._quick_words: dict[str, str] = {}
        with el.split():
            with el.side():
                with el.section("Add data", "CSV, TXT, XLSX, NPZ, MAT, HDF5, JSON, Parquet"):
                    self._uploads()
                self._list = el.box("Data of this session")
                self._reading = el.form("How it is read")
                self._quick_form = el.form("One page from this table")
            with el.plots():
                with el.section("Preview", wide=True) as self._words:
                    self._plot = Plot(
                        FORCES,
                        self._clicked,
                        empty="Cells of a force table, or curves of a record: add data to read",
                    )
                self._columns = el.box("Columns", wide=True)
                self._said = el.box("What was understood", wide=True)

    def update(self, changed: frozenset[str]) -> None:
        self._show_list()
        item = self._item
        key = (item["id"], item.get("file"), item["said"]) if item else ()
        if key != self._seen_of:
            self._seen, self._seen_of = None, key
            if item is not None:
                self.bench.soon(self._look())
        self._show()

    @property
    def _item(self) -> dict[str, Any] | None:
        return self.session.item("data", self.state["chosen"])

    # ---- adding ---------------------------------------------------------------------------------
    def _uploads(self) -> None:
        words = "Drop files here, or choose them with +"
        el.upload(words, self._dropped, self.bench.say, most=MOST_UPLOAD, count=50)
        with el.row().style("margin-top: 6px"):
            el.tag("span", "Bundled:", "bench-note")
            for name, length in BUNDLED.items():
                item = {"name": name, "bundled": name, "said": {"rest_length": length}}
                el.button(name.partition("_")[0], partial(self._add, item))

    async def _dropped(self, event: events.UploadEventArguments) -> None:
        await self._add(await dropped(self, event))

    async def _add(self, item: dict[str, Any]) -> None:
        item = await taken(self, item)
        self.session.put(f"add {item['name']}", "data", item, chosen=item["id"])

    async def _look(self) -> None:
        item = self._item
        if item is None:
            return
        seen = await self.work(look_at, item, quiet=True, latest="look")
        now = self._item
        if now is not None and (now["id"], now["said"]) == (item["id"], item["said"]):
            self._seen = seen
            self._show()

    # ---- the list -------------------------------------------------------------------------------
    def _show_list(self) -> None:
        self._list.clear()
        data = self.state["data"]
        with self._list:
            if not data:
                el.note("Nothing yet: drop a file above, or take a bundled table.")
                return
            rows = [[d["name"], d.get("is", ""), str(len(d.get("off", ())) or "")] for d in data]
            ids = [d["id"] for d in data]
            chosen = ids.index(self.state["chosen"]) if self.state["chosen"] in ids else None
            el.table(
                ["name", "kind", "off"],
                rows,
                act=lambda i: self._choose(ids[i]),
                chosen=chosen,
                label="Data of this session",
            )
            if chosen is not None:
                with el.row().style("margin-top: 6px"):
                    el.button("Remove", self._remove)

    def _choose(self, id: str) -> None:
        item = self.session.item("data", id)
        self.session.change(f"choose {item['name'] if item else id}", chosen=id)

    def _remove(self) -> None:
        item = self._item
        if item is not None:
            rest = [d for d in self.state["data"] if d["id"] != item["id"]]
            chosen = rest[-1]["id"] if rest else None
            self.session.change(f"remove {item['name']}", data=rest, chosen=chosen)

    # ---- how it is read -------------------------------------------------------------------------
    def _show(self) -> None:
        item, seen = self._item, self._seen
        self._columns.clear()
        self._said.clear()
        self._reading.show(self._reading_rows(item, seen or {}) if item else [])
        self._quick_form.show(self._quick_rows("cells" in seen) if item and seen else [])
        self._words.set_text("")
        if item is None:
            self._plot.clear()
            return
        if seen is None:
            self._words.set_text("reading ...")
            return
        with self._columns:
            self._column_table(item, seen)
        with self._said:
            self._understood(seen)
        self._words.set_text(self.bench.words(seen.get("reads_as") or seen["problem"]))
        if "records" in seen:
            self._plot.draw(_record_figure(seen), "Curves of the record")
        else:
            self._plot.draw(self._table_figure(item, seen.get("cells")), FORCES)

    def _reading_rows(self, item: Mapping[str, Any], seen: Mapping[str, Any]) -> list[el.Row]:
        said = item["said"]
        now = {None: "", True: "yes", False: "no"}[said.get("ramp")]
        marks = ", ".join(map(str, said.get("missing") or ()))
        rows: list[el.Row] = [(KIND, said.get("kind"), partial(self._say_one, "kind"))]
        missing = (MISSING, marks, self._missing_said)
        if said.get("kind", item.get("is")) == "record":
            rows += [(CLOCK, said.get("clock"), partial(self._say_one, "clock")), missing]
        else:
            rows += [
                (LENGTH, said.get("rest_length"), partial(self._say_one, "rest_length")),
                (RAMP, now, lambda v: self._say(ramp=RAMPS[v])),
                (FLOOR, said.get("floor"), partial(self._say_one, "floor")),
                (OFF, _ranges(item.get("off", ())), lambda text: self._switch(_numbers(text))),
                missing,
                (COLOUR, self._colour, self._coloured),
            ]
        # what is rarely needed, once it was given, or a message asks for it
        messages = " ".join([seen.get("problem", ""), *seen.get("doubts", ())])
        for option, label in ASKED.items():
            if option in said or f"{option}=" in messages:
                text = Text(label, "as a message asks for it")
                rows.append((text, said.get(option, ""), partial(self._say_one, option)))
        return rows

    def _say_one(self, option: str, value: Any) -> None:
        self._say(**{option: None if value == "" else value})

    def _missing_said(self, text: str) -> None:
        marks = el.parts_of(text)
        self._say(missing=[float(m) if is_number(m) else m for m in marks] or None)

    @property
    def _colour(self) -> str:
        cells = (self._seen or {}).get("cells") or {}
        usual = next((k for k in ("branch", "run", "file") if cells.get(k)), "pressure")
        return str(self.view("colour") or usual)

    def _coloured(self, by: str) -> None:
        self.remember(colour=by)
        self._show()

    def _say(self, **said: Any) -> None:
        """Change what a reader is told; None takes a word back."""
        item = self._item
        if item is None:
            return
        told = {k: v for k, v in {**item["said"], **said}.items() if v not in (None, {})}
        fresh = {**item, "said": told}
        if "kind" in told:
            fresh["is"] = told["kind"]
        if item.get("off") and not said.keys() <= SAME_CELLS:
            fresh["off"] = []
            self.bench.say("Cells may have other numbers now: all are on again")
        self.session.put(f"how {item['name']} is read", "data", fresh)

    def _column_table(self, item: Mapping[str, Any], seen: Mapping[str, Any]) -> None:
        rows = []
        for column in seen["columns"]:
            ends = (math.nan if column[n] is None else float(column[n]) for n in ("low", "high"))
            meaning: Any = column["meaning"] or NONE
            if seen["kind"] != "record":
                meaning = partial(self._meaning_menu, item, column)
            unit = partial(self._unit_menu, item, column)
            rows.append((column["header"], meaning, unit, *ends, column["empty"] or math.nan))
        heads = ("column", "is", "unit", "from", "to", "empty")
        el.table(heads, rows, label="Columns of the file")

    def _meaning_menu(self, item: Mapping[str, Any], column: Mapping[str, Any]) -> None:
        header, now = column["header"], column["meaning"] or NONE

        def chosen(value: str) -> None:
            columns = dict(item["said"].get("columns") or {})
            columns = {k: v for k, v in columns.items() if v != header}
            if value != NONE:
                columns[value] = header
            self._say(columns=columns)

        _menu(f"meaning of {header}", (NONE, *QUANTITIES, *LABELS), now, chosen)

    def _unit_menu(self, item: Mapping[str, Any], column: Mapping[str, Any]) -> None:
        meaning, shown = column["meaning"], column["unit"]
        shown, unnamed = shown.removesuffix(UNNAMED), shown.endswith(UNNAMED)
        known = UNITS.get(meaning) or _like(shown)
        if not unnamed and meaning not in (item["said"].get("units") or {}):
            # the header names the unit, which a reader does not overrule
            known = (shown, f"{shown} abs") if meaning == "pressure" else ()
        if not meaning or meaning in LABELS or not known:
            el.tag("span", shown)
            return

        def chosen(value: str) -> None:
            units = {k: v for k, v in (item["said"].get("units") or {}).items() if k != meaning}
            self._say(units={**units, meaning: value})

        options = known if shown in known else (shown, *known)
        _menu(f"unit of {column['header']}", options, shown, chosen)

    def _understood(self, seen: Mapping[str, Any]) -> None:
        for title, words, kind in (
            ("not read yet", [seen["problem"]] if seen["problem"] else [], "bench-bad"),
            ("doubt", seen["doubts"], "bench-bad"),
            ("said", seen["notes"], "bench-note"),
            ("clock", [seen["clock"]] if seen["clock"] else [], "bench-note"),
            ("text", [", ".join(seen["dialect"])] if seen["dialect"] else [], "bench-note"),
        ):
            for one in words:
                el.note(f"{title}: {self.bench.words(one)}", kind)
        name = str(self._item["name"]) if self._item else ""
        el.tag("pre", re.sub(r"'files/[^']*'", lambda _: repr(name), seen["call"]), "bench-pre")

    # ---- one page -------------------------------------------------------------------------------
    def _quick_rows(self, table: bool) -> list[el.Row]:
        if not table:
            return [el.words("It needs a force table that can be read.")]
        made = self._quick_words.get(str(self.state["chosen"]))
        return [
            el.words(
                "Ranks the laws, builds a pair of such muscles, plans its quickest motion, "
                "linearises it and exports it; report, workbook, FMU, plan and muscle file in "
                "one .zip."
            ),
            el.buttons({"Make one page": self._quick}),
            *([(Words(made, "bench-pre", "pre"), None, None)] if made else []),
        ]

    async def _quick(self) -> None:
        item = self._item
        if item is None:
            return
        made = await self.work(one_page, item)
        self.bench.deliver(self.world.exported(made["file"]))
        self._quick_words[item["id"]] = made["words"]
        self._show()

    # ---- cells ----------------------------------------------------------------------------------
    def _table_figure(self, item: Mapping[str, Any], cells: Any) -> dict[str, Any]:
        if cells is None:
            return look.figure([], "contraction [%]", "force [N]")
        data = _cells(cells, set(item.get("off", ())), self._colour)
        return look.figure(data, "contraction [%]", "force [N]", height=400, keep=str(item["id"]))

    def _clicked(self, point: Mapping[str, Any]) -> None:
        """Switch a cell off or on again."""
        number = (point.get("data") or [None])[0]
        if isinstance(number, int):
            item = self._item
            self._switch(set(item.get("off", ()) if item else ()) ^ {number})

    def _switch(self, off: set[int]) -> None:
        item, cells = self._item, (self._seen or {}).get("cells")
        if item is None or cells is None:
            return
        count = len(cells["force"])
        wrong = next((i for i in off if not 0 <= i < count), None)
        if wrong is not None:
            raise InputError(f"cell {wrong}: the table has cells 0 .. {count - 1}")
        label = f"{len(off)} cells of {item['name']} off"
        self.session.put(label, "data", {**item, "off": sorted(off)})


async def dropped(tab: Tab, event: events.UploadEventArguments, **said: Any) -> dict[str, Any]:
    """A file dropped on a tab as an item of data. said : to its reader."""
    name = _shown(event.file.name)
    return {"name": name, "file": tab.session.store(name, await event.file.read()), "said": said}


async def taken(tab: Tab, item: dict[str, Any]) -> dict[str, Any]:
    """The item to be kept, once it could be looked at; a damaged file is refused here."""
    seen = await tab.work(look_at, item, of=item["name"])
    return {**item, "id": tab.session.fresh_id("data"), "off": [], "is": seen["kind"]}


def _menu(label: str, options: Sequence[str], now: str, act: Any) -> None:
    with el.tag("select", "", "bench-input", aria_label=label) as made:
        for one in options:
            el.tag("option", one, value=one, selected=one == now)

    def chosen(event: Any) -> None:
        if event.args in options:
            act(event.args)

    made.on("change", chosen, js_handler="(e) => emit(e.target.value)")


def _like(shown: str) -> Sequence[str]:
    try:
        unit_of(shown)
    except InputError:
        return ()
    return el.units_like(shown)


def _cells(cells: Mapping[str, Any], off: set[int], by: str) -> list[dict[str, Any]]:
    """Markers: by pressure on one scale, else by label in colours and shapes; slack ones hollow."""
    p, k, f = (np.asarray(cells[n], float) for n in ("pressure", "contraction", "force"))
    index = np.arange(len(f))
    on = np.array([i not in off for i in range(len(f))])
    labels = np.array(cells.get(by) or [""] * len(f)) if by != "pressure" else None
    hover = "%{y:.4g} N at %{x:.3g} %, %{customdata[1]:.3g} bar, cell %{customdata[0]}"

    def marked(chosen: Any, name: str, **more: Any) -> dict[str, Any]:
        data = [[int(i), float(p[i] / 1e5)] for i in index[chosen]]
        return look.points(
            100 * k[chosen], f[chosen], name, customdata=data, hovertemplate=hover, **more
        )

    data = []
    taut = on & (f > 0)
    if labels is None:
        scale = {
            "color": look.numbers(p[taut] / 1e5),
            "colorscale": look.SCALE,
            "colorbar": look.scale("pressure [bar]"),
            "size": 8,
        }
        data.append(marked(taut, "taut", marker=scale))
    else:
        for i, label in enumerate(dict.fromkeys(labels)):
            style = {"symbol": look.symbol(i), "size": 8}
            colour = look.colour(i)
            data.append(
                marked(taut & (labels == label), label or "(none)", colour=colour, marker=style)
            )
    hollow = {"symbol": "circle-open", "size": 6}
    data.append(marked(on & (f <= 0), "slack (censored)", colour=look.FAINT, marker=hollow))
    data.append(marked(~on, "off", colour=look.FAINT, marker={"symbol": "x-thin-open", "size": 9}))
    if labels is None:
        for one in data:
            one["showlegend"] = one["name"] != "taut"
    return data


def _record_figure(seen: Mapping[str, Any]) -> dict[str, Any]:
    """Panels below each other, one for each unit."""
    units = list(dict.fromkeys(c["unit"] for c in seen["records"][0]["curves"]))[:5]
    rows = []
    for unit in units:
        names = [c["name"] for c in seen["records"][0]["curves"] if c["unit"] == unit]
        drawn = []
        for r, record in enumerate(seen["records"]):
            for curve in (c for c in record["curves"] if c["unit"] == unit):
                colour = look.COLOURS[names.index(curve["name"]) % len(look.COLOURS)]
                more = {"showlegend": r == 0, "opacity": 1.0 - 0.2 * r}
                drawn.append(look.line(record["t"], curve["values"], curve["name"], colour, **more))
        rows.append((look.quantity(unit), drawn))
    return look.panels(rows, "time [s]", keep="record")


def _shown(name: str) -> str:
    """A file's name as a browser sent it: its last part, printable, not long."""
    last = re.split(r"[/\\]", name)[-1]
    return "".join(c if c.isprintable() else "_" for c in last)[-80:] or "file"


def _ranges(off: Sequence[int]) -> str:
    """[3, 17, 18, 19] as "3, 17-19"."""
    parts: list[list[int]] = []
    for i in sorted(off):
        if parts and i == parts[-1][1] + 1:
            parts[-1][1] = i
        else:
            parts.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)


def _numbers(text: str) -> set[int]:
    """The way back. Raises InputError."""
    found: set[int] = set()
    for part in filter(None, (p.strip() for p in text.split(","))):
        match = re.fullmatch(r"(\d{1,6})(?:\s*-\s*(\d{1,6}))?", part)
        if match is None:
            raise InputError(f"cells off = {text[:60]!r}: give numbers and ranges, as 3, 17-20")
        found |= set(range(int(match[1]), int(match[2] or match[1]) + 1))
    return found
