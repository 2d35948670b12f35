"""Fits, rankings and designs for the tab Muscle; the last fits of a process are kept."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import PamError
from ...fitting.experiments.cells import design_cells
from ...fitting.static.force_fit import ForceFit
from ...fitting.static.static import compare_laws, fit_force
from ...muscles.muscle_file import load_muscle, save_muscle
from ..made import World, kept, muscle_of, table_of
from ..session import stored_file
from ..work import Say, job

CURVE = 61
"""Points of a drawn curve."""
MOST_LEVELS = 6
"""Pressures at which curves are drawn: as many as there are colours."""
LEVEL = 0.95
"""Of intervals and bands."""


@job("Ranking laws", warm="muscle")
def rank_laws(
    say: Say, world: World, item: Mapping[str, Any], fixed: Mapping[str, float]
) -> list[dict[str, Any]]:
    """The laws on one table, the best at a level left out first."""
    say(None, "each level left out in turn")
    found = compare_laws(table_of(world, item), fixed=dict(fixed))
    return [
        {
            **{n: getattr(law, n) for n in ("name", "parameters", "rmse", "problem")},
            "left_out": law.left_out_rmse,
            "fitted": law.fit is not None,
        }
        for law in found.laws
    ]


@job("Fitting {}", warm="muscle")
def fit_law(say: Say, world: World, said: Mapping[str, Any]) -> dict[str, Any]:
    """A fit as plain values: coefficients with intervals, curves with bands, residuals, words."""
    fit = fit_of(world, said)
    table, cells = fit.table, fit.cells
    say(0.5, "intervals")
    try:
        intervals = fit.intervals(LEVEL)
    except PamError:
        intervals = fit.intervals(LEVEL, linearised=True)
    levels = levels_of(cells.pressure)
    low, high = float(table.contraction.min()), float(table.contraction.max())
    kappa = np.linspace(min(low, 0.0), high + 0.04 * max(high - low, 1e-3), CURVE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bands = [fit.predict(np.full_like(kappa, p), kappa, LEVEL) for p in levels]
        report = fit.report()
    return {
        "coefficients": [
            {
                **{n: getattr(c, n) for n in ("name", "value", "stderr", "unit", "held")},
                "low": float(intervals.get(c.name, (c.value, c.value))[0]),
                "high": float(intervals.get(c.name, (c.value, c.value))[1]),
            }
            for c in fit.coefficients.values()
        ],
        "rmse": fit.rmse,
        "r2": fit.r2,
        "n": fit.n,
        "warnings": list(fit.warnings),
        "report": report,
        "levels": levels,
        "kappa": kappa,
        "bands": [tuple(np.asarray(e, float) for e in b.confidence) for b in bands],
        "cells": {
            "pressure": table.pressure,
            "contraction": table.contraction,
            "force": table.force,
            "slack": table.slack,
        },
        "rest_length": table.rest_length,
        "pressure_range": [float(max(table.pressure.min(), 0.0)), float(table.pressure.max())],
        "contraction_range": [low, high],
        "source": f"{type(fit.law).title} fitted to {said['table']['name']}",
        "workbook": hasattr(fit, "to_excel"),
    }


@job("What to measure next", warm="muscle")
def design(
    say: Say, world: World, said: Mapping[str, Any], count: int, criterion: str
) -> dict[str, Any]:
    """Cells to measure next, and the standard errors that they promise."""
    found = design_cells(fit_of(world, said), count, criterion=criterion)  # type: ignore[arg-type]
    length = found.cells.rest_length
    return {
        "pressure": found.cells.pressure,
        "contraction": found.cells.contraction,
        "force": found.cells.force,
        "length": None if length is None else length * (1 - found.cells.contraction),
        "before": dict(found.stderr_before),
        "after": dict(found.stderr_after),
    }


@job("Reading the muscle file", time_limit=30.0)
def read_muscle(say: Say, world: World, file: str) -> str:
    """The name of the muscle in a file; raises what reading it does."""
    return load_muscle(stored_file(world.folder, file)).name


@job("Saving", time_limit=30.0)
def muscle_file(say: Say, world: World) -> bytes:
    """The session's muscle as a muscle file (TOML)."""
    with tempfile.TemporaryDirectory() as temporary:
        return save_muscle(muscle_of(world), Path(temporary) / "muscle.toml").read_bytes()


@job("Writing the workbook", warm="muscle")
def workbook(say: Say, world: World, said: Mapping[str, Any]) -> bytes:
    """The fit as a workbook (XLSX)."""
    fit: Any = fit_of(world, said)
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "fit.xlsx"
        fit.to_excel(path)
        return path.read_bytes()


def levels_of(pressure: Any) -> list[float]:
    """Pressures at which curves are drawn: measured ones, spread over the range."""
    known = sorted({float(f"{p:.2g}") if p else 0.0 for p in np.asarray(pressure, float)})
    if len(known) > MOST_LEVELS and known[0] == 0.0:  # a muscle without pressure hardly pulls
        known = known[1:]
    if len(known) <= MOST_LEVELS:
        return known
    wanted = np.linspace(known[0], known[-1], MOST_LEVELS)
    return sorted({min(known, key=lambda p: abs(p - w)) for w in wanted})


def fit_of(world: World, said: Mapping[str, Any]) -> ForceFit:
    """The fit of a law to a table of the session, as ``said`` by the state's muscle."""
    read = ("bundled", "file", "name", "said", "off")
    item = {k: v for k, v in said["table"].items() if k in read}
    return _kept_fit(world, item, said["law"], dict(said["fixed"]))


@kept(most=6)
def _kept_fit(
    world: World, item: Mapping[str, Any], law: str, fixed: Mapping[str, float]
) -> ForceFit:
    return fit_force(table_of(world, item), law, fixed=fixed)
