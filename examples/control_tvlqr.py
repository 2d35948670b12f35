"""Time-varying LQR holds a planned motion that the plant, as it really is, would miss.

A slide is planned to go from stop to stop in the shortest time, with some pressure left to correct
with. Played open loop on a slide with +-30 % mass and a muscle with 5 % force error the motion is
missed; the gains of the Riccati equation along the plan hold it.

Run:  python examples/control_tvlqr.py [folder for the results]
"""

import itertools
import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control.along_motion import OpenLoop, tvlqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.figures.control import plot_tracking

BAR = 1e5
DT = 1e-3


def planned() -> tuple[pam.Plant, pam.Trajectory]:
    """The plant as believed, and its quickest motion within 1.2 .. 4.5 bar."""
    muscle = pam.muscle("DMSP-20-200N")
    plant = pam.AntagonisticSlide(
        muscle, mass=2.0, stroke=0.02, feed=pam.feeds.Regulator(0.05, max_pressure=6 * BAR)
    )
    pressures = [f"muscle{i}.{n}" for i in (1, 2) for n in ("pressure", "command")]
    plan = pam.plan(
        plant,
        stops=[{"x": -0.012}, {"x": 0.012}],
        minimise="time",
        bounds=dict.fromkeys(pressures, (1.2 * BAR, 4.5 * BAR)),
    )
    return plant, plan.replay.trajectory


def compared(
    plant: pam.Plant, motion: pam.Trajectory
) -> dict[tuple[float, float], dict[str, pam.Trajectory]]:
    """Runs {(mass factor, force factor of muscle 1): {"open loop": ..., "time-varying LQR":
    ...}}.
    """
    feedback = tvlqr(
        plant, motion, weights={"x": 300.0, "v": 3.0}, integral={"x": 3e4}, sample_time=DT
    )
    start = {v.name: motion[v.name][0] for v in plant.states}
    runs = {}
    for mass, force in itertools.product((0.7, 1.0, 1.3), (0.95, 1.0, 1.05)):
        law = [f"muscle1.{a}" for a in ("a1", "a2", "a4", "a5", "a6")]
        true = {n: force * float(plant.variable(n).start) for n in law}
        runs[mass, force] = {
            label: closed_loop(
                controller,
                plant,
                duration=motion.duration,
                sample_time=DT,
                start=start,
                parameters={"mass": 2.0 * mass, **true},
            ).trajectory
            for label, controller in (
                ("open loop", OpenLoop(plant, motion, DT)),
                ("time-varying LQR", feedback),
            )
        }
    return runs


def peak(run: pam.Trajectory, motion: pam.Trajectory) -> float:
    """Largest distance of a run from the planned motion [m]."""
    return float(np.abs(run["x"] - np.interp(run.t, motion.t, motion["x"])).max())


def main(folder: Path) -> None:
    plant, motion = planned()
    runs = compared(plant, motion)
    print(f"planned: {1e3 * motion.duration:.1f} ms for 24 mm")
    print(f"{'mass':>6}{'force':>7}{'open loop':>12}{'closed loop':>13}{'ratio':>8}")
    for (mass, force), pair in runs.items():
        a, b = (1e3 * peak(run, motion) for run in pair.values())
        print(f"{mass:>6.1f}{force:>7.2f}{a:>9.3f} mm{b:>10.3f} mm{a / b:>8.1f}")
    shown = {
        f"{label}, mass x{mass:g}": run
        for mass in (0.7, 1.3)
        for label, run in runs[mass, 0.95].items()
    }
    plot_tracking(
        shown,
        ["x", "muscle1.command", "muscle2.command"],
        {"x": lambda t: float(np.interp(t, motion.t, motion["x"]))},
        "Planned motion with +-30 % mass, muscle 1 with 5 % less force",
    ).savefig(folder / "control_tvlqr.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_tvlqr")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
