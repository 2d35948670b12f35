"""Designs: closed loops, PID with exact inverse, LQR and relatives, Kalman filter, measures."""

import importlib.util
import itertools
import sys
from pathlib import Path

import control
import numpy as np
import pytest
from conftest import BAR
from scipy import linalg

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.design.analysis import (
    along_stroke,
    bode_cloud,
    frequency_response,
    gramian,
    margins,
    margins_over,
    mode_map,
)
from pam_ocp.design.closed_loop import closed_loop
from pam_ocp.design.inverse import InverseDynamics
from pam_ocp.design.kalman import WithEstimate, kalman
from pam_ocp.design.lqr import lqr
from pam_ocp.design.pid import PID, PositionController, PressureLoop
from pam_ocp.design.references import hold, moves, sine
from pam_ocp.design.schedule import scheduled_lqr
from pam_ocp.design.tvlqr import OpenLoop, tvlqr
from pam_ocp.muscle.valves import OnOffValves, SpoolValve


class Fixed:
    """A controller whose answer does not depend on what it measures."""

    def __init__(self, answer):
        self.answer = answer
        self.seen = []

    def reset(self):
        self.seen = []

    def __call__(self, t, measured):
        self.seen.append(dict(measured))
        return self.answer(t) if callable(self.answer) else self.answer


def double_integrator():
    """x'' = u, all nominals 1."""
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    u = plant.input("u", unit="N")
    plant.der(x, v)
    plant.der(v, u)
    return plant


def weakened(plant, share):
    law = [f"muscle1.{a}" for a in ("a1", "a2", "a4", "a5", "a6")]
    return {n: share * plant.variable(n).start for n in law}


@pytest.fixture
def joint(long_muscle):
    return pam.AntagonisticJoint(long_muscle, inertia=0.05, link_mass=1.0, link_length=0.2)


def example(name):
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


# ---- the loop itself -------------------------------------------------------------------------------
def test_between_samples_the_plant_moves_as_in_simulate(slide):
    answer = lambda t: {"muscle1.command": (3 + (t > 0.0499)) * BAR, "muscle2.command": 3 * BAR}  # noqa: E731
    run = closed_loop(slide, Fixed(answer), duration=0.2, dt=5e-3, parts=4)
    assert len(run) == 161
    motion = pam.simulate(slide, run, t=run.t)
    assert run.compare(motion).largest < 1e-6


def test_what_the_controller_asks_is_kept_within_the_plants_range(slide):
    run = closed_loop(slide, Fixed({"muscle1.command": 20 * BAR}), duration=0.05, dt=1e-2)
    assert np.all(run["muscle1.command"] == slide.variable("muscle1.command").max)
    assert np.all(run["muscle2.command"] == slide.variable("muscle2.command").start)


def test_a_delay_lets_the_start_values_run_first(slide):
    run = closed_loop(slide, Fixed({"muscle1.command": 4 * BAR}), duration=0.05, dt=1e-2, delay=2)
    assert run["muscle1.command"][:4] == pytest.approx([3 * BAR, 3 * BAR, 4 * BAR, 4 * BAR])


def test_noise_has_the_deviation_asked_for_and_does_not_move_the_plant(slide):
    watch = Fixed({})
    run = closed_loop(slide, watch, duration=2.0, dt=1e-3, noise={"x": 1e-3}, seed=3)
    seen = np.array([m["x"] for m in watch.seen])
    assert np.std(seen - run["x"][:-1]) == pytest.approx(1e-3, rel=0.05)
    assert run["x"] == pytest.approx(0.0, abs=1e-12)  # both muscles at equal pressures


def test_disturbances_act_and_the_true_parameters_stay_hidden(long_muscle):
    plant = pam.AntagonisticJoint(long_muscle, loads=[pam.ExternalForce()])
    (external,) = [v.name for v in plant.inputs if v.disturbance]
    run = closed_loop(
        plant, Fixed({}), duration=2.5, dt=1e-2, disturbances={external: 1.0},
        parameters={"inertia": 0.08},
    )  # fmt: skip
    assert abs(run["torque"][-1]) == pytest.approx(1.0, rel=1e-3)
    assert np.all(run[external] == 1.0)


