"""Structures that :func:`choose` chooses among: plants, by free runs or by whole records, and
linear models as a yardstick (ARX, subspaces), with what all models without physics share: scales,
windows of the past, checked records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.errors import (
    FitError,
    InputError,
    require_count,
    require_instance,
    require_positive,
)
from ...core.trajectory import Trajectory
from ...plants.plant import Plant, require_plant
from ..statistics import Array
from .dynamic import fit_plant
from .experiment import groups
from .free_run_fit import fit_free_run
from .free_run_result import FreeRunFit
from .plant_fit import PlantFit


@dataclass(frozen=True, eq=False)
class FreeRunStructure:
    """A plant that is fitted and judged by free runs.

    options : of :func:`fit_free_run`; its horizons are the criteria, for each measured variable.
    judged : what differs where runs are judged, such as ``{"every": 0.05, "steps": 8}``.

    Examples
    --------
    >>> options = {"horizon": [0.1], "every": 0.2}
    >>> pam.fitting.FreeRunStructure(plant, ["mass"], options).complexity
    1.0
    """

    plant: Plant
    free: Sequence[str | Sequence[str]]
    options: Mapping[str, Any]
    judged: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_plant(self.plant)

    @property
    def complexity(self) -> float:
        """Number of unknowns; of a disturbance its rate and its gain."""
        pushed = self.options.get("disturbance", ())
        count = 1 if isinstance(pushed, str) else len(pushed)
        return float(len(groups(self.plant, self.free)) + 2 * count)

    def fit(self, records: Sequence[Trajectory], /) -> FreeRunFit:
        """See :func:`fit_free_run`."""
        return fit_free_run(
            self.plant, list(records), self.free, **{"judge": False, **self.options}
        )

    def losses(self, model: FreeRunFit, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record over each horizon, variable by variable."""
        options = {**model.options, "outputs": list(model.training.names), **self.judged}
        horizons = options.pop("horizon")
        several = [horizons] if isinstance(horizons, float | int) else list(horizons or [None])
        shortest = min(several) if several[0] is not None else None
        long = [i for i, r in enumerate(records) if _reaches(r, shortest, options)]
        found = np.full((len(records), len(several), len(model.training.names)), np.nan)
        if long:
            runs = model.validate(
                [records[i] for i in long],
                horizon=several if shortest is not None else None,
                **options,
            )
            for k, h in enumerate(several):
                found[long, k] = runs.losses(len(long), h)
        return found.reshape(len(records), -1)


def _reaches(record: Trajectory, horizon: float | None, options: Mapping[str, Any]) -> bool:
    """Whether a run of this horizon, with its past, lies in the record."""
    if horizon is None:
        return True
    sampling = record.duration / (len(record) - 1)
    before = (options["history"] - 1) * sampling + options["warm_up"]
    every = options["every"]
    return bool(np.ceil(before / every - 1e-9) * every + horizon <= record.duration + 1e-9)


