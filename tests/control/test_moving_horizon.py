"""The moving-horizon estimator: the Kalman filter where that is exact; bounds, outliers, a wrong
load.
"""

import numpy as np
import pytest
from conftest import benchmark_slide, refused
from mpc_cases import COMMANDS
from mpc_cases import mass as free_mass
from scipy.optimize import lsq_linear
from test_estimate import H, damped_spring

import pam_ocp as pam
from pam_ocp.control.estimators.extended_kalman import KalmanFilter
from pam_ocp.control.estimators.moving_horizon import MovingHorizonEstimator
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.core.errors import UnknownNameError


@pytest.mark.parametrize("horizon", [1, 4, 50])
def test_on_a_linear_plant_it_is_the_kalman_filter(horizon):
    """A window longer than the record, shorter, and of one step; with measurements missing."""
    settings = {
        "sample_time": H,
        "measured": {"double": 0.02, "v": 0.3},
        "process": {"v": 0.2},
        "start": {"x": 0.3},
        "uncertainty": {"x": 0.1, "v": 0.5},
        "unknown": {"der(v)": (1.0, 0.1)},
    }
    kalman = KalmanFilter(damped_spring(), **settings)
    window = MovingHorizonEstimator(damped_spring(), horizon=horizon, **settings)
    rng = np.random.default_rng(0)
    for k in range(40):
        seen = {"double": rng.standard_normal(), "v": rng.standard_normal()}
        if k % 3 == 0:
            del seen["v"]
        inputs = {"f": rng.standard_normal()}
        by_filter, by_window = ([e.correct(seen), e.predict(inputs)] for e in (kalman, window))
        for expected, found in zip(by_filter, by_window, strict=True):
            assert found.state == pytest.approx(expected.state, abs=1e-8)
            assert found.values == pytest.approx(expected.values, abs=1e-8)
            assert found.deviation == pytest.approx(expected.deviation, rel=1e-8)


def recorded(mass: float, duration: float, step: float, seed: int):
    """(plant, rest, samples of a slide of this mass under a square wave, noise, random numbers)."""
    plant = benchmark_slide()
    rest = plant.equilibrium(x=0.0, stiffness=2e4)
    state = {v.name: rest[v.name] for v in plant.states}
    real, rows = plant.with_values({"mass": mass}), []
    for k in range(round(duration / step)):
        up = 0.6e5 if k * step % 0.2 < 0.1 - 1e-9 else -0.6e5
        inputs = {n: rest[n] + s * up for n, s in zip(COMMANDS, (1, -1), strict=True)}
        rows.append((dict(state), inputs))
        run = pam.simulate(real, inputs, start=state, duration=step)
        state = {n: run[n][-1] for n in state}
    return plant.with_values({v.name: rest[v.name] for v in plant.states}), rows


NOISE = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
SLIDE = {
    "sample_time": 0.005,
    "measured": NOISE,
    "process": {"v": 1e-3},
    "uncertainty": {"x": 1e-4, "v": 1e-3, "muscle1.pressure": 1e3, "muscle2.pressure": 1e3},
}


def test_a_wrong_load_is_found_within_its_interval():
    model, rows = recorded(2.6, 0.6, 0.005, seed=0)
    rng = np.random.default_rng(0)
    window = MovingHorizonEstimator(model, horizon=15, unknown={"mass": (0.5, 1e-3)}, **SLIDE)
    for state, inputs in rows:
        found = window.correct({n: state[n] + s * rng.standard_normal() for n, s in NOISE.items()})
        window.predict(inputs)
    assert found.deviation["mass"] < 0.05
    assert abs(found.values["mass"] - 2.6) < 3 * found.deviation["mass"]
    assert found.state["v"] == pytest.approx(rows[-1][0]["v"], abs=4 * found.deviation["v"])


def test_with_few_outliers_huber_beats_the_extended_kalman_filter():
    model, rows = recorded(2.0, 0.5, 0.005, seed=1)
    rng = np.random.default_rng(1)
    kalman = KalmanFilter(model, **SLIDE)
    window = MovingHorizonEstimator(model, horizon=10, robust=1.345, iterations=5, **SLIDE)
    errors = []
    for state, inputs in rows:
        seen = {n: state[n] + s * rng.standard_normal() for n, s in NOISE.items()}
        if rng.random() < 0.1:
            seen["x"] += 1e-3 * rng.choice([-1, 1])  # 50 standard deviations
        errors.append([e.correct(seen).state["x"] - state["x"] for e in (kalman, window)])
        kalman.predict(inputs)
        window.predict(inputs)
    filtered, robust = np.sqrt(np.mean(np.square(errors), axis=0))
    assert robust < 0.5 * filtered
    assert robust < 2e-5


def reservoir() -> pam.Plant:
    plant = pam.Plant("reservoir", "a vessel that leaks")
    p = plant.state("p", unit="Pa", start=2e3, min=0.0, nominal=1e5)
    plant.der(p, -p / 0.2)
    return plant


def test_a_pressure_is_never_negative():
    known = {"measured": {"p": 3e3}, "process": {"p": 2e3}, "uncertainty": {"p": 3e3}}
    window = MovingHorizonEstimator(reservoir(), sample_time=H, horizon=8, **known)
    kalman = KalmanFilter(reservoir(), sample_time=H, **known)
    rng, lowest = np.random.default_rng(2), 0.0
    for _ in range(60):
        seen = {"p": 3e3 * rng.standard_normal()}
        lowest = min(lowest, kalman.correct(seen).state["p"])
        assert window.correct(seen).state["p"] >= 0.0
        assert window.window["p"].min() >= 0.0
        assert np.all(np.isfinite(window.window["p"]))
        kalman.predict()
        window.predict()
    assert lowest < -500.0  # the filter knows no bounds


