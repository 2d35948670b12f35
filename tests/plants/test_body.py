"""The muscle's own body in plants: mass, dead pressure, strength."""

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import rates_and_outputs
from scipy.optimize import brentq

import pam_ocp as pam

MUSCLE = pam.muscle("DMSP-20-200N")
HEAVY = replace(MUSCLE, mass_per_length=0.3, end_mass=0.2)
BODY = 0.2 * 0.3 + 0.2
G = 9.80665
IDEAL = pam.feeds.IdealPressure()


def acceleration(plant, **at):
    """der of the velocity of the first position, at states and inputs by name."""
    rates, _ = rates_and_outputs(plant, {n.replace("_", "."): v for n, v in at.items()})
    return rates[next(iter(plant.positions.values()))]


# ---- mass ----------------------------------------------------------------------------------------


def test_half_the_body_moves_and_hangs_with_a_load():
    pull = float(MUSCLE.force(3e5, 0.1))
    for inclination, share in ((None, 1.0), (0.5, math.sin(0.5))):
        plant = pam.HangingLoad(HEAVY, 8.0, damping=30.0, feed=IDEAL, inclination=inclination)
        m = 8.0 + BODY / 2
        expected = (pull - m * G * share - 30.0 * 0.1) / m
        assert acceleration(plant, x=0.02, v=0.1, muscle_pressure=3e5) == pytest.approx(expected)
    spring = pam.SpringOverMuscle(HEAVY, 8.0, 4e3, 50.0, inclination=0.3, damping=30.0, feed=IDEAL)
    against = 50 + 4e3 * 0.02 + m * G * math.sin(0.3) + 3.0
    found = acceleration(spring, x=0.02, v=0.1, muscle_pressure=3e5)
    assert found == pytest.approx((pull - against) / m)


def test_both_bodies_of_a_pair_move_with_it():
    slide = pam.AntagonisticSlide(HEAVY, 2.0, 0.1, damping=20.0, feed=IDEAL)
    pressures = {"muscle1_pressure": 3e5, "muscle2_pressure": 2e5}
    one, two = float(MUSCLE.force(3e5, 0.15)), float(MUSCLE.force(2e5, 0.05))
    expected = (one - two - 20 * 0.1) / (2.0 + BODY)
    assert acceleration(slide, x=0.01, v=0.1, **pressures) == pytest.approx(expected)


def test_on_a_lever_a_body_has_the_inertia_and_the_torque_of_its_kinetic_energy():
    # T = m s'(theta)^2 theta'^2/2 for the half m of each: by Lagrange, with differences
    arm = lambda angle: 0.03 + 0.01 * angle  # noqa: E731
    joint = pam.AntagonisticJoint(HEAVY, 0.05, arm, 0.1, damping=0.2, feed=IDEAL)
    light = pam.AntagonisticJoint(MUSCLE, 0.05, arm, 0.1, damping=0.2, feed=IDEAL)
    at = {"theta": 0.2, "omega": 1.5, "muscle1_pressure": 3e5, "muscle2_pressure": 2e5}
    torque = 0.05 * acceleration(light, **at)
    m, h = BODY, 1e-6  # two halves, both with this arm
    inertia = lambda angle: m * arm(angle) ** 2  # noqa: E731
    slope = (inertia(0.2 + h) - inertia(0.2 - h)) / (2 * h)
    expected = (torque - 0.5 * slope * 1.5**2) / (0.05 + inertia(0.2))
    assert acceleration(joint, **at) == pytest.approx(expected, rel=1e-6)


def test_on_a_tendon_the_body_moves_with_the_muscle():
    plant = pam.SeriesLoad(HEAVY, 8.0, fitting_mass=0.2, damping=50.0, feed=IDEAL)
    at = {"x": 0.02, "muscle.shortening": 0.021, "muscle.pressure": 3e5}
    pull = float(MUSCLE.force(3e5, 0.021 / 0.2)) - 1e5 * 0.001
    expected = (pull - BODY / 2 * G) / (0.2 + BODY / 2)
    assert rates_and_outputs(plant, at)[0]["muscle.velocity"] == pytest.approx(expected)


def test_a_muscle_without_body_leaves_a_plant_as_it_is():
    names = [v.name for v in pam.HangingLoad(MUSCLE).variables]
    assert not any("mass_per_length" in n or "own_mass" in n or "to_burst" in n for n in names)


def test_energy_and_power_per_mass_are_those_of_the_body():
    plant = pam.HangingLoad(HEAVY, 8.0, feed=pam.feeds.Regulator(totals=True))
    motion = pam.simulate(plant, inputs={"muscle.command": 3e5}, duration=0.3)
    assert motion["muscle.power_per_mass"] == pytest.approx(motion["muscle.power"] / BODY)
    assert motion["muscle.work_per_mass"] == pytest.approx(motion["muscle.work"] / BODY)
    stroke = pam.simulation.stroke_work(motion)["muscle"]
    assert stroke.work_per_mass == pytest.approx(stroke.work / BODY)


# ---- bladder -------------------------------------------------------------------------------------


def test_rest_under_a_dead_pressure_is_where_the_pull_carries_the_load():
    muscle = replace(MUSCLE, law=pam.laws.with_bladder(MUSCLE.law, 5e4))
    point = pam.HangingLoad(muscle, 10.0).equilibrium({"muscle.command": 3e5})
    pull = lambda k: float(MUSCLE.tension(2.5e5, k)) - 10 * G  # noqa: E731
    assert point["muscle.contraction"] == pytest.approx(brentq(pull, 0, 0.25), rel=1e-9)


# ---- strength ------------------------------------------------------------------------------------


def test_plans_keep_below_burst_and_pull_off():
    strong = pam.HangingLoad(replace(MUSCLE, burst_pressure=8e5, pull_off=2000.0), 10.0)
    weak = pam.HangingLoad(replace(MUSCLE, burst_pressure=8e5, pull_off=150.0), 10.0)
    stops = [{"x": 0.01}, {"x": 0.025}]
    quick, careful = (pam.plan(p, stops=stops, minimise="time") for p in (strong, weak))
    assert np.max(quick.trajectory["muscle.force"]) > 160.0
    assert np.max(careful.trajectory["muscle.force"]) < 150.0 * 1.001
    assert careful.duration > quick.duration
