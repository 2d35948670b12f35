"""Static optimisation, against the equation of a pendulum and the muscles' own law."""

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.plants import LimbMuscle

G = 9.80665
SIDES = (("flexor", 1), ("extensor", -1))
PENDULUM = """<robot name="limb"><link name="base"/>
<link name="bar"><inertial><origin xyz="0 0 -0.2" rpy="0 0 0"/><mass value="1.5"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute"><parent link="base"/><child link="bar"/>
<axis xyz="0 -1 0"/><limit lower="-1" upper="1" effort="0" velocity="0"/></joint></robot>"""


def pair(tmp_path):
    (tmp_path / "limb.urdf").write_text(PENDULUM)
    feed = pam.feeds.Regulator(0.05, max_pressure=5e5)  # less than the muscle's own 6.75 bar
    muscles = [
        LimbMuscle(n, "DMSP-20-300", [("a", 0.04 * s)], pre_contraction=0.1, feed=feed)
        for n, s in SIDES
    ]
    return pam.plants.limb(tmp_path / "limb.urdf", muscles, damping={"a": 0.3})


def test_static_optimisation_gives_the_moment_of_a_pendulum_with_the_stiffness_asked_for(tmp_path):
    plant = pair(tmp_path)
    angles, speeds = np.array([0.0, 0.2, 0.3]), np.array([0.0, 1.0, -1.0])
    found = plant.static_optimisation(
        {"a": angles}, {"a": speeds}, {"a": 5.0}, stiffness={"a": [25.0, 30.0, 35.0]}
    )
    assert found.reached.all()
    assert found.verdict == "reached at all 3 instants"
    needed = (0.02 + 1.5 * 0.04) * 5.0 + 0.3 * speeds + 1.5 * G * 0.2 * np.sin(angles)
    np.testing.assert_allclose(found.moments["a"], needed, rtol=1e-12)
    muscle = pam.muscle("DMSP-20-300")
    kappa = {n: 0.1 + s * 0.04 * angles / muscle.rest_length for n, s in SIDES}
    forces = {n: muscle.force(found.pressures[n], kappa[n]) for n in kappa}
    np.testing.assert_allclose(0.04 * (forces["flexor"] - forces["extensor"]), needed, atol=1e-5)
    stiff = sum(muscle.stiffness(found.pressures[n], kappa[n]) for n in kappa) * 0.04**2
    np.testing.assert_allclose(stiff, [25.0, 30.0, 35.0], rtol=1e-5)


@pytest.mark.parametrize("minimise", ["stiffness", "force", "air"])
def test_the_least_co_contraction_leaves_the_antagonist_just_taut(tmp_path, minimise):
    found = pair(tmp_path).static_optimisation({"a": 0.2}, minimise=minimise)
    assert found.reached.all()
    assert found.forces["extensor"][0] == pytest.approx(1.0, abs=1e-3)  # the clamp's width
    assert found.forces["flexor"][0] > 1.5 * G * 0.2 * np.sin(0.2) / 0.04
    assert found.moments["a"] == pytest.approx(1.5 * G * 0.2 * np.sin(0.2))  # at rest: gravity's


def test_static_optimisation_says_what_is_out_of_reach(tmp_path):
    plant = pair(tmp_path)
    found = plant.static_optimisation({"a": 0.0}, accelerations={"a": [0.0, 1e4]})
    assert list(found.reached) == [True, False]
    full = pam.muscle("DMSP-20-300").force(5e5, 0.1)
    largest = 0.04 * (full - 1.0)  # the other just taut
    short = 0.08 * 1e4 - largest
    assert found.missing["a"] == pytest.approx([0.0, short], rel=1e-4)
    assert "NOT REACHED at 1 of 2 instants: a lacks a moment of" in found.verdict
    stiff = plant.static_optimisation({"a": 0.0}, stiffness={"a": 1e4})
    assert "a has a stiffness of" in stiff.verdict
    assert stiff.missing["a"] == pytest.approx(0.0)
    assert stiff.stiffness["a"][0] < 1e3


def test_static_optimisation_refuses_what_it_does_not_know(tmp_path):
    plant = pair(tmp_path)
    refused(r"unknown minimise 'time'", plant.static_optimisation, {"a": 0.0}, minimise="time")
    refused("unknown joint of limb 'limb' 'b'", plant.static_optimisation, {"b": 0.0})
    with pytest.raises(pam.InputError, match="one for each instant"):
        plant.static_optimisation({"a": [0.0, 0.1]}, {"a": [0.0, 0.1, 0.2]})
