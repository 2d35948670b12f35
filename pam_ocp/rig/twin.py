"""A twin: a plant behind the channels of a rig, in real or simulated time, with its faults.

It moves when somebody looks: each call integrates up to the present time of its clock.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.expressions import SYMBOLIC, carried_out, steps_of
from ..core.quantities import known_keys, quantity
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..numerics.solvers import Buffered
from ..plants.plant import Given, Plant, by_name, require_plant
from ..simulation.instruments import Instrument, readers_of
from ..simulation.sampled import stepped
from .channels import Clock, Command, Reading, RealClock, channels_of, usual_channels

Array: TypeAlias = NDArray[np.float64]
KEPT = 500_000
"""Moments of the past that a twin remembers."""
REST = 3.0
"""[s]."""


class Twin:
    """A plant that behaves like a rig: read and written by channels, in time.

    Parameters
    ----------
    plant : any Plant, with its losses (hysteresis, creep), which may differ from what controllers
        believe.
    readings, commands : channels as the rig has them; by default positions, pressures and controls.
    clock : by default that of the world; a ``SimulatedClock``, shared with the rig, runs as quickly
        as it can.
    scale : of the muscles' forces, 1.2 for 20 % more than the plant's own.
    sensors : {reading: Instrument}: noise, delay, steps, filter, bias, drift of its SI value.
    delay : from a command to its effect [s].
    faults : Fault, or tables as files hold them.
    timeout : [s] without a command after which it vents by itself, as good terminals do.
    start : states at the beginning; by default it has stood vented for some seconds. step : longest
    step of the integration [s].

    It vents (all commands at their vent values) until :meth:`arm`, and again after :meth:`vent`.
    Raises InputError for invalid input.

    Examples
    --------
    >>> clock = pam.rig.SimulatedClock()
    >>> seen = {"x": pam.simulation.Instrument(noise=1e-5)}
    >>> twin = pam.rig.Twin(plant, clock=clock, sensors=seen)
    >>> twin.arm()
    >>> twin.write({"muscle.command": 3e5})
    >>> clock.wait(1.0)
    >>> twin.read()["x"] > 0.01
    True
    """

    @verb
    def __init__(
        self,
        plant: Plant,
        readings: Any = None,
        commands: Any = None,
        *,
        clock: Clock | None = None,
        scale: float = 1.0,
        sensors: Mapping[str, Instrument] | None = None,
        delay: float = 0.0,
        faults: Iterable[Any] = (),
        timeout: float | None = None,
        start: Given | None = None,
        step: float = 1e-3,
        seed: int = 0,
    ) -> None:
        self.plant = require_plant(plant).with_values(by_name("start", start))
        usual = usual_channels(self.plant)
        self.readings = usual[0] if readings is None else channels_of(Reading, readings, plant)
        self.commands = usual[1] if commands is None else channels_of(Command, commands, plant)
        self.clock = clock or RealClock()
        self.delay = require_positive("delay", delay, "s", zero=True)
        self.timeout = None if timeout is None else require_positive("timeout", timeout, "s")
        self._longest = require_positive("step", step, "s")
        self._names = [v.name for v in (*self.plant.states, *self.plant.outputs)]
        self._require_names()
        units = {n: c.unit for n, c in (*self.readings.items(), *self.commands.items())}
        self.faults = faults_of(faults, units)
        known = {n: self.plant.variable(n) for n in self._own}
        for name in sensors or {}:
            if name not in known:
                raise UnknownNameError("reading of the twin", name, known)
        self._readers = readers_of(sensors, known, seed)
        # of each step; the others read what is now
        self._told = any(r.instrument.remembers for r in self._readers.values())
        self.scale = scale = require_positive("scale", scale)
        functions = self.plant.cached(("twin", scale), lambda: _functions(self.plant, scale))
        self._advance, self._look = (Buffered(f) for f in functions)
        self._x, self._p = self.plant.vector("state"), self.plant.vector("parameter")
        self._u0 = self.plant.vector("input")
        self._places = {n: [v.name for v in self.plant.inputs].index(n) for n in self.commands}
        self._vent = {n: float(c.vent or 0.0) for n, c in self.commands.items()}
        self._lock = threading.RLock()
        self._began = self._now = self._heard = self.clock.now()
        self._sent: deque[tuple[float, dict[str, float]]] = deque()
        self._acting = dict(self._vent)
        self._stuck: dict[tuple[Fault, str], Any] = {}
        self._odd = False
        self.armed = False
        self.vented_at: float | None = self._began
        """When it vented last, on its clock [s]; None while it acts."""
        self.past: deque[tuple[float, Array, Array]] = deque(maxlen=KEPT)
        if start is None:
            u = self._inputs(-math.inf)
            for _ in range(math.ceil(REST / self._longest)):
                self._x = self._advance(self._x, u, self._p, self._longest)[0][:, 0].copy()

    def _require_names(self) -> None:
        inputs = [v.name for v in self.plant.inputs]
        derived = {n for n, r in self.readings.items() if r.slope_of}
        self._own = [n for n in self.readings if n not in derived and n != "supply"]
        for name in self._own:
            if name not in self._names:
                raise UnknownNameError("state or output of the plant", name, self._names)
        for name in self.commands:
            if name not in inputs:
                raise UnknownNameError("input of the plant", name, inputs)

    # ---- a device -------------------------------------------------------------------------------
    def now(self) -> float:
        """On the twin's clock [s]."""
        return self.clock.now()

    @property
    def answers(self) -> bool:
        """Whether the cable is in."""
        with self._lock:
            self._go_on()
            return self._fault("cable", self._now - self._began) is None

    def read(self) -> dict[str, float] | None:
        """Raw numbers by the names of the readings, and ``"time"``; None where nothing answers."""
        with self._lock:
            self._go_on()
            t = self._now - self._began
            if self._fault("cable", t):
                return None
            stale = self._fault("stale", t)
            if stale is not None and (stale, "") in self._stuck:
                return dict(self._stuck[stale, ""])
            self._odd, true = not self._odd, self._true()
            found = {n: self._raw(n, self._sensed(n, t, true[n])) for n in self._own}
            if "supply" in self.readings:
                found["supply"] = self._supply(t)
            found["time"] = self._now
            if stale is not None:
                self._stuck[stale, ""] = dict(found)
            return found

    def write(self, inputs: Mapping[str, float]) -> None:
        """Raw numbers by the names of the commands: taken within their range, if numbers at all."""
        values = {n: c.si(inputs[n]) for n, c in self.commands.items() if n in inputs}
        with self._lock:
            self._go_on()
            if self._fault("cable", self._now - self._began):
                return
            self._heard = self._now
            ends = self.commands
            good = {
                n: min(max(v, ends[n].low), ends[n].high)
                for n, v in values.items()
                if math.isfinite(v)
            }
            if self.armed:
                self._sent.append((self._now + self.delay, good))
                self._go_on()

    def vent(self) -> None:
        """All commands at their vent values until :meth:`arm`; not where the cable is out."""
        with self._lock:
            self._go_on()
            if not self._fault("cable", self._now - self._began):
                self._close_down()

    def arm(self) -> None:
        """Commands act from now on."""
        with self._lock:
            self._go_on()
            if not self._fault("cable", self._now - self._began):
                self.armed, self.vented_at, self._heard = True, None, self._now

    def tick(self) -> None:
        """Nobody asks for anything: go on with time all the same."""
        with self._lock:
            self._go_on()

    @property
    def values(self) -> dict[str, float]:
        """True states and outputs now [SI]."""
        with self._lock:
            self._go_on()
            return self._true()

    @property
    def acting(self) -> dict[str, float]:
        """Commands as they act now [SI]."""
        with self._lock:
            self._go_on()
            return dict(self._acting)

    def motion(self) -> Trajectory:
        """What truly happened at the moments when somebody looked (states and inputs)."""
        with self._lock:
            rows = list(self.past)
        if not rows:
            raise InputError("nobody has looked at this twin yet: there is no motion")
        t = np.array([r[0] for r in rows]) - self._began
        keep = np.append(np.diff(t) > 0, True)
        variables = (*self.plant.states, *self.plant.inputs)
        data = np.hstack([np.array([r[1] for r in rows]), np.array([r[2] for r in rows])])[keep]
        columns = {v.name: data[:, i] for i, v in enumerate(variables)}
        return Trajectory(t[keep], columns, variables, "previous")

    def change(self, **values: float) -> None:
        """Other values of parameters from now on [SI], such as a leak; "_" may stand for "."."""
        with self._lock:
            self._go_on()
            places = {v.name: i for i, v in enumerate(self.plant.parameters)}
            for name, value in values.items():
                variable = self.plant.variable(name)
                if variable.name not in places:
                    raise UnknownNameError("parameter of the twin", name, places)
                self._p[places[variable.name]] = variable.check(value)

    # ---- its inside -----------------------------------------------------------------------------
    def _close_down(self) -> None:
        self._sent.clear()
        if self.armed or self.vented_at is None:
            self.vented_at = self._now
        self.armed, self._acting = False, dict(self._vent)

    def _fault(self, kind: str, t: float, channel: str = "") -> Fault | None:
        for fault in self.faults:
            if fault.kind == kind and fault.channel == channel and fault.on(t):
                return fault
        return None

    def _go_on(self) -> None:
        """Integrate to the present, with commands that take effect and time-outs on the way."""
        now = self.clock.now()
        while self._now < now:
            end = now
            if self._sent and self._sent[0][0] <= now:
                end = max(self._sent[0][0], self._now)
            lost = math.inf if self.timeout is None else self._heard + self.timeout
            end = min(end, max(lost, self._now)) if self.armed else end
            self._integrate(end)
            if self.armed and end >= lost:
                self._close_down()
            self._take()
        self._take()

    def _take(self) -> None:
        while self._sent and self._sent[0][0] <= self._now:
            self._acting |= self._sent.popleft()[1]

    def _integrate(self, end: float) -> None:
        span = end - self._now
        if span <= 0:
            return
        u = self._inputs(self._now - self._began)
        count = max(1, math.ceil(span / self._longest - 1e-9))
        for k in range(count):
            self._x = self._advance(self._x, u, self._p, span / count)[0][:, 0].copy()
            if self._readers and (self._told or k == count - 1):
                t, true = self._now + span * (k + 1) / count, self._true_at(u)
                for name, reader in self._readers.items():
                    reader.tell(t, true[name])
        if not np.all(np.isfinite(self._x)):
            raise InputError(
                f"the twin of {self.plant.name!r} cannot be integrated in steps of "
                f"{1e3 * self._longest:g} ms; give a smaller step"
            )
        self._now = end
        self.past.append((end, self._x, u))

    def _inputs(self, t: float) -> Array:
        """Inputs of the plant as they act: through faults of commands and of the supply."""
        u = self._u0.copy()
        lost = self._fault("supply", t)
        for name, place in self._places.items():
            value, vent = self._acting[name], self._vent[name]
            valve, zone = self._fault("valve", t, name), self._fault("dead_zone", t, name)
            if valve is not None:
                value = self._stuck.setdefault((valve, name), value)
            if zone is not None:
                beyond = max(abs(value - vent) - zone.value, 0.0)
                value = vent + math.copysign(beyond, value - vent)
            u[place] = vent if lost is not None else value
        return np.asarray(u)

    def _true(self) -> dict[str, float]:
        return self._true_at(self._inputs(self._now - self._began))

    def _true_at(self, u: Array) -> dict[str, float]:
        y = self._look(self._x, u, self._p)[0]
        return dict(zip(self._names, [*self._x.tolist(), *y[:, 0].tolist()], strict=True))

    def _sensed(self, name: str, t: float, value: float) -> float:
        """A reading in SI of a true value, with its instrument and its faults."""
        if name in self._readers:
            reader = self._readers[name]
            if not reader.times:
                reader.tell(self._now, value)
            value = reader.read(self._now)
        for kind, change in _CHANGES.items():
            fault = self._fault(kind, t, name)
            if fault is not None:
                value = change(fault, value, t - fault.at, self._odd)
        stuck = self._fault("stuck", t, name)
        return value if stuck is None else float(self._stuck.setdefault((stuck, name), value))

    def _supply(self, t: float) -> float:
        """The raw number of the supply's pressure: the highest command, or nothing."""
        highest = max(c.high for c in self.commands.values())
        return self._raw("supply", 0.0 if self._fault("supply", t) else highest)

    def _raw(self, name: str, value: float) -> float:
        channel = self.readings[name]
        zero, one = channel.si(0.0), channel.si(1.0)
        return (value - zero) / (one - zero)  # a bent calibration is straight to a twin


