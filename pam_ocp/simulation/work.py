"""Work of the muscles over a motion: what each gave, took back,
and how well it used what it got.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_finite, require_instance
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory

FINER = 8
"""Points between two samples, on a monotone cubic through them."""


@shown
@dataclass(frozen=True)
class StrokeWork:
    """Mechanical work of one muscle over a stroke.

    Examples
    --------
    >>> work = pam.simulation.stroke_work(motion)["muscle"]
    >>> work.work > 0, work.efficiency is None
    (True, True)
    """

    muscle: str
    work: float
    """Net, out of the muscle [J]: ``delivered - absorbed``."""
    delivered: float
    """While the muscle pulled and shortened [J]."""
    absorbed: float
    """While it was stretched [J]."""
    peak_power: float
    """[W]"""
    work_per_mass: float | None
    """[J/kg]; None where the muscle's mass is not known."""
    efficiency: float | None
    """Work per pneumatic work (or per exergy drawn by valves) over the stroke; None without
    ``totals`` (see the feeds), or where nothing was put in."""

    def __str__(self) -> str:
        share = "" if self.efficiency is None else f", efficiency {100 * self.efficiency:.3g} %"
        return (
            f"{self.muscle}: {self.work:.4g} J ({self.delivered:.4g} J delivered, "
            f"{self.absorbed:.4g} J absorbed), peak {self.peak_power:.4g} W{share}"
        )


@verb
def stroke_work(
    motion: Trajectory, begin: float | None = None, end: float | None = None
) -> dict[str, StrokeWork]:
    """Work of every muscle over a motion, or over its part from ``begin`` to ``end`` [s].

    motion : what simulate, a plan or an FMU's replay gave: it holds ``<muscle>.power`` [W], which
        is integrated; where it holds ``<muscle>.work`` (a feed with ``totals``), that is the net
        work.

    Raises InputError when there is no power, or no sample between begin and end.

    Examples
    --------
    >>> round(pam.simulation.stroke_work(motion)["muscle"].work, 1)  # J
    18.3
    """
    require_instance("motion", motion, Trajectory, "give what simulate() returned")
    low = motion.t[0] if begin is None else require_finite("begin", begin, "s")
    high = motion.t[-1] if end is None else require_finite("end", end, "s")
    if not motion.t[0] <= low < high <= motion.t[-1]:
        raise InputError(
            f"begin = {low:g} s, end = {high:g} s: give a part of {motion.t[0]:g} .. "
            f"{motion.t[-1]:g} s"
        )
    names = [n.removesuffix(".power") for n in motion.names if n.endswith(".power")]
    if not names:
        raise InputError("the motion holds no '<muscle>.power'; simulate a plant with muscles")
    return {name: _of_one(motion, name, float(low), float(high)) for name in names}


def _of_one(motion: Trajectory, name: str, low: float, high: float) -> StrokeWork:
    t = _fine(motion.t, low, high)
    power = _between(motion, f"{name}.power", t)
    parts = (np.maximum(sign * power, 0.0) for sign in (1, -1))
    delivered, absorbed = (float(np.sum((y[1:] + y[:-1]) / 2 * np.diff(t))) for y in parts)
    work = delivered - absorbed
    if f"{name}.work" in motion:
        work = _gained(motion, f"{name}.work", low, high)
    spent = [k for k in ("exergy_drawn", "pneumatic_work") if f"{name}.{k}" in motion]
    put_in = _gained(motion, f"{name}.{spent[0]}", low, high) if spent else 0.0
    per_mass = None
    if f"{name}.power_per_mass" in motion and np.any(power):
        peak = int(np.argmax(np.abs(motion[f"{name}.power"])))
        per_mass = work * motion[f"{name}.power_per_mass"][peak] / motion[f"{name}.power"][peak]
    return StrokeWork(
        name,
        work,
        delivered,
        absorbed,
        float(power.max()),
        per_mass,
        work / put_in if put_in > 0 else None,
    )


def _fine(t: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    inside = t[(t > low) & (t < high)]
    knots = np.concatenate([[low], inside, [high]])
    steps = np.diff(knots)[:, None] * np.arange(FINER) / FINER
    return np.append((knots[:-1, None] + steps).ravel(), high)


def _between(motion: Trajectory, name: str, t: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.interpolate import PchipInterpolator  # `import pam_ocp` stays quick

    return np.asarray(PchipInterpolator(motion.t, motion[name])(t), dtype=float)


def _gained(motion: Trajectory, name: str, low: float, high: float) -> float:
    first, last = _between(motion, name, np.array([low, high]))
    return float(last - first)
