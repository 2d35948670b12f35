"""Homing: what has to be known of a rig before anything is fitted or planned on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import InputError, UnknownNameError, require_finite, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from .guard import RigError
from .running import Running, noise_of, recorded

if TYPE_CHECKING:
    from .rig import Rig

CLEAR = 6.0
"""Standard deviations of the noise by which something has moved."""
NEAR = 0.9
"""Part of the way of a reading to a limit after which a sweep turns round."""
STILL = 0.02
"""Of its limits, or of the commands' range: what a zero may be off, and a reading may drift."""


@shown
@dataclass(frozen=True)
class Homing:
    """What was found, by name [SI]; ``ok`` without warnings.

    Examples
    --------
    >>> clock = pam.rig.SimulatedClock()
    >>> twin = pam.rig.Twin(plant, clock=clock)
    >>> rig = pam.Rig(pam.rig.driver("twin", twin=twin), plant=plant, clock=clock)
    >>> rig.arm()
    >>> found = rig.home(level="3 bar")
    >>> found.ok, found.travel["x"] > 0.03, 0.0 < found.slack["muscle.command"] < 3e5
    (True, True, True)
    """

    noise: Mapping[str, float]
    """Standard deviation of each reading at rest."""
    zeros: Mapping[str, float]
    """What pressures read with the air out; taken off from now on, where that was asked for."""
    rest: Mapping[str, float]
    """All other readings with the air out."""
    ranges: Mapping[str, tuple[float, float]]
    """Of each reading, over all sweeps."""
    slack: Mapping[str, float]
    """{command: from which on the position moves}; NaN where nothing moved."""
    hysteresis: Mapping[str, float]
    """{command: largest difference of the position between the way up and the way down}."""
    leak: Mapping[str, float]
    """{pressure: its change per second while the commands were held}."""
    doubts: tuple[str, ...] = ()
    sweeps: Mapping[str, Trajectory] = field(default_factory=dict, repr=False)
    """{command: what was read while it went up and down}."""

    @property
    def ok(self) -> bool:
        """Whether there are no warnings."""
        return not self.doubts

    @property
    def travel(self) -> dict[str, float]:
        """How far each reading went."""
        return {n: high - low for n, (low, high) in self.ranges.items()}

    def report(self) -> str:
        """All of it, as text."""
        lines = [f"{'reading':<24}{'noise':>11}{'zero/rest':>12}{'lowest':>12}{'highest':>12}"]
        for name, noise in self.noise.items():
            low, high = self.ranges[name]
            rest = self.zeros.get(name, self.rest.get(name, math.nan))
            lines.append(f"{name:<24}{noise:>11.3g}{rest:>12.5g}{low:>12.5g}{high:>12.5g}")
        lines.append(f"{'command':<24}{'slack up to':>11}{'hysteresis':>12}")
        lines += [f"{n:<24}{self.slack[n]:>11.4g}{self.hysteresis[n]:>12.3g}" for n in self.slack]
        lines += [f"{n} changes by {v:.3g} per second while held" for n, v in self.leak.items()]
        lines += [f"warning: {words}" for words in self.doubts] or ["no warnings"]
        return "\n".join(lines)

    __str__ = report


@verb
def home(
    rig: Rig,
    *,
    level: float | Mapping[str, float] | str | None = None,
    base: Mapping[str, float] | None = None,
    sweep_time: float = 4.0,
    hold_time: float = 2.0,
    take_zeros: bool = True,
) -> Homing:
    """Zeros, noise, range, slack, hysteresis and leaks of an armed rig, within the guard's limits.

    The air is out for a second: noise and zeros. Each command alone goes up slowly and down again:
    range, slack, hysteresis; it turns round before a limit of a reading is reached. At last all are
    held in the middle: what then drifts leaks (or creeps).

    level : highest value of each command, a number, a text with unit, or by name; by default half
    of its range. base : of the other commands meanwhile; by default their vent values.
    sweep_time : of one sweep, up and down [s]. hold_time : [s]. take_zeros : pressures are counted
    from what was found here from now on (:attr:`Rig.zeros`).

    Raises RigError where the guard vents; then nothing is taken over.
    """
    levels = _levels(rig, level)
    sweep_time = require_positive("sweep_time", sweep_time, "s")
    hold_time = require_positive("hold_time", hold_time, "s")
    still = _held(rig, rig.vented, 1.0)
    readings = [n for n, r in rig.readings.items() if not r.slope_of]
    noise = {n: noise_of(still[n]) for n in readings}
    means = {n: float(np.mean(still[n])) for n in readings}
    pressures = [n for n in readings if rig.readings[n].unit == "Pa" and n != "supply"]
    positions = [n for n in readings if n not in pressures and n != "supply"]
    sweeps = {n: _sweep(rig, n, levels[n], base or {}, sweep_time, noise) for n in rig.commands}
    middle = {n: (rig.vented[n] + levels[n]) / 2 for n in rig.commands}
    hold = _held(rig, middle, hold_time)
    runs = [still, hold, *sweeps.values()]
    half = hold.t > hold.t[-1] / 2
    slope = {n: float(np.polyfit(hold.t[half], hold[n][half], 1)[0]) for n in pressures}
    slack, hysteresis = {}, {}
    for name, sweep in sweeps.items():
        slack[name], hysteresis[name] = _moved(rig, name, sweep, positions, noise)
    found = Homing(
        noise=noise,
        zeros={n: means[n] + rig.zeros.get(n, 0.0) for n in pressures},
        rest={n: means[n] for n in readings if n not in pressures},
        ranges={
            n: (min(float(np.min(r[n])) for r in runs), max(float(np.max(r[n])) for r in runs))
            for n in readings
        },
        slack=slack,
        hysteresis=hysteresis,
        leak=slope,
        doubts=tuple(_doubts(rig, pressures, means, slope, slack, noise, levels)),
        sweeps=sweeps,
    )
    if take_zeros:
        rig.zeros |= found.zeros
    return found


