"""The figure of paper.md: one chain from a table to an FMU. ``python paper/figure.py [FOLDER]``"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

import pam_ocp as pam

ABOVE: dict[str, Any] = {
    "fontsize": 7,
    "loc": "lower center",
    "bbox_to_anchor": (0.5, 1.0),
    "ncols": 2,
    "frameon": False,
}
"""Legends that hide no curve."""


def law(axes: Any) -> pam.Muscle:
    """Measured cells and the fitted law; the muscle that has it."""
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
    fit = pam.fit_force(table)
    kappa = np.linspace(0.0, 0.25, 101)
    for number, pressure in enumerate(sorted(set(table.pressure))[2::4]):
        here = table.pressure == pressure
        color = f"C{number}"
        axes.plot(1e2 * table.contraction[here], table.force[here], "o", ms=3, color=color)
        force = np.maximum(fit.law.tension(pressure, kappa), 0.0)
        axes.plot(1e2 * kappa, force, color=color, label=f"{1e-5 * pressure:g} bar")
    axes.set(xlabel="contraction [%]", ylabel="force [N]", ylim=(0, None))
    axes.legend(fontsize=7)
    return fit.muscle(rest_length=0.300, diameter=0.020)


def motion(axes: Any, plant: pam.Plant) -> pam.planning.Plan:
    """The quickest motion there and back, and its pressures."""
    plan = pam.plan(plant, [{"x": -0.015}, {"x": 0.015}], cyclic=True, minimise="time")
    assert plan.verified, plan.verdict
    run = plan.replay.trajectory
    axes.plot(1e3 * run.t, 1e3 * run["x"], "k")
    axes.set(xlabel="time [ms]", ylabel="position [mm]")
    beside = axes.twinx()
    for name in ("muscle1", "muscle2"):
        beside.plot(1e3 * run.t, 1e-5 * run[f"{name}.pressure"], label=name, lw=1)
    beside.set_ylabel("pressure [bar]")
    beside.legend(**ABOVE)
    return plan


def unit(axes: Any, plant: pam.Plant, plan: pam.planning.Plan) -> None:
    """How far the FMU is from the simulation, mode by mode."""
    with tempfile.TemporaryDirectory() as folder:
        fmu = pam.export_fmu(plant, Path(folder) / "slide.fmu", platforms=["native"])
        check = pam.check_fmu(fmu, against=plan.replay.trajectory)
    assert check.ok, check
    modes = list(check.deviations)
    names = [v.name for v in plant.states]
    for shift, mode in zip((-0.2, 0.2), modes, strict=True):
        values = [check.deviations[mode][name] for name in names]
        axes.barh(np.arange(len(names)) + shift, values, 0.38, label=mode)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set(xscale="log", xlabel="FMU - simulation (scaled)")
    axes.legend(**ABOVE)


def main(folder: Path) -> Path:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
    plant = pam.AntagonisticSlide(law(left), mass=2.0, pre_contraction=0.10)
    unit(right, plant, motion(middle, plant))
    target = folder / "figure.png"
    figure.savefig(target, dpi=150, metadata={"Software": None})
    return target


if __name__ == "__main__":
    print(main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent))
