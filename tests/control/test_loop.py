"""The one closed loop: what noise, delay, estimators, disturbances and references do, by hand."""

from functools import partial

import numpy as np
import pytest
from conftest import refused
from design_tools import Fixed

import pam_ocp as pam
from pam_ocp import UnknownNameError
from pam_ocp.control.loop import ClosedLoop, closed_loop
from pam_ocp.control.references import source, visits

H, N = 0.05, 40
A, B = np.array([[1.0, H], [0.0, 1.0]]), np.array([H * H / 2, H])


def cart(limit=np.inf):
    """x'' = u + d: exactly x+ = A x + B (u + d) over a sample."""
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    u = plant.input("u", unit="N", min=-limit, max=limit)
    d = plant.input("d", unit="N", disturbance=True)
    plant.der(x, v)
    plant.der(v, u + d)
    return plant


def by_hand(answer, start, delay=0, disturbance=lambda t: 0.0):
    """States (N + 1, 2) and inputs (N,) of the loop, by the exact recursion."""
    z, rows, waiting, inputs = np.array(start, float), [start], [0.0] * delay, []
    for k in range(N):
        waiting.append(answer(z))
        inputs.append(waiting.pop(0))
        z = A @ z + B * (inputs[-1] + disturbance(k * H))
        rows.append(z)
    return np.array(rows), np.array(inputs)


def regulator(**options):
    return pam.lqr(cart(), {"x": 0.0}, weights={"x": 2.0, "v": 1.0}, sample_time=H, **options)


def moved(run):
    return run.trajectory.array(["x", "v"])


START = {"x": 0.3, "v": -0.1}


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_an_lqr_loop_with_delay_is_its_recursion(delay):
    feedback = regulator()
    run = closed_loop(feedback, cart(), duration=N * H, start=START, delay=delay)
    states, inputs = by_hand(lambda z: -(feedback.K @ z).item(), [0.3, -0.1], delay)
    assert moved(run) == pytest.approx(states, abs=1e-8)
    assert run["u"][:-1] == pytest.approx(inputs, abs=1e-8)


def test_an_lqr_loop_with_noise_is_its_recursion():
    feedback, sigma = regulator(), {"v": 0.02, "x": 0.01}
    run = closed_loop(feedback, cart(), duration=N * H, start=START, noise=sigma, seed=11)
    draw = np.random.default_rng(11).standard_normal
    errors = []

    def answer(z):
        v, x = 0.02 * draw(), 0.01 * draw()
        errors.append([x, v])
        return -(feedback.K @ (z + errors[-1])).item()

    states, _ = by_hand(answer, [0.3, -0.1])
    assert moved(run) == pytest.approx(states, abs=1e-8)
    seen = run.seen.array(["x", "v"])[:-1]
    assert seen - states[:-1] == pytest.approx(np.array(errors), abs=1e-8)


@pytest.mark.parametrize(("delay", "sigma"), [(0, 0.01), (2, 0.0), (2, 0.01)])
def test_a_pid_loop_with_noise_and_delay_is_its_recursion(delay, sigma):
    def made():
        pid = pam.control.PID(2.0, ki=0.3, kd=1.5, filter_time=0.03)
        return lambda x: pid(0.2 - x, H)

    acts, acts_by_hand = made(), made()
    draw = np.random.default_rng(4).standard_normal
    answer, real = lambda t, y: {"u": acts(y["x"])}, {"noise": {"x": sigma}, "seed": 4}
    run = closed_loop(answer, cart(), duration=N * H, sample_time=H, delay=delay, **real)
    states, _ = by_hand(lambda z: acts_by_hand(z[0] + sigma * draw()), [0.0, 0.0], delay)
    assert np.abs(states).max() > 0.1
    assert moved(run) == pytest.approx(states, abs=1e-8)


def lag():
    plant = pam.Plant("lag")
    x, u = plant.state("x", unit="m"), plant.input("u", unit="N", min=-1.0, max=1.0)
    plant.der(x, u - x)
    return plant


@pytest.mark.parametrize("guard", [None, {"limits": {"u": (-0.8, 0.9)}}])
def test_an_integral_leaves_a_limit_when_the_set_point_comes_back_into_reach(guard):
    law = pam.lqr(lag(), {"u": 0.0}, integral={"x": 5.0}, sample_time=H)
    if guard is not None:
        law = pam.control.BlockController(pam.control.block(law, plant=lag(), **guard))
    run = closed_loop(law, lag(), {"x": lambda t: 2.0 if t < 12 else 0.5}, duration=18.0)
    assert run["x"][-1] == pytest.approx(0.5, abs=1e-3)


