"""The tab Plant: the arrangement to scale, what it is made of, its rest, vibration and loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from ...core.errors import InputError
from ...core.quantities import quantity
from ...core.units import display_unit
from ...muscles.catalogue import muscle_names
from ...plants.kinds import PLANTS
from .. import elements as el
from .. import look
from ..form import argument_fields
from ..jobs import plant as jobs
from ..made import muscle_of, own_plants
from ..script import plant_lines
from ..tab import Tab
from .plant_own import own_plant_upload

__all__ = ["PlantTab"]

TURNING = ("AntagonisticJoint",)
"""Arrangements whose position is an angle."""
STUDY = {
    "position": ("position [mm]", 1e3),
    "stiffness": ("stiffness [N/mm]", 1e-3),
    "frequency": ("natural frequency [Hz]", 1.0),
    "settling_time": ("settling time [s]", 1.0),
}


class PlantTab(Tab):
    title = "Plant"
    parts = ("muscle", "plant", "point")

    def build(self) -> None:
        self._what: dict[str, Any] | None = None
        self._made_of: Any = None
        self._map: dict[str, Any] | None = None
        self._rest: dict[str, Any] | None = None
        self._rest_of: Any = None
        with el.split():
            with el.side():
                with el.section("Arrangement") as self._words:
                    self._form = ui.element("div")
                with el.section("Operating point") as self._point_words:
                    self._point = ui.element("div")
            with el.plots():
                with el.section("To scale"):
                    self._scene = el.Scene("The plant, drawn to scale", None, height=300)
                with el.section("Equilibrium map") as self._map_words:
                    self._map_plot = el.Plot(
                        look.figure([], height=330),
                        "Equilibrium map",
                        self._clicked,
                        empty="Position and stiffness over the pressures: press Compute the map",
                    )
                    with ui.element("div").classes("bench-row"):
                        el.button("Compute the map", self._compute_map)
                        el.tag("span", "A click sets the operating point.", "bench-note")
                with el.section("Free vibration") as self._swing_words:
                    self._swing_box()
                with el.section("Load study") as self._loads_words:
                    self._loads_box()
                with el.section("At rest"):
                    self._values = ui.element("div")
                with el.section("Variables"):
                    self._variables = ui.element("div")
        self.update(frozenset(self.parts))

    def update(self, changed: frozenset[str]) -> None:
        state = self.state
        made_of = [state["muscle"], state["plant"]]
        if made_of != self._made_of:
            self._made_of, self._what, self._map, self._rest_of = made_of, None, None, None
            if state["muscle"] is not None:
                self.bench.soon(self._outline)
            self._draw_map()
            self._swing_plot.draw(look.figure([], height=240))
            self._swing_scene.show(None)
            self._study_plot.draw(look.figure([], height=380))
            for words in (self._swing_words, self._loads_words):
                words.set_text("")
            self._cases.clear()
        self._show_form()
        self._show_point()

    @staticmethod
    def lines(state: dict[str, Any]) -> Sequence[str]:
        return plant_lines(state)

    @property
    def _arrangement(self) -> str:
        return str(self.state["plant"]["arrangement"])

    # ---- the form -------------------------------------------------------------------------------
    def _show_form(self) -> None:
        self._form.clear()
        said = self.state["plant"]
        name = self._arrangement
        with self._form:
            muscle = self.state["muscle"]
            if muscle is None:
                el.note("No muscle yet: fit or choose one in the tab Muscle.", "bench-bad")
            else:
                el.note(f"muscle: {muscle.get('name', '')}")
            own = own_plants(self.bench.folder) if self.bench.allow_code else {}
            known = {**{n: n for n in PLANTS}, **own}
            el.choice("Arrangement", {name: name, **known}, name, self._arranged)
            if self.bench.allow_code:
                own_plant_upload(self.bench, self._arranged)
            if name not in PLANTS:
                self._words.set_text("A plant of your own")
                return
            self._words.set_text(PLANTS.words(name))
            with self.bench.shown_errors():
                argument_fields(PLANTS, name, said, self._said, turning=name in TURNING)
            if "muscle2" in PLANTS.arguments(name):
                second = {"": "the same"} | {n: n for n in muscle_names()}
                el.choice(
                    "second muscle",
                    second,
                    str(said.get("muscle2", "")),
                    lambda v: self._said("muscle2", v or None),
                )

    def _arranged(self, name: str) -> None:
        with self.bench.shown_errors():
            known = PLANTS.arguments(name) if name in PLANTS else {}
            kept = {k: v for k, v in self.state["plant"].items() if k in known and k != "set"}
            # what belongs to the other kind of motion would be in a unit of its own
            if (name in TURNING) != (self._arrangement in TURNING):
                kept = {k: v for k, v in kept.items() if k in ("feed", "losses")}
            plant = {**kept, "arrangement": name}
            self.bench.session.change(f"arrangement {name}", plant=plant, point={})

    def _said(self, name: str, value: Any) -> None:
        """An argument of the plant; None takes it back. It is tried before it is kept."""
        with self.bench.shown_errors():
            rest = {k: v for k, v in self.state["plant"].items() if k != name}
            plant = rest if value is None else {**rest, name: value}
            self.bench.session.change(name.replace("_", " "), plant=plant)

    # ---- the plant ------------------------------------------------------------------------------
    async def _outline(self) -> None:
        made_of = self._made_of
        try:
            what = await self.bench.work(
                "The plant",
                jobs.outline_of,
                self.bench.folder,
                self.state,
                self.bench.allow_code,
                quiet=True,
                latest="outline",
                warm="plant",
                time_limit=60.0,
            )
        except Exception:
            self._scene.show(None)
            self._variables.clear()
            raise
        if made_of != self._made_of:
            return
        self._what = what
        scene = what["scene"]
        if scene is not None:
            near = int(np.argmin(np.abs(np.array(scene["t"]) - 0.0)))
            scene["still"] = near
            self._scene.show(scene, words=scene["along"], unit=scene["unit"], seconds=3.0)
        else:
            self._scene.show(None)
        self._variables.clear()
        with self._variables:
            rows = [
                (
                    v["name"],
                    v["causality"],
                    "" if v["start"] is None else f"{v['start']:.5g}",
                    "" if v["unit"] == "1" else v["unit"],
                )
                for v in what["variables"]
                if v["causality"] != "constraint"
            ]
            el.table(["variable", "is", "start", "unit"], rows, label="Variables of the plant")
        self._show_point()

    # ---- the operating point --------------------------------------------------------------------
    def _show_point(self) -> None:
        self._point.clear()
        self._point_words.set_text("")
        if self._what is None:
            return
        point = self.state["point"]
        names = list(point) or self._what["pressures"]
        with self._point:
            for name in names:
                el.Field(
                    name,
                    point.get(name),
                    self._unit(name),
                    partial(self._set, name),
                    optional=True,
                )
            if not point:
                el.note("Give each pressure, or click into the map.")
        if point and point != self._rest_of:
            self._rest_of = dict(point)
            self.bench.soon(self._find_rest)
        elif not point:
            self._values.clear()

    def _unit(self, name: str) -> str:
        """The SI unit of a variable that a condition names."""
        shown = next((v["unit"] for v in (self._what or {})["variables"] if v["name"] == name), "1")
        base = {display_unit(u): u for u in ("Pa", "m", "rad", "Pa/s", "rad/s")}
        return base.get(shown, shown)

    def _set(self, name: str, value: float | None) -> None:
        with self.bench.shown_errors():
            names = list(self.state["point"]) or (self._what or {})["pressures"]
            point = {**dict.fromkeys(names), **self.state["point"], name: value}
            missing = [n for n, v in point.items() if v is None]
            if missing and value is not None:
                point = {n: (value if v is None else v) for n, v in point.items()}
            kept = {n: v for n, v in point.items() if v is not None}
            self.bench.session.change("operating point", point=kept if value is not None else {})

    async def _find_rest(self) -> None:
        point = dict(self.state["point"])
        self._values.clear()
        try:
            found = await self.bench.work(
                "Operating point",
                jobs.rest,
                self.bench.folder,
                self.state,
                point,
                self.bench.allow_code,
                quiet=True,
                latest="rest",
                warm="plant",
                time_limit=60.0,
            )
        except Exception:
            self._point_words.set_text("no rest there")
            raise
        if point != self.state["point"]:
            return
        self._rest = found
        self._point_words.set_text(found["stability"])
        self._values.clear()
        with self._values:
            rows = [(n, f"{v:.6g}", "" if u == "1" else u) for n, v, u in found["shown"]]
            el.table(["variable", "value", "unit"], rows, label="Values at rest")
            for frequency, damping in found["modes"]:
                el.note(f"swings at {frequency:.4g} Hz, damping ratio {damping:.3g}")
        self._draw_map()

    # ---- the map --------------------------------------------------------------------------------
    async def _compute_map(self) -> None:
        with self.bench.shown_errors():
            muscle_of(self.bench.folder, self.state)
            made_of = self._made_of
            found = await self.bench.work(
                "Equilibrium map",
                jobs.equilibrium_map,
                self.bench.folder,
                self.state,
                self.bench.allow_code,
                warm="plant",
            )
            if made_of == self._made_of:
                self._map = found
                self._draw_map()

    def _draw_map(self) -> None:
        found, rest = self._map, self._rest if self.state["point"] else None
        if found is None:
            self._map_words.set_text("")
            self._map_plot.draw(look.figure([], height=330))
            return
        unit, factor = found["position_unit"]
        position = found["position"] / factor
        felt, size = found["stiffness_unit"]
        if felt == "N/m":
            felt, size = "N/mm", 1e3
        stiffness = found["stiffness"] / size
        words = f"{found['position_name']} [{unit}]"
        self._map_words.set_text(f"stiffness in {felt}")
        if len(found["names"]) == 1:
            figure = _curve(found, position, stiffness, words, felt)
        else:
            figure = _field(found, position, stiffness, words, felt)
        if rest is not None and all(n in rest["values"] for n in found["names"]):
            at = [rest["values"][n] / 1e5 for n in found["names"]]
            y = at[1] if len(at) > 1 else rest["values"][found["position_name"]] / factor
            mark = {"symbol": "x", "size": 11, "line": {"width": 1}}
            point = look.points([at[0]], [y], "operating point", look.COLOURS[1], marker=mark)
            figure["data"].append(point)
        self._map_plot.draw(figure)

    def _clicked(self, point: Mapping[str, Any]) -> None:
        """Set the operating point to that place of the map."""
        with self.bench.shown_errors():
            found = self._map
            if found is None or point.get("curve") is None:
                return
            names = found["names"]
            values = [1e5 * float(point["x"])]
            if len(names) > 1:
                values.append(1e5 * float(point["y"]))
            where = {n: round(v, -2) for n, v in zip(names, values, strict=True)}
            self.bench.session.change("operating point", point=where)

    # ---- free vibration -------------------------------------------------------------------------
    def _swing_box(self) -> None:
        view = self.bench.session.view
        remember = self.bench.session.remember
        turning = self._arrangement in TURNING
        self._swing_plot = el.Plot(
            look.figure([], height=240),
            "Free vibration over time",
            empty="The position after the plant is let go: press Free response",
        )
        self._swing_scene = el.Scene("The plant, swinging", None, height=200)
        el.Field(
            "Let go beside rest by",
            view("Plant", "offset", 0.002),
            "rad" if turning else "m",
            lambda v: remember("Plant", offset=v),
            low=-1.0,
            high=1.0,
        )
        el.Field(
            "Cycles",
            view("Plant", "cycles", 12),
            "1",
            lambda v: remember("Plant", cycles=v),
            low=2,
            high=200,
            shown="1",
        )
        with ui.element("div").classes("bench-row"):
            el.button("Free response", self._swing)

    async def _swing(self) -> None:
        with self.bench.shown_errors():
            if not self.state["point"]:
                raise InputError("no operating point; give its pressures, or click into the map")
            found = await self.bench.work(
                "Free vibration",
                jobs.vibration,
                self.bench.folder,
                self.state,
                self.state["point"],
                self.bench.session.view("Plant", "offset", 0.002),
                self.bench.session.view("Plant", "cycles", 12),
                self.bench.allow_code,
                warm="plant",
            )
            self._swing_words.set_text(
                f"{found['frequency']:.4g} Hz, damping ratio {found['damping']:.3g}"
            )
            curve = look.line(found["t"], found["values"])
            name = f"{found['name']} [{found['unit']}]"
            margin = {"l": 56, "r": 12, "t": 8, "b": 40}
            self._swing_plot.draw(look.figure([curve], "time [s]", name, height=240, margin=margin))
            self._swing_scene.show(found["scene"], seconds=max(2.0, float(found["t"][-1])))

    # ---- loads ----------------------------------------------------------------------------------
    def _loads_box(self) -> None:
        self._masses = self.bench.session.view("Plant", "masses", "5, 10, 20, 50")
        self._levels = self.bench.session.view("Plant", "levels", "1, 2, 3, 4, 5, 6")
        self._study_plot = el.Plot(
            look.figure([], height=330),
            "Load study",
            empty="Position, stiffness, frequency and settling time over pressure, a curve for "
            "each mass: press Study the loads",
        )
        el.text_field("Masses [kg]", self._masses, lambda v: self._several("masses", v, "kg"))
        el.text_field("Pressures [bar]", self._levels, lambda v: self._several("levels", v, "bar"))
        with ui.element("div").classes("bench-row"):
            el.button("Study the loads", self._study)
        self._cases = ui.element("div")

    def _several(self, name: str, text: str, unit: str) -> None:
        with self.bench.shown_errors():
            _listed(text, unit)
            setattr(self, f"_{name}", text)
            self.bench.session.remember("Plant", **{name: text})

    async def _study(self) -> None:
        with self.bench.shown_errors():
            found = await self.bench.work(
                "Load study",
                jobs.loads,
                self.bench.folder,
                self.state,
                _listed(self._masses, "kg"),
                _listed(self._levels, "bar"),
                warm="plant",
            )
            self._study_plot.draw(_study_figure(found["cases"]))
            self._cases.clear()
            with self._cases, ui.expansion("Table").props("dense").classes("bench-note"):
                el.tag("pre", found["words"], "bench-pre")


def _listed(text: str, unit: str) -> list[float]:
    """SI values of numbers between commas. Raises InputError."""
    base = {"bar": "Pa"}.get(unit, unit)
    parts = [p.strip() for p in text.split(",") if p.strip()]
    if not 1 <= len(parts) <= 12:
        raise InputError(f"{text[:60]!r}: give one to twelve numbers in {unit}, between commas")
    return [quantity("value", p if p[-1].isalpha() else f"{p} {unit}", base) for p in parts]


def _curve(
    found: Mapping[str, Any], position: Any, stiffness: Any, words: str, felt: str
) -> dict[str, Any]:
    """One muscle: position against pressure, coloured by stiffness."""
    p = found["pressures"][0] / 1e5
    scale = {
        "color": look.numbers(stiffness),
        "colorscale": look.SCALE,
        "size": 8,
        "colorbar": {"title": {"text": f"stiffness [{felt}]"}, "thickness": 12, "outlinewidth": 0},
    }
    hover = f"%{{x:.3g}} bar, %{{y:.4g}}, k %{{marker.color:.4g}} {felt}<extra></extra>"
    data = [
        look.line(p, position, "", look.FAINT, hoverinfo="skip"),
        look.points(p, position, marker=scale, hovertemplate=hover),
    ]
    return look.figure(data, f"{found['names'][0]} [bar]", words, height=330, showlegend=False)


def _field(
    found: Mapping[str, Any], position: Any, stiffness: Any, words: str, felt: str
) -> dict[str, Any]:
    """Two muscles: position as colours over both pressures, stiffness as lines."""
    x, y = (look.numbers(p / 1e5) for p in found["pressures"])
    data: list[dict[str, Any]] = [
        {
            "type": "heatmap",
            "x": x,
            "y": y,
            "z": look.numbers(position),
            "customdata": look.numbers(stiffness),
            "colorscale": look.SCALE,
            "colorbar": {"title": {"text": words}, "thickness": 12, "outlinewidth": 0},
            "hovertemplate": "%{x:.3g} bar, %{y:.3g} bar: %{z:.4g}, "
            f"k %{{customdata:.4g}} {felt}<extra></extra>",
        },
        {
            "type": "contour",
            "x": x,
            "y": y,
            "z": look.numbers(stiffness),
            "contours": {"coloring": "none", "showlabels": True, "labelfont": {"color": "#ffffff"}},
            "line": {"width": 1, "color": "#ffffff"},
            "showscale": False,
            "hoverinfo": "skip",
        },
    ]
    names = [f"{n} [bar]" for n in found["names"]]
    return look.figure(data, names[0], names[1], height=330, showlegend=False)


def _study_figure(cases: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Four panels against pressure, a line for each load."""
    masses = sorted({c["mass"] for c in cases})
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    for j, (name, (title, factor)) in enumerate(STUDY.items()):
        axis = "" if j == 0 else str(j + 1)
        column, row = j % 2, j // 2
        for i, mass in enumerate(masses):
            own = [c for c in cases if c["mass"] == mass]
            one = look.line(
                [c["pressure"] / 1e5 for c in own],
                [c[name] * factor for c in own],
                f"{mass:g} kg",
                look.COLOURS[i % len(look.COLOURS)],
                mode="lines+markers",
                marker={"size": 5, "symbol": look.SYMBOLS[i % len(look.SYMBOLS)]},
            )
            shown = {"xaxis": f"x{axis}", "yaxis": f"y{axis}", "showlegend": j == 0}
            data.append(one | shown | {"legendgroup": str(mass)})
        side = {"gridcolor": look.GRID, "automargin": True}
        layout[f"xaxis{axis}"] = {
            **side,
            "domain": [0.55 * column, 0.55 * column + 0.45],
            "anchor": f"y{axis}",
            "title": {"text": "pressure [bar]", "font": {"size": 11}, "standoff": 4},
        }
        layout[f"yaxis{axis}"] = {
            **side,
            "domain": [0.6, 1.0] if row == 0 else [0.0, 0.4],
            "anchor": f"x{axis}",
            "title": {"text": title, "font": {"size": 11}},
        }
    legend = {"orientation": "h", "y": 1.1, "x": 0.0, "xanchor": "left", "font": {"size": 11}}
    return look.figure(data, height=430, legend=legend, **layout)
