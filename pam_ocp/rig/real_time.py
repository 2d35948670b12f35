"""A controller's C code on a rig, in a process of its own with absolute deadlines (Linux).

The loop is ``c/real_time.c`` with what ``export_c`` writes of the controller, compiled here. It
shares memory with this process: what it is told (channels, guard, references), counts and
histograms, and a ring of rows, which are read, recorded and returned.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..control.references import source
from ..core.block import Block
from ..core.errors import InputError, UnknownNameError, require_count, require_positive
from ..core.interrupts import undisturbed
from ..core.trajectory import Trajectory
from ..export.c_code.package import export_c
from ..export.compile import compile_library, native
from ..plants.plant import Given, by_name
from .drivers.lines import MOD, LineDriver
from .guard import TRIPPED, RigError
from .running import STEP, Running

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .rig import Rig

Array: TypeAlias = NDArray[np.float64]

SERVER = Path(__file__).with_name("real_time_server.py")
MOST, INPUTS, BINS = 32, 256, 80
"""As in real_time.c."""
ROWS = 8192
"""Of the ring."""
LOOK = 0.01
"""How often the ring is read [s]."""
PATIENCE = 10.0
"""For the process to begin, and for the loop to vent and to end [s]."""
BENT = "; the loop in C takes straight ones alone: use closed_loop, or let the device calibrate"
BEATS = 4
"""Signs of life within the guard's heartbeat."""
(
    ENDED,
    STOPPED,
    LATE,
    OLD,
    NO_NUMBER,
    OUTSIDE,
    FAST,
    FROZEN,
    ASTRAY,
    NO_COMMAND,
    ALONE,
    NO_DOG,
) = range(12)


# ---- what is shared with real_time.c -------------------------------------------------------------
def _structure(name: str, **fields: Any) -> Any:
    """A structure of C with these fields, in order."""
    return type(name, (ctypes.Structure,), {"_fields_": [*fields.items()]})


def _all(kind: Any, names: str) -> dict[str, Any]:
    return dict.fromkeys(names.split(), kind)


_INT, _REAL = ctypes.c_int64, ctypes.c_double
_Reading = _structure(
    "_Reading",
    **_all(_REAL, "gain zero low high rate frozen filter deviation within"),
    **_all(_INT, "follows slope_of"),
    **_all(_REAL, "last at since astray slope"),
    **_all(_INT, "known away"),
)
_Command = _structure("_Command", **_all(_REAL, "gain zero low high rate begin sent offset"))
_Input = _structure("_Input", **_all(_INT, "source index"))
Shared = _structure(
    "Shared",
    **_all(_INT, "fd datagrams dog parent priority cpu standby"),
    **_all(_INT, "readings commands columns rows capacity steps bumpless"),
    **_all(_REAL, "period max_age late tolerated fade beat"),
    reading=_Reading * MOST,
    command=_Command * MOST,
    input=_Input * INPUTS,
    output=_INT * MOST,
    sequence=_INT,
    zero=_REAL,
    values=_REAL * MOST,
    stamp=_REAL,
    **_all(_INT, "go stop ready over head scheduler locked"),
    **_all(_INT, "samples missed answers unfit silent cause place vented"),
    **_all(_REAL, "figure reaction oldest latest longest"),
    lateness=_INT * BINS,
    busy=_INT * BINS,
)
"""Fields of ``shared`` in real_time.c, in its order."""


# ---- results -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Histogram:
    """How often something took how long: ``edges`` [s] (n + 1), ``counts`` (n), ``worst`` [s].

    Examples
    --------
    >>> print(pam.rig.Histogram([1e-6, 2e-6, 4e-6], [99, 1], 3e-6).text("late"))
    late [us]           samples
          1 .. 2             99 ####################
          2 .. 4              1 ####
    worst 3 us
    """

    edges: Any
    counts: Any
    worst: float

    def text(self, what: str) -> str:
        """Rows of numbers and bars, whose length is that of the logarithm."""
        counts = np.asarray(self.counts)
        there = np.flatnonzero(counts)
        rows = [f"{what + ' [us]':<17}{'samples':>10}"]
        largest = math.log(float(counts.max(initial=1)) + 1.0)
        for k in range(there[0], there[-1] + 1) if len(there) else ():
            low, high = (float(f"{1e6 * self.edges[i]:.2g}") for i in (k, k + 1))
            bar = "#" * math.ceil(20 * math.log(counts[k] + 1.0) / largest)
            rows.append(f"{low:>7g} .. {high:<7g}{counts[k]:>9} {bar}".rstrip())
        return "\n".join([*rows, f"worst {1e6 * self.worst:.3g} us"])

    def above(self, limit: float) -> int:
        """How many took longer than a limit [s], as far as the bins tell: at least so many."""
        return int(np.asarray(self.counts)[np.asarray(self.edges)[:-1] >= limit].sum())


