"""The tab Motion: stops dragged by hand, the plan solved anew meanwhile, its film, others beside.

What a motion says of itself: jobs/motion.py. The hand moves a copy (``_hand``); when it lets go,
that is one step of undo, and the plan is made in full.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from nicegui import events, ui

from ...core.units import unit as unit_of
from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..guard import MOST_UPLOAD
from ..jobs import motion as jobs
from ..jobs.data import look_at
from ..live import Stops
from ..made import plant_of
from ..script import call, figure_lines, literal
from ..tab import Tab

__all__ = ["Motion"]

DASHES = ("", "7 4", "2 3", "9 3 2 3")
WEIGHTS = (0.0, 2.0)
"""Ends of the sliders of the objective."""
Said = dict[str, Any]


class Motion(Tab):
    """Motions of the session, one of them at hand."""

    title = "Motion"
    parts = ("muscle", "plant", "motions", "data")

    def build(self) -> None:
        self._told: dict[str, Said] = {}  # the last plans
        self._last: dict[str, Said] = {}  # what came of the last attempts
        self._made_of: dict[str, Any] = {}
        self._record: Said | None = None
        self._hand: Said | None = None
        self._note = ""
        with el.split():
            with el.side():
                with el.section("Motion"):
                    self._list = ui.element("div")
                with el.section("Stops", "drag them, or use the arrow keys"):
                    self._stops_box = ui.element("div")
                with el.section("Objective"):
                    self._objective = ui.element("div").classes("bench-words")
                with el.section("Bounds", "beyond the plant's own"):
                    self._bounds_box = ui.element("div")
                with el.section("Compare and replay"):
                    self._beside = ui.element("div")
            with el.plots():
                with el.section("Position", wide=True) as self._words:
                    self._verdict = el.note("", "bench-verdict")
                    self._verdict._props["aria-live"] = "polite"
                    self._stops = Stops(self._slide, self._settle, self._add, self._remove)
                with el.section("Animation"):
                    self._film = el.Scene("The plant along the motion", height=260, unit="ms")
                with el.section("Figures"):
                    self._figures = ui.element("div")
                with el.section("Pressures, commands, forces", wide=True):
                    self._plot = el.Plot(look.figure([]), "Curves of the plan over time")
        self.update(frozenset(self.parts))

    def update(self, changed: frozenset[str]) -> None:
        self._hand = None
        self._show()
        motion = self._motion
        if motion is not None and self._made_of.get(motion["id"]) != self._key(motion):
            self.bench.soon(self._plan)

    @staticmethod
    def lines(state: dict[str, Any]) -> Sequence[str]:
        return motion_lines(state)

    # ---- what is at hand ------------------------------------------------------------------------
    @property
    def _motion(self) -> Said | None:
        motions = self.state["motions"]
        chosen = self.bench.session.item("motions", self.bench.session.view("Motion", "chosen"))
        return chosen or (motions[-1] if motions else None)

    def _plant(self) -> Plant:
        return plant_of(self.bench.folder, self.state, allow_code=self.bench.allow_code)

    def _key(self, motion: Said) -> Any:
        said = {k: v for k, v in motion.items() if k != "name"}
        return copy.deepcopy([self.state["muscle"], self.state["plant"], said])

    def _change(self, label: str, **values: Any) -> None:
        """One step of undo of the motion at hand."""
        with self.bench.shown_errors():
            motion = self._motion
            if motion is not None:
                self.bench.session.put(label, "motions", {**motion, **values})

    # ---- drawing it all -------------------------------------------------------------------------
    def _show(self) -> None:
        boxes = (self._list, self._stops_box, self._objective, self._bounds_box, self._beside)
        for box in boxes:
            box.clear()
        motion = self._motion
        if self.state["muscle"] is None:
            with self._list:
                el.note("A motion needs a muscle: choose or fit one in the tab Muscle.")
                el.button("To the tab Muscle", lambda: self.bench.open("Muscle"))
            self._verdict.set_text("")
            return
        with self.bench.shown_errors():
            plant = self._plant()
            with self._list:
                self._choices(motion, plant)
            if motion is None:
                return
            known = {v.name for v in plant.variables}
            if not {motion["variable"], motion["second"] or motion["variable"]} <= known:
                self._not_of(plant, motion)
                return
            with self._stops_box:
                self._stop_fields(motion, plant)
            with self._objective:
                self._weights(motion, plant)
            with self._bounds_box:
                self._bound_fields(motion, plant)
            with self._beside:
                self._compare(motion)
            self._show_plan(motion, plant)

    def _not_of(self, plant: Plant, motion: Said) -> None:
        self._verdict.set_text(
            f"{motion['name']} moves {motion['variable']}, which {plant.name} does not have: "
            "begin a new motion"
        )

    def _choices(self, motion: Said | None, plant: Plant) -> None:
        motions = self.state["motions"]
        if motion is None:
            el.note("None yet.")
        else:
            names = {m["id"]: m["name"] for m in motions}
            el.choice("Motion", names, motion["id"], self._choose)
            el.text_field("Name", motion["name"], lambda v: self._change("rename", name=v[:60]))
            el.choice(
                "Moves",
                list(plant.positions),
                motion["variable"],
                lambda v: self._moves(v),
                "the position that stops name",
            )
            el.check("Returns", motion["cyclic"], self._cyclic, "a cycle, again and again")
            methods = {n: words for n, (words, _) in jobs.METHODS.items()}
            el.choice("Mesh", methods, motion["method"], lambda v: self._change("mesh", method=v))
        with ui.element("div").classes("bench-row").style("margin-top: 6px"):
            el.button("New motion", self._new, main=motion is None)
            if motion is not None:
                el.button("Copy", self._copy)
                el.button("Delete", self._delete)

    def _choose(self, id: str) -> None:
        self.bench.session.remember("Motion", chosen=id)
        self.update(frozenset(("motions",)))

    def _new(self) -> None:
        with self.bench.shown_errors():
            session = self.bench.session
            id = session.fresh_id("motions")
            motion = jobs.first_motion(self._plant(), id, f"Motion {id.removeprefix('motions')}")
            session.remember("Motion", chosen=id)
            session.put(f"add {motion['name']}", "motions", motion)

    def _copy(self) -> None:
        with self.bench.shown_errors():
            session, motion = self.bench.session, self._motion
            if motion is not None:
                id = session.fresh_id("motions")
                made = {**motion, "id": id, "name": f"Motion {id.removeprefix('motions')}"}
                compared = [*session.view("Motion", "compared", []), motion["id"]]
                session.remember("Motion", chosen=id, compared=compared)
                session.put(f"copy {motion['name']}", "motions", made)

    def _delete(self) -> None:
        motion = self._motion
        if motion is not None:
            with self.bench.shown_errors():
                self.bench.session.drop(f"delete {motion['name']}", "motions", motion["id"])

    def _moves(self, name: str) -> None:
        with self.bench.shown_errors():
            motion = self._motion
            if motion is not None:
                first = jobs.first_motion(self._plant(), motion["id"], motion["name"])
                low, high = jobs.stroke_of(self._plant(), name)
                for part, stop in zip((0.35, 0.65), first["stops"], strict=True):
                    stop["at"] = low + part * (high - low)
                first = {**first, "variable": name}
                self.bench.session.put(f"move {name}", "motions", first)

    def _cyclic(self, on: bool) -> None:
        motion = self._motion
        if motion is not None:
            durations = [*motion["durations"], None] if on else motion["durations"][:-1]
            self._change("a cycle" if on else "no cycle", cyclic=on, durations=durations)

    # ---- stops ----------------------------------------------------------------------------------
    def _stop_fields(self, motion: Said, plant: Plant) -> None:
        low, high = jobs.stroke_of(plant, motion["variable"])
        v = plant.variable(motion["variable"])
        seconds = {"": "nothing else", **{n: n for n in _also(plant, motion["variable"])}}
        count = len(motion["stops"])
        for i, stop in enumerate(motion["stops"]):
            el.tag("h3", f"Stop {i + 1}", "bench-h3")
            el.Field(v.name, stop["at"], v.unit, self._stop_act(i, "at"), low=low, high=high)
            if motion["second"]:
                w = plant.variable(motion["second"])
                el.Field(w.name, stop["second"], w.unit, self._stop_act(i, "second"), optional=True)
            el.Field("Stays for", stop["dwell"], "s", self._stop_act(i, "dwell"), low=0, high=60)
            el.check("At rest", stop["rest"], self._stop_act(i, "rest"), "no velocity there")
            if i < len(motion["durations"]):
                to = (i + 1) % count + 1
                el.Field(
                    f"To stop {to} in",
                    motion["durations"][i],
                    "s",
                    self._leg_act(i),
                    low=1e-4,
                    high=600,
                    optional=True,
                    hint="empty: as the objective wants it",
                )
            if count > 2:
                el.button(f"Remove stop {i + 1}", lambda i=i: self._remove({"stop": i}))
        el.choice("Stops name also", seconds, motion["second"] or "", self._also)
        with ui.element("div").classes("bench-row").style("margin-top: 6px"):
            el.button("Add a stop", self._append)

    def _stop_act(self, i: int, key: str) -> Callable[[Any], None]:
        def act(value: Any) -> None:
            motion = self._motion
            if motion is not None:
                stops = copy.deepcopy(motion["stops"])
                stops[i][key] = value
                self._change(f"stop {i + 1}", stops=stops)

        return act

    def _leg_act(self, i: int) -> Callable[[Any], None]:
        def act(value: Any) -> None:
            motion = self._motion
            if motion is not None:
                durations = [*motion["durations"]]
                durations[i] = value
                self._change(f"time of leg {i + 1}", durations=durations)

        return act

    def _also(self, name: str) -> None:
        motion = self._motion
        if motion is not None:
            stops = [{**s, "second": None} for s in motion["stops"]]
            self._change("what stops name", second=name or None, stops=stops)

    def _append(self) -> None:
        motion = self._motion
        if motion is not None:
            low, high = jobs.stroke_of(self._plant(), motion["variable"])
            last = motion["stops"][-1]["at"]
            at = low + 0.35 * (high - low) if last > (low + high) / 2 else low + 0.65 * (high - low)
            stop = {"at": at, "second": None, "dwell": 0.0, "rest": True}
            self._change(
                "add a stop",
                stops=[*motion["stops"], stop],
                durations=[*motion["durations"], None],
            )

    def _add(self, said: Said) -> None:
        """A stop where the page was clicked twice: between those before and after."""
        motion = self._motion
        if motion is None or not all(isinstance(said.get(k), int | float) for k in ("at", "t")):
            return
        low, high = jobs.stroke_of(self._plant(), motion["variable"])
        times = [s["t"] for s in self._drawn_stops(motion)]
        i = int(np.searchsorted(times, said["t"]))
        stop = {
            "at": float(np.clip(said["at"], low, high)),
            "second": None,
            "dwell": 0.0,
            "rest": False,
        }
        stops = [*motion["stops"][:i], stop, *motion["stops"][i:]]
        stop["rest"] = i == len(motion["stops"])
        durations = [*motion["durations"]]
        durations[max(i - 1, 0) : i] = [None, None]
        self._change("add a stop", stops=stops, durations=durations[: len(motion["durations"]) + 1])

    def _remove(self, said: Said) -> None:
        motion, i = self._motion, said.get("stop")
        if motion is None or len(motion["stops"]) < 3 or not isinstance(i, int):
            return
        stops = [s for k, s in enumerate(motion["stops"]) if k != i]
        durations = [*motion["durations"]]
        durations[max(i - 1, 0) : i + 1] = [None]
        self._change("remove a stop", stops=stops, durations=durations[: len(stops)])
        # as many legs as before, less one

    # ---- the hand -------------------------------------------------------------------------------
    def _moved(self, said: Said) -> Said | None:
        """The motion with a stop where the hand has it."""
        motion = self._motion
        i, at, leg = said.get("stop"), said.get("at"), said.get("leg")
        if motion is None or not isinstance(i, int) or not 0 <= i < len(motion["stops"]):
            return None
        if not isinstance(at, int | float):
            return None
        low, high = jobs.stroke_of(self._plant(), motion["variable"])
        moved = copy.deepcopy(motion)
        moved["stops"][i]["at"] = float(np.clip(at, low, high))
        if isinstance(leg, int | float) and 1e-4 <= leg <= 600 and i > 0:
            moved["durations"][i - 1] = float(leg)
        return moved

    def _slide(self, said: Said) -> None:
        moved = self._moved(said)
        if moved is not None:
            self._hand = moved
            self.bench.soon(self._resolve)

    async def _resolve(self) -> None:
        moved = self._hand
        if moved is None:
            return
        try:
            told = await self.bench.work(
                "Plan under the hand",
                jobs.dragged,
                self.bench.folder,
                self._told_state(),
                moved,
                self.bench.allow_code,
                quiet=True,
                warm="plan",
                latest="drag",
                time_limit=30.0,
            )
        finally:
            self._stops.shown()
        if self._hand is not None:  # it has not let go meanwhile
            self._show_curve(moved, self._plant(), told)

    def _settle(self, said: Said) -> None:
        moved = self._moved(said)
        self._hand = None
        if moved is not None:
            with self.bench.shown_errors():
                self.bench.session.put(f"move stop {said['stop'] + 1}", "motions", moved)

    def _told_state(self) -> Said:
        """What a process must know."""
        return {k: self.state[k] for k in ("plant", "muscle", "data")}

    # ---- the objective --------------------------------------------------------------------------
    def _weights(self, motion: Said, plant: Plant) -> None:
        low, high = WEIGHTS
        for term, words in jobs.terms_of(plant).items():
            weight = float(motion["minimise"].get(term, 0.0))
            slider = el.Slider(
                term,
                weight,
                low,
                max(high, weight),
                "",
                lambda v, term=term: self._weigh(term, v, settled=False),
                lambda v, term=term: self._weigh(term, v, settled=True),
            )
            slider._props["title"] = words
        el.note("Weights; each term counts in units of its usual size.")

    def _weigh(self, term: str, weight: float, *, settled: bool) -> None:
        motion = self._hand or self._motion
        if motion is None:
            return
        weight = round(max(weight, 0.0), 6)
        minimise = {k: v for k, v in {**motion["minimise"], term: weight}.items() if v}
        if settled:
            self._change(f"weight of {term}", minimise=minimise)
        elif minimise:
            self._hand = {**motion, "minimise": minimise}
            self.bench.soon(self._resolve)

    # ---- bounds ---------------------------------------------------------------------------------
    def _bound_fields(self, motion: Said, plant: Plant) -> None:
        taken = [b["name"] for b in motion["bounds"]]
        for i, bound in enumerate(motion["bounds"]):
            v = plant.variable(bound["name"])
            for side in ("low", "high"):
                el.Field(
                    f"{v.name} {'>=' if side == 'low' else '<='}",
                    bound[side],
                    v.unit,
                    self._bound_act(i, side),
                    optional=True,
                )
            el.button(f"Remove bound of {v.name}", lambda i=i: self._unbound(i))
        rest = [v.name for v in (*plant.states, *plant.inputs, *plant.outputs)]
        names = {"": "choose ...", **{n: n for n in rest if n not in taken}}
        el.choice("Bound", names, "", self._bind)

    def _bound_act(self, i: int, side: str) -> Callable[[Any], None]:
        def act(value: Any) -> None:
            motion = self._motion
            if motion is not None:
                bounds = copy.deepcopy(motion["bounds"])
                bounds[i][side] = value
                self._change(f"bound of {bounds[i]['name']}", bounds=bounds)

        return act

    def _bind(self, name: str) -> None:
        motion = self._motion
        if motion is not None and name:
            v = self._plant().variable(name)
            ends = [e if np.isfinite(e) else None for e in (v.min, v.max)]
            bound = {"name": name, "low": ends[0], "high": ends[1]}
            self._change(f"bound {name}", bounds=[*motion["bounds"], bound])

    def _unbound(self, i: int) -> None:
        motion = self._motion
        if motion is not None:
            bounds = [b for k, b in enumerate(motion["bounds"]) if k != i]
            self._change("remove a bound", bounds=bounds)

    # ---- plans ----------------------------------------------------------------------------------
    async def _plan(self) -> None:
        motion = self._motion
        if motion is None or self.state["muscle"] is None:
            return
        key = self._key(motion)
        self._made_of[motion["id"]] = key
        self._note = "planning ..."
        self._show_curve(motion, self._plant(), self._told.get(motion["id"]), pending=True)
        try:
            told = await self.bench.work(
                f"Plan {motion['name']}",
                jobs.planned,
                self.bench.folder,
                self._told_state(),
                motion,
                self.bench.allow_code,
                warm="plan",
                latest="plan",
                time_limit=jobs.TIME_LIMIT + 30.0,
            )
        except Exception:
            if self._made_of.get(motion["id"]) == key:
                self._made_of.pop(motion["id"])
            self._note = "no plan"
            self._show_curve(motion, self._plant(), self._told.get(motion["id"]))
            raise
        if self._made_of.get(motion["id"]) != key:
            return
        self._note = ""
        self._last[motion["id"]] = told
        if told["ok"]:
            self._told[motion["id"]] = told
            self.bench.session.remember(
                "figures", **{motion["id"]: {"of": key, "values": told["figures"]}}
            )
        now = self._motion
        if now is not None and now["id"] == motion["id"]:
            self._show_plan(now, self._plant(), told)

    def _show_plan(self, motion: Said, plant: Plant, told: Said | None = None) -> None:
        """All that a finished plan says; of one that failed, why, and the one before."""
        told = told or self._last.get(motion["id"]) or self._told.get(motion["id"])
        self._show_curve(motion, plant, told)
        good = self._told.get(motion["id"])
        self._film.show(good["scene"] if good else None)
        self._plot.draw(self._curves(good) if good else look.figure([], "time [ms]"))
        self._show_figures(motion)

    def _show_curve(
        self, motion: Said, plant: Plant, told: Said | None, *, pending: bool = False
    ) -> None:
        """Stops and the motion between them, the verdict, the limits that it touches."""
        low, high = jobs.stroke_of(plant, motion["variable"])
        v = plant.variable(motion["variable"])
        factor = unit_of(v.display_unit).factor
        problem, wrong = "", None
        curve = told if told is not None and told["ok"] else self._told.get(motion["id"])
        if told is not None and not told["ok"]:
            problem, wrong = _conflict(told)
        self._stops.show(
            stops=self._drawn_stops(motion, curve),
            variable=v.name,
            unit=v.display_unit,
            factor=factor,
            low=low,
            high=high,
            label=f"Stops of {motion['name']}; double click adds one, Delete removes one",
            curve={"t": curve["t"], "x": curve["position"]} if curve else None,
            duration=curve["duration"] if curve else 0.0,
            active=curve["active"] if curve else [],
            others=self._others(motion),
            record=self._record_curve(motion, factor),
            pending=pending or (told is not None and not told["ok"]),
            problem=problem,
            wrong=wrong,
        )
        self._say_verdict(told, pending)

    def _say_verdict(self, told: Said | None, pending: bool) -> None:
        self._verdict.classes(remove="bench-bad bench-good")
        if told is None:
            self._verdict.set_text(self._note)
        elif not told["ok"]:
            self._verdict.set_text(told["problem"])
            self._verdict.classes("bench-bad")
        else:
            dragged = "verb_seconds" in told
            said = f"{1e3 * told['duration']:.5g} ms, objective {told['objective']:.5g}; "
            said += "under the hand, on a coarse mesh" if dragged else told["verdict"]
            self._verdict.set_text(f"{self._note}  {said}" if pending else said)
            if not dragged:
                self._verdict.classes("bench-good" if told["verified"] else "bench-bad")
        self._words.set_text("the motion before is shown meanwhile" if pending else "")

    def _drawn_stops(self, motion: Said, curve: Said | None = None) -> list[Said]:
        """Stops with the times at which the last plan was there; legs that are given have them."""
        curve = curve or self._told.get(motion["id"])
        times = curve["stop_times"] if curve else []
        now, stops = 0.0, []
        for i, stop in enumerate(motion["stops"]):
            fixed = i > 0 and motion["durations"][i - 1] is not None
            if fixed:
                now += motion["durations"][i - 1]
            elif i:
                there = i < len(times)
                now += times[i] - times[i - 1] - motion["stops"][i - 1]["dwell"] if there else 0.1
            stops.append({**stop, "t": now, "fixed": fixed})
            now += stop["dwell"]
        return stops

    def _others(self, motion: Said) -> list[Said]:
        found = []
        for i, other in enumerate(self._compared(motion)):
            told = self._told.get(other["id"])
            if told is not None and other["variable"] == motion["variable"]:
                found.append(
                    {
                        "t": told["t"],
                        "x": told["position"],
                        "colour": look.COLOURS[(i + 1) % len(look.COLOURS)],
                        "dash": DASHES[(i + 1) % len(DASHES)],
                    }
                )
        return found

    def _curves(self, told: Said) -> dict[str, Any]:
        """All panels below each other, their units at the axes."""
        scale = 1e3 if told["duration"] < 2 else 1.0
        t = [scale * v for v in told["t"]]
        panels, data, layout = told["panels"], [], {}
        gap = 0.05
        each = (1 - gap * (len(panels) - 1)) / len(panels)
        for i, panel in enumerate(panels):
            axis = "" if i == 0 else str(i + 1)
            top = 1 - i * (each + gap)
            layout[f"yaxis{axis}"] = {
                **look.axis(panel["unit"] if panel["unit"] != "1" else "part"),
                "domain": [max(0.0, top - each), top],
            }
            for k, name in enumerate(panel["names"]):
                colour, dash = _style(name, k)
                data.append(
                    look.line(
                        t,
                        told["columns"][name],
                        name,
                        colour,
                        yaxis=f"y{axis}",
                        line={"dash": dash},
                        hovertemplate=f"{name}: %{{y:.4g}} {panel['unit']}<extra></extra>",
                    )
                )
        unit = "ms" if scale > 1 else "s"
        figure = look.figure(
            data,
            f"time [{unit}]",
            height=130 * len(panels) + 90,
            hovermode="x",
            **layout,
            **look.ABOVE,
        )
        figure["layout"]["xaxis"]["anchor"] = f"y{len(panels)}" if len(panels) > 1 else "y"
        return figure

    # ---- beside each other ----------------------------------------------------------------------
    def _compared(self, motion: Said) -> list[Said]:
        ids = self.bench.session.view("Motion", "compared", [])
        return [m for m in self.state["motions"] if m["id"] in ids and m["id"] != motion["id"]]

    def _compare(self, motion: Said) -> None:
        others = [m for m in self.state["motions"] if m["id"] != motion["id"]]
        compared = [m["id"] for m in self._compared(motion)]
        if not others:
            el.note("Copy the motion to compare two plans.")
        for other in others:
            el.check(
                f"beside {other['name']}",
                other["id"] in compared,
                lambda on, id=other["id"]: self._set_compared(id, on),
            )
        records = {d["id"]: d["name"] for d in self.state["data"] if d.get("is") == "record"}
        if records:
            el.choice("Record", {"": "none", **records}, self._record_id, self._set_record)
        ui.upload(
            label="Drop a record of the motion here",
            auto_upload=True,
            max_file_size=MOST_UPLOAD,
            on_upload=self._dropped,
            on_rejected=lambda: self.bench.say("the file was refused: it is too large", "error"),
        ).props("flat bordered hide-upload-btn")

    def _set_compared(self, id: str, on: bool) -> None:
        ids = [i for i in self.bench.session.view("Motion", "compared", []) if i != id]
        self.bench.session.remember("Motion", compared=[*ids, id] if on else ids)
        self.bench.soon(lambda: self._plan_other(id))

    async def _plan_other(self, id: str) -> None:
        """The plan of a motion that is shown beside the one at hand, where it is not known yet."""
        other, motion = self.bench.session.item("motions", id), self._motion
        if other is not None and id not in self._told:
            told = await self.bench.work(
                f"Plan {other['name']}",
                jobs.planned,
                self.bench.folder,
                self._told_state(),
                other,
                self.bench.allow_code,
                warm="plan",
            )
            if told["ok"]:
                self._told[id] = told
                self._made_of[id] = self._key(other)
        if motion is not None:
            self._show_plan(motion, self._plant())

    def _show_figures(self, motion: Said) -> None:
        self._figures.clear()
        shown = [m for m in (motion, *self._compared(motion)) if m["id"] in self._told]
        with self._figures:
            if not shown:
                el.note("No plan yet.")
                return
            rows = []
            plant = self._plant()
            for name in self._told[shown[0]["id"]]["figures"]:
                row = []
                for m in shown:
                    value = self._told[m["id"]]["figures"].get(name)
                    row.append("" if value is None else _with_unit(plant, name, value))
                rows.append([name, *row])
            rows.append(["found in", *[f"{self._told[m['id']]['seconds']:.3g} s" for m in shown]])
            el.table(["figure", *[m["name"] for m in shown]], rows, label="Figures of the plans")
            if self._record is not None:
                self._show_record(self._record)

    def _show_record(self, record: Said) -> None:
        el.note(f"{record['name']} against the plan: largest and root mean square difference")
        rows = [
            [r["name"], f"{r['largest']:.4g} {r['unit']}", f"{r['rms']:.4g} {r['unit']}"]
            for r in record["rows"]
        ]
        el.table(["column", "largest", "rms"], rows, label="The record against the plan")

    # ---- records --------------------------------------------------------------------------------
    @property
    def _record_id(self) -> str:
        return str(self.bench.session.view("Motion", "record", ""))

    def _set_record(self, id: str) -> None:
        self.bench.session.remember("Motion", record=id)
        self._record = None
        self.bench.soon(self._replay)

    async def _dropped(self, event: events.UploadEventArguments) -> None:
        with self.bench.shown_errors():
            session = self.bench.session
            name = str(event.file.name)[:100]
            item: Said = {"name": name, "said": {"kind": "record"}}
            item["file"] = session.store(name, await event.file.read())
            seen = await self.bench.work(
                f"Reading {name}", look_at, self.bench.folder, item, time_limit=60.0
            )
            item = {**item, "id": session.fresh_id("data"), "off": [], "is": seen["kind"]}
            session.remember("Motion", record=item["id"])
            session.put(f"add {name}", "data", item)
            await self._replay()

    async def _replay(self) -> None:
        motion, item = self._motion, self.bench.session.item("data", self._record_id)
        if motion is None:
            return
        if item is not None:
            self._record = await self.bench.work(
                f"Compare {item['name']}",
                jobs.replayed,
                self.bench.folder,
                self._told_state(),
                motion,
                item,
                self.bench.allow_code,
                warm="plan",
            )
        self._show_plan(motion, self._plant())

    def _record_curve(self, motion: Said, factor: float) -> Said | None:
        if self._record is None or motion["variable"] not in self._record["curves"]:
            return None
        curve = self._record["curves"][motion["variable"]]
        return {"t": curve["t"], "x": [factor * v for v in curve["y"]]}


# ---- words ---------------------------------------------------------------------------------------
def _also(plant: Plant, variable: str) -> list[str]:
    """What stops may name beside the position: stiffness, pressures."""
    names = [v.name for v in (*plant.states, *plant.outputs)]
    chosen = ("stiffness", ".pressure")
    return [n for n in names if n != variable and n.endswith(chosen)]


def _conflict(told: Said) -> tuple[str, int | None]:
    """(words, number of the stop in whose place they are said)."""
    for one in told["conflicts"]:
        if one["stop"] is not None:
            return one["words"], one["stop"]
    return (told["conflicts"][0]["words"], None) if told["conflicts"] else ("", None)


def _style(name: str, k: int) -> tuple[str, str]:
    """Colour by muscle; commands and what else shares a muscle's colour are dashed."""
    owner = name.partition(".")[0]
    if owner.startswith("muscle"):
        number = owner.removeprefix("muscle")
        colour = look.COLOURS[(int(number) - 1 if number.isdigit() else 0) % len(look.COLOURS)]
        return colour, "dot" if name.endswith(".command") else "solid"
    return look.COLOURS[(k + 2) % len(look.COLOURS)], "solid"


