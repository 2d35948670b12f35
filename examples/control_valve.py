"""Control by proportional valves: the dead zone inverted, from closed valves at rest.

20 kg hang on a muscle behind a spool valve that stays closed over 15 % of its travel to either
side. An LQR and an Mpc lift them by 30 mm; both choose the valve's opening and send the command
that gives it. Beside them the LQR's openings sent as if they were commands: small ones are lost in
the dead zone.

Run:  python examples/control_valve.py [folder for the results]
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import pam_ocp as pam
from pam_ocp.control.loop import closed_loop
from pam_ocp.figures.control import plot_tracking
from pam_ocp.plants.valves import SpoolValve

DT = 2e-3


def main(folder: Path) -> None:
    plant = pam.HangingLoad(pam.muscle("DMSP-20-400N"), mass=20.0, feed=SpoolValve(overlap=0.3))
    low, high = plant.equilibrium(x=0.05), plant.equilibrium(x=0.08)
    start = {v.name: low[v.name] for v in plant.states}
    feedback = pam.lqr(plant, high, sample_time=DT)
    print(f"poles with feedback [1/s]: {feedback.poles.round(1)}")

    inversion = pam.plants.Inversion(plant)

    def without_inversion(t: float, measured: Mapping[str, float]) -> dict[str, float]:
        opening = inversion.openings(feedback(t, measured))["muscle.opening"]
        return {"muscle.command": opening}

    runs = {
        "LQR": closed_loop(feedback, plant, duration=1.0, sample_time=DT, start=start).trajectory,
        "LQR without inversion": closed_loop(
            without_inversion, plant, duration=1.0, sample_time=DT, start=start
        ).trajectory,
    }
    mpc = pam.Mpc(
        plant, horizon=25, sample_time=0.01, track={"x": 1.0}, rate={"muscle.command": 0.05}
    )
    runs["Mpc"] = mpc.closed_loop(plant, {"x": 0.08}, 1.0, start=start).trajectory
    for label, run in runs.items():
        print(f"{label:<22} after 1 s {1e3 * abs(run['x'][-1] - 0.08):7.4f} mm from the set point")
    figure = plot_tracking(
        runs,
        ["x", "muscle.pressure", "muscle.command"],
        {"x": lambda t: 0.08},
        "20 kg behind a valve with a wide dead zone",
    )
    figure.savefig(folder / "control_valve.png", dpi=120)
    path = pam.export_fmu(
        pam.control.state_feedback_controller(feedback),
        folder / "valve_controller.fmu",
        platforms="native",
    )
    print(f"the controller with its inversion: {path}")


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_valve")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