def test_bad_arguments_of_the_closed_loop_are_named(slide):
    with pytest.raises(InputError, match="at least one sample"):
        closed_loop(slide, Fixed({}), duration=1e-4, dt=1e-3)
    with pytest.raises(InputError, match="x is a state of the plant, not an input"):
        closed_loop(slide, Fixed({"x": 0.0}), duration=0.1, dt=1e-2)
    with pytest.raises(InputError, match="controller's answer at t = 0 s is not finite"):
        closed_loop(slide, Fixed({"muscle1.command": np.nan}), duration=0.1, dt=1e-2)
    with pytest.raises(InputError, match=r"noise: muscle1\.command is not measured"):
        closed_loop(slide, Fixed({}), duration=0.1, dt=1e-2, noise={"muscle1.command": 1.0})


@pytest.mark.slow
def test_the_fmu_as_the_plant_gives_the_same_closed_loop(slide, tmp_path):
    fmu = pam.export_fmu(slide, tmp_path / "slide.fmu", platforms="native")
    feedback = lqr(slide, slide.equilibrium(x=0.003, stiffness=2.2e4), integral={"x": 50.0})
    shared = {"duration": 0.3, "dt": 2e-3, "parameters": {"mass": 2.6}, "parts": 2}
    plant, unit = (closed_loop(slide, feedback, fmu=f, **shared) for f in (None, fmu))
    assert plant["x"][-1] != pytest.approx(plant["x"][0], abs=1e-3)
    assert plant.compare(unit).largest < 1e-6


# ---- exact inverse, PID, cascade -------------------------------------------------------------------
def test_the_inverse_is_the_allocation_of_a_pair(joint):
    inverse, allocation = InverseDynamics(joint), pam.Allocation(joint)
    theta, omega, alpha, stiffness = 0.3, 0.7, 5.0, 26.0
    effort = 0.05 * alpha + 0.3 * omega + 1.0 * 9.80665 * 0.2 * np.sin(theta)
    expected = allocation.pressures(theta, effort, stiffness)
    assert inverse(theta, omega, alpha, stiffness) == pytest.approx(np.ravel(expected), rel=1e-10)


def test_the_inverse_of_one_muscle_is_its_law_turned_round(long_muscle):
    plant = pam.HangingLoad(long_muscle, mass=20.0, damping=pam.ConstantDamping(50.0))
    found = InverseDynamics(plant)(0.05, 0.2, 1.5)
    force = 20.0 * (9.80665 + 1.5) + 50.0 * 0.2
    assert found[0] == pytest.approx(long_muscle.pressure(force, 0.05 / 0.4), rel=1e-10)


def test_out_of_reach_the_inverse_stays_in_range_and_keeps_the_acceleration_if_it_can(joint):
    inverse = InverseDynamics(joint)
    stiff = inverse(0.0, 0.0, 0.0, 500.0)
    assert stiff == pytest.approx([6e5, 6e5])
    tilted = inverse(0.3, 0.0, 0.0, 500.0)
    assert tilted.max() == 6e5
    x = {"theta": 0.3, "muscle1.pressure": tilted[0], "muscle2.pressure": tilted[1]}
    moved = joint.with_values(x)
    xdot = joint.function(moved.vector("state"), moved.vector("input"), joint.vector("parameter"))[
        0
    ]
    assert float(xdot[1]) == pytest.approx(0.0, abs=1e-6)


def test_the_inverse_says_what_it_lacks(joint, long_muscle):
    with pytest.raises(InputError, match="give a stiffness for a pair"):
        InverseDynamics(joint)(0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="needs a plant with one position"):
        InverseDynamics(pam.SeriesLoad(long_muscle))


