"""The process that holds the rig of the page: it reads, arms, homes and moves.

    python -m pam_ocp.bench.rig_worker FILE.toml [--allow-code]

Commands come as JSON, a line each, ``{"do": "arm" | "disarm" | "home" | "move" | "rest" | "end"}``
with ``"targets"`` (of a move, also while it is under way) and ``"level"`` (of home); what it reads
and how it stands goes out in the same way. An interrupt is the vent button's: what was asked before
(``"at"``, monotonic clock [s]) is not done after it, however late it is read.
"""

from __future__ import annotations

import json
import math
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from ..core.errors import PamError
from ..rig.rig import Rig, load_rig
from ..rig.running import Running

OFTEN = 0.05
"""Between two rows that are shown [s]."""
BEHIND = 200
"""Lines that wait for a page that does not read; further ones are dropped: nothing waits for it."""


class Pressed(KeyboardInterrupt):
    """The vent button was pressed."""


class Tap:
    """A driver whose answers are shown besides."""

    def __init__(self, driver: Any, show: Any) -> None:
        self._driver, self._show = driver, show
        self.sent: dict[str, float] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def read(self) -> dict[str, float]:
        """As the driver's own."""
        found: dict[str, float] = self._driver.read()
        self._show(found)
        return found

    def write(self, inputs: Mapping[str, float]) -> None:
        """As the driver's own."""
        self._driver.write(inputs)
        self.sent = dict(inputs)

    def vent(self) -> None:
        """As the driver's own."""
        self.sent = {}
        self._driver.vent()


class Worker:
    """The rig, its commands and what is said of it."""

    def __init__(self, rig: Rig, told: Callable[[Any], None]) -> None:
        self.rig, self._told = rig, told
        self._out: queue.Queue[dict[str, Any]] = queue.Queue(BEHIND)
        self._in: queue.Queue[dict[str, Any]] = queue.Queue()
        self._shown = 0.0
        self._tap: Any = Tap(rig.driver, self._show)
        rig.driver = self._tap
        self._begun = time.monotonic()
        self.doing = ""
        self._open = self._pressed = False
        self._pressed_at = -math.inf

    # ---- to and from the page -------------------------------------------------------------------
    def say(self, **said: Any) -> None:
        """A line to the page; dropped where nobody reads."""
        with suppress(queue.Full):
            self._out.put_nowait(said)

    def _tell(self) -> None:
        while True:
            self._told(self._out.get())

    def _listen(self) -> None:
        for line in sys.stdin:
            self._in.put(json.loads(line))
        self._in.put({"do": "end"})
        os.kill(os.getpid(), signal.SIGINT)  # the page is gone

    def _show(self, raw: Mapping[str, float]) -> None:
        now = time.monotonic()
        if now - self._shown < OFTEN:
            return
        self._shown = now
        seen = self.rig.taken(raw)
        seen.pop("time")
        commands = self.rig.commands
        sent = {n: commands[n].si(v) for n, v in self._tap.sent.items()} or self.rig.vented
        self.say(t=now - self._begun, values={**seen, **sent}, **self.state)

    @property
    def state(self) -> dict[str, Any]:
        """How it stands."""
        return {"armed": self.rig.armed, "reason": self.rig.reason, "doing": self.doing}

    # ---- the work -------------------------------------------------------------------------------
    def run(self) -> None:
        """Until the page is gone."""
        for work in (self._tell, self._listen):
            threading.Thread(target=work, daemon=True).start()
        going = True
        while going:
            try:
                going = self._interruptible()
            except Pressed as error:
                self._pressed, self.doing = False, ""
                self.rig.vent(str(error))
                self.say(error=str(error), **self.state)
            except PamError as error:
                self.doing = ""
                self.say(error=str(error), **self.state)

    def pressed(self, number: int, frame: Any) -> None:
        """The vent button's signal: ends the work that is going on, or the next that would begin.
        Words to the page are never cut.
        """
        self._pressed, self._pressed_at = True, time.monotonic()
        if self._open:
            raise Pressed("the vent button was pressed")

    def _interruptible(self) -> bool:
        try:
            self._open = True
            if self._pressed:
                raise Pressed("the vent button was pressed")
            return self._once()
        finally:
            self._open = False

    def _once(self) -> bool:
        try:
            asked = self._in.get(timeout=OFTEN)
        except queue.Empty:
            self.rig.read()
            return True
        if asked.get("at", math.inf) < self._pressed_at:
            return True
        self.doing = asked["do"]
        work: dict[str, Callable[[], Any]] = {
            "arm": self.rig.arm,
            "disarm": self.rig.disarm,
            "home": partial(self._home, asked),
            "move": partial(self._move, asked),
        }
        if self.doing in work:
            self.say(**self.state)
            work[self.doing]()
        going = self.doing != "end"
        self.doing = ""
        self.say(**self.state)
        return going

    def _home(self, asked: Mapping[str, Any]) -> None:
        found = self.rig.home(level=asked.get("level"))
        self.say(report=found.report(), **self.state)

    def _move(self, asked: Mapping[str, Any]) -> None:
        """Commands go to their targets at their rates ``soft`` until something else is asked."""
        rig, targets = self.rig, dict(asked.get("targets", {}))
        step = rig.sample_time
        with Running(rig, step) as run:
            now = dict(run.sent)
            while True:
                while not self._in.empty():
                    more = self._in.queue[0]
                    if more["do"] != "move":
                        return
                    targets |= self._in.get().get("targets", {})
                for name, command in rig.commands.items():
                    way = float(command.soft or 1.0) * step
                    goal = float(targets.get(name, rig.vented[name]))
                    now[name] += min(max(goal - now[name], -way), way)
                run.step(now)


def main(arguments: list[str]) -> None:
    """Hold a rig until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # until there is something to be vented
    page = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what drivers and a user's own code print is nothing that the page reads

    def told(said: Any) -> None:
        page.write(json.dumps(said) + "\n")
        page.flush()

    try:
        rig = load_rig(arguments[0], allow_code="--allow-code" in arguments)
    except PamError as error:
        told({"error": str(error), "over": True})
        return
    emergency = getattr(rig.driver, "emergency", lambda: None)()
    how = None if emergency is None else emergency.told
    channels = [
        {
            "name": v.name,
            "unit": v.unit,
            "low": v.min,
            "high": v.max,
            "is": v.causality,
            "vent": rig.vented.get(v.name),
        }
        for v in rig.variables
    ]
    told({"name": rig.name, "channels": channels, "emergency": how})
    with rig:
        worker = Worker(rig, told)
        signal.signal(signal.SIGINT, worker.pressed)
        worker.run()


if __name__ == "__main__":
    main(sys.argv[1:])
