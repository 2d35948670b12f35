"""Step times of the controller on the planner's benchmark plant, in one run, as ratios to IPOPT.

The plant of PAM-2DIR follows a square wave between the stops: steps of 5 ms, RK4 with two sub-steps,
all limits soft, shifted warm start. IPOPT solves the same program from the same guess.

Run:  python benchmarks/mpc.py
"""

from time import perf_counter

import numpy as np

import pam_ocp as pam
from pam_ocp.plan.mpc import Mpc

STEP, BAR = 0.005, 1e5
COMMANDS = ("muscle1.command", "muscle2.command")


def benchmark_plant() -> pam.Plant:
    return pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"), mass=2.0, pre_contraction=0.10, stroke=0.016,
        damping=pam.ConstantDamping(20.0),
        feed=pam.Regulator(0.05, max_pressure=6 * BAR, max_rate=40 * BAR),
    )  # fmt: skip


def run(plant: pam.Plant, horizon: int, preview: bool, steps: int, **options) -> Mpc:
    mpc = Mpc(
        plant, horizon=horizon, step=STEP, track={"x": 1.0}, rate=dict.fromkeys(COMMANDS, 0.1),
        **options,
    )  # fmt: skip
    rest = plant.equilibrium(x=-0.014, stiffness=2e4)
    mpc.reset({n: rest[n] for n in COMMANDS})
    state = rest.x
    for k in range(steps):
        t = STEP * (k + (np.arange(horizon + 1) if preview else np.zeros(horizon + 1)))
        mpc.control(state, {"x": np.where(t % 0.5 < 0.25, -0.014, 0.014)})
        plan = mpc.prediction()  # the plant follows the model: the next state is the planned one
        state = np.clip(
            plan.array([v.name for v in plant.states])[1],
            plant.vector("state", attribute="min"), plant.vector("state", attribute="max"),
        )  # fmt: skip
    return mpc


def main() -> None:
    plant = benchmark_plant()
    begin = perf_counter()
    Mpc(plant, horizon=50, step=STEP, track={"x": 1.0})
    print(f"build, horizon 50: {perf_counter() - begin:.3f} s")
    methods = (
        ("ipopt", {"solver": "ipopt"}, 40),
        ("piqp, one iteration", {"solver": "piqp", "iterations": 1}, 400),
        ("hpipm, one iteration", {"iterations": 1}, 400),
        ("hpipm, at most 3", {"iterations": 3}, 400),
        ("hpipm, converged", {"iterations": 30}, 400),
    )
    print("milliseconds a step; evaluation and Python are what the QP solver does not take")
    head = ("median", "99 %", "worst", "of it QP", "ratio", "iterations", "fallbacks")
    print(f"{'':<44}" + "".join(f"{h:>11}" for h in head))
    for preview in (False, True):
        for horizon in (30, 50):
            base = None
            for name, options, steps in methods:
                done = run(plant, horizon, preview, steps, **options).statistics
                base = base or done.median
                qp = np.median([s.qp_seconds for s in done.steps[1:]])
                iterations = np.mean([s.iterations for s in done.steps[1:]])
                label = f"{name}, horizon {horizon}{', preview' if preview else ''}"
                figures = (done.median, float(np.quantile(done.seconds, 0.99)), done.worst, qp)
                print(
                    f"{label:<44}" + "".join(f"{1e3 * f:>11.2f}" for f in figures)
                    + f"{done.median / base:>11.3f}{iterations:>11.1f}{done.fallbacks:>11d}"
                )  # fmt: skip


if __name__ == "__main__":
    main()
