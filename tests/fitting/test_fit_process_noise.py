"""Process noise: the smoothed fit against a Kalman filter's, its coverage, and what it is for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.linalg import expm
from scipy.optimize import minimize

import pam_ocp as pam
from pam_ocp.fitting import fit_plant

SPRING, DAMPER, STEP = 40.0, 1.5, 0.05
INTENSITY, NOISE = 0.05, 5e-4
FREE = ["spring", "damper"]
NOISY: dict[str, Any] = {"noise": {"x": NOISE}, "process_noise": {"v": INTENSITY}}


def oscillator(spring: float = SPRING, damper: float = DAMPER) -> pam.Plant:
    plant = pam.Plant("oscillator")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    f = plant.input("force", unit="N", min=-1.0, max=1.0)
    k = plant.parameter("spring", spring, unit="N/m", min=0.0, nominal=10.0)
    c = plant.parameter("damper", damper, unit="N.s/m", min=0.0)
    plant.der(x, v)
    plant.der(v, f - k * x - c * v)
    return plant


def discrete(spring: float, damper: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact transition over a step, and the effect of a held force."""
    block = np.zeros((3, 3))
    block[:2] = [[0, 1, 0], [-spring, -damper, 1]]
    whole = expm(block * STEP)
    return whole[:2, :2], whole[:2, 2]


