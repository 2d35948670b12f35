"""PID on a joint: what feed-forward by the exact inverse and a cascaded pressure loop bring.

A link of 1 kg between flexor and extensor follows moves of half a second. Four controllers of the
same PID, sampled at 2 ms, against the nonlinear plant with 20 % more inertia than they believe:
PID alone; with feed-forward; feed-forward on a cascade whose inner loop makes the regulators five
times as quick; and that cascade on spool valves with their gas instead of regulators.

Run:  python examples/control_pid.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.pid import PID, PositionController, PressureLoop
from pam_ocp.control.references import moves
from pam_ocp.figures.control import plot_tracking
from pam_ocp.plants.valves import SpoolValve

DT = 2e-3


def joint(feed: pam.feeds.Regulator | SpoolValve) -> pam.Plant:
    muscle = pam.muscle("DMSP-20-400N")
    return pam.AntagonisticJoint(muscle, inertia=0.05, link_mass=1.0, link_length=0.2, feed=feed)


def main(folder: Path) -> None:
    reference = moves([0.0, 0.5, -0.3, 0.0], [0.1, 0.9, 1.7], duration=0.5)
    regulated, valves = joint(pam.feeds.Regulator(0.05)), joint(SpoolValve())
    kinds = {
        "PID alone": (regulated, False, None),
        "with feed-forward": (regulated, True, None),
        "and pressure loop": (regulated, True, 0.01),
        "the same on valves": (valves, True, None),
    }
    runs = {}
    for label, (plant, feedforward, time_constant) in kinds.items():
        controller = PositionController(
            plant,
            reference,
            PID.placed(3.0),
            sample_time=DT,
            stiffness=25.0,
            feedforward=feedforward,
            inner=PressureLoop(plant, time_constant),
        )
        first = dict(
            zip(("muscle1.pressure", "muscle2.pressure"), controller.pressures(0.0), strict=True)
        )
        true = {"inertia": 0.06, "link_mass": 1.2}
        run = closed_loop(
            controller,
            plant,
            duration=2.5,
            sample_time=DT,
            start=first,
            parameters=true,
            noise={"theta": 2e-5},
        ).trajectory
        error = run["theta"] - np.array([reference(t)[0] for t in run.t])
        print(f"{label:<22} largest error {np.degrees(np.abs(error).max()):6.3f} deg")
        runs[label] = run
    figure = plot_tracking(
        runs,
        ["theta", "muscle1.pressure", "stiffness"],
        {"theta": lambda t: reference(t)[0]},
        "PID on a joint, 20 % more inertia than believed",
    )
    figure.savefig(folder / "control_pid.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_pid")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
