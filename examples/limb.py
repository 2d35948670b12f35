"""An arm of seven joints from a URDF file, moved by fourteen muscles.

A limb is a plant as all others: it rests, moves, is linearised, planned and exported. Pairs pull
over pulleys at the shoulder and the forearm; the biceps spans the elbow in a straight line, and
four muscles at the wrist lead their cords through via points over both its joints.

Run:  python examples/limb.py [folder for the results]
"""

import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam

REACH = {
    "shoulder_flexion": 0.5,
    "shoulder_abduction": 0.3,
    "shoulder_rotation": 0.2,
    "elbow": 0.8,
    "forearm_rotation": 0.3,
    "wrist_flexion": 0.2,
    "wrist_deviation": 0.1,
}
HANG = dict.fromkeys(REACH, 0.0) | {"elbow": 0.2}


def seven_joint_arm(feed: pam.feeds.Feed | None = None) -> pam.plants.Limb:
    """Points are (link, (x, y, z)) in metres, pulleys (joint, radius)."""
    large, small = pam.muscle("DMSP-20-400N"), pam.muscle("DMSP-20-200N")
    paths = {
        "deltoid_front": (large, [("shoulder_flexion", 0.05)], 0.12),
        "deltoid_rear": (large, [("shoulder_flexion", -0.05)], 0.12),
        "abductor": (large, [("shoulder_abduction", 0.05)], 0.12),
        "adductor": (large, [("shoulder_abduction", -0.05)], 0.12),
        "inner_rotator": (large, [("shoulder_rotation", 0.025)], 0.12),
        "outer_rotator": (large, [("shoulder_rotation", -0.025)], 0.12),
        "biceps": (large, [("upper_arm", (0.05, 0, 0.05)), ("elbow_fork", (0.04, 0, -0.05))], 0.05),
        "triceps": (large, [("elbow", -0.02)], 0.15),
        "pronator": (small, [("forearm_rotation", 0.02)], 0.12),
        "supinator": (small, [("forearm_rotation", -0.02)], 0.12),
    }
    wrist = {"flexor": (0.02, 0), "extensor": (-0.02, 0), "radial": (0, 0.02), "ulnar": (0, -0.02)}
    for name, (x, y) in wrist.items():
        path = [("forearm", (x, y, 0.0)), ("forearm", (x, y, -0.16)), ("hand", (x, y, -0.03))]
        paths[name] = (small, path, 0.12)
    muscles = [
        pam.plants.LimbMuscle(name, muscle, path, pre_contraction=k0, feed=feed)
        for name, (muscle, path, k0) in paths.items()
    ]
    return pam.plants.limb("arm.urdf", muscles)


def main(folder: Path) -> None:
    arm = seven_joint_arm()
    print(arm)
    arm.plot(REACH | {"biceps.pressure": 3e5}).savefig(folder / "arm.png", dpi=120)

    # which pressures hold the arm while the elbow bends; the shoulder stiffer than need be
    elbow = np.linspace(0.2, 0.8, 7)
    posture = REACH | {"elbow": elbow}
    least = arm.static_optimisation(posture)
    print(least.verdict)
    wanted = {"shoulder_flexion": 1.2 * least.stiffness["shoulder_flexion"]}
    stiff = arm.static_optimisation(posture, stiffness=wanted)
    print(np.round(stiff.pressures["deltoid_rear"] / 1e5, 2), "bar in the rear:", stiff.verdict)

    held = {f"{name}.pressure": p[-1] for name, p in stiff.pressures.items()}
    commands = {f"{name}.command": p[-1] for name, p in stiff.pressures.items()}
    run = pam.simulate(arm, commands, start=REACH | held, t=np.linspace(0.0, 1.0, 101))
    print(f"it stays within {max(np.ptp(run[joint]) for joint in REACH):.1e} rad")

    plan = pam.plan(
        arm,
        stops=[HANG, REACH],
        duration=0.6,
        minimise="effort",
        method=pam.Collocation(intervals=16, degree=6),
    )
    print(plan)
    arm.animate(plan.trajectory, folder / "arm.gif", colour="pressure")


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "limb")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
