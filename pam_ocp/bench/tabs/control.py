"""The tab Control: a controller about the operating point, its linear loop as gains move, a run
against the plant, and one in real time under the hand.

What a controller says of itself: jobs/control.py.
"""

from __future__ import annotations

import asyncio
import copy
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..elements import Menu, Number, Slide, Text
from ..jobs import control as jobs
from ..made import made_of_loop, plant_of
from ..pictures import Plot, Scene, Strip
from ..script import PUSH, can_be_pushed
from ..tab import Members

Said = dict[str, Any]
KINDS = {"pid": "PID on position", "lqr": "LQR, with an integral", "mpc": "model predictive"}
SAMPLE_TIME = Number("Sample time", "s", 1e-4, 0.1, shown="ms")
LINEAR = "about the operating point, of a PID or LQR; a predictive controller has none"
DECADES = 2.0
"""Of a gain's slider, to either side of where it begins."""
BEAT = 0.05
"""[s] between two pieces of a run in real time."""
LONGEST = 0.25
"""[s] of such a piece; where more has gone by, the run is slower than the clock."""
PULL = 0.25
"""[N] of a push per pixel that the plant is pulled."""


class Control(Members):
    """Controllers of the session, one of them at hand."""

    title = "Control"
    part = "controllers"
    parts = ("muscle", "plant", "point", "controllers")

    def build(self) -> None:
        self._design: Said | None = None
        self._keys: dict[str, Any] = {}
        self._runs = False
        self._push = 0.0
        self._goal: float | None = None
        self._factor = 1.0
        with el.split():
            with el.side():
                self._point_form = el.form("Operating point")
                self._form = el.form("Controller")
                self._gains_form = el.form("Gains", classes="bench-words")
                self._study_form = el.form("Run against the plant")
            with el.plots():
                with (
                    el.section("Live", wide=True),
                    ui.element("div").classes("bench-live"),
                ):
                    self._make_live()
                with el.section("Poles"):
                    self._margins = el.Verdict()
                    self._poles = Plot(
                        "Poles of the loop",
                        empty="The poles of plant and loop: make a controller",
                    )
                with el.section("Step of the linear loop"):
                    self._step = Plot("Step response", empty=f"The answer to a step {LINEAR}")
                with el.section("Bode, open loop", wide=True):
                    self._bode = Plot(
                        "Bode plot of the open loop", empty=f"Gain and phase {LINEAR}"
                    )
                with el.section("The run", wide=True):
                    self._run_said = el.Verdict()
                    self._plot = Plot(
                        "The closed loop over time",
                        empty="The run against the plant: make a controller",
                    )

    def update(self, changed: frozenset[str]) -> None:
        if changed & {"muscle", "plant", "point"}:
            self._stop()
            self._push = 0.0
        self._show()
        if self._ready:
            self.bench.soon(self._design_it())
            self.bench.soon(self._run_it())
        elif self._keys:
            self._clear()

    def close(self) -> None:
        self._runs = False

    def _clear(self) -> None:
        """Nothing is shown of a controller that is gone."""
        self._stop()
        self._keys = {}
        for plot in (self._poles, self._step, self._bode, self._plot):
            plot.clear()
        for verdict in (self._margins, self._run_said):
            verdict.say()

    # ---- what is at hand ------------------------------------------------------------------------
    @property
    def _ready(self) -> bool:
        has = self.state["muscle"] is not None and bool(self.state["point"])
        return has and self.at_hand is not None

    def _made_of(self, said: Said | None) -> Any:
        """All that a loop's figures depend on."""
        return copy.deepcopy(made_of_loop(self.state, said))

    # ---- drawing --------------------------------------------------------------------------------
    def _show(self) -> None:
        shown = (self._point_form, self._form, self._gains_form, self._study_form)
        with self.rows(*shown) as rows:
            if self.state["muscle"] is None:
                rows[0] = self.without_muscle("A controller")
                return
            plant, said = plant_of(self.world), self.at_hand
            rows[0] = self._point_rows(plant)
            if not self.state["point"]:
                return
            rows[1] = self._rows(said)
            if said is not None:
                rows[2], rows[3] = self._gain_rows(said, plant), self._study_rows(said, plant)
                self._show_live(plant)

    def _point_rows(self, plant: Plant) -> list[el.Row]:
        point = self.state["point"]
        if not point:
            middle = {"Centre position": lambda: self._set_point(**jobs.first_point(plant))}
            return [
                el.words("None yet: click on the map in the tab Plant, or begin in mid stroke."),
                el.buttons(middle, main="Centre position"),
            ]
        variables = [plant.variable(name) for name in point]
        known = {v.name: Number(v.name, v.unit, v.min, v.max) for v in variables}
        return el.fields(known, point, lambda name, value: self._set_point(**{name: value}))

    def _set_point(self, **values: float) -> None:
        self.session.change("operating point", point={**self.state["point"], **values})

    def _rows(self, said: Said | None) -> list[el.Row]:
        acts: dict[str, Any] = {f"New {kind.upper()}": partial(self._new, kind) for kind in KINDS}
        names = {f"New {k.upper()}": f"New {k.upper()}: {words}" for k, words in KINDS.items()}
        if said is None:
            return [el.words("None yet."), el.buttons(acts, names=names)]
        return [
            (Menu("Controller", self.names), said["id"], self._choose),
            (Text("Name"), said["name"], self.rename),
            (
                SAMPLE_TIME,
                said["sample_time"],
                lambda v: self.change("sample time", sample_time=v),
            ),
            el.buttons({**acts, "Delete": self.drop}, names=names),
        ]

    def _choose(self, id: str) -> None:
        self._stop()
        self.choose(id)

    def _new(self, kind: str) -> None:
        plant, id = plant_of(self.world), self.session.fresh_id("controllers")
        self.add(jobs.first_controller(plant, self.state["point"], kind, id))

    # ---- gains ----------------------------------------------------------------------------------
    def _gain_rows(self, said: Said, plant: Plant) -> list[el.Row]:
        """On a scale of decades, as gains are moved."""
        units, rows = gain_units(said["kind"], plant), []
        for name, (words, usual) in jobs.GAINS[said["kind"]].items():
            unit, factor = units.get(name, ("", 1.0))
            shown = float(said["gains"][name]) * factor
            if name == "horizon":
                slide = Slide(words, 2, 100, of=said["id"])
            else:
                middle = shown if shown > 0 else about(name, said, units, usual)
                ends = middle * 10**-DECADES, middle * 10**DECADES
                slide = Slide(words, *ends, unit, log=True, of=said["id"])
            acts = partial(self._slide, name, factor), partial(self._settle, name, factor)
            rows.append((slide, shown, acts))
        if said["kind"] == "lqr":
            rows.append(el.words("Weights of squares scaled by nominals: more effort, less gain."))
        return rows

    def _moved(self, name: str, value: float) -> Said | None:
        if not np.isfinite(value) or value < 0:
            return None
        value = float(np.clip(round(value), 2, 200)) if name == "horizon" else value
        return {**self.held, "gains": {**self.held["gains"], name: value}}

    def _slide(self, name: str, factor: float, shown: float) -> None:
        moved = self._moved(name, shown / factor)
        if moved is not None and moved["kind"] != "mpc":
            self.bench.soon(self._design_it(moved))

    def _settle(self, name: str, factor: float, shown: float) -> None:
        moved = self._moved(name, shown / factor)
        if moved is not None:
            self.change(f"gain {name}", gains=moved["gains"])

    async def _design_it(self, said: Said | None = None) -> None:
        said = said or self.at_hand
        key = self._made_of(said)
        if said is None or not self._ready or self._keys.get("design") == key:
            return
        self._keys["design"] = key
        try:
            self._design = await self.work(jobs.designed, said)
        except Exception:
            if self._keys.get("design") == key:  # nothing is shown beside other gains
                del self._keys["design"]
                self._margins.say()
                for plot in (self._poles, self._step, self._bode):
                    plot.clear()
            raise
        if self._keys.get("design") == key:
            self._show_design(said)

    def _show_design(self, said: Said) -> None:
        found = self._design or {}
        self._poles.draw(poles_figure(found))
        self._step.draw(step_figure(found, said))
        self._bode.draw(bode_figure(found))
        if not self._runs and "rest" in found:
            self._goal = found["rest"]
            self._strip.set(reference=found["rest"] / self._factor)
        if "margins" not in found:
            self._margins.say("A predictive controller has no linear loop: run it.")
            return
        m = found["margins"]
        words = [
            "stable" if found["stable"] else "UNSTABLE",
            f"gain margin {figure_said(m['gain'], 'dB')}",
            f"phase margin {figure_said(m['phase'], 'deg')}",
            f"crossover {figure_said(m['crossover'], 'Hz')}",
        ]
        if "overshoot" in found:
            words.append(f"overshoot {100 * max(found['overshoot'], 0.0):.3g} %")
        self._margins.say(", ".join(words), bool(found["stable"]))

    # ---- a run ----------------------------------------------------------------------------------
    def _study_rows(self, said: Said, plant: Plant) -> list[el.Row]:
        v = plant.variable(next(iter(plant.positions)))
        force = "N" if v.unit == "m" else "N.m"
        known = {
            "step": Number(f"Step of {v.name}", v.unit),
            "duration": Number("Duration", "s", 0.01, 20.0, shown="s"),
            "push": Number("Push", force),
            "push_from": Number("Push from", "s", 0.0, 20.0, shown="s"),
            "noise": Number(f"Noise of {v.name}", v.unit, 0.0, hint="standard deviation"),
        }
        return el.fields(
            known,
            said["study"],
            lambda name, value: self.change_in(f"{name} of the run", "study", name, value),
        )

    async def _run_it(self) -> None:
        said = self.at_hand
        key = self._made_of(said)
        if said is None or not self._ready or self._keys.get("run") == key:
            return
        self._keys["run"] = key
        self._run_said.say("running ...")
        self._plot.clear()
        try:
            found = await self.work(jobs.closed, said, of=said["name"])
        except Exception as error:
            if self._keys.get("run") == key:
                del self._keys["run"]
                self._run_said.say(self.bench.words(str(error)), False)
            raise
        if self._keys.get("run") == key:
            self._run_said.say(found["words"])
            self._plot.draw(run_figure(found))
            self.keep_figures(said["id"], key, found["figures"])

    # ---- live -----------------------------------------------------------------------------------
    def _make_live(self) -> None:
        with el.row():
            self._start = el.button("Start", self._turn, main=True)
            against = Menu("Against", {"plant": "the plant", "fmu": "its FMU"})
            el.Form().show([(against, self.view("against", "plant"), self._set_against)])
            self._rate = el.tag("span", "", "bench-note")
        with ui.element("div").classes("bench-live-parts"):
            self._strip = Strip("What is reached and what is to be reached", self._set_goal)
            with ui.element("div"):
                self._film = Scene(
                    "The plant as it stands; pull it with the pointer",
                    height=240,
                    pull=self._pulled,
                )
                self._push_form = el.Form()
        el.note(
            "Press Start. Then drag the arrow at the right edge, or use its arrow keys: the "
            "reference. Pull the plant with the pointer, type a push, move gains: the run goes on."
        )

    def _show_live(self, plant: Plant) -> None:
        v = plant.variable(next(iter(plant.positions)))
        self._factor = v.display_factor
        inputs = []
        for i, u in enumerate(u for u in plant.inputs if not u.disturbance):
            low, high = _ends(u)
            more = {"colour": look.colour(i), "dash": "" if i == 0 else "6 3"}
            inputs.append({"name": u.name, "unit": u.display_unit, "low": low, "high": high} | more)
        low, high = _ends(v)
        self._strip.set(low=low, high=high, unit=v.display_unit, variable=v.name, inputs=inputs)
        self._push_of = "N" if v.unit == "m" else "N.m"
        self._show_push()

    def _show_push(self) -> None:
        if can_be_pushed(self.state["plant"]):
            push = Number("Push, until changed", self._push_of)
            self._push_form.show([(push, self._push, lambda v: setattr(self, "_push", v))])
        else:
            self._push = 0.0
            self._push_form.show([el.words("This arrangement takes no push.")])

    def _set_goal(self, shown: float) -> None:
        if np.isfinite(shown):
            self._goal = shown * self._factor

    def _pulled(self, by: Said) -> None:
        """Towards the positive side of the picture: right, or up where it hangs."""
        x, y = (by.get(k) for k in ("x", "y"))
        if not can_be_pushed(self.state["plant"]):
            return
        if isinstance(x, int | float) and isinstance(y, int | float) and np.isfinite(x + y):
            self._push = float(np.clip(PULL * (x if abs(x) > abs(y) else y), -500.0, 500.0))
            self._show_push()

    def _set_against(self, value: str) -> None:
        self.remember(against=value)
        self._stop()

    def _turn(self) -> None:
        if self._runs:
            self._stop()
        elif self._ready:
            self._runs = True
            self._start.set_text("Stop")
            self.bench.soon(self._keep_running())
        else:
            self.bench.say("Choose an operating point and a controller first")

    def _stop(self) -> None:
        self._runs = False
        self._start.set_text("Start")
        self._rate.set_text("")

    async def _keep_running(self) -> None:
        """Piece after piece, each as long as the one before took."""
        name = f"{time.time():.6f}"
        against = self.view("against", "plant")
        last, simulated, clock = time.monotonic(), 0.0, 0.0
        self._rate.set_text("starting: what runs is built ...")
        try:
            while self._runs and self._ready:
                said = self.at_hand
                assert said is not None
                now = time.monotonic()
                wanted, last = now - last, now
                seconds = float(np.clip(wanted, BEAT, LONGEST))
                ask = {"run": name, "seconds": seconds, "push": self._push, "reference": self._goal}
                kept = {k: said[k] for k in ("kind", "gains", "sample_time")}
                found = await self.work(jobs.live, {**kept, "against": against}, ask)
                self._strip.add({k: found[k] for k in ("t", "rows", "restart")})
                self._film.set(scene=found["scene"])
                took = time.monotonic() - now
                if found["built"]:  # in which all is built: no measure of what follows
                    last, simulated, clock = time.monotonic(), 0.0, 0.0
                    continue
                simulated = 0.9 * simulated + seconds
                clock = 0.9 * clock + max(took, BEAT)
                self._rate.set_text(f"{simulated / clock:.2f} of real time")
                await asyncio.sleep(max(0.0, BEAT - took))
        finally:
            self._stop()