def _with_unit(plant: Plant, name: str, value: float) -> str:
    if name == "duration":
        return f"{1e3 * value:.5g} ms"
    if name.startswith("max("):
        return plant.variable(name[4:-1]).shown(value)
    return f"{value:.4g}"


# ---- the script ----------------------------------------------------------------------------------
def motion_lines(state: Mapping[str, Any]) -> list[str]:
    """Each motion as a call of pam.plan, with its figures."""
    lines: list[str] = []
    if state["muscle"] is None:
        return lines
    for motion in state["motions"]:
        said = jobs.arguments(motion)
        stops = ", ".join(
            literal(s) if isinstance(s, dict) else _stop_code(s) for s in said["stops"]
        )
        method = jobs.METHODS[motion["method"]][1]
        shown = {k: v for k, v in said.items() if k != "stops"}
        code = call("pam.plan", "plant", f"[{stops}]", **shown, time_limit=jobs.TIME_LIMIT)
        if method is not None:
            code = f"{code[:-1]}, method=pam.{method!r})"
        id = motion["id"]
        lines += [f"{id} = {code}", f"print({id})"]
        lines += figure_lines(
            id,
            {
                "duration": f"{id}.duration",
                "objective": f"{id}.objective",
                "replay_error": f"{id}.replay_error",
            },
        )
        lines += [
            "for v in (*plant.states, *plant.inputs):",
            f'    figures[f"{id}.max({{v.name}})"] = float({id}.trajectory[v.name].max())',
        ]
    return lines


def _stop_code(stop: Any) -> str:
    said = call("pam.Stop", literal(dict(stop.values)), rest=stop.rest)
    return f"{said[:-1]}, dwell={stop.dwell!r})" if stop.dwell else said
