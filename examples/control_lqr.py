"""LQR, LQI and LQG about a stop, with a wrong mass and a weak muscle, and the margins of each.

A slide held by two muscles carries half as much again as its controllers believe and is displaced
at first; one muscle pulls 5 % less than its law says. LQR is left with an error, LQI is
not; LQG sees only a noisy position and pressures. The last run has the plant's FMU as the plant.

Run:  python examples/control_lqr.py [folder for the results]
"""

import sys
from pathlib import Path

import pam_ocp as pam
from pam_ocp.control.analysis import margins
from pam_ocp.control.estimators.stationary import WithEstimate, kalman
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.figures.control import plot_loop, plot_tracking

DT = 1e-3
STOP = 0.004


def weakened(plant: pam.Plant, share: float) -> dict[str, float]:
    """Parameters of a muscle 1 that pulls with this share of its law's force."""
    names = [f"muscle1.{a}" for a in ("a1", "a2", "a4", "a5", "a6")]
    return {n: share * float(plant.variable(n).start) for n in names}


def main(folder: Path) -> None:
    muscle = pam.muscle("DMSP-20-200N")
    plant = pam.AntagonisticSlide(muscle, mass=2.0, feed=pam.feeds.Regulator(0.05))
    point = plant.equilibrium(x=STOP, stiffness=2.3e4)
    weights = {"x": 10.0, "v": 0.5}
    regulator = lqr(plant, point, weights=weights, sample_time=DT)
    integral = lqr(
        plant, point, weights=weights, integral={"x": 100.0, "stiffness": 5.0}, sample_time=DT
    )
    watch = kalman(
        plant,
        point,
        measured={"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0},
        process={"v": 5.0, "muscle1.pressure": 1.0, "muscle2.pressure": 1.0},
        sample_time=DT,
    )
    estimated = WithEstimate(integral, watch, also=["stiffness"])

    true = {"mass": 3.0, **weakened(plant, 0.95)}
    start = {"x": STOP - 0.003, **{n: point[n] for n in ("muscle1.pressure", "muscle2.pressure")}}
    noise = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    fmu = pam.export_fmu(plant, folder / "slide.fmu", platforms="native")
    shared = {"duration": 0.8, "sample_time": DT, "start": start, "parameters": true}
    runs = {
        "LQR": closed_loop(regulator, plant, **shared).trajectory,
        "LQI": closed_loop(integral, plant, **shared).trajectory,
        "LQG with integral": closed_loop(estimated, plant, noise=noise, **shared).trajectory,
        "LQI, FMU as plant": closed_loop(integral, fmu, **shared).trajectory,
    }
    for label, run in runs.items():
        print(f"{label:<20} error at the end {1e6 * (run['x'][-1] - STOP):8.2f} um")
    difference = runs["LQI"].compare(runs["LQI, FMU as plant"]).largest
    print(f"FMU against plant: {difference:.1e} of nominal")

    loops = {"LQR": regulator.loop, "LQI": integral.loop}
    found = {label: margins(loop) for label, loop in loops.items()}
    for label, m in found.items():
        print(f"{label}\n{m}")
    plot_tracking(
        runs,
        ["x", "muscle1.pressure", "stiffness"],
        {"x": lambda t: STOP},
        "LQR and LQI about a stop, 50 % more mass, one muscle 5 % weaker",
    ).savefig(folder / "control_lqr.png", dpi=120)
    plot_loop(loops, found).savefig(folder / "control_lqr_margins.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "control_lqr")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
