"""A spring over the muscle: one muscle moves a load both ways.

A muscle only pulls. A spring around it stretches it back, so that venting moves the load the other
way, as far and as fast as the spring is strong. How stiff should it be? Each spring costs stroke on
the way up, and gives acceleration on the way down.
"""

import numpy as np

import pam_ocp as pam

plant = pam.SpringOverMuscle("DMSP-20-300", mass=4.0, spring_stiffness=4e3, preload=150.0)
print(plant.equilibrium({"muscle.command": 3e5}))

# %%
# The stroke over the pressure, for three springs.

figure, ((stroke, quickest),) = pam.figures.new_figure(1, 2, size=(9.0, 4.0))
for stiffness in (2e3, 4e3, 8e3):
    sprung = plant.with_values(spring_stiffness=stiffness)
    path = pam.operating.equilibrium_path(sprung, "muscle.command", np.linspace(1.2e5, 6e5, 25))
    pressure = [point["muscle.command"] / 1e5 for point in path.points]
    stroke.plot(pressure, [1e3 * p["x"] for p in path.points], label=f"{stiffness / 1e3:g} N/mm")
stroke.set(xlabel="pressure [bar]", ylabel="x [mm]", title="rest")
stroke.legend(title="spring")

# %%
# There and back between 10 and 30 mm in the shortest time: the way back is the spring's.

stiffnesses = np.geomspace(1.5e3, 8e3, 6)
planner = pam.Planner(plant, [{"x": 0.010}, {"x": 0.030}], cyclic=True, minimise="time")
legs = np.array([planner(values={"spring_stiffness": k}).durations for k in stiffnesses])
quickest.plot(stiffnesses / 1e3, 1e3 * legs[:, 0], "o-", label="up")
quickest.plot(stiffnesses / 1e3, 1e3 * legs[:, 1], "o-", label="back")
quickest.plot(stiffnesses / 1e3, 1e3 * legs.sum(axis=1), "ko-", label="both")
quickest.set(xlabel="spring [N/mm]", ylabel="duration [ms]", title="the quickest motion")
quickest.legend()
figure.savefig("spring_over_muscle.png", dpi=120)
best = stiffnesses[np.argmin(legs.sum(axis=1))]
print(f"the quickest of these springs: {best / 1e3:.1f} N/mm")
