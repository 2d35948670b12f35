"""LQR, LQI, Kalman filter, gain scheduling."""

import numpy as np
import pytest
from conftest import pushed, refused
from design_tools import Fixed, weakened
from scipy import integrate, linalg

import pam_ocp as pam
from pam_ocp.control.along_motion import tvlqr
from pam_ocp.control.analysis import margins
from pam_ocp.control.estimators.stationary import WithEstimate, kalman
from pam_ocp.control.linear_quadratic import lqr, scheduled_lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.references import moves
from pam_ocp.plants.valves import SpoolValve


# ---- LQR, LQI, Kalman
def test_lqr_of_the_double_integrator_is_the_textbooks():
    """Cost q^2 x^2 + r^2 u^2: K = [q/r, sqrt(2 q/r)]."""
    plant = pushed(np.inf)
    point = pam.operating.OperatingPoint(plant, np.zeros(2), np.zeros(1))
    feedback = lqr(plant, point, weights={"x": 3.0}, effort=0.5)
    assert np.allclose(feedback.K, [[6.0, np.sqrt(12.0)]], rtol=1e-10)


def test_weights_count_in_units_of_nominal(hanging):
    """An independent solution of the Riccati equation in SI, its weights written out."""
    point = hanging.equilibrium(x=0.06)
    feedback = lqr(hanging, point, weights={"x": 5.0, "muscle.force": 0.3}, effort=2.0)
    system = hanging.linearize(point, outputs=["x", "muscle.force"])
    scale = np.diag([5.0 / 0.01, 0.3 / 100.0])
    c = scale @ np.asarray(system.C)
    r = np.array([[(2.0 / 1e5) ** 2]])
    p = linalg.solve_continuous_are(system.A, system.B, c.T @ c, r)
    assert np.allclose(feedback.K, np.linalg.solve(r, np.asarray(system.B).T @ p), rtol=1e-5)


@pytest.mark.parametrize("sampled", [False, True])
def test_an_output_that_the_input_enters_at_once_is_weighed_and_integrated(sampled):
    """x' = -x + u, y = x + 2 u; the cost (3 y)^2 + (2 u)^2 + (5 z)^2, z' = y, has a cross term."""
    plant = pam.Plant("direct")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, u - x)
    plant.output("y", x + 2 * u)
    motion = pam.simulate(plant, {"u": 0.0}, t=np.linspace(0, 1, 11))
    cost = {"weights": {"y": 3.0}, "effort": 2.0, "integral": {"y": 5.0}, "sampled": sampled}
    feedback = lqr(plant, {"u": 0.0}, sample_time=0.1, **cost)
    varying = tvlqr(plant, motion, sample_time=0.1, **cost)
    a, b = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[1.0], [2.0]])
    q, r, s = np.diag([9.0, 25.0]), np.array([[4.0 + 36.0]]), np.array([[18.0], [0.0]])
    if sampled:
        whole = linalg.expm(0.1 * np.block([[a, b], [np.zeros((1, 3))]]))
        a, b = whole[:2, :2], whole[:2, 2:]
        p = linalg.solve_discrete_are(a, b, q, r, s=s)
        k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a + s.T)
    else:
        p = linalg.solve_continuous_are(a, b, q, r, s=s)
        k = np.linalg.solve(r, b.T @ p + s.T)
        assert np.sort(feedback.poles) == pytest.approx(np.sort(np.linalg.eigvals(a - b @ k)))
    assert np.hstack([feedback.K, feedback.Ki]) == pytest.approx(k, rel=1e-9)
    for gains, ki in zip(varying.K, varying.Ki, strict=True):
        assert np.hstack([gains, ki]) == pytest.approx(k, rel=1e-5)


def test_the_loop_of_an_lqr_keeps_its_distance_from_minus_one(slide):
    """Kalman's inequality: sigma_min(I + L) >= 1, so phase margins of 60 deg, gains up to inf."""
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    for integral in ({}, {"x": 80.0, "stiffness": 5.0}):
        found = margins(lqr(slide, point, integral=integral).loop)
        assert found.all_inputs >= 1 - 1e-6
        assert min(found.phase) >= 60
        assert min(found.modulus) >= 1 - 1e-6
        assert found.gain == (np.inf, np.inf)


def test_near_the_stop_the_nonlinear_loop_moves_as_linear_theory_says(slide):
    point = slide.equilibrium(x=0.002, stiffness=2.2e4)
    feedback = lqr(slide, point, sample_time=1e-4)
    start = {v.name: point[v.name] for v in slide.states} | {"x": point.x[0] + 1e-6}
    run = closed_loop(feedback, slide, duration=0.06, sample_time=1e-4, start=start)
    a = np.asarray(feedback.system.A) - np.asarray(feedback.system.B) @ feedback.K
    step, d = linalg.expm(a * 1e-4), [np.array([1e-6, 0, 0, 0])]
    for _ in run.t[1:]:
        d.append(step @ d[-1])
    assert run["x"] - point.x[0] == pytest.approx(np.array(d)[:, 0], abs=2e-8)


