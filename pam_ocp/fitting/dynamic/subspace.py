"""A linear state-space model by subspace identification, and what all models without physics share:
scales, windows of the past, checked records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import FitError, InputError, require_count, require_finite, require_positive
from ...core.trajectory import Trajectory
from ..statistics import Array
from .structures import JudgedRuns, measured, run_losses

__all__ = [
    "Data",
    "Scales",
    "SubspaceModel",
    "SubspaceStructure",
    "data_of",
    "levels_of",
    "one_length",
    "require_structure",
]

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


# ---- records and arguments ----------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Data:
    """Outputs and inputs of each record, and the sampling interval that all have."""

    series: Sequence[tuple[Array, Array]]
    sampling: float


def data_of(runs: JudgedRuns, records: Sequence[Trajectory]) -> Data:
    if not records:
        raise FitError("no records to fit")
    series = [measured(runs, r) for r in records]
    steps = np.array([r.duration / (len(r) - 1) for r in records])
    if np.ptp(steps) > 0.01 * steps.min():
        raise FitError(
            f"records are sampled every {steps.min():g} to {steps.max():g} s: a black box needs "
            "one sampling interval; resample them"
        )
    return Data(series, float(np.mean(steps)))


def require_structure(structure: Any, counts: Sequence[str]) -> None:
    """What cannot be."""
    for name in ("outputs", "inputs"):
        value = getattr(structure, name)
        if isinstance(value, str) or not len(value):
            raise InputError(f"{name} = {value!r}: give names of columns, at least one")
    for name in counts:
        require_count(name, getattr(structure, name))
    require_count("lag", structure.lag, -LONGEST_LAG, LONGEST_LAG)
    if not len(structure.horizon):
        raise InputError("horizon is empty: give durations [s], at least one")
    require_positive("every", structure.every)
    for h in structure.horizon:
        require_positive("horizon", h)
    if require_finite("first", structure.first) < 0:
        raise InputError(f"first = {structure.first:g} s must not be negative")


# ---- the model ----------------------------------------------------------------------------------
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

    @property
    def poles(self) -> Any:
        """Of the sampled system."""
        return np.linalg.eigvals(self.A)

    def predict(self, past: Array, inputs: Array) -> Array:
        """As :meth:`NetworkModel.predict`."""
        past, inputs = one_length(past, inputs, self.before)
        y, u = (s(x).swapaxes(0, 1) for s, x in zip(self.scales, (past, inputs), strict=True))
        start, order = len(y), self.past.shape[1] // (y.shape[2] + u.shape[2])
        x = _history(y, u, [start], order, self.lag)[0] @ self.past.T
        found = []
        for drive in levels_of(np, u, np.arange(start, len(u)), self.lag, 1)[:, :, 0]:
            drive = np.column_stack([drive, np.ones(len(drive))])
            found.append(x @ self.C.T + drive @ self.D.T)
            x = np.clip(x @ self.A.T + drive @ self.B.T, -1e9, 1e9)
        scale = self.scales[0]
        return np.asarray(scale.mean + scale.size * np.array(found).swapaxes(0, 1))


def _history(y: Array, u: Array, times: Any, order: int, lag: int) -> Array:
    """Of the samples before each of ``times`` (times, n, order (ny + nu)), the newest first."""
    levels = [levels_of(np, s, times, g, order) for s, g in ((y, 1), (u, lag + 1))]
    return np.concatenate([x.reshape(*x.shape[:2], -1) for x in levels], axis=-1)


def _older(coefficients: Array, i: int) -> Array:
    """Those from sample i of the past on (ny, p c), of (ny, p, c); then none."""
    left = np.pad(coefficients[:, i:], ((0, 0), (0, i), (0, 0)))
    return left.reshape(len(left), -1)


@dataclass(frozen=True, eq=False)
class SubspaceStructure:
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
    >>> ways = {"horizon": [0.1], "every": 0.1}
    >>> subspace = pam.fitting.SubspaceStructure(*names, order=3, past=10, **ways)
    >>> runs = [pam.simulate(plant, {"muscle.command": u}, duration=1.0) for u in (2e5, 3e5)]
    >>> subspace.fit(runs).poles.shape
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
        require_structure(self, ("order", "past"))
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
        data = data_of(self, records)
        scales = Scales.of([y for y, _ in data.series]), Scales.of([u for _, u in data.series])
        rows = []
        for y, u in ((scales[0](y)[:, None], scales[1](u)[:, None]) for y, u in data.series):
            times = np.arange(self.past + max(0, self.lag), len(y))
            if len(times) > 1:
                drive = levels_of(np, u, times, self.lag, 1)[:, 0, 0]
                drive = np.column_stack([drive, np.ones(len(drive))])
                rows.append((_history(y, u, times, self.past, self.lag)[:, 0], drive, y[times, 0]))
        if not rows:
            raise FitError(f"no record is longer than past = {self.past} samples")
        seen = self._states(rows)
        now = np.concatenate([np.hstack([z @ seen.T, u])[:-1] for z, u, _ in rows])
        then = np.concatenate([np.hstack([(z @ seen.T)[1:], y[:-1]]) for z, _, y in rows])
        found = np.linalg.lstsq(now, then, rcond=1e-10)[0].T
        n, before = self.order, max(self.past, self.past + self.lag)
        A, B, C, D = found[:n, :n], found[:n, n:], found[n:, :n], found[n:, n:]
        return SubspaceModel(A, B, C, D, seen, scales, before, self.lag)

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

    def losses(self, model: SubspaceModel, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record over each horizon, output by output."""
        return run_losses(self, records, model.before, model.predict)
