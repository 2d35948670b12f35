"""The tab Control: a controller about the operating point, its linear loop as gains move, a run
against the plant, and one in real time under the hand.

What a controller says of itself: jobs/control.py.
"""

from __future__ import annotations

import asyncio
import copy
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..jobs import control as jobs
from ..live import Strip
from ..made import plant_of
from ..script import can_be_pushed, control_lines
from ..tab import Tab
from .control_shown import (
    about,
    bode_figure,
    figure_said,
    gain_units,
    poles_figure,
    run_figure,
    step_figure,
)

__all__ = ["Control"]

Said = dict[str, Any]
KINDS = {"pid": "PID on position", "lqr": "LQR, with an integral", "mpc": "model predictive"}
LINEAR = "about the operating point, of a PID or LQR; a predictive controller has none"
DECADES = 2.0
"""Of a gain's slider, to either side of where it begins."""
BEAT = 0.05
"""[s] between two pieces of a run in real time."""
LONGEST = 0.25
"""[s] of such a piece; where more has gone by, the run is slower than the clock."""
PULL = 0.25
"""[N] of a push per pixel that the plant is pulled."""


class Control(Tab):
    """Controllers of the session, one of them at hand."""

    title = "Control"
    parts = ("muscle", "plant", "point", "controllers")

    def build(self) -> None:
        self._design: Said | None = None
        self._run: Said | None = None
        self._keys: dict[str, Any] = {}
        self._runs = False
        self._push = 0.0
        self._drawn_form: Any = None
        self._fields: dict[str, el.Field] = {}
        self._sliders: dict[str, tuple[el.Slider, float]] = {}
        self._goal: float | None = None
        self._factor = 1.0
        with el.split():
            with el.side():
                with el.section("Operating point"):
                    self._point_box = ui.element("div")
                with el.section("Controller"):
                    self._list = ui.element("div")
                with el.section("Gains"):
                    self._gains_box = ui.element("div").classes("bench-words")
                with el.section("Run against the plant"):
                    self._study_box = ui.element("div")
            with el.plots():
                with el.section("Live", wide=True) as self._live_words:
                    self._live_box = ui.element("div").classes("bench-live")
                    with self._live_box:
                        self._make_live()
                with el.section("Poles"):
                    self._margins = el.note("", "bench-verdict")
                    self._margins._props["aria-live"] = "polite"
                    self._poles = _plot(
                        "Poles of the loop", "The poles of plant and loop: make a controller"
                    )
                with el.section("Step of the linear loop"):
                    self._step = _plot("Step response", f"The answer to a step {LINEAR}")
                with el.section("Bode, open loop", wide=True):
                    self._bode = _plot("Bode plot of the open loop", f"Gain and phase {LINEAR}")
                with el.section("The run", wide=True):
                    self._run_said = el.note("", "bench-verdict")
                    self._plot = _plot(
                        "The closed loop over time", "The run against the plant: make a controller"
                    )
        self.update(frozenset(self.parts))

    def update(self, changed: frozenset[str]) -> None:
        if changed & {"muscle", "plant", "point"}:
            self._stop()
        if self._form() == self._drawn_form:
            self._set_fields()
        else:
            self._show()
        if self._ready:
            self.bench.soon(self._design_it)
            self.bench.soon(self._run_it)
        elif self._keys:
            self._clear()

    def close(self) -> None:
        self._runs = False

    def _clear(self) -> None:
        """Nothing is shown of a controller that is gone."""
        self._stop()
        self._keys = {}
        for plot in (self._poles, self._step, self._bode, self._plot):
            plot.draw(look.figure([]))
        for words in (self._margins, self._run_said):
            words.set_text("")

    @staticmethod
    def lines(state: dict[str, Any]) -> Sequence[str]:
        return control_lines(state)

    # ---- what is at hand ------------------------------------------------------------------------
    @property
    def _controller(self) -> Said | None:
        controllers = self.state["controllers"]
        chosen = self.bench.session.item(
            "controllers", self.bench.session.view("Control", "chosen")
        )
        return chosen or (controllers[-1] if controllers else None)

    @property
    def _ready(self) -> bool:
        has = self.state["muscle"] is not None and bool(self.state["point"])
        return has and self._controller is not None

    def _plant(self) -> Plant:
        return plant_of(self.bench.folder, self.state, allow_code=self.bench.allow_code)

    def _told_state(self) -> Said:
        return {k: self.state[k] for k in ("plant", "muscle", "point")}

    def _change(self, label: str, **values: Any) -> None:
        with self.bench.shown_errors():
            said = self._controller
            if said is not None:
                self.bench.session.put(label, "controllers", {**said, **values})

    def _form(self) -> Any:
        """All that fields and buttons depend on, but the numbers that they show."""
        said = self._controller
        names = [(c["id"], c["name"]) for c in self.state["controllers"]]
        at_hand = said and (said["id"], said["kind"])
        point = list(self.state["point"])
        return copy.deepcopy([self.state["muscle"], self.state["plant"], point, names, at_hand])

    def _set_fields(self) -> None:
        said = self._controller
        for name, field in self._fields.items():
            if name in self.state["point"]:
                field.set(self.state["point"][name])
            elif said is not None:
                field.set(said["sample_time"] if name == "sample_time" else said["study"][name])
        if said is not None:
            for name, (slider, factor) in self._sliders.items():
                slider.set(float(said["gains"][name]) * factor)

    # ---- drawing --------------------------------------------------------------------------------
    def _show(self) -> None:
        for box in (self._point_box, self._list, self._gains_box, self._study_box):
            box.clear()
        self._fields, self._sliders, self._drawn_form = {}, {}, None
        if self.state["muscle"] is None:
            with self._point_box:
                el.note("A controller needs a muscle: choose or fit one in the tab Muscle.")
                el.button("To the tab Muscle", lambda: self.bench.open("Muscle"))
            return
        with self.bench.shown_errors():
            plant = self._plant()
            with self._point_box:
                self._point_fields(plant)
            if not self.state["point"]:
                return
            with self._list:
                self._choices(plant)
            said = self._controller
            if said is None:
                return
            with self._gains_box:
                self._gains(said, plant)
            with self._study_box:
                self._study(said, plant)
            self._show_live(plant)
            self._drawn_form = self._form()

    def _point_fields(self, plant: Plant) -> None:
        point = self.state["point"]
        if not point:
            el.note("None yet: click on the map in the tab Plant, or begin in mid stroke.")
            el.button("Centre position", self._middle, main=True)
            return
        for name, value in point.items():
            v = plant.variable(name)
            self._fields[name] = el.Field(
                name, value, v.unit, self._point_act(name), low=v.min, high=v.max
            )

    def _middle(self) -> None:
        with self.bench.shown_errors():
            point = jobs.first_point(self._plant())
            self.bench.session.change("operating point", point=point)

    def _point_act(self, name: str) -> Callable[[Any], None]:
        def act(value: Any) -> None:
            with self.bench.shown_errors():
                point = {**self.state["point"], name: value}
                self.bench.session.change("operating point", point=point)

        return act

    def _choices(self, plant: Plant) -> None:
        said = self._controller
        if said is None:
            el.note("None yet.")
        else:
            names = {c["id"]: c["name"] for c in self.state["controllers"]}
            el.choice("Controller", names, said["id"], self._choose)
            el.text_field("Name", said["name"], lambda v: self._change("rename", name=v[:60]))
            self._fields["sample_time"] = el.Field(
                "Sample time",
                said["sample_time"],
                "s",
                lambda v: self._change("sample time", sample_time=v),
                low=1e-4,
                high=0.1,
                shown="ms",
            )
        with ui.element("div").classes("bench-row").style("margin-top: 6px"):
            for kind, words in KINDS.items():
                name = f"New {kind.upper()}"
                el.button(name, lambda kind=kind: self._new(kind), aria_label=f"{name}: {words}")
            if said is not None:
                el.button("Delete", self._delete)

    def _choose(self, id: str) -> None:
        self._stop()
        self.bench.session.remember("Control", chosen=id)
        self.update(frozenset(("controllers",)))

    def _new(self, kind: str) -> None:
        with self.bench.shown_errors():
            session = self.bench.session
            id = session.fresh_id("controllers")
            made = jobs.first_controller(self._plant(), self.state["point"], kind, id)
            session.remember("Control", chosen=id)
            session.put(f"add {made['name']}", "controllers", made)

    def _delete(self) -> None:
        said = self._controller
        if said is not None:
            with self.bench.shown_errors():
                self.bench.session.drop(f"delete {said['name']}", "controllers", said["id"])

    # ---- gains ----------------------------------------------------------------------------------
    def _gains(self, said: Said, plant: Plant) -> None:
        """On a scale of decades, as gains are moved."""
        units = gain_units(said["kind"], plant)
        for name, (words, usual) in jobs.GAINS[said["kind"]].items():
            value = float(said["gains"][name])
            if name == "horizon":
                still = partial(self._moved, name)
                self._sliders[name] = (
                    el.Slider(words, value, 2, 100, "", still, partial(self._settle, name, 1.0)),
                    1.0,
                )
                continue
            unit, factor = units.get(name, ("", 1.0))
            shown = value * factor
            middle = shown if shown > 0 else about(name, said, units, usual)
            slider = el.Slider(
                words,
                shown,
                middle * 10**-DECADES,
                middle * 10**DECADES,
                unit,
                partial(self._slide, name, factor),
                partial(self._settle, name, factor),
                log=True,
            )
            self._sliders[name] = slider, factor
        if said["kind"] == "lqr":
            el.note("Weights of squares scaled by nominals: more effort, less gain.")

    def _moved(self, name: str, value: float) -> Said | None:
        said = self._controller
        if said is None or not np.isfinite(value) or value < 0:
            return None
        value = float(np.clip(round(value), 2, 200)) if name == "horizon" else value
        return {**said, "gains": {**said["gains"], name: value}}

    def _slide(self, name: str, factor: float, shown: float) -> None:
        moved = self._moved(name, shown / factor)
        if moved is not None and moved["kind"] != "mpc":
            self.bench.soon(lambda: self._design_it(moved))

    def _settle(self, name: str, factor: float, shown: float) -> None:
        moved = self._moved(name, shown / factor)
        if moved is not None:
            self._change(f"gain {name}", gains=moved["gains"])

    async def _design_it(self, said: Said | None = None) -> None:
        said = said or self._controller
        key = copy.deepcopy([self._told_state(), said])
        if said is None or not self._ready or self._keys.get("design") == key:
            return
        self._keys["design"] = key
        self._design = await self.bench.work(
            "Linear loop",
            jobs.designed,
            self.bench.folder,
            self._told_state(),
            said,
            self.bench.allow_code,
            quiet=True,
            warm="control",
            latest="gains",
            time_limit=60.0,
        )
        if self._keys["design"] == key:
            self._show_design(said)

    def _show_design(self, said: Said) -> None:
        found = self._design or {}
        self._poles.draw(poles_figure(found))
        self._step.draw(step_figure(found, said))
        self._bode.draw(bode_figure(found))
        if not self._runs and "rest" in found:
            self._goal = found["rest"]
            self._strip.show(reference=found["rest"] / self._factor)
        self._margins.classes(remove="bench-bad bench-good")
        if "margins" not in found:
            self._margins.set_text("A predictive controller has no linear loop: run it.")
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
        self._margins.set_text(", ".join(words))
        self._margins.classes("bench-good" if found["stable"] else "bench-bad")

    # ---- a run ----------------------------------------------------------------------------------
    def _study(self, said: Said, plant: Plant) -> None:
        study = said["study"]
        v = plant.variable(next(iter(plant.positions)))
        force = "N" if v.unit == "m" else "N.m"

        def field(name: str, words: str, unit: str, **more: Any) -> None:
            self._fields[name] = el.Field(words, study[name], unit, self._study_act(name), **more)

        field("step", f"Step of {v.name}", v.unit)
        field("duration", "Duration", "s", low=0.01, high=20.0, shown="s")
        field("push", "Push", force)
        field("push_from", "Push from", "s", low=0.0, high=20.0, shown="s")
        field("noise", f"Noise of {v.name}", v.unit, low=0.0, hint="standard deviation")

    def _study_act(self, name: str) -> Callable[[Any], None]:
        def act(value: Any) -> None:
            said = self._controller
            if said is not None:
                self._change(f"{name} of the run", study={**said["study"], name: value})

        return act

    async def _run_it(self) -> None:
        said = self._controller
        key = copy.deepcopy([self._told_state(), said])
        if said is None or not self._ready or self._keys.get("run") == key:
            return
        self._keys["run"] = key
        try:
            found = await self.bench.work(
                f"Run {said['name']}",
                jobs.closed,
                self.bench.folder,
                self._told_state(),
                said,
                self.bench.allow_code,
                warm="control",
                latest="run",
                time_limit=120.0,
            )
        except Exception as error:
            self._run_said.set_text(self.bench.words(str(error)))
            self._run_said.classes("bench-bad")
            raise
        if self._keys["run"] == key:
            self._run = found
            self._run_said.classes(remove="bench-bad")
            self._run_said.set_text(found["words"])
            self._plot.draw(run_figure(found))
            self.bench.session.remember(
                "figures", **{said["id"]: {"of": key, "values": found["figures"]}}
            )

    # ---- live -----------------------------------------------------------------------------------
    def _make_live(self) -> None:
        with ui.element("div").classes("bench-row"):
            self._start = el.button("Start", self._turn, main=True)
            self._against = el.choice(
                "Against",
                {"plant": "the plant", "fmu": "its FMU"},
                self.bench.session.view("Control", "against", "plant"),
                lambda v: self._set_against(v),
            )
            self._rate = el.tag("span", "", "bench-note")
        with ui.element("div").classes("bench-live-parts"):
            self._strip = Strip("What is reached and what is to be reached", self._set_goal)
            with ui.element("div"):
                self._film = el.Scene(
                    "The plant as it stands; pull it with the pointer",
                    height=240,
                    pull=self._pulled,
                )
                self._push_box = ui.element("div")
        el.note(
            "Press Start. Then drag the arrow at the right edge, or use its arrow keys: the "
            "reference. Pull the plant with the pointer, type a push, move gains: the run goes on."
        )

    def _show_live(self, plant: Plant) -> None:
        v = plant.variable(next(iter(plant.positions)))
        factor = v.display_factor
        low, high = (e / factor if np.isfinite(e) else 0.0 for e in (v.min, v.max))
        inputs = []
        for i, u in enumerate(u for u in plant.inputs if not u.disturbance):
            ends = [e / u.display_factor for e in (u.min, u.max)]
            low_u, high_u = (e if np.isfinite(e) else 0.0 for e in ends)
            colour = look.COLOURS[i % len(look.COLOURS)]
            inputs.append(
                {
                    "name": u.name,
                    "unit": u.display_unit,
                    "low": low_u,
                    "high": high_u,
                    "colour": colour,
                    "dash": "" if i == 0 else "6 3",
                }
            )
        self._push = 0.0
        self._push_box.clear()
        with self._push_box:
            if can_be_pushed(self.state["plant"]):
                unit = "N" if v.unit == "m" else "N.m"
                self._push_field = el.Field("Push, until changed", 0.0, unit, self._set_push)
            else:
                el.note("This arrangement takes no push.")
        self._strip.show(
            low=low,
            high=high,
            unit=v.display_unit,
            variable=v.name,
            inputs=inputs,
        )
        self._factor = factor

    def _set_goal(self, shown: float) -> None:
        if np.isfinite(shown):
            self._goal = shown * self._factor

    def _set_push(self, value: float) -> None:
        self._push = value

    def _pulled(self, by: Said) -> None:
        """Towards the positive side of the picture: right, or up where it hangs."""
        x, y = (by.get(k) for k in ("x", "y"))
        if not can_be_pushed(self.state["plant"]):
            return
        if isinstance(x, int | float) and isinstance(y, int | float) and np.isfinite(x + y):
            self._push = float(np.clip(PULL * (x if abs(x) > abs(y) else y), -500.0, 500.0))
            self._push_field.set(self._push)

    def _set_against(self, value: str) -> None:
        self.bench.session.remember("Control", against=value)
        self._stop()

    def _turn(self) -> None:
        if self._runs:
            self._stop()
        elif self._ready:
            self._runs = True
            self._start.set_text("Stop")
            self.bench.soon(self._keep_running)
        else:
            self.bench.say("Choose an operating point and a controller first")

    def _stop(self) -> None:
        self._runs = False
        self._start.set_text("Start")
        self._rate.set_text("")

    async def _keep_running(self) -> None:
        """Piece after piece, each as long as the one before took."""
        name = f"{time.time():.6f}"
        against = self.bench.session.view("Control", "against", "plant")
        last, simulated, clock = time.monotonic(), 0.0, 0.0
        self._rate.set_text("starting: what runs is built ...")
        try:
            while self._runs and self._ready:
                said = self._controller
                assert said is not None
                now = time.monotonic()
                wanted, last = now - last, now
                seconds = float(np.clip(wanted, BEAT, LONGEST))
                ask = {
                    "run": name,
                    "seconds": seconds,
                    "reference": self._goal,
                    "push": self._push,
                }
                kept = {k: said[k] for k in ("kind", "gains", "sample_time")}
                found = await self.bench.work(
                    "Live",
                    jobs.live,
                    self.bench.folder,
                    self._told_state(),
                    {**kept, "against": against},
                    ask,
                    self.bench.allow_code,
                    quiet=True,
                    warm="live",
                    time_limit=60.0,
                )
                self._strip.add({k: found[k] for k in ("t", "rows", "restart")})
                self._film.show(found["scene"])
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


def _plot(label: str, what: str) -> el.Plot:
    return el.Plot(look.figure([]), label, empty=what)
