"""A spring that nobody modelled, learned from records: what it does to an optimal motion.

A load of 10 kg hangs on a muscle, and on something that hardens as it is drawn (a cable duct). The
model knows muscle, load and regulator, not the duct. Its damping and lag are fitted to four records
of the position and the pressure; what is left is learned as a function of position and speed, of
which cross-validation says whether it is worth having. Motions in least time are then planned with
both models, and their commands are given to the rig itself.

Run:  python examples/learned_residual.py [folder for the results]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pam_ocp as pam
from pam_ocp.fitting import Residual, Splines, fit_residual

STEP, BAR = 0.01, 1e5
MEASURED = {"x": 2e-5, "muscle.pressure": 300.0}
"""What is measured, with the noise of its sensor."""


def load() -> pam.Plant:
    """What is known."""
    return pam.HangingLoad("DMSP-20-300", 10.0, damping=150.0, feed=pam.feeds.Regulator(lag=0.05))


def rig() -> pam.Plant:
    """What is there: up to 40 N more at 40 mm."""
    known = load()
    return known.with_terms(lambda _: {"v": -4.0 * (known.expression("x") / 0.04) ** 3})


def record(plant: pam.Plant, seed: int) -> pam.Trajectory:
    """Three seconds from rest, with commands that are held for a quarter of a second."""
    random, t = np.random.default_rng(seed), STEP * np.arange(301)
    u = np.repeat(random.uniform(2 * BAR, 4.5 * BAR, 13), 25)[: len(t)]
    rest = plant.equilibrium({"muscle.command": u[0]})
    run = pam.simulate(plant, {"muscle.command": u}, t=t, start=rest)
    columns = {n: run[n] + noise * random.standard_normal(len(t)) for n, noise in MEASURED.items()}
    names = ("muscle.command", *MEASURED)
    columns["muscle.command"] = u
    return pam.Trajectory(t, {n: columns[n] for n in names}, map(plant.variable, names), "previous")


def main(folder: Path) -> None:
    true = rig()
    records = [record(true, seed) for seed in range(4)]
    physics = pam.fit_free_run(
        load(), records, ["damping", "muscle.lag"], horizon=0.5, every=0.25, judge=False
    )
    lacking = Residual("v", ["x", "v"], Splines(5))
    learned = fit_residual(physics, lacking, folds=4, strengths=[1e-2, 1e-3, 1e-4])
    print(learned)
    test = [record(true, seed) for seed in (10, 11)]
    band = learned.predict(test)
    before, after = physics.validate(test).rmse["x"], band.run.rmse["x"]
    print(f"new records: {1e3 * before:.2f} mm by the physics, {1e3 * after:.2f} mm with what is")
    print(f"learned; {band.coverage['x']:.0%} of them lie in its 90 % bands")

    figure, axes = plt.subplots(figsize=(7, 4))
    for name, plant in (("physics", physics.plant), ("learned", learned.plant)):
        plan = pam.plan(plant, stops=[{"x": 0.02}, {"x": 0.045}], minimise="time")
        inputs, start = plan.trajectory, true.equilibrium(x=0.02)
        replay = pam.simulate(true, inputs, duration=plan.duration, start=start)
        off = 1e3 * (replay["x"][-1] - 0.045)
        print(f"planned by {name}: {plan.duration:.3f} s, on the rig {off:+.2f} mm from its end")
        axes.plot(1e3 * replay.t, 1e3 * replay["x"], label=f"rig, planned by {name}")
    axes.axhline(45.0, color="grey", linewidth=0.8)
    axes.set(xlabel="time [ms]", ylabel="position [mm]")
    axes.legend()
    figure.savefig(folder / "learned_residual.png", dpi=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path())
