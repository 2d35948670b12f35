"""The muscle's own body: dead pressure, ends, strength, several side by side; whose numbers."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import quad

import pam_ocp as pam
from pam_ocp.muscles import gas, in_parallel
from pam_ocp.muscles.catalogue import attribution, attribution_table, muscle_names
from pam_ocp.muscles.validity import ValidityWarning, forget_warnings

MUSCLE = pam.muscle("DMSP-20-200N")
HEAVY = replace(MUSCLE, mass_per_length=0.3, end_mass=0.2)


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


def test_by_default_ends_change_nothing_and_a_bladder_takes_a_fifth_of_a_bar():
    inner, at = type(MUSCLE.law), MUSCLE.law.values
    ends, bladder = pam.laws.ends_law(inner)(**at), pam.laws.bladder_law(inner)(**at)
    assert ends.tension(3e5, 0.1) == pytest.approx(MUSCLE.law.tension(3e5, 0.1), rel=1e-14)
    assert pam.laws.with_ends(MUSCLE.law) == ends
    assert bladder.tension(3e5, 0.1) == pytest.approx(MUSCLE.law.tension(2.8e5, 0.1), rel=1e-12)


def test_a_muscle_is_drawn():
    force, stiffness, *_ = MUSCLE.plot().axes
    assert force.get_ylabel() == "pulling force [N]"
    assert "stiffness" in stiffness.get_ylabel()
    (surface,) = MUSCLE.plot_surface("stiffness").axes
    assert surface.get_zlabel() == "stiffness [N/mm]"


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
    one = replace(one, mass_per_length=0.3, end_mass=0.2)
    many = in_parallel(one, 3)
    assert in_parallel(one, 1) is one
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
    assert (many.mass_per_length, many.end_mass) == pytest.approx((0.9, 0.6))
    assert many.slack_width == 3 * one.slack_width


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


def test_a_muscle_is_described_in_units_of_ones_own():
    words = {"diameter": "20 mm", "slack_width": "2 N", "mass": "250 g", "end_mass": "200 g"}
    words |= {"mass_per_length": "300 g/m", "burst_pressure": "9 bar", "pull_off": "2 kN"}
    words |= {"pressure_range": ("0 bar", "6 bar"), "contraction_range": ("0 %", "25 %")}
    si = {"diameter": 0.02, "slack_width": 2.0, "mass": 0.25, "end_mass": 0.2}
    si |= {"mass_per_length": 0.3, "burst_pressure": 9e5, "pull_off": 2e3}
    described = pam.Muscle(MUSCLE.law, "200 mm", **words)
    assert described == pam.Muscle(MUSCLE.law, 0.2, **si)
    assert described.body_mass == pytest.approx(0.2 * 0.3 + 0.2)
    assert described.known_mass == 0.25
    assert HEAVY.known_mass == pytest.approx(0.26)
    assert MUSCLE.known_mass is None
    assert "rest length 200 mm" in repr(MUSCLE)