_CHANGES: dict[str, Callable[[Fault, float, float, bool], float]] = {
    "gain": lambda f, v, t, odd: v * f.value,
    "bias": lambda f, v, t, odd: v + f.value,
    "drift": lambda f, v, t, odd: v + f.value * t,
    "spike": lambda f, v, t, odd: v + f.value * odd,
    "nan": lambda f, v, t, odd: math.nan,
}


def _functions(plant: Plant, scale: float) -> tuple[ca.Function, ca.Function]:
    """(x, u, p, h) -> x one L-stable step later, and (x, u, p) -> outputs; forces scaled."""
    x, u, p = (
        ca.SX.sym(n, v.numel()) for n, v in zip("xup", (plant.x, plant.u, plant.p), strict=True)
    )
    own = plant.function
    rates, outputs = (
        own(x, u, p)[:2]
        if scale == 1.0
        else forces_changed(plant, lambda name, force: scale * force, x, u, p)
    )
    nominal = plant.vector("state", attribute="nominal")
    slopes = ca.Function("slopes", [x, u, p], [rates, ca.jacobian(rates, x)])
    z, h = ca.SX.sym("z", x.numel()), ca.SX.sym("h")

    def slopes_at(y: ca.SX) -> tuple[ca.SX, ca.SX]:
        value, jacobian = slopes(y * nominal, u, p)
        return value / nominal, jacobian * (nominal[None, :] / nominal[:, None])

    after = stepped(slopes_at, z, h, "rosenbrock", 1) * nominal
    for i, v in enumerate(plant.states):
        if v.memory:  # elements that slide are stiffer than a step is short
            after[i] = ca.fmin(ca.fmax(after[i], v.min), v.max)
    whole = ca.Function("step", [z, u, p, h], [after])
    # slopes repeat what rates are made of: half of all instructions
    step = ca.Function("step", [x, u, p, h], [whole(x / nominal, u, p, h)], {"cse": True})
    return step, ca.Function("look", [x, u, p], [ca.densify(outputs)])