@pytest.mark.parametrize(
    "reference", [moves([0.0, 0.4, -0.2], [0.1, 0.8], 0.5), sine(0.1, 0.3, 1.5), hold(0.2)]
)
def test_velocity_and_acceleration_of_a_reference_are_its_derivatives(reference):
    h = 1e-4
    for t in (0.05, 0.23, 0.47, 0.7, 1.1):
        x, v, a = reference(t)
        before, after = reference(t - h), reference(t + h)
        assert v == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-5)
        assert a == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-4)
        assert np.isfinite(x)


def test_feed_forward_by_the_inverse_alone_follows_the_motion_it_was_made_for(long_muscle):
    """Inverse, then plant: the identity, up to inputs held over a sample (error of order dt)."""
    plant = pam.AntagonisticJoint(
        long_muscle, link_mass=1.0, link_length=0.2, feed=pam.IdealPressure()
    )
    reference = moves([0.0, 0.4], [0.05], 0.5)
    errors = []
    for dt in (2e-3, 1e-3):
        controller = PositionController(plant, reference, PID(0.0), dt=dt, stiffness=25.0)
        run = closed_loop(plant, controller, duration=0.7, dt=dt)
        errors.append(np.abs(run["theta"] - [reference(t)[0] for t in run.t]).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_a_pid_is_placed_where_it_says():
    pid = PID.placed(2.0, damping=0.7)
    w = 4 * np.pi
    expected = [-w, complex(-0.7 * w, w * np.sqrt(0.51)), complex(-0.7 * w, -w * np.sqrt(0.51))]
    found = np.roots([1.0, pid.kd, pid.kp, pid.ki])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_a_saturated_pid_does_not_wind_up():
    pid = PID(1.0, ki=10.0)
    for _ in range(100):
        pid(1.0, 0.01, saturated=False)
    before = pid(1.0, 0.01, saturated=True)
    assert pid(1.0, 0.01, saturated=True) == before
    assert pid(-1.0, 0.01, saturated=True) < before - 2.0


def test_the_pressure_loop_closes_with_its_time_constant(hanging):
    loop = PressureLoop(hanging, time_constant=0.01)

    class Hold:
        def reset(self): ...

        def __call__(self, t, measured):
            return loop({"muscle": 3.5 * BAR}, measured)

    run = closed_loop(
        hanging, Hold(), duration=0.05, dt=1e-4, start={"x": 0.06, "muscle.pressure": 3 * BAR}
    )
    expected = 3.5 * BAR - 0.5 * BAR * np.exp(-run.t / 0.01)
    assert run["muscle.pressure"] == pytest.approx(expected, abs=0.01 * BAR)


@pytest.mark.parametrize("feed", [pam.Regulator(0.05), SpoolValve(), OnOffValves()], ids=type)
def test_feed_forward_makes_the_error_a_fifth_of_the_pids_alone(long_muscle, feed):
    plant = pam.AntagonisticJoint(long_muscle, link_mass=1.0, link_length=0.2, feed=feed)
    reference = moves([0.0, 0.5], [0.1], 0.5)
    largest = {}
    for feedforward in (True, False):
        controller = PositionController(
            plant, reference, PID.placed(3.0), dt=2e-3, stiffness=25.0, feedforward=feedforward,
            inner=PressureLoop(plant, 0.01),
        )  # fmt: skip
        first = controller.pressures(0.0)
        start = {f"muscle{i + 1}.pressure": first[i] for i in (0, 1)}
        run = closed_loop(
            plant, controller, duration=0.8, dt=2e-3, start=start, parameters={"link_mass": 1.2}
        )
        largest[feedforward] = np.abs(run["theta"] - [reference(t)[0] for t in run.t]).max()
    assert largest[True] < largest[False] / 5


# ---- LQR, LQI, Kalman ------------------------------------------------------------------------------
def test_lqr_of_the_double_integrator_is_the_textbooks():
    """Cost q^2 x^2 + r^2 u^2: K = [q/r, sqrt(2 q/r)]."""
    plant = double_integrator()
    point = pam.OperatingPoint(plant, np.zeros(2), np.zeros(1))
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


def test_the_loop_of_an_lqr_keeps_its_distance_from_minus_one(slide):
    """Kalman's inequality: sigma_min(I + L) >= 1, so phase margins of 60 deg and gains up to inf."""
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    for integral in ({}, {"x": 80.0, "stiffness": 5.0}):
        found = margins(lqr(slide, point, integral=integral).loop)
        assert found.all_inputs >= 1 - 1e-6
        assert min(found.phase) >= 60
        assert min(found.modulus) >= 1 - 1e-6
        assert found.gain == (np.inf, np.inf)


def test_near_the_stop_the_nonlinear_loop_moves_as_linear_theory_says(slide):
    point = slide.equilibrium(x=0.002, stiffness=2.2e4)
    feedback = lqr(slide, point, dt=1e-4)
    start = {v.name: x for v, x in zip(slide.states, point.x, strict=True)}
    run = closed_loop(
        slide, feedback, duration=0.06, dt=1e-4, start={**start, "x": point.x[0] + 1e-6}
    )
    a = np.asarray(feedback.system.A) - np.asarray(feedback.system.B) @ feedback.K
    d = [(linalg.expm(a * t) @ [1e-6, 0, 0, 0])[0] for t in run.t]
    assert run["x"] - point.x[0] == pytest.approx(d, abs=2e-8)


def test_a_sampled_design_solves_the_discrete_riccati_equation(slide):
    point, dt = slide.equilibrium(x=0.0, stiffness=2.2e4), 0.01
    feedback = lqr(slide, point, weights={"x": 10.0, "v": 1.0}, dt=dt, sampled=True)
    system = slide.linearize(point, dt=dt)
    a, b = np.asarray(system.A), np.asarray(system.B)
    n, e = slide.vector("state", attribute="nominal"), np.full(2, 1e5)
    a, b = a * n / n[:, None], b * e / n[:, None]
    q, r = dt * np.diag([100.0, 1.0, 0, 0]), dt * np.eye(2)
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
        run = closed_loop(slide, feedback, duration=1.0, start=start, parameters=true)
        left[name] = abs(run["x"][-1] - 0.004)
    assert left["LQR"] > 1e-4
    assert left["LQI"] < 1e-6


def test_an_lqi_goes_to_another_set_point(slide):
    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    feedback = lqr(slide, point, integral={"x": 100.0}, setpoint={"x": 0.003})
    start = {n: point[n] for n in ("muscle1.pressure", "muscle2.pressure")}
    assert closed_loop(slide, feedback, duration=1.0, start=start)["x"][-1] == pytest.approx(
        0.003, abs=1e-6
    )


def test_lqr_says_what_cannot_be_stabilised_or_weighed(long_muscle, slide):
    counted = pam.HangingLoad(long_muscle, feed=SpoolValve(totals=True))
    somewhere = pam.OperatingPoint(counted, counted.vector("state"), counted.vector("input"))
    with pytest.raises(InputError, match="totals of gas feeds"):
        lqr(counted, somewhere, weights={"muscle.work": 1.0, "x": 1.0})
    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    with pytest.raises(InputError, match=r"weights: muscle1\.command is no state or output"):
        lqr(slide, point, weights={"muscle1.command": 1.0})
    with pytest.raises(InputError, match=r"effort: no weight for the input muscle2\.command"):
        lqr(slide, point, effort={"muscle1.command": 1.0})


def test_the_kalman_gain_is_that_of_the_dual_riccati_equation(hanging):
    point, dt = hanging.equilibrium(x=0.06), 2e-3
    found = kalman(hanging, point, measured={"x": 1e-4}, process={"v": 2.0}, dt=dt)
    system = hanging.linearize(point, outputs=["x"], dt=dt)
    a, c = np.asarray(system.A), np.asarray(system.C)
    q, r = np.diag([0.0, (2.0 * 0.1) ** 2 * dt, 0.0]), np.array([[1e-8]])
    scale = np.diag([1.0, 1.0, 1e-5])  # Pa beside m would cost SciPy its small entries
    back = np.linalg.inv(scale)
    p = linalg.solve_discrete_are((scale @ a @ back).T, (c @ back).T, scale @ q @ scale, r)
    p = back @ p @ back
    assert np.allclose(found.gain, p @ c.T / (c @ p @ c.T + r), rtol=1e-5, atol=1e-9)


def test_the_filter_finds_velocity_and_pressure_from_the_position(hanging):
    point = hanging.equilibrium(x=0.06)
    watch = kalman(
        hanging, point, measured={"x": 2e-5}, process={"v": 0.1, "muscle.pressure": 0.1}, dt=1e-3
    )
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
    run = closed_loop(hanging, Watching(), duration=1.0, start=start, noise={"x": 2e-5}, seed=5)
    truth = run.array([v.name for v in hanging.states])[:-1]
    error = np.abs(np.array(estimates) - truth)
    late = error[500:]
    assert error[0, 1] == pytest.approx(0.02, rel=0.2)  # it did not know the velocity at first
    assert np.sqrt(np.mean(late[:, 1] ** 2)) < 2e-3
    assert np.sqrt(np.mean(late[:, 0] ** 2)) < 2e-5  # better than the sensor
    assert np.sqrt(np.mean(late[:, 2] ** 2)) < 1e3


def test_a_controller_behind_a_filter_sees_the_estimate_only(hanging):
    point = hanging.equilibrium(x=0.06)
    inner = Fixed({"muscle.command": point["muscle.command"]})
    watch = kalman(hanging, point, measured={"x": 1e-5}, dt=1e-3)
    start = {"x": 0.058, "muscle.pressure": point["muscle.pressure"]}
    closed_loop(hanging, WithEstimate(inner, watch, ["muscle.force"]), duration=0.01, start=start)
    assert set(inner.seen[0]) == {"x", "v", "muscle.pressure", "muscle.force"}
    assert inner.seen[0]["x"] != 0.058


def test_lqg_holds_a_stop_from_noisy_measurements(slide):
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    noise = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    watch = kalman(slide, point, measured=noise, process={"v": 5.0, "muscle1.pressure": 1.0})
    start = {n: point[n] for n in ("muscle1.pressure", "muscle2.pressure")}
    run = closed_loop(
        slide, WithEstimate(lqr(slide, point, integral={"x": 100.0}), watch), duration=0.6,
        start={**start, "x": 0.001}, noise=noise, parameters={"mass": 2.5},
    )  # fmt: skip
    late = run["x"][run.t > 0.4] - 0.004
    assert np.abs(late).max() < 1e-4


# ---- along a motion --------------------------------------------------------------------------------
def test_the_riccati_equation_has_the_scalar_solution_of_theory():
    """x' = u, cost x^2 + u^2, no end cost: P = tanh(T - t)."""
    plant = pam.Plant("integrator")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, u)
    motion = pam.simulate(plant, {"u": 0.0}, t=np.linspace(0, 2, 81))
    feedback = tvlqr(plant, motion, weights={"x": 1.0}, final=[[0.0]])
    assert feedback.P[:, 0, 0] == pytest.approx(np.tanh(2 - motion.t), abs=1e-6)
    assert feedback.K[:, 0, 0] == pytest.approx(np.tanh(2 - motion.t), abs=1e-6)


