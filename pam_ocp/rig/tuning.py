"""Tuning: from a rig that was homed to one that tracks, by training motions and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..control.compensation import HysteresisCompensation
from ..control.loop import closed_loop
from ..control.pid import PID
from ..control.references import Source
from ..core.errors import InputError, require_count, require_finite, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from .guard import RigError
from .tracking import (
    BLOCK,
    PACE,
    Answer,
    LearnedInverse,
    LearnedTracking,
    Memory,
    Residual,
    lines,
    placed_by,
)

if TYPE_CHECKING:
    from .rig import Rig

Array: TypeAlias = NDArray[np.float64]

SHIFTS = np.arange(-0.02, 0.041, 0.0025)
"""[s], by which pressures that were asked for may have come early or late."""
WINDOW = 13
"""Samples over which positions are smoothed by a cubic (Savitzky and Golay)."""
TIMED = 2
"""Training motions after which the delay is found anew."""
SHOWN = 2
"""Training motions after which the rig is shaken; the feedback is gentle until then."""
GENTLE = 2.0
"""Its bandwidth [rad/s]."""
SHAKEN, PRESSED, RINGING = 0.006, 0.06, 0.1
"""How far (RMS): in parts of the range, by a model of this damping; of the pressures' ranges."""
CROSSED, CROSSING, BLOCKS = 0.7, 0.8, 8
"""Meanwhile it moves: halves of the range, frequency [Hz], for so many blocks."""
SETTLING, ENDING = 1.0, 0.1
"""Of each training motion, from which nothing is learned [s]."""
STARTS, CHOICES, BEGUN = 8, 4, 0.5
"""Short motions at the end; gains that are tried in them; from when on errors count [s]."""
TRIAL = BEGUN + BLOCK + ENDING
"""How long they are [s]."""
SHORTEST = 5.0
"""Training motion [s]: one that shows each position at several speeds."""
FINE = 2e-3
"""Seconds between the points of a training motion."""
FIRST = 0.7
"""Part of the range that the first training motion makes use of: it is not tracked well yet."""
INSIDE, SPARE, TAUT = 0.05, 0.07, 0.05
"""Kept free: of the position's limits at both ends; of the pressures' range; of a muscle's largest
force, for its slackness.
"""
BELOW = 0.97
"""Part of a pressure reading's limit that is commanded at most."""
STIFFNESSES = np.linspace(0.6, 1.8, 13)
"""Of a pair, in parts of that at its start values: those that are tried."""
LEAST = 0.3
"""Part of a span that a lesson leaves of it, or it leaves it as it is."""
STRONG = 1.2
"""What forces may be off by, before anything is known."""


@shown
@dataclass(frozen=True)
class Tuned:
    """What tuning came to, for ``closed_loop(tuned.law, rig, {"x": ...}, start=tuned.start(x0))``.

    Examples
    --------
    >>> pam.rig.Tuned.__name__
    'Tuned'
    """

    law: LearnedInverse
    """The controller: it tracks positions of any shape within ``range``."""
    range: tuple[float, float]
    """Of the position [its unit]: where no muscle is slack and no pressure at its end."""
    errors: tuple[float, ...]
    """RMS of the position's error in each training motion, each new to the law that tracked it."""
    runs: tuple[Trajectory, ...] = field(repr=False)

    def start(self, position: float) -> dict[str, float]:
        """Commands under which a position rests, by all that was learned."""
        return self.law.resting(position)

    def report(self) -> str:
        """Range, delay, and how the error went down."""
        low, high = self.range
        rows = [f"{self.law.position} within {low:.4g} .. {high:.4g}"]
        rows.append(f"commands act after {1e3 * self.law.ahead:.3g} ms")
        for k, e in enumerate(self.errors):
            part = 100 * e / (high - low)
            rows.append(f"training motion {k + 1}: RMS {e:.3g}, {part:.2f} % of the range")
        return "\n".join(rows)

    __str__ = report


