"""A rig with every effect of a bench, found back from staircases, and other signals predicted.

    python benchmarks/staircase_study.py [--seed N] [--rigs 4] [--steps K]

Random antagonistic slides with a command in volts: gain, base pressure, a lag of filling and one of
venting, slew limit, dead time, friction, damping. Two staircases of held steps are measured (the
position with 20 um of noise, the pressures with 500 Pa) and fitted by ``fit_free_run`` at its
defaults, whole records. Printed: each parameter with its distance from the truth in standard
errors, and how much of the variance of signals of other kinds (sines, chirps, straight lines
between random points) the fitted plant predicts. Without --seed it comes from the clock.
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.plants.losses import CoulombFriction

SAMPLE = 0.01
NOISE = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
OUTPUTS = list(NOISE)
FREE = [
    "muscle*.gain",
    "base_pressure",
    "muscle*.lag",
    "muscle*.venting_lag",
    "muscle*.slew",
    "muscle*.friction_constant",
    "damping",
]
RANGES = {
    "gain": (0.8e5, 1.2e5),
    "base": (2.0e5, 2.6e5),
    "lag": (0.02, 0.06),
    "venting_lag": (0.05, 0.10),
    "slew": (8e5, 2e6),
    "dead_time": (0.004, 0.03),
    "friction": (3.0, 12.0),
    "damping": (25.0, 70.0),
}
GUESS = {
    "gain": 1e5, "base": 2.3e5, "lag": 0.04, "venting_lag": 0.07, "slew": 1.3e6,
    "friction": 6.0, "damping": 45.0,
}  # fmt: skip


def rig(values: dict[str, float], mass: float) -> pam.Plant:
    feed = {k: v for k, v in values.items() if k not in ("friction", "damping")}
    return pam.AntagonisticSlide(
        "DMSP-20-200N",
        mass,
        feed=pam.feeds.PairRegulator(max_pressure=6e5, **feed),
        losses=(CoulombFriction(values["friction"], speed=3e-3),),
        damping=values["damping"],
    )


def staircase(rng: np.random.Generator, steps: int = 24) -> tuple[Any, Any, str]:
    volts = np.repeat([0.0, *rng.uniform(-1.4, 1.4, steps - 1)], 25)
    return SAMPLE * np.arange(len(volts)), volts, "previous"


def others(rng: np.random.Generator) -> dict[str, tuple[Any, Any, str]]:
    t = np.arange(0, 5, SAMPLE)
    rates = rng.uniform(0.3, 3.0, 3)
    sines = sum(np.sin(2 * np.pi * (f * t + rng.uniform())) for f in rates) * 0.4
    chirp = rng.uniform(0.8, 1.4) * np.sin(2 * np.pi * (0.2 * t + rng.uniform(0.2, 0.6) * t**2))
    points = rng.uniform(-1.4, 1.4, 14)
    lines = np.interp(t, np.linspace(0, 5, 14), points)
    return {n: (t, u, "linear") for n, u in (("sines", sines), ("chirp", chirp), ("lines", lines))}


def measured(plant: pam.Plant, signal: Any, rng: np.random.Generator) -> pam.Trajectory:
    t, volts, between = signal
    run = pam.simulate(
        plant, {"difference": volts}, t=t, dead_times="exact", rtol=1e-9,
        interpolation=between, start=plant.equilibrium(difference=float(volts[0])),
    )  # fmt: skip
    columns = {n: run[n] + e * rng.standard_normal(len(t)) for n, e in NOISE.items()}
    variables = [plant.variable(n) for n in ("difference", *OUTPUTS)]
    return pam.Trajectory(t, {"difference": volts, **columns}, variables, between)


def true_values(values: dict[str, float]) -> dict[str, float]:
    last = {"base": "base_pressure", "friction": "friction_constant", "dead_time": "delay"}
    return {last.get(n, n): v for n, v in values.items()}


def one(rng: np.random.Generator, options: dict[str, Any]) -> tuple[int, int]:
    """(parameters, those outside of their 95 % intervals) of a random rig."""
    values = {n: float(rng.uniform(*r)) for n, r in RANGES.items()}
    mass = float(rng.uniform(1.0, 4.0))
    plant = rig(values, mass)
    records = [measured(plant, staircase(rng), rng) for _ in range(2)]
    begin = time.process_time()
    fit = pam.fit_free_run(
        rig(GUESS, mass), records, FREE, horizon=None, outputs=OUTPUTS, delay=(0.0, 0.05), **options
    )
    spent = time.process_time() - begin
    print(f"rig of {mass:.2f} kg: {spent:.1f} s of the processor, steps {fit.options['steps']}")
    print(f"    {fit.status}; at the edge: {fit.at_bound or 'none'}")
    for name, error in fit.integration_error.items():
        print(f"    halving the step moves {name} by {error:.2g}, noise {NOISE[name]:.2g}")
    outside, truth = 0, true_values(values)
    for name, c in fit.coefficients.items():
        true = truth[name.rpartition(".")[2]]
        low, high = fit.interval(name)
        off = (c.value - true) / c.stderr
        outside += not low <= true <= high
        said = "" if low <= true <= high else "  OUTSIDE"
        print(f"    {name}: {c.value:.6g} +- {c.stderr:.2g}, true {true:.6g}: {off:+.1f}{said}")
    for name, signal in others(rng).items():
        clean = measured(plant, signal, rng)
        run = fit.validate(clean)
        kept = {n: 1 - (e / np.std(clean[n])) ** 2 for n, e in run.rmse.items()}
        said = ", ".join(f"{n} {100 * k:.3f} %" for n, k in kept.items())
        print(f"    {name}: {said}", flush=True)
    return len(fit.coefficients), outside


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seed", type=int, default=time.time_ns() // 10**9)
    options.add_argument("--rigs", type=int, default=4)
    options.add_argument("--steps", type=int, help="of the integration; by default as chosen")
    given = options.parse_args()
    warnings.simplefilter("ignore")
    print("seed", given.seed)
    chosen = {} if given.steps is None else {"steps": given.steps}
    found = [one(np.random.default_rng([given.seed, k]), chosen) for k in range(given.rigs)]
    total, outside = (sum(c) for c in zip(*found, strict=True))
    print(f"{outside} of {total} parameters outside their 95 % intervals")


if __name__ == "__main__":
    main()
