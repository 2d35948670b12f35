"""The tab Motion: stops dragged by hand, the plan solved anew meanwhile, its film, others beside.

What a motion says of itself: jobs/motion.py. The hand moves a copy (``_hand``); when it lets go,
that is one step of undo, and the plan is made in full.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from nicegui import events

from ...core.units import unit as unit_of
from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..elements import Menu, Number, Slide, Text, Tick, Words
from ..guard import MOST_UPLOAD
from ..jobs import motion as jobs
from ..made import made_of_plan, plant_of
from ..pictures import Plot, Scene, Stops
from ..script import METHODS
from ..tab import Members
from .data import dropped, taken

Said = dict[str, Any]

DWELL = Number("Stays for", "s", 0, 60)
REST = Tick("At rest", "no velocity there")
MESH = Menu("Mesh", {key: words for key, (words, _) in METHODS.items()})
WEIGHTS = (0.0, 2.0)
"""Ends of the sliders of the objective."""
DASHES = ("", "7 4", "2 3", "9 3 2 3")
"""Of motions beside the one at hand."""


class Motion(Members):
    """Motions of the session, one of them at hand, and what is known of each."""

    title, part = "Motion", "motions"
    parts = ("muscle", "plant", "motions", "data")

    def build(self) -> None:
        self._told: dict[str, Said] = {}  # the last plans, each with what it is made "of"
        self._last: dict[str, Said] = {}  # what came of the last attempts
        self._made_of: dict[str, Any] = {}
        self._record: Said | None = None  # beside the plan, with what both are made "of"
        self._hand: Said | None = None
        self._note = ""
        with el.split():
            with el.side():
                self._form = el.form("Motion")
                self._stops_form = el.form("Stops", "drag them, or use the arrow keys")
                self._objective_form = el.form("Objective", classes="bench-words")
                self._bounds_form = el.form("Bounds", "beyond the plant's own")
                with el.section("Compare and replay"):
                    self._beside_form = el.Form()
                    words = "Drop a record of the motion here"
                    el.upload(words, self._dropped, self.bench.say, most=MOST_UPLOAD)
            with el.plots():
                with el.section("Position", wide=True) as self._words:
                    self._verdict = el.Verdict()
                    self._stops = Stops(self._slide, self._settle, self._add, self._remove)
                with el.section("Animation"):
                    self._film = Scene("The plant along the motion", height=260, unit="ms")
                with el.section("Figures"):
                    self._figures = el.tag("div")
                with el.section("Pressures, commands, forces", wide=True):
                    self._plot = Plot(
                        "Curves of the plan over time",
                        empty="Position, pressures, commands and forces of the plan: add a motion",
                    )

    def update(self, changed: frozenset[str]) -> None:
        self._hand = None
        self._show()
        motion = self.at_hand
        if motion is None or self.state["muscle"] is None:
            return
        plant = self._plant()
        if not self._can_do(motion, plant):
            return
        if self._made_of.get(motion["id"]) != self._key(motion):
            self.bench.soon(self._plan())
        for other in self._compared(motion):
            known = self._made_of.get(other["id"]) == self._key(other)
            if not known and self._can_do(other, plant):
                self.bench.soon(self._plan_other(other["id"]))

    def _plant(self) -> Plant:
        return plant_of(self.world)

    def _key(self, motion: Said) -> Any:
        return copy.deepcopy(made_of_plan(self.state, motion))

    @staticmethod
    def _can_do(motion: Said, plant: Plant) -> bool:
        """Whether the plant has what the motion moves and bounds."""
        names = {motion["variable"], motion["second"] or motion["variable"]}
        names |= {b["name"] for b in motion["bounds"]}
        return names <= {v.name for v in plant.variables}

    def _is_of_now(self, motion: Said) -> bool:
        """Whether the plan that is known of a motion is that of what is said now."""
        told = self._told.get(motion["id"])
        return told is not None and told["of"] == self._key(motion)

    # ---- drawing --------------------------------------------------------------------------------
    def _show(self) -> None:
        motion = self.at_hand
        forms = (self._form, self._stops_form, self._objective_form, self._bounds_form)
        with self.rows(*forms, self._beside_form) as rows:
            if self.state["muscle"] is None:
                rows[0] = self.without_muscle("A motion")
                self._clear()
                return
            try:
                plant = self._plant()
            except Exception:
                self._clear()
                raise
            rows[0] = self._rows(motion, plant)
            if motion is None:
                self._clear()
                return
            if not self._can_do(motion, plant):
                self._clear()
                self._verdict.say(
                    f"{motion['name']} moves {motion['variable']} or bounds what {plant.name} "
                    "does not have: begin a new motion"
                )
                return
            rows[1] = self._stop_rows(motion, plant)
            rows[2] = self._weight_rows(motion, plant)
            rows[3] = self._bound_rows(motion, plant)
            rows[4] = self._compare_rows(motion)
            self._show_plan(motion, plant)

    def _clear(self) -> None:
        """Nothing is shown of a plan that is gone."""
        self._stops.set(stops=[], others=[], active=[], curve=None, record=None, problem="")
        self._film.set(scene=None)
        self._plot.clear()
        self._figures.clear()
        self._words.set_text("")
        self._verdict.say()

    def _rows(self, motion: Said | None, plant: Plant) -> list[el.Row]:
        if motion is None:
            return [el.words("None yet."), el.buttons({"New motion": self._new}, main="New motion")]
        positions = {n: n for n in plant.positions}
        return [
            (Menu("Motion", self.names), motion["id"], self.choose),
            (Text("Name"), motion["name"], self.rename),
            (
                Menu("Moves", positions, "the position that stops name"),
                motion["variable"],
                self._moves,
            ),
            (Tick("Returns", "a cycle, again and again"), motion["cyclic"], self._cyclic),
            (MESH, motion["method"], lambda v: self.change("mesh", method=v)),
            el.buttons({"New motion": self._new, "Copy": self._copy, "Delete": self.drop}),
        ]

    def _new(self) -> None:
        id = self.session.fresh_id("motions")
        name = f"Motion {id.removeprefix('motions')}"
        self.add(jobs.first_motion(self._plant(), id, name))

    def _copy(self) -> None:
        motion, id = self.held, self.session.fresh_id("motions")
        made = {**motion, "id": id, "name": f"Motion {id.removeprefix('motions')}"}
        self.remember(compared=[*self.view("compared", []), motion["id"]])
        self.add(made, f"copy {motion['name']} as")

    def _moves(self, name: str) -> None:
        motion = self.held
        first = jobs.first_motion(self._plant(), motion["id"], motion["name"], name)
        self.session.put(f"move {name}", "motions", first)

    def _cyclic(self, on: bool) -> None:
        durations = self.held["durations"]
        durations = [*durations, None] if on else durations[:-1]
        self.change("a cycle" if on else "no cycle", cyclic=on, durations=durations)

    # ---- stops ----------------------------------------------------------------------------------
    def _stop_rows(self, motion: Said, plant: Plant) -> list[el.Row]:
        low, high = jobs.stroke_of(plant, motion["variable"])
        v = plant.variable(motion["variable"])
        known: dict[str, Any] = {"at": Number(v.name, v.unit, low, high)}
        if motion["second"]:
            w = plant.variable(motion["second"])
            known["second"] = Number(w.name, w.unit, optional=True)
        known |= {"dwell": DWELL, "rest": REST}
        rows, count = [], len(motion["stops"])
        for i, stop in enumerate(motion["stops"]):
            part: list[el.Row] = [(Words(f"Stop {i + 1}", "bench-h3", "h3"), None, None)]
            part += el.fields(known, stop, partial(self.change_in, f"stop {i + 1}", "stops", i))
            if i < len(motion["durations"]):
                label, hint = f"To stop {(i + 1) % count + 1} in", "as the objective wants it"
                leg = Number(label, "s", 1e-4, 600, optional=True, hint=f"empty: {hint}")
                act = partial(self.change_in, f"time of leg {i + 1}", "durations", i)
                part.append((leg, motion["durations"][i], act))
            if count > 2:
                remove = partial(self._remove, {"stop": i})
                part.append(el.buttons({f"Remove stop {i + 1}": remove}))
            rows.append((el.Part(f"stop {i + 1}", ""), part, None))
        seconds = {"": "nothing else", **{n: n for n in also(plant, motion["variable"])}}
        return [
            *rows,
            (Menu("Stops name also", seconds), motion["second"], self._also),
            el.buttons({"Add a stop": self._append}),
        ]

    def _also(self, name: str) -> None:
        stops = [{**s, "second": None} for s in self.held["stops"]]
        self.change("what stops name", second=name or None, stops=stops)

    def _append(self) -> None:
        motion = self.held
        low, high = jobs.stroke_of(self._plant(), motion["variable"])
        part = 0.35 if motion["stops"][-1]["at"] > (low + high) / 2 else 0.65
        stops = [*motion["stops"], jobs.stop_at(low + part * (high - low))]
        durations = legs_with(motion["durations"], len(stops) - 1, motion["cyclic"])
        self.change("add a stop", stops=stops, durations=durations)

    def _add(self, said: Said) -> None:
        """A stop where the page was clicked twice: between those before and after."""
        motion = self.held
        if not all(isinstance(said.get(k), int | float) for k in ("at", "t")):
            return
        low, high = jobs.stroke_of(self._plant(), motion["variable"])
        times = [s["t"] for s in self._drawn_stops(motion)]
        i = int(np.searchsorted(times, said["t"]))
        stop = jobs.stop_at(float(np.clip(said["at"], low, high)), rest=i == len(times))
        stops = [*motion["stops"][:i], stop, *motion["stops"][i:]]
        durations = legs_with(motion["durations"], i, motion["cyclic"])
        self.change("add a stop", stops=stops, durations=durations)

    def _remove(self, said: Said) -> None:
        motion, i = self.held, said.get("stop")
        if len(motion["stops"]) < 3 or not isinstance(i, int):
            return
        stops = [s for k, s in enumerate(motion["stops"]) if k != i]
        durations = legs_without(motion["durations"], i, motion["cyclic"])
        self.change("remove a stop", stops=stops, durations=durations)

    # ---- the hand -------------------------------------------------------------------------------
    def _moved(self, said: Said) -> Said | None:
        """The motion with a stop where the hand has it."""
        motion = self.held
        i, at, leg = said.get("stop"), said.get("at"), said.get("leg")
        if not isinstance(i, int) or not 0 <= i < len(motion["stops"]):
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
            self.bench.soon(self._resolve())

    async def _resolve(self) -> None:
        moved = self._hand
        if moved is None:
            return
        try:
            told = await self.work(jobs.dragged, moved)
        finally:
            self._stops.shown()
        if self._hand is not None:  # it has not let go meanwhile
            self._show_curve(moved, self._plant(), told)

    def _settle(self, said: Said) -> None:
        moved = self._moved(said)
        self._hand = None
        if moved is not None:
            self.session.put(f"move stop {said['stop'] + 1}", "motions", moved)

    # ---- the objective --------------------------------------------------------------------------
    def _weight_rows(self, motion: Said, plant: Plant) -> list[el.Row]:
        rows: list[el.Row] = []
        for term, words in jobs.terms_of(plant).items():
            weight, (low, high) = float(motion["minimise"].get(term, 0.0)), WEIGHTS
            slide = Slide(term, low, max(high, weight), hint=words, of=motion["id"])
            acts = (partial(self._weigh, term, settled=on) for on in (False, True))
            rows.append((slide, weight, tuple(acts)))
        return [*rows, el.words("Weights; each term counts in units of its usual size.")]

    def _weigh(self, term: str, weight: float, *, settled: bool) -> None:
        motion = self._hand or self.held
        weight = round(max(weight, 0.0), 6)
        minimise = {k: v for k, v in {**motion["minimise"], term: weight}.items() if v}
        if settled:
            self.change(f"weight of {term}", minimise=minimise)
        elif minimise:
            self._hand = {**motion, "minimise": minimise}
            self.bench.soon(self._resolve())

    # ---- bounds ---------------------------------------------------------------------------------
    def _bound_rows(self, motion: Said, plant: Plant) -> list[el.Row]:
        rows: list[el.Row] = []
        for i, bound in enumerate(motion["bounds"]):
            v = plant.variable(bound["name"])
            act = partial(self.change_in, f"bound of {v.name}", "bounds", i)
            ends = {
                side: Number(f"{v.name} {sign}", v.unit, optional=True)
                for side, sign in (("low", ">="), ("high", "<="))
            }
            rows += el.fields(ends, bound, act)
            rows.append(el.buttons({f"Remove bound of {v.name}": partial(self._unbound, i)}))
        taken = [b["name"] for b in motion["bounds"]]
        rest = [v.name for v in (*plant.states, *plant.inputs, *plant.outputs)]
        names = {"": "choose ...", **{n: n for n in rest if n not in taken}}
        return [*rows, (Menu("Bound", names), "", self._bind)]

    def _bind(self, name: str) -> None:
        if name:
            v = self._plant().variable(name)
            ends = [e if np.isfinite(e) else None for e in (v.min, v.max)]
            bound = {"name": name, "low": ends[0], "high": ends[1]}
            self.change(f"bound {name}", bounds=[*self.held["bounds"], bound])

    def _unbound(self, i: int) -> None:
        bounds = [b for k, b in enumerate(self.held["bounds"]) if k != i]
        self.change("remove a bound", bounds=bounds)

    # ---- plans ----------------------------------------------------------------------------------
    async def _plan(self) -> None:
        motion = self.at_hand
        if motion is None or self.state["muscle"] is None:
            return
        key = self._key(motion)
        self._made_of[motion["id"]] = key
        self._note = "planning ..."
        self._show_curve(motion, self._plant(), self._told.get(motion["id"]), pending=True)
        try:
            told = await self.work(jobs.planned, motion, of=motion["name"])
        except Exception as error:
            if self._made_of.get(motion["id"]) == key:
                self._made_of.pop(motion["id"])
                self._note = ""
                none = {"ok": False, "problem": f"no plan: {error}", "conflicts": []}
                self._last[motion["id"]] = none
                self._show_at_hand(motion["id"], none)
            raise
        if self._made_of.get(motion["id"]) != key:
            return
        self._note = ""
        self._last[motion["id"]] = told
        if told["ok"]:
            self._told[motion["id"]] = {**told, "of": key}
            self.keep_figures(motion["id"], key, told["figures"])
        if self._show_at_hand(motion["id"], told) and told["ok"]:
            await self._replay()

    def _show_at_hand(self, id: str | None = None, told: Said | None = None) -> bool:
        """Show the plan at hand, if it is that of a motion (None: of any); whether it is."""
        now = self.at_hand
        if now is None or id not in (None, now["id"]):
            return False
        self._show_plan(now, self._plant(), told)
        return True

    def _show_plan(self, motion: Said, plant: Plant, told: Said | None = None) -> None:
        """All that a finished plan says; of one that failed, why, and the one before."""
        told = told or self._last.get(motion["id"]) or self._told.get(motion["id"])
        self._show_curve(motion, plant, told)
        good = self._told.get(motion["id"])
        self._film.set(scene=good["scene"] if good else None)
        self._plot.draw(curves(good) if good else look.figure([]))
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
        self._stops.set(
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
        before = pending or (told is not None and not told["ok"])
        self._words.set_text("the motion before is shown meanwhile" if before else "")
        if told is None:
            self._verdict.say(self._note)
        elif not told["ok"]:
            self._verdict.say(self.bench.words(told["problem"]), False)
        else:
            dragged = "verb_seconds" in told
            said = f"{1e3 * told['duration']:.5g} ms, objective {told['objective']:.5g}; "
            said += "under the hand, on a coarse mesh" if dragged else told["verdict"]
            good = None if dragged else bool(told["verified"])
            self._verdict.say(f"{self._note}  {said}" if pending else said, good)

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

    # ---- beside each other ----------------------------------------------------------------------
    def _compared(self, motion: Said) -> list[Said]:
        ids = self.view("compared", [])
        return [m for m in self.state["motions"] if m["id"] in ids and m["id"] != motion["id"]]

    def _others(self, motion: Said) -> list[Said]:
        found = []
        for i, other in enumerate(self._compared(motion)):
            if self._is_of_now(other) and other["variable"] == motion["variable"]:
                told = self._told[other["id"]]
                found.append(
                    {
                        "t": told["t"],
                        "x": told["position"],
                        "colour": look.colour(i + 1),
                        "dash": DASHES[(i + 1) % len(DASHES)],
                    }
                )
        return found

    def _compare_rows(self, motion: Said) -> list[el.Row]:
        others = [m for m in self.state["motions"] if m["id"] != motion["id"]]
        compared = [m["id"] for m in self._compared(motion)]
        rows: list[el.Row] = [
            (
                Tick(f"beside {other['name']}"),
                other["id"] in compared,
                partial(self._set_compared, other["id"]),
            )
            for other in others
        ] or [el.words("Copy the motion to compare two plans.")]
        records = {d["id"]: d["name"] for d in self.state["data"] if d.get("is") == "record"}
        if records:
            menu = Menu("Record", {"": "none", **records})
            rows.append((menu, self.view("record", ""), self._set_record))
        return rows

    def _set_compared(self, id: str, on: bool) -> None:
        ids = [i for i in self.view("compared", []) if i != id]
        self.remember(compared=[*ids, id] if on else ids)
        self.bench.soon(self._plan_other(id))

    async def _plan_other(self, id: str) -> None:
        """The plan of a motion that is shown beside the one at hand, where it is not known yet."""
        other = self.session.item("motions", id)
        if other is not None and self._made_of.get(id) != self._key(other):
            key = self._made_of[id] = self._key(other)
            try:
                told = await self.work(jobs.planned, other, of=other["name"], latest="")
            except Exception:
                self._made_of.pop(id, None)
                raise
            self._last[id] = told
            if told["ok"]:
                self._told[id] = {**told, "of": key}
        self._show_at_hand()

    def _show_figures(self, motion: Said) -> None:
        self._figures.clear()
        shown = [motion] if motion["id"] in self._told else []
        shown += [m for m in self._compared(motion) if self._is_of_now(m)]
        with self._figures:
            if not shown:
                el.note("No plan yet.")
                return
            rows = []
            for name in self._told[shown[0]["id"]]["shown"]:
                rows.append([name, *[self._told[m["id"]]["shown"].get(name, "") for m in shown]])
            rows.append(["found in", *[f"{self._told[m['id']]['seconds']:.3g} s" for m in shown]])
            heads = [m["name"] + ("" if self._is_of_now(m) else ", before") for m in shown]
            el.table(["figure", *heads], rows, label="Figures of the plans")
            if self._record is not None and self._record["of"] == self._record_key(motion):
                self._show_record(self._record)

    def _show_record(self, record: Said) -> None:
        el.note(f"{record['name']} against the plan: largest and root mean square difference")
        rows = [
            [r["name"], f"{r['largest']:.4g} {r['unit']}", f"{r['rms']:.4g} {r['unit']}"]
            for r in record["rows"]
        ]
        el.table(["column", "largest", "rms"], rows, label="The record against the plan")

    # ---- records --------------------------------------------------------------------------------
    def _record_key(self, motion: Said) -> Any:
        """All that the comparison of a plan with the record depends on."""
        item = self.session.item("data", self.view("record", ""))
        return [self._key(motion), copy.deepcopy(item)]

    def _set_record(self, id: str) -> None:
        self.remember(record=id)
        self.bench.soon(self._replay())

    async def _dropped(self, event: events.UploadEventArguments) -> None:
        item = await taken(self, await dropped(self, event, kind="record"))
        self.remember(record=item["id"])
        self.session.put(f"add {item['name']}", "data", item)
        await self._replay()

    async def _replay(self) -> None:
        motion, item = self.at_hand, self.session.item("data", self.view("record", ""))
        if motion is None:
            return
        if item is not None:
            key = self._record_key(motion)
            found = await self.work(jobs.replayed, motion, item, of=item["name"])
            self._record = {**found, "of": key}
        self._show_at_hand()

    def _record_curve(self, motion: Said, factor: float) -> Said | None:
        if self._record is None or motion["variable"] not in self._record["curves"]:
            return None
        if self._record["of"][1] != self.session.item("data", self.view("record", "")):
            return None
        curve = self._record["curves"][motion["variable"]]
        return {"t": curve["t"], "x": [factor * v for v in curve["y"]]}


# ---- legs ----------------------------------------------------------------------------------------
def legs_with(durations: list[Any], i: int, cyclic: bool) -> list[Any]:
    """The legs' times with a stop more, the i-th: those that lead to it and from it are free."""
    legs = [*durations]
    if i == 0:
        return [None, *(legs[:-1] if cyclic else legs), *([None] if cyclic else [])]
    legs[i - 1 : i] = [None, None] if i <= len(legs) else [None]
    return legs