def _levels(rig: Rig, level: object) -> dict[str, float]:
    given = level if isinstance(level, Mapping) else dict.fromkeys(rig.commands, level)
    found = {}
    for name in given:
        if name not in rig.commands:
            raise UnknownNameError("command of the rig", name, rig.commands)
    for name, channel in rig.commands.items():
        vent = rig.vented[name]
        far = channel.high if channel.high - vent >= vent - channel.low else channel.low
        value = given.get(name)
        if value is None:
            value = vent + (far - vent) / 2
        found[name] = require_finite(f"level of {name}", value, channel.unit)
        if not channel.low <= found[name] <= channel.high or found[name] == vent:
            raise InputError(
                f"level of {name} = {found[name]:g} must lie within {channel.low:g} .. "
                f"{channel.high:g} and away from its vent value {vent:g}"
            )
    return found


def _held(rig: Rig, commands: Mapping[str, float], seconds: float) -> Trajectory:
    """What is read while commands are held, after a soft start."""
    rows = _Rows(rig)
    with Running(rig, rig.sample_time) as run:
        run.approach(commands)
        for _ in range(math.ceil(seconds / rig.sample_time)):
            rows.add(run)
            run.step(commands)
    return rows.trajectory()


def _sweep(
    rig: Rig,
    name: str,
    level: float,
    base: Mapping[str, float],
    seconds: float,
    noise: Mapping[str, float],
) -> Trajectory:
    """One command up and down, as far as the limits of readings allow."""
    rows, vent = _Rows(rig), rig.vented[name]
    count = max(2, math.ceil(seconds / 2 / rig.sample_time))
    with Running(rig, rig.sample_time) as run:
        others = {**rig.vented, **base, name: vent}
        run.approach(others)
        top, begun = count, dict(run.values)
        for k in range(1, count + 1):
            rows.add(run)
            run.step({**others, name: vent + (level - vent) * k / count})
            if _near(rig, begun, run.values, noise):
                top = k
                break
        for k in range(top, -1, -1):
            rows.add(run)
            run.step({**others, name: vent + (level - vent) * k / count})
    return rows.trajectory()


def _near(
    rig: Rig, begun: Mapping[str, float], values: Mapping[str, float], noise: Mapping[str, float]
) -> bool:
    """Whether a reading comes near one of its limits, from where it began."""
    for name, channel in rig.readings.items():
        moved = values[name] - begun[name]
        if abs(moved) <= CLEAR * noise.get(name, 0.0):
            continue
        for end in (channel.low, channel.high):
            way = end - begun[name]
            if math.isfinite(end) and moved * way > 0 and moved / way > NEAR:
                return True
    return False


class _Rows:
    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.rows: list[tuple[float, list[float]]] = []

    def add(self, run: Running) -> None:
        if not self.rows or run.time > self.rows[-1][0]:
            row = [*run.values.values(), *(run.sent[n] for n in self.rig.commands)]
            self.rows.append((run.time, row))

    def trajectory(self) -> Trajectory:
        if not self.rows:
            raise RigError(f"{self.rig.name}: nothing was read")
        return recorded(self.rows, self.rig.variables)


def _moved(
    rig: Rig, name: str, sweep: Trajectory, positions: list[str], noise: Mapping[str, float]
) -> tuple[float, float]:
    """(command from which on a position moves, largest difference between up and down)."""
    command = sweep[name]
    top = int(np.argmax(np.abs(command - rig.vented[name])))
    begins, widest = [], 0.0
    for position in positions:
        path = sweep[position]
        far = float(np.ptp(path))
        clear = np.abs(path[: top + 1] - path[0]) > max(CLEAR * noise[position], 0.01 * far)
        if far > 2 * CLEAR * noise[position] and clear.any():
            begins.append(float(command[int(np.argmax(clear))]))
        up, down = slice(0, top + 1), slice(len(path) - 1, top, -1)
        order = np.argsort(np.abs(command[down] - rig.vented[name]), kind="stable")
        away = np.abs(command[down] - rig.vented[name])[order]
        if len(away):
            back = np.interp(np.abs(command[up] - rig.vented[name]), away, path[down][order])
            widest = max(widest, float(np.max(np.abs(path[up] - back))))
    nearest = min(begins, key=lambda v: abs(v - rig.vented[name]), default=math.nan)
    return nearest, widest


def _doubts(
    rig: Rig,
    pressures: list[str],
    means: Mapping[str, float],
    slope: Mapping[str, float],
    slack: Mapping[str, float],
    noise: Mapping[str, float],
    levels: Mapping[str, float],
) -> list[str]:
    span = max(c.high - c.low for c in rig.commands.values())
    found = []
    for name in pressures:
        high = rig.readings[name].high
        whole = high if math.isfinite(high) else span if span > 1e4 else 1e6
        if abs(means[name]) > STILL * whole:
            found.append(
                f"{name} reads {means[name]:.4g} Pa with the air out: its zero is off, or the air "
                "is not out"
            )
        if abs(slope[name]) > STILL * whole:
            found.append(f"{name} changes by {slope[name]:.3g} Pa/s while held: look for a leak")
        if noise[name] == 0:
            found.append(f"{name} has no noise at all: look whether it is measured")
    found = [f for f in found if not f.endswith("it is measured") or rig.clock.real]
    found += [
        f"nothing moved with {n} up to {levels[n]:.4g}: look at its valve and tube, or give a "
        "higher level"
        for n, v in slack.items()
        if math.isnan(v)
    ]
    return found