def test_a_sampled_design_solves_the_discrete_riccati_equation(slide):
    point, sample_time = slide.equilibrium(x=0.0, stiffness=2.2e4), 0.01
    how = {"weights": {"x": 10.0, "v": 1.0}, "sampled": True}
    feedback = lqr(slide, point, sample_time=sample_time, **how)
    system = slide.linearize(point, dt=sample_time)
    a, b = np.asarray(system.A), np.asarray(system.B)
    n, e = slide.vector("state", attribute="nominal"), np.full(2, 1e5)
    a, b = a * n / n[:, None], b * e / n[:, None]
    q, r = sample_time * np.diag([100.0, 1.0, 0, 0]), sample_time * np.eye(2)
    p = linalg.solve_discrete_are(a, b, q, r)
    k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a) * e[:, None] / n
    assert np.allclose(feedback.K, k, rtol=1e-6, atol=1e-6 * np.abs(k).max())


def test_integral_action_removes_the_error_that_lqr_leaves(slide):
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    true = {"mass": 3.0, **weakened(slide, 0.95)}
    start = {n: point[n] for n in ("x", "muscle1.pressure", "muscle2.pressure")}
    left = {}
    for name, integral in (("LQR", {}), ("LQI", {"x": 100.0})):
        feedback = lqr(slide, point, integral=integral)
        run = closed_loop(feedback, slide, duration=1.0, start=start, parameters=true)
        left[name] = abs(run["x"][-1] - 0.004)
    assert left["LQR"] > 1e-4
    assert left["LQI"] < 1e-6


def test_an_lqi_goes_to_another_set_point(slide):
    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    feedback = lqr(slide, point, integral={"x": 100.0}, setpoint={"x": 0.003})
    start = {n: point[n] for n in ("muscle1.pressure", "muscle2.pressure")}
    run = closed_loop(feedback, slide, duration=1.0, start=start)
    assert run["x"][-1] == pytest.approx(0.003, abs=1e-6)


def test_lqr_says_what_cannot_be_stabilised_or_weighed(long_muscle, slide):
    counted = pam.HangingLoad(long_muscle, feed=SpoolValve(totals=True))
    start = counted.vector("state"), counted.vector("input")
    somewhere = pam.operating.OperatingPoint(counted, *start)
    refused("totals of gas feeds", lqr, counted, somewhere, weights={"muscle.work": 1.0, "x": 1.0})
    point, one = slide.equilibrium(x=0.0, stiffness=2.2e4), {"muscle1.command": 1.0}
    refused(r"weights: muscle1\.command is no state or output", lqr, slide, point, weights=one)
    refused(r"effort: no weight for the input muscle2\.command", lqr, slide, point, effort=one)


@pytest.mark.parametrize("sample_time", [2e-3, 0.05])
def test_the_kalman_gain_is_that_of_the_dual_riccati_equation(sample_time, hanging):
    point = hanging.equilibrium(x=0.06)
    known = {"measured": {"x": 1e-4}, "process": {"v": 2.0}}
    found = kalman(hanging, point, **known, sample_time=sample_time)
    system = hanging.linearize(point, outputs=["x"], dt=sample_time)
    a, c = np.asarray(system.A), np.asarray(system.C)
    still, r = np.asarray(hanging.linearize(point).A), np.array([[1e-8]])
    push = lambda s: 2.0 * 0.1 * linalg.expm(still * s)[:, 1]  # noqa: E731
    q, _ = integrate.quad_vec(lambda s: np.outer(push(s), push(s)), 0.0, sample_time)
    scale = np.diag([1.0, 1.0, 1e-5])  # Pa beside m would cost SciPy its small entries
    back = np.linalg.inv(scale)
    p = linalg.solve_discrete_are((scale @ a @ back).T, (c @ back).T, scale @ q @ scale, r)
    p = back @ p @ back
    assert np.allclose(found.gain, p @ c.T / (c @ p @ c.T + r), rtol=1e-5, atol=1e-9)