def _histogram(bins: Any, worst: float) -> Histogram:
    """Of ten bins a decade five are left, which are told apart in print."""
    counts = np.array(bins[:])
    joined = np.concatenate([counts[:1], counts[1:-1].reshape(-1, 2).sum(axis=1), counts[-1:]])
    edges = 1e-6 * np.concatenate([[0.0], 10.0 ** np.arange(0.0, BINS / 10, 0.2), [math.inf]])
    return Histogram(edges[: len(joined) + 1], joined, worst)


@dataclass(frozen=True)
class RealTimeRun:
    """What the C loop did. Times in s.

    trajectory : readings and commands. lateness : of each sample against its deadline; busy : from
    there to the commands sent and written down. missed : samples later than the guard's
    ``tolerated``, or whose commands left after the next deadline. silent : samples to which no new
    answer had come; unfit : lines that were damaged or too old. lost : rows that nobody took out of
    the ring in time. surrounding : kernel, scheduler, processors and memory, in words. reason : why
    it was vented, "" for a run that went to its end. reaction : from the sample that found this
    reason to the vent line sent.

    Examples
    --------
    >>> late = pam.rig.Histogram([1e-6, 2e-6], [1000], 2e-6)
    >>> counts = dict(samples=1000, missed=0, answers=999, silent=1, unfit=0, lost=0, oldest=2e-3)
    >>> ended = dict(surrounding="Linux", reason="", reaction=2e-5)
    >>> pam.rig.RealTimeRun(motion, late, late, **counts, **ended)
    1000 samples, 0 missed deadlines (0); went to its end
    """

    trajectory: Trajectory
    lateness: Histogram
    busy: Histogram
    samples: int
    missed: int
    answers: int
    silent: int
    unfit: int
    lost: int
    oldest: float
    surrounding: str
    reason: str
    reaction: float

    def report(self) -> str:
        """In words, with the histograms."""
        share = self.missed / max(self.samples, 1)
        ended = f"vented: {self.reason}" if self.reason else "went to its end"
        return "\n".join(
            [
                f"{self.samples} samples, {self.missed} missed deadlines ({share:.2g}); {ended}",
                self.surrounding,
                f"{self.answers} answers, {self.silent} samples without a new one, {self.unfit} "
                f"unfit lines; the oldest reading was {1e3 * self.oldest:.3g} ms old",
                f"the vent line left {1e6 * self.reaction:.3g} us after the sample that ended the "
                "run had begun",
                self.lateness.text("late"),
                self.busy.text("busy"),
            ]
        )

    def plot(self) -> Figure:
        """The two histograms."""
        shown = {"late": self.lateness, "busy": self.busy}
        return courtesy.plot_durations({n: (h.edges, h.counts) for n, h in shown.items()})

    def __repr__(self) -> str:
        return self.report().partition("\n")[0]


class RealTimeError(RigError):
    """A run of the C loop that the guard ended; ``run`` is a :class:`RealTimeRun`.

    Examples
    --------
    >>> issubclass(pam.rig.RealTimeError, pam.rig.RigError)
    True
    """

    def __init__(self, words: str, run: RealTimeRun) -> None:
        super().__init__(words)
        self.run = run


