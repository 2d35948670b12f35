"""Where the records of a fit have been, and what to think of a prediction elsewhere.

A fitted plant is as good as its laws where it was not measured. What is compared: the range of each
state, input and output; amplitudes of the inputs by octaves of frequency; places in the space of
states and inputs together (distance to the nearest sample of the records, against that of the
records' own samples from those of other moments); and what the parameters' uncertainty, carried
along the motion, makes of the outputs.

How much of each is usual the records tell themselves: parts of them are left out in turn and
compared with the others. A motion of the same kind is as far from all of them as one part from the
rest, and exceeds the farthest of n with probability 1/(n + 1) (conformal prediction; V. Vovk, A.
Gammerman, G. Shafer, Algorithmic Learning in a Random World, 2005). What is farther is an
extrapolation: sound while it stays within the plant's own limits, leaves no range by more than the
range itself, and the parameters still determine it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from ...core.errors import InputError, SimulationError, kind_of, require_positive
from ...core.signals import Inputs
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ...simulation.simulator import simulate
from ..estimates import Tabled
from ..statistics import Array, Coefficient, student_t
from .experiment import played, visited

BEYOND = 0.05
"""Part of a range by which it may be left without a word."""
LOUDER = 1.25
"""Times the amplitude that the records hold in an octave, from which it counts as new."""
FAINT = 0.02
"""Amplitudes below this part of an input's largest are not looked at."""
MOST_USUAL = (0.5, 2.5, 0.5)
"""Of all three, whatever the records' own parts show."""
PARTS = 6
"""Of the records that are left out in turn, at least."""
TOO_FAR = 1.0
"""Ranges by which a range may be left before it is absurd to predict there."""
OCTAVES = 4.0
"""Times the highest frequency measured, from which it is absurd."""
BLURRED = 0.5
"""Standard deviation of a prediction by its parameters, in that of the motion itself, from which
it tells nothing."""
USUAL = 99.0
"""Percentile of the distances among the records' own samples up to which a place counts as seen."""
APART = 0.1
"""Samples of one record nearer in time than this part of its duration are no neighbours."""
MOST = 4000
"""Samples that stand for all records in the search of neighbours."""


@dataclass(frozen=True)
class Reach:
    """Ranges of a variable, and the share of the samples asked for ``outside`` of what was seen."""

    name: str
    unit: str
    causality: str
    seen: tuple[float, float]
    asked: tuple[float, float]
    outside: float

    @property
    def beyond(self) -> float:
        """How far it leaves what was seen, in parts of that range."""
        size = max(self.seen[1] - self.seen[0], 1e-300)
        return max(self.seen[0] - self.asked[0], self.asked[1] - self.seen[1], 0.0) / size


@dataclass(frozen=True)
class Band:
    """An octave low .. high [Hz] of an input: largest amplitudes there [its unit]. highest : where
    the records end, the last octave with an amplitude that counts among theirs [Hz].
    """

    name: str
    low: float
    high: float
    seen: float
    asked: float
    highest: float

    @property
    def louder(self) -> float:
        """Times the amplitude that the records hold at such frequencies."""
        return self.asked / max(self.seen, 1e-300)


