"""Comparison of a simulation with a measured record: alignment in time, RMSE, fit percentage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """How well one variable of a simulation agrees with a record [its unit]."""

    name: str
    rmse: float
    largest: float
    fit_percent: float
    """100 (1 - |measured - simulated| / |measured - mean|): 100 is perfect, 0 no better than the
    mean.
    """
    offset: float
    """Mean of measured - simulated."""


@shown
@dataclass(frozen=True)
class RecordComparison:
    """A simulation against a record, over their common time.

    Examples
    --------
    >>> found = pam.simulation.compare_with_record(motion, motion)
    >>> found.shift, [a.name for a in found.agreements][:2]
    (0.0, ['x', 'v'])
    """

    shift: float
    """The record lags behind the simulation by this time [s] (0 when not aligned)."""
    agreements: tuple[Agreement, ...]
    measured: Trajectory = field(repr=False)
    """The record in the simulation's time, over the common part."""
    simulated: Trajectory = field(repr=False)
    """The simulation at the record's samples."""

    def __getitem__(self, name: str) -> Agreement:
        wanted = self.measured.variable(name).name
        return next(a for a in self.agreements if a.name == wanted)

    def __str__(self) -> str:
        lines = [f"record lags by {self.shift * 1e3:.4g} ms; {len(self.measured)} common samples"]
        for a in self.agreements:
            shown = self.measured.variable(a.name).shown
            lines.append(
                f"{a.name:<24} RMSE {shown(a.rmse):>12}  largest {shown(a.largest):>12}  "
                f"fit {a.fit_percent:6.2f} %"
            )
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Measured and simulated, and the residual, for each compared variable."""
        return courtesy.plot_record(self)


@verb
def compare_with_record(
    simulated: Trajectory,
    measured: Trajectory,
    names: Sequence[str] | None = None,
    *,
    max_shift: float = 0.0,
) -> RecordComparison:
    """Compare a simulation with a measured record at the record's samples.

    names : columns to compare; by default all that both hold, inputs left out.
    max_shift : the record's clock may be off by up to this time [s]; the shift that makes the
        summed squared residual (in units of each variable's spread) smallest is found to well below
        a sample. 0 takes the clocks as they are.

    Raises InputError when nothing can be compared (no common column, no common time).

    Examples
    --------
    >>> late = pam.Trajectory(motion.t + 0.01, {"x": motion["x"]})
    >>> found = pam.simulation.compare_with_record(motion, late, max_shift=0.05)
    >>> print(f"{found.shift:.4f}")
    0.0100
    """
    if max_shift:
        max_shift = require_positive("max_shift", max_shift, "s", zero=True)
    if names is None:
        names = [
            n
            for n in measured.names
            if n in simulated and simulated.variable(n).causality != "input"
        ]
    if not names:
        raise InputError("simulation and record have no column in common (other than inputs)")
    columns = [simulated.variable(n).name for n in names]
    shift = _best_shift(simulated, measured, columns, max_shift) if max_shift else 0.0
    inside = _common(simulated, measured, shift)
    if inside.sum() < 2:
        raise InputError(
            f"record {measured.t[0]:g} .. {measured.t[-1]:g} s and simulation {simulated.t[0]:g} "
            f".. {simulated.t[-1]:g} s overlap in {int(inside.sum())} samples; at least 2 are "
            "needed"
        )
    times = measured.t[inside] - shift
    variables = [simulated.variable(n) for n in columns]
    record = Trajectory(times, {n: measured[n][inside] for n in columns}, variables)
    there = simulated.at(times)
    model = Trajectory(times, {n: there[n] for n in columns}, variables)
    return RecordComparison(
        shift, tuple(_agreement(n, record[n], model[n]) for n in columns), record, model
    )


def _agreement(name: str, measured: Array, simulated: Array) -> Agreement:
    residual = measured - simulated
    spread = float(np.linalg.norm(measured - measured.mean()))
    size = float(np.linalg.norm(residual))
    fit = 100 * (1 - size / spread) if spread > 0 else (100.0 if size == 0 else float("-inf"))
    return Agreement(
        name,
        float(np.sqrt(np.mean(residual**2))),
        float(np.max(np.abs(residual))),
        fit,
        float(residual.mean()),
    )


def _common(simulated: Trajectory, measured: Trajectory, shift: float) -> NDArray[np.bool_]:
    t = measured.t - shift
    return np.asarray((t >= simulated.t[0]) & (t <= simulated.t[-1]))


def _best_shift(
    simulated: Trajectory, measured: Trajectory, names: Sequence[str], largest: float
) -> float:
    """Scan at the record's sampling, then golden section around the best."""
    spreads = {n: float(np.std(measured[n])) or 1.0 for n in names}
    step = float(np.median(np.diff(measured.t))) if len(measured) > 1 else largest

    def cost(shift: float) -> float:
        inside = _common(simulated, measured, shift)
        if inside.sum() < max(2, len(measured) // 4):
            return float("inf")
        t = measured.t[inside] - shift
        return float(
            np.mean(
                [
                    np.mean(
                        (
                            (measured[n][inside] - np.interp(t, simulated.t, simulated[n]))
                            / spreads[n]
                        )
                        ** 2
                    )
                    for n in names
                ]
            )
        )

    count = int(np.ceil(largest / step))
    scanned = np.linspace(-largest, largest, 2 * min(count, 2000) + 1)
    best = float(scanned[int(np.argmin([cost(s) for s in scanned]))])
    width = float(scanned[1] - scanned[0])
    low, high = max(-largest, best - width), min(largest, best + width)
    golden = (np.sqrt(5) - 1) / 2
    a, b = high - golden * (high - low), low + golden * (high - low)
    while high - low > 1e-6 * width:
        if cost(a) < cost(b):
            high, b = b, a
            a = high - golden * (high - low)
        else:
            low, a = a, b
            b = low + golden * (high - low)
    return float((low + high) / 2)
