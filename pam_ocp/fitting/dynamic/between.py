"""How inputs ran between samples, where a record does not say it: both ways are fitted, the
likelier stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from ...core.errors import FitError
from ...core.signals import Interpolation
from ...core.stop import TimeIsUp
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..statistics import Array

__all__ = ["decided", "deviance"]

Result = TypeVar("Result")
WAYS: tuple[Interpolation, Interpolation] = ("previous", "linear")
WORDS = {"previous": "held", "linear": "joined by lines"}
TOLD = 6.0
"""Difference of -2 ln(likelihood) from which a record tells which of both it was."""


def deviance(residuals: Array, noise: Array | None = None) -> float:
    """-2 ln(likelihood) of normal residuals (n, ny), up to a constant; of unknown size without
    ``noise``.
    """
    if noise is not None:
        return float(np.sum((residuals / noise) ** 2))
    squares = np.maximum(np.mean(residuals**2, axis=0), 1e-300)
    return float(len(residuals) * np.sum(np.log(squares)))


def decided(
    plant: Plant,
    records: Sequence[Trajectory],
    fitted: Callable[[Sequence[Trajectory]], tuple[Result, float]],
) -> tuple[Result, Interpolation, str]:
    """A fit, how inputs count as having run where that was not known, and what decided it, in
    words.

    fitted : records to a fit and its deviance. Called once where all records say how inputs ran, or
    where none of them moves.
    """
    if all(r.interpolation_known or not _moves(plant, r) for r in records):
        return fitted(records)[0], "linear", ""
    found: dict[Interpolation, tuple[Result, float]] = {}
    failed: FitError | None = None
    for way in WAYS:
        try:
            found[way] = fitted([r if r.interpolation_known else r.running(way) for r in records])
        except FitError as error:
            failed = error
        except TimeIsUp:
            if not found:
                raise
            break
    if not found:
        assert failed is not None
        raise failed
    best = min(found, key=lambda way: found[way][1])
    if len(found) == 1:
        return found[best][0], best, f"inputs count as {WORDS[best]}: the other way gave no fit"
    other = next(way for way in WAYS if way != best)
    gap = found[other][1] - found[best][1]
    words = (
        f"inputs count as {WORDS[best]} between samples, which the records do not say: -2 "
        f"ln(likelihood) is {gap:.4g} less than {WORDS[other]}"
    )
    if not gap > TOLD:
        words += "; that hardly tells, so say it: read_record(..., inputs='held' or 'linear')"
    return found[best][0], best, words


def _moves(plant: Plant, record: Trajectory) -> bool:
    inputs = [record[v.name] for v in plant.inputs if v.name in record]
    return any(np.ptp(u) > 1e-9 * np.abs(u).max(initial=1.0) for u in inputs)
