"""Where free runs of a plant begin in records, and what they are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_count, require_instance, require_positive
from ...core.shown import shown
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array
from .experiment import measured_names

__all__ = ["FreeRun", "Runs", "runs_of"]

FAR = 100.0
"""Ranges of a measured variable by which a run must be off to count as diverged."""


@shown
@dataclass(frozen=True, eq=False)
class FreeRun:
    """Runs of a plant from many starts, beside what was measured.

    record, start : of each run (n,) the number of its record and the time where it begins [s].
    t : times since the start (K,) [s]. measured, predicted : (n, K, ny), in SI, of ``names``.
    """

    names: tuple[str, ...]
    record: Array
    start: Array
    t: Array = field(repr=False)
    measured: Array = field(repr=False)
    predicted: Array = field(repr=False)
    sizes: Array = field(repr=False)
    """Range of each measured variable over the runs, at least its nominal."""

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared error over all samples of all runs [unit of the variable].

        Infinite where a run went beyond all numbers.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.mean((self.predicted - self.measured) ** 2, axis=(0, 1))
        squares = np.where(np.isfinite(squares), squares, np.inf)
        return dict(zip(self.names, np.sqrt(squares).tolist(), strict=True))

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Which runs (n,) went beyond all numbers, or astray by 100 ranges of what was measured."""
        with np.errstate(over="ignore", invalid="ignore"):
            far = np.abs(self.predicted - self.measured).max(axis=1) / self.sizes
        return np.asarray(~(far <= FAR).all(axis=1))

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
        lines += [f"    {n}: RMSE {e:.4g}" for n, e in self.rmse.items()]
        return "\n".join([*lines, *(f"    warning: {w}" for w in self.warnings)])


@dataclass(frozen=True, eq=False)
class Runs:
    """What runs start from and are compared with.

    x0 (n, nx); inputs at the edges of all steps (n, K steps + 1, nu), of each step at its begin and
    its end; step [s].
    """

    names: tuple[str, ...]
    record: Array
    start: Array
    t: Array
    measured: Array
    x0: Array
    begin: Array
    end: Array
    step: float
    steps: int
    sizes: Array

    def result(self, predicted: Array) -> FreeRun:
        return FreeRun(
            self.names, self.record, self.start, self.t, self.measured, predicted, self.sizes
        )


def runs_of(
    plant: Plant,
    records: Trajectory | Sequence[Trajectory],
    horizon: float,
    every: float,
    outputs: Sequence[str] | None,
    history: int,
    steps: int,
) -> Runs:
    kinds = (Trajectory, list, tuple)
    require_instance(
        "records", records, kinds, "give a Trajectory (of read_record), or a list of them"
    )
    chosen = [records] if isinstance(records, Trajectory) else list(records)
    names = measured_names(plant, chosen, outputs)
    require_count("history", history, 2)
    require_count("steps", steps)
    sampling = _sampling(chosen)
    length = _multiple("horizon", horizon, sampling)
    stride = _multiple("every", every, sampling)
    inputs = [v.name for v in plant.inputs]
    parts: list[tuple[Any, ...]] = []
    for r, record in enumerate(chosen):
        missing = [n for n in inputs if n not in record]
        if missing:
            raise InputError(f"record {r + 1} has no column for the input {missing[0]}")
        if not np.all(np.isfinite(record.array(inputs))):
            raise InputError(f"record {r + 1}: an input is not finite; cut the record there")
        first = -(-(history - 1) // stride) * stride
        for i in range(first, len(record) - length, stride):
            u = record.array(inputs)[i : i + length + 1]
            parts.append(
                (
                    r,
                    record.t[i],
                    record.array(names)[i + 1 : i + length + 1],
                    _start(plant, record, i, history),
                    *_edges(u, steps, record.interpolation),
                )
            )
    if not parts:
        raise InputError(
            f"no record holds {history} samples and a horizon of {horizon:g} s after them; the "
            f"longest lasts {max(r.duration for r in chosen):g} s"
        )
    number, start, measured, x0, begin, end = (np.array(c, float) for c in zip(*parts, strict=True))
    t = np.asarray(sampling * np.arange(1, length + 1))
    nominal = np.array([plant.variable(n).nominal for n in names])
    sizes = np.maximum(np.ptp(measured.reshape(-1, len(names)), axis=0), nominal)
    return Runs(
        tuple(names), number, start, t, measured, x0, begin, end, sampling / steps, steps, sizes
    )


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


def _edges(u: Array, steps: int, interpolation: str) -> tuple[Array, Array]:
    """The inputs at the begin and at the end of each step, from samples (K + 1, nu)."""
    part = np.arange(steps)[:, None] / steps
    width = 0.0 if interpolation == "previous" else 1.0
    slope = width * np.diff(u, axis=0)[:, None, :]
    begin = u[:-1, None, :] + part * slope
    end = u[:-1, None, :] + (part + 1 / steps) * slope
    shape = ((len(u) - 1) * steps, u.shape[1])
    return begin.reshape(shape), end.reshape(shape)
