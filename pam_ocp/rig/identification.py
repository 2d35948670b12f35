"""Identification on a rig: design an excitation, play it, fit, judge; and again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import InputError, require_count, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..fitting.dynamic.dynamic import fit_plant
from ..fitting.dynamic.plant_fit import PlantFit
from ..fitting.experiments.signals import SignalDesign, design_signal
from ..plants.plant import Plant
from .side import play

if TYPE_CHECKING:
    from .rig import Rig

INSIDE = 0.9
"""Part of the guard's limits, from their middle, that an excitation may go to by the model."""


@shown
@dataclass(frozen=True)
class Identified:
    """What was found: ``fit`` of all records, ``plant`` with its values, and why it ended.

    Examples
    --------
    >>> pam.rig.Identified.__name__
    'Identified'
    """

    fit: PlantFit
    designs: tuple[SignalDesign, ...] = field(repr=False)
    records: tuple[Trajectory, ...] = field(repr=False)
    reached: bool
    """Whether all intervals are as narrow as was asked for."""
    ended: str

    @property
    def plant(self) -> Plant:
        """The model with the fitted values."""
        return self.fit.plant

    @property
    def adequate(self) -> bool:
        """Whether the residuals show no sign of anything missing in the model."""
        return self.fit.adequacy.adequate

    def report(self) -> str:
        """Rounds, why it ended, and the fit's own report."""
        return f"{len(self.records)} excitations; {self.ended}\n{self.fit.report()}"

    def __str__(self) -> str:
        return self.report()


@verb
def identify(
    rig: Rig,
    free: Sequence[str | Sequence[str]],
    *,
    duration: float = 4.0,
    width: float = 0.05,
    rounds: int = 3,
    within: float | None = None,
    at: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    inputs: Mapping[str, tuple[float, float]] | None = None,
    sample: float | None = None,
    segments: int = 8,
    outputs: Sequence[str] | None = None,
    offsets: Sequence[str] = (),
    seed: int = 0,
) -> Identified:
    """Fit parameters of the rig's model to excitations that are designed for it, one by one.

    Each excitation is the best by the fit so far (:func:`design_signal`), within the ranges of the
    commands and inside of the guard's limits; all records are fitted together, and the fit's
    adequacy is judged. It ends when all 95 % intervals are narrower than ``width`` on each side,
    relative to their values, after ``rounds``, or where another excitation would not end ``within``
    [s] on the rig's clock (the first one is always played).

    free : parameters, as for :func:`fit_plant`. duration : of an excitation [s]. at : commands to
    start from; by default the middle of their ranges. noise : {reading: standard deviation}; by
    default measured at rest. inputs : {command: (low, high)}, by default the middle 80 % of their
    ranges. sample : of the fit [s]; by default a multiple of the rig's near 20 ms. segments :
    levels of each command. outputs, offsets : as for :func:`fit_plant`.

    Raises RigError where the guard vents, InputError, FitError.
    """
    if rig.plant is None:
        raise InputError("identify: the rig has no model; give Rig(..., plant=...)")
    require_count("rounds", rounds)
    width, duration = require_positive("width", width), require_positive("duration", duration, "s")
    every = max(1, round((sample or 0.02) / rig.sample_time))
    step = every * rig.sample_time
    known_names = {v.name for v in (*rig.plant.states, *rig.plant.outputs)}
    measured = [n for n, r in rig.readings.items() if not r.slope_of and n in known_names]
    measured = [n for n in measured if n in (outputs or measured)]
    rig.require_armed()
    most = None if within is None else require_positive("within", within, "s")
    begun = rig.clock.now()
    ranges = inputs or {n: _inner(c.low, c.high, 0.8) for n, c in rig.commands.items()}
    begin = {n: (low + high) / 2 for n, (low, high) in ranges.items()} | dict(at or {})
    if noise is None:
        seen = rig.check(1.0)
        noise = {n: max(seen[n]["deviation"], 1e-4 * _size(rig, n)) for n in measured}
    limits = {
        n: _inner(r.low, r.high, INSIDE)
        for n, r in rig.readings.items()
        if n in measured and np.isfinite(r.low) and np.isfinite(r.high)
    }
    known: Plant | PlantFit = rig.plant
    designs: list[SignalDesign] = []
    records: list[Trajectory] = []
    ended = f"{rounds} rounds are over"
    reached = False
    for k in range(rounds):
        if most is not None and k and rig.clock.now() - begun + duration > most:
            ended = f"{most:g} s are over"
            break
        model = known if isinstance(known, Plant) else known.plant
        rest = model.equilibrium(begin)
        design = design_signal(
            known,
            list(free),
            duration=duration,
            noise={n: noise[n] for n in measured},
            inputs=ranges,
            sample=step,
            segments=segments,
            limits=limits,
            start={v.name: rest[v.name] for v in model.states},
            tries=1,
            seed=seed + k,
        )
        designs.append(design)
        records.append(_thinned(play(rig, design.trajectory, begin), every))
        known = fit_plant(
            model, records, list(free), outputs=measured, offsets=offsets, widest=False
        )
        if _narrow(known, width):
            reached, ended = True, f"all intervals are within {100 * width:g} % of their values"
            break
    assert isinstance(known, PlantFit)
    return Identified(known, tuple(designs), tuple(records), reached, ended)


def _inner(low: float, high: float, part: float) -> tuple[float, float]:
    middle, half = (low + high) / 2, part * (high - low) / 2
    return middle - half, middle + half


def _size(rig: Rig, name: str) -> float:
    return float(rig.readings[name].variable(rig.plant).nominal)


def _thinned(record: Trajectory, every: int) -> Trajectory:
    """Every so many samples, at which inputs may have changed; between them they were held."""
    rows = slice(None, None, every)
    columns: dict[str, Any] = {n: record[n][rows] for n in record.names}
    return Trajectory(record.t[rows], columns, record.variables, "previous")


def _narrow(fit: PlantFit, width: float) -> bool:
    for name, (low, high) in fit.intervals().items():
        value = fit.values[name]
        if not (np.isfinite(high - low) and (high - low) / 2 <= width * abs(value)):
            return False
    return True