def legs_without(durations: list[Any], i: int, cyclic: bool) -> list[Any]:
    """The legs' times without the i-th stop: the one between its neighbours is free."""
    legs = [*durations]
    if i == 0:
        return [*legs[1:-1], None] if cyclic else legs[1:]
    legs[i - 1 : i + 1] = [None] if i < len(legs) else []
    return legs


# ---- pictures and words --------------------------------------------------------------------------
def curves(told: Mapping[str, Any]) -> dict[str, Any]:
    """All panels below each other, their units at the axes."""
    scale, unit = (1e3, "ms") if told["duration"] < 2 else (1.0, "s")
    t, rows = [scale * v for v in told["t"]], []
    for panel in told["panels"]:
        hover = f": %{{y:.4g}} {panel['unit']}<extra></extra>"
        drawn = []
        for k, name in enumerate(panel["names"]):
            colour, dash = style(name, k)
            more = {"line": {"dash": dash}, "hovertemplate": name + hover}
            drawn.append(look.line(t, told["columns"][name], name, colour, **more))
        rows.append((look.quantity(panel["unit"]), drawn))
    return look.panels(rows, f"time [{unit}]", each=130, hovermode="x")


def also(plant: Plant, variable: str) -> list[str]:
    """What stops may name beside the position: stiffness, pressures."""
    names = [v.name for v in (*plant.states, *plant.outputs)]
    chosen = ("stiffness", ".pressure")
    return [n for n in names if n != variable and n.endswith(chosen)]


def conflict(told: Mapping[str, Any]) -> tuple[str, int | None]:
    """(words, number of the stop in whose place they are said)."""
    for one in told["conflicts"]:
        if one["stop"] is not None:
            return one["words"], one["stop"]
    return (told["conflicts"][0]["words"], None) if told["conflicts"] else ("", None)


def style(name: str, k: int) -> tuple[str, str]:
    """Colour by muscle; commands and what else shares a muscle's colour are dashed."""
    owner = name.partition(".")[0]
    if owner.startswith("muscle"):
        number = owner.removeprefix("muscle")
        colour = look.COLOURS[(int(number) - 1 if number.isdigit() else 0) % len(look.COLOURS)]
        return colour, "dot" if name.endswith(".command") else "solid"
    return look.colour(k + 2), "solid"
