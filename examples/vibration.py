"""Vibration of a load on one muscle: why it dies out at constant pressure, and how feedback keeps
it.

Run:  python examples/vibration.py [folder for the pictures]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp import vibration
from pam_ocp.figures.vibration import plot_backbone, plot_phase
from pam_ocp.plants.regulated import RegulatedLoad

BAR = 1e5


def free(muscle: pam.Muscle, folder: Path) -> None:
    """20 kg, let go 30 mm above rest; frequency against amplitude at three pressures."""
    damped = pam.HangingLoad(muscle, mass=20.0, feed=pam.feeds.IdealPressure())
    motion = vibration.free_vibration(damped, {"muscle.pressure": 4 * BAR}, 0.03, cycles=10)
    print("free vibration, damping ratio 0.1:", motion)
    motion.plot_envelope().savefig(folder / "free_envelope.png", dpi=120)
    motion.plot_phase().savefig(folder / "free_phase.png", dpi=120)

    energy = vibration.energy(damped, motion.trajectory)
    fallen, largest = energy.total[0] - energy.total[-1], np.diff(energy.total).max()
    print(f"energy lost: {fallen:.4f} J; largest rise between two samples: {largest:.1e} J")
    print("  at constant pressure energy only falls: no vibration can sustain itself")
    energy.plot().savefig(folder / "energy.png", dpi=120)

    undamped = pam.HangingLoad(
        muscle, mass=20.0, damping=pam.losses.ConstantDamping(0.0), feed=pam.feeds.IdealPressure()
    )
    curves = {}
    for bar, largest_offset in ((2, 0.034), (4, 0.030), (6, 0.014)):
        curves[f"{bar} bar"] = vibration.backbone(
            undamped, {"muscle.pressure": bar * BAR}, np.linspace(0.001, largest_offset, 12)
        )
        found = curves[f"{bar} bar"]
        print(
            f"backbone at {bar} bar: {found.frequencies[0]:.4f} Hz at 1 mm, "
            f"{found.frequencies[-1]:.4f} Hz let go at {largest_offset * 1e3:.0f} mm"
        )
    plot_backbone(curves).savefig(folder / "backbone.png", dpi=120)


def border(plant: pam.Plant, rest: dict[str, float], folder: Path) -> vibration.HopfPoint:
    """Where feedback through a lag makes the rest unstable."""
    path = vibration.stability_path(plant, "muscle.gain", np.linspace(1e5, 3e6, 60), rest)
    path.plot().savefig(folder / "eigenvalues.png", dpi=120)
    found = vibration.hopf_border(
        plant, "muscle.gain", (1e5, 5e7), "muscle.lag", np.geomspace(0.005, 1.0, 40), rest
    )
    i = int(np.nanargmin(found.border))
    print(
        f"the least gain that can vibrate is {found.border[i] / BAR:.2f} bar/m, "
        f"at a lag of {found.values[i]:.3f} s"
    )
    found.plot().savefig(folder / "hopf_border.png", dpi=120)
    point = vibration.hopf(plant, "muscle.gain", (1e5, 1e7), rest)
    print(point)
    return point


def cycles(point: vibration.HopfPoint, name: str, folder: Path, step: float) -> None:
    """The limit cycle born at a Hopf point, and what becomes of it as the gain grows."""
    small = vibration.limit_cycle(point.plant, point, amplitude={"x": 2e-3})
    branch = vibration.continue_cycle(
        small, "muscle.gain", (0.2 * point.value, 1.5 * point.value), step=step
    )
    print(f"{len(branch.cycles)} cycles; {branch.ended}")
    gain = point.plant.variable("muscle.gain")
    for i in branch.folds:
        print(
            f"  the branch turns back at {gain.shown(branch.values[i])}, "
            f"amplitude {1e3 * branch.amplitudes('x')[i]:.1f} mm"
        )
    slack = next((c for c in branch.cycles if any(c.slack.values())), None)
    if slack is not None:
        print(
            f"  the muscle goes slack from an amplitude of {1e3 * slack.amplitude('x'):.1f} mm on"
        )
    beyond = next((c for c in branch.cycles if c.outside), None)
    if beyond is not None:
        print(f"  from {1e3 * beyond.amplitude('x'):.1f} mm on the force law is extrapolated")
    branch.plot().savefig(folder / f"{name}_branch.png", dpi=120)
    branch.plot_phase().savefig(folder / f"{name}_phase.png", dpi=120)


def check(point: vibration.HopfPoint, folder: Path) -> None:
    """A cycle 10 % beyond the border against a simulation that winds onto it."""
    plant = point.plant.with_values({"muscle.gain": 1.1 * point.value})
    motion = pam.simulate(plant, t=np.linspace(0, 30, 6001), start={"x": point.point["x"] + 0.012})
    cycle = vibration.limit_cycle(plant, motion)
    print(cycle)
    print("Floquet multipliers:", ", ".join(f"{m:.6g}" for m in np.abs(cycle.multipliers)))
    print(f"a simulation misses its start after one period by {cycle.closing_error:.1e} of nominal")
    plot_phase(
        [motion, cycle.trajectory], "x", plant, labels=["simulation, from 12 mm", "limit cycle"]
    ).savefig(folder / "limit_cycle.png", dpi=120)
    cycle.plot_multipliers().savefig(folder / "multipliers.png", dpi=120)


def main(folder: Path) -> None:
    muscle = pam.muscle("DMSP-20-400N")
    free(muscle, folder)

    plant = RegulatedLoad(muscle, mass=20.0, lag=0.1)
    print("\nlow, at 40 mm: the overstretched muscle bounds the vibration")
    point = border(plant, {"x": 0.04, "muscle.reference": 0.04}, folder)
    check(point, folder)
    cycles(point, "low", folder, step=0.5)

    print("\nhigh, at 80.8 mm (4 bar): slack at the top makes the onset a jump")
    rest = {"x": 0.0808, "muscle.reference": 0.0808}
    high = vibration.hopf(plant, "muscle.gain", (1e5, 1e7), rest)
    print(high)
    cycles(high, "high", folder, step=1.0)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "vibration")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