def record(seed: int, samples: int = 81, exact: bool = True) -> pam.Trajectory:
    """Force steps, position with noise; the velocity is disturbed by white noise all the time."""
    random = np.random.default_rng(seed)
    a, b = discrete(SPRING, DAMPER)
    # covariance gained in a step (C. Van Loan, IEEE Trans. Autom. Control 23 (1978) 395-404)
    flow = np.array([[0, 1.0], [-SPRING, -DAMPER]])
    block = np.block([[-flow, np.diag([0, INTENSITY**2])], [np.zeros((2, 2)), flow.T]])
    whole = expm(block * STEP)
    gained = whole[2:, 2:].T @ whole[:2, 2:] if exact else np.diag([1e-30, INTENSITY**2 * STEP])
    root = np.linalg.cholesky(gained)
    force = random.choice([-1.0, 1.0], samples // 8 + 1)[np.arange(samples) // 8]
    z = np.zeros((samples, 2))
    for i in range(samples - 1):
        z[i + 1] = a @ z[i] + b * force[i] + root @ random.standard_normal(2)
    x = z[:, 0] + NOISE * random.standard_normal(samples)
    variables = [oscillator().variable(n) for n in ("force", "x")]
    t = STEP * np.arange(samples)
    return pam.Trajectory(t, {"force": force, "x": x}, variables, "previous")


def innovations(theta: Any, run: pam.Trajectory) -> float:
    """sum(e^2/S) of a Kalman filter: the least cost of any motion and disturbance for theta."""
    a, b = discrete(*theta)
    mean, p, total = np.zeros(2), 1e6 * np.eye(2), 0.0
    for i, y in enumerate(run["x"]):
        s = p[0, 0] + NOISE**2
        gain, e = p[:, 0] / s, y - mean[0]
        total += e**2 / s
        mean, p = mean + gain * e, p - np.outer(gain, p[0])
        mean, p = a @ mean + b * run["force"][i], a @ p @ a.T + np.diag([0, INTENSITY**2 * STEP])
    return total


@pytest.fixture(scope="module")
def run() -> pam.Trajectory:
    return record(0)


@pytest.fixture(scope="module")
def fit(run: pam.Trajectory) -> pam.fitting.PlantFit:
    return fit_plant(oscillator(35.0, 1.0), run, FREE, **NOISY)


def test_the_fit_is_that_of_a_kalman_filter(fit: pam.fitting.PlantFit, run: pam.Trajectory) -> None:
    """A linear plant: the optimum over parameters and motion is that over the innovations."""
    tight = {"xatol": 1e-6, "fatol": 1e-9}
    best = minimize(innovations, [35.0, 1.0], (run,), "Nelder-Mead", options=tight)
    assert list(fit.values.values()) == pytest.approx(best.x, rel=2e-4)
    scale = fit.linearisation.scale**2 * fit.linearisation.dof
    assert scale == pytest.approx(best.fun, rel=1e-4)
    # curvature of the cost: covariance 2 H^-1, times s^2
    step, hessian = np.diag([0.2, 0.05]), np.zeros((2, 2))
    for i, j in np.ndindex(2, 2):
        for si, sj in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            cost = innovations(best.x + si * step[i] + sj * step[j], run)
            hessian[i, j] += si * sj * cost / (4 * step[i, i] * step[j, j])
    expected = fit.linearisation.scale * np.sqrt(np.diag(2 * np.linalg.inv(hessian)))
    # Gauss-Newton leaves out the residuals' curvature, which noise makes some per cent
    assert [c.stderr for c in fit.coefficients.values()] == pytest.approx(expected, rel=0.12)


def test_multiple_shooting_finds_the_same(fit: pam.fitting.PlantFit, run: pam.Trajectory) -> None:
    way: Any = {"method": "multiple-shooting", "degree": 4}
    other = fit_plant(oscillator(35.0, 1.0), run, FREE, **NOISY, **way)
    for name, (low, high) in fit.intervals().items():
        assert other.values[name] == pytest.approx(fit.values[name], rel=1e-4)
        assert other.interval(name) == pytest.approx((low, high), rel=1e-3)


def test_the_report_says_so(fit: pam.fitting.PlantFit) -> None:
    assert fit.process_noise == {"v": INTENSITY}
    text = fit.report()
    assert "[[Fit]] of the smoothed motion" in text
    assert "process noise of v: 0.05 m/s/sqrt(s)" in text
    assert fit.noise == {"x": pytest.approx(NOISE)}
    # the smoothed motion follows the record to less than the measurement noise
    assert fit.rmse["x"] < NOISE


@pytest.mark.slow
def test_intervals_cover_where_those_without_process_noise_do_not() -> None:
    """20 records: intervals of 95 %; the scatter of estimates is smaller, too. Without process
    noise residuals are autocorrelated: intervals of independent ones do not cover, those that count
    it nearly do.
    """
    with_, without, hits = [], [], np.zeros(3)
    for seed in range(20):
        run = record(seed)
        smooth = fit_plant(oscillator(35.0, 1.0), run, FREE, **NOISY)
        plain = fit_plant(oscillator(35.0, 1.0), run, FREE)
        for name, true in (("spring", SPRING), ("damper", DAMPER)):
            for i, found in enumerate((smooth, plain)):
                low, high = found.interval(name)
                hits[i] += low <= true <= high
            place = plain.linearisation.names.index(name)
            error = 1.97 * plain.linearisation.stderr()[place]
            hits[2] += abs(plain.values[name] - true) <= error
        with_.append(smooth.values["spring"] - SPRING)
        without.append(plain.values["spring"] - SPRING)
    assert hits[0] >= 35  # of 40: fewer has a probability of 1 in 70 at 95 %
    assert hits[1] >= 33  # 1 in 260 of fewer at 95 %
    assert hits[2] <= 24
    assert np.sqrt(np.mean(np.square(with_))) < np.sqrt(np.mean(np.square(without)))


def test_a_vanishing_process_noise_is_none(run: pam.Trajectory) -> None:
    known = {"noise": {"x": NOISE}, "degree": 5}
    tiny = fit_plant(oscillator(), run, FREE, process_noise={"v": 1e-7}, **known)
    none = fit_plant(oscillator(), run, FREE, **known)
    errors = dict(zip(none.linearisation.names, none.linearisation.stderr(), strict=True))
    for name in FREE:
        assert tiny.values[name] == pytest.approx(none.values[name], rel=1e-4)
        assert tiny.coefficients[name].stderr == pytest.approx(errors[name], rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"noise": None}, "process_noise needs noise="),
        ({"process_noise": {"spring": 1.0}}, "spring is a parameter, not a state"),
        ({"process_noise": {"v": -1.0}}, r"process_noise\['v'\] = -1 m/s/sqrt\(s\) must be > 0"),
        ({"method": "single-shooting"}, "single shooting knows no jumps"),
    ],
)
def test_bad_arguments_are_refused_in_words(
    arguments: dict[str, Any], words: str, run: pam.Trajectory
) -> None:
    refused(words, fit_plant, oscillator(), run, FREE, **NOISY | arguments)