def test_set_points_are_told_in_units_and_a_reference_takes_the_place_of_its_own():
    plant = pam.Plant("two")
    for n in "ab":
        x, u = plant.state(n, unit="m"), plant.input(f"u{n}", unit="N")
        plant.der(x, u - x)
    design = {"integral": {"a": 9.0, "b": 9.0}, "sample_time": H}
    law = pam.lqr(plant, {"ua": 0.0, "ub": 0.0}, setpoint={"a": "30 cm", "b": 0.2}, **design)
    run = closed_loop(law, plant, {"b": 0.1}, duration=5.0)
    assert [run["a"][-1], run["b"][-1]] == pytest.approx([0.3, 0.1], abs=1e-3)
    wrong = pam.lqr(plant, {"ua": 0.0, "ub": 0.0}, setpoint=lambda t: {"ua": 1.0}, **design)
    refused("setpoint: ua is not integrated", closed_loop, wrong, plant, duration=1.0)


def test_a_controllers_own_sample_time_and_reference_are_the_loops():
    run = closed_loop(regulator(integral={"x": 1.0}), cart(), {"x": 0.1}, duration=20.0)
    assert np.diff(run.t) == pytest.approx(H)
    assert np.all(run.reference["x"] == 0.1)
    assert run.steady_error("x", 1.0) < 1e-3
    stops = {"stops": ["100 mm", -0.1], "dwell": "1 s", "rest": 0.0, "rest_from": 2.0}
    jump = closed_loop(regulator(integral={"x": 1.0}), cart(), {"x": stops}, duration=3.0)
    expected = np.select([jump.t < 1 - 1e-6, jump.t < 2 - 1e-6], [0.1, -0.1], 0.0)
    assert jump.reference["x"] == pytest.approx(expected)


def test_a_disturbance_may_act_from_a_time_on():
    feedback = regulator()
    run = closed_loop(feedback, cart(), duration=N * H, disturbances={"d": (0.4, "1 s")})
    push = lambda t: 0.4 if t >= 1.0 - 1e-9 else 0.0  # noqa: E731
    states, _ = by_hand(lambda z: -(feedback.K @ z).item(), [0.0, 0.0], 0, push)
    assert moved(run) == pytest.approx(states, abs=1e-8)
    assert run["d"][:-1] == pytest.approx([push(k * H) for k in range(N)])


# ---- estimators ----------------------------------------------------------------------------------
def watching():
    known = {"measured": {"x": 1e-3}, "process": {"v": 0.1}}
    return pam.control.kalman(cart(), {"x": 0.0}, **known, sample_time=H)


def test_what_counts_samples_is_run_at_its_own():
    """State feedback without memory may be sampled otherwise, a filter or an integral may not."""
    filtered, other = pam.control.WithEstimate(regulator(), watching()), {"sample_time": H / 2}
    assert closed_loop(filtered, cart(), duration=1.0).t[1] == pytest.approx(H)
    assert len(closed_loop(regulator(), cart(), duration=1.0, **other).t) == 41
    for law in (filtered, regulator(integral={"x": 1.0})):
        refused("make both equal", closed_loop, law, cart(), duration=1.0, **other)
    integrating = pam.lqr(cart(), {"x": 0.0}, integral={"x": 1.0})
    refused("design both for one", pam.control.WithEstimate, integrating, watching())


def test_the_loops_estimator_is_the_filter_that_a_controller_carries():
    watch = watching()
    shared = {"duration": N * H, "start": START, "noise": {"x": 1e-3}, "seed": 2}
    carrying = pam.control.WithEstimate(regulator(), watch)
    inside = closed_loop(carrying, cart(), sample_time=H, **shared)
    outside = closed_loop(regulator(), cart(), estimator=watch, **shared)
    assert moved(outside) == pytest.approx(moved(inside), abs=1e-12)
    assert set(outside.seen.names) == {"x", "v"}
    assert outside.estimate["x"] == pytest.approx(outside.seen["x"])