def test_along_a_rest_the_gains_are_those_of_the_lqr_there(slide):
    point = slide.equilibrium(x=0.003, stiffness=2.2e4)
    rest = {v.name: x for v, x in zip(slide.states, point.x, strict=True)}
    motion = pam.simulate(
        slide,
        {n: point[n] for n in ("muscle1.command", "muscle2.command")},
        duration=0.3,
        start=rest,
    )
    cost = {"weights": {"x": 20.0, "v": 1.0}, "integral": {"x": 50.0}}
    stationary, varying = lqr(slide, point, **cost), tvlqr(slide, motion, **cost)
    scale = np.abs(stationary.K).max()
    assert np.allclose(varying.K, stationary.K, rtol=1e-4, atol=1e-6 * scale)
    assert np.allclose(varying.Ki, stationary.Ki, rtol=1e-4)


def test_the_cost_to_go_is_what_the_linear_loop_then_costs(slide):
    """z' P(0) z against the integral of the cost along d' = (A - B K) d, integrated on its own."""
    from scipy.integrate import solve_ivp

    t = np.linspace(0, 0.1, 201)
    motion = pam.simulate(
        slide,
        {
            "muscle1.command": lambda s: 3e5 + 1e5 * np.sin(40 * s),
            "muscle2.command": lambda s: 3e5 - 1e5 * np.sin(40 * s),
        },
        t=t,
        start={"muscle1.pressure": 3e5, "muscle2.pressure": 3e5},
    )
    feedback = tvlqr(slide, motion, weights={"x": 10.0, "v": 0.5}, final=np.zeros((4, 4)))
    from pam_ocp.linear import linearize_along

    along = linearize_along(slide, motion)
    n, e = slide.vector("state", attribute="nominal"), np.full(2, 1e5)

    def rate(s, d):
        a, b, _, _ = along.at(s)
        i = min(int(s / t[1]), 199)
        share = s / t[1] - i
        k = (1 - share) * feedback.K[i] + share * feedback.K[i + 1]
        w = -k @ d[:4]
        z = d[:4] / n
        return np.append(a @ d[:4] + b @ w, 100 * z[0] ** 2 + 0.25 * z[1] ** 2 + (w / e) @ (w / e))

    z0 = np.array([0.3, -0.2, 0.1, 0.4])
    solution = solve_ivp(rate, (0, 0.1), np.append(z0 * n, 0.0), rtol=1e-8, atol=1e-10)
    assert z0 @ feedback.P[0] @ z0 == pytest.approx(solution.y[-1, -1], rel=1e-3)