@verb
def tune(
    rig: Rig,
    *,
    span: tuple[float, float] | None = None,
    stiffness: float | None = None,
    rounds: int = 4,
    duration: float = 30.0,
    bandwidth: float | None = None,
    seed: int = 0,
) -> Tuned:
    """Teach an armed, homed rig to track motions of any shape up to some 1.5 Hz.

    A training motion (smooth and random, then sines of 1 Hz of changing middle and size) is
    tracked by the inverse of the rig's model; from what was asked for and what came of it the delay
    and what the model lacks (scale of the force, friction, hysteresis, creep, dead zones) are
    fitted, and the next one is tracked with that. The model itself stays as it is.

    span : of positions; by default as far as pressures reach at both signs of the error of the
    force, no muscle gets slack, and the readings' limits are kept. It shrinks to what is found
    possible. stiffness : of a pair; by default that of the widest span. rounds : training motions,
    of ``duration`` [s] each. bandwidth : of the feedback [rad/s]; by default the rig is shaken
    besides, and the gains are those with the least error by what that shows.

    Raises RigError where the guard vents, InputError.
    """
    plant = rig.plant
    if plant is None:
        raise InputError("tune: the rig has no model; give Rig(..., plant=...)")
    rig.require_armed()
    require_count("rounds", rounds, SHOWN)
    require_count("seed", seed, 0)
    if bandwidth is not None:
        bandwidth = require_positive("bandwidth", bandwidth)
    duration = require_positive("duration", duration, "s")
    if duration < SHORTEST:
        raise InputError(
            f"duration = {duration:g} s: a training motion takes at least {SHORTEST:g} s"
        )
    inner = HysteresisCompensation(plant, sample_time=rig.sample_time, stiffness=stiffness)
    reach = _Reach(rig, inner)
    if stiffness is None and inner.stiffness is not None:
        inner.stiffness = reach.stiffest()
    low, high = reach.span() if span is None else _given(reach, span)
    memory = Memory((low + high) / 2, (high - low) / 2, rig.sample_time)
    none = Residual.none(memory)
    law = LearnedInverse(inner, none, 2 * rig.sample_time, PID(0.0), ceilings=reach.ceilings)
    law = replace(law, pid=law.placed(bandwidth or GENTLE), past=rig.past)
    rng, lessons = np.random.default_rng(seed), list[_Lesson]()
    errors, runs, seen = [], [], None
    for k in range(rounds):
        motion = _training(rng, low, high, duration, 1.0 if k else FIRST)
        controller = law.tracking({law.position: motion}, {}, True)
        begin = law.resting(motion(0.0))
        run = closed_loop(controller, rig, duration=duration, start=begin).trajectory
        runs.append(run)
        missed = run[law.position] - np.array([motion(t) for t in run.t])
        errors.append(float(np.sqrt(np.mean(missed[run.t > SETTLING] ** 2))))
        lessons.append(_lesson(law, run, controller))
        law = _learned(law, lessons, timing=k < TIMED)
        if seen is None:
            law = replace(law, pid=law.placed(bandwidth or GENTLE))
        low, high = reach.span((low, high), law, lessons[-1])
        if bandwidth is None and k == SHOWN - 1:
            seen = _shaken(rig, law, reach.most, (low, high), rng)
        if seen is not None:
            error = np.interp(np.arange(BEGUN, run.t[-1], law.sample_time), run.t, -missed)
            law = replace(law, pid=placed_by(seen, law.sample_time, error, controller.owner.pid))
    if seen is not None:
        law = _tried(rig, law, seen, [_training(rng, low, high, TRIAL, 1.0) for _ in range(STARTS)])
    return Tuned(law, (low, high), tuple(errors), tuple(runs))


