"""A signal that goes where the records of a fit have not been, for the sake of what is to be
predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...core.errors import FitError, SimulationError, require_count, require_positive
from ...core.stop import check
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...simulation.simulator import simulate
from ..dynamic.coverage import Band, Coverage, Reach
from ..statistics import Array
from .excitation import ranges_of

__all__ = ["GapSignal", "close_gap"]

LEVELS = 8
"""Places of its range to which each input goes, in a random order."""
LINES = 2
"""Sines in each octave whose amplitude is missing."""
MARGIN = 1.1
"""Times the missing amplitude that is played: the plant is not quite as it is thought to be."""


@dataclass(frozen=True, eq=False)
class GapSignal:
    """A signal to play, and what its record would leave open.

    trajectory : the inputs and the motion that is expected. before, after : coverage of what is to
    be predicted, without and with this record. violation : how far limits are left, in parts of
    their range.

    Examples
    --------
    >>> asked = pam.fitting.coverage(dynamic_fit, {"muscle.command": 5e5}, duration=0.5)
    >>> gap = pam.experiments.design_signal(asked, duration=0.5, sample=0.02, tries=1)
    >>> gap.inputs, gap.violation
    (('muscle.command',), 0.0)
    """

    trajectory: Trajectory
    inputs: tuple[str, ...]
    before: Coverage = field(repr=False)
    after: Coverage = field(repr=False)
    violation: float

    def report(self) -> str:
        """What was open, and what would be, as text."""
        t = self.trajectory.t
        lines = [
            f"{t[-1] - t[0]:g} s of {', '.join(self.inputs)}",
            f"far from all records: {100 * self.before.far:.0f} % of the samples, "
            f"{100 * self.after.far:.0f} % with this one",
            f"octaves with amplitudes that are missing: {len(self.before.new_bands)}, "
            f"{len(self.after.new_bands)} with this one",
            "variables that leave what was measured: "
            f"{', '.join(r.name for r in self.before.left) or 'none'}; with this one: "
            f"{', '.join(r.name for r in self.after.left) or 'none'}",
        ]
        if self.violation > 1e-4:
            lines.append(f"limits are left by up to {100 * self.violation:.2g} % of their range")
        return "\n".join(lines)

    __str__ = report


def close_gap(
    gap: Coverage,
    duration: float,
    sample: float = 0.01,
    inputs: Mapping[str, tuple[float, float]] | Sequence[str] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    tries: int = 8,
    seed: int = 0,
) -> GapSignal:
    """See :func:`design_signal`, which calls this for a :class:`Coverage`."""
    plant = gap.plant
    t = np.arange(0.0, require_positive("duration", duration, "s") + sample / 2, sample)
    reaches = {v.name: _reach_of(gap, v.name) for v in plant.inputs if not v.disturbance}
    usual = {
        n: (min(r.seen[0], r.asked[0]), max(r.seen[1], r.asked[1])) for n, r in reaches.items()
    }
    ranges = ranges_of(plant, inputs, usual)
    kept = {plant.variable(n).name: ends for n, ends in (limits or {}).items()}
    missing = {n: [b for b in gap.new_bands if b.name == n] for n in ranges}
    random = np.random.default_rng(seed)
    best: tuple[float, GapSignal] | None = None
    for _ in range(require_count("tries", tries)):
        check()
        drive = {
            n: _signal(t, ends, _reach_of(gap, n), missing[n], random) for n, ends in ranges.items()
        }
        held = {
            v.name: float(gap.seen[0][v.name][0])
            for v in plant.inputs
            if v.name not in drive and v.name in gap.seen[0]
        }
        motion = _motion(gap, {**drive, **held}, t)
        if motion is None:
            continue
        found = GapSignal(
            motion, tuple(drive), gap, gap.seeing(motion), _violation(motion, kept, plant)
        )
        open_ = found.after.far + len(found.after.new_bands) / max(len(gap.bands), 1)
        open_ += sum(min(r.beyond, 1.0) for r in found.after.left) / len(gap.reaches)
        merit = open_ + 10 * found.violation
        if best is None or merit < best[0]:
            best = (merit, found)
    if best is None:
        raise FitError(
            "the plant cannot be simulated under any signal of this kind; narrow the inputs' "
            "ranges with inputs={name: (low, high)}"
        )
    return best[1]


def _reach_of(gap: Coverage, name: str) -> Reach:
    return next(r for r in gap.reaches if r.name == name)


def _signal(
    t: Array,
    ends: tuple[float, float],
    reach: Reach,
    bands: Sequence[Band],
    random: np.random.Generator,
) -> Array:
    """Ramps between levels all over the range that is asked for, and sines where these miss."""
    low, high = max(ends[0], reach.asked[0]), min(ends[1], reach.asked[1])
    if not low < high:
        low, high = ends
    levels = low + (high - low) * random.permutation(np.linspace(0, 1, LEVELS))
    wave = np.zeros(len(t))
    for band in bands:
        for _ in range(LINES):
            f = band.low * (band.high / band.low) ** random.uniform()
            size = MARGIN * band.asked / np.sqrt(LINES)
            wave += size * np.sin(2 * np.pi * (f * t + random.uniform()))
    knots = np.linspace(t[0], t[-1], 2 * LEVELS)  # each level is held as long as it is gone to
    steady = np.interp(t, knots, np.repeat(levels, 2))
    return np.asarray(np.clip(steady + wave, *ends))


def _motion(gap: Coverage, drive: Mapping[str, object], t: Array) -> Trajectory | None:
    first = gap.seen[0]
    start = {}
    for v in gap.plant.states:
        if v.name in first:
            start[v.name] = float(np.clip(first[v.name][0], v.min, v.max))
    try:
        return simulate(gap.plant, dict(drive), t=t, start=start, interpolation="linear", rtol=1e-5)
    except SimulationError:
        return None


def _violation(
    motion: Trajectory, limits: Mapping[str, tuple[float, float]], plant: Plant
) -> float:
    worst = 0.0
    for name, (low, high) in limits.items():
        size = high - low if np.isfinite(high - low) else plant.variable(name).nominal
        column = motion[name]
        worst = max(worst, float((low - column).max()) / size, float((column - high).max()) / size)
    return worst