def test_a_motion_without_inputs_is_refused_and_a_wrong_end_too(slide, hanging):
    motion = pam.simulate(hanging, duration=0.1)
    with pytest.raises(InputError, match=r"holds no column 'muscle1\.pressure'"):
        tvlqr(slide, motion)
    with pytest.raises(
        InputError, match=r"final has shape \(1, 1\); the Riccati matrix has \(3, 3\)"
    ):
        tvlqr(hanging, motion, final=[[1.0]])


def test_open_loop_plays_the_plan(slide):
    motion = pam.simulate(
        slide, {"muscle1.command": lambda t: 3e5 + 1e6 * t, "muscle2.command": 3e5},
        t=np.linspace(0, 0.1, 101), start={"muscle1.pressure": 3e5, "muscle2.pressure": 3e5},
    )  # fmt: skip
    start = {v.name: motion[v.name][0] for v in slide.states}
    run = closed_loop(slide, OpenLoop(slide, motion, 1e-3), duration=0.1, start=start)
    assert run["x"] == pytest.approx(motion["x"], abs=1e-6)


@pytest.mark.slow
def test_the_example_holds_its_plan_under_wrong_mass_and_force_to_a_fifth_of_open_loop():
    module = example("control_tvlqr")
    plant, motion = module.planned()
    runs = module.compared(plant, motion)
    assert set(runs) == set(itertools.product((0.7, 1.0, 1.3), (0.95, 1.0, 1.05)))
    for pair in runs.values():
        opened, closed = (module.peak(run, motion) for run in pair.values())
        assert closed < opened / 5


