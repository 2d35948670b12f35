"""The muscle's own body: mass, dead pressure, ends, strength, several side by side."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import rates_and_outputs, refused
from scipy.integrate import quad
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp.muscles import gas, in_parallel
from pam_ocp.muscles.catalogue import attribution, attribution_table, muscle_names
from pam_ocp.muscles.validity import ValidityWarning, forget_warnings

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


# ---- bladder and ends ----------------------------------------------------------------------------


def test_below_its_dead_pressure_a_bladder_gives_nothing_and_above_as_much_less():
    law = pam.laws.with_bladder(MUSCLE.law, 4e4, 1e3)
    for p in (0.0, 2e4, 3.8e4):
        assert law.tension(p, 0.05) == pytest.approx(float(MUSCLE.law.tension(0.0, 0.05)))
    for p in (4.2e4, 3e5):
        assert law.tension(p, 0.05) == pytest.approx(float(MUSCLE.law.tension(p - 4e4, 0.05)))
    assert law.pressure(200.0, 0.1) == pytest.approx(float(MUSCLE.law.pressure(200.0, 0.1)) + 4e4)


def test_rigid_conical_ends_contract_less_and_a_fixed_tube_pushes_back():
    law = pam.laws.with_ends(MUSCLE.law, rigid=0.1, taper=1.05, tube=80.0)
    inner = 1.05 / 0.9 * 0.08
    expected = float(MUSCLE.law.tension(3e5, inner)) - 80.0 * 0.08
    assert law.tension(3e5, 0.08) == pytest.approx(expected)
    assert law.max_contraction(5e5) < float(MUSCLE.law.max_contraction(5e5))


def test_with_ends_and_bladder_muscle_and_gas_stay_consistent():
    law = pam.laws.with_bladder(pam.laws.with_ends(MUSCLE.law, 0.1, 1.05, 80.0), 3e4)
    assert law.name == "six-parameter+ends+bladder"
    muscle = replace(MUSCLE, law=law)
    gain = lambda k: float(law.dtension_dp(4e5, k))  # noqa: E731
    grown = np.diff(gas.muscle_volume(muscle, [0.0, 0.2]))[0]
    assert grown == pytest.approx(0.2 * quad(gain, 0, 0.2)[0], rel=1e-9)


def test_laws_around_a_law_are_saved_and_read_by_their_names(tmp_path):
    law = pam.laws.with_ends(pam.laws.with_bladder(MUSCLE.law, 3e4), 0.05)
    muscle = replace(HEAVY, law=law, burst_pressure=9e5, pull_off=2e3)
    path = pam.save_muscle(muscle, tmp_path / "muscle.toml")
    assert pam.load_muscle(path) == muscle
    refused("has bladder already", pam.laws.with_bladder, law, 1e4)


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


def test_numbers_beyond_what_a_muscle_bears_give_a_warning():
    weak = replace(MUSCLE, burst_pressure=5e5, pull_off=800.0, name="weak")
    forget_warnings()
    with pytest.warns(ValidityWarning, match="550000 Pa is above 500000 Pa, at which its tube"):
        weak.force(5.5e5, 0.2)
    with pytest.warns(ValidityWarning, match="N is above 800 N, at which its ends give way"):
        weak.force(4.5e5, 0.0)


# ---- several -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", muscle_names())
def test_three_in_parallel_pull_three_times_and_take_three_times_the_air(name):
    one = replace(pam.muscle(name, rest_length=0.25), mass=0.1, pull_off=2e4, diameter=0.02)
    many = in_parallel(one, 3)
    for p, kappa in ((3e5, 0.03), (2.1e5, 0.15)):
        assert many.force(p, kappa) == pytest.approx(3 * one.force(p, kappa), rel=1e-9)
        assert many.stiffness(p, kappa) == pytest.approx(3 * one.stiffness(p, kappa), rel=1e-9)
    volume = gas.BraidVolume()
    ratio = gas.muscle_volume(many, 0.1, volume) / gas.muscle_volume(one, 0.1, volume)
    assert ratio == pytest.approx(3)
    if one.law.is_affine():
        ratio = gas.muscle_volume(many, 0.1) / gas.muscle_volume(one, 0.1)
        assert ratio == pytest.approx(3)
    assert (many.mass, many.pull_off) == pytest.approx((0.3, 6e4))


def test_a_law_that_cannot_be_scaled_is_refused():
    fields = {"a": pam.laws.coefficient("N", 100.0, "a")}
    squared = pam.laws.own_law("squared", lambda p, kappa, a: 1e-3 * p + a**2 - a * kappa, fields)
    refused("do not scale the force", in_parallel, pam.Muscle(squared(a=20.0), rest_length=0.2), 2)


# ---- attribution ---------------------------------------------------------------------------------


def test_every_muscle_says_whose_numbers_it_has_and_how_sure_they_are():
    for name in muscle_names():
        found = attribution(name)
        assert found.confidence in ("high", "medium", "low")
        assert all((found.measured, found.by, found.where, found.source, found.sure))
        assert f"`{name}`" in attribution_table()
    said = str(attribution("Festo-three-element"))
    assert "Serres" in said
    assert "10.1080/10255840802654327" in said
    refused("did you mean", attribution, "Festo-three-elements")