# ---- what the loop is told -----------------------------------------------------------------------
def _sources(rig: Rig, law: Block, told: Mapping[str, int]) -> list[tuple[int, int]]:
    """(where from, which) of each input of the law; 0 for its start value."""
    readings, commands = list(rig.readings), list(rig.commands)
    found = []
    for variable in law.inputs:
        name = variable.name
        first, _, rest = name.partition(".")
        if name in told:
            found.append((3, told[name]))
        elif name in readings:
            found.append((1, readings.index(name)))
        elif first == "sent" and rest in commands:
            found.append((2, commands.index(rest)))
        elif first in ("wanted", "enable", "active", "limited", "held_back", "ahead", "place"):
            found.append((0, 0))
        else:
            raise InputError(
                f"{law.name} measures {name}, which {rig.name} does not read ({', '.join(readings)}"
                "); add a reading, put an estimator before the law (pam.control.chain), or give "
                f"wanted={{{name!r}: ...}}"
            )
    return found


def _table(law: Block, wanted: Mapping[str, Any], count: int) -> tuple[dict[str, int], Array]:
    """({input: column}, values of each sample) of what the law is told from outside."""
    units = {v.name: v.unit for v in law.inputs}
    columns: dict[str, int] = {}
    values: list[list[float]] = []
    for name, given in wanted.items():
        full = f"wanted.{name}" if f"wanted.{name}" in units else name
        if full not in units:
            raise UnknownNameError(f"input of {law.name}", name, units)
        at = source(f"wanted[{name!r}]", given, units[full])
        columns[full] = len(values)
        constant = not callable(given) and not isinstance(given, Mapping)
        times = [0.0] if constant else [k * law.sample_time for k in range(count)]
        values.append([at(t) for t in times])
    rows = max(map(len, values), default=1)
    table = [column * rows if len(column) == 1 else column for column in values]
    return columns, np.array(table, dtype=float).reshape(len(values), rows).T.copy()


def _library(law: Block) -> bytes:
    """The loop with the law, compiled, or from the cache."""
    sources = {"real_time.c": (resources.files(__package__) / "c/real_time.c").read_text("utf-8")}
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as place:
        folder = export_c(law, Path(place) / "law", name="law", steps=1)
        for name in ("law.c", "law.h", "elementary.h"):
            if (folder / name).is_file():
                sources[name] = (folder / name).read_text("utf-8")
    return compile_library(sources, "real_time.c", native(), "real_time")


class _Loop:
    """The process with its memory."""

    def __init__(self, rig: Rig, law: Block, table: Array, columns: Mapping[str, int]) -> None:
        width = 4 + len(rig.readings) + len(rig.commands)
        size = ctypes.sizeof(Shared) + 8 * (table.size + ROWS * width)
        shared_memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        self._folder = tempfile.TemporaryDirectory(prefix="pam_ocp_", dir=shared_memory)
        self._place = Path(self._folder.name)
        (self._place / "memory").write_bytes(bytes(size))
        with (self._place / "memory").open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        self.shared = Shared.from_buffer(self._memory)
        behind = np.frombuffer(self._memory, dtype=float, offset=ctypes.sizeof(Shared))
        behind[: table.size] = table.ravel()
        self._ring = behind[table.size :].reshape(ROWS, width)
        self._taken = self.lost = 0
        self._process: subprocess.Popen[bytes] | None = None
        fill(self.shared, rig, law, columns)
        self.shared.rows, self.shared.columns = table.shape
        self.shared.capacity = ROWS
        (self._place / "real_time.so").write_bytes(_library(law))

    @undisturbed
    def start(self, fds: tuple[int, ...]) -> None:
        """Begin, up to the moment at which it may go."""
        shared = self.shared
        shared.parent = os.getpid()
        parts = [SERVER, self._place / "real_time.so", self._place / "memory"]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", *map(str, parts)],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            pass_fds=fds,
            start_new_session=True,  # Ctrl-C is for this process, which stops the loop
        )
        until = time.monotonic() + PATIENCE
        while not shared.ready and self.alive and time.monotonic() < until:
            time.sleep(1e-3)
        if not shared.ready:
            raise RigError(f"the loop in C did not begin: {self._words()}")

    @property
    def alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _words(self) -> str:
        assert self._process is not None
        if self.alive:
            return f"nothing is heard of it for {PATIENCE:g} s"
        stream = self._process.stderr
        said = stream.read().decode("utf-8", "replace").strip() if stream else ""
        return said.rpartition("\n")[2] or f"its process ended ({self._process.returncode})"

    def rows(self) -> Array:
        """Those that have come since the last call."""
        head = int(self.shared.head)
        first = max(self._taken, head - ROWS)
        numbers = np.arange(first, head)
        rows = np.array(self._ring[numbers % ROWS])
        kept = max(int(self.shared.head) - ROWS, first)  # meanwhile others were written over
        self.lost += kept - self._taken
        self._taken = head
        return rows[kept - first :]

    def stop(self) -> None:
        """Let it vent and end; it is killed where it does not, and then the watchdog vents."""
        self.shared.stop = 1
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(PATIENCE)
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        """Let go of everything."""
        self.stop()
        if self._process is not None and self._process.stderr is not None:
            self._process.stderr.close()
        self._folder.cleanup()


