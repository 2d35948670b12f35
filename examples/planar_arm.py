"""A planar arm with two joints, flexor and extensor on each, built from the parts.

Shoulder and elbow turn in a vertical plane; each is moved by two muscles over pulleys. The plan
lifts the arm from hanging to reaching forward and comes to rest there.

Run:  python examples/planar_arm.py [folder for the results]
"""

import sys
from pathlib import Path

import casadi as ca

import pam_ocp as pam

GRAVITY = 9.80665


def planar_arm(muscle: pam.Muscle) -> pam.Plant:
    """M(q) q'' + h(q, q') + G(q) = tau - c q', the angles measured from hanging down."""
    arm = pam.Plant("planar_arm", "two joints, four muscles")
    q = [arm.state(f"q{i}", unit="rad", min=-0.9, max=0.9, nominal=0.3) for i in (1, 2)]
    w = [arm.state(f"w{i}", unit="rad/s", nominal=1.0) for i in (1, 2)]
    m = [
        arm.parameter(f"mass{i}", v, unit="kg", min=1e-6, tunable=True)
        for i, v in ((1, 1.0), (2, 0.8))
    ]
    length = [arm.parameter(f"length{i}", 0.3, unit="m", min=1e-6, nominal=0.1) for i in (1, 2)]
    radius = arm.parameter("radius", 0.035, unit="m", min=1e-6, nominal=0.01)
    friction = arm.parameter("friction", 0.4, unit="N.m.s/rad", min=0.0)

    torques = []
    for i in (0, 1):
        pull = 0
        for side, sign in (("flexor", 1), ("extensor", -1)):
            attached = arm.add_muscle(
                f"{side}{i + 1}",
                muscle,
                shortening=sign * radius * q[i],
                rate=sign * radius * w[i],
                pre_contraction=0.12,
            )
            pull += sign * radius * attached.force
        torques.append(arm.output(f"torque{i + 1}", pull, unit="N.m"))

    # slender links with their mass in the middle (any robotics textbook)
    c1, c2 = length[0] / 2, length[1] / 2
    i1, i2 = m[0] * length[0] ** 2 / 12, m[1] * length[1] ** 2 / 12
    coupling = m[1] * length[0] * c2
    m22 = i2 + m[1] * c2**2
    m12 = m22 + coupling * ca.cos(q[1])
    m11 = i1 + m[0] * c1**2 + m22 + m[1] * length[0] ** 2 + 2 * coupling * ca.cos(q[1])
    bend = coupling * ca.sin(q[1])
    hand = m[1] * GRAVITY * c2 * ca.sin(q[0] + q[1])
    weight = [(m[0] * c1 + m[1] * length[0]) * GRAVITY * ca.sin(q[0]) + hand, hand]
    rest = [
        torques[0] - friction * w[0] - weight[0] + bend * w[1] * (2 * w[0] + w[1]),
        torques[1] - friction * w[1] - weight[1] - bend * w[0] ** 2,
    ]
    det = m11 * m22 - m12**2
    for i in (0, 1):
        arm.der(q[i], w[i])
    arm.der(w[0], (m22 * rest[0] - m12 * rest[1]) / det)
    arm.der(w[1], (m11 * rest[1] - m12 * rest[0]) / det)
    return arm


def main(folder: Path) -> None:
    arm = planar_arm(pam.muscle("DMSP-20-400N"))
    print(arm)
    lift = pam.plan(
        arm, stops=[{"q1": 0.0, "q2": 0.0}, {"q1": 0.7, "q2": 0.6}], duration=(0.05, 2.0)
    )
    print(lift)
    lift.trajectory.plot(
        [
            "q1",
            "q2",
            "torque1",
            "torque2",
            "flexor1.command",
            "extensor1.command",
            "flexor2.command",
            "extensor2.command",
        ]
    ).savefig(folder / "arm.png", dpi=120)
    held = arm.equilibrium(
        {"q1": 0.7, "q2": 0.6, "extensor1.pressure": 2.5e5, "extensor2.pressure": 2.5e5}
    )
    for frequency, damping in pam.operating.modes(arm.linearize(held)):
        print(f"held there: {frequency:.2f} Hz, damping ratio {damping:.2f}")


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "planar_arm")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