def forces_changed(
    plant: Plant, change: Callable[[str, ca.SX], ca.SX], x: ca.SX, u: ca.SX, p: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Rates and outputs with every muscle's force changed, wherever it stands; change(name, force).

    The plant's expressions are walked in the order of their evaluation; what a force is stored as
    is changed before anything else makes use of it.
    """
    forces = [v.name for v in plant.outputs if v.name.endswith(".force")]
    if not forces:
        raise InputError(
            f"{plant.name!r} has no output that ends in '.force', whose scale could be changed; "
            "scale its own parameters"
        )
    first = [plant.expression(n) for n in forces]
    rates = ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states))
    outputs = ca.vertcat(*(plant.expression(v.name) for v in plant.outputs))
    walked = ca.Function(
        "walked", [plant.x, plant.u, plant.p], [*first, ca.densify(rates), ca.densify(outputs)]
    )
    entries = [walked.numel_out(i) for i in range(walked.n_out())]

    def changed(result: int, value: ca.SX) -> ca.SX:
        return change(forces[result], value) if result < len(first) else value

    given = [e.__getitem__ for e in (x, u, p)]
    found = carried_out(steps_of(walked), SYMBOLIC, given, entries, ca.SX, changed)
    return ca.vertcat(*found[-2]), ca.vertcat(*found[-1])


# ---- faults: from when to when, where, and how much ----------------------------------------------
FAULTS: dict[str, str] = {
    "stuck": "a reading stays where it is",
    "nan": "a reading is no number",
    "bias": "a reading is shifted by value",
    "gain": "a reading is multiplied by value",
    "drift": "a reading drifts by value per second",
    "spike": "a reading jumps by value at every other look",
    "valve": "a command has no effect any more: the last one stays",
    "dead_zone": "commands less than value from their vent value have no effect",
    "cable": "nothing is answered, and nothing arrives",
    "stale": "the same answer again and again, with its time",
    "supply": "the supply is lost: all commands act as vented",
}
"""Kinds, in words."""
OF_A_READING = ("stuck", "nan", "bias", "gain", "drift", "spike")
OF_A_COMMAND = ("valve", "dead_zone")
SIZED = ("bias", "gain", "drift", "spike", "dead_zone")


@dataclass(frozen=True)
class Fault:
    """What goes wrong in a twin.

    kind : one of ``FAULTS``. channel : the reading or command that it concerns. value : its size in
    SI, of those that have one. at, until : [s] after the twin began.

    Examples
    --------
    >>> pam.rig.Fault("stuck", "x", at=2.0).on(2.5)
    True
    """

    kind: str
    channel: str = ""
    value: float = math.nan
    at: float = 0.0
    until: float = math.inf

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise UnknownNameError("kind of fault", self.kind, FAULTS)
        if bool(self.channel) != (self.kind in OF_A_READING + OF_A_COMMAND):
            needs = "no channel" if self.channel else "the channel that it concerns"
            raise InputError(f"fault {self.kind!r} ({FAULTS[self.kind]}): give it {needs}")
        if math.isfinite(self.value) != (self.kind in SIZED):
            raise InputError(
                f"fault {self.kind!r} ({FAULTS[self.kind]}): value = {self.value:g}; give it "
                + ("a finite value" if self.kind in SIZED else "none")
            )
        if not self.at < self.until:
            raise InputError(f"fault {self.kind!r}: at = {self.at:g} s must be before until")

    def on(self, t: float) -> bool:
        """Whether it acts, at a time after the beginning [s]."""
        return self.at <= t < self.until


def faults_of(given: Iterable[Any], units: Mapping[str, str]) -> tuple[Fault, ...]:
    """Faults of tables, as ``[[fault]]`` of a file holds them. units : of the channels, SI."""
    found = []
    for said in given:
        if isinstance(said, Fault):
            found.append(said)
            continue
        if not isinstance(said, Mapping):
            raise InputError(
                f"fault = {said!r}: give a table, as {{ kind = 'stuck', channel = 'x' }}"
            )
        known_keys("fault", said, ("kind", "channel", "value", "at", "until"))
        kind, channel = said.get("kind"), str(said.get("channel", ""))
        plain = ("1",) if kind == "gain" else (units.get(channel, "1"), "1")
        per = (f"{units[channel]}/s",) if kind == "drift" and channel in units else plain
        options = {n: quantity(f"fault.{n}", said[n], "s") for n in ("at", "until") if n in said}
        if "value" in said:
            options["value"] = quantity("fault.value", said["value"], *per)
        found.append(Fault(str(kind), channel, **options))
    for fault in found:
        if fault.channel and fault.channel not in units:
            raise UnknownNameError("channel of the twin", fault.channel, units)
    return tuple(found)
