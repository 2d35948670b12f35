"""Model predictive control against an FMU that carries 30 % more mass and is pushed by a force.

The controller and its Kalman filter know the slide with 2 kg and no force. The FMU moves 2.6 kg,
and from 1 s on 40 N push it. Position and pressures are measured with noise; mass, force and
velocity are estimated, and the estimates are what the controller plans with.

Run:  python examples/mpc.py [folder for the results]
"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

import pam_ocp as pam
from pam_ocp.control.loop import ClosedLoop

STEP = 0.005
PUSH, MASS = 40.0, 2.6


def pushed_slide(muscle: pam.Muscle) -> pam.Plant:
    """A slide that a force from outside pushes, which no controller can choose."""
    return pam.AntagonisticSlide(
        muscle,
        2.0,
        0.10,
        stroke=0.016,
        damping=pam.losses.ConstantDamping(20.0),
        feed=pam.feeds.Regulator(0.05, max_pressure=6e5, max_rate=40e5),
        loads=(pam.loads.ExternalForce("push"),),
        name="pushed_slide",
    )


def wanted(t: float) -> float:
    """A square wave between two stops, then rest at the middle."""
    if t > 2.0:
        return 0.0
    return 0.010 if t % 0.8 < 0.4 else -0.010


def run(plant: pam.Plant, fmu: Path, estimating: bool) -> ClosedLoop:
    rest = plant.equilibrium(x=0.0, stiffness=2e4)
    start = {v.name: rest[v.name] for v in (*plant.states, *plant.inputs)}
    model = plant.with_values(start)
    controller = pam.Mpc(
        model,
        horizon=40,
        sample_time=STEP,
        delay=1,
        track={"x": 1.0, "stiffness": 0.05},
        rate={"muscle1.command": 0.05, "muscle2.command": 0.05},
    )
    unknown = {"mass": (0.5, 0.05), "push": (20.0, 100.0)} if estimating else {}
    observer = pam.KalmanFilter(
        model,
        sample_time=STEP,
        unknown=unknown,
        process={"v": 0.01},
        measured={"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0},
        uncertainty={"x": 1e-4, "v": 1e-3, "muscle1.pressure": 1e3, "muscle2.pressure": 1e3},
    )
    return controller.closed_loop(
        fmu,
        {"x": wanted, "stiffness": 2e4},
        duration=3.0,
        estimator=observer,
        disturbances={"push": lambda t: PUSH if t >= 1.0 else 0.0},
        parameters={"mass": MASS},
        start=start,
        seed=1,
    )


def draw(blind: ClosedLoop, seeing: ClosedLoop) -> Figure:
    figure = Figure(figsize=(8, 8.5), layout="constrained")
    motion, error, pressure, load = figure.subplots(4, 1, sharex=True)
    t = seeing.trajectory.t
    for loop, label, colour in (
        (blind, "load not estimated", "#c8553d"),
        (seeing, "load estimated", "#1b6ca8"),
    ):
        deviation = loop.trajectory["x"] - loop.reference["x"]
        motion.plot(t, 1e3 * loop.trajectory["x"], color=colour, label=label)
        error.plot(t, 1e3 * deviation, color=colour)
    motion.step(t, 1e3 * seeing.reference["x"], "k:", where="post", lw=1, label="reference")
    motion.set_ylabel("position [mm]")
    error.axhspan(-0.2, 0.2, color="#4c956c", alpha=0.25, lw=0, label="±0.2 mm")
    error.set_ylim(-1.5, 1.5)
    error.set_ylabel("error [mm]")
    for i, colour in ((1, "#1b6ca8"), (2, "#c98b14")):
        column = seeing.trajectory[f"muscle{i}.pressure"]
        pressure.plot(t, column / 1e5, color=colour, label=f"muscle {i}")
    pressure.set_ylabel("pressure [bar]")
    pressure.set_ylim(bottom=0)
    assert seeing.estimate is not None
    load.plot(t, seeing.estimate["push"], color="#7b5ea7", lw=0.8, label="push, estimated")
    load.plot(t, seeing.trajectory["push"], "k:", lw=1.2, label="push, true")
    load.set_ylabel("push [N]")
    mass = load.twinx()
    mass.axhline(MASS, color="#4c956c", ls=":", lw=1, label="mass, true")
    mass.plot(t, seeing.estimate["mass"], color="#4c956c", label="mass, estimated")
    mass.set_ylabel("mass [kg]")
    mass.set_ylim(1.0, 3.5)
    load.set_xlabel("time [s]")
    load.set_xlim(t[0], t[-1])
    for ax in (motion, error, pressure):
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
    handles = [*load.get_lines(), *mass.get_lines()]
    load.legend(
        handles,
        [h.get_label() for h in handles],
        loc="center left",
        bbox_to_anchor=(1.1, 0.5),
        frameon=False,
        fontsize="small",
    )
    for ax in (motion, error, pressure, load):
        ax.grid(True, color="#dddddd", lw=0.6)
    return figure


def main(folder: Path) -> None:
    plant = pushed_slide(pam.muscle("DMSP-20-200N"))
    fmu = pam.export_fmu(plant, folder / "pushed_slide.fmu", platforms=["native"])
    blind, seeing = (run(plant, fmu, estimating) for estimating in (False, True))
    for label, loop in (("load not estimated", blind), ("load estimated", seeing)):
        print(f"{label}: steady error {1e3 * loop.steady_error('x', 0.3):.3f} mm")
        print(loop)
    assert seeing.estimate is not None
    found = seeing.estimate.row(-1)
    print(f"found: mass {found['mass']:.2f} kg (true {MASS}), push {found['push']:.1f} N ({PUSH})")
    draw(blind, seeing).savefig(folder / "mpc.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "mpc")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