# ---- gain scheduling -------------------------------------------------------------------------------
def test_at_a_grid_point_the_schedule_has_the_gains_of_the_lqr_there(slide):
    axes = {"x": [-0.004, 0.0, 0.004], "stiffness": [2.1e4, 2.4e4]}
    found = scheduled_lqr(
        slide, axes, lambda t: {"x": 0.0, "stiffness": 2.4e4}, integral={"x": 50.0}
    )
    own = lqr(slide, slide.equilibrium(x=0.0, stiffness=2.4e4), integral={"x": 50.0})
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

    cost = {"integral": {"theta": 50.0, "stiffness": 10.0}, "dt": 2e-3}
    start = joint.equilibrium(place(0.0))
    middle = joint.equilibrium(theta=0.25, stiffness=24.0)
    axes = {"theta": np.linspace(-0.1, 0.6, 8), "stiffness": np.linspace(14, 34, 5)}
    errors = {}
    for label, controller in (
        ("one", lqr(joint, middle, setpoint=place, **cost)),
        ("scheduled", scheduled_lqr(joint, axes, place, **cost)),
    ):
        run = closed_loop(
            joint, controller, duration=1.2, dt=2e-3, parameters={"link_mass": 1.2},
            start={v.name: start[v.name] for v in joint.states},
        )  # fmt: skip
        errors[label] = [
            np.abs(run[n] - [place(t)[n] for t in run.t]).max() for n in ("theta", "stiffness")
        ]
    assert errors["scheduled"][0] < errors["one"][0] / 3
    assert errors["scheduled"][1] < errors["one"][1] / 3


