"""The influence of loads: how a muscle rests, swings and settles against load and pressure."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.cases import results_of
from ..core.errors import InputError, require_positive
from ..core.executors import Place
from ..core.files import atomic_path
from ..core.quantities import doubt
from ..core.shown import shown
from ..core.stop import verb
from ..muscles.gas import AMBIENT_PRESSURE, air_mass, muscle_volume
from ..muscles.pneumatic_muscle import Muscle
from ..operating.held import Memory
from ..operating.linear import linearize, modes
from ..operating.resting_point import EquilibriumError, OperatingPoint
from ..plants.components import as_muscle
from ..plants.damping import Damping, Loss
from ..plants.feeds import Feed
from ..plants.hanging import HangingLoad
from ..plants.plant import Plant
from ..simulation.simulator import simulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array: TypeAlias = NDArray[np.float64]

SETTLED = 0.02
"""The load has settled when it stays within this part of its step."""


@dataclass(frozen=True)
class LoadCase:
    """One load at one pressure; NaN where the muscle cannot carry it within its stroke."""

    mass: float
    """[kg]"""
    pressure: float
    """[Pa gauge]"""
    position: float = np.nan
    """Contraction at rest [m]."""
    stiffness: float = np.nan
    """At rest, constant pressure [N/m]."""
    frequency: float = np.nan
    """Natural frequency about rest [Hz]."""
    damping_ratio: float = np.nan
    overshoot: float = np.nan
    """Of the step of pressure that leads there, as a part of the step of position."""
    settling_time: float = np.nan
    """From the step until the load stays within 2 % of it [s]."""
    work: float = np.nan
    """Lifting work m g dx of the step [J]."""
    air: float = np.nan
    """Air drawn for the step, isothermal, energy-consistent volume of the muscle [kg]."""


@shown
@dataclass(frozen=True)
class LoadStudy:
    """All cases, load by load.

    Examples
    --------
    >>> study = pam.load_study(muscle, masses=10.0, pressures=3e5, duration=1.0)
    >>> study.cases[0].mass, round(study.cases[0].frequency, 2)
    (10.0, 4.7)
    """

    muscle: str
    step: float
    """Each case is reached by a step of pressure this high [Pa]."""
    cases: tuple[LoadCase, ...] = field(repr=False)

    def __str__(self) -> str:
        head = (
            f"{self.muscle}: step of {self.step / 1e5:g} bar to each pressure\n"
            f"{'kg':>8}{'bar':>7}{'x [mm]':>9}{'k [N/mm]':>10}{'f [Hz]':>8}{'zeta':>7}"
            f"{'over [%]':>10}{'settle [s]':>11}{'work [J]':>10}{'air [mg]':>10}"
        )
        return "\n".join([head, *(self._line(c) for c in self.cases)])

    @staticmethod
    def _line(c: LoadCase) -> str:
        if np.isnan(c.position):
            return f"{c.mass:8.4g}{c.pressure / 1e5:7.3g}   not carried within the stroke"
        return (
            f"{c.mass:8.4g}{c.pressure / 1e5:7.3g}{c.position * 1e3:9.1f}{c.stiffness / 1e3:10.2f}"
            f"{c.frequency:8.2f}{c.damping_ratio:7.3f}{c.overshoot * 100:10.1f}"
            f"{c.settling_time:11.3f}{c.work:10.3f}{c.air * 1e6:10.1f}"
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the table as CSV (SI units)."""
        with (
            atomic_path(path) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            names = [f.name for f in fields(LoadCase)]
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows([[repr(float(getattr(c, n))) for n in names] for c in self.cases])
        return Path(path)

    def plot(self) -> Figure:
        """Six panels against pressure, one line per load."""
        from ..figures.trajectory import plot_load_study

        lines = {
            f"{mass:g} kg": {
                f.name: [getattr(c, f.name) for c in self.cases if c.mass == mass]
                for f in fields(LoadCase)
            }
            for mass in sorted({c.mass for c in self.cases})
        }
        return plot_load_study(f"{self.muscle}, hanging loads", lines)


@verb
def load_study(
    muscle: Muscle | str,
    masses: float | Sequence[float] = (5.0, 10.0, 20.0, 50.0, 100.0),
    pressures: float | Sequence[float] = (1e5, 2e5, 3e5, 4e5, 5e5, 6e5),
    *,
    step: float = 0.2e5,
    damping: Damping | float | None = None,
    feed: Feed | None = None,
    losses: Sequence[Loss] = (),
    memory: Memory = "virgin",
    duration: float = 4.0,
    executor: Place = None,
    time_limit: float | None = None,
) -> LoadStudy:
    """A hanging load at rest, swinging and settling, for every mass [kg] and pressure [Pa].

    pressures : in the muscle at rest, whatever feeds it.
    step : the load comes to each rest by a step of pressure this high [Pa], from rest: of the
        commanded pressure where the feed has one. With valves there is no such step: overshoot and
        settling time are NaN, and frequency and damping are those with the valves closed.
    damping, feed, losses : of the HangingLoad; duration : simulated after each step [s].
    memory : what hysteresis keeps at rest, see :func:`pam_ocp.equilibrium`. A step then ends where
        friction holds the load: overshoot and settling are about that place.
    executor : where the cases are worked on, as for :func:`pam_ocp.each`.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError for masses, pressures or a step that are not positive.

    Examples
    --------
    >>> study = pam.load_study(muscle, masses=[5.0, 10.0], pressures=3e5, duration=1.0)
    >>> study.cases[1].frequency < study.cases[0].frequency
    True
    """
    muscle = as_muscle(muscle)
    weights = _several("masses", masses, "kg")
    levels = _several("pressures", pressures, "Pa")
    (step,) = _several("step", step, "Pa")
    duration = require_positive("duration", duration, "s")
    plant = HangingLoad(muscle, damping=damping, feed=feed, losses=losses)
    wanted = [(m, p) for m in weights for p in levels]
    work = partial(_case, plant, muscle, step, duration, memory)
    cases = results_of(work, wanted, executor=executor, chunk=1, what="loads")
    return LoadStudy(muscle.name, step, tuple(cases))


def _several(argument: str, values: Any, unit: str) -> list[float]:
    """One number or several, each > 0 and of a usual size."""
    single = isinstance(values, str) or np.ndim(values) == 0
    numbers = [require_positive(argument, v, unit) for v in ([values] if single else values)]
    if not numbers:
        raise InputError(f"{argument} must hold at least one value")
    for number in numbers:
        if doubt(argument, number, unit):
            break
    return numbers


def _rest(plant: Plant, mass: float, pressure: float, memory: Memory) -> OperatingPoint:
    """At rest with this pressure in the muscle; of several inputs all but the first keep their
    start.
    """
    held = {v.name: v.start or 0.0 for v in plant.inputs[1:]}
    conditions = {"mass": mass, "muscle.pressure": pressure, **held}
    return plant.equilibrium(conditions, memory=memory)


def _case(
    plant: Plant,
    muscle: Muscle,
    step: float,
    duration: float,
    memory: Memory,
    wanted: tuple[float, float],
) -> LoadCase:
    mass, pressure = wanted
    try:
        rest = _rest(plant, mass, pressure, memory)
    except EquilibriumError:
        return LoadCase(mass, pressure)
    swinging = modes(linearize(plant, rest, stuck=True))
    found: dict[str, Any] = {
        "position": rest["x"],
        "stiffness": rest["stiffness"],
        "frequency": swinging[0][0] if swinging else np.nan,
        "damping_ratio": swinging[0][1] if swinging else np.nan,
    }
    try:
        before = _rest(plant, mass, pressure - step, memory)
    except (EquilibriumError, InputError):  # nothing to step from
        return LoadCase(mass, pressure, **found)
    found |= _cost(muscle, before, rest)
    if plant.inputs[0].unit == "Pa":
        found |= _step(before, rest, duration)
    return LoadCase(mass, pressure, **found)


def _step(before: OperatingPoint, rest: OperatingPoint, duration: float) -> dict[str, float]:
    """How the load comes to rest when the inputs jump to those of ``rest``."""
    start = {v.name: before[v.name] for v in before.plant.states}
    t = np.linspace(0.0, duration, 2001)
    inputs = {v.name: rest[v.name] for v in rest.plant.inputs}
    motion = simulate(rest.plant, inputs, t=t, start=start, rtol=1e-8)
    goal = float(motion["x"][-1]) if rest.memory else rest["x"]
    progress = (motion["x"] - before["x"]) / (goal - before["x"])
    outside = np.flatnonzero(np.abs(progress - 1) > SETTLED)
    last = int(outside[-1]) + 1 if outside.size else 0
    return {
        "overshoot": max(float(progress.max()) - 1.0, 0.0),
        "settling_time": float(t[last]) if last < len(t) else np.nan,
    }


def _cost(muscle: Muscle, before: OperatingPoint, rest: OperatingPoint) -> dict[str, float]:
    """Lifting work, and air that the muscle holds more."""
    air = [
        air_mass(
            point["muscle.pressure"] + AMBIENT_PRESSURE,
            float(muscle_volume(muscle, point["muscle.contraction"])),
        )
        for point in (before, rest)
    ]
    mass, gravity = (rest.plant.variable(n).start or 0.0 for n in ("mass", "gravity"))
    return {
        "work": mass * gravity * (rest["x"] - before["x"]),
        "air": air[1] - air[0],
    }
