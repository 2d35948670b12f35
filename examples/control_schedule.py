"""Gain scheduling: a joint moves and stiffens at once; one LQI for all places, or one for each.

The angle follows moves between -0.5 and 0.5 rad while the stiffness goes from 12 to 36 N m/rad and
back. The feedback designed in the middle knows one point of rest only and leaves all others to its
integrals; interpolated gains and points of rest follow both.

Run:  python examples/control_schedule.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control.linear_quadratic import lqr, scheduled_lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.references import moves
from pam_ocp.figures.control import plot_tracking

DT = 2e-3
ANGLE = moves([0.0, 0.5, -0.5, 0.0], [0.2, 1.2, 2.4], duration=0.7)
STIFFNESS = moves([12.0, 36.0, 20.0], [0.2, 2.4], duration=1.5)


def place(t: float) -> dict[str, float]:
    """Where the joint is to be."""
    return {"theta": ANGLE(t)[0], "stiffness": STIFFNESS(t)[0]}


def main(folder: Path) -> None:
    muscle = pam.muscle("DMSP-20-400N")
    joint = pam.AntagonisticJoint(muscle, inertia=0.05, link_mass=1.0, link_length=0.2)
    cost = {
        "weights": {"theta": 10.0, "omega": 1.0},
        "integral": {"theta": 50.0, "stiffness": 10.0},
    }
    middle = joint.equilibrium(theta=0.0, stiffness=24.0)
    start = joint.equilibrium(place(0.0))
    begin = {v.name: start[v.name] for v in joint.states}
    controllers = {
        "one LQI": lqr(joint, middle, setpoint=place, sample_time=DT, **cost),
        "scheduled LQI": scheduled_lqr(
            joint,
            {"theta": np.linspace(-0.6, 0.6, 9), "stiffness": np.linspace(12.0, 36.0, 7)},
            place,
            sample_time=DT,
            **cost,
        ),
    }
    runs = {
        label: closed_loop(
            controller,
            joint,
            duration=4.2,
            sample_time=DT,
            start=begin,
            parameters={"link_mass": 1.2},
        ).trajectory
        for label, controller in controllers.items()
    }
    for label, run in runs.items():
        angle, stiffness = (
            np.abs(run[n] - np.array([place(t)[n] for t in run.t])).max()
            for n in ("theta", "stiffness")
        )
        print(f"{label:<15} largest error {np.degrees(angle):.2f} deg, {stiffness:.2f} N m/rad")
    plot_tracking(
        runs,
        ["theta", "stiffness", "muscle1.pressure"],
        {n: lambda t, n=n: place(t)[n] for n in ("theta", "stiffness")},
        "Position and stiffness of a joint, 20 % more mass of the link",
    ).savefig(folder / "control_schedule.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_schedule")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