def test_bounds_give_the_constrained_optimum():
    """One measurement, prior and bound: by hand the bound itself, and the prior's share of the
    rest.
    """
    known = {"measured": {"x": 0.1}, "uncertainty": {"x": 0.1, "v": 0.5}}
    bounds = {"x": (None, 0.2)}
    window = MovingHorizonEstimator(damped_spring(), sample_time=H, bounds=bounds, **known)
    assert window.correct({"x": 0.3}).state["x"] == pytest.approx(0.15)  # half way, bound idle
    window.correct({"x": 0.9})  # replaces the value: 0.45 without the bound
    assert window.estimate.state["x"] == pytest.approx(0.2, abs=1e-8)


def test_a_bounded_window_is_the_least_squares_fit_of_scipy():
    """Of a leak p' = -p/0.2: prior, noise of each step and measurements over p >= 0."""
    known = {"measured": {"p": 3e3}, "process": {"p": 2e3}, "uncertainty": {"p": 4e3}}
    window = MovingHorizonEstimator(reservoir(), sample_time=H, horizon=15, **known)
    whole, half = np.exp(-H / 0.2), np.exp(-H / 2 / 0.2)
    noise = 2e3 * np.sqrt(H / 6 * (whole**2 + 4 * half**2 + 1))
    seen = 3e3 * np.random.default_rng(4).standard_normal(12)
    rows, right = [np.eye(12)[0] / 4e3], [2e3 / 4e3]
    for k, y in enumerate(seen):
        rows, right = [*rows, np.eye(12)[k] / 3e3], [*right, y / 3e3]
        if k:
            rows.append((np.eye(12)[k] - whole * np.eye(12)[k - 1]) / noise)
            right.append(0.0)
            window.predict()
        window.correct({"p": float(y)})
    fit = lsq_linear(np.array(rows), np.array(right), (0.0, np.inf), method="bvls", tol=1e-14)
    assert fit.active_mask.any()
    assert not fit.active_mask.all()
    assert window.window["p"] == pytest.approx(fit.x, abs=0.01)  # of 3 kPa


def test_a_disturbance_inside_given_bounds():
    known = {"measured": {"x": 1e-4}, "process": {"v": 1e-4}, "unknown": {"push": (1.0, 1e-3)}}
    bounds = {"push": (-0.5, 0.5)}
    window = MovingHorizonEstimator(free_mass(), sample_time=H, bounds=bounds, **known)
    x, v = 0.0, 0.0
    for _ in range(40):
        found = window.correct({"x": x})
        window.predict()
        x, v = x + H * v + H * H / 2 * 1.5, v + H * 1.5  # pushed by 1.5 N
        assert abs(found.values["push"]) <= 0.5 + 1e-8
    assert found.values["push"] == pytest.approx(0.5, abs=1e-6)


def test_it_takes_the_filters_place_in_a_closed_loop():
    plant = free_mass(limit=5.0)
    known = {"measured": {"x": 1e-4}, "process": {"v": 1e-3}, "unknown": {"push": (1.0, 0.01)}}
    window = MovingHorizonEstimator(plant, sample_time=0.1, **known)
    mpc = Mpc(plant, horizon=20, sample_time=0.1, track={"x": 1.0}, rate={"f": 0.01})
    real = {"estimator": window, "disturbances": {"push": 0.8}, "seed": 3}
    loop = closed_loop(mpc, plant, {"x": 0.5}, duration=6.0, **real)
    found = loop.estimate.row(-1)
    assert abs(found["push"] - 0.8) < 4 * found["deviation.push"] < 0.1
    assert loop.steady_error("x", 1.0) < 5e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"horizon": 0}, "horizon = 0"),
        ({"iterations": 1.5}, "iterations = 1.5"),
        ({"robust": -1.0}, "robust"),
        ({"bounds": {"m": (0, 1)}}, "m is not estimated"),
        ({"bounds": {"x": (1, 0)}}, "the first the smaller"),
        ({"bounds": {"x": 3}}, "give \\(low, high\\)"),
    ],
)
def test_arguments_that_cannot_be_meant_are_refused(change, words):
    settings = {"sample_time": H, "measured": {"x": 1e-3}, **change}
    refused(words, MovingHorizonEstimator, free_mass(), **settings)


def test_unknown_names_get_the_nearest_one():
    with pytest.raises(UnknownNameError, match="push"):
        MovingHorizonEstimator(
            free_mass(), sample_time=H, measured={"x": 1e-3}, bounds={"pushh": (0, 1)}
        )


def test_a_reset_keeps_what_is_named_and_refuses_other_names():
    settings = {"sample_time": H, "measured": {"double": 0.02}, "start": {"x": 0.3}}
    known = {"uncertainty": {"x": 0.1, "v": 0.5}, "unknown": {"der(v)": (1.0, 0.1)}}
    window = MovingHorizonEstimator(damped_spring(), horizon=4, **settings, **known)
    for _ in range(10):
        window.correct({"double": 1.0})
        window.predict({"f": 0.0})
    before = window.estimate.values
    assert before["der(v)"] != 0.0
    window.reset(["der(v)"])
    assert window.estimate.values == before
    window.reset()
    assert window.estimate.values["der(v)"] == 0.0
    refused("kept", window.reset, "nope", error=UnknownNameError)
