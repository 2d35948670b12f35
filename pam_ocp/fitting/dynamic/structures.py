"""Structures that :func:`choose` chooses among: plants, by free runs or by whole records, and
linear models as a yardstick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.errors import FitError, InputError, require_count, require_instance
from ...core.trajectory import Trajectory
from ...plants.plant import Plant, require_plant
from ..statistics import Array
from .dynamic import fit_plant
from .experiment import groups
from .free_run_fit import fit_free_run
from .free_run_result import FreeRunFit
from .plant_fit import PlantFit

__all__ = ["ArxModel", "ArxStructure", "FreeRunStructure", "PlantStructure"]


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
            y, u = self._arrays(record)
            k = np.arange(min(3, len(y) - 1), len(y))
            rows = np.column_stack([self._regressors(y, u, k), np.ones(len(k))])
            normal, right = normal + rows.T @ rows, right + rows.T @ y[k]
        if not np.ndim(normal):
            raise FitError("no records to fit")
        return ArxModel(np.asarray(np.linalg.lstsq(normal, right, rcond=1e-14)[0], dtype=float))

    def losses(self, model: ArxModel, records: Sequence[Trajectory], /) -> Array:
        """Mean squared error of each record over each horizon, output by output."""
        found = [[self._loss(model, r, h) for h in self.horizon] for r in records]
        return np.array(found).reshape(len(records), -1)

    def _loss(self, model: ArxModel, record: Trajectory, horizon: float) -> Array:
        y, u = self._arrays(record)
        sampling = record.duration / (len(record) - 1)
        h, stride = round(horizon / sampling), round(self.every / sampling)
        first = -(-round(self.first / sampling) // stride) * stride
        starts = np.arange(first, len(y) - h, stride)
        if not starts.size:
            return np.full(y.shape[1], np.nan)
        past = max(self.order, self.order + self.lag) + 1
        place = starts[:, None] + np.arange(-past + 1, h + 1)
        runs = y[np.maximum(place, 0)].copy()
        drive = u[np.clip(place, 0, len(u) - 1)]
        # what a lag below zero asks of the inputs behind the end of the run is not known there
        for s in range(h):
            parts = [runs[:, past + s - i] for i in range(1, self.order + 1)]
            parts += [
                drive[:, np.minimum(past + s - i, past + h - 1)]
                for i in range(self.lag, self.lag + self.order)
            ]
            rows = np.concatenate([*parts, np.ones((len(starts), 1))], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):
                runs[:, past + s] = np.clip(rows @ model.coefficients, -1e6, 1e6)
        error = runs[:, past:] - y[place[:, past:]]
        return np.asarray(np.mean(error**2, axis=(0, 1)))

    def _regressors(self, y: Array, u: Array, k: Any) -> Array:
        last = len(u) - 1
        parts = [y[np.maximum(k - i, 0)] for i in range(1, self.order + 1)]
        parts += [u[np.clip(k - i, 0, last)] for i in range(self.lag, self.lag + self.order)]
        return np.concatenate(parts, axis=1)

    def _arrays(self, record: Trajectory) -> tuple[Array, Array]:
        require_instance("record", record, Trajectory, "give Trajectories")
        for name in (*self.outputs, *self.inputs):
            if name not in record:
                raise InputError(f"a record has no column {name}")
        return record.array(self.outputs), record.array(self.inputs)
