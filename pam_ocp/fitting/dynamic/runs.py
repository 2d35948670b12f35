"""Where free runs of a plant begin in records, and what they are compared with.

Where the states begin that nobody measured: pressures, spools, heat, creep, slip.

Each record gets a start of its own for them, estimated with all else. Runs from moments in the
middle of a record begin where the plant has brought these states by then, along the measured
inputs, the measured states set to what was measured at each start.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_count, require_positive
from ...core.shown import shown
from ...core.trajectory import Trajectory
from ...numerics.rosenbrock import ros2
from ...plants.plant import Plant
from ..statistics import Array
from .experiment import measured_names, recorded


@dataclass(frozen=True, eq=False)
class RunSteps:
    """Inputs at the begins and ends of steps, and what they gain per second of delay, (n - 1,
    steps, nu) each; lengths of the steps (n - 1, steps) [s], and what these gain per second of each
    input's delay (steps, nu).
    """

    begin: Array
    end: Array
    begin_slope: Array
    end_slope: Array
    length: Array
    length_slope: Array


@dataclass(frozen=True, eq=False)
class RunInputs:
    """t (n,), u (n, nu): samples, joined by lines or ``held``; before the first its value holds."""

    t: Array
    u: Array
    held: bool

    def steps(self, delays: Array, late: Sequence[tuple[int, ...]], count: int) -> RunSteps:
        """In ``count`` steps of each sampling interval. delays : of each input [s]. late : inputs
        that are late, those of one delay together. Held ones jump inside of the intervals: there a
        step ends and the next begins, so that none has to do with two values and their motion
        depends on the delay without jumps.
        """
        if self.held:
            return self._between_jumps(delays, late, count)
        part = np.arange(count + 1) / count
        spans = np.diff(self.t)
        grid = self.t[:-1, None] + part * spans[:, None]
        found = np.array([self._line(i, grid - d) for i, d in enumerate(delays)])
        value, slope = np.moveaxis(found.reshape(len(delays), 2, *grid.shape), (1, 0), (0, -1))
        edges = value[:, :-1], value[:, 1:], slope[:, :-1], slope[:, 1:]
        length = np.repeat(spans[:, None] / count, count, axis=1)
        return RunSteps(*edges, length, np.zeros((count, len(delays))))

    def _line(self, i: int, at: Array) -> tuple[Array, Array]:
        """Values, and what they gain per second of delay."""
        t, u = self.t, self.u[:, i]
        slopes = np.concatenate([[0.0], np.diff(u) / np.diff(t)])
        # the line that a moment lies on when the delay grows: the one to its left
        left = np.clip(np.searchsorted(t, at - 1e-9 * (t[1] - t[0])), 0, len(t) - 1)
        return np.interp(at, t, u), -slopes[left]

    def _between_jumps(
        self, delays: Array, late: Sequence[tuple[int, ...]], count: int
    ) -> RunSteps:
        n = len(self.t) - 1
        sampling = (self.t[-1] - self.t[0]) / n
        number = delays / sampling
        floor = np.floor(number + 1e-9)
        whole, part = floor.astype(np.intp), np.clip(number - floor, 0.0, 1.0)
        rank = sorted(range(len(late)), key=lambda g: part[late[g][0]])
        jumps = np.array([part[late[g][0]] for g in rank])
        ends = np.concatenate([[0.0], jumps, [1.0]])
        shares = _shared(np.diff(ends), count)
        between = np.repeat(np.arange(len(shares)), shares)  # the jumps that each step lies behind
        order = np.full(len(delays), -1)
        for k, g in enumerate(rank):
            order[list(late[g])] = k
        passed = between[None, :] > order[:, None]
        place = np.arange(n)[:, None, None] - (whole[:, None] + 1 - passed).T
        value = np.take_along_axis(self.u[:, None, :], np.clip(place, 0, n), axis=0)
        slope = np.zeros((len(shares), len(delays)))
        for k, g in enumerate(rank):
            slope[k, late[g][0]] += 1.0
            slope[k + 1, late[g][0]] -= 1.0
        still = np.zeros_like(value)
        length = np.diff(self.t)[:, None] * (np.diff(ends) / shares)[between]
        return RunSteps(value, value, still, still, length, (slope / shares[:, None])[between])


def _shared(spans: Array, count: int) -> NDArray[np.intp]:
    """``count`` steps over parts of an interval: one to each, others where steps are longest."""
    found = np.ones(len(spans), dtype=np.intp)
    for _ in range(count - len(spans)):
        found[int(np.argmax(spans / found))] += 1
    return found


LEAST_STEPS, MOST_STEPS = 4, 64
"""In a sampling interval: where the search for enough of them begins and ends."""
FAR = 100.0
"""Ranges of a measured variable by which a run must be off to count as diverged."""


@shown
@dataclass(frozen=True, eq=False)
class FreeRun:
    """Runs of a plant from many starts, beside what was measured.

    record, start : of each run (n,) the number of its record and the time where it begins [s].
    t : times since the start (K,) [s]. measured, predicted : (n, K, ny), in SI, of ``names``; NaN
    behind the end of a run that its record cuts short. horizons : [s], those that were asked for.

    Examples
    --------
    >>> run = pam.fitting.free_run(plant, record, horizon=0.3, every=0.2, outputs=["x"])
    >>> run.predicted.shape == run.measured.shape
    True
    """

    names: tuple[str, ...]
    record: NDArray[Any]
    start: Array
    t: Array = field(repr=False)
    measured: Array = field(repr=False)
    predicted: Array = field(repr=False)
    sizes: Array = field(repr=False)
    """Range of each measured variable over the runs, at least its nominal."""
    horizons: tuple[float, ...] = ()

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared error over all samples of all runs [unit of the variable].

        Infinite where a run went beyond all numbers.
        """
        return self._rooted(self._squares())

    def rmse_over(self, horizon: float) -> dict[str, float]:
        """The same within a horizon [s], of the runs that are that long."""
        return self._rooted(self._squares(self._samples(horizon)))

    def _rooted(self, squares: Array) -> dict[str, float]:
        return dict(zip(self.names, np.sqrt(_mean(squares)).tolist(), strict=True))

    def losses(self, records: int, horizon: float | None = None) -> Array:
        """Mean squared error in each record (records, ny), of the runs that are as long as
        ``horizon``; NaN where a record has none.
        """
        squares, record = self._squares(), self.record
        if horizon is not None:
            count = self._samples(horizon)
            squares, record = self._squares(count), record[self._long(count)]
        return np.array([_mean(squares[record == r]) for r in range(records)])

    def _long(self, count: int) -> NDArray[np.bool_]:
        """Which runs last so many samples."""
        return np.asarray(~np.isnan(self.measured[:, count - 1, 0]))

    def _samples(self, horizon: float) -> int:
        return int(np.searchsorted(self.t, horizon * (1 + 1e-9), side="right"))

    def _squares(self, count: int | None = None) -> Array:
        """(n, K, ny); NaN where nothing was measured, infinite where a run has no number."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = (self.predicted - self.measured) ** 2
        squares[~np.isfinite(squares)] = np.inf
        squares[np.isnan(self.measured)] = np.nan
        return squares if count is None else squares[self._long(count), :count]

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Which runs (n,) went beyond all numbers, or astray by 100 ranges of what was measured."""
        with np.errstate(over="ignore", invalid="ignore"):
            far = np.abs(self.predicted - self.measured) / self.sizes
        lost = ~(far <= FAR) & ~np.isnan(self.measured)
        return np.asarray(lost.any(axis=(1, 2)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """That runs diverged, and where; empty when none did."""
        lost = np.nonzero(self.diverged)[0]
        if not lost.size:
            return ()
        first = int(lost[0])
        return (
            f"{lost.size} of {len(self.start)} free runs diverge, the first from t = "
            f"{self.start[first]:g} s of record {int(self.record[first]) + 1}: there the plant "
            "predicts nothing; fit on such records, too, take a shorter horizon, or more steps "
            "where the integration is too coarse",
        )

    def __str__(self) -> str:
        lines = [f"{len(self.start)} free runs of {self.t[-1]:g} s"]
        for h in self.horizons or (self.t[-1],):
            over = f" over {h:g} s" if len(self.horizons) > 1 else ""
            lines += [f"    {n}: RMSE{over} {e:.4g}" for n, e in self.rmse_over(h).items()]
        return "\n".join([*lines, *(f"    warning: {w}" for w in self.warnings)])


@dataclass(frozen=True, eq=False)
class Band:
    """Predicted runs and where the measured ones lie: ``run.predicted`` -+ ``half`` (n, K, ny).

    Examples
    --------
    >>> 0.8 < learned.predict(record, level=0.9).coverage["x"] <= 1.0
    True
    """

    run: FreeRun
    half: Array

    @property
    def coverage(self) -> dict[str, float]:
        """The part of the measured samples that lies inside, by variable."""
        inside = np.abs(self.run.predicted - self.run.measured) <= self.half
        seen = ~np.isnan(self.run.measured)
        return {n: float(inside[..., i][seen[..., i]].mean()) for i, n in enumerate(self.run.names)}


NEAR = 0.2
"""Of the samples left out, the part that says how wide a band is: those nearest to its point."""


def half_widths(
    apart: Array,
    predicted: Array,
    left: Sequence[Array],
    level: float,
) -> Array:
    """Half widths (n, K, ny) of bands around what is predicted. apart (folds, n, K, ny) : how the
    folds differ from it. left : what each fold predicts of what it left out, and the sizes of its
    errors (2, samples, ny).
    """
    from scipy.spatial import KDTree  # loaded where bands are asked for

    at, errors = np.concatenate(left, axis=1)
    fold = np.repeat(np.arange(len(left)), [e.shape[1] for e in left])
    size = np.maximum(at.std(axis=0), 1e-300)
    points = np.nan_to_num(predicted.reshape(-1, at.shape[1]) / size)
    count = max(int(np.ceil(NEAR * len(at))), 1)
    rank = min(int(np.ceil((count + 1) * level)), count) - 1
    places = KDTree(at / size).query(points, np.arange(1, count + 1))[1]
    half = np.empty(points.shape)
    for i, own in enumerate(places):
        aside = apart.reshape(len(left), -1, at.shape[1])[fold[own], i]
        ends = (np.partition(errors[own] + a, rank, axis=0)[rank] for a in (aside, -aside))
        half[i] = np.maximum(*ends)
    return half.reshape(predicted.shape)


def _mean(squares: Array) -> Array:
    """Of what was measured (n, K, ny), by variable; NaN where nothing was."""
    seen = ~np.isnan(squares)
    count = seen.sum(axis=(0, 1))
    total = np.where(seen, squares, 0.0).sum(axis=(0, 1))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, eq=False)
class Runs:
    """What runs start from and are compared with. first : sample of its record (n,) where each
    begins, ``warm`` samples before its start, and length (n,) the samples after the start. x0 (n,
    nx) at ``first`` as measured; seen (n, warm, ny) what was measured from there on. weights (n,
    K): of each sample, so that the horizons weigh alike and each is a mean. inputs : of each
    record. steps : to a sample, at least.
    """

    names: tuple[str, ...]
    record: NDArray[np.intp]
    start: Array
    t: Array
    measured: Array
    x0: Array
    first: NDArray[np.intp]
    length: NDArray[np.intp]
    warm: int
    seen: Array
    weights: Array
    inputs: Sequence[RunInputs]
    steps: int
    sizes: Array
    horizons: tuple[float, ...]

    def result(self, predicted: Array) -> FreeRun:
        own = {f.name: getattr(self, f.name) for f in fields(FreeRun) if f.name != "predicted"}
        return FreeRun(**own, predicted=predicted)


def runs_of(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    horizon: float | Sequence[float] | None,
    every: float | None,
    outputs: Sequence[str] | None,
    history: int,
    steps: int,
    warm_up: float = 0.0,
    even: bool = True,
) -> Runs:
    """even : whether records must be sampled at the same equal steps; else times are nominal."""
    chosen = recorded(records)
    names = measured_names(plant, chosen, outputs)
    require_count("history", history, 2)
    require_count("steps", steps)
    sampling = _sampling(chosen) if even else float(np.median(np.diff(chosen[0].t)))
    warm = 0
    if require_positive("warm_up", warm_up, "s", zero=True):
        warm = _multiple("warm_up", warm_up, sampling)
    horizons = _horizons(horizon, sampling)
    stride = None if every is None else _multiple("every", every, sampling)
    if horizons is not None and stride is None:
        raise InputError(
            "every: give the time from start to start [s]; only whole records need none"
        )
    inputs = [v.name for v in plant.inputs]
    rows: list[tuple[int, int, int]] = []
    for r, record in enumerate(chosen):
        missing = [n for n in inputs if n not in record]
        if missing:
            raise InputError(f"record {r + 1} has no column for the input {missing[0]}")
        if not np.all(np.isfinite(record.array(inputs))):
            raise InputError(f"record {r + 1}: an input is not finite; cut the record there")
        rows += _spans(r, len(record) - 1, horizons, stride, history - 1 + warm)
    if not rows:
        least = "one sample" if horizons is None else f"a horizon of {sampling * horizons[0]:g} s"
        raise InputError(
            f"no record holds {history + warm} samples and {least} after them; the "
            f"longest lasts {max(r.duration for r in chosen):g} s"
        )
    number, begin, length = (np.array(c, dtype=np.intp) for c in zip(*rows, strict=True))
    longest = int(length.max())
    columns = [r.array(names) for r in chosen]
    measured = np.full((len(rows), longest, len(names)), np.nan)
    seen = np.empty((len(rows), warm, len(names)))
    for row, (r, i, k) in enumerate(rows):
        measured[row, :k] = columns[r][i + 1 : i + k + 1]
        seen[row] = columns[r][i - warm + 1 : i + 1]
    every_value = measured[~np.isnan(measured[:, :, 0])]
    nominal = np.array([plant.variable(n).nominal for n in names])
    x0 = [_start(plant, chosen[r], i - warm, history) for r, i, _ in rows]
    return Runs(
        tuple(names),
        number,
        np.array([chosen[r].t[i] for r, i, _ in rows]),
        np.asarray(sampling * np.arange(1, longest + 1)),
        measured,
        np.array(x0),
        begin - warm,
        length,
        warm,
        seen,
        _weights(length, horizons or (longest,), horizons is None),
        [RunInputs(r.t, r.array(inputs), r.interpolation == "previous") for r in chosen],
        steps,
        np.maximum(np.ptp(every_value, axis=0), nominal),
        tuple(sampling * h for h in horizons or ()),
    )


def _horizons(given: Any, sampling: float) -> tuple[int, ...] | None:
    """In samples, rising; None for whole records."""
    if given is None:
        return None
    several = list(given) if isinstance(given, (Sequence, np.ndarray)) else [given]
    if not several:
        raise InputError("horizon is empty: give [s], one or several, or None for whole records")
    return tuple(sorted({_multiple("horizon", h, sampling) for h in several}))


def _spans(
    record: int, last: int, horizons: tuple[int, ...] | None, stride: int | None, before: int
) -> list[tuple[int, int, int]]:
    """(record, sample of the start, samples after it) of each run, as long as the record allows."""
    if horizons is None:
        return [(record, before, last - before)] if last > before else []
    assert stride is not None
    first = -(-before // stride) * stride
    return [
        (record, i, min(horizons[-1], last - i))
        for i in range(first, last - horizons[0] + 1, stride)
    ]


def _weights(length: NDArray[np.intp], horizons: Sequence[int], whole: bool) -> Array:
    """Of each sample of each run: all of one horizon make 1, and the horizons are averaged."""
    k = np.arange(int(length.max()))
    inside = k < length[:, None]
    if whole:
        return np.asarray(inside / inside.sum())
    found = np.zeros(inside.shape)
    reached = [h for h in horizons if np.any(length >= h)]
    for h in reached:
        rows = length >= h
        found += rows[:, None] * (k < h) / (rows.sum() * h * len(reached))
    return found


def _sampling(records: Sequence[Trajectory]) -> float:
    """The sampling time of all records [s]."""
    usual = float(np.median(np.diff(records[0].t)))
    for r, record in enumerate(records):
        steps = np.diff(record.t)
        uneven = np.nonzero(np.abs(steps - usual) > 1e-3 * usual)[0]
        if uneven.size or not steps.size:
            where = (
                f"a step of {steps[uneven[0]]:g} s at t = {record.t[uneven[0]]:g} s"
                if uneven.size
                else "one sample"
            )
            raise InputError(
                f"record {r + 1} has {where} where {usual:g} s are usual; free runs want equal "
                "steps: resample it with record.at(...)"
            )
    return usual


def _multiple(argument: str, value: Any, sampling: float) -> int:
    number = require_positive(argument, value, "s") / sampling
    whole = round(number)
    if whole < 1 or abs(number - whole) > 1e-3 * number:
        raise InputError(
            f"{argument} = {value:g} s is no multiple of the sampling time {sampling:g} s"
        )
    return whole


def _start(plant: Plant, record: Trajectory, i: int, history: int) -> Array:
    """The states at sample i from that sample and those before."""
    values = {v.name: float(v.start or 0.0) for v in plant.states}
    past = slice(i - history + 1, i + 1)
    since = record.t[past] - record.t[past].mean()
    for position, velocity in plant.positions.items():
        if position in record:
            values[velocity] = float(since @ record[position][past] / (since @ since))
    values.update({n: float(record[n][i]) for n in values if n in record})
    return np.array([values[v.name] for v in plant.states])


SETTLING = np.concatenate([2e-3 * 2.0 ** np.arange(12), np.full(8, 0.5)])
"""Steps [s] of rest before a record: 12 s in all."""


def hidden_states(
    plant: Plant, measured: Sequence[str], known: Collection[str], whole: bool
) -> list[int]:
    """Positions of the states whose starts are found by default: those that were not measured and
    are not ``known``; of ``whole`` records all, as one sample's noise would count in all of it.
    """
    given = set(known)
    if not whole:
        given |= {*measured, *(v for q, v in plant.positions.items() if q in measured)}
    return [i for i, v in enumerate(plant.states) if v.name not in given]


def settled_starts(plant: Plant, runs: Runs, records: int, places: Sequence[int]) -> Array:
    """Guesses (records, len(places)): measured states and velocities as at a record's first run,
    others at rest under its first inputs, or at the plant's start where they find no rest.
    """
    if not places:
        return np.empty((records, 0))
    order = [v.name for v in plant.states]
    seen = {*runs.names, *(v for q, v in plant.positions.items() if q in runs.names)}
    loose = [i for i, n in enumerate(order) if n not in seen]
    step = _settling(plant, loose) if loose else ca.Function()
    low, high = (plant.vector("state", attribute=a) for a in ("min", "max"))
    found = np.empty((records, len(places)))
    for r in range(records):
        rows = np.nonzero(runs.record == r)[0]
        if not rows.size:
            found[r] = plant.vector("state")[list(places)]
            continue
        first = rows[np.argmin(runs.first[rows])]
        begin = runs.x0[first].copy()
        part = begin[loose]
        now = runs.inputs[r].u[int(runs.first[first])]
        for length in SETTLING if loose else ():
            part = np.asarray(step(part, begin, now, length)).ravel()
        if np.all(np.isfinite(part)) and np.all((part >= low[loose]) & (part <= high[loose])):
            begin[loose] = part
        found[r] = np.clip(begin, low, high)[list(places)]
    return found


def _settling(plant: Plant, loose: list[int]) -> ca.Function:
    """A step of these states towards rest: (they, all states, inputs, its length) -> they."""
    nx = len(plant.states)
    x, u, h = ca.SX.sym("x", nx), ca.SX.sym("u", len(plant.inputs)), ca.SX.sym("h")
    own, p = ca.SX.sym("own", len(loose)), ca.SX(plant.vector("parameter"))

    def rates(part: ca.SX) -> ca.SX:
        every = ca.SX(x)
        every[loose] = part
        return plant.function(every, u, p)[0][loose]

    after = ros2(lambda q: (rates(q), ca.jacobian(rates(q), q)), rates, own, h)
    return ca.Function("settle", [own, x, u, h], [after])
