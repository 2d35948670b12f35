"""Instruments: what a sensor and its electronics make of a quantity, from sample to sample.

A plant's own :class:`pam_ocp.plants.sensors.Sensor` is part of its equations; an instrument is what
cannot be: noise, wander, sample and hold, a transport delay of any length. It serves simulated
records (:func:`measured`) and closed loops alike.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import (
    InputError,
    require_count,
    require_finite,
    require_instance,
    require_positive,
)
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable

Array: TypeAlias = NDArray[np.float64]

SAME = 1e-9
"""Times nearer to each other than this part of a sampling time are one."""


@dataclass(frozen=True)
class Instrument:
    """A sensor with its electronics, in the order in which the signal goes through it.

    A quantity q is filtered (first order), scaled and shifted, sampled and held, disturbed by
    noise, limited to a range, rounded to whole steps, and handed over after a delay.

    filter : time constant [s]. gain : reading per quantity. bias : reading at q = 0.
    drift : of the bias [unit/s]. wander : random walk of the bias [unit/sqrt(s)].
    sample_time : the instrument samples at its multiples and holds between [s]; None: whenever it
    is read. noise : standard deviation of each sample, normal and white.
    low, high : ends of the range, where the reading stays. resolution : step of the reading.
    delay : [s], of any length: nothing newer is read.

    Texts such as "0.02 mm" or "5 ms" are numbers too, where the unit fits the quantity.

    Examples
    --------
    >>> encoder = pam.simulation.Instrument(resolution="1 mm", delay="10 ms")
    >>> read = pam.simulation.measured(motion, {"x": encoder})
    >>> bool(np.allclose(1e3 * read["x"], np.round(1e3 * read["x"])))
    True
    """

    filter: float = 0.0
    gain: float = 1.0
    bias: float = 0.0
    drift: float = 0.0
    wander: float = 0.0
    sample_time: float | None = None
    noise: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    resolution: float | None = None
    delay: float = 0.0

    @property
    def remembers(self) -> bool:
        """Whether a reading depends on more than the quantity at that time."""
        return bool(self.filter or self.delay or self.sample_time is not None)

    def of(self, variable: Variable) -> Instrument:
        """The same with all values as numbers, checked for this quantity. Raises InputError."""
        label, unit, found = f"sensors[{variable.name!r}]", variable.unit, dict[str, Any]()
        units = {"filter": "s", "sample_time": "s", "delay": "s", "gain": "1"}
        for each in fields(self):
            value = getattr(self, each.name)
            own = units.get(each.name, "" if each.name in ("drift", "wander") else unit)
            if value is None or (isinstance(value, float) and math.isinf(value)):
                found[each.name] = value
            else:
                found[each.name] = require_finite(f"{label}.{each.name}", value, own)
        for name, zero in (
            ("filter", True),
            ("wander", True),
            ("noise", True),
            ("delay", True),
            ("sample_time", False),
            ("resolution", False),
        ):
            if found[name] is not None:
                require_positive(f"{label}.{name}", found[name], units.get(name, ""), zero)
        if found["gain"] == 0:
            raise InputError(f"{label}.gain = 0 reads nothing: give the reading per quantity")
        if not found["low"] < found["high"]:
            raise InputError(
                f"{label}: low = {found['low']:g} must lie below high = {found['high']:g}"
            )
        return Instrument(**found)


@dataclass
class Reader:
    """An instrument at work: told the quantity as time goes on (:meth:`tell`), and read.

    Between two told values the quantity is taken as a straight line, which the filter follows
    exactly.
    """

    instrument: Instrument
    random: np.random.Generator
    times: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    """Of the quantity behind the filter."""
    _last: float = 0.0
    _walk: float = 0.0
    _walked: float = math.nan
    _sample: tuple[float, float] | None = None

    def tell(self, t: float, value: float) -> None:
        """The quantity is ``value`` at time t [s], later than all told before."""
        tau = self.instrument.filter
        if not self.times:
            self.times.append(t)
            self.values.append(value)
        else:
            self.times.append(t)
            self.values.append(self._filtered(value, t - self.times[-2]) if tau else value)
        self._last = value
        self._forget(t)

    def _filtered(self, value: float, h: float) -> float:
        """The filter's output after h seconds on a line from the last value to this one."""
        tau, slope = self.instrument.filter, (value - self._last) / h
        steady = self._last - slope * tau  # y = steady + slope s is the line it settles to
        return steady + slope * h + (self.values[-1] - steady) * math.exp(-h / tau)

    def _forget(self, t: float) -> None:
        """What is older than the delay and a sample is not read again."""
        kept = self.instrument.delay + (self.instrument.sample_time or 0.0)
        old = bisect_right(self.times, t - kept - SAME) - 1
        if old > 1000:
            del self.times[: old - 1], self.values[: old - 1]

    def read(self, t: float) -> float:
        """The reading at time t [s], not before the last one told."""
        how = self.instrument
        at = max(t - how.delay, self.times[0])
        if how.sample_time is not None:
            at = max(how.sample_time * math.floor(at / how.sample_time + SAME), self.times[0])
            if self._sample is not None and self._sample[0] == at:
                return self._sample[1]
        value = how.gain * self._behind(at)
        value += how.bias + how.drift * at + self._wandered(at)
        if how.noise:
            value += how.noise * float(self.random.standard_normal())
        value = min(max(value, how.low), how.high)
        if how.resolution is not None:
            value = how.resolution * math.floor(value / how.resolution + 0.5)
        self._sample = at, value
        return value

    def _behind(self, t: float) -> float:
        """The quantity behind the filter, on a line between two times."""
        times, values = self.times, self.values
        i = bisect_right(times, t)
        if i in (0, len(times)):
            return values[min(i, len(times) - 1)]
        part = (t - times[i - 1]) / (times[i] - times[i - 1])
        return values[i - 1] + part * (values[i] - values[i - 1])

    def _wandered(self, t: float) -> float:
        if self.instrument.wander:
            if not math.isnan(self._walked):
                step = math.sqrt(max(t - self._walked, 0.0))
                self._walk += self.instrument.wander * step * float(self.random.standard_normal())
            self._walked = t
        return self._walk


