"""Disturbances estimated and made good for."""

from functools import partial

import numpy as np
import pytest
from conftest import BAR, refused
from scipy.integrate import quad_vec
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp.control.estimators.stationary import kalman
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.state_feedback import OffsetFree


@pytest.fixture
def pushed(long_muscle):
    """A joint on which a torque acts from outside, and its rest."""
    link = {"inertia": 0.05, "link_mass": 1.0, "link_length": 0.2}
    plant = pam.AntagonisticJoint(long_muscle, **link, loads=[pam.loads.ExternalForce()])
    return plant, plant.equilibrium(theta=0.2, stiffness=25.0)


NOISE = {"theta": 1e-5, "muscle1.pressure": 50.0, "muscle2.pressure": 50.0}
DRIFT = {"external_force": 30.0}


def run(plant, point, controller, **options):
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)}
    options = {"duration": 1.5, "sample_time": 2e-3, "start": start, **options}
    return pam.closed_loop(controller, plant, **options)


def watching(plant, point, measured=NOISE):
    """A filter that estimates the torque, too."""
    known = {"measured": measured, "process": 0.1, "disturbances": DRIFT}
    return kalman(plant, point, **known, sample_time=2e-3)


def test_the_estimate_is_the_torque_that_acts(pushed):
    plant, point = pushed
    filter_ = watching(plant, point)
    feedback = lqr(plant, point, sample_time=2e-3)
    controller = OffsetFree(feedback, filter_, ["theta", "stiffness"])
    torque = 0.05
    run(plant, point, controller, disturbances={"external_force": torque})
    assert filter_.disturbance["external_force"] == pytest.approx(torque, rel=0.02)


def test_the_disturbance_is_told_from_an_input_that_feeds_through():
    """x' = -2 x + 3 u + d, y = x + u/2 + d/5 about d = 5: the true d = 8 by formulas alone."""
    plant = pam.Plant("fed_through")
    x, u, d = plant.state("x"), plant.input("u"), plant.input("d", disturbance=True)
    plant.der(x, -2 * x + 3 * u + d)
    plant.output("y", x + u / 2 + d / 5)
    point = plant.equilibrium(u=1.0, d=5.0)
    assert point["x"] == pytest.approx(4.0)
    filter_ = kalman(plant, point, measured={"y": 1e-3}, disturbances={"d": 10.0}, sample_time=0.05)
    rng, true, keep = np.random.default_rng(4), 3.0, np.exp(-0.1)
    command = 1.0
    for _ in range(300):
        seen = true + command / 2 + 8.0 / 5
        estimate = filter_.correct({"y": seen})
        last, command = true, float(rng.normal(1.0, 2.0))
        filter_.predict({"u": command})
        true = keep * true + (1 - keep) / 2 * (3 * command + 8.0)
    assert filter_.disturbance == {"d": pytest.approx(8.0, rel=1e-6)}
    assert estimate == pytest.approx([last], rel=1e-6)


def test_nothing_is_left_of_an_unknown_torque_load_and_weak_muscle(pushed):
    plant, point = pushed
    feedback = lqr(plant, point, sample_time=2e-3)
    filter_ = watching(plant, point, {"theta": 1e-5})
    true = {"link_mass": 1.2, "muscle1.a5": 0.95 * plant.variable("muscle1.a5").start}
    about = {"disturbances": {"external_force": 1.0}, "parameters": true, "duration": 3.0}
    alone = pam.control.WithEstimate(lqr(plant, point, sample_time=2e-3), filter_)
    plain = run(plant, point, alone, **about)
    free = run(plant, point, OffsetFree(feedback, filter_, ["theta"]), **about)
    assert abs(plain["theta"][-1] - 0.2) > 1e-3
    assert abs(free["theta"][-1] - 0.2) < 1e-7


def test_it_goes_to_another_goal_without_an_integral(pushed):
    plant, point = pushed
    filter_ = watching(plant, point, {"theta": 1e-5})
    controller = OffsetFree(lqr(plant, point, sample_time=2e-3), filter_, ["theta"], {"theta": 0.3})
    moved = run(plant, point, controller, duration=3.0)
    assert moved["theta"][-1] == pytest.approx(0.3, abs=1e-6)
    assert moved["theta"].max() < 0.3 + 0.1 * 0.1


def test_the_augmented_gain_is_that_of_the_riccati_equation_written_out(pushed):
    """An independent iteration of the filter; the noise of a sample by quadrature."""
    plant, point = pushed
    found = watching(plant, point)
    a, c = np.asarray(found.system.A), np.asarray(found.system.C)
    n = np.append(plant.vector("state", attribute="nominal"), 10.0)
    still = plant.linearize(point)
    pushed_by = np.asarray(still.B)[:, [v.name for v in plant.inputs].index("external_force")]
    moving = np.vstack([np.column_stack([still.A, pushed_by]), np.zeros(len(n))])
    drive = np.append(np.full(len(n) - 1, 0.1), 3.0)
    spread = lambda s: expm(moving * n / n[:, None] * s) * drive  # noqa: E731
    q, _ = quad_vec(lambda s: spread(s) @ spread(s).T, 0.0, 2e-3)
    a, c = a * n / n[:, None], c * n / np.array([*NOISE.values()])[:, None]
    p = q.copy()
    for _ in range(20000):
        gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.eye(len(c)))
        p = a @ (p - gain @ c @ p) @ a.T + q
    expected = gain * n[:, None] / np.array([*NOISE.values()])
    assert found.gain == pytest.approx(expected, rel=1e-5, abs=1e-9 * np.abs(expected).max())


def test_what_cannot_be_estimated_or_held_is_refused(pushed, slide):
    plant, point = pushed
    watch, both = partial(kalman, plant, point), {"external_force": 1.0, "muscle1.command": 1e4}
    words = "theta is a state; name inputs of the plant"
    refused(words, watch, measured=NOISE, disturbances={"theta": 1.0})
    words = r"cannot be told .* by 1 measured value"
    refused(words, watch, measured={"theta": 1e-5}, disturbances=both)
    one = {"muscle1.pressure": 50.0}  # pressures do not feel the torque
    refused("cannot be told", watch, measured=one, disturbances=DRIFT)
    filter_, blind = watch(measured=NOISE, disturbances=DRIFT), watch(measured=NOISE)
    feedback, slower = lqr(plant, point), lqr(plant, point, sample_time=2e-3)
    integrating = lqr(plant, point, integral={"theta": 5.0})
    refused("hold names 0 value", OffsetFree, feedback, filter_, [])
    refused("design both for one", OffsetFree, slower, filter_, ["theta"])
    refused("the feedback integrates theta", OffsetFree, integrating, filter_, ["theta"])
    refused("estimates no disturbance", OffsetFree, feedback, blind, ["theta"])
    held, far = ["theta", "omega"], {"theta": 2 * BAR}
    refused("theta, omega cannot be held", OffsetFree, feedback, filter_, held, far)