def fill(shared: Any, rig: Rig, law: Block, columns: Mapping[str, int]) -> None:
    """Channels, guard and law as real_time.c has them; what it cannot have is said."""
    readings, commands = list(rig.readings), list(rig.commands)
    if max(len(readings), len(commands), len(columns)) > MOST or len(law.inputs) > INPUTS:
        raise InputError(
            f"the loop in C has room for {MOST} readings, commands and references each, and for "
            f"{INPUTS} inputs of a law"
        )
    for place, channel in zip(shared.reading, rig.readings.values(), strict=False):
        derived = bool(channel.slope_of)
        place.gain, place.zero = (1.0, 0.0) if derived else channel.line(BENT)
        place.zero -= rig.zeros.get(channel.name, 0.0)
        place.low, place.high, place.rate = channel.low, channel.high, channel.rate
        place.frozen = math.inf if channel.frozen is None else channel.frozen
        place.filter = channel.filter
        place.deviation, place.within = channel.deviation, channel.within
        place.follows = commands.index(channel.follows) if channel.follows else -1
        place.slope_of = readings.index(channel.slope_of) if derived else -1
    for place, command in zip(shared.command, rig.commands.values(), strict=False):
        place.gain, place.zero = command.line(BENT)
        place.low, place.high, place.rate = command.low, command.high, command.rate
    names = [v.name for v in law.outputs]
    for i, name in enumerate(commands):
        if name not in law.commands:
            raise InputError(
                f"{law.name} gives no command {name} ({', '.join(law.commands) or 'none at all'}); "
                "the loop in C sends all commands of the rig"
            )
        shared.output[i] = names.index(name)
    for place, (kind, index) in zip(shared.input, _sources(rig, law, columns), strict=False):
        place.source, place.index = kind, index
    guard = rig.guard
    shared.readings, shared.commands = len(readings), len(commands)
    shared.period = law.sample_time
    shared.max_age, shared.late = guard.max_age, guard.late
    shared.tolerated, shared.fade = guard.tolerated, guard.fade
    shared.beat = guard.heartbeat / BEATS


