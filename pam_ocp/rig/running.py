"""A run: sample after sample with absolute deadlines, everything looked at by the guard."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .guard import RigError, Watch
from .records import RecordWriter

if TYPE_CHECKING:
    from .rig import Rig

__all__ = ["Running", "Watch", "noise_of"]

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
            if isinstance(error, RigError) or not isinstance(error, Exception):
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
        except Exception as error:  # the age of what is read says how long that may go on
            self.lost += 1
            self._cause = str(error)
        self._mark()
        self._write_down()
        self._beat()
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

    def _beat(self) -> None:
        dog = self.rig._watchdog
        if dog is not None and (words := dog.beat()):
            raise RigError(words)

    def _take(self) -> None:
        """The newest readings; those before stay where nothing valid comes."""
        try:
            seen = self.rig.taken(self.rig.driver.read())
        except Exception as error:  # a driver of one's own may raise anything
            self.lost += 1
            self._cause = str(error)
            return
        stamp = seen.pop("time")
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
            raise RigError(words + (f" ({self._cause})" if "age" in words and self._cause else ""))

    def _write_down(self) -> None:
        if self._record is not None:
            row = [*self.values.values(), *(self.sent[n] for n in self.rig.commands)]
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
        ranges = {n: r.high - r.low for n, r in rig.readings.items() if not r.slope_of}
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
            if self._record is not None:
                if self.values:
                    self._mark()
                    self._write_down()
                self._record.close(self.figures(rig.reason))

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
