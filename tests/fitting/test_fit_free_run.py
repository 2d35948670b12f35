"""Free runs: against SciPy's integration of the same equations, and the truth back from them."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import noisy_record, refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.core.errors import FitError, InputError, UnknownNameError
from pam_ocp.fitting.dynamic.free_run_fit import fit_free_run, free_run
from pam_ocp.fitting.dynamic.rollout import Rollout
from pam_ocp.fitting.dynamic.runs import runs_of

TRUTH = {"stiffness": 40.0, "damping": 1.5, "friction": 2.0, "gain": 30.0}
SPEED = 0.05


def rubbing() -> pam.Plant:
    """q'' = gain u - stiffness q - damping q' - friction tanh(q'/v): it sticks and slides."""
    plant = pam.Plant("rubbing", "a joint with dry friction")
    q, w = plant.state("q", unit="rad"), plant.state("w", unit="rad/s")
    u = plant.input("u")
    k, c, f, g = (plant.parameter(n, v, min=0, nominal=v) for n, v in TRUTH.items())
    plant.parameter("idle", 1.0)
    plant.der(q, w)
    plant.der(w, g * u - k * q - c * w - f * ca.tanh(w / SPEED))
    plant.output("torque", g * u - k * q)
    return plant


def force(t: np.ndarray, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.interp(t, np.linspace(0, t[-1], 9), random.uniform(-1, 1, 9))


def reference(
    t: np.ndarray, u: np.ndarray, x0: tuple[float, float], held: bool = False
) -> np.ndarray:
    """The equations of ``rubbing`` once more, by SciPy: states (n, 2) at t."""

    def slope(time: float, x: np.ndarray, value: float | None) -> list[float]:
        f = np.interp(time, t, u) if value is None else value
        rub = TRUTH["friction"] * np.tanh(x[1] / SPEED)
        return [x[1], TRUTH["gain"] * f - TRUTH["stiffness"] * x[0] - TRUTH["damping"] * x[1] - rub]

    rows, tight = [np.array(x0)], {"method": "Radau", "rtol": 1e-9, "atol": 1e-11}
    for k in range(len(t) - 1):
        value = float(u[k]) if held else None
        run = solve_ivp(slope, t[k : k + 2], rows[-1], args=(value,), **tight)
        rows.append(run.y[:, -1])
    return np.array(rows)


@cache
def record(seed: int, *, with_speed: bool = True, held: bool = False) -> pam.Trajectory:
    t = np.arange(121) / 100
    u = force(t, seed)
    q, w = reference(t, u, (0.3, 0.0), held).T
    columns = {"q": q, "u": u, **({"w": w} if with_speed else {})}
    return pam.Trajectory(t, columns, interpolation="previous" if held else "linear")


@pytest.mark.parametrize("held", [False, True])
def test_runs_follow_an_independent_integration(held: bool) -> None:
    measured = record(1, held=held)
    runs = free_run(rubbing(), measured, horizon=0.4, every=0.2, outputs=["q", "w"], steps=8)
    np.testing.assert_allclose(runs.start, [0.2, 0.4, 0.6, 0.8])
    assert runs.predicted.shape == (4, 40, 2)
    # the record is that integration, so from its own states the runs must stay on it
    assert np.abs(runs.predicted - runs.measured).max() < 1e-4 * np.ptp(measured["w"])
    assert runs.rmse["q"] < 1e-5


def test_velocity_comes_from_the_past_alone() -> None:
    plant = pam.Plant("coasting")
    q, w = plant.state("q"), plant.state("w")
    plant.der(q, w)
    plant.der(w, 0.0)
    t = np.arange(60) / 100
    bent = np.where(t <= 0.2, 2 * t, 0.4 - 3 * (t - 0.2))  # turns round at the first start
    runs = free_run(plant, pam.Trajectory(t, {"q": bent}), horizon=0.1, every=0.2)
    np.testing.assert_allclose(runs.predicted[0, :, 0], 0.4 + 2 * runs.t, atol=1e-12)
    np.testing.assert_allclose(runs.predicted[1], runs.measured[1], atol=1e-12)


def test_outputs_are_read_with_the_inputs_of_their_time() -> None:
    measured = record(4)
    torque = TRUTH["gain"] * measured["u"] - TRUTH["stiffness"] * measured["q"]
    columns = {n: measured[n] for n in ("q", "w", "u")}
    whole = pam.Trajectory(measured.t, {**columns, "torque": torque})
    runs = free_run(rubbing(), whole, horizon=0.4, every=0.2, outputs=["torque"], steps=8)
    assert runs.rmse["torque"] < 1e-3 * np.std(torque)


def test_the_truth_comes_back_from_stick_and_slip() -> None:
    records = [record(seed) for seed in range(3)]
    off = rubbing().with_values(stiffness=30.0, damping=3.0, friction=0.8, gain=22.0)
    fit = fit_free_run(off, records, list(TRUTH), horizon=0.4, every=0.1, outputs=["q"], steps=8)
    for name, value in TRUTH.items():
        assert fit.values[name] == pytest.approx(value, rel=0.02)
        assert fit.plant.variable(name).start == fit.values[name]
    assert fit.cost[1] < 1e-4 * fit.cost[0]
    assert fit.integration_error["q"] < 0.01 * np.std([r["q"] for r in records])
    assert fit.at_bound == ()
    assert "free runs of 0.4 s" in str(fit)


def test_a_value_held_back_by_its_range_is_named() -> None:
    asked = {"horizon": 0.4, "every": 0.1, "outputs": ["q"], "bounds": {"friction": (0.1, 1.0)}}
    fit = fit_free_run(rubbing().with_values(friction=0.5), record(7), ["friction"], **asked)
    assert fit.at_bound == ("friction",)
    assert fit.values["friction"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"horizon": 0.123456}, "horizon = 0.123456 s is no multiple of the sampling time 0.01 s"),
        ({"every": 0.0}, "every"),
        ({"horizon": 3.0}, "the longest lasts 1.2 s"),
        ({"history": 1}, "history = 1: give a whole number >= 2"),
        ({"steps": 0}, "steps = 0"),
    ],
)
def test_arguments_that_cannot_be(options: dict[str, float], words: str) -> None:
    refused(words, free_run, rubbing(), record(1), **{"horizon": 0.4, "every": 0.2, **options})


def test_records_that_cannot_be() -> None:
    good = record(1)
    late = good.t + 0.005 * (np.arange(len(good)) >= 60)
    columns = {n: good[n] for n in ("q", "w", "u")}
    broken = {**columns, "u": np.where(good.t > 0.5, np.nan, good["u"])}
    for t, given, words in (
        (late, columns, r"a step of 0\.015 s at t = 0\.59 s"),
        (good.t, {"q": good["q"]}, "no column for the input u"),
        (good.t, broken, "an input is not finite"),
    ):
        refused(words, free_run, rubbing(), pam.Trajectory(t, given), horizon=0.4, every=0.2)


@pytest.mark.parametrize(
    ("free", "error", "words"),
    [
        ([], InputError, "free is empty"),
        (["friction", "idle"], FitError, "idle has no influence"),
        (["fricton"], UnknownNameError, "fricton"),
    ],
)
def test_parameters_that_cannot_be_fitted(free: list[str], error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        fit_free_run(rubbing(), record(1), free, horizon=0.4, every=0.2, outputs=["q"])
    options: Any = {"horizon": 0.4, "every": 0.2, "evaluations": 0}
    refused(
        "evaluations = 0: give a whole", fit_free_run, rubbing(), record(1), ["friction"], **options
    )


def test_a_motion_that_is_small_beside_its_nominal_is_fitted_by_least_squares() -> None:
    """2 mrad of a joint whose nominal is 1 rad: no row is taken for a parting of the ways."""
    plant = pam.Plant("swinging", "a joint with a spring")
    q, w = plant.state("q", unit="rad"), plant.state("w", unit="rad/s")
    u, k, c = plant.input("u"), plant.parameter("k", 40.0), plant.parameter("c", 1.5)
    plant.der(q, w)
    plant.der(w, u - k * q - c * w)
    t = 0.01 * np.arange(400)
    told = {"u": 0.05 * force(t, 5)}
    run = pam.simulate(plant, told, t=t, interpolation="linear", rtol=1e-10)
    shown = noisy_record(plant, run, told, {"q": 1e-4}, np.random.default_rng(6), "linear")
    beside = plant.with_values(k=50.0, c=1.0)
    fit = fit_free_run(beside, shown, ["k", "c"], horizon=None, judge=False)
    runs = runs_of(fit.plant, shown, **{**fit.options, "outputs": ["q"]})
    rollout = Rollout(fit.plant, runs, fit.unknowns, fit.rig)
    assert rollout.normal(fit.z)[3] == 0
    slopes, errors = rollout.jacobian(fit.z, damped=False), rollout.residuals(fit.z)
    cosines = slopes.T @ errors / np.linalg.norm(slopes, axis=0) / np.linalg.norm(errors)
    assert np.abs(cosines).max() < 1e-3
