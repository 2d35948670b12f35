"""What stands between a plant and its record is found by free runs: dead time, sensors, starts."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.fitting.dynamic import rollout as rollout_module
from pam_ocp.fitting.dynamic.experiment import groups
from pam_ocp.fitting.dynamic.free_run_fit import fit_free_run, free_run
from pam_ocp.fitting.dynamic.rig import unknowns_of
from pam_ocp.fitting.dynamic.rollout import Rollout
from pam_ocp.fitting.dynamic.runs import runs_of

WHOLE: dict[str, Any] = {"horizon": None, "history": 2}
WHOLE["starts"] = {"z": "record", "w": "record"}
K, C, G, LAG, LATE = 40.0, 3.0, 30.0, 0.08, 0.034


def lagging() -> pam.Plant:
    """q'' = G z - K q - C q', LAG z' = u - z: z, a pressure, is not measured."""
    plant = pam.Plant("lagging")
    q, w, z = plant.state("q"), plant.state("w"), plant.state("z")
    u = plant.input("u")
    k, c = plant.parameter("k", K, nominal=K), plant.parameter("c", C, nominal=C)
    g, lag = plant.parameter("g", G, nominal=G), plant.parameter("lag", LAG, nominal=LAG, min=0.01)
    plant.der(q, w)
    plant.der(w, g * z - k * q - c * w)
    plant.der(z, (u - z) / lag)
    return plant


@cache
def record(
    seed: int,
    samples: int = 151,
    z0: float = 0.5,
    late: float = LATE,
    held: bool = False,
    noise: float = 0.0,
) -> pam.Trajectory:
    """The equations once more by SciPy; u acts ``late`` seconds after it was recorded."""
    random = np.random.default_rng(seed)
    t = 0.01 * np.arange(samples)
    knots = random.uniform(-1, 1, samples // 12 + 2)
    u = np.interp(t, 0.12 * np.arange(len(knots)), knots)
    if held:
        u = knots[(t / 0.12 + 1e-9).astype(int)]

    def value(time: float) -> float:
        if held:
            return float(u[max(0, min(samples - 1, int(np.floor((time - late) / 0.01 + 1e-9))))])
        return float(np.interp(time - late, t, u))

    def slope(time: float, x: np.ndarray) -> list[float]:
        return [x[1], G * x[2] - K * x[0] - C * x[1], (value(time) - x[2]) / LAG]

    tight = {"t_eval": t, "rtol": 1e-8, "atol": 1e-10, "max_step": 0.005}
    run = solve_ivp(slope, t[[0, -1]], [0.2, 0.0, z0], **tight)
    q = run.y[0] + noise * random.standard_normal(samples)
    return pam.Trajectory(t, {"q": q, "u": u}, interpolation="previous" if held else "linear")


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.slow
def test_dead_time_and_hidden_starts_come_back_from_whole_records(held: bool) -> None:
    records = [record(s, 100 + 20 * s, z0=0.3 * s, held=held) for s in range(2)]
    off = lagging().with_values(k=30.0, c=5.0, g=20.0, lag=0.05)
    late = {"u": (0, 0.2)}
    fit = fit_free_run(off, records, ["k", "c", "g", "lag"], delay=late, **WHOLE)
    assert fit.converged
    assert fit.rig.delays["u"] == pytest.approx(LATE, abs=1e-3)
    for name, truth in {"k": K, "c": C, "g": G, "lag": LAG}.items():
        assert fit.values[name] == pytest.approx(truth, rel=0.02)
    other = record(9, 140, z0=-0.4, held=held)
    assert fit.validate(other).rmse["q"] < 0.01 * np.std(other["q"])


def test_the_slope_over_everything_is_that_of_finite_differences() -> None:
    records = [record(1, 60), record(2, 45)]
    plant = lagging().with_values(k=33.0)
    for horizon, every in ((None, None), ((0.05, 0.15), 0.1)):
        runs = runs_of(plant, records, horizon, every, ["q"], 3, 2, 0.05)
        sensor = {"gains": ["q"], "offsets": ["q"], "starts": {"z": "record"}}
        free = groups(plant, ["k", "lag"], {})
        more = {"delay": (0.0, 0.1), "correct": {"z": ["q"]}, **sensor}
        unknowns, rig = unknowns_of(plant, free, ["q"], 2, 0.01, **more)
        rollout = Rollout(plant, runs, unknowns, rig)
        # off the kinks of the recorded input, where a dead time has two slopes
        z = unknowns.guess + np.where(np.arange(len(unknowns.names)) == 2, 0.237, 0.02)
        exact, step = rollout.jacobian(z), 1e-6
        for i, unit in enumerate(np.eye(len(z))):
            up, down = rollout.residuals(z + step * unit), rollout.residuals(z - step * unit)
            difference = (up - down) / (2 * step)
            np.testing.assert_allclose(exact[:, i], difference, atol=1e-5 * np.abs(exact).max())
        cost, gradient, square, _ = rollout.normal(z)
        residuals = rollout.residuals(z)
        assert cost == pytest.approx(residuals @ residuals)
        np.testing.assert_allclose(gradient, exact.T @ residuals, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(square, exact.T @ exact, rtol=1e-9, atol=1e-15)


def pressures(names: list[str]) -> tuple[Rollout, Any]:
    """Free runs of a load whose lag and damping are sought; the pressure needs no load."""
    plant = pam.HangingLoad("DMSP-20-200N", mass=5.0, damping=60.0)
    t = np.arange(0, 1.2, 0.01)
    u = np.where(t < 0.5, 1.5e5, 3e5)
    run = pam.simulate(plant, {"muscle.command": u}, t=t)
    columns = {n: run[n] for n in ("muscle.command", "x", "muscle.pressure")}
    record = pam.Trajectory(t, columns, [plant.variable(n) for n in columns], "previous")
    runs = runs_of(plant, [record], None, None, names, 3, 4)
    free = groups(plant, ["muscle.lag", "damping"])
    unknowns, rig = unknowns_of(plant, free, names, 1, 0.01)
    return Rollout(plant, runs, unknowns, rig), unknowns.guess


def test_states_that_the_outputs_do_not_need_stand_still_and_change_nothing() -> None:
    (alone, z), (both, _) = pressures(["muscle.pressure"]), pressures(["x", "muscle.pressure"])
    np.testing.assert_allclose(alone.predicted(z)[..., 0], both.predicted(z)[..., 1], rtol=1e-12)
    slopes = both.jacobian(z).reshape(-1, 2, len(z))[:, 1] * np.sqrt(2)
    np.testing.assert_allclose(alone.jacobian(z), slopes, rtol=1e-9, atol=1e-12)
    for (_, one), (_, other) in zip(alone.states(z), both.states(z), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)  # asked for, they all move


def test_a_compiled_step_says_what_the_interpreted_one_says(monkeypatch) -> None:
    plain, z = pressures(["x"])
    wanted, slopes = plain.predicted(z), plain.jacobian(z)
    called, original = [], rollout_module._compiled
    monkeypatch.setattr(rollout_module, "MANY", 0)
    kept = lambda f: called.append(original(f)) or called[-1]  # noqa: E731
    monkeypatch.setattr(rollout_module, "_compiled", kept)
    quick, _ = pressures(["x"])
    np.testing.assert_allclose(quick.predicted(z), wanted, rtol=1e-12)
    np.testing.assert_allclose(quick.jacobian(z), slopes, rtol=1e-9, atol=1e-12)
    if not all(f.class_name().endswith("External") for f in called):
        pytest.skip("no C compiler here")
    assert len(called) == 2


def test_gain_and_offset_of_a_sensor_come_back() -> None:
    clean = [record(s, late=0.0) for s in range(2)]
    columns = [{"q": 1.2 * r["q"] + 0.05, "u": r["u"]} for r in clean]
    shown = [pam.Trajectory(clean[0].t, c, interpolation="linear") for c in columns]
    off = lagging().with_values(k=35.0)
    fit = fit_free_run(off, shown, ["k", "c"], gains=["q"], offsets=["q"], **WHOLE)
    assert fit.rig.gains["q"] == pytest.approx(1.2, rel=0.01)
    assert fit.rig.offsets["q"] == pytest.approx(0.05, abs=2e-3)
    assert fit.values["k"] == pytest.approx(K, rel=0.01)


def test_an_observer_brings_hidden_states_to_where_they_belong() -> None:
    records = [record(s, late=0.0) for s in range(2)]
    common: dict[str, Any] = {"horizon": 0.1, "every": 0.05, "history": 2}
    blind = free_run(lagging(), records, **common)
    fit = fit_free_run(lagging(), records, [], warm_up=0.15, correct={"z": ["q"]}, **common)
    assert fit.training.rmse["q"] < 0.3 * blind.rmse["q"]
    assert set(fit.rig.corrections) == {("q", "q"), ("w", "q"), ("z", "q")}


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside, total = 0, 0
    for seed in range(8):
        records = [record(10 * seed + s, 120, late=0.0, noise=2e-3) for s in range(3)]
        asked = {"steps": 2, "begin_short": False, **WHOLE}
        fit = fit_free_run(lagging(), records, ["k", "c", "g"], **asked)
        for name, truth in {"k": K, "c": C, "g": G}.items():
            low, high = fit.interval(name)
            inside, total = inside + (low <= truth <= high), total + 1
    assert inside >= 0.8 * total


def test_several_horizons_weigh_alike() -> None:
    runs = runs_of(lagging(), record(1, 101), (0.1, 0.2, 0.5), 0.1, ["q"], 3, 2)
    assert runs.length.max() == 50
    assert runs.length.min() == 10
    assert runs.weights.sum() == pytest.approx(1.0)
    # a third of the weight belongs to each horizon; the longest alone has the samples behind 0.2 s
    share = runs.weights[:, 20:].sum()
    assert share == pytest.approx((50 - 20) / 50 / 3)


def test_a_wild_run_is_damped_and_the_fit_still_comes_home() -> None:
    """An upright pendulum: its slope grows by e^16 within 2 s, whichever way it falls."""
    plant = pam.Plant("upright")
    q, w = plant.state("q"), plant.state("w")
    a = plant.parameter("a", 64.0, nominal=64.0, min=1.0)
    plant.der(q, w)
    plant.der(w, a * ca.sin(q))
    t = 0.01 * np.arange(200)
    exact = {"t_eval": t, "rtol": 1e-10, "atol": 1e-12}
    run = solve_ivp(lambda _, x: [x[1], 64 * np.sin(x[0])], t[[0, -1]], [1e-3, 0.0], **exact)
    measured = pam.Trajectory(t, {"q": run.y[0], "w": run.y[1]})
    asked = {"horizon": 1.5, "every": 0.1, "steps": 8, "outputs": ["q"]}
    fit = fit_free_run(plant.with_values(a=50.0), measured, ["a"], **asked)
    assert fit.values["a"] == pytest.approx(64.0, rel=2e-3)


@pytest.mark.slow
def test_progress_is_told_and_a_time_limit_keeps_the_best() -> None:
    told: list[tuple[str, int, float]] = []
    records = [record(s, late=0.0) for s in range(2)]
    off = lagging().with_values(k=20.0, c=8.0)

    def slow(stage: str, count: int, cost: float) -> None:
        told.append((stage, count, cost))
        if count == 2:
            time.sleep(2.0)

    asked = {"horizon": 0.1, "every": 0.05, "progress": slow, "time_limit": 2.0}
    fit = fit_free_run(off, records, ["k", "c", "g"], **asked)
    assert not fit.converged
    assert "time limit" in fit.status
    assert any("did not come to its end" in w for w in fit.warnings)
    assert fit.cost[1] < fit.cost[0]
    assert told[0][1] == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"delay": {"q": 0.1}}, "q is no input"),
        ({"delay": (0.2, 0.1)}, "the lower must be the smaller"),
        ({"offsets": ["z"]}, "z is not measured"),
        ({"starts": ["q"]}, "q is measured"),
        ({"starts": {"z": "each"}}, "choose 'all', 'record' or 'plant'"),
        ({"correct": True}, "correct needs warm_up"),
        ({"every": None}, "every: give the time"),
    ],
)
def test_what_cannot_be_is_refused(options: dict[str, object], words: str) -> None:
    given = {"horizon": 0.1, "every": 0.1, **options}
    refused(words, fit_free_run, lagging(), record(1), ["k"], **given)


# ---- held inputs that are late, and the length of the steps -----------------------------------
def cubed() -> pam.Plant:
    """a' = u^3, b' = v^3: what a mean of u over a jump would get wrong."""
    plant = pam.Plant("cubed")
    a, b = plant.state("a"), plant.state("b")
    u, v, k = plant.input("u"), plant.input("v"), plant.parameter("k", 1.0)
    plant.der(a, k * u**3)
    plant.der(b, v**3 + 0 * a)
    return plant


@pytest.mark.parametrize("late", [(0.034, 0.0271), (0.0271, 0.034), (0.02, 0.0), (-0.013, 0.01)])
def test_held_inputs_jump_where_their_dead_times_say(late: tuple[float, float]) -> None:
    """Integrals of held values, exact with one step; their slope is the jump that goes by."""
    random = np.random.default_rng(7)
    t = 0.01 * np.arange(31)
    u, v = random.uniform(-1, 1, (2, 31))

    def integral(values: np.ndarray, time: np.ndarray, by: float) -> np.ndarray:
        """Of the cubes of values held from their samples on, the first one before all of them."""
        sums = np.concatenate([[0.0], np.cumsum(values[:-1] ** 3 * 0.01)])
        rest = np.concatenate([values[:-1], values[-1:]]) ** 3

        def to(at: np.ndarray) -> np.ndarray:
            place = np.clip(np.floor(at / 0.01 + 1e-9).astype(int), 0, 30)
            return sums[place] + rest[place] * (at - 0.01 * place)

        return to(time - by) - to(np.array([0.01 - by]))

    record = pam.Trajectory(t, {"a": 0 * t, "b": 0 * t, "u": u, "v": v}, interpolation="previous")
    plant = cubed()
    runs = runs_of(plant, record, None, None, ["a", "b"], 2, 1)
    delay = {n: (by - 0.02, by + 0.02) for n, by in zip("uv", late, strict=True)}
    unknowns, rig = unknowns_of(plant, (), ["a", "b"], 1, 0.01, delay=delay)
    rollout = Rollout(plant, runs, unknowns, rig)
    z = unknowns.guess
    found = rollout.predicted(z)[0]
    inside = slice(0, 26)  # behind a negative dead time the record has no more to say
    for k, (values, by) in enumerate(((u, late[0]), (v, late[1]))):
        expected = integral(values, t[2:], by)
        np.testing.assert_allclose(found[inside, k], expected[inside], rtol=0, atol=1e-13)
    delay = dict(zip("uv", late, strict=True))
    known = free_run(plant, record, horizon=None, history=2, delay=delay, steps=1)
    np.testing.assert_allclose(known.predicted[0], found, rtol=0, atol=1e-13)
    if min(late) > 0.02:  # inside of a sampling interval: one slope
        step = 1e-5
        exact = rollout.jacobian(z)
        for i, unit in enumerate(np.eye(2)):
            up, down = rollout.residuals(z + step * unit), rollout.residuals(z - step * unit)
            np.testing.assert_allclose(exact[:, i], (up - down) / (2 * step), atol=1e-8)


def ringing(rate: float) -> pam.Plant:
    plant = pam.Plant("ringing")
    q, w = plant.state("q"), plant.state("w")
    k = plant.parameter("k", rate**2, nominal=rate**2, min=1.0)
    c = plant.parameter("c", 4.0, nominal=4.0, min=0.0)
    plant.der(q, w)
    plant.der(w, -k * q - c * w)
    return plant


def rung(noise: float, seed: int) -> pam.Trajectory:
    """The closed form of a damped oscillation of 120 rad/s, sampled every 10 ms."""
    t = 0.01 * np.arange(200)
    fast = np.sqrt(120.0**2 - 4.0)
    q = np.exp(-2 * t) * np.cos(fast * t)
    w = np.exp(-2 * t) * (-2 * np.cos(fast * t) - fast * np.sin(fast * t))
    of_q, of_w = noise * np.random.default_rng(seed).standard_normal((2, 200))
    return pam.Trajectory(t, {"q": q + of_q, "w": w + 120 * of_w})


def test_steps_are_as_many_as_the_intervals_ask_for() -> None:
    """Four steps to a sample shift the frequency by far more than its standard error."""
    measured, options = rung(1e-2, 11), {"horizon": 0.2, "every": 0.1, "outputs": ["q", "w"]}
    fit = fit_free_run(ringing(118.0), measured, ["k", "c"], **options)
    assert fit.fine
    assert fit.options["steps"] > 4
    assert not fit.warnings
    for name, truth in {"k": 120.0**2, "c": 4.0}.items():
        low, high = fit.interval(name, 0.999)
        assert low <= truth <= high
    with pytest.warns(RuntimeWarning, match=r"coarse for these records.*steps=8"):
        coarse = fit_free_run(ringing(118.0), measured, ["k", "c"], steps=2, **options)
    assert not coarse.fine
    off = abs(coarse.values["k"] - 120.0**2)
    # what it says of its own error is of the right size: half of the true shift at least
    # in standard errors of the noise alone: those reported are widened for what is not noise
    shift = coarse.moved["k"] * coarse.spread.coefficients["k"].stderr
    assert 0.4 * off < shift < 2.5 * off


def test_runs_without_a_fit_have_steps_enough() -> None:
    measured = rung(0.0, 1)
    runs = free_run(ringing(120.0), measured, horizon=0.2, every=0.1, outputs=["q"])
    few = free_run(ringing(120.0), measured, horizon=0.2, every=0.1, outputs=["q"], steps=4)
    assert runs.rmse["q"] < 2e-3 * np.std(measured["q"]) < few.rmse["q"]


def test_a_table_of_free_runs_holds_values_and_intervals() -> None:
    fit = fit_free_run(lagging(), record(4, late=0.0), ["k", "c"], horizon=0.2, every=0.1)
    table = fit.to_pandas()
    assert list(table.index) == ["k", "c"]
    for name, (low, high) in fit.intervals().items():
        assert (table.loc[name, "low"], table.loc[name, "high"]) == (low, high)
        assert table.loc[name, "value"] == fit.values[name]


def test_what_only_a_sum_tells_has_no_standard_error() -> None:
    """Two springs side by side: their sum is seen, neither of them is."""
    plant = pam.Plant("two_springs")
    q, w, u = plant.state("q"), plant.state("w"), plant.input("u")
    k1, k2, c = (plant.parameter(n, v, nominal=v) for n, v in (("k1", 15), ("k2", 20), ("c", C)))
    plant.der(q, w)
    plant.der(w, G * u - (k1 + k2) * q - c * w)
    t = 0.01 * np.arange(200)
    true = plant.with_values(k1=K - 20.0)
    run = pam.simulate(true, {"u": (t, np.sin(3 * t))}, t=t, interpolation="linear")
    shown = run["q"] + 1e-4 * np.random.default_rng(2).standard_normal(len(t))
    seen = pam.Trajectory(t, {"q": shown, "u": run["u"]}, interpolation="linear")
    fit = fit_free_run(plant, seen, ["k1", "k2", "c"], horizon=None)
    assert np.isinf(fit.coefficients["k1"].stderr)
    assert np.isinf(fit.coefficients["k2"].stderr)
    assert fit.values["k1"] + fit.values["k2"] == pytest.approx(K, rel=0.01)
    assert fit.coefficients["c"].stderr < 0.1 * C
    assert fit.values["c"] == pytest.approx(C, abs=4 * fit.coefficients["c"].stderr)
