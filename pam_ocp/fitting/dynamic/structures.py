"""Structures that :func:`choose` chooses among: plants, by free runs or by whole records, and
linear models as a yardstick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, InputError, require_count, require_instance
from ...core.trajectory import Trajectory
from ...plants.plant import Plant, require_plant
from ..statistics import Array
from .dynamic import fit_plant
from .experiment import groups
from .free_run_fit import fit_free_run
from .free_run_result import FreeRunFit
from .plant_fit import PlantFit

__all__ = [
    "ArxModel",
    "ArxStructure",
    "FreeRunStructure",
    "JudgedRuns",
    "PlantStructure",
    "measured",
    "run_losses",
    "run_starts",
    "windows",
]


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


# ---- free runs of models without physics --------------------------------------------------------
class JudgedRuns(Protocol):
    """What says which free runs judge a model without physics: all such are judged by the same."""

    @property
    def outputs(self) -> Sequence[str]: ...
    @property
    def inputs(self) -> Sequence[str]: ...
    @property
    def horizon(self) -> Sequence[float]: ...
    @property
    def every(self) -> float: ...
    @property
    def first(self) -> float: ...


def measured(runs: JudgedRuns, record: Trajectory) -> tuple[Array, Array]:
    """Outputs (N, ny) and inputs (N, nu) of a record."""
    require_instance("record", record, Trajectory, "give Trajectories")
    for name in (*runs.outputs, *runs.inputs):
        if name not in record:
            raise InputError(f"a record has no column {name}")
    return record.array(runs.outputs), record.array(runs.inputs)


def run_starts(count: int, ahead: int, first: int, stride: int) -> NDArray[np.intp]:
    """The samples from which runs over ``ahead`` samples start, in a record of ``count``."""
    return np.arange(-(-first // stride) * stride, count - ahead, stride)


def windows(y: Array, u: Array, starts: Any, before: int, ahead: int) -> tuple[Array, Array]:
    """Outputs and inputs (n, before + ahead, ...) around starts, each the last of ``before``
    samples of the past. Beyond an end of the record its last sample there stands again.
    """
    place = np.asarray(starts)[:, None] + np.arange(1 - before, ahead + 1)
    place = np.clip(place, 0, len(y) - 1)
    return y[place], u[place]


def run_losses(
    runs: JudgedRuns,
    records: Sequence[Trajectory],
    before: int,
    predict: Callable[[Array, Array], Array],
) -> Array:
    """Mean squared error of each record over each horizon, output by output; NaN where no run fits
    in.

    predict : of the outputs of ``before`` samples up to the start (n, before, ny) and of the inputs
        of these and of the run (n, before + h, nu), the outputs of the run (n, h, ny).
    """
    found = [[_run_loss(runs, r, h, before, predict) for h in runs.horizon] for r in records]
    return np.array(found).reshape(len(records), -1)


def _run_loss(
    runs: JudgedRuns,
    record: Trajectory,
    horizon: float,
    before: int,
    predict: Callable[[Array, Array], Array],
) -> Array:
    y, u = measured(runs, record)
    sampling = record.duration / (len(record) - 1)
    ahead, stride = round(horizon / sampling), round(runs.every / sampling)
    starts = run_starts(len(y), ahead, round(runs.first / sampling), stride)
    if not starts.size:
        return np.full(y.shape[1], np.nan)
    outputs, inputs = windows(y, u, starts, before, ahead)
    error = predict(outputs[:, :before], inputs) - outputs[:, before:]
    return np.asarray(np.mean(error**2, axis=(0, 1)))


@dataclass(frozen=True, eq=False)
class ArxModel:
    """y(k) from the past of outputs and inputs: coefficients (numbers, ny)."""

    coefficients: Array


@dataclass(frozen=True, eq=False)
class ArxStructure:
    """Linear in the past of the outputs and inputs: the yardstick for any other structure (L.
    Ljung, System Identification, 1999, 4.2).

    order : samples of the past outputs, and of the inputs from ``lag`` samples ago on (0: that of
    the moment itself; below zero where inputs are recorded late). Fitted to the next sample, judged
    by runs over ``horizon`` from every ``every`` seconds on, ``first`` seconds of each record past.

    Examples
    --------
    >>> names = ["x"], ["muscle.command"]
    >>> yardstick = pam.fitting.ArxStructure(*names, order=2, horizon=[0.1], every=0.2)
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

    @property
    def complexity(self) -> float:
        """Number of coefficients of each output."""
        return float(self.order * (len(self.outputs) + len(self.inputs)) + 1)

    def fit(self, records: Sequence[Trajectory], /) -> ArxModel:
        """Least squares over all samples of all records."""
        require_count("order", self.order)
        normal, right = 0.0, 0.0
        for record in records:
            y, u = measured(self, record)
            k = np.arange(min(3, len(y) - 1), len(y))
            rows = np.column_stack([self._regressors(y, u, k), np.ones(len(k))])
            normal, right = normal + rows.T @ rows, right + rows.T @ y[k]
        if not np.ndim(normal):
            raise FitError("no records to fit")
        return ArxModel(np.asarray(np.linalg.lstsq(normal, right, rcond=1e-14)[0], dtype=float))

    def losses(self, model: ArxModel, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record over each horizon, output by output."""
        before = max(self.order, self.order + self.lag) + 1
        return run_losses(self, records, before, lambda y, u: self._run(model, y, u))

    def _run(self, model: ArxModel, past: Array, inputs: Array) -> Array:
        before, last = past.shape[1], inputs.shape[1] - 1
        ahead = last + 1 - before
        runs = np.concatenate([past, np.zeros((len(past), ahead, past.shape[2]))], axis=1)
        # what a lag below zero asks of the inputs behind the end of the run is not known there
        for k in range(before, before + ahead):
            parts = [runs[:, k - i] for i in range(1, self.order + 1)]
            parts += [inputs[:, min(k - i, last)] for i in range(self.lag, self.lag + self.order)]
            rows = np.concatenate([*parts, np.ones((len(runs), 1))], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):
                runs[:, k] = np.clip(rows @ model.coefficients, -1e6, 1e6)
        return runs[:, before:]

    def _regressors(self, y: Array, u: Array, k: Any) -> Array:
        last = len(u) - 1
        parts = [y[np.maximum(k - i, 0)] for i in range(1, self.order + 1)]
        parts += [u[np.clip(k - i, 0, last)] for i in range(self.lag, self.lag + self.order)]
        return np.concatenate(parts, axis=1)
