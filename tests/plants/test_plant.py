"""Plant: declaring, values, errors; and the two plants against their equations by hand."""

import casadi as ca
import numpy as np
import pytest
from conftest import flat

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError

BAR = 1e5


def oscillator() -> pam.Plant:
    plant = pam.Plant("oscillator")
    x = plant.state("x", unit="m", start=0.1)
    v = plant.state("v", unit="m/s")
    f = plant.input("force", unit="N")
    k = plant.parameter("k", 100.0, unit="N/m", min=0.0)
    plant.der(x, v)
    plant.der(v, f - k * x)
    plant.output("spring", k * x, unit="N")
    return plant


def test_functions_follow_the_declared_equations():
    plant = oscillator()
    xdot, y, _ = plant.function([0.2, 0.3], [5.0], [100.0])
    assert np.allclose(flat(xdot), [0.3, 5.0 - 20.0])
    assert np.allclose(flat(y), [20.0])
    assert plant.positions == {"x": "v"}


def test_new_values_share_the_expressions_and_leave_the_original():
    plant = oscillator()
    stiffer = plant.with_values(k=400.0)
    assert stiffer.function is plant.function
    assert stiffer.vector("parameter") == pytest.approx([400.0])
    assert plant.vector("parameter") == pytest.approx([100.0])


def test_underscore_may_stand_for_the_dot_in_names(hanging):
    assert hanging.variable("muscle_pressure").name == "muscle.pressure"


def test_every_physical_constant_of_the_muscle_is_a_parameter(hanging, long_muscle):
    values = {v.name: v.start for v in hanging.parameters}
    for name, value in long_muscle.law.values.items():
        assert values[f"muscle.{name}"] == value
    assert values["muscle.rest_length"] == 0.4
    assert values["mass"] == 20.0


def test_a_plant_without_an_equation_says_which_is_missing():
    plant = pam.Plant("half")
    plant.state("x")
    with pytest.raises(InputError, match=r"no equation der\(x\)"):
        _ = plant.function


def test_a_free_symbol_is_named():
    plant = pam.Plant("free")
    x = plant.state("x")
    plant.der(x, -x * ca.SX.sym("forgotten"))
    with pytest.raises(InputError, match="forgotten"):
        _ = plant.function


def test_a_name_may_be_declared_once_only():
    plant = pam.Plant("twice")
    plant.state("x")
    with pytest.raises(InputError, match="'x' is declared twice"):
        plant.parameter("x", 1.0)


def test_a_plant_in_use_is_closed():
    plant = oscillator()
    _ = plant.function
    with pytest.raises(InputError, match="in use"):
        plant.parameter("late", 1.0)


def test_unknown_names_bring_the_nearest(hanging):
    with pytest.raises(UnknownNameError, match=r"muscle\.command"):
        hanging.variable("muscle.comand")


def test_values_outside_the_range_are_refused(hanging):
    with pytest.raises(InputError, match=r"mass: start = -1 kg is outside"):
        hanging.with_values(mass=-1.0)
    with pytest.raises(InputError, match="output"):
        hanging.with_values({"muscle.force": 3.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mass": 0.0}, "mass = 0 kg must be > 0"),
        ({"mass": -2.0}, "mass = -2 kg must be > 0"),
        ({"pre_contraction": 0.4}, "slack or overstretched"),
        ({"pre_contraction": -0.05}, "slack or overstretched"),
        ({"stroke": 0.1}, "allow at most"),
    ],
)
def test_a_slide_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), **arguments)


def test_a_regulator_needs_a_positive_lag():
    with pytest.raises(InputError, match=r"Regulator\.lag = 0 s must be > 0"):
        pam.Regulator(0.0)


def by_hand(p, kappa):
    """Force [N] of the DMSP-20-200N from the published figures: p in bar, kappa in percent."""
    a1, a2, a3, a4, a5, a6 = (
        -4.00180705,
        292.4620246,
        -0.32930845,
        -9.33564098,
        294.0538256,
        -280.498151,
    )
    k = 100 * kappa
    return (a1 * p + a2) * np.exp(a3 * k) + a4 * k * p + a5 * p + a6


def test_the_slide_moves_as_newton_says(slide):
    rng = np.random.default_rng(1)
    for _ in range(20):
        x, v = rng.uniform(-0.008, 0.008), rng.uniform(-1, 1)
        p, u = rng.uniform(3, 6, 2), rng.uniform(0, 6, 2)
        xdot = slide.function([x, v, *(p * BAR)], u * BAR, slide.vector("parameter"))[0]
        pull = by_hand(p[0], 0.10 + x / 0.2) - by_hand(p[1], 0.10 - x / 0.2)
        expected = [v, (pull - 20.0 * v) / 2.0, *((u - p) * BAR / 0.05)]
        assert flat(xdot) == pytest.approx(expected, rel=1e-9, abs=1e-6)


def test_the_hanging_load_moves_as_newton_says(hanging, long_muscle):
    x, v, p, u = 0.05, 0.2, 4.0 * BAR, 5.0 * BAR
    kappa = x / 0.4
    h = 1e-6
    slope = (long_muscle.law.tension(p, kappa + h) - long_muscle.law.tension(p, kappa - h)) / (
        2 * h
    )
    c = 2 * 0.1 * np.sqrt(20.0 * -slope / 0.4)
    acceleration = (long_muscle.law.tension(p, kappa) - 20.0 * 9.80665 - c * v) / 20.0
    xdot = hanging.function([x, v, p], [u], hanging.vector("parameter"))[0]
    assert flat(xdot) == pytest.approx([v, acceleration, (u - p) / 0.05], rel=1e-6)


def test_the_mirror_image_of_a_slide_moves_in_the_mirror(slide):
    x = np.array([0.004, 0.3, 3e5, 2e5])
    image = np.array([-0.004, -0.3, 2e5, 3e5])
    p = slide.vector("parameter")
    one = flat(slide.function(x, [5e5, 1e5], p)[0])
    two = flat(slide.function(image, [1e5, 5e5], p)[0])
    assert two == pytest.approx([-one[0], -one[1], one[3], one[2]], rel=1e-12)


def test_unequal_muscles_have_no_mirror_image():
    plant = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"), muscle2=pam.muscle("DMSP-20-400N", rest_length=0.2)
    )
    assert plant.mirror_map == {}
    with pytest.raises(InputError, match="no mirror symmetry"):
        pam.plan(plant, [{"x": -0.01}, {"x": 0.01}], cyclic="mirrored")


@pytest.mark.parametrize(
    "verb",
    [
        lambda m: pam.simulate(m, duration=1.0),
        lambda m: pam.plan(m, [{"x": 0.0}, {"x": 0.1}]),
        lambda m: pam.equilibrium(m, x=0.0),
        pam.linearize,
        lambda m: pam.export_fmu(m, "m.fmu"),
    ],
    ids=["simulate", "plan", "equilibrium", "linearize", "export"],
)
def test_a_muscle_in_place_of_a_plant_is_told_where_it_belongs(verb, long_muscle):
    with pytest.raises(InputError, match=r"plant is a Muscle, not a Plant.*HangingLoad\(muscle\)"):
        verb(long_muscle)
