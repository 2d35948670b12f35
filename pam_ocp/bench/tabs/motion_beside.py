"""Of the tab Motion: others beside the motion at hand, records compared with it; its pictures."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import partial
from typing import Any

from nicegui import events, ui

from ...plants.plant import Plant
from .. import elements as el
from .. import look
from ..elements import Menu, Tick
from ..jobs import motion as jobs
from ..made import plant_of
from ..tab import Members, Page
from .data import dropped, taken

DASHES = ("", "7 4", "2 3", "9 3 2 3")
Said = dict[str, Any]


class Beside(Members):
    """Motions of the session, and what is known of each."""

    part = "motions"
    _figures: ui.element

    def __init__(self, bench: Page) -> None:
        super().__init__(bench)
        self._told: dict[str, Said] = {}  # the last plans
        self._last: dict[str, Said] = {}  # what came of the last attempts
        self._made_of: dict[str, Any] = {}
        self._record: Said | None = None

    def _show_plan(self, motion: Said, plant: Plant, told: Said | None = None) -> None:
        raise NotImplementedError

    def _plant(self) -> Plant:
        return plant_of(self.world)

    def _key(self, motion: Said) -> Any:
        said = {k: v for k, v in motion.items() if k != "name"}
        return copy.deepcopy([self.state["muscle"], self.state["plant"], said])

    # ---- beside each other ----------------------------------------------------------------------
    def _compared(self, motion: Said) -> list[Said]:
        ids = self.view("compared", [])
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
        other, motion = self.session.item("motions", id), self.at_hand
        if other is not None and id not in self._told:
            told = await self.work(jobs.planned, other, of=other["name"], latest="")
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
    def _set_record(self, id: str) -> None:
        self.remember(record=id)
        self._record = None
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
            self._record = await self.work(jobs.replayed, motion, item, of=item["name"])
        self._show_plan(motion, self._plant())

    def _record_curve(self, motion: Said, factor: float) -> Said | None:
        if self._record is None or motion["variable"] not in self._record["curves"]:
            return None
        curve = self._record["curves"][motion["variable"]]
        return {"t": curve["t"], "x": [factor * v for v in curve["y"]]}


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


def with_unit(plant: Plant, name: str, value: float) -> str:
    if name == "duration":
        return f"{1e3 * value:.5g} ms"
    if name.startswith("max("):
        return plant.variable(name[4:-1]).shown(value)
    return f"{value:.4g}"