# ---- margins and measures --------------------------------------------------------------------------
def test_margins_of_a_third_order_loop_are_the_textbooks():
    """L = 2/(s (s+1) (s+2)): gain margin 3, at w = sqrt(2)."""
    loop = control.ss(control.tf([2.0], [1.0, 3.0, 2.0, 0.0]), inputs=["u"], outputs=["y"])
    found = margins(loop)
    assert found.gain[0] == pytest.approx(3.0, rel=1e-6)
    w = 2 * np.pi * found.crossover[0]
    value = 2 / (1j * w * (1j * w + 1) * (1j * w + 2))
    assert abs(value) == pytest.approx(1.0, rel=1e-6)
    assert found.phase[0] == pytest.approx(180 + np.degrees(np.angle(value)), abs=1e-6)
    assert found.modulus[0] == pytest.approx(found.all_inputs, rel=1e-9)
    assert "phase" in str(found)


def test_frequency_responses_are_python_controls(slide):
    system = slide.linearize(slide.equilibrium(x=0.0, stiffness=2.2e4))
    f = np.geomspace(0.1, 100, 7)
    expected = np.moveaxis(np.asarray(system(2j * np.pi * f)), -1, 0)
    found = frequency_response(system, f)
    assert np.allclose(found, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())


def test_the_gramian_is_theorys_for_unstable_stable_and_stiff_systems():
    scalar = gramian(np.array([[1.0]]), np.array([[1.0]]), 2.0)
    assert scalar[0, 0] == pytest.approx((np.exp(4) - 1) / 2, rel=1e-12)
    a, b = np.array([[-1.0, 5.0], [0.0, -3e3]]), np.array([[0.0], [1.0]])
    long = gramian(a, b, 60.0)
    lyapunov = linalg.solve_continuous_lyapunov(a, -b @ b.T)
    assert np.allclose(long, lyapunov, rtol=1e-9, atol=1e-15)


def test_the_position_of_a_slide_alone_does_not_show_both_pressures(slide):
    """Equal regulators: the pressures enter the force as one sum that decays on its own."""
    place = ("x", np.linspace(-0.006, 0.006, 5), {"stiffness": 2.3e4})
    alone = along_stroke(slide, *place)
    both = along_stroke(slide, *place, outputs=["x", "muscle1.pressure"])
    assert alone.visible.max() < 1e-6
    assert both.visible.min() > 1e-3
    assert alone.weakest.min() > 1e-3
    k = [p["stiffness"] for p in alone.points]
    assert alone.frequency == pytest.approx(np.sqrt(np.array(k) / 2.0) / (2 * np.pi), rel=1e-9)


