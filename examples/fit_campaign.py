"""A static campaign and a set of holds: from a folder of tables to muscles, from rest to a spring.

Usage: python fit_campaign.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import pam_ocp as pam
from pam_ocp.fitting import fit_holds

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "campaign")
rig = folder / "rig"
rig.mkdir(parents=True, exist_ok=True)

# ---- a rig: two lengths, filled and vented, each twice ----
random = np.random.default_rng(2)
law = pam.muscle("DMSP-20-300").law
levels = np.meshgrid(np.linspace(0.5e5, 6e5, 12), np.linspace(0, 0.2, 7))
pressure, kappa = (a.ravel() for a in levels)
for length in (200, 300):
    for branch, offset in (("filling", -6.0), ("venting", 6.0)):
        for run in (1, 2):
            force = law.tension(pressure, kappa) + offset + random.normal(0, 2, pressure.size)
            rows = zip(length * (1 - kappa), pressure / 1e5, np.maximum(force, 0), strict=True)
            text = "length [mm],pressure [bar],force [N]\n"
            text += "".join(f"{a:.3f},{b:.4f},{c:.2f}\n" for a, b, c in rows)
            (rig / f"DMSP-20-{length}_{branch}_run{run}.csv").write_text(text)

campaign = pam.fit_forces(rig, candidates=["six-parameter", "five-parameter"])
print(campaign.report())
campaign.save(folder / "campaign")

# ---- holds: a muscle inside a spring that nobody has measured ----
muscle = campaign["DMSP-20-300"].fit.muscle(diameter=0.020)
plant = pam.SpringOverMuscle(muscle, mass=2.0)
true = plant.with_values(spring_stiffness=4200.0, preload=140.0)
up = np.linspace(1.2e5, 5.5e5, 50)
p = np.concatenate([up, up[::-1][1:]])
side = np.repeat([1.0, -1.0], [50, 49])
x = np.array([true.equilibrium({"muscle.pressure": v})["x"] for v in p])
x += -3e-4 * side + random.normal(0, 5e-5, p.size)
found = fit_holds(
    plant,
    {"muscle_pressure": p, "x": x, "side": side},
    ["spring_stiffness", "preload", "band.x"],
)
print(found.report())

# ---- figures ----
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for name, data in campaign.plot_data().items():
    left.plot(data["fitted"], data["residual"], ".", label=name)
left.set(xlabel="fitted force [N]", ylabel="measured - fitted [N]")
left.legend()
for way, words in ((1, "from below"), (-1, "from above")):
    own = side == way
    right.plot(p[own] / 1e5, 1e3 * x[own], ".", label=words)
    right.plot(p[own] / 1e5, 1e3 * found.predicted["x"][own], "k-", lw=0.8)
right.set(xlabel="pressure [bar]", ylabel="contraction [mm]")
right.legend()
figure.savefig(folder / "campaign.png", dpi=120)
