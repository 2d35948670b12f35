"""Time-varying LQR along a motion."""

import itertools

import numpy as np
import pytest
from conftest import refused
from design_tools import example
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.control.along_motion import OpenLoop, tvlqr
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.operating.linear import linearize_along

EVEN = {"muscle1.pressure": 3e5, "muscle2.pressure": 3e5}


# ---- along a motion
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
    held = {v.name: point[v.name] for v in slide.inputs}
    motion = pam.simulate(slide, held, duration=0.3, start=rest)
    cost = {"weights": {"x": 20.0, "v": 1.0}, "integral": {"x": 50.0}}
    stationary, varying = lqr(slide, point, **cost), tvlqr(slide, motion, **cost)
    scale = np.abs(stationary.K).max()
    assert np.allclose(varying.K, stationary.K, rtol=1e-4, atol=1e-6 * scale)
    assert np.allclose(varying.Ki, stationary.Ki, rtol=1e-4)


def test_the_cost_to_go_is_what_the_linear_loop_then_costs(slide):
    """z' P(0) z against the integral of the cost along d' = (A - B K) d, integrated on its own."""
    t = np.linspace(0, 0.1, 201)
    inputs = {
        "muscle1.command": lambda s: 3e5 + 1e5 * np.sin(40 * s),
        "muscle2.command": lambda s: 3e5 - 1e5 * np.sin(40 * s),
    }
    motion = pam.simulate(slide, inputs, t=t, start=EVEN)
    feedback = tvlqr(slide, motion, weights={"x": 10.0, "v": 0.5}, final=np.zeros((4, 4)))
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


def test_at_rest_a_design_for_held_inputs_is_that_of_dlqr(slide):
    rest = slide.equilibrium(x=0.0, stiffness=2e4)
    inputs = {v.name: rest[v.name] for v in slide.inputs}
    begin = {v.name: rest[v.name] for v in slide.states}
    motion = pam.simulate(slide, inputs, t=np.linspace(0, 0.2, 21), start=begin)
    law = tvlqr(slide, motion, sample_time=4e-3, sampled=True)
    still = lqr(slide, rest, sample_time=4e-3, sampled=True)
    assert pytest.approx(np.tile(still.K, (len(law.K), 1, 1)), rel=1e-3, abs=1e-6) == law.K


def test_what_is_no_motion_of_the_plant_and_a_wrong_end_are_refused(slide, hanging):
    motion = pam.simulate(hanging, duration=0.1)
    refused(r"holds no column 'muscle1\.pressure'", tvlqr, slide, motion)
    words = r"final has shape \(1, 1\); the Riccati matrix has \(3, 3\)"
    refused(words, tvlqr, hanging, motion, final=[[1.0]])
    refused("motion is a dict, not a Trajectory", tvlqr, slide, {})
    refused("plant is a dict, not a Plant", tvlqr, {}, {})
    refused("plant is a str, not a Plant", pam.lqr, "slide")


def test_open_loop_plays_the_plan(slide):
    inputs = {"muscle1.command": lambda t: 3e5 + 1e6 * t, "muscle2.command": 3e5}
    motion = pam.simulate(slide, inputs, t=np.linspace(0, 0.1, 101), start=EVEN)
    start = {v.name: motion[v.name][0] for v in slide.states}
    run = closed_loop(OpenLoop(slide, motion, 1e-3), slide, duration=0.1, start=start)
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
