"""The tab Plant: the arrangement to scale, what it is made of, its rest, vibration and loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from nicegui import events, ui

from ...core.errors import InputError
from ...core.quantities import quantity
from ...core.units import display_unit
from ...muscles.catalogue import muscle_names
from ...plants.kinds import PLANTS
from .. import elements as el
from .. import look
from ..elements import Menu, Number, Text
from ..form import argument_rows
from ..jobs import plant as jobs
from ..made import muscle_of, own_plants
from ..pictures import Plot, Scene
from ..tab import Tab

MOST_FILE = 2**20
"""Bytes of a file with a plant of one's own."""
CYCLES = Number("Cycles", low=2, high=200, shown="1")
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
        self._swing_of: Any = None
        self._map: dict[str, Any] | None = None
        self._rest: dict[str, Any] | None = None
        self._rest_of: Any = None
        with el.split():
            with el.side():
                with el.section("Arrangement") as self._words:
                    self._form = el.Form()
                    if self.bench.allow_code:
                        # a Python file that makes plants; a single one in it is chosen at once
                        words, say = "A plant of your own (.py)", self.bench.say
                        el.upload(words, self._dropped, say, most=MOST_FILE, accept=".py")
                with el.section("Operating point") as self._point_words:
                    self._point_form = el.Form()
            with el.plots():
                with el.section("To scale"):
                    self._scene = Scene("The plant, drawn to scale", height=300)
                with el.section("Equilibrium map") as self._map_words:
                    self._map_plot = Plot(
                        "Equilibrium map",
                        self._clicked,
                        empty="Position and stiffness over the pressures: press Compute the map",
                    )
                    with el.row():
                        el.button("Compute the map", self._compute_map)
                        el.tag("span", "A click sets the operating point.", "bench-note")
                with el.section("Free vibration") as self._swing_words:
                    self._swing_box()
                with el.section("Load study") as self._loads_words:
                    self._loads_box()
                self._values = el.box("At rest")
                self._variables = el.box("Variables")

    def update(self, changed: frozenset[str]) -> None:
        state = self.state
        made_of = [state["muscle"], state["plant"]]
        if made_of != self._made_of:
            self._made_of, self._what, self._map, self._rest_of = made_of, None, None, None
            if state["muscle"] is not None:
                self.bench.soon(self._outline())
            self._rest = None
            self._values.clear()
            self._draw_map()
            self._show_swing()
            self._clear_loads()
        if self._swing_of not in (None, self._swing_key):
            self._clear_swing()
        self._show_form()
        self._show_point()

    @property
    def _arrangement(self) -> str:
        return str(self.state["plant"]["arrangement"])

    # ---- the form -------------------------------------------------------------------------------
    def _show_form(self) -> None:
        said, name, muscle = self.state["plant"], self._arrangement, self.state["muscle"]
        own = own_plants(self.session.folder) if self.bench.allow_code else {}
        known = {**{n: n for n in PLANTS}, **own}
        known.setdefault(name, name)
        rows = [
            el.words("No muscle yet: fit or choose one in the tab Muscle.", "bench-bad")
            if muscle is None
            else el.words(f"muscle: {muscle.get('name', '')}"),
            (Menu("Arrangement", known), name, self._arranged),
        ]
        if name in PLANTS:
            rows += argument_rows(PLANTS, name, said, self._said, turning=name in TURNING)
            if "muscle2" in PLANTS.arguments(name):
                second = {"": "the same"} | {n: n for n in muscle_names()}
                act = partial(self._said, "muscle2")
                rows.append((Menu("second muscle", second), said.get("muscle2"), act))
        self._words.set_text(PLANTS.words(name) if name in PLANTS else "A plant of your own")
        self._form.show(rows)

    async def _dropped(self, event: events.UploadEventArguments) -> None:
        before = own_plants(self.session.folder)
        file = self.session.store(event.file.name, await event.file.read())
        made = [name for name in own_plants(self.session.folder) if name.startswith(f"{file}:")]
        if not made:
            raise InputError(
                f"{event.file.name} names no plant: at its top, define a Plant or a function "
                "that takes a muscle and returns one"
            )
        self._arranged(next((name for name in made if name not in before), made[0]))

    def _arranged(self, name: str) -> None:
        known = PLANTS.arguments(name) if name in PLANTS else {}
        kept = {k: v for k, v in self.state["plant"].items() if k in known and k != "set"}
        # what belongs to the other kind of motion would be in a unit of its own
        if (name in TURNING) != (self._arrangement in TURNING):
            kept = {k: v for k, v in kept.items() if k in ("feed", "losses")}
        plant = {**kept, "arrangement": name}
        self.session.change(f"arrangement {name}", plant=plant, point={})

    def _said(self, name: str, value: Any) -> None:
        """An argument of the plant; None takes it back."""
        rest = {k: v for k, v in self.state["plant"].items() if k != name}
        plant = rest if value in (None, "") else {**rest, name: value}
        self.session.change(name.replace("_", " "), plant=plant)

    # ---- the plant ------------------------------------------------------------------------------
    async def _outline(self) -> None:
        made_of = self._made_of
        try:
            what = await self.work(jobs.outline_of)
        except Exception:
            self._scene.set(scene=None)
            self._variables.clear()
            raise
        if made_of != self._made_of:
            return
        self._what = what
        scene = what["scene"]
        along = {"words": scene["along"], "unit": scene["unit"], "seconds": 3.0} if scene else {}
        self._scene.set(scene=scene, **along)
        self._variables.clear()
        with self._variables:
            rows = [
                (v["name"], v["causality"], _said(v["start"]), _unit(v["unit"]))
                for v in what["variables"]
                if v["causality"] != "constraint"
            ]
            el.table(["variable", "is", "start", "unit"], rows, label="Variables of the plant")
        self._show_point()

    # ---- the operating point --------------------------------------------------------------------
    def _show_point(self) -> None:
        self._point_words.set_text("")
        if self._what is None:
            self._point_form.show([])
            return
        point = self.state["point"]
        names = list(point) or self._what["pressures"]
        known = {name: Number(name, self._unit(name), optional=True) for name in names}
        rows = el.fields(known, {n: point.get(n) for n in names}, self._set)
        none = [] if point else [el.words("Give each pressure, or click into the map.")]
        self._point_form.show([*rows, *none])
        if point and point != self._rest_of:
            self._rest_of = dict(point)
            self.bench.soon(self._find_rest())
        elif not point:
            self._rest = None
            self._values.clear()
            self._draw_map()

    def _unit(self, name: str) -> str:
        """The SI unit of a variable that a condition names."""
        shown = next((v["unit"] for v in (self._what or {})["variables"] if v["name"] == name), "1")
        base = {display_unit(u): u for u in ("Pa", "m", "rad", "Pa/s", "rad/s")}
        return base.get(shown, shown)

    def _set(self, name: str, value: float | None) -> None:
        names = list(self.state["point"]) or (self._what or {})["pressures"]
        point = {**dict.fromkeys(names, value), **self.state["point"], name: value}
        self.session.change("operating point", point={} if value is None else point)

    async def _find_rest(self) -> None:
        point, made_of = dict(self.state["point"]), self._made_of
        self._rest = None
        self._values.clear()
        self._draw_map()
        try:
            found = await self.work(jobs.rest, point)
        except Exception:
            if (point, made_of) == (self.state["point"], self._made_of):
                self._point_words.set_text("no rest there")
            raise
        if (point, made_of) != (self.state["point"], self._made_of):
            return
        self._rest = found
        self._point_words.set_text(found["stability"])
        self._values.clear()
        with self._values:
            rows = [(n, f"{v:.6g}", _unit(u)) for n, v, u in found["shown"]]
            el.table(["variable", "value", "unit"], rows, label="Values at rest")
            for frequency, damping in found["modes"]:
                el.note(f"swings at {frequency:.4g} Hz, damping ratio {damping:.3g}")
        self._draw_map()

    # ---- the map --------------------------------------------------------------------------------
    async def _compute_map(self) -> None:
        muscle_of(self.world)
        made_of = self._made_of
        found = await self.work(jobs.equilibrium_map)
        if made_of == self._made_of:
            self._map = found
            self._draw_map()

    def _draw_map(self) -> None:
        found, rest = self._map, self._rest
        if found is None:
            self._map_words.set_text("")
            self._map_plot.clear()
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
        found = self._map
        if found is None or point.get("curve") is None:
            return
        axes = [float(point[axis]) for axis in "xy"[: len(found["names"])]]
        where = {n: round(1e5 * v, -2) for n, v in zip(found["names"], axes, strict=True)}
        self.session.change("operating point", point=where)

    # ---- free vibration -------------------------------------------------------------------------
    def _swing_box(self) -> None:
        self._swing_plot = Plot(
            "Free vibration over time",
            empty="The position after the plant is let go: press Free response",
        )
        self._swing_scene = Scene("The plant, swinging", height=200)
        self._swing_form = el.Form()
        self._show_swing()

    def _show_swing(self) -> None:
        unit = "rad" if self._arrangement in TURNING else "m"
        offset = Number("Let go beside rest by", unit, -1.0, 1.0)
        self._swing_form.show(
            [
                (offset, self._offset, lambda v: self._set_swing(offset=v)),
                (CYCLES, self._count, lambda v: self._set_swing(cycles=v)),
                el.buttons({"Free response": self._swing}),
            ]
        )

    @property
    def _offset(self) -> float:
        return float(self.view("offset", 0.002))

    @property
    def _count(self) -> float:
        return float(self.view("cycles", 12))

    def _set_swing(self, **values: float) -> None:
        self.remember(**values)
        if self._swing_of not in (None, self._swing_key):
            self._clear_swing()

    @property
    def _swing_key(self) -> list[Any]:
        """All that the free vibration depends on."""
        return [self._made_of, self.state["point"], self._offset, self._count]

    def _clear_swing(self) -> None:
        self._swing_of = None
        self._swing_plot.clear()
        self._swing_scene.set(scene=None)
        self._swing_words.set_text("")

    async def _swing(self) -> None:
        if not self.state["point"]:
            raise InputError("no operating point; give its pressures, or click into the map")
        key = self._swing_key
        found = await self.work(jobs.vibration, self._offset, self._count)
        if key != self._swing_key:
            return
        self._swing_of = key
        self._swing_words.set_text(
            f"{found['frequency']:.4g} Hz, damping ratio {found['damping']:.3g}"
        )
        curve = look.line(found["t"], found["values"])
        name = f"{found['name']} [{found['unit']}]"
        margin = {"l": 56, "r": 12, "t": 8, "b": 40}
        self._swing_plot.draw(look.figure([curve], "time [s]", name, height=240, margin=margin))
        self._swing_scene.set(scene=found["scene"], seconds=max(2.0, float(found["t"][-1])))

    # ---- loads ----------------------------------------------------------------------------------
    def _loads_box(self) -> None:
        self._masses = self.view("masses", "5, 10, 20, 50")
        self._levels = self.view("levels", "1, 2, 3, 4, 5, 6")
        self._study_plot = Plot(
            "Load study",
            empty="Position, stiffness, frequency and settling time over pressure, a curve for "
            "each mass: press Study the loads",
        )
        masses, levels = Text("Masses [kg]"), Text("Pressures [bar]")
        el.Form().show(
            [
                (masses, self._masses, partial(self._several, "masses", "kg")),
                (levels, self._levels, partial(self._several, "levels", "bar")),
                el.buttons({"Study the loads": self._study}),
            ]
        )
        self._cases = ui.element("div")

    def _several(self, name: str, unit: str, text: str) -> None:
        _listed(text, unit)
        setattr(self, f"_{name}", text)
        self.remember(**{name: text})
        self._clear_loads()

    def _clear_loads(self) -> None:
        self._study_plot.clear()
        self._loads_words.set_text("")
        self._cases.clear()

    async def _study(self) -> None:
        made_of, said = self._made_of, (_listed(self._masses, "kg"), _listed(self._levels, "bar"))
        found = await self.work(jobs.loads, *said)
        now = self._made_of, (_listed(self._masses, "kg"), _listed(self._levels, "bar"))
        if now != (made_of, said):
            return
        self._study_plot.draw(_study_figure(found["cases"]))
        self._cases.clear()
        with self._cases, ui.expansion("Table").props("dense").classes("bench-note"):
            el.tag("pre", found["words"], "bench-pre")


def _said(start: float | None) -> str:
    return "" if start is None else f"{start:.5g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _listed(text: str, unit: str) -> list[float]:
    """SI values of numbers between commas. Raises InputError."""
    base = {"bar": "Pa"}.get(unit, unit)
    parts = el.parts_of(text)
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
        "colorbar": look.scale(f"stiffness [{felt}]"),
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
            "colorbar": look.scale(words),
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
                look.colour(i),
                mode="lines+markers",
                marker={"size": 5, "symbol": look.symbol(i)},
            )
            shown = {"xaxis": f"x{axis}", "yaxis": f"y{axis}", "showlegend": j == 0}
            data.append(one | shown | {"legendgroup": str(mass)})
        across = [0.55 * column, 0.55 * column + 0.45]
        layout[f"xaxis{axis}"] = look.axis("pressure [bar]", domain=across, anchor=f"y{axis}")
        up = [0.6, 1.0] if row == 0 else [0.0, 0.4]
        layout[f"yaxis{axis}"] = look.axis(title, domain=up, anchor=f"x{axis}")
    return look.figure(data, height=430, **layout, **look.ABOVE)
