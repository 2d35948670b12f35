"""Describing functions of a load on a muscle, and the limit cycle that a relay makes of it.

A relay switches the command by +-D when the load passes its place: u = u0 - D sign(x - x0). Seen by
its first harmonic it sends a sine of amplitude 4 D / pi, so the loop swings at the frequency where
the plant's describing function at this amplitude has a phase of -180 degrees, with the amplitude
that the describing function then gives. The simulated loop swings so, to within what the higher
harmonics do.

Run:  python examples/control_describing.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp.control.describing import describing_function

BAR = 1e5
STEP = 0.5 * BAR
"""Of the relay."""


class Relay:
    """A Controller: more pressure below the place, less above it."""

    def __init__(self, point):
        self.point = point

    def reset(self): ...

    def __call__(self, t, measured):
        return {"muscle.command": self.point.u[0] - STEP * np.sign(measured["x"] - self.point["x"])}


def predicted(plant, point):
    """Frequency [Hz] and amplitude [m] of the limit cycle."""
    first = 4 * STEP / np.pi

    def answer(hertz):
        found = describing_function(plant, "muscle.command", "x", [first], [hertz], point)
        return found.values[0, 0]

    hertz = brentq(lambda f: (-answer(f)).imag, 1.0, 30.0, xtol=1e-6)
    return hertz, abs(answer(hertz)) * first


def simulated(plant, point):
    """The same of the loop with the relay, and its motion."""
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)}
    run = pam.closed_loop(
        Relay(point), plant, duration=4.0, sample_time=2e-4, start={**start, "x": point["x"] - 1e-3}
    ).trajectory
    late = run.t > 2.0
    t, x = run.t[late], run["x"][late] - point["x"]
    up = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    return (len(up) - 1) / (t[up[-1]] - t[up[0]]), (x.max() - x.min()) / 2, run


def main(folder: Path) -> None:
    plant = pam.HangingLoad(
        pam.muscle("DMSP-20-400N"),
        20.0,
        damping=pam.losses.ConstantDamping(150.0),
        losses=[pam.losses.CoulombFriction(8.0)],
    )
    point = plant.equilibrium(x=0.05)
    amplitudes, hertz = np.array([0.02, 0.1, 0.4, 1.2]) * BAR, np.geomspace(0.3, 12.0, 40)
    found = describing_function(plant, "muscle.command", "x", amplitudes, hertz, point)

    frequency, amplitude = predicted(plant, point)
    actual, swing, run = simulated(plant, point)
    print(f"limit cycle: predicted {frequency:.2f} Hz, {1e3 * amplitude:.3f} mm")
    print(f"             simulated {actual:.2f} Hz, {1e3 * swing:.3f} mm")

    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    gain, phase, motion = figure.subplots(3, 1)
    for i, size in enumerate(amplitudes):
        label = f"{size / BAR:g} bar"
        gain.loglog(hertz, np.abs(found.values[i]) * BAR * 1e3, label=label)
        angle = np.degrees(np.unwrap(np.angle(found.values[i])))
        phase.semilogx(hertz, angle - 360 * np.round(angle[0] / 360))
    gain.legend(title="amplitude of the command", fontsize=8)
    gain.set(
        ylabel="gain [mm/bar]", title="Describing functions of a load on a muscle with friction"
    )
    phase.axhline(-180, color="0.6", lw=0.8)
    phase.set(xlabel="frequency [Hz]", ylabel="phase [deg]")
    shown = run.t > run.t[-1] - 1.0
    motion.plot(run.t[shown], 1e3 * (run["x"][shown] - point["x"]), label="simulated")
    for side in (-1, 1):
        motion.axhline(
            side * 1e3 * amplitude, color="C1", ls="--", label="predicted" if side > 0 else None
        )
    motion.legend(fontsize=8, loc="upper right")
    motion.set(
        xlabel="t [s]",
        ylabel="x - x0 [mm]",
        title=f"Relay of +-{STEP / BAR:g} bar: {actual:.2f} Hz, predicted {frequency:.2f} Hz",
    )
    for axes in (gain, phase, motion):
        axes.grid(alpha=0.3)
    figure.savefig(folder / "control_describing.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_describing")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