# ---- a run ---------------------------------------------------------------------------------------
def run_in_c(
    rig: Rig,
    controller: Any,
    duration: float,
    *,
    wanted: Mapping[str, Any] | None = None,
    start: Given | None = None,
    priority: int = 80,
    cpu: int | Sequence[int] | None = None,
    bumpless: bool = True,
    seen: Callable[[Array], Any] | None = None,
) -> RealTimeRun:
    """A controller as compiled C on an armed rig, at its sample time, without Python in the loop.

    Parameters
    ----------
    controller : a Block with commands, or what :func:`pam_ocp.control.block` makes one of. What it
        measures the rig reads; for more, chain an estimator before it.
    duration : [s]. wanted : {input of the block, "x" for "wanted.x": value, text with a unit, or
        function of time}; start : see :meth:`Rig.side`.
    priority : of SCHED_FIFO, 0 for none. cpu : the processor to run on, or two: a thread waits on
        each, and whichever wakes first takes the sample, which bridges the pauses of one processor.
        By default the last two that are allowed. What was granted the result's ``surrounding``
        says.
    bumpless : the step fades that the controller makes as it takes over. seen : is called with new
        rows (deadline, woken, stamp, sent [s], readings, commands) some hundred times a second.

    Raises RealTimeError where the guard vents; InputError for what the loop in C cannot do: drivers
    but "udp" and "serial", bent calibrations, other systems than Linux.
    """
    if sys.platform != "linux":
        raise InputError("the loop in C runs on Linux alone; use closed_loop here")
    driver = rig.driver
    if not isinstance(driver, LineDriver):
        raise InputError(
            f"the loop in C speaks the lines of the drivers udp and serial, not "
            f"{type(driver).__name__}; use closed_loop for it"
        )
    law = controller if isinstance(controller, Block) else Block.of(controller, plant=rig.plant)
    span = require_positive("duration", duration, "s")
    count = max(1, round(span / law.sample_time))
    columns, table = _table(law, wanted or {}, count)
    rig.require_armed()
    loop = _Loop(rig, law, table, columns)
    try:
        shared, dog = loop.shared, rig._watchdog
        shared.fd, shared.datagrams = driver.fileno(), driver.datagrams
        shared.dog = -1 if dog is None else dog.told
        shared.steps, shared.priority = count, require_count("priority", priority, 0, 99)
        shared.cpu, shared.standby = _processors(cpu)
        shared.bumpless = bumpless
        loop.start((driver.fileno(), *(() if dog is None else (dog.told,))))
        return _run(rig, loop, driver, start, seen)
    finally:
        loop.close()


def _processors(cpu: int | Sequence[int] | None) -> tuple[int, int]:
    """The processor of the loop and that of the thread that stands by; -1 for none."""
    allowed = sorted(os.sched_getaffinity(0))
    if cpu is None:
        return (allowed[-1], allowed[-2]) if len(allowed) > 1 else (-1, -1)
    given = list(cpu) if isinstance(cpu, Sequence) else [cpu]
    for one in given:
        if require_count("cpu", one, 0, 1023) not in allowed:
            told = ", ".join(map(str, allowed))
            raise InputError(f"cpu = {cpu!r}: this process may run on {told}")
    if not 1 <= len(set(given)) == len(given) <= 2:
        raise InputError(f"cpu = {cpu!r}: give one processor, or two that differ")
    return given[0], given[1] if len(given) > 1 else -1


def _run(
    rig: Rig,
    loop: _Loop,
    driver: LineDriver,
    start: Given | None,
    seen: Callable[[Array], Any] | None,
) -> RealTimeRun:
    shared, taken = loop.shared, list[Array]()
    with Running(rig, rig.sample_time) as run:
        target = {n: float(v) for n, v in by_name("start", start).items() if n in rig.commands}
        if target:
            run.approach(target)
        for place, name in zip(shared.command, rig.commands, strict=False):
            place.begin = place.sent = run.sent[name]
        shared.values[: len(run.values)] = list(run.values.values())
        shared.stamp, shared.sequence = run.stamp, driver.sequence
        with _going(loop, driver):
            for rows in _rows(rig, loop):
                taken.append(rows)
                _record(run, rows)
                if seen is not None:
                    seen(rows)
        found = _result(rig, loop, np.concatenate(taken), run.zero)
        run.samples, run.missed, run.lost = found.samples, found.missed, found.silent
        run.latest = [float(r[1] - r[0]) for rows in taken for r in rows]
        if found.reason:
            raise RealTimeError(found.reason, found)
    return found


@contextmanager
def _going(loop: _Loop, driver: LineDriver) -> Iterator[None]:
    """The loop goes; however this is left, it stands, and the driver counts on from there."""
    loop.shared.go = 1
    try:
        yield
    finally:
        loop.stop()
        driver.sequence = int(loop.shared.sequence) % MOD


def _rows(rig: Rig, loop: _Loop) -> Iterator[Array]:
    """Rows as they come, until the loop is over, or dead."""
    while True:
        ended = bool(loop.shared.over) or not loop.alive
        yield loop.rows()
        if ended:
            return
        if rig._watchdog is not None and rig._watchdog.heard_trip():
            loop.stop()
        time.sleep(LOOK)


