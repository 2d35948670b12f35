"""A joint that moves and stiffens independently of each other.

Two muscles give two freedoms: their difference turns the joint, their sum stiffens it. For the
six-parameter law the pressures for a torque and a stiffness are the solution of two linear
equations; a controller with the exact inverse follows a move while the stiffness goes its own way.
"""

import numpy as np

import pam_ocp as pam

joint = pam.AntagonisticJoint(
    "DMSP-20-300", inertia=0.08, moment_arm=0.04, damping=0.5, feed=pam.feeds.Regulator(lag=0.03)
)
allocation = pam.operating.Allocation(joint)

# %%
# What is attainable: torque and stiffness, at three angles.

figure, ((reach, motion),) = pam.figures.new_figure(1, 2, size=(10.0, 4.0))
for theta in (-0.3, 0.0, 0.3):
    torques = np.linspace(*allocation.effort_range(theta), 60)[1:-1]
    ends = np.array([allocation.stiffness_range(theta, torque, taut=False) for torque in torques])
    reach.fill_between(torques, ends[:, 0], ends[:, 1], alpha=0.3, label=f"{theta:g} rad")
reach.set(xlabel="torque [N m]", ylabel="stiffness [N m/rad]", title="within 0 .. 6 bar")
reach.legend()

# %%
# The joint goes back and forth; every second the stiffness changes, too.


def angle(t: float) -> tuple[float, float, float]:
    """A sine of half a hertz: position, velocity, acceleration."""
    w = np.pi
    return 0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t), -0.3 * w**2 * np.sin(w * t)


def stiffness(t: float) -> float:
    return 30.0 if t % 2.0 < 1.0 else 45.0


controller = pam.control.PositionController(
    joint,
    angle,
    pam.control.PID.placed(6.0),
    sample_time=2e-3,
    stiffness=stiffness,
    inner=pam.control.PressureLoop(joint, time_constant=0.01),
)
start = joint.equilibrium(theta=0.0, stiffness=30.0)
loop = pam.closed_loop(controller, joint, duration=4.0, start=start)
error = loop["theta"] - np.array([angle(t)[0] for t in loop.t])
print(f"angle missed by {np.degrees(np.abs(error[loop.t > 0.5]).max()):.2f} degrees at most")
motion.plot(loop.t, np.degrees(loop["theta"]), label="angle [deg]")
motion.plot(loop.t, loop["stiffness"], label="stiffness [N m/rad]")
motion.plot(loop.t, [stiffness(t) for t in loop.t], "k:", label="stiffness wanted")
motion.set(xlabel="t [s]", title="both at once")
motion.legend()
figure.savefig("joint_stiffness.png", dpi=120)
