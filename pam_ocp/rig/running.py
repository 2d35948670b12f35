"""A run: sample after sample with absolute deadlines, everything looked at by the guard."""

from __future__ import annotations

import errno
import math
import os
import platform
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.errors import InputError, with_kinds
from ..core.exceptions import WriteError
from ..core.files import json_of, make_folder, write_json
from ..core.trajectory import HELD, Trajectory
from ..core.variables import Variable, variable_of
from .channels import Reading
from .guard import SILENT, RigError, Watch

if TYPE_CHECKING:
    from .rig import Rig

STEP = 1e-6
"""[s], by which rows differ at least."""
SETTLED = 0.3
"""How long a soft start waits where it has arrived, at least [s]."""
PATIENCE = 10.0
"""How long it waits for rest, at most [s]."""
STILL = 1e-3
"""At rest, means over quarters of ``SETTLED`` differ by at most this share of a reading's range (or
as noise lets them): what swings on from one run to the next is in no two runs the same."""


class Running:
    """A run of an armed rig. ``values`` : newest readings [SI]; ``sent`` : commands that act.

    Left by ``with``, however that is, the rig is vented and the record closed.
    """

    def __init__(self, rig: Rig, sample_time: float) -> None:
        rig.require_armed()
        if rig._running:
            raise RigError(f"{rig.name} is under way already; end that run first")
        self.rig, self.sample_time = rig, sample_time
        self.watch = Watch(rig.guard, rig.readings, rig.commands)
        self.sent = dict(rig.vented)
        self.values: dict[str, float] = {}
        self.stamp = self.at = -math.inf
        self.samples = self.missed = self.lost = 0
        self.latest: list[float] = []
        """By how much each sample was late [s]."""
        self.rows: list[tuple[float, list[float]]] = []
        """(time, readings and commands) of each sample, as a record has them."""
        self._slopes: dict[str, tuple[float, float, float]] = {}
        self._cause = ""
        self._record: RecordWriter | None = None
        rig._running = True
        try:
            rig.driver.vent()
            rig._let_act()
            self._begin()
        except BaseException as error:
            self._end(error)
            if isinstance(error, RigError | InputError) or not isinstance(error, Exception):
                raise
            raise RigError(f"{rig.name} does not answer: {error}") from error

    def _begin(self) -> None:
        rig = self.rig
        if rig.monitor is not None:
            rig.monitor.begin()
        if rig.record is not None:
            self._record = RecordWriter(rig.record, rig.variables, rig.about())
        self.zero = self.deadline = rig.clock.now()
        self._take()
        if not self.values:
            raise RigError(f"{rig.name}: nothing valid is read: {self._cause}")
        self.zero = self.stamp
        self._judge()
        self._accepted = rig.clock.now()

    # ---- one sample -----------------------------------------------------------------------------
    def step(self, asked: Mapping[str, float]) -> None:
        """Send commands, hold them for a sample, read. Raises RigError; then the rig is vented."""
        try:
            self._step(asked)
        except BaseException as error:
            self.rig.vent(str(error) or type(error).__name__)
            raise

    def _step(self, asked: Mapping[str, float]) -> None:
        rig = self.rig
        self.sent = self.watch.limited(asked, self.sent, self.sample_time)
        try:
            rig.driver.write({n: c.raw(self.sent[n]) for n, c in rig.commands.items()})
            self._accepted = rig.clock.now()
        except Exception as error:  # a driver of one's own may raise anything
            self.lost += 1
            self._cause = str(error)
            self._require_accepted()
        self._mark()
        self._write_down()
        dog = rig._watchdog
        if dog is not None and (words := dog.beat()):
            raise RigError(words)
        self.deadline += self.sample_time
        rig.clock.wait(self.deadline)
        late = rig.clock.now() - self.deadline
        self.samples += 1
        self.latest.append(late)
        if late > rig.guard.tolerated * self.sample_time:
            self.missed += 1
        if late > rig.guard.late:
            raise RigError(
                f"the loop was {1e3 * late:.3g} ms late, {1e3 * rig.guard.late:g} ms are allowed"
            )
        self._take()
        self._judge()

    def _require_accepted(self) -> None:
        """Readings may come while no command goes out; the last one that was taken acts on."""
        age, most = self.rig.clock.now() - self._accepted, self.rig.guard.max_age
        if age > most:
            raise RigError(
                f"no command has been taken for {1e3 * age:.3g} ms, {1e3 * most:g} ms are allowed "
                f"({self._cause})"
            )

    def _take(self) -> None:
        """The newest readings; those before stay where nothing valid comes."""
        try:
            seen = self.rig.taken(self.rig.driver.read())
        except Exception as error:  # a driver of one's own may raise anything
            self.lost += 1
            self._cause = str(error)
            return
        stamp = seen.pop("time")
        self._cause = ""
        if stamp < self.stamp:
            return  # an older answer
        for name, channel in self.rig.readings.items():
            if channel.slope_of:
                seen[name] = self._slope(name, seen[channel.slope_of], stamp, channel.filter)
        self.values, self.stamp = {n: seen[n] for n in self.rig.readings}, stamp
        self.rig.past.append((stamp, self.values))

    def _slope(self, name: str, value: float, stamp: float, filter_time: float) -> float:
        """Filtered slope of another reading [SI/s]."""
        last, at, slope = self._slopes.get(name, (value, stamp, 0.0))
        if stamp > at:
            share = math.exp(-(stamp - at) / filter_time)
            slope = share * slope + (1 - share) * (value - last) / (stamp - at)
        self._slopes[name] = value, stamp, slope
        return slope

    def _judge(self) -> None:
        words = self.watch.look(self.rig.clock.now(), self.values, self.stamp, self.sent)
        if words:
            silent = words.endswith(SILENT) and self._cause
            raise RigError(words + (f" ({self._cause})" if silent else ""))

    def _write_down(self) -> None:
        row = [*self.values.values(), *(self.sent[n] for n in self.rig.commands)]
        self.rows.append((self.at, row))
        if self._record is not None:
            self._record.row(self.at, row)
        if self.rig.monitor is not None:
            self.rig.monitor.sample(self.at, self.values, self.sent)

    def _mark(self) -> None:
        """For the row to come: when the readings were taken, or, where they are those of the row
        before, when the commands were sent.
        """
        sent = max(self.rig.clock.now() - self.zero, self.at + STEP)
        self.at = self.time if self.time > self.at else sent

    @property
    def time(self) -> float:
        """When the newest readings were taken, from the first ones on [s]."""
        return self.stamp - self.zero

    # ---- begin and end --------------------------------------------------------------------------
    def approach(self, target: Mapping[str, float]) -> None:
        """A soft start: to commands at each one's rate ``soft``, and wait there for rest."""
        rig = self.rig
        goal = {n: v for n, v in target.items() if n in rig.commands}
        span = max(
            (abs(v - self.sent[n]) / float(rig.commands[n].soft or 1.0) for n, v in goal.items()),
            default=0.0,
        )
        begin, count = dict(self.sent), math.ceil(span / self.sample_time)
        for k in range(count):
            part = (k + 1) / count
            self.step({n: begin[n] + part * (v - begin[n]) for n, v in goal.items()})
        window = 4 * math.ceil(SETTLED / self.sample_time / 4)
        seen: deque[list[float]] = deque(maxlen=window)
        ranges = {
            n: _range_of(r, r.variable(rig.plant))
            for n, r in rig.readings.items()
            if not r.slope_of
        }
        for _ in range(max(window, math.ceil(PATIENCE / self.sample_time))):
            self.step(goal)
            seen.append([self.values[n] for n in ranges])
            if len(seen) == window and _still(np.array(seen), np.array(list(ranges.values()))):
                return

    def __enter__(self) -> Running:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end(error)

    def _end(self, error: BaseException | None) -> None:
        rig, reason = self.rig, ""
        if error is not None:
            reason = " ".join(str(error).split()) or type(error).__name__
        try:
            answered = rig.vent(reason)
            self.sent = dict(rig.vented) if answered else self.sent
            if not answered and not reason:
                rig.vent("the rig did not answer when it was to vent at the end of a run")
        finally:
            rig._running = False
            self._end_record(error)

    def _end_record(self, error: BaseException | None) -> None:
        """The last row, and the figures. What cannot be written hides no other error."""
        if self._record is None:
            return
        try:
            try:
                if self.values:
                    self._mark()
                    self._write_down()
            finally:
                self._record.close(self.figures(self.rig.reason))
        except WriteError:
            if error is None:
                raise

    def figures(self, reason: str = "") -> dict[str, Any]:
        """Samples, missed deadlines, answers that stayed out, and how late samples were."""
        late = sorted(self.latest) or [0.0]
        return {
            "samples": self.samples,
            "missed": self.missed,
            "lost": self.lost,
            "late_median": late[len(late) // 2],
            "late_99": late[min(len(late) - 1, math.ceil(0.99 * len(late)) - 1)],
            "late_worst": late[-1],
            "vented_for": reason,
        }


def recorded(
    rows: Sequence[tuple[float, Sequence[float]]], variables: Sequence[Variable]
) -> Trajectory:
    """Rows of (time, values of the variables) as a motion that begins at 0."""
    t, data = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    columns = {v.name: data[:, i] for i, v in enumerate(variables)}
    return Trajectory(t - t[0], columns, variables, "previous")


def _range_of(reading: Reading, variable: Variable) -> float:
    """Of the reading; of the plant's variable where the reading has no limits."""
    own = reading.high - reading.low
    return own if math.isfinite(own) else variable.max - variable.min


def _still(seen: NDArray[np.float64], ranges: NDArray[np.float64]) -> bool:
    """Whether readings (rows: samples) stay where they are."""
    quarters = seen.reshape(4, -1, seen.shape[1]).mean(axis=1)
    noise = np.array([noise_of(column) for column in seen.T]) / math.sqrt(len(seen) / 4)
    return bool(np.all(np.ptp(quarters, axis=0) <= np.maximum(STILL * ranges, 4 * noise)))


def noise_of(values: NDArray[np.float64]) -> float:
    """Standard deviation of white noise, from second differences: what drifts does not count."""
    if len(values) < 3:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6))


