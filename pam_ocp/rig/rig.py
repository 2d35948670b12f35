"""A real rig under a guard: channels, arming, venting, runs; a side of closed loops."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import courtesy
from ..core.errors import InputError, UnknownNameError, require_instance, require_positive
from ..core.files import read_toml, reading
from ..core.interrupts import undisturbed
from ..core.quantities import known_keys, quantity, table
from ..core.variables import Variable
from ..plants.plant import Given, Plant
from ..plants.plant_file import plant_of
from .channels import Clock, Command, Reading, RealClock, channels_of, usual_channels
from .drift import Monitor
from .drivers.driver import DRIVERS, Driver
from .guard import Guard, RigError, Watch, Watchdog

if TYPE_CHECKING:
    from ..control.sides import Side
    from ..core.trajectory import Trajectory
    from ..courtesy import Homing, Identified, Learned, RealTimeRun, Tuned

PAST = 4000
"""Samples of the past that are kept."""
PATIENCE, PAUSE = 0.25, 0.005
"""How long a vent is sent again where no answer comes, and how often [s]; the watchdog's way is
taken besides.
"""


class Rig:
    """A rig on a bench, or its twin, as a side of :func:`pam_ocp.closed_loop`.

    Parameters
    ----------
    driver : a :class:`Driver`, such as ``pam.rig.driver("modbus", host=...)`` or one's own.
    readings, commands : channels (Reading, Command), or tables of them as files have; by default
        positions, pressures and controls of ``plant``, in SI.
    plant : the model; says units and ranges, and is what :meth:`identify` fits.
    guard : what is allowed. sample_time : of runs that do not say another [s].
    record : folder for the records of all runs; None for none.
    watchdog : a process of its own that vents where this one is late or dead. It needs a driver
        that has an ``emergency()``, and the clock of the world.
    clock : that of a twin in simulated time.

    Nothing is sent before :meth:`arm`. Every run ends vented, however it ends; what the guard ends
    has to be armed again. No software makes a rig safe: see docs/rig.md.

    Examples
    --------
    >>> clock = pam.rig.SimulatedClock()
    >>> twin = pam.rig.Twin(plant, clock=clock)
    >>> rig = pam.Rig(pam.rig.driver("twin", twin=twin), plant=plant, clock=clock)
    >>> rig.arm()
    >>> loop = pam.closed_loop(lambda t, seen: {"muscle.command": 3e5}, rig, duration=1.0)
    >>> bool(loop["x"][-1] > 0.03), rig.armed
    (True, True)
    """

    def __init__(
        self,
        driver: Driver,
        readings: Any = None,
        commands: Any = None,
        *,
        plant: Plant | None = None,
        guard: Guard | None = None,
        sample_time: float = 0.005,
        record: str | os.PathLike[str] | None = None,
        watchdog: bool = True,
        clock: Clock | None = None,
        name: str = "rig",
    ) -> None:
        for method in ("read", "write", "vent", "close"):
            if not callable(getattr(driver, method, None)):
                raise InputError(f"driver has no {method}(); a driver has read, write, vent, close")
        require_instance("plant", plant, Plant, "give the model of the rig, a Plant", none=True)
        if plant is None and (readings is None or commands is None):
            raise InputError("give readings and commands, or a plant that says what they are")
        usual = usual_channels(plant) if plant is not None else ({}, {})
        self.driver, self.plant, self.name = driver, plant, name
        self.readings = usual[0] if readings is None else channels_of(Reading, readings, plant)
        self.commands = usual[1] if commands is None else channels_of(Command, commands, plant)
        self._require_channels()
        self.guard = guard or Guard()
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.record, self.clock = record, clock or RealClock()
        self._wanted_watchdog = watchdog and self.clock.real
        self._watchdog: Watchdog | None = None
        self._armed = self._running = False
        self.reason = ""
        """Why the guard vented last; "" where it did not."""
        self.vented = {n: float(c.vent or 0.0) for n, c in self.commands.items()}
        self.zeros: dict[str, float] = {}
        """What readings show where they should show nothing [SI]: taken off; found by home()."""
        if not self.clock.real and hasattr(driver, "now"):
            driver.now = self.clock.now  # its stamps are to be those of a twin's time
        self.past: deque[tuple[float, dict[str, float]]] = deque(maxlen=PAST)
        """What was read lately, and when by the stamps [s]."""
        self.monitor: Monitor | None = None
        """Watches runs for what drifts."""
        if hasattr(driver, "open"):
            driver.open(self.readings, self.commands)

    def _require_channels(self) -> None:
        if not self.readings or not self.commands:
            raise InputError("a rig needs at least one reading and one command")
        before = [n for n, c in self.readings.items() if not c.slope_of]
        for name, channel in self.readings.items():
            for other, known in (
                (channel.slope_of, self.readings),
                (channel.follows, self.commands),
            ):
                if other and other not in known:
                    raise UnknownNameError(f"channel that {name} belongs to", other, known)
            if channel.slope_of:
                if channel.slope_of not in before:
                    raise InputError(
                        f"{name}: slope_of = {channel.slope_of!r} is a slope itself, which has to "
                        f"stand before {name}"
                    )
                before.append(name)
        for command in self.commands.values():
            command.require_range()

    @property
    def variables(self) -> tuple[Variable, ...]:
        """Readings as they are called in the plant, and commands as its inputs."""
        readings = [c.variable(self.plant) for c in self.readings.values()]
        commands = [
            replace(c.variable(self.plant), min=c.low, max=c.high, start=None)
            for c in self.commands.values()
        ]
        return (*readings, *commands)

    @property
    def armed(self) -> bool:
        """Whether runs may begin."""
        return self._armed

    # ---- looking --------------------------------------------------------------------------------
    def read(self) -> dict[str, float]:
        """The readings now [SI], and ``"time"``. Raises RigError where no valid answer comes."""
        try:
            return self.taken(self.driver.read())
        except Exception as error:  # of a driver of one's own: anything
            raise RigError(f"{self.name}: nothing valid is read: {error}") from error

    def taken(self, raw: Mapping[str, float]) -> dict[str, float]:
        """Raw numbers in SI; slopes are left out. Raises KeyError where one is missing."""
        found = {
            n: c.si(float(raw[n])) - self.zeros.get(n, 0.0)
            for n, c in self.readings.items()
            if not c.slope_of
        }
        return {**found, "time": float(raw["time"])}

    def check(self, duration: float = 0.5) -> dict[str, dict[str, float]]:
        """Read for a while, move nothing: {reading: mean, deviation, lowest, highest} [SI] and
        ``{"time": {"rate", "missing", "oldest"}}`` (answers per second, how many stayed out, age of
        the oldest [s]). Raises RigError where nothing valid comes at all.
        """
        import numpy as np

        duration = require_positive("duration", duration, "s")
        rows, missing, oldest = [], 0, 0.0
        begin = self.clock.now()
        count = max(2, round(duration / self.sample_time))
        for k in range(count):
            try:
                seen = self.read()
                oldest = max(oldest, self.clock.now() - seen.pop("time"))
                rows.append(seen)
            except RigError as error:
                missing += 1
                cause = error
            self.clock.wait(begin + (k + 1) * self.sample_time)
        if not rows:
            raise cause
        found = {}
        for name in rows[0]:
            column = np.array([row[name] for row in rows])
            numbers = (column.mean(), column.std(), column.min(), column.max())
            found[name] = dict(
                zip(("mean", "deviation", "lowest", "highest"), map(float, numbers), strict=True)
            )
        span = max(self.clock.now() - begin, 1e-9)
        found["time"] = {"rate": len(rows) / span, "missing": float(missing), "oldest": oldest}
        return found

    # ---- arming and venting ---------------------------------------------------------------------
    def arm(self) -> None:
        """Allow runs: look at all readings, start the watchdog, vent once to see that it can be.

        Raises RigError where something is not as it should be; then nothing is armed.
        """
        if self._armed:
            return
        self.reason = ""
        watch = Watch(
            self.guard, {n: c for n, c in self.readings.items() if not c.slope_of}, self.commands
        )
        if hasattr(self.driver, "synchronise"):
            self.driver.synchronise()
        self.read()
        seen = self.read()
        words = watch.look(self.clock.now(), seen, seen["time"], self.vented)
        if words:
            raise RigError(f"{self.name} is not armed: {words}")
        if self._wanted_watchdog:
            emergency = getattr(self.driver, "emergency", lambda: None)()
            if emergency is None:
                raise RigError(
                    f"{self.name} is not armed: its driver has no emergency(), by which a watchdog "
                    "could vent; give it one, or say watchdog=False and know that nothing vents "
                    "when this process hangs"
                )
            self._stop_watchdog()  # one that has vented vents on, whatever it is told
            self._watchdog = Watchdog(emergency, self.guard.heartbeat)
        try:
            self.driver.vent()
            self._let_act()
        except Exception as error:
            self._stop_watchdog()
            raise RigError(
                f"{self.name} is not armed: it does not take commands ({error})"
            ) from error
        self._armed = True

    def require_armed(self) -> None:
        """RigError where it is not."""
        if not self._armed:
            why = f" (it was vented: {self.reason})" if self.reason else ""
            raise RigError(
                f"{self.name} is not armed{why}; look that nobody is near, and call rig.arm()"
            )

    def _let_act(self) -> None:
        """Only with vent values behind it, so that nothing moves."""
        if hasattr(self.driver, "arm"):
            self.driver.arm()
        self.driver.write({n: c.raw_vent for n, c in self.commands.items()})

    @undisturbed
    def vent(self, reason: str = "") -> bool:
        """Let the air out, now. Whether the rig answered; the watchdog vents besides.

        reason : why; a rig that was vented for one has to be armed again.
        """
        if reason:
            self.reason, self._armed = self.reason or reason, False
        if self._watchdog is not None and reason:
            self._watchdog.vent()
        until = self.clock.now() + PATIENCE
        while self.clock.now() < until:
            try:
                self.driver.vent()
            except Exception:  # whatever it is, it is tried again
                if self._watchdog is not None:
                    self._watchdog.vent()
                self.clock.wait(self.clock.now() + PAUSE)
                continue
            if self._watchdog is not None and not reason:
                self._watchdog.idle()
            return True
        return False

    def disarm(self) -> None:
        """Vent, end the watchdog; nothing moves until :meth:`arm`."""
        self.vent()
        self._armed = False
        self._stop_watchdog()

    def _stop_watchdog(self) -> None:
        if self._watchdog is not None:
            self._watchdog.close()
            self._watchdog = None

    def close(self) -> None:
        """Disarm and let go of the transport."""
        if self._armed or self._watchdog is not None:
            self.disarm()
        self.driver.close()

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- runs -----------------------------------------------------------------------------------
    def side(self, sample_time: float, start: Given | None = None) -> Side:
        """For :func:`pam_ocp.closed_loop`, which calls it. start : inputs to be reached softly
        before the run begins, by name or those of an operating point.
        """
        return courtesy.RigSide(self, sample_time, start)

    def run(
        self,
        inputs: Callable[[float], Mapping[str, float]] | Trajectory,
        duration: float | None = None,
        *,
        start: Given | None = None,
    ) -> Trajectory:
        """Play inputs: a function of time, or those of a trajectory (a plan, a designed signal).

        Returns what was read and sent; see :func:`pam_ocp.closed_loop` for controllers.
        """
        return courtesy.run_on(self, inputs, duration, start)

    def run_in_c(self, controller: Any, duration: float, **options: Any) -> RealTimeRun:
        """A controller as compiled C in a loop of its own process: see
        :func:`pam_ocp.rig.real_time.run_in_c`.
        """
        return courtesy.run_in_c(self, controller, duration, **options)

    def about(self) -> dict[str, Any]:
        """Channels with their calibrations, and the guard: what stands beside records."""
        channels = {n: asdict(c) for n, c in (*self.readings.items(), *self.commands.items())}
        kind = type(self.driver).__name__
        when = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        return {
            "rig": self.name,
            "driver": kind,
            "channels": channels,
            "zeros": dict(self.zeros),
            "guard": asdict(self.guard),
            "begun": when,
        }

    def home(self, **options: Any) -> Homing:
        """Zero of sensors, range, slack, leak: see :func:`pam_ocp.rig.homing.home`."""
        return courtesy.home(self, **options)

    def identify(self, free: Sequence[Any], **options: Any) -> Identified:
        """Fit the plant to designed excitations; see :func:`pam_ocp.rig.learning.identify`."""
        return courtesy.identify(self, free, **options)

    def tune(self, **options: Any) -> Tuned:
        """Training motions for tracking of any shape: see :func:`pam_ocp.rig.tuning.tune`."""
        return courtesy.tune(self, **options)

    def learn(self, motion: Any, track: str, **options: Any) -> Learned:
        """Iterative learning along a motion: see :func:`pam_ocp.rig.learning.learn`."""
        return courtesy.learn(self, motion, track, **options)

    def __repr__(self) -> str:
        state = "armed" if self._armed else f"vented: {self.reason}" if self.reason else "not armed"
        return f"<Rig {self.name!r}, {state}: reads {', '.join(self.readings)}>"


# ---- a rig in a file: driver, channels, guard, model ---------------------------------------------
KEYS = (
    "name",
    "driver",
    "sample_time",
    "record",
    "watchdog",
    "plant",
    "readings",
    "commands",
    "guard",
    "fault",
)
HELP = "see docs/rig.md: it has tables [driver], [plant], [readings], [commands], [guard]"


def driver(kind: str, **arguments: Any) -> Driver:
    """A driver by its kind ("modbus", "serial", "udp", "opcua", "ros", "twin") and its arguments.

    Raises UnknownNameError, InputError.

    Examples
    --------
    >>> pam.rig.driver("udp", host="127.0.0.1", port=9750, timeout="5 ms").timeout
    0.005
    """
    name = DRIVERS.name("driver.kind", kind)
    known = DRIVERS.arguments(name)
    known_keys(f"driver ({name})", arguments, known)
    given = {
        n: quantity(f"driver.{n}", v, *known[n].units)
        if isinstance(v, str) and known[n].units
        else v
        for n, v in arguments.items()
    }
    try:
        made: Driver = DRIVERS[name](**given)
    except TypeError as error:
        raise InputError(f"driver ({name}): {error}") from None
    return made


def load_rig(path: str | os.PathLike[str], *, allow_code: bool = False, **changes: Any) -> Rig:
    """The rig that a TOML file describes; nothing is sent.

    allow_code : the file may name a plant as FILE.py:NAME. changes : arguments of :class:`Rig` that
    take the place of what the file says.

    Raises InputError, naming file, key and what is allowed.

    Examples
    --------
    >>> _ = open("bench.toml", "w").write('''
    ... driver = { kind = "udp", host = "127.0.0.1", port = 9750 }
    ... [plant]
    ... arrangement = "HangingLoad"
    ... muscle = "DMSP-20-300"
    ... ''')
    >>> pam.rig.load_rig("bench.toml")
    <Rig 'bench', not armed: reads x, muscle.pressure>
    """
    content = read_toml(path)
    with reading(path, "a rig", HELP):
        return rig_of(content, Path(path), allow_code=allow_code, **changes)


def plant_in(content: Any, path: Path, allow_code: bool) -> Plant | None:
    """The model of a rig's file, if it has one: a table, or another file with a table [plant]."""
    said = content.get("plant")
    if isinstance(said, str):
        said = read_toml(path.parent / said).get("plant")
    return None if said is None else plant_of(said, "plant", path.parent, allow_code=allow_code)