def test_of_a_linear_plant_all_estimators_end_at_one_covariance():
    """The stationary one by SciPy's Riccati equation, after the correction: white acceleration."""
    from scipy.linalg import solve_discrete_are

    sigma, drive = 1e-3, 0.1
    q, watch = drive**2 * np.array([[H**3 / 3, H**2 / 2], [H**2 / 2, H]]), watching()
    carried = pam.KalmanFilter(cart(), sample_time=H, measured={"x": sigma}, process={"v": drive})
    for _ in range(300):
        carried.predict()
        carried.correct({"x": 0.0})
    c = np.array([[1.0, 0.0]])
    p = solve_discrete_are(A.T, c.T, q, np.array([[sigma**2]]))
    left = p - p @ c.T @ c @ p / (p[0, 0] + sigma**2)
    for deviation in (watch.estimate.deviation, carried.estimate.deviation):
        assert [deviation["x"], deviation["v"]] == pytest.approx(np.sqrt(np.diag(left)), rel=1e-6)


@pytest.mark.parametrize("kind", [pam.KalmanFilter, pam.control.MovingHorizonEstimator])
def test_an_estimator_tells_an_lqr_loop_the_push_and_serves_twice_alike(kind):
    known = {"measured": {"x": 1e-4}, "process": {"v": 1e-3}, "unknown": {"d": (1.0, 0.05)}}
    watch = kind(cart(), sample_time=H, **known)
    heard = []
    feedback = regulator()

    def makes_good(t, seen):
        heard.append(seen["d"])
        return {"u": feedback(t, seen)["u"] - seen["d"]}

    real = {"disturbances": {"d": 0.5}, "start": {"x": 0.1}, "seed": 7}
    runs = [
        closed_loop(makes_good, cart(), duration=4.0, estimator=watch, **real) for _ in range(2)
    ]
    assert heard[len(heard) // 2 - 1] == pytest.approx(0.5, abs=0.05)
    assert abs(runs[0]["x"][-1]) < 0.01  # without it 0.5 / K is left
    assert np.array_equal(moved(runs[0]), moved(runs[1]))
    assert np.std(runs[0].seen["x"] - runs[0]["x"]) > 1e-6  # the noise that it expects acts


# ---- results and refusals ------------------------------------------------------------------------
def test_an_mpc_is_run_by_the_same_loop_and_reckons_with_its_delay():
    def mpc(delay):
        return pam.Mpc(
            cart(1.0), horizon=15, sample_time=H, delay=delay, track={"x": 1.0}, rate={"u": 0.01}
        )

    for delay in (0, 1):
        one = mpc(delay).closed_loop(cart(1.0), {"x": 0.05}, 1.0)
        other = closed_loop(mpc(delay), cart(1.0), {"x": 0.05}, duration=1.0)
        assert np.array_equal(moved(one), moved(other))
        assert (one["u"][0] == 0.0) == (delay == 1)
        assert len(one.statistics.steps) == 20
    late = closed_loop(mpc(0), cart(1.0), {"x": 0.05}, duration=1.0, delay=3)
    assert np.all(late["u"][:3] == 0.0)  # a computing time that it does not know of
    assert late["u"][3] != 0.0


def test_a_loop_without_reference_and_times_is_drawn_too():
    run = closed_loop(Fixed({"u": 0.1}), cart(), duration=0.5, sample_time=H)
    assert run.reference is run.statistics is run.prediction_error is None
    assert len(run.plot("free").axes) == 3  # two states and the inputs
    refused("knows no reference", run.steady_error, "x", 0.1)
    tracked = closed_loop(regulator(integral={"x": 1.0}), cart(), {"x": 0.1}, duration=0.5)
    assert len(tracked.plot().axes) == 3  # what is tracked, its error and the inputs


def test_inputs_of_several_units_are_drawn_in_a_panel_each():
    plant = pam.Plant("pushed")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    force, share = plant.input("force", unit="N"), plant.input("share", unit="1")
    pressure = plant.input("pressure", unit="Pa")
    plant.der(x, v)
    plant.der(v, force + share + 1e-6 * pressure)
    given = {"force": 2.0, "share": 0.5, "pressure": 3e5}
    run = closed_loop(Fixed(given), plant, duration=0.5, sample_time=H)
    panels = {ax.get_ylabel(): ax.lines for ax in run.plot().axes[2:]}
    assert set(panels) == {"inputs [N]", "inputs [1]", "inputs [bar]"}
    shown = {"force": ("N", 2.0), "share": ("1", 0.5), "pressure": ("bar", 3.0)}
    for name, (unit, value) in shown.items():
        (line,) = panels[f"inputs [{unit}]"]
        assert line.get_label() == name
        assert np.all(line.get_ydata() == value)


def test_a_saved_loop_is_read_whole_and_as_its_motion(tmp_path):
    watch = pam.KalmanFilter(cart(1.0), sample_time=H, measured={"x": 1e-4}, unknown={"d": (1, 1)})
    mpc = pam.Mpc(cart(1.0), horizon=10, sample_time=H, track={"x": 1.0}, rate={"u": 0.01})
    run = mpc.closed_loop(cart(1.0), {"x": 0.05}, 1.0, estimator=watch, parts=2)
    path = run.save(tmp_path / "run.npz")
    again = ClosedLoop.load(path)
    for name in ("trajectory", "seen", "reference", "estimate"):
        one, other = getattr(run, name), getattr(again, name)
        assert np.array_equal(one.t, other.t)
        assert np.array_equal(one.array(one.names), other.array(one.names))
    assert again.statistics == run.statistics
    assert again.prediction_error == run.prediction_error
    assert np.array_equal(pam.Trajectory.load(path)["x"], run["x"])
    plain = closed_loop(Fixed({}), cart(), duration=0.1).save(tmp_path / "plain.npz")
    assert ClosedLoop.load(plain).statistics is None
    motion = run.trajectory.save(tmp_path / "motion.npz")
    refused("is no closed loop", ClosedLoop.load, motion)
    (tmp_path / "junk.npz").write_bytes(b"junk")
    for kind in (ClosedLoop, pam.Trajectory):
        refused("cannot be read", kind.load, tmp_path / "junk.npz")


def test_what_a_loop_cannot_mean_is_refused():
    run, law, fixed, plant = partial(closed_loop, duration=1.0), regulator(), Fixed({}), cart()
    integrating = regulator(integral={"x": 1.0})
    refused("reference: v is not integrated", run, integrating, plant, {"v": 0.1})
    refused("is not told by the loop what to reach", run, fixed, plant, {"x": 0.1})
    refused("real side 'y'", run, law, plant, {"y": 0.1}, error=UnknownNameError)
    other = pam.Plant("other")
    other.der(other.state("x"), other.input("u") + other.parameter("rate", 1.0))
    words = "start: rate is a parameter; give states and inputs"
    refused(words, run, fixed, other, start={"rate": 2.0})
    words = r"disturbances\['d'\] = \(1, 2, 3\)"
    refused(words, run, law, plant, disturbances={"d": (1, 2, 3)})
    refused("x is a state of the plant, not an input", run, law, plant, disturbances={"x": 1.0})
    watch = pam.KalmanFilter(plant, sample_time=0.1, measured={"x": 1e-3})
    refused(r"estimator's sample_time is 0\.1 s", run, law, plant, estimator=watch)
    mpc = pam.Mpc(plant, horizon=5, sample_time=H, track={"x": 1.0})
    refused("controller's sample_time", run, mpc, plant, sample_time=0.1)


def test_values_over_time_are_what_they_say():
    assert source("r", "20 mm", "m")(3.0) == 0.02
    assert source("r", lambda t: 2 * t)(1.5) == 3.0
    assert [source("d", [5.0, 1.0], before=1.5)(t) for t in (0.0, 1.0, 2.0)] == [1.5, 5.0, 5.0]
    stepping = visits([1.0, 2.0, 3.0], 0.5, rest=9.0, rest_from=2.0)
    assert [stepping(t) for t in (0.0, 0.5, 1.2, 1.5, 2.0)] == [1.0, 2.0, 3.0, 1.0, 9.0]
    for wrong, words in (
        ({"stops": []}, "give stops"),
        ({"stops": [1], "pause": 1}, "pause"),
        ("fast", "fast"),
        (float("nan"), "finite"),
        ([1.0, 2.0], "not a number"),
    ):
        refused(words, source, "r", wrong)


@pytest.mark.slow
def test_an_fmu_without_its_plant_is_described_by_itself(tmp_path):
    plant = cart(limit=0.2)
    fmu = pam.export_fmu(plant, tmp_path / "cart.fmu", platforms="native")
    answer = lambda t, y: {"u": -0.5 if t > 0.2 else 0.4}  # noqa: E731
    shared = {"duration": 1.0, "sample_time": H, "parts": 2, "disturbances": {"d": (0.1, 0.5)}}
    one, other = (closed_loop(answer, side, **shared) for side in (plant, fmu))
    assert np.abs(other["u"]).max() == 0.2  # the range that the FMU tells of
    assert other.trajectory.variable("x").unit == "m"
    assert moved(one) == pytest.approx(moved(other), abs=1e-6)
    assert other["d"][:-1] == pytest.approx(one["d"][:-1])