def test_modes_over_pressure_and_contraction_are_those_of_the_second_order_equation(long_muscle):
    plant = pam.HangingLoad(long_muscle, mass=20.0, damping=pam.ConstantDamping(100.0))
    p, kappa = np.array([2.0, 4.0]) * BAR, np.array([0.05, 0.10, 0.15])
    found = mode_map(plant, {"muscle.command": p, "x": kappa * 0.4}, free=["gravity"])
    k = np.array([[long_muscle.stiffness(a, b) for b in kappa] for a in p])
    assert found.frequency == pytest.approx(np.sqrt(k / 20.0) / (2 * np.pi), rel=1e-6)
    assert found.damping == pytest.approx(100.0 / (2 * np.sqrt(k * 20.0)), rel=1e-6)
    assert found.stable.all()
    weak = mode_map(
        plant, {"muscle.command": p, "x": kappa * 0.4}, free=["gravity"],
        within={"muscle.force": (600.0, np.inf)},
    )  # fmt: skip
    force = np.array([[long_muscle.force(a, b) for b in kappa] for a in p])
    assert np.array_equal(np.isnan(weak.frequency), force < 600.0)


def test_far_above_resonance_a_cloud_falls_with_the_mass(hanging):
    """|x/p_command| -> (dF/dp) / (m w^2 |1 + i w lag|), dF/dp the same at one place and pressure."""
    cases = [{"parameters": {"mass": m}} for m in (15.0, 20.0, 30.0)]
    cloud = bode_cloud(
        hanging, {"muscle.command": 4 * BAR}, cases, source="muscle.command", output="x",
        hertz=(0.1, 300.0),
    )  # fmt: skip
    slope = [hanging_gain(p) for p in cloud.points]
    size = np.abs(cloud.responses[:, -1])
    w = 2 * np.pi * 300.0
    expected = np.array(slope) / (np.array([15.0, 20.0, 30.0]) * w**2 * np.hypot(1, w * 0.05))
    assert size == pytest.approx(expected, rel=2e-3)
    assert np.allclose(cloud.responses[1], cloud.nominal, rtol=1e-6)
    low, high = cloud.band(0.5)
    assert np.all(low <= high)


def hanging_gain(point):
    """dF/dp of the muscle at a point, by the force law."""
    law = pam.muscle("DMSP-20-400N").law
    return float(law.dtension_dp(point["muscle.pressure"], point["muscle.contraction"]))


def test_a_feedback_keeps_a_lighter_and_a_heavier_slide_stable(slide):
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    feedback = lqr(slide, point, integral={"x": 80.0})
    cases = [{"parameters": {"mass": m}} for m in (1.4, 2.0, 2.6)]
    found = margins_over(feedback, cases, {"x": 0.004, "stiffness": 2.3e4})
    assert all(poles.real.max() < 0 for _, poles in found)
    assert found[1][0].phase == pytest.approx(margins(feedback.loop).phase, rel=1e-6)
    assert np.sort(found[1][1].real) == pytest.approx(np.sort(feedback.poles.real), rel=1e-6)


def test_every_figure_is_drawn_without_pyplot(slide, hanging):
    from matplotlib.figure import Figure

    from pam_ocp.design import plots

    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    feedback = lqr(slide, point)
    run = closed_loop(slide, feedback, duration=0.02)
    cloud = bode_cloud(
        slide, {"x": 0.0, "stiffness": 2.2e4}, pam.sweep(mass=[1.0, 3.0]), source="muscle1.command",
        output="x",
    )  # fmt: skip
    stroke = along_stroke(slide, "x", [0.0, 0.001], {"stiffness": 2.2e4})
    found = mode_map(hanging, {"muscle.command": [2e5, 3e5], "x": [0.02, 0.04]}, free=["gravity"])
    figures = [
        plots.plot_tracking({"LQR": run}, ["x"], {"x": lambda t: 0.0}, "title"),
        plots.plot_bode_cloud(cloud),
        plots.plot_loop({"LQR": feedback.loop}, {"LQR": margins(feedback.loop)}),
        plots.plot_stroke({"slide": stroke}),
        plots.plot_mode_map(found),
    ]
    assert all(isinstance(f, Figure) for f in figures)
    with pytest.raises(InputError, match="runs is empty"):
        plots.plot_tracking({}, ["x"])
