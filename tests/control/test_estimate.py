"""The Kalman filter: equal to the linear one on linear plants, and it finds what is unknown."""

import numpy as np
import pytest
from conftest import refused
from mpc_cases import mass as free_mass
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp.control.estimators.extended_kalman import KalmanFilter
from pam_ocp.control.estimators.moving_horizon import MovingHorizonEstimator
from pam_ocp.control.estimators.stationary import kalman
from pam_ocp.core.errors import UnknownNameError

H = 0.05


def damped_spring() -> pam.Plant:
    plant = pam.Plant("spring", "a damped mass on a spring")
    x, v = plant.state("x", unit="m", nominal=0.1), plant.state("v", unit="m/s")
    f = plant.input("f", unit="N")
    plant.der(x, v)
    plant.der(v, f - 8.0 * x - 0.6 * v)
    plant.output("double", 2 * x, unit="m")
    return plant


def van_loan(a: np.ndarray, q: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Discrete matrix and noise of x' = A x + w (Van Loan, IEEE TAC 23, 1978)."""
    n = len(a)
    both = expm(np.block([[-a, q], [np.zeros((n, n)), a.T]]) * h)
    step = both[n:, n:].T
    return step, step @ both[:n, n:]


def test_on_a_linear_plant_it_is_the_linear_kalman_filter():
    a, b, c = np.array([[0, 1], [-8.0, -0.6]]), np.array([0, 1.0]), np.array([[2.0, 0.0]])
    step, noise = van_loan(a, np.diag([0.0, 0.2**2]), H)
    into = np.linalg.solve(a, (step - np.eye(2)) @ b)
    x, p = np.array([0.3, 0.0]), np.diag([0.1**2, 0.5**2])
    known = {"measured": {"double": 0.02}, "process": {"v": 0.2}}
    known |= {"start": {"x": 0.3}, "uncertainty": {"x": 0.1, "v": 0.5}}
    filter_ = KalmanFilter(damped_spring(), sample_time=H, substeps=10, **known)
    for seen, f in zip((0.5, 0.2, -0.1, 0.4), (1.0, -2.0, 0.0, 3.0), strict=True):
        gain = p @ c.T / (c @ p @ c.T + 0.02**2)
        x, p = x + (gain * (seen - c @ x)).ravel(), (np.eye(2) - gain @ c) @ p
        now = filter_.correct({"double": seen})
        assert list(now.state.values()) == pytest.approx(x, abs=3e-6)
        assert list(now.deviation.values()) == pytest.approx(np.sqrt(np.diag(p)), rel=1e-5)
        x, p = step @ x + into * f, step @ p @ step.T + noise
        filter_.predict({"f": f})


def test_mass_force_and_offset_converge_to_the_truth():
    plant = free_mass()
    for truth in ({"push": 1.5}, {"m": 1.3}, {"der(v)": -0.7}):
        (name, value), rng = next(iter(truth.items())), np.random.default_rng(0)
        known = {"measured": {"x": 1e-4}, "process": {"v": 1e-4}}
        filter_ = KalmanFilter(plant, sample_time=H, unknown={name: (1.0, 1e-3)}, **known)
        m, more = truth.get("m", 1.0), truth.get("push", 0.0) + truth.get("der(v)", 0.0)
        x, v = 0.0, 0.0
        for k in range(200):
            filter_.correct({"x": x + 1e-4 * rng.standard_normal()})
            f = np.sin(0.2 * k)
            filter_.predict({"f": f})
            acceleration = (f + more) / m
            x, v = x + H * v + H * H / 2 * acceleration, v + H * acceleration
        found = filter_.estimate
        assert found.values[name] == pytest.approx(value, rel=0.01)
        assert abs(found.values[name] - value) < 4 * found.deviation[name]


def test_an_estimate_stays_inside_the_bounds_of_its_parameter():
    filter_ = KalmanFilter(
        free_mass(), sample_time=H, measured={"x": 1e-6}, unknown={"m": (10.0, 1.0)}
    )
    for x in (0.0, 5.0, -5.0, 5.0):
        filter_.correct({"x": x})
        assert filter_.predict({"f": 1.0}).values["m"] >= 1e-3


def test_a_stiff_plant_is_filtered_with_the_implicit_step():
    plant = pam.Plant("stiff", "two lags, one of 10 us")
    x, y = plant.state("x", start=1.0), plant.state("y")
    plant.der(x, -x)
    plant.der(y, 1e5 * (x - y))
    filter_ = KalmanFilter(plant, sample_time=0.1, measured={"y": 1e-3}, method="rosenbrock")
    state = filter_.predict().state
    assert state["x"] == pytest.approx(np.exp(-0.1), rel=1e-4)
    assert state["y"] == pytest.approx(np.exp(-0.1), rel=1e-3)


def test_a_measurement_that_is_missing_is_left_out():
    filter_ = KalmanFilter(damped_spring(), sample_time=H, measured={"x": 0.01, "v": 0.01})
    filter_.correct({"x": 0.2})
    assert filter_.estimate.deviation["x"] < 0.011
    assert filter_.estimate.deviation["v"] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [KalmanFilter, MovingHorizonEstimator, kalman])
def test_a_missing_measurement_corrects_nothing_and_the_others_correct_alone(kind):
    """As blocks of filters do; without the position the rest is a filter of the velocity."""
    seen, about = {"x": 1e-3, "v": 1e-2}, ({"f": 0.0},) if kind is kalman else ()
    gaps, never = (kind(free_mass(), *about, sample_time=H, measured=seen) for _ in range(2))
    for f, missing in ((1.0, np.nan), (0.5, np.inf), (-1.0, -np.inf)):
        gaps.correct({"x": missing, "v": 0.1})
        never.correct({"v": 0.1})
        gaps.predict({"f": f})
        never.predict({"f": f})
        kept = gaps.estimate.state
        gaps.correct({"x": missing, "v": missing})
        assert gaps.estimate.state == kept == never.estimate.state
        assert kept["v"] != 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sample_time": 0.0}, "sample_time = 0"),
        ({"measured": {}}, "measured is empty"),
        ({"measured": {"x": -1.0}}, "measured"),
        ({"measured": {"f": 1.0}}, "f is an input"),
        ({"unknown": {"m": 1.0}}, "initial standard deviation"),
        ({"process": {"x": -1.0}}, "process"),
        ({"uncertainty": {"m": 1.0}}, "m is a parameter"),
    ],
)
def test_arguments_that_cannot_be_meant_are_refused(change, words):
    settings = {"sample_time": H, "measured": {"x": 1e-3}, **change}
    refused(words, KalmanFilter, free_mass(), **settings)


def test_unknown_names_get_the_nearest_one():
    with pytest.raises(UnknownNameError, match="push"):
        KalmanFilter(free_mass(), sample_time=H, measured={"x": 1e-3}, unknown={"pus": (1, 1)})
    filter_ = KalmanFilter(free_mass(), sample_time=H, measured={"x": 1e-3})
    refused("measured", filter_.correct, {"v": 1.0}, error=UnknownNameError)
    refused("x = None", filter_.correct, {"x": None})