def _ends(variable: Any) -> list[float]:
    """Of the range as it is shown; 0 where it is open."""
    ends = (e / variable.display_factor for e in (variable.min, variable.max))
    return [float(e) if np.isfinite(e) else 0.0 for e in ends]


# ---- words and pictures --------------------------------------------------------------------------
def gain_units(kind: str, plant: Plant) -> dict[str, tuple[str, float]]:
    """{gain: (unit shown, shown value per SI value)} of a PID."""
    if kind != "pid":
        return {}
    v = plant.variable(next(iter(plant.positions)))
    u = next(u for u in plant.in_openings().inputs if not u.disturbance)
    unit = u.display_unit if u.display_unit != "1" else ""
    factor = v.display_factor / u.display_factor
    per = f"{unit or '1'}/{v.display_unit}"
    return {
        "proportional": (per, factor),
        "integral": (f"{per}/s", factor),
        "derivative": (f"{per} s", factor),
    }


def about(name: str, said: Said, units: Mapping[str, tuple[str, float]], usual: float) -> float:
    """Where the slider of a gain that is 0 begins."""
    if said["kind"] != "pid":
        return usual or 1.0
    shown = said["gains"]["proportional"] * units["proportional"][1]
    return float(f"{shown * {'derivative': 0.01, 'integral': 1.0}.get(name, 1.0) or 1.0:.2g}")


