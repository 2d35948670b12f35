"""Fits of holds, against equilibria that SciPy finds of balances written by hand."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import refused
from scipy import stats
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp.fitting import fit_holds
from pam_ocp.fitting.static.holds import HoldsFit
from pam_ocp.fitting.statistics import Linearisation

LAW = pam.muscle("DMSP-20-300").law
REST_LENGTH, GRAVITY = 0.300, 9.80665
UP = np.linspace(1.2e5, 5.5e5, 25)
PRESSURE = np.concatenate([UP, UP[::-1][1:]])
SIDE = np.concatenate([np.ones(25), -np.ones(24)])


def positions(force, lowest=-0.05):
    """Where the muscle of 300 mm pulls with force(x, side) at each pressure [m]."""

    def left(x, p, s):
        return float(LAW.tension(p, x / REST_LENGTH)) - force(x, s)

    pairs = zip(PRESSURE, SIDE, strict=True)
    return np.array([brentq(left, lowest, 0.1, args=pair, xtol=1e-14) for pair in pairs])


SPRUNG = positions(lambda x, _: 120.0 + 6000.0 * x)


@pytest.fixture(scope="module")
def spring():
    return pam.SpringOverMuscle("DMSP-20-300", mass=2.0)


def test_a_spring_a_band_and_the_zero_of_the_sensor_are_found_exactly_without_noise(spring):
    x = SPRUNG - 2e-4 * SIDE
    shown = {"muscle_pressure [bar]": (PRESSURE + 7e3) / 1e5, "x [mm]": 1e3 * x, "side": SIDE}
    truth = {"spring_stiffness": 6000.0, "preload": 120.0}
    truth |= {"zero.muscle.pressure": 7e3, "band.x": 2e-4}
    fit = fit_holds(spring, shown, list(truth))
    assert fit.values == pytest.approx(truth, rel=1e-5)
    assert fit.plant.variable("preload").start == pytest.approx(120.0, rel=1e-5)


def test_dry_friction_and_a_load_are_found_from_the_sequence_of_commands():
    x = positions(lambda x, side: 35.0 * GRAVITY + 15.0 * side)
    plant = pam.HangingLoad("DMSP-20-300", mass=20.0, losses=pam.losses.CoulombFriction(5.0))
    shown, free = {"muscle_command": PRESSURE, "x": x}, ["mass", "muscle.friction_constant"]
    fit = fit_holds(plant, {**shown, "direction": ["up"] * 25 + ["down"] * 24}, free)
    assert fit.values["mass"] == pytest.approx(35.0, rel=1e-6)
    assert fit.values["muscle.friction_constant"] == pytest.approx(15.0, rel=1e-6)
    told = fit_holds(plant, shown, free)
    assert told.side[1:].tolist() == SIDE[1:].tolist()


def test_hysteresis_that_slid_fully_on_the_way_is_found():
    x = positions(lambda x, side: 30.0 * GRAVITY + 12.0 * side)
    plant = pam.HangingLoad("DMSP-20-300", 30.0, losses=pam.losses.BoucWen(friction=30.0))
    shown = {"muscle_pressure": PRESSURE, "x": x, "side": SIDE}
    fit = fit_holds(plant, shown, "muscle.hysteresis_force")
    assert fit.values["muscle.hysteresis_force"] == pytest.approx(12.0, rel=1e-6)


def test_a_joint_tells_its_link_from_angles_under_two_pressures():
    plant = pam.AntagonisticJoint("DMSP-20-300", link_mass=3.0, link_length=0.2)
    # a grid of its own equilibria: found back from another start
    names = ("muscle1.pressure", "muscle2.pressure")
    pairs = itertools.product(np.linspace(1e5, 5e5, 6), (1.5e5, 3e5))
    points = [plant.equilibrium(dict(zip(names, pair, strict=True))) for pair in pairs]
    data = {n: [point[n] for point in points] for n in (*names, "theta")}
    fit = fit_holds(plant.with_values(link_mass=1.0), data, ["link_mass", "zero.theta"])
    assert fit.values["link_mass"] == pytest.approx(3.0, rel=1e-6)
    assert fit.values["zero.theta"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"bounds": {"mass": 3}}, r"bounds\['mass'\] = 3: give \(low, high\)"),
        ({"bounds": {"mass": ("1 N", 9)}}, "measures something else than 'kg'"),
        ({"bounds": {"mass": (0, 10**400)}}, "larger than any float"),
        ({"bounds": {"mass": (5, 3)}}, "the first the smaller"),
        ({"noise": {"x": "1 bar"}}, r"noise\['x'\] = '1 bar': this measures something else"),
        ({"noise": {"x": 0}}, r"noise\['x'\] = 0 m must be > 0"),
        ({"noise": {"y": 1e-3}}, "unknown measured variable in noise 'y'"),
    ],
)
def test_bounds_and_noise_that_cannot_be_are_named(arguments, words):
    plant = pam.SpringOverMuscle("DMSP-20-300", mass=2.0)
    holds = {"muscle_pressure [bar]": [1.0, 2.0, 3.0], "x [mm]": [10.0, 20.0, 28.0]}
    refused(words, fit_holds, plant, holds, "mass", **arguments)


def test_bounds_and_noise_may_be_texts(spring):
    x = SPRUNG + 1e-4 * np.sin(np.arange(49))
    holds = {"muscle_pressure": PRESSURE, "x": x}
    one, other = (
        fit_holds(spring, holds, "preload", bounds={"preload": b}, noise={"x": n})
        for b, n in ((("-1 kN", "0.1 kN"), "0.1 mm"), ((-1e3, 100.0), 1e-4))
    )
    assert one.values == other.values
    assert one.at_bound == ("preload",)  # 120 N lie beyond


def test_what_holds_cannot_tell_is_refused_by_name(spring):
    fit, shown = partial(fit_holds, spring), {"muscle_pressure": PRESSURE, "x": SPRUNG}
    one = {n: v[:1].repeat(9) for n, v in shown.items()}
    one["x"] += np.arange(9) * 1e-7
    words, both = r"spring_stiffness by .* and preload by", ["spring_stiffness", "preload"]
    refused(words, fit, one, both, error=pam.FitError)
    refused(r"muscle\.command", fit, {"x": SPRUNG}, ["preload"])
    refused("no hold has a side", fit, shown, ["band.x"], side=np.zeros(49))
    refused("sideways", fit, shown, ["preload"], side="sideways")


def test_wrong_holds_do_not_move_a_robust_fit(spring):
    random = np.random.default_rng(5)
    x = SPRUNG + random.normal(0, 5e-5, 49)
    x[[3, 17, 30]] += [4e-3, -6e-3, 5e-3]
    holds = {"muscle_pressure": PRESSURE, "x": x}
    plain = fit_holds(spring, holds, ["spring_stiffness", "preload"])
    robust = fit_holds(spring, holds, ["spring_stiffness", "preload"], loss="bisquare")
    low, high = robust.interval("spring_stiffness")
    assert low < 6000.0 < high
    assert high - low < 0.3 * np.ptp(plain.interval("spring_stiffness"))
    assert any("3 of 49 holds" in text for text in robust.warnings)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say(spring):
    x = np.linspace(0.005, 0.055, 40)
    at_0, at_1 = (np.asarray(LAW.tension(p, x / REST_LENGTH)) for p in (0.0, 1e5))
    hits = 0
    for seed in range(30):
        random = np.random.default_rng(700 + seed)
        k, f0 = random.uniform(3000, 8000), random.uniform(50, 250)
        pressure = 1e5 * (f0 + k * x - at_0) / (at_1 - at_0)  # the law is affine in pressure
        shown = {"muscle_pressure": pressure, "x": x + random.normal(0, 5e-5, x.size)}
        fit = fit_holds(spring, shown, ["spring_stiffness", "preload"], errors="independent")
        low, high = fit.interval("spring_stiffness")
        hits += low <= k <= high
    assert 25 <= hits <= 30  # binomial, 0.95: within with probability 0.997


def test_a_fit_of_holds_is_told_and_saved(spring, tmp_path):
    x = SPRUNG - 2e-4 * SIDE
    shown = {"muscle_pressure": PRESSURE, "x": x, "side": SIDE}
    fit = fit_holds(spring, shown, ["preload", "band.x"])
    assert "25 come to from below, 24 come to from above" in fit.report()
    assert '"band.x"' in fit.save(tmp_path / "holds.json").read_text("utf-8")


def test_what_hangs_on_one_hold_has_the_interval_of_the_others():
    """A row of 100 times the slope of the others, as where a muscle goes slack."""
    random = np.random.default_rng(3)
    rows = np.column_stack([np.ones(30), random.uniform(-1, 1, 30), random.uniform(-1, 1, 30)])
    rows[7] = [1.0, 100.0, 0.3]
    linear = Linearisation(("a", "b", "c"), np.zeros(3), ("1",) * 3, rows, 0.2, 27)
    zeros = np.zeros(30)
    plant, x = pam.SpringOverMuscle("DMSP-20-300"), {"x": zeros}
    fit = HoldsFit(plant, linear, x, x, {}, zeros, np.ones((30, 1)), "squares")
    others = np.delete(rows, 7, axis=0)
    errors = 0.2 * np.sqrt(np.diag(np.linalg.inv(others.T @ others)))
    assert set(fit.hanging) == {"b"}
    assert fit.interval("b")[1] == pytest.approx(stats.t.ppf(0.975, 27) * errors[1])
    assert fit.interval("c")[1] == pytest.approx(stats.t.ppf(0.975, 27) * errors[2], rel=0.05)
    assert "b hang on them" in " ".join(fit.warnings)
    rows[:, 1] = 0.0
    rows[7, 1] = 1.0  # the others know nothing of b
    assert fit.plant is not None
    open_fit = replace(fit, linearisation=replace(linear, jacobian=rows))
    assert np.isinf(open_fit.interval("b")[1])
    assert "hangs on few holds" in open_fit.report()


@pytest.mark.filterwarnings("error")
def test_a_coefficient_all_but_without_influence_has_an_infinite_condition():
    """Squares of 1e-320 are zero, so that the column keeps its length: 1 / 1e-320 is no number."""
    rows = np.array([[1.0, 0.0], [1.0, 1e-320], [1.0, 0.0]])
    linear = Linearisation(("a", "b"), np.zeros(2), ("1",) * 2, rows, 0.2, 1)
    assert linear.condition == np.inf
    assert linear.rank == 1


@pytest.mark.slow
def test_a_richer_fit_is_never_worse_than_a_poorer_one() -> None:
    """A sensor's zero of 7 mm and a scale 8 % off: the fit with the mass ended twice as far off."""
    plant = pam.SpringOverMuscle("DMSP-20-300", mass=2.0)
    p = np.linspace(1.1136, 5.5, 14)
    x = [10.87, 13.5, 15.29, 18.35, 21.84, 24.38, 29.36, 30.88, 34.36, 38.11, 39.23, 41.57]
    holds = {"muscle_pressure [bar]": p, "x [mm]": [*x, 43.34, 45.62]}
    names = ("preload", "zero.x", "mass")
    rmse = {
        chosen: fit_holds(plant, holds, chosen).rmse["x"]
        for n in (1, 2, 3)
        for chosen in itertools.combinations(names, n)
    }
    for few, many in itertools.permutations(rmse, 2):
        if set(few) < set(many):
            assert rmse[many] <= rmse[few] * (1 + 1e-9)
