"""Muscle and lever chosen together: which muscle on which radius turns a joint the quickest?

A short radius gives a wide angle and little torque, a long one the other way round; which is right
depends on the muscle, its length and the inertia. The planner chooses the radius with the motion;
the muscles of the catalogue are tried one by one, and each radius by itself for comparison.
"""

import numpy as np

import pam_ocp as pam

STOPS = [{"theta": -0.4}, {"theta": 0.4}]
METHOD = pam.Collocation(15, 3)


def joint(muscle: pam.Muscle) -> pam.Plant:
    return pam.AntagonisticJoint(muscle, inertia=0.25, moment_arm=0.04, damping=0.5)


# %%
# The radii of flexor and extensor are parameters: the planner may choose them within a range.

NAMES = ["DMSP-20-200N", "DMSP-20-300", "DMSP-20-400N"]
RADII = ("muscle1.radius", "muscle2.radius")
figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.5))
for name in NAMES:
    plant = joint(pam.muscle(name))
    ranges = dict.fromkeys(RADII, (0.02, 0.12))
    chosen = pam.plan(plant, STOPS, cyclic=True, design=ranges, method=METHOD)
    radius = float(np.mean([chosen.design[n] for n in RADII]))
    print(f"{name}: radius {1e3 * radius:.1f} mm, a cycle takes {chosen.duration:.3f} s")

    # each radius by itself: the planner is built once
    planner = pam.Planner(plant, STOPS, cyclic=True, method=METHOD)
    radii, durations = radius * np.linspace(0.8, 1.25, 7), []
    for r in radii:
        try:
            durations.append(planner(values=dict.fromkeys(RADII, r)).duration)
        except pam.PlanError:
            durations.append(np.nan)
    (line,) = axes.plot(1e3 * radii, durations, ".-", label=name)
    axes.plot(1e3 * radius, chosen.duration, "o", ms=10, color=line.get_color(), fillstyle="none")
axes.set(xlabel="radius [mm]", ylabel="shortest cycle [s]", title="rings: chosen with the motion")
axes.legend()
figure.savefig("muscle_and_lever.png", dpi=120)
