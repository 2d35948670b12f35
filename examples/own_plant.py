"""A plant of your own: a muscle swings a pendulum against gravity. Every verb works on it.

Run:  python examples/own_plant.py [folder for the results]
"""

import sys
from pathlib import Path

import casadi as ca

import pam_ocp as pam


def pendulum(muscle: pam.Muscle) -> pam.Plant:
    """m L^2 theta'' = r F - m g L sin(theta) - c theta',
    the muscle pulling on a lever of radius r.
    """
    plant = pam.Plant("pendulum", "a pneumatic muscle swinging a pendulum")
    theta = plant.state("theta", unit="rad", min=-0.3, max=1.2, description="angle from below")
    omega = plant.state("omega", unit="rad/s", description="angular velocity")
    mass = plant.parameter("mass", 3.0, unit="kg", min=1e-6, tunable=True, description="bob")
    length = plant.parameter("length", 0.40, unit="m", min=1e-6, description="of the rod")
    radius = plant.parameter("radius", 0.04, unit="m", min=1e-6, description="of the lever")
    friction = plant.parameter(
        "friction", 0.3, unit="N.m.s/rad", min=0.0, description="of the joint"
    )
    muscle1 = plant.add_muscle(
        "muscle", muscle, shortening=radius * theta, rate=radius * omega, pre_contraction=0.05
    )
    torque = radius * muscle1.force
    plant.der(theta, omega)
    weight = mass * 9.80665 * length * ca.sin(theta)
    plant.der(omega, (torque - weight - friction * omega) / (mass * length**2))
    plant.output("torque", torque, unit="N.m", description="of the muscle on the joint")
    return plant


def main(folder: Path) -> None:
    plant = pendulum(pam.muscle("DMSP-20-400N"))
    print(plant)

    swing = pam.plan(plant, stops=[{"theta": 0.2}, {"theta": 1.0}], cyclic=True, minimise="time")
    print(swing)
    swing.trajectory.plot().savefig(folder / "pendulum.png", dpi=120)

    raised = plant.equilibrium(theta=1.0)
    system = plant.linearize(raised, outputs=["theta"])
    print("raised at 1 rad by", plant.variable("muscle.command").shown(raised["muscle.command"]))
    print("natural frequency and damping ratio there:", pam.operating.modes(system))

    replay = pam.simulate(plant, inputs=swing.trajectory)
    fmu = pam.export_fmu(plant, folder / "pendulum.fmu", platforms=["native"])
    print(pam.check_fmu(fmu, against=replay))


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "pendulum")
    target.mkdir(parents=True, exist_ok=True)
    main(target)
