"""A muscle with asymmetric hysteresis follows a triangle: with and without the memory's inverse.

Run:  python examples/hysteresis_compensation.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import pam_ocp as pam
from pam_ocp.control import HysteresisCompensation

MIDDLE, AMPLITUDE, FREQUENCY = 0.050, 0.018, 0.5
"""Of the triangle [m], [m], [Hz]."""


def triangle(t: float) -> float:
    """From the lower end up, and back."""
    phase = (FREQUENCY * t) % 1.0
    return MIDDLE + AMPLITUDE * (1 - 2 * abs(1 - 2 * phase))


def main(folder: Path) -> None:
    loss = pam.losses.PrandtlIshlinskii(
        contracting=(12.0, 10.0), relaxing=(7.0, 6.0), per_pressure=2e-6
    )
    plant = pam.HangingLoad("DMSP-20-400N", mass=15.0, losses=loss)
    start = plant.equilibrium(x=triangle(0.0))
    model = plant.with_values(start)
    figure = Figure(figsize=(10.0, 6.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.6, 1.0))
    path, error = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    loop, force = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    missed = {}
    for color, compensate in (("C1", False), ("C0", True)):
        controller = HysteresisCompensation(model, compensate=compensate)
        run = pam.closed_loop(
            controller, plant, {"x": triangle}, duration=6.0, start=start, rtol=1e-7
        )
        wanted = np.array([triangle(t) for t in run.t])
        off, late = run["x"] - wanted, run.t > 2.0
        missed[compensate] = float(np.sqrt(np.mean(off[late] ** 2)))
        label = "with the memory's inverse" if compensate else "law and dynamics alone"
        path.plot(run.t, 1e3 * run["x"], color=color, label=label)
        error.plot(run.t, 1e3 * off, color=color)
        loop.plot(run["muscle.pressure"][late] / 1e5, 1e3 * run["x"][late], color=color, lw=1.0)
        force.plot(1e2 * run["muscle.contraction"], run["muscle.loss"], color=color, lw=1.0)
        print(f"{label:26} error {1e3 * missed[compensate]:.3f} mm (root mean square from 2 s)")
    print(f"smaller by a factor of {missed[False] / missed[True]:.0f}")
    path.plot(run.t, 1e3 * wanted, "k:", lw=1.0, label="wanted")
    path.legend(fontsize=8, loc="upper center", ncols=3)
    path.set(ylabel="x [mm]", ylim=(28, 78), title="A triangle of 0.5 Hz by feed-forward")
    error.set(xlabel="t [s]", ylabel="error [mm]")
    loop.set(xlabel="pressure [bar]", ylabel="x [mm]", title="length over pressure")
    force.set(xlabel="contraction [%]", ylabel="friction [N]", title="force of the memory")
    for axes in (path, error, loop, force):
        axes.grid(alpha=0.3)
    figure.savefig(folder / "hysteresis_compensation.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "hysteresis_compensation")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
