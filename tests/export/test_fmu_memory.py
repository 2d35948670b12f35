"""Losses with memory and the muscle's body through FMPy, both modes."""

from dataclasses import replace

import numpy as np
import pytest

import pam_ocp as pam

L = pam.losses


@pytest.mark.slow
def test_every_loss_and_the_body_run_in_an_fmu_as_here(tmp_path):
    known = pam.muscle("DMSP-20-200N")
    law = pam.laws.with_ends(pam.laws.with_bladder(known.law, 2e4), 0.05, 1.03, 60.0)
    muscle = replace(known, law=law, mass_per_length=0.2, end_mass=0.1, pull_off=2e3)
    losses = (
        L.PrandtlIshlinskii((4.0, 3.0), (3.0, 2.0), (0.004, 0.02), per_pressure=2e-6),
        L.BoucWen(5.0, per_pressure=2e-6),
        L.MaxwellSlip((3.0, 2.0), (0.005, 0.02), per_pressure=2e-6),
        L.StrandFriction(0.05),
        L.ForceVelocity(),
        L.LoadCreep(),
        L.Preconditioning(),
    )
    plant = pam.HangingLoad(muscle, 10.0, losses=losses)
    plant = plant.with_values(plant.equilibrium({"muscle.command": 2.6e5}))
    t = np.linspace(0.0, 1.5, 151)
    command = 2.6e5 + 7e4 * np.sin(6 * t) * np.cos(2 * t)
    given = pam.Trajectory(t, {"muscle.command": command}, [plant.variable("muscle.command")])
    motion = pam.simulate(plant, inputs=given)
    check = pam.check_fmu(pam.export_fmu(plant, tmp_path / "memory.fmu"), against=motion)
    assert check.ok, str(check)