def _given(reach: _Reach, span: tuple[float, float]) -> tuple[float, float]:
    low, high = (require_finite(f"span[{i}]", v, reach.unit) for i, v in enumerate(span))
    if not reach.low <= low < high <= reach.high:
        raise InputError(
            f"span = {span}: give two positions that rise, within {reach.low:g} .. {reach.high:g}"
        )
    return low, high


# ---- what is learned of a run -------------------------------------------------------------------
@dataclass(frozen=True)
class _Lesson:
    """A run, smoothed: the motion, the functions along it, and the pressures asked for."""

    t: Array
    motion: tuple[Array, Array, Array]
    rows: Array
    asked: tuple[Array, Array]

    def left(self, law: LearnedInverse, late: float = 0.0) -> Array:
        """r: by what the model moves more, pressures being ``late`` by more than is known [s]."""
        times, pressures = self.asked
        p = np.column_stack([np.interp(self.t - law.ahead - late, times, c) for c in pressures.T])
        x, v, a = self.motion
        return law.inverse.inverse.accelerations(x, v, p) - a


def _lesson(law: LearnedInverse, run: Trajectory, controller: LearnedTracking) -> _Lesson:
    from scipy.signal import savgol_filter

    h = law.sample_time
    t = np.arange(0.0, run.t[-1], h)
    seen = np.interp(t, run.t, run[law.position])
    x, v, a = (savgol_filter(seen, WINDOW, 3, deriv=d, delta=h) for d in (0, 1, 2))
    times, p = (np.array(c) for c in zip(*controller.asked, strict=True))
    rows = law.residual.memory.along(x, v, a, controller.slow)
    kept = (t > SETTLING) & (t < t[-1] - ENDING)
    smooth = savgol_filter(p, WINDOW, 3, axis=0)
    return _Lesson(t[kept], (x[kept], v[kept], a[kept]), rows[kept], (times, smooth))


def _learned(law: LearnedInverse, lessons: Sequence[_Lesson], timing: bool) -> LearnedInverse:
    """The law with all that the lessons say; with ``timing`` also of the delay."""
    rows = np.vstack([q.rows for q in lessons])

    def fitted(late: float) -> tuple[float, Residual]:
        values = np.concatenate([q.left(law, late) for q in lessons])
        found = law.residual.fitted(rows, values)
        return float(np.std(rows @ found.weights - values)), found

    late = min(SHIFTS, key=lambda d: fitted(d)[0]) if timing else 0.0
    residual = fitted(float(late))[1]
    return replace(law, residual=residual, ahead=max(law.ahead + float(late), 0.0))


# ---- feedback -----------------------------------------------------------------------------------
def _shaken(
    rig: Rig, law: LearnedInverse, most: Array, span: tuple[float, float], rng: np.random.Generator
) -> Answer:
    """How the rig answers while it moves and is shaken; what the motion brings is taken off.

    most : pressures. span : of positions.
    """
    inverse, middle, half = law.inverse.inverse, sum(span) / 2, (span[1] - span[0]) / 2
    omega, (_, stiff) = 2 * np.pi * lines(law.sample_time), law.slopes()
    resonance = np.sqrt(max(stiff, 1.0))
    needed = np.abs(stiff - omega**2 + 2j * RINGING * resonance * omega)
    sizes, phases = np.sqrt(needed), rng.uniform(0, 2 * np.pi, len(omega))
    moved = SHAKEN * 2 * half / np.sqrt(np.sum((sizes / needed) ** 2) / 2)
    asked = moved * np.sqrt(np.sum(sizes**2) / 2)
    rest, more = (inverse(middle, 0.0, a, law.inverse.stiffness) for a in (0.0, asked))
    share = float(np.max(np.abs(more - rest) / (most - inverse.low))) / PRESSED
    sizes *= moved / max(share, 1.0)

    def motion(t: float) -> float:
        return middle + CROSSED * half * float(np.sin(2 * np.pi * CROSSING * t))

    def run(probe: Source | None) -> tuple[Array, Array]:
        """Errors, and accelerations asked for besides."""
        controller = law.tracking({law.position: motion}, {}, True)
        controller.probe = probe
        begin, duration = law.resting(motion(0.0)), SETTLING + BLOCKS * BLOCK
        seen = closed_loop(controller, rig, duration=duration, start=begin).trajectory
        t = np.arange(SETTLING, duration, law.sample_time)
        times = np.array([at for at, _ in controller.asked]) - law.sample_time
        wanted = np.array([motion(at) for at in t])
        error = wanted - np.interp(t, seen.t, seen[law.position])
        return error, np.interp(t, times, controller.added)

    shaken = run(lambda t: float(sizes @ np.sin(omega * t + phases)))
    error, added = (one - other for one, other in zip(shaken, run(None), strict=True))
    return Answer.shown(error, added, law.sample_time, stiff)


