"""Families of signals for a record that is to be designed, and what must be kept while they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np

from ...core.errors import InputError, require_count, require_positive
from ...plants.plant import Plant, Values
from ..dynamic.experiment import ParameterGroup
from ..statistics import Array
from .information import Excitation

__all__ = ["RANDOM", "Family", "excitation", "random_signals", "span"]

Family: TypeAlias = Literal["steps", "ramps", "multisine"]
FAMILIES = ("steps", "ramps", "multisine")
RANDOM = 40
"""Random signals of the family: the best are where a search begins, all are what it is held
against.
"""


def span(e: Excitation) -> Array:
    """Rows of the basis that must stay within -1 .. 1: none where bounds of w see to it."""
    partition = bool(np.all(e.basis >= 0) and np.all(e.basis.sum(axis=1) <= 1 + 1e-12))
    return e.basis[:0] if partition else e.basis


def _basis(family: Family, count: int, segments: int) -> Array:
    """(count or count + 1, segments) shapes of the family over the samples, within -1 .. 1."""
    if family == "steps":
        place = np.arange(count) * segments // count
        return np.asarray((place[:, None] == np.arange(segments)).astype(float))
    share = np.arange(count + 1) / count
    if family == "ramps":
        nodes = np.linspace(0, 1, segments)
        return np.stack([np.interp(share, nodes, row) for row in np.eye(segments)], axis=1)
    columns = [np.ones(count + 1)]
    for i in range(1, segments):
        angle = 2 * np.pi * ((i + 1) // 2) * share
        columns.append(np.sin(angle) if i % 2 else np.cos(angle))
    return np.stack(columns, axis=1)


def random_signals(e: Excitation, seed: int) -> list[Array]:
    """Random signals of the family that fill the inputs' ranges to a random part."""
    random, rows = np.random.default_rng(seed), span(e)
    found = []
    for _ in range(RANDOM):
        w = random.uniform(-1, 1, (e.basis.shape[1], len(e.inputs)))
        if len(rows):
            w /= np.max(np.abs(rows @ w), axis=0)
        found.append((w * random.uniform(0.3, 1.0)).ravel(order="F"))
    return found


def excitation(
    plant: Plant,
    unknown: Sequence[ParameterGroup],
    sigma: Mapping[str, float],
    inputs: Any,
    duration: float,
    sample: float,
    family: Any,
    segments: int,
    limits: Mapping[str, tuple[float, float]] | None,
    start: Values | None,
    known_start: bool,
) -> Excitation:
    if family not in FAMILIES:
        raise InputError(f"family = {family!r}: choose one of {', '.join(FAMILIES)}")
    h = require_positive("sample", sample, "s")
    count = round(require_positive("duration", duration, "s") / h)
    require_count("segments", segments, 1, count)
    ranges = _ranges(plant, inputs)
    low, high = np.array(list(ranges.values())).T
    return Excitation(
        plant=plant,
        groups=unknown,
        noise=sigma,
        sample=h,
        basis=_basis(family, count, segments),
        held=family == "steps",
        inputs=tuple(ranges),
        mid=(low + high) / 2,
        half=(high - low) / 2,
        start=plant.vector("state", start),
        known_start=known_start,
        watched=_watched(plant, limits or {}),
    )


def _ranges(plant: Plant, inputs: Any) -> dict[str, tuple[float, float]]:
    usual = {v.name: (v.min, v.max) for v in plant.inputs if not v.disturbance}
    if inputs is None:
        inputs = usual
    if not isinstance(inputs, Mapping):
        inputs = {n: usual.get(plant.variable(n).name, (-np.inf, np.inf)) for n in inputs}
    found = {}
    for name, (low, high) in inputs.items():
        variable = plant.variable(name)
        if variable.causality != "input":
            raise InputError(f"inputs: {variable.name} is a {variable.causality}, not an input")
        low, high = max(float(low), variable.min), min(float(high), variable.max)
        if not low < high or not np.isfinite(high - low):
            raise InputError(
                f"inputs: {variable.name} may run over {low:g} .. {high:g}; give a finite range "
                f"within its bounds, inputs={{{variable.name!r}: (low, high)}}"
            )
        found[variable.name] = (low, high)
    if not found:
        raise InputError("inputs is empty: there is no signal to design")
    return found


def _watched(
    plant: Plant, limits: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Bounds of states and path constraints, narrowed by the user's limits."""
    own = {v.name: (v.min, v.max) for v in (*plant.states, *plant.constraints)}
    for name, ends in limits.items():
        variable = plant.variable(name)
        try:
            low, high = (float(v) for v in ends)
        except (TypeError, ValueError):
            raise InputError(f"limits[{name!r}] = {ends!r}: give (low, high)") from None
        low, high = max(low, variable.min), min(high, variable.max)
        if not low < high:
            raise InputError(f"limits: {variable.name} would have to stay in {low:g} .. {high:g}")
        own[variable.name] = (low, high)
    return {n: ends for n, ends in own.items() if np.isfinite(ends).any()}