def _record(run: Running, rows: Array) -> None:
    """Written as :class:`Running` writes: at the time of the readings, or of the commands."""
    count = len(run.rig.readings)
    for row in rows:
        read, sent = row[2] - run.zero, row[3] - run.zero
        run.at = read if read > run.at else max(sent, run.at + STEP)
        values = row[4:].tolist()
        run.stamp = row[2]
        run.values = dict(zip(run.rig.readings, values[:count], strict=True))
        run.sent = dict(zip(run.rig.commands, values[count:], strict=True))
        run._write_down()


def _result(rig: Rig, loop: _Loop, rows: Array, zero: float) -> RealTimeRun:
    shared = loop.shared
    t = np.where(np.diff(rows[:, 2], prepend=-math.inf) > 0, rows[:, 2], rows[:, 3]) - zero
    for k in range(1, len(t)):
        t[k] = max(t[k], t[k - 1] + STEP)
    columns = {v.name: rows[:, 4 + i].copy() for i, v in enumerate(rig.variables)}
    begun = t[0] if len(t) else 0.0
    return RealTimeRun(
        Trajectory(t - begun, columns, rig.variables, "previous"),
        _histogram(shared.lateness, float(shared.latest)),
        _histogram(shared.busy, float(shared.longest)),
        samples=int(shared.samples),
        missed=int(shared.missed),
        answers=int(shared.answers),
        silent=int(shared.silent),
        unfit=int(shared.unfit),
        lost=loop.lost,
        oldest=float(shared.oldest),
        surrounding=_surrounding(shared),
        reason=_reason(rig, shared),
        reaction=float(shared.reaction),
    )


def _surrounding(shared: Any) -> str:
    """Kernel, scheduler and memory, in words."""
    kernel = "not a real-time kernel: nothing is guaranteed"
    with suppress(OSError):
        if Path("/sys/kernel/realtime").read_text().strip() == "1":
            kernel = "a real-time kernel"
    scheduler = f"SCHED_FIFO {shared.priority}" if shared.priority else "the usual scheduler"
    if shared.scheduler:
        scheduler = f"SCHED_FIFO is not allowed ({os.strerror(shared.scheduler)})"
    memory = "memory locked"
    if shared.locked:
        memory = f"memory could not be locked ({os.strerror(shared.locked)})"
    places = [f"processor {n}" for n in (shared.cpu, shared.standby) if n >= 0]
    places = [", standing by on ".join(places)] if places else []
    system = f"{platform.system()} {platform.release()}, {kernel}"
    return "; ".join([system, scheduler, *places, memory])


def _reason(rig: Rig, shared: Any) -> str:
    """Why the loop vented, as guard.py says it; "" for a run that went to its end."""
    if not shared.over:
        return "the process of the loop in C has died; the watchdog vents"
    cause, place, v = int(shared.cause), int(shared.place), float(shared.figure)
    dog = rig._watchdog
    if cause in (ENDED, STOPPED) and dog is not None and dog.tripped:
        return TRIPPED
    if cause == ENDED and shared.vented:
        return ""
    channels: list[Any] = list((rig.commands if cause == NO_COMMAND else rig.readings).values())
    c = channels[place] if place >= 0 else channels[0]
    words = {
        ENDED: "the rig did not answer when it was to vent at the end of a run",
        STOPPED: "the run was stopped",
        LATE: f"the loop was {1e3 * v:.3g} ms late, {1e3 * rig.guard.late:g} ms are allowed",
        OLD: f"the newest reading is {1e3 * v:.3g} ms old, {1e3 * rig.guard.max_age:g} ms are "
        "allowed: nothing valid comes in",
        NO_NUMBER: f"{c.name} is no number",
        OUTSIDE: f"{c.name} = {v:g} {c.unit} has left {c.low:g} .. {c.high:g}",
        FAST: f"{c.name} changes by {v:.3g} {c.unit}/s, {c.rate:g} are allowed",
        FROZEN: f"{c.name} has stayed the same to the last digit for {1e3 * v:.3g} ms",
        ASTRAY: f"{c.name} is {v:g} {c.unit} away from {getattr(c, 'follows', '')} for too long: "
        "look at supply, valve and cable",
        NO_COMMAND: f"the command {c.name} = {v} is no number",
        ALONE: "the process that started the loop is gone",
        NO_DOG: "the watchdog's process has ended",
    }
    return words[cause]
