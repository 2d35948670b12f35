"""The tab Motion: stops dragged by hand, the plan solved anew meanwhile, its film, others beside.

What a motion says of itself: jobs/motion.py. The hand moves a copy (``_hand``); when it lets go,
that is one step of undo, and the plan is made in full.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from ...core.units import unit as unit_of
from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..jobs import motion as jobs
from ..live import Stops
from .motion_beside import Beside, Said
from .motion_shown import also, conflict, curves, motion_lines

__all__ = ["Motion"]

WEIGHTS = (0.0, 2.0)
"""Ends of the sliders of the objective."""


class Motion(Beside):
    """Motions of the session, one of them at hand."""

    title = "Motion"
    parts = ("muscle", "plant", "motions", "data")

    def build(self) -> None:
        self._hand: Said | None = None
        self._drawn_form: Any = None
        self._fields: dict[tuple[int, str], el.Field] = {}
        self._sliders: dict[str, el.Slider] = {}
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
                    self._plot = el.Plot(
                        look.figure([]),
                        "Curves of the plan over time",
                        empty="Position, pressures, commands and forces of the plan: add a motion",
                    )
        self.update(frozenset(self.parts))

    def update(self, changed: frozenset[str]) -> None:
        self._hand = None
        motion = self._motion
        if motion is not None and self._form(motion) == self._drawn_form:
            self._set_fields(motion)
        else:
            self._show()
        if motion is not None and self._made_of.get(motion["id"]) != self._key(motion):
            self.bench.soon(self._plan)

    @staticmethod
    def lines(state: dict[str, Any]) -> Sequence[str]:
        return motion_lines(state)

    # ---- without drawing all anew, which would take the cursor out of its field ------------------
    def _form(self, motion: Said) -> Any:
        """All that fields and buttons depend on, but the numbers that they show."""
        said = copy.deepcopy({k: v for k, v in motion.items() if k != "minimise"})
        for stop in said["stops"]:
            stop.update(at=0.0, second=None, dwell=0.0)
        said["durations"] = len(said["durations"])
        for bound in said["bounds"]:
            bound.update(low=0.0, high=0.0)
        names = [(m["id"], m["name"]) for m in self.state["motions"]]
        seen = [(d["id"], d["name"], d.get("is")) for d in self.state["data"]]
        return copy.deepcopy([said, names, seen, self.state["muscle"], self.state["plant"]])

    def _set_fields(self, motion: Said) -> None:
        for i, stop in enumerate(motion["stops"]):
            for key in ("at", "second", "dwell"):
                if (i, key) in self._fields:
                    self._fields[i, key].set(stop[key])
        for i, duration in enumerate(motion["durations"]):
            self._fields[i, "leg"].set(duration)
        for i, bound in enumerate(motion["bounds"]):
            for side in ("low", "high"):
                self._fields[i, side].set(bound[side])
        for term, slider in self._sliders.items():
            slider.set(float(motion["minimise"].get(term, 0.0)))
        with self.bench.shown_errors():
            self._show_plan(motion, self._plant())

    # ---- drawing it all -------------------------------------------------------------------------
    def _show(self) -> None:
        boxes = (self._list, self._stops_box, self._objective, self._bounds_box, self._beside)
        for box in boxes:
            box.clear()
        self._fields, self._sliders, self._drawn_form = {}, {}, None
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
            self._drawn_form = self._form(motion)
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
        seconds = {"": "nothing else", **{n: n for n in also(plant, motion["variable"])}}
        count = len(motion["stops"])
        for i, stop in enumerate(motion["stops"]):
            el.tag("h3", f"Stop {i + 1}", "bench-h3")
            self._fields[i, "at"] = el.Field(
                v.name, stop["at"], v.unit, self._stop_act(i, "at"), low=low, high=high
            )
            if motion["second"]:
                w = plant.variable(motion["second"])
                self._fields[i, "second"] = el.Field(
                    w.name, stop["second"], w.unit, self._stop_act(i, "second"), optional=True
                )
            self._fields[i, "dwell"] = el.Field(
                "Stays for", stop["dwell"], "s", self._stop_act(i, "dwell"), low=0, high=60
            )
            el.check("At rest", stop["rest"], self._stop_act(i, "rest"), "no velocity there")
            if i < len(motion["durations"]):
                to = (i + 1) % count + 1
                self._fields[i, "leg"] = el.Field(
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

    # ---- the objective --------------------------------------------------------------------------
    def _weights(self, motion: Said, plant: Plant) -> None:
        low, high = WEIGHTS
        for term, words in jobs.terms_of(plant).items():
            weight = float(motion["minimise"].get(term, 0.0))
            slider = self._sliders[term] = el.Slider(
                term,
                weight,
                low,
                max(high, weight),
                "",
                partial(self._weigh, term, settled=False),
                partial(self._weigh, term, settled=True),
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
                self._fields[i, side] = el.Field(
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
        self._plot.draw(curves(good) if good else look.figure([], "time [ms]"))
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
            problem, wrong = conflict(told)
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
            self._verdict.set_text(self.bench.words(told["problem"]))
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