@dataclass(frozen=True, eq=False)
class Coverage:
    """What of a motion the records of a fit do not hold.

    reaches : of every variable. bands : octaves of the inputs. far : share of the samples whose
    state and inputs together are farther from all of the records than these are from each other.
    uncertainty : {measured variable: (standard deviation of the prediction by that of the
    parameters, the same along the records)}, RMS over the samples [its unit]. usual : what of
    beyond, louder and far parts of the records show against the others.

    Examples
    --------
    >>> seen = pam.fitting.coverage(dynamic_fit, {"muscle.command": 5e5}, duration=0.5)
    >>> seen.verdict
    'absurd'
    """

    reaches: tuple[Reach, ...]
    bands: tuple[Band, ...]
    far: float
    uncertainty: Mapping[str, tuple[float, float]]
    asked: tuple[Trajectory, ...] = field(repr=False)
    seen: tuple[Trajectory, ...] = field(repr=False)
    plant: Plant = field(repr=False)
    measured: tuple[str, ...] = field(repr=False)
    usual: tuple[float, float, float] = (BEYOND, LOUDER, BEYOND)

    @property
    def left(self) -> tuple[Reach, ...]:
        """Variables that leave what was seen, the farthest first."""
        out = [r for r in self.reaches if r.beyond > self.usual[0]]
        return tuple(sorted(out, key=lambda r: -r.beyond))

    @property
    def new_bands(self) -> tuple[Band, ...]:
        """Octaves with amplitudes that the records do not hold."""
        return tuple(b for b in self.bands if b.louder > self.usual[1])

    @property
    def covered(self) -> bool:
        """Whether the records hold the like of this motion."""
        return not self.left and not self.new_bands and self.far <= self.usual[2]

    @property
    def verdict(self) -> Literal["covered", "extrapolation", "absurd"]:
        """Of a motion that is not covered, whether the plant may still be asked for it."""
        if self.covered:
            return "covered"
        return "absurd" if self.absurdities else "extrapolation"

    @property
    def absurdities(self) -> tuple[str, ...]:
        """Why it makes no sense to predict this motion, in words; empty where it does."""
        words = []
        for r in self.reaches:
            v = self.plant.variable(r.name)
            slack = 1e-6 * max(v.nominal, r.seen[1] - r.seen[0])
            if r.asked[0] < v.min - slack or r.asked[1] > v.max + slack:
                words.append(
                    f"{r.name} goes to {r.asked[0]:.4g} .. {r.asked[1]:.4g} {_unit(r.unit)}, which "
                    f"the plant cannot ({v.min:.4g} .. {v.max:.4g})"
                )
            elif r.beyond > max(TOO_FAR, self.usual[0]):
                words.append(
                    f"{r.name} goes {r.beyond:.1f} times its whole measured range beyond it"
                )
        for b in self.new_bands:
            if 0 < OCTAVES * b.highest <= b.low:
                words.append(
                    f"{b.name} swings at {b.low:.3g} .. {b.high:.3g} Hz, where the records end at "
                    f"{b.highest:.3g} Hz"
                )
        for name, (here, _) in self.uncertainty.items():
            held_ = _column(name, self.asked)
            if held_.size and here > BLURRED * max(float(held_.std()), 1e-300):
                words.append(
                    f"{name} would be uncertain by ±{here:.3g} by its parameters alone, where it "
                    f"moves by {float(held_.std()):.3g} (standard deviations)"
                )
        return tuple(words)

    @property
    def doubts(self) -> tuple[str, ...]:
        """How a prediction may fail there, in words; empty when it is covered."""
        words = []
        for r in self.left:
            side = "above" if r.asked[1] - r.seen[1] > r.seen[0] - r.asked[0] else "below"
            end = r.asked[1] if side == "above" else r.asked[0]
            words.append(
                f"{r.name} goes to {end:.4g} {_unit(r.unit)}, {100 * r.beyond:.0f} % of its range "
                f"{side} what was measured ({r.seen[0]:.4g} .. {r.seen[1]:.4g}): {_why(r)}"
            )
        for b in self.new_bands:
            words.append(
                f"{b.name} swings by {b.asked:.3g} at {b.low:.3g} .. {b.high:.3g} Hz, measured "
                f"were {b.seen:.3g}: lags, dead time and slew limits there are extrapolated, so "
                "amplitude and phase may be off"
            )
        if self.far > self.usual[2]:
            words.append(
                f"{100 * self.far:.0f} % of its states and inputs, taken together, lie far from "
                "all that was measured, even where each alone does not: couplings (force over "
                "length and pressure, friction over tension) are the model's word alone"
            )
        for name, (here, there) in self.uncertainty.items():
            if here > 2 * there > 0:
                words.append(
                    f"{name}: the parameters' uncertainty alone makes ±{here:.3g} (one standard "
                    f"deviation), {here / there:.1f} times as much as along the records"
                )
        return tuple(words)

    def seeing(self, *motions: Trajectory) -> Coverage:
        """What would be left if these motions were measured, too; without uncertainties."""
        return _compared(self.plant, (*self.seen, *motions), self.asked, self.measured, self.usual)

    def report(self) -> str:
        """Ranges, octaves, and doubts, as text."""
        lines = [f"{'variable':<28}{'measured':>26}{'asked':>26}{'outside':>9}"]
        for r in self.reaches:
            seen, asked = (f"{a:.4g} .. {b:.4g}" for a, b in (r.seen, r.asked))
            lines.append(f"{r.name:<28}{seen:>26}{asked:>26}{100 * r.outside:>7.0f} %")
        lines.append(f"{'input':<28}{'octave [Hz]':>26}{'measured':>13}{'asked':>13}")
        for b in self.bands:
            octave = f"{b.low:.3g} .. {b.high:.3g}"
            mark = "  new" if b in self.new_bands else ""
            lines.append(f"{b.name:<28}{octave:>26}{b.seen:>13.3g}{b.asked:>13.3g}{mark}")
        lines.append(
            {
                "covered": "covered: the records hold the like of it",
                "extrapolation": "an extrapolation that the plant may be asked for; a prediction "
                "may fail here:",
                "absurd": "absurd: the records say nothing of such a motion; a prediction may fail "
                "here:",
            }[self.verdict]
        )
        lines += [f"  - {text}" for text in self.absurdities if self.verdict == "absurd"]
        lines += [f"  - {text}" for text in self.doubts if self.verdict != "covered"]
        return "\n".join(lines)

    __str__ = report


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _why(r: Reach) -> str:
    if r.causality == "input":
        return "the feed and the force law are extrapolated"
    if "/s" in r.unit:
        return "friction and damping at such speeds are extrapolated"
    return "the force law and the loads are extrapolated"


