"""A joint is pushed by an unknown torque: LQR, LQI, and a Kalman filter that estimates the torque.

Run:  python examples/control_offset_free.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import pam_ocp as pam
from pam_ocp.control.estimators.stationary import WithEstimate, kalman
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.state_feedback import OffsetFree

DT = 2e-3
NOISE = {"theta": 5e-5}
"""Standard deviation of what is measured [rad]."""


def torque(t: float) -> float:
    """From outside [N m]."""
    return 1.0 if t >= 0.5 else 0.0


def main(folder: Path) -> None:
    plant = pam.AntagonisticJoint(
        pam.muscle("DMSP-20-400N"),
        inertia=0.05,
        link_mass=1.0,
        link_length=0.2,
        loads=[pam.loads.ExternalForce()],
    )
    point = plant.equilibrium(theta=0.2, stiffness=25.0)
    plain = lqr(plant, point, sample_time=DT)
    integral = lqr(plant, point, integral={"theta": 60.0}, sample_time=DT)
    about = {"measured": NOISE, "process": 0.1, "sample_time": DT}
    controllers = {
        "LQR": WithEstimate(plain, kalman(plant, point, **about)),
        "LQI": WithEstimate(integral, kalman(plant, point, **about)),
        "estimated torque": OffsetFree(
            plain, kalman(plant, point, **about, disturbances={"external_force": 5.0}), ["theta"]
        ),
    }
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)}
    figure = Figure(figsize=(9.5, 6.0), layout="constrained")
    angle, pressure = figure.subplots(2, 1, sharex=True)
    for i, (label, controller) in enumerate(controllers.items()):
        run = pam.closed_loop(
            controller,
            plant,
            duration=2.5,
            sample_time=DT,
            start=start,
            noise=NOISE,
            parameters={"link_mass": 1.2},
            disturbances={"external_force": torque},
        ).trajectory
        late = np.degrees(np.mean(run["theta"][run.t > 2.0]) - 0.2)
        print(f"{label:<18} left at the end {late:+.3f} deg")
        angle.plot(run.t, np.degrees(run["theta"]), label=label, color=f"C{i}")
        pressure.plot(run.t, run["muscle1.command"] / 1e5, color=f"C{i}", lw=0.9, zorder=3 - i)
    angle.axhline(np.degrees(0.2), color="0.6", lw=0.8)
    angle.legend(fontsize=8)
    angle.set(ylabel="theta [deg]", title="1.2 kg instead of 1 kg, and 1 N m from t = 0.5 s on")
    pressure.set(xlabel="t [s]", ylabel="command of muscle 1 [bar]")
    for axes in (angle, pressure):
        axes.grid(alpha=0.3)
    figure.savefig(folder / "control_offset_free.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_offset_free")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
