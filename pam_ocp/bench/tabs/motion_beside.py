"""Of the tab Motion: the motion at hand, others beside it, and records compared with it."""

from __future__ import annotations

import copy
from functools import partial
from typing import Any

from nicegui import events, ui

from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..guard import MOST_UPLOAD
from ..jobs import motion as jobs
from ..jobs.data import look_at
from ..made import plant_of
from ..tab import Page, Tab
from .motion_shown import with_unit

__all__ = ["Beside", "Said"]

DASHES = ("", "7 4", "2 3", "9 3 2 3")
Said = dict[str, Any]


class Beside(Tab):
    """Motions of the session, and what is known of each."""

    _figures: ui.element

    def __init__(self, bench: Page) -> None:
        super().__init__(bench)
        self._told: dict[str, Said] = {}  # the last plans
        self._last: dict[str, Said] = {}  # what came of the last attempts
        self._made_of: dict[str, Any] = {}
        self._record: Said | None = None

    def _show_plan(self, motion: Said, plant: Plant, told: Said | None = None) -> None:
        raise NotImplementedError

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

    def _told_state(self) -> Said:
        """What a process must know."""
        return {k: self.state[k] for k in ("plant", "muscle", "data")}

    # ---- beside each other ----------------------------------------------------------------------
    def _compared(self, motion: Said) -> list[Said]:
        ids = self.bench.session.view("Motion", "compared", [])
        return [m for m in self.state["motions"] if m["id"] in ids and m["id"] != motion["id"]]

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

    def _compare(self, motion: Said) -> None:
        others = [m for m in self.state["motions"] if m["id"] != motion["id"]]
        compared = [m["id"] for m in self._compared(motion)]
        if not others:
            el.note("Copy the motion to compare two plans.")
        for other in others:
            el.check(
                f"beside {other['name']}",
                other["id"] in compared,
                partial(self._set_compared, other["id"]),
            )
        records = {d["id"]: d["name"] for d in self.state["data"] if d.get("is") == "record"}
        if records:
            el.choice("Record", {"": "none", **records}, self._record_id, self._set_record)
        el.upload(
            "Drop a record of the motion here",
            self._dropped,
            lambda: self.bench.say("the file was refused: it is too large", "error"),
            max_file_size=MOST_UPLOAD,
        )

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
                    row.append("" if value is None else with_unit(plant, name, value))
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