def figure_said(value: float | None, unit: str) -> str:
    return "unlimited" if value is None else f"{value:.3g} {unit}"


def poles_figure(found: Said) -> Said:
    data = []
    for key, words, symbol, colour in (
        ("open", "plant", "x-thin-open", look.FAINT),
        ("poles", "closed loop", "x", look.COLOURS[0]),
    ):
        if key in found:
            marker = {"symbol": symbol, "size": 9, "line": {"width": 2, "color": colour}}
            data.append(
                look.points(found[key]["re"], found[key]["im"], words, colour, marker=marker)
            )
    return look.figure(data, "real part [1/s]", "imaginary part [1/s]", height=300, **look.ABOVE)


def step_figure(found: Said, said: Said) -> Said:
    data = []
    if "step" in found:
        t = found["step"]["t"]
        data = [
            look.line(t, [1.0] * len(t), "wanted", look.FAINT, line={"dash": "dash"}),
            look.line(t, found["step"]["y"], "reached"),
        ]
    return look.figure(data, "time [s]", "position per step [1]", height=330, **look.ABOVE)


def bode_figure(found: Said) -> Said:
    log = {"type": "log"}
    if "hertz" not in found:
        return look.figure([])
    data = [look.line(found["hertz"], found["magnitude"], "gain", look.COLOURS[0])]
    if "phase" not in found:
        words = "largest gain of all inputs [dB]"
        return look.figure(data, "frequency [Hz]", words, height=300, xaxis=log)
    data.append(
        look.line(
            found["hertz"],
            found["phase"],
            "phase",
            look.COLOURS[1],
            yaxis="y2",
            line={"dash": "dash"},
        )
    )
    right = look.axis("phase [deg]", overlaying="y", side="right", showgrid=False)
    return look.figure(
        data, "frequency [Hz]", "gain [dB]", height=320, xaxis=log, yaxis2=right, **look.ABOVE
    )


def run_figure(found: Said) -> Said:
    position, t = found["position"], found["t"]
    first = [look.line(t, found["columns"][position], position, look.COLOURS[0])]
    if found["reference"] is not None:
        dashed = {"dash": "dash"}
        first.insert(0, look.line(t, found["reference"], "wanted", look.FAINT, line=dashed))
    # a push of nothing says nothing
    inputs = [n for n in found["inputs"] if n != PUSH or any(found["columns"][n])]
    rows: dict[str, list[Said]] = {found["units"][n]: [] for n in inputs}
    for i, name in enumerate(inputs):
        colour = look.colour(i + 1)
        rows[found["units"][name]].append(look.line(t, found["columns"][name], name, colour))
    titles = {unit: "openings" if unit == "1" else f"inputs [{unit}]" for unit in rows}
    return look.panels(
        [
            (f"{position} [{found['units'][position]}]", first),
            *((titles[unit], curves) for unit, curves in rows.items()),
        ],
        "time [s]",
        hovermode="x",
    )
