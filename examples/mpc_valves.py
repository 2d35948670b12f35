"""Model predictive control through spool valves, against the FMU of a plant that is heavier.

The valves stay closed over 10 % of their travel to either side. The controller chooses openings,
in which the flow has a slope through zero, and sends the commands that make them. It believes the
slide to weigh 2 kg; the FMU moves 2.5 kg.
"""

import numpy as np

import pam_ocp as pam

slide = pam.AntagonisticSlide(
    "DMSP-20-200N",
    mass=2.0,
    pre_contraction=0.10,
    stroke=0.016,
    damping=20.0,
    feed=pam.feeds.SpoolValve(conductance=1e-8, overlap=0.10),
)
fmu = pam.export_fmu(slide, "valves.fmu", platforms=["native"])
rest = slide.equilibrium(x=0.0, stiffness=2.4e4)

# %%
# Position and stiffness are tracked; weights on the change of the openings leave no steady error.

controller = pam.Mpc(
    slide.with_values(rest),
    horizon=30,
    sample_time=0.005,
    track={"x": 1.0, "stiffness": 0.05},
    rate={"muscle1.opening": 0.02, "muscle2.opening": 0.02},
)


def wanted(t: float) -> float:
    """A square wave between two stops."""
    return 0.008 if t % 1.0 < 0.5 else -0.008


loop = controller.closed_loop(
    fmu,
    {"x": wanted, "stiffness": 2.4e4},
    duration=2.0,
    start=rest,
    parameters={"mass": 2.5},
)
print(loop)

# %%
# The commands jump over the dead zone (grey), as they must; the jumps are known ahead, so that the
# slide sets off before.

figure, axes = pam.figures.new_figure(3, size=(8.0, 7.0), sharex=True)
motion, pressure, command = axes.ravel()
motion.plot(loop.t, 1e3 * loop["x"], label="slide")
motion.step(loop.t, [1e3 * wanted(t) for t in loop.t], "k:", where="post", label="wanted")
motion.set(ylabel="x [mm]")
motion.legend(loc="lower right")
for name in ("muscle1", "muscle2"):
    pressure.plot(loop.t, loop[f"{name}.pressure"] / 1e5, label=name)
    command.step(loop.t, loop[f"{name}.command"], where="post", lw=0.8)
pressure.set(ylabel="pressure [bar]")
pressure.legend(loc="lower right")
command.axhspan(-0.1, 0.1, color="#bbbbbb", alpha=0.5, lw=0)
command.set(xlabel="t [s]", ylabel="command")
figure.savefig("mpc_valves.png", dpi=120)
held = (loop.t % 0.5 > 0.2) & (loop.t % 0.5 < 0.3)
error = np.abs(loop["x"] - [wanted(t) for t in loop.t])[held].max()
print(f"between the jumps it stands within {1e3 * error:.2f} mm")
