"""Seven joints in a row, two muscles each: a plant of 28 states, declared in a loop.

Links that follow each other are coupled by torsion springs, as the segments of a soft arm are. The
motion of least effort from one posture to another is planned and verified; its picture has the
curves by joint.

Run:  python examples/seven_joints.py [folder for the results]
"""

import sys
from pathlib import Path

import pam_ocp as pam

JOINTS = 7


def row_of_joints(muscle: pam.Muscle, joints: int = JOINTS) -> pam.Plant:
    """J w_i' = r (F_flexor - F_extensor) - d w_i - k (2 q_i - q_(i-1) - q_(i+1)), the ends free."""
    plant = pam.Plant("row_of_joints", "joints coupled by springs, a pair of muscles at each")
    inertia = plant.parameter("inertia", 0.05, unit="kg.m2", min=1e-6, description="of a link")
    damping = plant.parameter("damping", 0.5, unit="N.m.s/rad", min=0.0, description="of a joint")
    spring = plant.parameter("spring", 5.0, unit="N.m/rad", min=0.0, description="between links")
    radius = 0.03
    angles, speeds, torques = [], [], []
    for i in range(1, joints + 1):
        q = plant.state(f"joint{i}.angle", unit="rad", min=-0.5, max=0.5)
        w = plant.state(f"joint{i}.speed", unit="rad/s")
        forces = [
            plant.add_muscle(
                f"joint{i}.{name}",
                muscle,
                shortening=sign * radius * q,
                rate=sign * radius * w,
                pre_contraction=0.1,
            ).force
            for name, sign in (("flexor", 1), ("extensor", -1))
        ]
        angles.append(q)
        speeds.append(w)
        torques.append(radius * (forces[0] - forces[1]))
    for i, (q, w, torque) in enumerate(zip(angles, speeds, torques, strict=True)):
        bent = sum(q - angles[j] for j in (i - 1, i + 1) if 0 <= j < joints)
        plant.der(q, w)
        plant.der(w, (torque - damping * w - spring * bent) / inertia)
    return plant


def main(folder: Path) -> None:
    plant = row_of_joints(pam.muscle("DMSP-20-200N"))
    low = {f"joint{i}.angle": -0.1 for i in range(1, JOINTS + 1)}
    high = {f"joint{i}.angle": 0.05 * i for i in range(1, JOINTS + 1)}
    plan = pam.plan(plant, [low, high], duration=0.4, minimise="effort")
    print(plan)
    plan.plot().savefig(folder / "seven_joints.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "seven_joints")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
