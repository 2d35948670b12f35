"""Speed-up of simulate_many on two processes over one, in one run.

Run:  python benchmarks/simulate_many.py
"""

from concurrent.futures import ProcessPoolExecutor
from time import perf_counter

import numpy as np

import pam_ocp as pam


def main() -> None:
    plant = pam.HangingLoad(pam.muscle("DMSP-20-400N"))
    cases = [
        *pam.simulation.sweep(mass=list(np.linspace(5, 100, 999))),
        {"parameters": {"mass": -1.0}},
    ]
    common = {
        "inputs": {"muscle.command": wave()},
        "t": np.linspace(0.0, 2.5, 251),
        "interpolation": "linear",
    }

    begin = perf_counter()
    alone = pam.simulate_many(plant, cases, **common)
    one = perf_counter() - begin

    with ProcessPoolExecutor(2) as pool:
        begin = perf_counter()
        shared = pam.simulate_many(plant, cases, executor=pool, **common)
        two = perf_counter() - begin

    same = all(
        np.array_equal(a["x"], shared.trajectories[i]["x"]) for i, a in alone.trajectories.items()
    )
    print(f"{len(cases)} cases: one process {one:.1f} s, two {two:.1f} s, speed-up {one / two:.2f}")
    print(f"{len(shared.trajectories)} returned, {len(shared.failures)} failed; equal: {same}")


def wave() -> np.ndarray:
    """Samples of a wave of pressure: arrays travel to workers, functions of time may not."""
    return 4e5 + 1e5 * np.sin(9 * np.linspace(0.0, 2.5, 251))


if __name__ == "__main__":
    main()
