"""A load of your own: a magnet that holds the slide in the middle.

A load is a small class with one method, `force`. Registered, it is known to problem files and the
command line, too; without that, it can be given to every arrangement.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import pam_ocp as pam

# %%
# A force along the coordinate at which it acts, with its constants as parameters of the plant.


@dataclass(frozen=True)
class Magnet:
    """F = -pull q/(1 + q^2), q = position/reach."""

    pull: float
    reach: float

    def force(self, plant: Any, at: pam.loads.Coordinate) -> ca.SX:
        pull = plant.parameter("magnet.pull", self.pull, unit="N", tunable=True)
        reach = plant.parameter("magnet.reach", self.reach, unit="m", min=1e-6)
        q = at.position / reach
        return -pull * q / (1 + q**2)


slide = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, loads=Magnet(pull=150.0, reach=0.004))
print(slide)

# %%
# The magnet stiffens the middle and softens what lies beside it.

figure, ((modes, plans),) = pam.figures.new_figure(1, 2, size=(10.0, 4.0))
places = np.linspace(-0.015, 0.015, 41)
for pull in (0.0, 75.0, 150.0):
    plant = slide.with_values({"magnet.pull": pull})
    points = [plant.equilibrium({"x": x, "stiffness": 2e4}) for x in places]
    slow = [pam.operating.modes(plant.linearize(point))[0][0] for point in points]
    modes.plot(1e3 * places, slow, label=f"{pull:g} N")
modes.set(xlabel="x [mm]", ylabel="natural frequency [Hz]")
modes.legend(title="pull")

# %%
# The quickest way through it: every verb takes the load as it is.

planner = pam.Planner(slide, [{"x": -0.010}, {"x": 0.010}])
for pull in (0.0, 75.0, 150.0):
    plan = planner(values={"magnet.pull": pull})
    motion = plan.trajectory
    plans.plot(1e3 * motion.t, 1e3 * motion["x"], label=f"{pull:g} N")
    print(f"{pull:g} N: {1e3 * plan.duration:.1f} ms")
plans.set(xlabel="t [ms]", ylabel="x [mm]")
figure.savefig("own_load.png", dpi=120)