def _tried(
    rig: Rig, law: LearnedInverse, seen: Answer, motions: Sequence[Source]
) -> LearnedInverse:
    """The law with the best of some gains in short motions, which show what starting brings."""
    h, found = law.sample_time, list[tuple[float, LearnedInverse]]()
    designed, law = law, replace(law, pid=law.placed(GENTLE))
    times = BEGUN + h * np.arange(round(BLOCK / h))
    for k in range(CHOICES):
        errors = []
        for motion in motions:
            reference, begin = {law.position: motion}, law.resting(motion(0.0))
            loop = closed_loop(law, rig, reference, duration=TRIAL, start=begin)
            missed = np.array([motion(t) for t in loop.t]) - loop[law.position]
            errors.append(np.interp(times, loop.t, missed))
        whole = np.concatenate(errors)
        found.append((float(np.mean(whole**2)), law))
        law = replace(law, pid=placed_by(seen, h, whole, law.pid)) if k else designed
    return min(found, key=lambda pair: pair[0])[1]


# ---- where it goes ------------------------------------------------------------------------------
def _training(
    rng: np.random.Generator, low: float, high: float, duration: float, part: float
) -> Source:
    """Half of it smooth and random (0.1 to 1.5 Hz), half sines of 1 Hz of changing middle, size."""
    t = np.arange(0.0, duration + 1.0, FINE)
    f, phase = rng.uniform(0.1, 1.5, 12), rng.uniform(0, 2 * np.pi, 14)
    waves = np.sin(2 * np.pi * np.outer(t, f) + phase[:12]) @ rng.uniform(0.3, 1.0, 12)
    wild = np.tanh(1.2 * waves / np.quantile(np.abs(waves), 0.97))
    middle = 0.6 * np.sin(2 * np.pi * 0.05 * t + phase[12])
    size = (1 - np.abs(middle)) * (0.55 + 0.45 * np.sin(2 * np.pi * 0.13 * t + phase[13]))
    share = np.clip(t - duration / 2 + 0.5, 0.0, 1.0)
    share = share**3 * (10 - 15 * share + 6 * share**2)
    both = (1 - share) * wild + share * (middle + size * np.sin(2 * np.pi * t))
    path: list[float] = ((low + high) / 2 + part * (high - low) / 2 * both).tolist()

    def at(time: float) -> float:
        k = min(max(int(time / FINE), 0), len(path) - 2)
        return path[k] + min(max(time / FINE - k, 0.0), 1.0) * (path[k + 1] - path[k])

    return at