def rig_of(content: Any, path: Path, *, allow_code: bool = False, **changes: Any) -> Rig:
    """The rig of a file's content."""
    known_keys(path.name, content, KEYS)
    arguments: dict[str, Any] = {"name": str(content.get("name", path.stem))}
    if "sample_time" in content:
        arguments["sample_time"] = quantity("sample_time", content["sample_time"], "s")
    if "record" in content:
        arguments["record"] = path.parent / str(content["record"])
    if "watchdog" in content:
        if not isinstance(content["watchdog"], bool):
            raise InputError(f"watchdog = {content['watchdog']!r}: give true or false")
        arguments["watchdog"] = content["watchdog"]
    for name in ("readings", "commands"):
        if name in content:
            arguments[name] = table(name, content[name])
    guard = dict(table("guard", content.get("guard", {})))
    known_keys("guard", guard, ("max_age", "late", "heartbeat", "fade", "tolerated"))
    arguments |= {"guard": Guard(**guard), "plant": plant_in(content, path, allow_code), **changes}
    if "driver" not in arguments:
        if "driver" not in content:
            raise InputError(
                "driver is missing; give a table such as { kind = 'modbus', host = ... }"
            )
        said = dict(table("driver", content["driver"]))
        if "kind" not in said:
            raise InputError(f"driver.kind is missing; give one of {', '.join(DRIVERS)}")
        kind = said.pop("kind")
        if kind == "twin":
            raise InputError("driver.kind = 'twin': a twin in this process is made in Python alone")
        arguments["driver"] = driver(kind, **said)
    return Rig(arguments.pop("driver"), **arguments)