@verb
def coverage(
    fit: Any,
    other: Trajectory | Sequence[Trajectory] | Inputs,
    *,
    duration: float | None = None,
    sample: float = 0.01,
    start: Mapping[str, float] | None = None,
    uncertainty: bool = True,
) -> Coverage:
    """Compare where the records of a fit have been with a motion that it is to predict.

    Parameters
    ----------
    fit : a PlantFit or a FreeRunFit, with its records.
    other : records, a plan's trajectory, or inputs as :func:`simulate` takes them; states that it
        does not hold are those of the fitted plant under its inputs.
    duration, sample : [s] of a motion that is given by inputs that are no Trajectory.
    start : initial states of such a motion.
    uncertainty : whether the parameters' covariance is carried along the motion, which takes a
        simulation for each of them.

    Raises InputError (inputs without a duration, a fit without records).

    Examples
    --------
    >>> seen = pam.fitting.coverage(dynamic_fit, record)
    >>> seen.far, pam.fitting.coverage(dynamic_fit, {"muscle.command": 6e5}, duration=0.5).far > 0.5
    (0.0, True)
    """
    if not (hasattr(fit, "plant") and hasattr(fit, "records")):
        raise InputError(f"fit is {kind_of(fit)}: give what fit_plant or fit_free_run returned")
    plant: Plant = fit.plant
    if not fit.records:
        raise InputError("the fit holds no records: give one that was fitted here or loaded whole")
    asked = _asked(plant, other, duration, sample, start)
    before = [visited(plant, r) for r in fit.records]
    _require_whole(plant, before, asked)
    measured = tuple(fit.measured if hasattr(fit, "measured") else fit.training.names)
    found = _compared(plant, before, asked, measured, _usual(plant, before))
    spread = _uncertainty(fit, before, asked, measured) if uncertainty else {}
    return replace(found, uncertainty=spread)


def _require_whole(plant: Plant, before: Sequence[Trajectory], asked: Sequence[Trajectory]) -> None:
    needed = [v.name for v in plant.inputs if all(v.name in m for m in before)]
    for motion in asked:
        if missing := [n for n in needed if n not in motion]:
            raise InputError(f"other: no column for the input {missing[0]}, which the records hold")
        for n in motion.names:
            if not np.all(np.isfinite(motion[n])):
                raise InputError(f"other: {n} is not finite; cut the motion there")


def _compared(
    plant: Plant,
    before: Sequence[Trajectory],
    asked: Sequence[Trajectory],
    measured: tuple[str, ...],
    usual: tuple[float, float, float],
) -> Coverage:
    names = [v.name for v in (*plant.states, *plant.inputs)]
    shown = [*names, *(n for n in measured if n not in names)]
    return Coverage(
        tuple(_reach(plant, n, before, asked) for n in shown),
        tuple(b for v in plant.inputs for b in _bands(v.name, before, asked)),
        _far(plant, names, before, asked),
        {},
        tuple(asked),
        tuple(before),
        plant,
        measured,
        usual,
    )


def _usual(plant: Plant, records: Sequence[Trajectory]) -> tuple[float, float, float]:
    """The most by which a part of the records leaves the others, and lies far from all of them."""
    parts = _parts(records)
    names = [v.name for v in (*plant.states, *plant.inputs)]
    found = [(BEYOND, LOUDER, BEYOND)]
    for i, part in enumerate(parts if len(parts) > 2 else ()):
        rest = [p for k, p in enumerate(parts) if k != i]
        beyond = max(_reach(plant, n, rest, [part]).beyond for n in names)
        bands = [b.louder for v in plant.inputs for b in _bands(v.name, rest, [part])]
        found.append((beyond, max(bands, default=0.0), _far(plant, names, rest, [part])))
    ends = zip(np.nanmax(found, axis=0), MOST_USUAL, strict=True)
    beyond, louder, far = (float(min(most, end)) for most, end in ends)
    return beyond, louder, far


