"""The tab Muscle: laws ranked, the fit with its band, coefficients on sliders, what to measure."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import events, ui

from ...core.errors import InputError
from ...core.units import unit as unit_of
from ...muscles.catalogue import muscle_names
from ...muscles.catalogue import summary as catalogue_summary
from ...muscles.law import LAWS, ForceLaw
from ...muscles.laws.user_defined import law_named
from ...muscles.pneumatic_muscle import Muscle
from .. import elements as el
from .. import look
from ..elements import Menu, Number, Slide, Text
from ..jobs import muscle as jobs
from ..made import World, chosen_item, muscle_of
from ..pictures import Plot
from ..tab import Tab

MOST_FILE = 2**20
"""Bytes of a muscle file."""
SIZE = 36
"""Points of the surface along each axis."""
CONSTANTS = {
    name: Number(name.replace("_", " "), unit, 1e-4, 1.0, optional=True)
    for name, unit in {"radius": "m", "rest_diameter": "m", "max_contraction_ratio": "1"}.items()
}
"""Known constants that some laws ask for."""
NAME = Text("Name")
DIAMETER = Number(
    "Inner diameter at rest",
    "m",
    1e-3,
    0.5,
    optional=True,
    hint="needed by valves and by what counts air",
)
LENGTH = Number(
    "Rest length",
    "m",
    1e-3,
    10.0,
    optional=True,
    hint="where the catalogue holds none, or of another one",
)
READ = ("bundled", "file", "said", "off")
"""What the table of an item of data depends on."""
CHOOSE = el.words("Choose a force table in the tab Data.")
COUNT = Number("Further cells", low=1, high=50, shown="1")
CRITERION = Menu(
    "Shrink",
    {"D": "joint confidence region", "A": "relative variances", "I": "predicted force"},
)


class MuscleTab(Tab):
    title = "Muscle"
    parts = ("muscle", "data", "chosen")

    def build(self) -> None:
        self._fit: dict[str, Any] | None = None
        self._fit_of: Any = None
        self._ranked: list[dict[str, Any]] = []
        self._ranked_of: Any = None
        self._next: dict[str, Any] | None = None
        with el.split():
            with el.side():
                with el.section("Law fitted to the chosen data") as self._data_name:
                    self._law_form = el.Form()
                    with ui.expansion("Known constants").props("dense") as self._more:
                        self._more.classes("bench-note")
                        self._constant_form = el.Form()
                    self._laws = ui.element("div")
                with el.section("Coefficients") as self._coefficient_words:
                    self._coefficient_form = el.Form()
                with el.section("Muscle") as self._muscle_words:
                    self._muscle_form = el.Form()
                with el.section("From the catalogue, or a file"):
                    self._others()
            with el.plots():
                with el.section("Force", wide=True) as self._force_words:
                    self._force = Plot(
                        "Force over contraction",
                        empty="A curve for each pressure: fit a law, or choose a muscle",
                    )
                with el.section("Residuals"):
                    self._rest = Plot(
                        "Residuals of the fit",
                        empty="Measured minus fitted force of each cell, after a fit",
                    )
                with el.section("Force surface"):
                    self._surface = Plot(
                        "Force surface",
                        empty="The force over contraction and pressure",
                    )
                with el.section("Measure next"):
                    self._design_form = el.Form()
                    self._next_box = ui.element("div")
                self._intervals = el.box("Intervals, 95 %")
                with el.section("Report", wide=True):
                    self._report = el.tag("pre", "", "bench-pre")

    def update(self, changed: frozenset[str]) -> None:
        said = self._said
        of = said and _fit_of(said)
        if of != self._fit_of:
            self._fit, self._fit_of, self._next = None, of, None
            if said:
                self.bench.soon(self._refit())
        self._show_laws()
        self._show()
        self._show_others()

    @property
    def _said(self) -> dict[str, Any] | None:
        """The muscle of the state where it is a fit."""
        said = self.state["muscle"]
        return said if said is not None and said["kind"] == "fit" else None

    @property
    def _held(self) -> dict[str, Any]:
        """The same for an event, which raises InputError where it is gone."""
        if self._said is None:
            raise InputError("the fit is gone; fit a law")
        return self._said

    # ---- laws -----------------------------------------------------------------------------------
    def _show_laws(self) -> None:
        self._laws.clear()
        item = self.session.item("data", self.state["chosen"])
        self._data_name.set_text(item["name"] if item else "")
        ready = item is not None and item.get("is") == "table"
        self._more.set_visibility(ready)
        said = self._said
        now = said["law"] if said else None
        self._law_form.show(self._law_rows(item, said) if ready else [CHOOSE])
        self._constant_form.show(el.fields(CONSTANTS, self._constants, self._constant))
        if ready and self._ranked and self._ranked_of == self._rank_key:
            with self._laws:
                self._ranking(now)

    def _law_rows(self, item: Any, said: Mapping[str, Any] | None) -> list[el.Row]:
        law = said["law"] if said and said["law"] in LAWS else "six-parameter"
        titles = {name: LAWS[name].title for name in LAWS}
        self._law = law
        changed = el.words("The data have changed since the fit.", "bench-bad")
        acts = {"Fit": lambda: self._fit_law(str(self._law)), "Rank all laws": self._rank}
        return [
            *([changed] if said and not _same(said["table"], item) else []),
            (Menu("Law", titles), law, lambda v: setattr(self, "_law", v)),
            el.buttons(acts, main="Fit"),
        ]

    def _ranking(self, now: str | None) -> None:
        rows = [
            (one["name"], one["parameters"], one["rmse"], one["left_out"])
            for one in self._ranked
            if one["fitted"]
        ]
        names = [row[0] for row in rows]
        el.table(
            ["law", "k", "RMSE [N]", "left out [N]"],
            rows,
            act=lambda i: self._fit_law(names[i]),
            chosen=names.index(now) if now in names else None,
            label="Laws ranked by their error at a contraction left out of the fit",
        )
        for one in self._ranked:
            if not one["fitted"]:
                el.note(self.bench.words(f"{one['name']}: {one['problem']}"))

    @property
    def _constants(self) -> dict[str, float | None]:
        return {**dict.fromkeys(CONSTANTS), **self.view("constants", {})}

    @property
    def _known(self) -> dict[str, float]:
        return {n: v for n, v in self._constants.items() if v is not None}

    def _constant(self, name: str, value: float | None) -> None:
        kept = {k: v for k, v in {**self._constants, name: value}.items() if v is not None}
        self.remember(constants=kept)
        self._show_laws()

    @property
    def _rank_key(self) -> Any:
        """All that the ranking depends on."""
        item = self.session.item("data", self.state["chosen"]) or {}
        return [{k: item.get(k) for k in READ}, self._known]

    async def _rank(self) -> None:
        item, key = chosen_item(self.state), self._rank_key
        self._ranked = await self.work(jobs.rank_laws, item, self._known)
        self._ranked_of = key
        self._show_laws()

    async def _fit_law(self, name: str) -> None:
        """Fit a law to the chosen data: one step of undo."""
        item = chosen_item(self.state)
        kind = law_named(name)
        fixed = {n: v for n, v in self._known.items() if n in kind.fixed_coefficients()}
        fit = {"table": item, "law": name, "fixed": fixed}
        found = await self.work(jobs.fit_law, fit, of=name)
        values = {c["name"]: c["value"] for c in found["coefficients"]}
        before = self._said or {}
        length = found["rest_length"]
        if length is None:
            length = before.get("rest_length")
        if length is None:
            raise InputError(
                "rest_length is missing: the table holds none; give it in the tab Data"
            )
        said = {
            "kind": "fit",
            **fit,
            "coefficients": values,
            "fitted": values,
            "moved": False,
            "rest_length": length,
            "diameter": before.get("diameter"),
            "name": before.get("name", "fitted muscle"),
            **{k: found[k] for k in ("pressure_range", "contraction_range", "source")},
        }
        self._fit, self._fit_of, self._next = found, fit, None
        self.session.change(f"fit {name}", muscle=said)

    async def _refit(self) -> None:
        """The figures of a fit that the state tells of: after resuming, or undo."""
        said = self._said
        if said is not None:
            fit = _fit_of(said)
            found = await self.work(jobs.fit_law, fit, of=said["law"])
            if self._fit_of == fit:
                self._fit = found
                self._show()

    # ---- what is shown --------------------------------------------------------------------------
    def _show(self) -> None:
        said, fit = self._said, self._fit
        self._next_box.clear()
        self._intervals.clear()
        self._report.set_text("")
        for words in (self._coefficient_words, self._force_words, self._muscle_words):
            words.set_text("")
        forms = (self._coefficient_form, self._muscle_form, self._design_form)
        with self.rows(*forms) as rows, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows[0] = self._coefficient_rows(said, fit)
            if self.state["muscle"] is None:
                for plot in (self._force, self._rest, self._surface):
                    plot.clear()
                return
            muscle = muscle_of(self.world)
            rows[1] = self._muscle_rows(muscle, said)
            if fit is not None and said is not None:
                rows[2] = self._design_rows()
                with self._intervals:
                    _interval_table(fit, self.bench.words)
                self._show_next()
                self._report.set_text(fit["report"])
            self._draw(muscle)
            self._draw_surface(muscle)

    def _muscle_rows(self, muscle: Muscle, said: dict[str, Any] | None) -> list[el.Row]:
        self._muscle_words.set_text(muscle.law.title)
        acts: dict[str, Any] = {
            "Save muscle file": partial(self._save, "muscle.toml", jobs.muscle_file)
        }
        if said is None:
            length = f"{muscle.name}, rest length {1e3 * float(muscle.rest_length):g} mm"
            texts = (length, f"Source: {muscle.source}", muscle.note)
            return [*(el.words(text) for text in texts if text), el.buttons(acts)]
        if self._fit is not None and self._fit["workbook"]:
            acts["Save workbook"] = lambda: self._save(
                "fit.xlsx", jobs.workbook, _fit_of(self._held)
            )
        return [
            (NAME, said["name"], lambda v: self._change("name", name=v[:80])),
            (DIAMETER, said.get("diameter"), lambda v: self._change("diameter", diameter=v)),
            el.buttons(acts),
        ]

    def _change(self, label: str, **values: Any) -> None:
        self.session.change(label, muscle={**self._held, **values})

    # ---- sliders --------------------------------------------------------------------------------
    def _coefficient_rows(
        self, said: dict[str, Any] | None, fit: Mapping[str, Any] | None
    ) -> list[el.Row]:
        if said is None or fit is None:
            none = el.words("No muscle yet: fit a law, or take one of the catalogue.")
            return [none] if self.state["muscle"] is None else []
        self._coefficient_words.set_text("moved by hand" if said["moved"] else "as fitted")
        self._now, rows = dict(said["coefficients"]), list[el.Row]()
        for c in fit["coefficients"]:
            name, fitted = c["name"], said["fitted"][c["name"]]
            if c["held"]:
                rows.append(el.words(f"{name} = {c['value']:.6g} {c['unit']}, held"))
                continue
            shown, factor = _shown_unit(c["unit"])
            reach = 6 * c["stderr"] if math.isfinite(c["stderr"]) else 0.0
            reach = min(max(reach, 0.1 * abs(fitted)), 2 * abs(fitted)) or 1.0
            value = said["coefficients"][name]
            ends = min(fitted - reach, value) / factor, max(fitted + reach, value) / factor
            acts = partial(self._slide, name, factor), partial(self._settle, name, factor)
            rows.append((Slide(name, *ends, shown, of=(fitted, reach)), value / factor, acts))
        return [*rows, *([el.buttons({"Back to the fit": self._unmoved})] if said["moved"] else [])]

    def _slide(self, name: str, factor: float, value: float) -> None:
        """The curves follow; nothing is kept yet. factor : of the unit shown."""
        self._now[name] = factor * value
        said, fit = self._said, self._fit
        if said is None or fit is None:
            return
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            law = law_named(said["law"])(**self._now)
            muscle = muscle_of(self.world)
            moved = dataclasses.replace(muscle, law=law)
            curves = [look.numbers(moved.force(p, fit["kappa"])) for p in fit["levels"]]
            count = len(fit["levels"])
            self._force.curves(range(count, 2 * count), y=curves)
            residuals, rmse = _residuals(law, fit)
            self._rest.curves([0], y=[look.numbers(residuals)])
            self._force_words.set_text(f"RMSE {rmse:.4g} N (fitted {fit['rmse']:.4g} N)")

    def _settle(self, name: str, factor: float, value: float) -> None:
        self._now[name] = factor * value
        self._change(f"{name} by hand", coefficients=dict(self._now), moved=True)

    def _unmoved(self) -> None:
        self._change("back to the fit", coefficients=self._held["fitted"], moved=False)

    # ---- pictures -------------------------------------------------------------------------------
    def _draw(self, muscle: Muscle) -> None:
        said, fit = self._said, self._fit
        axes = ("contraction [%]", "force [N]")
        if said is None or fit is None:
            low, high = muscle.contraction_range
            kappa = np.linspace(min(low, 0.0), high, jobs.CURVE)
            top = muscle.pressure_range[1]
            levels = [top * (i + 1) / jobs.MOST_LEVELS for i in range(jobs.MOST_LEVELS)]
            data = _curves(muscle, levels, kappa)
            self._force.draw(look.figure(data, *axes, height=380, keep=muscle.name))
            self._rest.clear()
            return
        levels, kappa = fit["levels"], fit["kappa"]
        data = [
            look.band(100 * kappa, low, high, look.colour(i))
            for i, (low, high) in enumerate(fit["bands"])
        ]
        data += _curves(muscle, levels, kappa)
        data += _measured(fit)
        if self._next is not None:
            star = {"symbol": "star", "size": 11, "line": {"width": 1, "color": "#333333"}}
            kappa, force = 100 * self._next["contraction"], self._next["force"]
            data.append(look.points(kappa, force, "measure next", "#e69f00", marker=star))
        top = max(
            float(np.max(fit["cells"]["force"])), float(np.max(data[2 * len(levels) - 1]["y"]))
        )
        ends = {"range": [-0.04 * top, 1.12 * top]}  # a band may go to any height beyond the cells
        picture = look.figure(data, *axes, height=420, keep=str(said["law"]), yaxis=ends)
        self._force.draw(picture)
        residuals, rmse = _residuals(muscle.law, fit)
        taut = ~np.asarray(fit["cells"]["slack"])
        markers = {"size": 6}
        one = look.points(fit["cells"]["force"][taut], residuals, marker=markers)
        self._rest.draw(look.figure([one], "measured force [N]", "residual [N]", height=300))
        words = f"RMSE {rmse:.4g} N over {fit['n']} taut cells, R² {fit['r2']:.5f}"
        if said["moved"]:
            words = f"RMSE {rmse:.4g} N (fitted {fit['rmse']:.4g} N)"
        self._force_words.set_text(words)

    def _draw_surface(self, muscle: Muscle) -> None:
        low, high = muscle.contraction_range
        p = np.linspace(0.0, muscle.pressure_range[1], SIZE)
        kappa = np.linspace(min(low, 0.0), high, SIZE)
        force = np.asarray(muscle.force(p[:, None], kappa[None, :]), float)
        data: list[dict[str, Any]] = [
            {
                "type": "surface",
                "x": look.numbers(100 * kappa),
                "y": look.numbers(p / 1e5),
                "z": look.numbers(force),
                "colorscale": look.SCALE,
                "showscale": False,
                "opacity": 0.92,
                "hovertemplate": "%{z:.4g} N at %{x:.3g} %, %{y:.3g} bar<extra></extra>",
            }
        ]
        if self._said is not None and self._fit is not None:
            cells = self._fit["cells"]
            data.append(
                {
                    "type": "scatter3d",
                    "mode": "markers",
                    "x": look.numbers(100 * cells["contraction"]),
                    "y": look.numbers(cells["pressure"] / 1e5),
                    "z": look.numbers(cells["force"]),
                    "marker": {"size": 2.5, "color": look.COLOURS[1]},
                    "showlegend": False,
                }
            )
        axis = {"gridcolor": look.GRID, "color": look.FAINT, "backgroundcolor": "rgba(0,0,0,0)"}
        scene = {
            "xaxis": {**axis, "title": {"text": "contraction [%]"}},
            "yaxis": {**axis, "title": {"text": "pressure [bar]"}},
            "zaxis": {**axis, "title": {"text": "force [N]"}},
            "camera": {"eye": {"x": 1.9, "y": 1.9, "z": 0.9}, "center": {"z": -0.15}},
        }
        margin = {"l": 0, "r": 0, "t": 0, "b": 0}
        self._surface.draw(look.figure(data, height=300, scene=scene, margin=margin))

    # ---- what to measure next -------------------------------------------------------------------
    def _design_rows(self) -> list[el.Row]:
        return [
            (COUNT, self._how[0], lambda v: self._set_how(count=round(v))),
            (CRITERION, self._how[1], lambda v: self._set_how(criterion=v)),
            el.buttons({"Propose": self._design}),
        ]

    @property
    def _how(self) -> tuple[int, str]:
        """How many cells are proposed, and by what."""
        return int(self.view("count", 6)), str(self.view("criterion", "D"))

    def _set_how(self, **values: Any) -> None:
        self.remember(**values)
        self._next = None
        self._show()

    def _show_next(self) -> None:
        found = self._next
        if found is None:
            return
        lengths = found["length"]
        rows = [
            (
                float(p / 1e5),
                float(100 * k),
                *([float(1e3 * lengths[i])] if lengths is not None else []),
                float(f),
            )
            for i, (p, k, f) in enumerate(
                zip(found["pressure"], found["contraction"], found["force"], strict=True)
            )
        ]
        heads = ["p [bar]", "κ [%]", *(["l [mm]"] if lengths is not None else []), "F expected [N]"]
        ratios = ", ".join(
            f"{n} ×{found['after'][n] / found['before'][n]:.2f}" for n in found["after"]
        )
        with self._next_box:
            el.table(heads, rows, label="Cells to measure next")
            el.note(f"Standard errors then: {ratios}")

    async def _design(self) -> None:
        fit, how = _fit_of(self._held), self._how
        found = await self.work(jobs.design, fit, *how)
        if (fit, how) == (self._fit_of, self._how):
            self._next = found
            self._show()

    # ---- other muscles, and out of it -----------------------------------------------------------
    def _others(self) -> None:
        self._length: float | None = None
        self._others_form = el.Form()
        words, say = "Muscle file (.toml, .json)", self.bench.say
        el.upload(words, self._dropped, say, most=MOST_FILE, accept=".toml,.json")

    def _show_others(self) -> None:
        said = self.state["muscle"] or {}
        name = said["name"] if said.get("kind") == "catalogue" else ""
        if name:
            self._length = said.get("rest_length")
        names = {"": "choose ..."} | {n: catalogue_summary(n) for n in muscle_names()}
        catalogue = Menu("Catalogue", names), name, lambda n: self._catalogued(n, self._length)
        length = LENGTH, self._length, lambda v: self._catalogued(name, v)
        self._others_form.show([catalogue, length])

    def _catalogued(self, name: str, length: float | None) -> None:
        """A muscle of the catalogue; without a name its length alone, for the one chosen next."""
        self._length = length
        if name:
            said = {"kind": "catalogue", "name": name, "rest_length": length}
            muscle_of(World(self.session.folder, {"muscle": said}))
            self.session.change(f"muscle {name}", muscle=said)

    async def _dropped(self, event: events.UploadEventArguments) -> None:
        file = self.session.store(event.file.name, await event.file.read())
        name = await self.work(jobs.read_muscle, file)
        self.session.change(f"muscle {name}", muscle={"kind": "file", "file": file, "name": name})

    async def _save(self, name: str, made_by: Callable[..., bytes], *args: Any) -> None:
        self.bench.download(await self.work(made_by, *args), name)


def _fit_of(said: Mapping[str, Any]) -> dict[str, Any]:
    """What a fit is made of."""
    return {k: said[k] for k in ("table", "law", "fixed")}


def _same(table: Mapping[str, Any], item: Mapping[str, Any]) -> bool:
    return all(table.get(k) == item.get(k) for k in READ)


def _shown_unit(unit: str) -> tuple[str, float]:
    """The unit in which a coefficient is shown (bar for Pa), and its factor to SI."""
    shown = unit.replace("Pa", "bar")
    return ("" if shown == "1" else shown), unit_of(shown).factor


def _curves(muscle: Muscle, levels: Sequence[float], kappa: Any) -> list[dict[str, Any]]:
    return [
        look.line(100 * kappa, muscle.force(p, kappa), f"{p / 1e5:.3g} bar", look.colour(i))
        for i, p in enumerate(levels)
    ]


def _measured(fit: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Measured cells in the colour of their pressure's curve; pale where none is drawn."""
    cells, levels = fit["cells"], np.array(fit["levels"])
    p = np.asarray(cells["pressure"], float)
    nearest = np.argmin(np.abs(p[:, None] - levels[None, :]), axis=1)
    near = np.abs(p - levels[nearest]) <= 0.03 * levels[nearest]
    taut = ~np.asarray(cells["slack"])
    made = []
    groups = [(near & taut & (nearest == i), i) for i in range(len(levels))]
    for chosen, i in [(~near & taut, -1), *groups]:
        colour = look.FAINT if i < 0 else look.colour(i)
        symbol = "circle-open" if i < 0 else look.symbol(i)
        made.append(
            look.points(
                100 * cells["contraction"][chosen],
                cells["force"][chosen],
                "",
                colour,
                marker={"symbol": symbol, "size": 5 if i < 0 else 7},
                customdata=look.numbers(p[chosen] / 1e5),
                hovertemplate="%{y:.4g} N at %{x:.3g} %, %{customdata:.3g} bar<extra></extra>",
            )
        )
    return made


def _residuals(law: ForceLaw, fit: Mapping[str, Any]) -> tuple[Any, float]:
    """Measured minus tension of the taut cells [N], and their RMSE."""
    cells = fit["cells"]
    taut = ~np.asarray(cells["slack"])
    tension = law.tension(cells["pressure"][taut], cells["contraction"][taut])
    residuals = cells["force"][taut] - np.asarray(tension, float)
    return residuals, float(np.sqrt(np.mean(residuals**2)))


def _interval_table(fit: Mapping[str, Any], worded: Callable[[str], str]) -> None:
    rows = []
    for c in fit["coefficients"]:
        shown, factor = _shown_unit(c["unit"])
        ends = [f"{c[k] / factor:.5g}" if math.isfinite(c[k]) else "open" for k in ("low", "high")]
        value, error = f"{c['value'] / factor:.6g}", f"{c['stderr'] / factor:.3g}"
        if c["held"]:
            ends, error = ["", ""], "held"
        rows.append((c["name"], value, error, *ends, shown))
    el.table(["coefficient", "value", "std. error", "from", "to", "unit"], rows, label="Intervals")
    for words in fit["warnings"]:
        el.note(worded(words), "bench-bad")