class _Reach:
    """Which positions a rig can hold, and be moved at, with all muscles taut."""

    def __init__(self, rig: Rig, inner: HysteresisCompensation) -> None:
        self.inner, inverse, plant = inner, inner.inverse, inner.plant
        variable, reading = plant.variable(inverse.position), rig.readings.get(inverse.position)
        if reading is None:
            raise InputError(
                f"tune: the rig does not read {inverse.position}, which is to be moved"
            )
        self.unit = variable.unit
        low, high = max(variable.min, reading.low), min(variable.max, reading.high)
        if not np.isfinite(high - low):
            raise InputError(
                f"tune: {inverse.position} has no limits; give its reading low and high"
            )
        self.low, self.high = low + INSIDE * (high - low), high - INSIDE * (high - low)
        self.x = np.linspace(self.low, self.high, 81)
        names = [f"{m}.pressure" for m in inverse.muscles]
        ends = [rig.readings[n].high if n in rig.readings else np.inf for n in names]
        self.ceilings = {
            f"{m}.command": BELOW * e for m, e in zip(inverse.muscles, ends, strict=True)
        }
        self.most = np.minimum(inverse.high, BELOW * np.array(ends))
        self._forces = _forces(plant, inverse.muscles)

    def _possible(self, k: float | None, extra: Array, scale: float = 1.0) -> NDArray[np.bool_]:
        """At each position, ``extra`` being asked for besides [acceleration]."""
        inverse = self.inner.inverse
        p = np.array([inverse(x, 0.0, e, k) for x, e in zip(self.x, extra, strict=True)])
        spare = SPARE * (self.most - inverse.low)
        inside = np.all((p >= inverse.low + spare) & (scale * p <= self.most - spare), axis=1)
        at = inverse.points(self.x, 0.0 * self.x, p)
        forces = np.asarray(self._forces.map(at.shape[1])(at)).T
        taut = np.all(forces > TAUT * forces.max(axis=0, initial=0.0), axis=1)
        return np.asarray(inside & taut)

    def _widest(self, possible: NDArray[np.bool_]) -> tuple[float, float]:
        """The longest stretch of positions that are possible."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], possible.astype(int), [0]])))
        if not len(edges):
            return 0.0, 0.0
        first, last = max(edges.reshape(-1, 2), key=lambda e: e[1] - e[0])
        return float(self.x[first]), float(self.x[last - 1])

    def stiffest(self) -> float:
        """The stiffness of a pair that gives it the widest span."""
        usual, none = float(self.inner.stiffness or 0.0), 0.0 * self.x

        def width(k: float) -> float:
            low, high = self._widest(self._possible(k, none, STRONG))
            return high - low

        return max((usual * float(part) for part in STIFFNESSES), key=width)

    def span(
        self,
        before: tuple[float, float] | None = None,
        law: LearnedInverse | None = None,
        lesson: _Lesson | None = None,
    ) -> tuple[float, float]:
        """Positions from where to where; with a law by what it knows, within those ``before``."""
        k = self.inner.stiffness
        if law is None or before is None or lesson is None:
            low, high = self._widest(self._possible(k, 0.0 * self.x, STRONG))
            if low == high:
                raise RigError(
                    "tune: by the model there is no position at which all muscles are taut within "
                    "the limits of position and pressures; give span"
                )
            return low, high
        memory, weights = law.residual.memory, law.residual.weights
        known = np.array([law.residual.again()(x, 0.0, 0.0) for x in self.x])
        held = lesson.rows[:, memory.smooth :] @ weights[memory.smooth :]
        moving = float(np.quantile(np.abs(held), 0.95)) + memory.half * PACE**2
        good = self._possible(k, known + moving) & self._possible(k, known - moving)
        low, high = self._widest(good & (self.x >= before[0]) & (self.x <= before[1]))
        return (low, high) if high - low > LEAST * (before[1] - before[0]) else before


def _forces(plant: Plant, muscles: Sequence[str]) -> ca.Function:
    """(states and inputs) -> forces of the muscles, by the model."""
    known = {v.name for v in plant.outputs}
    names = [f"{m}.force" for m in muscles if f"{m}.force" in known]
    z, here = ca.vertcat(plant.x, plant.u), ca.SX.sym("z", plant.x.numel() + plant.u.numel())
    column = ca.vertcat(*(plant.expression(n) for n in names))
    whole = ca.Function("forces", [z, plant.p], [column])
    return ca.Function("forces", [here], [whole(here, ca.DM(plant.vector("parameter")))])