def readers_of(
    sensors: Mapping[str, Instrument] | None, variables: Mapping[str, Variable], seed: int
) -> dict[str, Reader]:
    """{variable: its Reader}. Each draws from a sequence of its own, whatever the others are."""
    require_instance("sensors", sensors, Mapping, "give {name: Instrument(...)}", none=True)
    require_count("seed", seed, 0)
    found = {}
    for k, (name, instrument) in enumerate((sensors or {}).items()):
        remedy = "give an Instrument, such as Instrument(noise=1e-5, delay=0.004)"
        require_instance(f"sensors[{name!r}]", instrument, Instrument, remedy)
        variable = variables[name]
        found[variable.name] = Reader(
            instrument.of(variable), np.random.default_rng([seed, k, len(sensors or {})])
        )
    return found


@verb
def measured(
    motion: Trajectory,
    sensors: Mapping[str, Instrument],
    *,
    sample_time: float | None = None,
    seed: int = 0,
) -> Trajectory:
    """What instruments make of a motion: the record that a rig would have written.

    motion : a simulation, plan or record; columns without an instrument stay as they are.
    sensors : {column: Instrument}. sample_time : of the record [s]; by default the motion's times.
    seed : of noise and wander. The quantity between the motion's samples is a straight line.

    Raises InputError, UnknownNameError.

    Examples
    --------
    >>> encoder = pam.simulation.Instrument(resolution="1 mm")
    >>> read = pam.simulation.measured(motion, {"x": encoder}, sample_time="10 ms")
    >>> bool(np.allclose(read["x"] * 1e3, np.round(read["x"] * 1e3)))
    True
    """
    require_instance("motion", motion, Trajectory, "give a Trajectory, such as simulate() returns")
    variables = {n: motion.variable(n) for n in sensors}
    readers = readers_of(sensors, variables, seed)
    t = motion.t
    if sample_time is not None:
        h = require_positive("sample_time", sample_time, "s")
        t = motion.t[0] + h * np.arange(math.floor(motion.duration / h + SAME) + 1)
    inside = motion.at(t)
    columns = {n: np.array(inside[n]) for n in motion.names}
    for name, reader in readers.items():
        column, k = motion[name], 0
        for i, time in enumerate(t):
            while k < len(motion.t) and motion.t[k] <= time + SAME * max(1.0, abs(time)):
                reader.tell(float(motion.t[k]), float(column[k]))
                k += 1
            columns[name][i] = reader.read(float(time))
    kept = motion.interpolation if motion.interpolation_known else None
    return Trajectory(t, columns, motion.variables, kept)