def _parts(records: Sequence[Trajectory]) -> list[Trajectory]:
    """Whole records, or pieces of them where they are few."""
    pieces = max(1, -(-PARTS // len(records)))
    if pieces == 1:
        return list(records)
    found = []
    for r in records:
        edges = np.linspace(0, len(r), pieces + 1).astype(int)
        for a, b in pairwise(edges.tolist()):
            if b - a > 3:
                columns = {n: r[n][a:b] for n in r.names}
                found.append(Trajectory(r.t[a:b], columns, interpolation=r.interpolation))
    return found


def _asked(
    plant: Plant,
    other: Any,
    duration: float | None,
    sample: float,
    start: Mapping[str, float] | None,
) -> list[Trajectory]:
    if isinstance(other, Trajectory):
        return [visited(plant, other, start)]
    if isinstance(other, (list, tuple)):
        if not other:
            raise InputError("other is empty: give records, or inputs")
        return [visited(plant, r, start) for r in other]
    if duration is None:
        raise InputError("duration: how long shall these inputs be played? [s]")
    end = require_positive("duration", duration, "s")
    t = np.arange(0.0, end + 0.5 * sample, require_positive("sample", sample, "s"))
    return [simulate(plant, other, t=t, start=dict(start or {}), rtol=1e-6)]


def _column(name: str, motions: Sequence[Trajectory]) -> Array:
    held = [m[name] for m in motions if name in m]
    return np.concatenate(held) if held else np.empty(0)


def _reach(
    plant: Plant, name: str, before: Sequence[Trajectory], asked: Sequence[Trajectory]
) -> Reach:
    v, old, new = plant.variable(name), _column(name, before), _column(name, asked)
    if v.causality == "state" and old.size and not all(name in m for m in asked):
        new = np.array([-np.inf, np.inf])  # where no run of the plant came to its end
    if not old.size or not new.size:
        nothing = (np.nan, np.nan)
        return Reach(name, v.unit, v.causality, nothing, nothing, 0.0)
    seen, goal = (old.min(), old.max()), (new.min(), new.max())
    slack = 1e-9 * v.nominal
    outside = np.mean((new < seen[0] - slack) | (new > seen[1] + slack))
    ends = [(float(a), float(b)) for a, b in (seen, goal)]
    return Reach(name, v.unit, v.causality, ends[0], ends[1], float(outside))


def _bands(name: str, before: Sequence[Trajectory], asked: Sequence[Trajectory]) -> list[Band]:
    """Largest amplitudes by octave; down to one period in the longest of the motions."""
    both = [m for m in (*before, *asked) if name in m and len(m) > 3]
    if not both:
        return []
    longest = max(m.duration for m in both)
    nyquist = max(0.5 * (len(m) - 1) / m.duration for m in both)
    edges = [1 / (1.5 * longest)]
    while edges[-1] < nyquist:
        edges.append(2 * edges[-1])
    old, new = (_amplitudes(name, part, edges) for part in (before, asked))
    least = FAINT * max(float(new.max(initial=0.0)), 1e-300)
    held = np.asarray(edges[1:])[(old > 0) & (old >= FAINT * old.max(initial=0.0))]
    highest = float(held.max(initial=0.0))
    return [
        Band(name, a, b, float(x), float(y), highest)
        for a, b, x, y in zip(edges[:-1], edges[1:], old, new, strict=True)
        if y > least
    ]


def _amplitudes(name: str, motions: Sequence[Trajectory], edges: Sequence[float]) -> Array:
    """Root of twice the power in each octave: a sine shows its amplitude; the most of all."""
    found = np.zeros(len(edges) - 1)
    for m in motions:
        if name not in m or len(m) < 4:
            continue
        t = np.linspace(m.t[0], m.t[-1], len(m))
        u = np.interp(t, m.t, m[name])
        window = np.hanning(len(u) + 2)[1:-1]
        lines = np.fft.rfft((u - u.mean()) * window)
        power = 2 * np.abs(lines) ** 2 / (len(u) * np.sum(window**2))
        frequency = np.fft.rfftfreq(len(u), t[1] - t[0])
        total = np.histogram(frequency, np.asarray(edges), weights=power)[0]
        found = np.maximum(found, np.sqrt(2 * total))
    return found


def _far(
    plant: Plant, names: Sequence[str], before: Sequence[Trajectory], asked: Sequence[Trajectory]
) -> float:
    """Share of the samples asked for that are farther from the records than usual among them."""
    from scipy.spatial import cKDTree

    used = [n for n in names if all(n in m for m in (*before, *asked))]
    if not used:
        return 0.0
    place = np.concatenate([m.array(used) for m in before])
    owner = np.concatenate([np.full(len(m), i) for i, m in enumerate(before)])
    time = np.concatenate([(m.t - m.t[0]) / max(m.duration, 1e-300) for m in before])
    scale = place.std(axis=0)
    nominal = np.array([plant.variable(n).nominal for n in used])
    scale = np.where(scale > 1e-6 * nominal, scale, nominal)
    keep = np.linspace(0, len(place) - 1, min(MOST, len(place))).astype(int)
    place, owner, time = place[keep] / scale, owner[keep], time[keep]
    # neighbours of the same moment say nothing: in turn one part of the records is left out
    part = np.floor(time / APART).astype(int) + 1000 * owner * (len(before) < 5)
    label = owner if len(before) >= 5 else part
    own = []
    for k in np.unique(label)[:: max(1, len(np.unique(label)) // 20)]:
        out = label == k
        if not out.all():
            own.append(cKDTree(place[~out]).query(place[out])[0])
    usual = float(np.percentile(np.concatenate(own), USUAL)) if own else 0.0
    goal = np.concatenate([m.array(used) for m in asked]) / scale
    return float(np.mean(cKDTree(place).query(goal)[0] > usual))


def _uncertainty(
    fit: Any, before: Sequence[Trajectory], asked: Sequence[Trajectory], measured: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """RMS standard deviations by the parameters' covariance: along ``asked``, ``before``."""
    plant: Plant = fit.plant
    known = [v.name for v in plant.parameters]
    held = [n for n in fit.coefficients if all(part in known for part in n.split(" = "))]
    spread = np.asarray(fit.covariance)
    order = list(fit.coefficients)
    held = [
        n for n in held if np.isfinite(spread[order.index(n), order.index(n)])
    ]  # not at a bound
    rows = [order.index(n) for n in held]
    covariance = spread[np.ix_(rows, rows)]
    if not held:
        return {}
    values, vectors = np.linalg.eigh(covariance)
    directions = [v * np.sqrt(max(w, 0.0)) for w, v in zip(values, vectors.T, strict=True) if w > 0]
    begin = {v.name: float(v.start or 0.0) for v in plant.parameters}

    def total(motions: Sequence[Trajectory]) -> dict[str, float]:
        squares, count = dict.fromkeys(measured, 0.0), 0
        for m in motions:
            start = {v.name: float(m[v.name][0]) for v in plant.states if v.name in m}
            base = played(plant, m, start, 1e-7)
            count += len(m)
            for step in directions:
                moved = {
                    p: begin[p] + 0.1 * float(d)
                    for n, d in zip(held, step, strict=True)
                    for p in n.split(" = ")
                }
                run = played(plant.with_values(moved), m, start, 1e-7)
                for n in measured:
                    squares[n] += float(np.sum((10 * (run[n] - base[n])) ** 2))
        return {n: float(np.sqrt(s / max(count, 1))) for n, s in squares.items()}

    try:
        there = total(before[:3])
    except SimulationError:
        return {}
    try:
        here = total(asked)
    except SimulationError:  # neither the plant nor its like can be run along it
        here = dict.fromkeys(measured, np.inf)
    return {n: (here[n], there[n]) for n in measured}


# ---- of fits of plants ---------------------------------------------------------------------------
class FittedPlant(Tabled, ABC):
    """What fits of plants tell alike; intervals by Student's t, of as many residuals as are
    independent (standard errors count autocorrelation, see ``coefficients``).
    """

    @property
    def _called(self) -> str:
        return "fitted parameter"

    @abstractmethod
    def _freedom(self, name: str) -> int:
        """Degrees of freedom of a coefficient's interval."""

    @abstractmethod
    def _plain(self) -> Array:
        """Covariance of the coefficients before their standard errors were widened."""

    def _half(self, c: Coefficient, level: float) -> float:
        return student_t(level, self._freedom(c.name)) * c.stderr

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, in the order of ``coefficients``."""
        plain = self._plain()
        size = np.sqrt(np.maximum(np.diag(plain), 1e-300))
        wider = np.array([c.stderr for c in self.coefficients.values()])
        ratio = np.where(np.isfinite(wider), wider / size, 1.0)
        return np.asarray(plain * np.outer(ratio, ratio))

    def coverage(self, other: Any, **options: Any) -> Coverage:
        """Where the records of this fit have been, against a record or a signal that is to be
        predicted: see :func:`pam_ocp.fitting.coverage`.
        """
        return coverage(self, other, **options)