def test_the_filter_finds_velocity_and_pressure_from_the_position(hanging):
    point = hanging.equilibrium(x=0.06)
    known = {"measured": {"x": 2e-5}, "process": {"v": 0.1, "muscle.pressure": 0.1}}
    watch = kalman(hanging, point, **known, sample_time=1e-3)
    command = point["muscle.command"] + 2e3
    estimates = []

    class Watching:
        def reset(self):
            watch.reset()

        def __call__(self, t, measured):
            estimates.append(watch.correct(measured))
            inputs = {"muscle.command": command}
            watch.predict(inputs)
            return inputs

    start = {"x": 0.06, "v": 0.02, "muscle.pressure": point["muscle.pressure"] - 3e3}
    run = closed_loop(Watching(), hanging, duration=1.0, start=start, noise={"x": 2e-5}, seed=5)
    truth = run.trajectory.array([v.name for v in hanging.states])[:-1]
    error = np.abs(np.array(estimates) - truth)
    late = error[500:]
    assert error[0, 1] == pytest.approx(0.02, rel=0.2)  # it did not know the velocity at first
    assert np.sqrt(np.mean(late[:, 1] ** 2)) < 2e-3
    assert np.sqrt(np.mean(late[:, 0] ** 2)) < 2e-5  # better than the sensor
    assert np.sqrt(np.mean(late[:, 2] ** 2)) < 1e3


def test_a_controller_behind_a_filter_sees_the_estimate_only(hanging):
    point = hanging.equilibrium(x=0.06)
    inner = Fixed({"muscle.command": point["muscle.command"]})
    watch = kalman(hanging, point, measured={"x": 1e-5}, sample_time=1e-3)
    start = {"x": 0.058, "muscle.pressure": point["muscle.pressure"]}
    closed_loop(WithEstimate(inner, watch, ["muscle.force"]), hanging, duration=0.01, start=start)
    assert set(inner.seen[0]) == {"x", "v", "muscle.pressure", "muscle.force"}
    assert inner.seen[0]["x"] != 0.058


def test_lqg_holds_a_stop_from_noisy_measurements(slide):
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    noise = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    watch = kalman(slide, point, measured=noise, process={"v": 5.0, "muscle1.pressure": 1.0})
    start = {n: point[n] for n in ("muscle1.pressure", "muscle2.pressure")} | {"x": 0.001}
    law = WithEstimate(lqr(slide, point, integral={"x": 100.0}), watch)
    real = {"start": start, "noise": noise, "parameters": {"mass": 2.5}}
    run = closed_loop(law, slide, duration=0.6, **real)
    late = run["x"][run.t > 0.4] - 0.004
    assert np.abs(late).max() < 1e-4


# ---- gain scheduling
def test_at_a_grid_point_the_schedule_has_the_gains_of_the_lqr_there(slide):
    axes = {"x": [-0.004, 0.0, 0.004], "stiffness": [2.1e4, 2.4e4]}
    here = {"x": 0.0, "stiffness": 2.4e4}
    found = scheduled_lqr(slide, axes, lambda t: here, integral={"x": 50.0})
    own = lqr(slide, slide.equilibrium(here), integral={"x": 50.0})
    assert np.allclose(found.K[1, 1], own.K, rtol=1e-9)
    measured = {v.name: x for v, x in zip(slide.states, own.point.x, strict=True)}
    answer = found(0.0, measured)
    assert [answer[n] for n in own.inputs] == pytest.approx(own.point.u, rel=1e-9)


def test_beyond_its_grid_a_schedule_stays_at_the_border(slide):
    axes = {"x": [-0.004, 0.004], "stiffness": [2.1e4, 2.4e4]}
    found = scheduled_lqr(slide, axes, lambda t: {"x": 0.02, "stiffness": 1e4})
    assert found.where(0.0) == {"x": 0.004, "stiffness": 2.1e4}


def test_a_scheduled_joint_follows_position_and_stiffness_at_once(joint):
    angle, stiffening = moves([0.0, 0.5], [0.1], 0.7), moves([14.0, 34.0], [0.1], 0.7)

    def place(t):
        return {"theta": angle(t)[0], "stiffness": stiffening(t)[0]}

    cost = {"integral": {"theta": 50.0, "stiffness": 10.0}, "sample_time": 2e-3}
    start = joint.equilibrium(place(0.0))
    middle = joint.equilibrium(theta=0.25, stiffness=24.0)
    axes = {"theta": np.linspace(-0.1, 0.6, 8), "stiffness": np.linspace(14, 34, 5)}
    errors = {}
    begin = {v.name: start[v.name] for v in joint.states}
    real = {"parameters": {"link_mass": 1.2}, "start": begin}
    for label, controller in (
        ("one", lqr(joint, middle, setpoint=place, **cost)),
        ("scheduled", scheduled_lqr(joint, axes, place, **cost)),
    ):
        run = closed_loop(controller, joint, duration=1.2, sample_time=2e-3, **real)
        errors[label] = [
            np.abs(run[n] - [place(t)[n] for t in run.t]).max() for n in ("theta", "stiffness")
        ]
    assert errors["scheduled"][0] < errors["one"][0] / 3
    assert errors["scheduled"][1] < errors["one"][1] / 3
