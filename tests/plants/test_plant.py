"""Plant: declaring, values, errors; and the two plants against their equations by hand."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import flat, rates_and_outputs, refused
from hand_equations import SETS

import pam_ocp as pam
from pam_ocp import UnknownNameError

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


def test_what_is_declared_twice_wrongly_or_not_at_all_is_named():
    plant = pam.Plant("half")
    x, u = plant.state("x"), plant.input("u")
    refused("'x' is declared twice", plant.parameter, "x", 1.0)
    refused("must be the symbol of a state", plant.der, u, x)
    refused("must be the symbol of a state", plant.der, 2 * x, x)
    refused(r"no equation der\(x\)", getattr, plant, "function")
    plant.der(x, -x * ca.SX.sym("forgotten"))
    refused(r"der\(x\) is given twice", plant.der, x, u)
    refused("forgotten", getattr, plant, "function")
    refused("has no state", getattr, pam.Plant("empty"), "function")


def test_a_plant_in_use_is_closed():
    plant = oscillator()
    _ = plant.function
    refused("in use", plant.parameter, "late", 1.0)


def test_unknown_names_bring_the_nearest(hanging):
    refused(r"muscle\.command", hanging.variable, "muscle.comand", error=UnknownNameError)


def test_values_outside_the_range_are_refused(hanging):
    refused(r"mass: start = -1 kg is outside", hanging.with_values, mass=-1.0)
    refused("output", hanging.with_values, {"muscle.force": 3.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mass": 0.0}, "mass = 0 kg must be > 0"),
        ({"pre_contraction": 0.4}, "slack or overstretched"),
        ({"pre_contraction": -0.05}, "slack or overstretched"),
        ({"stroke": 0.1}, "allow at most"),
    ],
)
def test_a_slide_that_cannot_be_is_refused(arguments, message):
    refused(message, pam.AntagonisticSlide, pam.muscle("DMSP-20-200N"), **arguments)


def by_hand(p, kappa):
    """Force [N] of the DMSP-20-200N from the published figures: p in bar, kappa in percent."""
    a1, a2, a3, a4, a5, a6 = SETS["DMSP-20-200N"]
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
    tension, h = long_muscle.law.tension, 1e-6
    slope = (tension(p, kappa + h) - tension(p, kappa - h)) / (2 * h)
    c = 2 * 0.1 * np.sqrt(20.0 * -slope / 0.4)
    acceleration = (tension(p, kappa) - 20.0 * 9.80665 - c * v) / 20.0
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
    other = pam.muscle("DMSP-20-400N", rest_length=0.2)
    plant = pam.AntagonisticSlide("DMSP-20-200N", muscle2=other)
    assert plant.mirror_map == {}
    refused("no mirror symmetry", pam.plan, plant, [{"x": -0.01}, {"x": 0.01}], cyclic="mirrored")


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
    refused(r"plant is a Muscle, not a Plant.*HangingLoad\(muscle\)", verb, long_muscle)


# ---- what a plant answers ---------------------------------------------------------------------


def test_values_come_by_name_or_from_a_point_of_rest(hanging):
    point = hanging.equilibrium(x=0.05)
    assert hanging.vector("state", point) == pytest.approx(point.x)
    assert hanging.vector("input", point) == pytest.approx(point.u)
    refused("give values by name", hanging.vector, "state", [0.0, 0.1])
    refused("mass is a parameter, not a state", hanging.vector, "state", {"mass": 1.0})


def test_a_plant_takes_its_start_values_from_a_point(hanging):
    point = hanging.equilibrium(x=0.05)
    there = hanging.with_values(mass=7.0).with_values(point)
    assert there.vector("state") == pytest.approx(point.x)
    assert there.vector("input") == pytest.approx(point.u)
    assert there.variable("mass").start == 7.0  # a point of rest says nothing of parameters
    assert hanging.with_values(point, x=0.03).variable("x").start == 0.03


def test_vectors_hold_one_attribute_in_the_order_of_declaration():
    plant = pam.Plant("three")
    a, b = plant.state("a", start=1.0, min=-4.0, nominal=2.0), plant.state("b", max=5.0)
    plant.der(a, b)
    plant.der(b, -a)
    assert plant.vector("state") == pytest.approx([1.0, 0.0])
    assert plant.vector("state", {"b": 3.0}) == pytest.approx([1.0, 3.0])
    assert list(plant.vector("state", attribute="min")) == [-4.0, -np.inf]
    assert list(plant.vector("state", attribute="max")) == [np.inf, 5.0]
    assert list(plant.vector("state", attribute="nominal")) == [2.0, 1.0]


def test_expressions_are_found_by_name():
    plant = oscillator()
    f = ca.Function(
        "f", [plant.x, plant.u, plant.p], [plant.expression(n) for n in ("der(v)", "v", "spring")]
    )
    assert [float(e) for e in f([0.2, 0.3], [5.0], [100.0])] == pytest.approx([-15.0, 0.3, 20.0])
    refused("spring is no state", plant.expression, "der(spring)")


def test_jacobians_are_those_of_the_equations():
    a, b, c, d = (np.asarray(e) for e in oscillator().jacobians([0.2, 0.3], [5.0], [80.0]))
    assert np.array_equal(a, [[0, 1], [-80, 0]])
    assert np.array_equal(b, [[0], [1]])
    assert np.array_equal(c, [[80, 0]])
    assert np.array_equal(d, [[0]])


def test_copies_share_what_was_built_and_the_latest_32_are_kept():
    plant = oscillator()
    plant.cached("first", lambda: "built")
    for k in range(31):
        plant.cached(k, lambda k=k: k)
    assert plant.with_values(k=1.0).cached("first", lambda: "anew") == "built"  # used again
    plant.cached(31, lambda: 31)
    assert plant.cached("first", lambda: "anew") == "built"
    assert plant.cached(0, lambda: "anew") == "anew"  # the oldest that was not used


def test_a_mirror_names_variables_of_the_plant():
    plant = pam.Plant("mirrored")
    x = plant.state("x")
    plant.der(x, -x)
    for wrong in ({"x": (-1.0, "y")}, {"y": (-1.0, "x")}):
        refused("'y'", plant.mirror, wrong, error=UnknownNameError)
    plant.mirror({"x": (-1.0, "x")})
    assert plant.mirror_map == {"x": (-1.0, "x")}
    _ = plant.function
    refused("in use", plant.mirror, {})


def test_a_plant_travels_with_values_names_and_mirror(slide):
    moved = slide.with_values(mass=3.5, x=0.004)
    there = pickle.loads(pickle.dumps(moved))
    assert there.variables == moved.variables
    assert (there.name, there.description) == (slide.name, slide.description)
    assert there.mirror_map == slide.mirror_map
    x, u = np.array([0.004, 0.3, 3e5, 2e5]), [5e5, 1e5]
    here, away = (p.function(x, u, p.vector("parameter")) for p in (moved, there))
    for one, two in zip(here, away, strict=True):
        assert flat(two) == pytest.approx(flat(one), rel=1e-14)


# ---- meters -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "feed", [pam.feeds.IdealPressure(totals=True), pam.feeds.Regulator(0.07, totals=True)]
)
def test_power_work_and_pneumatic_work_are_integrals_of_force_and_pressure(feed, long_muscle):
    """F v of the muscle; p dV with dV/dt = (dF/dp) v, for F = G p + H."""
    plant = pam.HangingLoad(replace(long_muscle, mass=0.25), mass=15.0, feed=feed)
    rng = np.random.default_rng(3)
    for _ in range(5):
        values = {"x": 0.05 + 0.03 * rng.uniform(), "v": rng.uniform(-0.4, 0.4)}
        pressure = rng.uniform(4, 6) * BAR
        values |= {"muscle.work": 300.0, "muscle.pneumatic_work": 500.0}
        rate, out = rates_and_outputs(plant, {**values, "muscle.pressure": pressure})
        law, kappa = long_muscle.law, values["x"] / 0.4
        force = law.tension(pressure, kappa)
        gain = law.tension(1.0, kappa) - law.tension(0.0, kappa)
        power = force * values["v"]
        assert out["muscle.power"] == pytest.approx(power, rel=1e-9)
        assert out["muscle.power_per_mass"] == pytest.approx(power / 0.25, rel=1e-9)
        assert out["muscle.work_per_mass"] == pytest.approx(300.0 / 0.25)
        assert out["muscle.efficiency"] == pytest.approx(300.0 / 500.0, rel=1e-6)
        assert rate["muscle.work"] == pytest.approx(power, rel=1e-9)
        pneumatic = pressure * gain * values["v"]
        assert rate["muscle.pneumatic_work"] == pytest.approx(pneumatic, rel=1e-7)


def test_a_valves_totals_are_the_air_drawn_and_its_exergy(long_muscle):
    """Exergy of compressed air per mass: R T ln(p / ambient)."""
    gas = pam.gas.Gas(temperature=305.0, ambient=0.95e5)
    feed = pam.feeds.OnOffValves(conductance=3e-8, supply=6.5e5, gas=gas, totals=True)
    plant = pam.HangingLoad(long_muscle, mass=15.0, feed=feed)
    values = {"x": 0.05, "muscle.pressure": 2e5, "muscle.air_drawn": 2e-3, "muscle.work": 40.0}
    rate, out = rates_and_outputs(plant, {**values, "v": 0.0, "muscle.fill": 0.6})
    specific = 287.05 * 305.0 * np.log((6.5e5 + 0.95e5) / 0.95e5)
    assert rate["muscle.air_drawn"] == pytest.approx(out["muscle.supply_flow"])
    assert rate["muscle.air_drawn"] > 0
    assert out["muscle.exergy_flow"] == pytest.approx(specific * out["muscle.supply_flow"])
    assert out["muscle.exergy_drawn"] == pytest.approx(2e-3 * specific)
    assert out["muscle.efficiency"] == pytest.approx(40.0 / (2e-3 * specific), rel=1e-6)


@pytest.mark.parametrize("cls", [pam.feeds.IdealPressure, pam.feeds.Regulator])
def test_without_totals_there_are_no_sums(cls, long_muscle):
    plant = pam.HangingLoad(long_muscle, mass=15.0, feed=cls())
    names = {v.name for v in plant.variables}
    assert "muscle.power" in names
    assert not {n for n in names if "work" in n or "efficiency" in n}


def test_a_finished_plant_gets_one_more_output_in_a_copy(long_muscle):
    plant = pam.AntagonisticSlide(long_muscle, mass=2.0, feed=pam.feeds.SpoolValve())
    difference = plant.expression("muscle1.pressure") - plant.expression("muscle2.pressure")
    more = plant.with_output("difference", difference, unit="Pa", nominal=1e5)
    assert [v.name for v in more.outputs] == [*(v.name for v in plant.outputs), "difference"]
    assert "difference" not in [v.name for v in plant.variables]
    start = {"muscle1.pressure": 3e5, "muscle2.pressure": 1e5}
    for each in (more, more.in_openings(), pickle.loads(pickle.dumps(more))):
        run = pam.simulate(each, start=start, duration=0.05)
        apart = run["muscle1.pressure"] - run["muscle2.pressure"]
        assert run["difference"][0] == 2e5
        assert np.array_equal(run["difference"], apart)
    refused("declared twice", plant.with_output, "x", difference)
    refused(r"in use .* with_output\(\)", plant.output, "difference", difference)


def test_a_cost_term_of_ones_own_is_tracked_by_an_mpc(long_muscle):
    joint = pam.AntagonisticJoint(long_muscle)
    total = joint.expression("muscle1.pressure") + joint.expression("muscle2.pressure")
    joint = joint.with_output("total", total, unit="Pa", nominal=1e5)
    rest = joint.equilibrium(theta=0.0, stiffness=30.0)
    weights = {"track": {"theta": 1.0, "total": 0.05}}
    weights["rate"] = dict.fromkeys(("muscle1.command", "muscle2.command"), 0.05)
    mpc = pam.Mpc(joint.with_values(rest), horizon=15, sample_time=0.02, **weights)
    loop = mpc.closed_loop(joint, {"theta": 0.15, "total": 5e5}, 1.0, start=rest)
    summed = loop["muscle1.pressure"] + loop["muscle2.pressure"]
    assert loop["theta"][-1] == pytest.approx(0.15, abs=1e-4)
    assert summed[-1] == pytest.approx(5e5, rel=1e-3)


def test_the_report_of_a_plant_names_each_variable_with_its_value(hanging):
    text = hanging.with_values(mass=7.5).report()
    for variable in hanging.variables:
        assert f" {variable.name} " in text
    assert "parameter  mass                         7.5 kg" in text
