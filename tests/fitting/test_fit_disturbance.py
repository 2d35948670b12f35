"""A coloured force that nobody measured: gains against the stationary Kalman filter's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.linalg import expm, solve_discrete_are

import pam_ocp as pam

STIFFNESS, DAMPING, GAIN, RATE = 60.0, 4.0, 30.0, 2.5
PUSH, NOISE, T = 12.0, 2e-3, 0.01
"""Standard deviations of the force [1/s2] and of the encoder [rad]; sampling time [s]."""
HORIZONS = (0.1, 0.3)


def sprung() -> pam.Plant:
    plant = pam.Plant("sprung")
    q, w = plant.state("q", unit="rad"), plant.state("w", unit="rad/s")
    u = plant.input("u")
    k, c = plant.parameter("k", 40.0, nominal=50), plant.parameter("c", 2.0, nominal=5)
    g = plant.parameter("g", 20.0, nominal=30)
    plant.der(q, w)
    plant.der(w, g * u - k * q - c * w)
    plant.output("torque", g * u)
    return plant


def matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, B, covariance of what is added) from sample to sample, of (q, w, force)."""
    a = np.array([[0, 1, 0], [-STIFFNESS, -DAMPING, 1], [0, 0, -RATE]])
    b = np.array([[0.0], [GAIN], [0.0]])
    both = expm(T * np.block([[a, b], [np.zeros((1, 4))]]))
    q = np.zeros((3, 3))
    q[2, 2] = 2 * RATE * PUSH**2
    big = expm(T * np.block([[-a, q], [np.zeros((3, 3)), a.T]]))  # Van Loan 1978
    discrete = big[3:, 3:].T
    return discrete, both[:3, 3:], discrete @ big[:3, 3:]


def record(seed: int, samples: int = 301) -> pam.Trajectory:
    random = np.random.default_rng(seed)
    a, b, q = matrices()
    t = T * np.arange(samples)
    u = np.repeat(random.uniform(-1, 1, samples // 20 + 1), 20)[:samples]
    root = np.linalg.cholesky(q + 1e-18 * np.eye(3))
    x = np.zeros((samples, 3))
    x[0, 2] = PUSH * random.standard_normal()
    for k in range(samples - 1):
        x[k + 1] = a @ x[k] + b[:, 0] * u[k] + root @ random.standard_normal(3)
    y = x[:, 0] + NOISE * random.standard_normal(samples)
    return pam.Trajectory(t, {"q": y, "u": u}, interpolation="previous")


def fitted(**options: Any) -> pam.fitting.FreeRunFit:
    given = {"horizon": HORIZONS, "every": 0.1, "warm_up": 0.5, "correct": True, **options}
    return pam.fit_free_run(sprung(), [record(s) for s in range(6)], ["k", "c", "g"], **given)


@pytest.fixture(scope="module")
def both() -> tuple[pam.fitting.FreeRunFit, pam.fitting.FreeRunFit]:
    return fitted(), fitted(disturbance=["w"])


@pytest.mark.slow
def test_unseen_records_are_predicted_better(both: Any) -> None:
    unseen = [record(s) for s in (101, 102, 103, 104)]
    plain, pushed = (fit.validate(unseen) for fit in both)
    for h in HORIZONS:
        assert pushed.rmse_over(h)["q"] < 0.8 * plain.rmse_over(h)["q"]


@pytest.mark.slow
def test_gains_are_those_of_the_kalman_filter(both: Any) -> None:
    a, _, q = matrices()
    c = np.array([[1.0, 0.0, 0.0]])
    p = solve_discrete_are(a.T, c.T, q, NOISE**2 * np.eye(1))
    best = (p @ c.T / (c @ p @ c.T + NOISE**2))[:, 0]
    fit = both[1]
    for state, wanted in zip(("q", "w", "w.disturbance"), best, strict=True):
        assert fit.rig.corrections[state, "q"] == pytest.approx(wanted, rel=0.4), state
    assert fit.values["w.disturbance_rate"] == pytest.approx(RATE, abs=1.5)
    for name, true in (("k", STIFFNESS), ("c", DAMPING), ("g", GAIN)):
        low, high = fit.interval(name)
        assert low < true < high, name


@pytest.mark.slow
def test_the_plant_by_itself_is_what_it_was(both: Any) -> None:
    fit = both[1]
    own = sprung().with_values({n: fit.values[n] for n in "kcg"})
    t = np.linspace(0, 1, 51)
    runs = [pam.simulate(p, {"u": 0.7}, t=t, start={"q": 0.1}) for p in (own, fit.plant)]
    np.testing.assert_allclose(runs[0]["q"], runs[1]["q"], atol=1e-6)
    assert [v.name for v in fit.plant.outputs] == ["torque"]


def test_a_structure_with_it_counts_it() -> None:
    options = {"horizon": 0.1, "every": 0.1, "warm_up": 0.1}
    structure = pam.fitting.FreeRunStructure
    assert structure(sprung(), ["k"], options).complexity == 1.0
    assert structure(sprung(), ["k"], {**options, "disturbance": ["w"]}).complexity == 3.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"warm_up": 0.0}, "disturbance needs warm_up"),
        ({"disturbance": ["u"]}, "u, which is no state; states are q, w"),
        ({"disturbance": "w", "outputs": ["torque"]}, "neither w nor a position"),
    ],
)
def test_what_cannot_be_is_refused(options: dict[str, Any], words: str) -> None:
    run = record(1)
    columns = {"torque": GAIN * run["u"], "q": run["q"], "u": run["u"]}
    both = pam.Trajectory(run.t, columns, interpolation="previous")
    given = {"horizon": 0.1, "every": 0.1, "warm_up": 0.1, "outputs": ["q"], "disturbance": ["w"]}
    refused(words, pam.fit_free_run, sprung(), both, ["k"], **{**given, **options})
