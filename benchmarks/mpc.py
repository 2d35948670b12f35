"""Step times of the controller on the planner's benchmark plant, in one run, as ratios to IPOPT.

The plant of PAM-2DIR follows a square wave between the stops: steps of 5 ms, RK4 with two
sub-steps, all limits soft, shifted warm start. IPOPT solves the same program from the same guess.

Times are those of the thread on the processor, so that other programs do not enter; "wall" is the
median by the clock. The garbage of the set-up is frozen first, as before any loop that must be on
time.

Run:  python benchmarks/mpc.py [horizon ...]
"""

import gc
import sys
from time import perf_counter, thread_time

import numpy as np

import pam_ocp as pam
from pam_ocp.control.mpc.mpc import Mpc

STEP, BAR = 0.005, 1e5
COMMANDS = ("muscle1.command", "muscle2.command")
METHODS = (
    ("ipopt", {"solver": "ipopt"}, 60),
    ("piqp, one iteration", {"solver": "piqp", "iterations": 1, "compiled": False}, 400),
    ("hpipm, one iteration", {"iterations": 1, "compiled": False}, 400),
    ("one iteration, compiled", {"iterations": 1, "compiled": True}, 400),
    ("hpipm, converged, work bounded", {"iterations": 30, "compiled": False}, 400),
    ("converged, work bounded, compiled", {"iterations": 30, "compiled": True}, 400),
    ("hpipm, converged", {"iterations": 30, "work": None, "compiled": False}, 400),
)


def benchmark_plant() -> pam.Plant:
    return pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"),
        mass=2.0,
        pre_contraction=0.10,
        stroke=0.016,
        damping=pam.losses.ConstantDamping(20.0),
        feed=pam.feeds.Regulator(0.05, max_pressure=6 * BAR, max_rate=40 * BAR),
    )


def run(
    plant: pam.Plant, horizon: int, preview: bool, steps: int, **options
) -> tuple[Mpc, np.ndarray]:
    """The controller after so many steps, and the processor time of each after the first [s]."""
    mpc = Mpc(
        plant,
        horizon=horizon,
        sample_time=STEP,
        track={"x": 1.0},
        rate=dict.fromkeys(COMMANDS, 0.1),
        **options,
    )
    rest = plant.equilibrium(x=-0.014, stiffness=2e4)
    mpc.reset({n: rest[n] for n in COMMANDS})
    state, seconds = rest.x, []
    gc.collect()
    gc.freeze()
    for k in range(steps):
        t = STEP * (k + (np.arange(horizon + 1) if preview else np.zeros(horizon + 1)))
        wanted = {"x": np.where(t % 0.5 < 0.25, -0.014, 0.014)}
        begin = thread_time()
        mpc.control(state, wanted)
        seconds.append(thread_time() - begin)
        plan = mpc.prediction()  # the plant follows the model: the next state is the planned one
        state = np.clip(
            plan.array([v.name for v in plant.states])[1],
            plant.vector("state", attribute="min"),
            plant.vector("state", attribute="max"),
        )
    gc.unfreeze()
    return mpc, np.array(seconds[1:])


def main() -> None:
    plant = benchmark_plant()
    begin = perf_counter()
    Mpc(plant, horizon=50, sample_time=STEP, track={"x": 1.0})
    print(f"build, horizon 50: {perf_counter() - begin:.3f} s")
    print("milliseconds a step; evaluation and Python are what the QP solver does not take")
    heads = ("median", "99 %", "worst", "worst/med", "wall", "of it QP", "ratio", "iterations")
    print(f"{'':<46}" + "".join(f"{h:>11}" for h in heads) + f"{'fallbacks':>11}")
    for preview in (False, True):
        for horizon in [int(a) for a in sys.argv[1:]] or [30, 50]:
            base = None
            for name, options, steps in METHODS:
                mpc, seconds = run(plant, horizon, preview, steps, **options)
                done, median = mpc.statistics, float(np.median(seconds))
                base = base or median
                qp = float(np.median([s.qp_seconds for s in done.steps[1:]]))
                iterations = np.mean([s.iterations for s in done.steps[1:]])
                label = f"{name}, {horizon}{', preview' if preview else ''}"
                worst = float(seconds.max())
                figures = [1e3 * f for f in (median, np.quantile(seconds, 0.99), worst)]
                figures += [worst / median, 1e3 * done.median, 1e3 * qp]
                print(
                    f"{label:<46}"
                    + "".join(f"{f:>11.2f}" for f in figures)
                    + f"{median / base:>11.3f}{iterations:>11.1f}{done.fallbacks:>11d}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