# ---- records, written as they come: what is on the disk is whole, whatever happens next ----------
FORM = "pam_ocp.rig run"
DIGITS = 10


class RecordWriter:
    """One run in ``run_NNNN.csv``, a line a sample, and ``run_NNNN.json`` with all about it.

    folder : it gets the next number there. A line is written by one call of the system, so that it
    is there even when this process is killed after it; :func:`read_run` leaves out a line that is
    not whole. The CSV is a record as :func:`pam_ocp.read_record` reads it.

    Examples
    --------
    >>> writer = pam.rig.RecordWriter("runs", [plant.variable("x")], {"about": "a test"})
    >>> writer.row(0.0, [0.001])
    >>> path = writer.close({"missed": 0})
    >>> pam.rig.read_run(path)["x"]
    array([0.001])
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        variables: Sequence[Variable],
        about: Mapping[str, Any],
    ) -> None:
        place = Path(folder)
        make_folder(place)
        self.variables = tuple(variables)
        self.path, self._file = _next(place)
        self._about = {
            "form": FORM,
            "variables": [asdict(v) for v in variables],
            "versions": {"pam_ocp": __version__, "python": platform.python_version()},
            "platform": sys.platform,
            **about,
        }
        self._held = [HELD] if any(v.causality == "input" for v in variables) else []
        header = ["time [s]", *(f"{v.name} [{v.unit}]" for v in variables), *self._held]
        self._line(header)
        self._tell({"ended": False})

    def _line(self, cells: Sequence[str]) -> None:
        line = (",".join(cells) + "\n").encode("utf-8")
        try:
            if os.write(self._file, line) < len(line):  # no space for the rest
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise WriteError(
                f"{self.path}: a line of the record was not written ({error.strerror})", error.errno
            ) from None

    def _tell(self, more: Mapping[str, Any]) -> None:
        write_json(self.path.with_suffix(".json"), _plain({**self._about, **more}))

    def row(self, time: float, values: Sequence[float]) -> None:
        """A sample: its time [s], and the values in the order of the variables [SI]."""
        cells = [f"{time:.6f}", *(f"{v:.{DIGITS}g}" for v in values)]
        self._line([*cells, "1"] if self._held else cells)

    def close(self, more: Mapping[str, Any]) -> Path:
        """The end, with what is known of the run now."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._tell({"ended": True, **more})
        return self.path


