"""The tab Rig: live readings, the guard's state, arming, moving, and the vent button, which is a
page of another process (rig/vent_server.py) in a frame.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import ui

from ...core.units import display_unit
from ...core.units import unit as unit_of
from .. import elements as el
from .. import look
from ..elements import Number, Tick
from ..pictures import Plot
from ..rig_room import RigRoom
from ..tab import Tab

LEGEND: dict[str, Any] = {"legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0.0}}
SOON = 0.25
"""Between two looks at the rig [s]."""
LATE = 1.0
"""Without a word of the rig's process, after which that is shown [s]."""
NEAR = Tick("Nobody is near, the emergency stop works")
DOING = {"arm": "arming", "disarm": "disarming", "home": "homing", "move": "moving"}
LEVEL = Number("Highest command", "Pa", 0.0, 2e6, shown="bar")


class RigTab(Tab):
    """One rig, seen by all browsers."""

    title = "Rig"

    def build(self) -> None:
        assert self.bench.room is not None
        self._room: RigRoom = self.bench.room
        self._near, self._level = False, 3e5
        self._targets: dict[str, float] = {}
        self._plots: dict[str, Plot] = {}
        self._told = (len(self._room.errors), len(self._room.reports))
        self._last: Any = None
        with el.split():
            with el.side():
                self._frame = el.box("Vent")
                with el.section("Guard"):
                    self._state = el.note("", "bench-verdict")
                    self._state._props["role"] = "status"
                    self._reason = el.note("")
                self._arm_form = el.form("Arm")
                self._move_form = el.form("Move")
                with el.section("Home"):
                    self._home_form = el.Form()
                    self._report = el.tag("pre", "", "bench-pre")
            with el.plots():
                self._pictures = ui.element("div").style("display: contents")
        ui.timer(SOON, self._look)
        self._look()

    # ---- what is shown --------------------------------------------------------------------------
    def _look(self) -> None:
        room = self._room
        if room.about and not self._plots:
            self._begin()
        state, late = room.state, room.silent > LATE
        words = "armed" if state["armed"] else "not armed: the air is out"
        words += f"; {DOING.get(state['doing'], state['doing'])}" if state["doing"] else ""
        if late:
            words = f"nothing is heard of the rig for {room.silent:.0f} s: vent"
        now = (words, state["reason"], state["armed"], bool(state["doing"]), self._near)
        if now != self._last:
            self._last = now
            self._state.set_text(words)
            self._state.classes(remove="bench-bad", add="bench-bad" if late else "")
            self._reason.set_text(f"vented: {state['reason']}" if state["reason"] else "")
            self._forms()
        for text in room.errors[self._told[0] :]:
            self.bench.say(text, "error")
        for text in room.reports[self._told[1] :]:
            self._report.set_text(text)
        self._told = (len(room.errors), len(room.reports))
        self._draw()

    def _begin(self) -> None:
        """Once the channels are known: a plot for each unit, the vent button."""
        units = dict.fromkeys(c["unit"] for c in self._room.about["channels"])
        with self._pictures:
            for unit in units:
                names = [c["name"] for c in self._of(unit)]
                with el.section(", ".join(names), wide=True):
                    self._plots[unit] = Plot(
                        f"{', '.join(names)} over time",
                        empty="What is read and sent, once the rig answers",
                    )
        with self._frame:
            if self._room.about["emergency"] is None:
                el.note("This driver has no way for a button of its own: use the emergency stop.")
                return
            host = self.bench.client.request.url.hostname
            address = f"http://{host}:{self._room.vent_port}/{self._room.token}"
            frame = ui.element("iframe").style("width: 100%; height: 130px; border: 0")
            frame._props.update(src=address, title="Vent the rig")
            el.tag("a", "Open the button in a window of its own", href=address, target="_blank")

    def _of(self, unit: str) -> list[dict[str, Any]]:
        return [c for c in self._room.about["channels"] if c["unit"] == unit]

    def _draw(self) -> None:
        rows = list(self._room.rows)
        if not rows:
            return
        t = [row[0] - rows[-1][0] for row in rows]
        for unit, plot in self._plots.items():
            shown = display_unit(unit)
            factor = unit_of(shown).factor
            curves = [
                {
                    "x": t,
                    "y": [row[1].get(c["name"], float("nan")) / factor for row in rows],
                    "name": c["name"],
                    "mode": "lines",
                    "line": {"shape": "hv" if c["is"] == "input" else "linear"},
                }
                for c in self._of(unit)
            ]
            label = f"[{shown}]" if shown != "1" else ""
            plot.draw(look.figure(curves, "time before now [s]", label, height=240, **LEGEND))

    # ---- what is asked --------------------------------------------------------------------------
    def _forms(self) -> None:
        armed, busy = self._room.state["armed"], bool(self._room.state["doing"])
        arm: list[el.Row] = [(NEAR, self._near, self._said_near)]
        if armed:
            arm = [el.buttons({"Disarm": lambda: self._room.ask("disarm")})]
        elif self._near and self._room.about.get("emergency"):
            arm.append(el.buttons({"Arm": self._arm}, main="Arm"))
        self._arm_form.show(arm)
        if not armed:
            hint = [el.words("Arm the rig first.")]
            self._move_form.show(hint)
            self._home_form.show(hint)
            return
        commands = [c for c in self._room.about["channels"] if c["is"] == "input"]
        rows: list[el.Row] = []
        for c in commands:
            target = self._targets.setdefault(c["name"], c["vent"])
            command = Number(c["name"], c["unit"], c["low"], c["high"])
            rows.append((command, target, partial(self._aim, c["name"])))
        moves = {"Stop and vent": lambda: self._room.ask("rest")}
        if not busy:
            moves = {"Move": self._move}
        self._move_form.show([*rows, el.buttons(moves, main=next(iter(moves)))])
        self._home_form.show(
            [
                (LEVEL, self._level, lambda v: setattr(self, "_level", v)),
                el.buttons({"Home": lambda: self._room.ask("home", level=self._level)}),
            ]
        )

    def _said_near(self, value: bool) -> None:
        self._near = value
        self._look()

    def _arm(self) -> None:
        self._near = False  # to be said each time
        self._room.ask("arm")

    def _aim(self, name: str, value: float) -> None:
        self._targets[name] = value
        if self._room.state["doing"] == "move":
            self._move()
        self._forms()

    def _move(self) -> None:
        self._room.ask("move", targets=self._targets)