@dataclass(frozen=True, eq=False)
class PlantStructure:
    """A plant that is fitted to whole records and judged by simulations of them, of which only the
    initial states are estimated.

    options : of :func:`fit_plant`. The criteria are its measured variables.

    Examples
    --------
    >>> pam.fitting.PlantStructure(plant, ["mass"]).complexity
    1.0
    """

    plant: Plant
    free: Sequence[str | Sequence[str]]
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_plant(self.plant)

    @property
    def complexity(self) -> float:
        """Number of unknowns."""
        return float(len(groups(self.plant, self.free)))

    def fit(self, records: Sequence[Trajectory], /) -> PlantFit:
        """See :func:`fit_plant`."""
        return fit_plant(self.plant, list(records), self.free, **self.options)

    def losses(self, model: PlantFit, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each measured variable in each record."""
        rows = [[c[n].rmse ** 2 for n in model.measured] for c in model.validate(list(records))]
        return np.asarray(rows, dtype=float)


# ---- models without physics ---------------------------------------------------------------------
LONGEST_LAG = 10_000
"""Samples."""


def levels_of(xp: Any, series: Any, times: Any, lag: int, order: int) -> Any:
    """What lies ``lag``, lag + 1, ... samples before each of ``times``: (times, n, order, c) of a
    series (T, n, c). Beyond its ends its last sample stands again.
    """
    place = np.clip(np.asarray(times)[:, None] - lag - np.arange(order), 0, len(series) - 1)
    return xp.moveaxis(series[place], 1, 2)


@dataclass(frozen=True, eq=False)
class Scales:
    """Mean and standard deviation of each column, and the size of its steps in parts of that."""

    mean: Array
    size: Array
    gain: Array

    @classmethod
    def of(cls, series: Sequence[Array]) -> Scales:
        whole = np.concatenate(series)
        size = _nonzero(np.std(whole, axis=0))
        steps = np.concatenate([np.diff(one, axis=0) for one in series]) / size
        return cls(np.mean(whole, axis=0), size, _nonzero(np.std(steps, axis=0)))

    def __call__(self, series: Array) -> Array:
        return (series - self.mean) / self.size


def _nonzero(sizes: Array) -> Array:
    return np.where(sizes > 0, sizes, 1.0)


def one_length(past: Any, inputs: Any, before: int) -> tuple[Array, Array]:
    """The last ``before`` samples of the past, and the inputs from there on."""
    past, inputs = np.asarray(past, dtype=float), np.asarray(inputs, dtype=float)
    if past.ndim != 3 or inputs.ndim != 3 or len(past) != len(inputs):
        raise InputError(
            f"past {past.shape} and inputs {inputs.shape}: give (n, b, outputs) and (n, b + h, "
            "inputs), of as many runs n"
        )
    surplus = past.shape[1] - before
    if surplus < 0 or inputs.shape[1] <= past.shape[1]:
        raise InputError(
            f"past of {past.shape[1]} samples, inputs of {inputs.shape[1]}: this model reads "
            f"{before} of the past, and its inputs go on behind them"
        )
    return past[:, surplus:], inputs[:, surplus:]


@dataclass(frozen=True, eq=False)
class Data:
    """Outputs and inputs of each record, and the sampling interval that all have."""

    series: Sequence[tuple[Array, Array]]
    sampling: float

    @property
    def scales(self) -> tuple[Scales, Scales]:
        """Of outputs and inputs."""
        y, u = zip(*self.series, strict=True)
        return Scales.of(y), Scales.of(u)


class Predictor(Protocol):
    """A fitted model without physics, which reads ``before`` samples of the past, one every
    ``sampling`` seconds.
    """

    @property
    def before(self) -> int: ...

    @property
    def sampling(self) -> float: ...

    def predict(self, past: Array, inputs: Array) -> Array:
        """Of the outputs of ``before`` samples up to the start (n, before, ny) and of the inputs of
        these and of the run (n, before + h, nu), the outputs of the run (n, h, ny).
        """
        ...


def _sampling(records: Sequence[Trajectory], *known: float) -> float:
    """The one interval of all records, and of those they are to be compared with [s]."""
    steps = np.concatenate([*(np.diff(r.t) for r in records), known])
    if np.ptp(steps) > 0.01 * steps.min():
        raise FitError(
            f"records are sampled every {steps.min():g} to {steps.max():g} s: a black box "
            "needs one sampling interval; resample them"
        )
    return float(np.mean(steps))


class BlackBox:
    """A structure without physics, of columns of records: all such are judged by the same free
    runs, over ``horizon`` from every ``every`` seconds on, ``first`` seconds of each record past.
    """

    outputs: Sequence[str]
    inputs: Sequence[str]
    horizon: Sequence[float]
    every: float
    first: float
    lag: int

    def require(self, *counts: str) -> None:
        """InputError for what cannot be; ``counts`` : fields that are counts."""
        for name in ("outputs", "inputs"):
            value = getattr(self, name)
            if isinstance(value, str) or not len(value):
                raise InputError(f"{name} = {value!r}: give names of columns, at least one")
        for name in counts:
            require_count(name, getattr(self, name))
        require_count("lag", self.lag, -LONGEST_LAG, LONGEST_LAG)
        if not len(self.horizon):
            raise InputError("horizon is empty: give durations [s], at least one")
        horizon = [require_positive("horizon", h, "s") for h in self.horizon]
        object.__setattr__(self, "horizon", horizon)
        object.__setattr__(self, "every", require_positive("every", self.every, "s"))
        object.__setattr__(self, "first", require_positive("first", self.first, "s", zero=True))

    def measured(self, record: Trajectory) -> tuple[Array, Array]:
        """Outputs (N, ny) and inputs (N, nu) of a record."""
        require_instance("record", record, Trajectory, "give Trajectories")
        for name in (*self.outputs, *self.inputs):
            if name not in record:
                raise InputError(f"a record has no column {name}")
        return record.array(self.outputs), record.array(self.inputs)

    def data(self, records: Sequence[Trajectory]) -> Data:
        """Of records with one sampling interval."""
        if not records:
            raise FitError("no records to fit")
        series = [self.measured(r) for r in records]
        return Data(series, _sampling(records))

    def losses(self, model: Any, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record over each horizon, output by output; NaN where no run
        fits in.
        """
        found = [[self._loss(model, r, h) for h in self.horizon] for r in records]
        return np.array(found).reshape(len(records), -1)

    def _loss(self, model: Predictor, record: Trajectory, horizon: float) -> Array:
        y, u = self.measured(record)
        sampling, before = _sampling([record], model.sampling), model.before
        ahead, stride = round(horizon / sampling), round(self.every / sampling)
        first = -(-round(self.first / sampling) // stride) * stride
        starts = np.arange(first, len(y) - ahead, stride)
        if not starts.size:
            return np.full(y.shape[1], np.nan)
        # beyond an end of the record its last sample there stands again
        place = np.clip(starts[:, None] + np.arange(1 - before, ahead + 1), 0, len(y) - 1)
        error = model.predict(y[place[:, :before]], u[place]) - y[place[:, before:]]
        return np.asarray(np.mean(error**2, axis=(0, 1)))


def history(y: Array, u: Array, times: Any, order: int, lag: int) -> Array:
    """Of the samples before each of ``times`` (times, n, order (ny + nu)), the newest first."""
    levels = [levels_of(np, s, times, g, order) for s, g in ((y, 1), (u, lag + 1))]
    return np.concatenate([x.reshape(*x.shape[:2], -1) for x in levels], axis=-1)


def _whole(count: int, past: int, inputs: int, lag: int) -> NDArray[np.intp]:
    """Samples of a record with ``past`` ones before them, and with as many ``inputs``, their own
    included, ``lag`` earlier: none is repeated beyond an end.
    """
    return np.arange(max(past, inputs - 1 + lag), count + min(0, lag))


# ---- linear models ------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class ArxModel:
    """y(k) from the past of outputs and inputs: coefficients (numbers, ny)."""

    coefficients: Array
    order: int
    lag: int
    sampling: float

    @property
    def before(self) -> int:
        """Samples of the past that it reads, the start included."""
        return max(self.order, self.order + self.lag - 1)

    def predict(self, past: Array, inputs: Array) -> Array:
        """As :meth:`NetworkModel.predict`."""
        past, inputs = one_length(past, inputs, self.before)
        before, last = past.shape[1], inputs.shape[1]
        runs = np.concatenate([past, np.zeros((len(past), last - before, past.shape[2]))], axis=1)
        y, u = runs.swapaxes(0, 1), inputs.swapaxes(0, 1)
        # what a lag below zero asks of the inputs behind the end of the run is not known there
        for k in range(before, last):
            rows = history(y, u, [k], self.order, self.lag - 1)[0]
            with np.errstate(over="ignore", invalid="ignore"):
                found = np.column_stack([rows, np.ones(len(runs))]) @ self.coefficients
                y[k] = np.clip(found, -1e100, 1e100)
        return runs[:, before:]


@dataclass(frozen=True, eq=False)
class ArxStructure(BlackBox):
    """Linear in the past of the outputs and inputs: the yardstick for any other structure (L.
    Ljung, System Identification, 1999, 4.2).

    order : samples of the past outputs, and of the inputs from ``lag`` samples ago on (0: that of
    the moment itself; below zero where inputs are recorded late). Fitted to the next sample, judged
    by runs over ``horizon`` from every ``every`` seconds on, ``first`` seconds of each record past.

    Examples
    --------
    >>> yardstick = pam.fitting.ArxStructure(["x"], ["muscle.command"], 2, [0.1], every=0.2)
    >>> yardstick.complexity  # two of the past of each, and a constant
    5.0
    """

    outputs: Sequence[str]
    inputs: Sequence[str]
    order: int
    horizon: Sequence[float]
    every: float
    first: float = 0.1
    lag: int = 0

    def __post_init__(self) -> None:
        self.require("order")

    @property
    def complexity(self) -> float:
        """Number of coefficients of each output."""
        return float(self.order * (len(self.outputs) + len(self.inputs)) + 1)

    def fit(self, records: Sequence[Trajectory], /) -> ArxModel:
        """Least squares over all samples with their past, of all records; FitError without any."""
        data, parts = self.data(records), []
        for y, u in data.series:
            times = _whole(len(y), self.order, self.order, self.lag)
            if len(times):
                past = history(y[:, None], u[:, None], times, self.order, self.lag - 1)[:, 0]
                parts.append((np.column_stack([past, np.ones(len(times))]), y[times]))
        if not parts:
            raise FitError(f"no record is longer than order = {self.order} samples and the lag")
        rows, now = (np.concatenate(part) for part in zip(*parts, strict=True))
        size = _nonzero(np.linalg.norm(rows, axis=0))  # whatever the units
        found = np.linalg.lstsq(rows / size, now, rcond=None)[0] / size[:, None]
        return ArxModel(found, self.order, self.lag, data.sampling)


@dataclass(frozen=True, eq=False)
class SubspaceModel:
    """x(k+1) = A x + B (u, 1), y = C x + D (u, 1), all in parts of the training records' scales.
    past : x = past [y(k-1), ..., y(k-p), u(k-1), ..., u(k-p)]. poles : eigenvalues of A.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    past: Array
    scales: tuple[Scales, Scales]
    before: int
    lag: int
    sampling: float

    @property
    def poles(self) -> Any:
        """Of the sampled system."""
        return np.linalg.eigvals(self.A)

    def predict(self, past: Array, inputs: Array) -> Array:
        """As :meth:`NetworkModel.predict`."""
        past, inputs = one_length(past, inputs, self.before)
        y, u = (s(x).swapaxes(0, 1) for s, x in zip(self.scales, (past, inputs), strict=True))
        start, order = len(y), self.past.shape[1] // (y.shape[2] + u.shape[2])
        x = history(y, u, [start], order, self.lag)[0] @ self.past.T
        found = []
        for drive in levels_of(np, u, np.arange(start, len(u)), self.lag, 1)[:, :, 0]:
            drive = np.column_stack([drive, np.ones(len(drive))])
            found.append(x @ self.C.T + drive @ self.D.T)
            x = np.clip(x @ self.A.T + drive @ self.B.T, -1e9, 1e9)
        scale = self.scales[0]
        return np.asarray(scale.mean + scale.size * np.array(found).swapaxes(0, 1))


def _older(coefficients: Array, i: int) -> Array:
    """Those from sample i of the past on (ny, p c), of (ny, p, c); then none."""
    left = np.pad(coefficients[:, i:], ((0, 0), (0, i), (0, 0)))
    return left.reshape(len(left), -1)


@dataclass(frozen=True, eq=False)
class SubspaceStructure(BlackBox):
    """A linear state-space model of ``order`` states by predictor-based subspace identification (A.
    Chiuso, Automatica 43 (2007) 1034-1048).

    An ARX model of ``past`` samples, by least squares over all records; the states are the
    ``order`` combinations of the past that say most of what it predicts; A, B, C, D then by least
    squares. ``lag``, ``horizon``, ``every``, ``first`` : as for :class:`ArxStructure`. No pair
    of samples is taken across the border of two records; ``control.era`` asks for impulse
    responses, and nfoursid takes one record alone.

    Examples
    --------
    >>> names = ["x"], ["muscle.command"]
    >>> pam.fitting.SubspaceStructure(*names, 3, [0.1], 0.1, past=10).fit(episodes).poles.shape
    (3,)
    """

    outputs: Sequence[str]
    inputs: Sequence[str]
    order: int
    horizon: Sequence[float]
    every: float
    first: float = 0.1
    lag: int = 0
    past: int = 15

    def __post_init__(self) -> None:
        self.require("order", "past")
        require_count("order", self.order, 1, self.past * len(self.outputs))

    @property
    def complexity(self) -> float:
        """What A, B, C, D, a Kalman gain and the constants leave free once the states' basis is
        chosen.
        """
        ny, nu = len(self.outputs), len(self.inputs) + 1
        return float(self.order * (2 * ny + nu) + ny * nu)

    def fit(self, records: Sequence[Trajectory], /) -> SubspaceModel:
        """FitError where no record is longer than the past."""
        data = self.data(records)
        scales, rows = data.scales, []
        for y, u in ((scales[0](y)[:, None], scales[1](u)[:, None]) for y, u in data.series):
            times = _whole(len(y), self.past, self.past + 1, self.lag)
            if len(times) > 1:
                drive = levels_of(np, u, times, self.lag, 1)[:, 0, 0]
                drive = np.column_stack([drive, np.ones(len(drive))])
                rows.append((history(y, u, times, self.past, self.lag)[:, 0], drive, y[times, 0]))
        if not rows:
            raise FitError(f"no record is longer than past = {self.past} samples")
        seen = self._states(rows)
        now = np.concatenate([np.hstack([z @ seen.T, u])[:-1] for z, u, _ in rows])
        then = np.concatenate([np.hstack([(z @ seen.T)[1:], y[:-1]]) for z, _, y in rows])
        found = np.linalg.lstsq(now, then, rcond=1e-10)[0].T
        n, before = self.order, max(self.past, self.past + self.lag)
        A, B, C, D = found[:n, :n], found[:n, n:], found[n:, :n], found[n:, n:]
        return SubspaceModel(A, B, C, D, seen, scales, before, self.lag, data.sampling)

    def _states(self, rows: Sequence[tuple[Array, Array, Array]]) -> Array:
        """What makes states of the past (order, past (ny + nu))."""
        ny, nu, p = len(self.outputs), len(self.inputs), self.past
        z, drive, y = (np.concatenate(part) for part in zip(*rows, strict=True))
        model = np.linalg.lstsq(np.hstack([z, drive]), y, rcond=1e-10)[0][: p * (ny + nu)].T
        own, other = model[:, : p * ny].reshape(ny, p, ny), model[:, p * ny :].reshape(ny, p, nu)
        # what the past alone says of the outputs i samples later: the older coefficients
        later = np.concatenate([np.hstack([_older(own, i), _older(other, i)]) for i in range(p)])
        centred = z - z.mean(axis=0)
        spread = np.asarray(np.linalg.qr(centred, mode="r")).T / np.sqrt(len(z))
        left, size, _ = np.linalg.svd(later @ spread, full_matrices=False)
        size = np.maximum(size[: self.order], 1e-12 * size[0])
        return np.asarray((left[:, : self.order] / np.sqrt(size)).T @ later)