def _next(place: Path) -> tuple[Path, int]:
    """A new file of the next number, opened."""
    numbers = [p.stem[4:] for p in place.glob("run_*.csv")]
    number = max((int(n) for n in numbers if n.isdigit()), default=0)
    while True:
        number += 1
        path = place / f"run_{number:04d}.csv"
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
            return path, os.open(path, flags, 0o644)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{place}: no record can be written there ({error})") from None


def _plain(value: Any) -> Any:
    """As JSON has it; what is not finite is a text."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return repr(value)
    return value


@with_kinds
def read_run(path: str | os.PathLike[str]) -> Trajectory:
    """The Trajectory of a run that a rig recorded, as far as it came; inputs are inputs, and held.

    Raises InputError for what no rig wrote.

    Examples
    --------
    >>> writer = pam.rig.RecordWriter("runs", list(plant.inputs), {})
    >>> writer.row(0.0, [2e5])
    >>> pam.rig.read_run(writer.path).named("input")  # it is still being written
    ('muscle.command',)
    """
    source = Path(path)
    try:
        text = source.read_text("utf-8")
        about = json_of(source.with_suffix(".json").read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{source}: no record of a rig can be read there ({error})") from None
    if about.get("form") != FORM:
        raise InputError(f"{source.with_suffix('.json')}: a rig did not write this")
    said = [
        {k: float(v) if v in ("inf", "-inf") else v for k, v in s.items()}
        for s in about["variables"]
    ]
    variables = [variable_of(s) for s in said]
    whole = [line for line in text.split("\n")[1:-1] if line]
    try:
        rows = np.array([[float(c) for c in line.split(",")] for line in whole])
    except ValueError as error:
        raise InputError(f"{source}: {error}; the file is damaged") from None
    if not len(rows):
        raise InputError(f"{source}: the run ended before its first sample")
    if rows.shape[1] < len(variables) + 1:
        raise InputError(f"{source}: a line has {rows.shape[1]} cells; the file is damaged")
    columns = {v.name: rows[:, i + 1] for i, v in enumerate(variables)}
    return Trajectory(rows[:, 0], columns, variables, "previous")
