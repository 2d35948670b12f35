"""A plant with a learned residual is a plant like any other: its plan, FMU, predictive controller
and C code agree with what is computed elsewhere.
"""

from __future__ import annotations

from typing import Any

import fmpy
import numpy as np
import pytest
from c_program import needs_compiler
from conftest import scipy_states
from fmu_tools import KINDS, exported
from test_c_code import same_loop

import pam_ocp as pam
from pam_ocp.control import block
from pam_ocp.fitting import Network, Residual
from pam_ocp.fitting.learned.residual import Visited, attached

PRESSURES = ("muscle1.pressure", "muscle2.pressure")
LOW, HIGH = np.array([[-0.016, -0.5, 0, 0], [0.016, 0.5, 6e5, 6e5]])


@pytest.fixture(scope="module")
def learned() -> pam.Plant:
    """The slide with a force that depends on position, speed, pressures and on the past."""
    slide, random = pam.AntagonisticSlide("DMSP-20-200N", 2.0), np.random.default_rng(0)
    visited = Visited(random.uniform(LOW, HIGH, (300, 4)), np.zeros((300, 2)))
    lacking = Residual("v", ["x", "v", *PRESSURES], Network(6), memory=1)
    made = attached(slide, [lacking], visited, np.random.default_rng(1))
    return made.at(made.centre + 0.1 * random.standard_normal(len(made.centre)))


def by_hand(plant: pam.Plant, slide: pam.Plant) -> Any:
    """x' of the learned plant from that of the slide and the formula of the residual, in NumPy."""
    seen = np.random.default_rng(0).uniform(LOW, HIGH, (300, 4))
    p, drawn = slide.vector("parameter"), np.random.default_rng(1)
    mixed = drawn.permuted(seen, axis=0)  # the size is that of terms that do not balance
    rates = [float(slide.function(s, np.zeros(2), p)[0][1]) for s in mixed]
    w = plant.vector("parameter")[len(p) :]
    hidden, behind, leaky = w[:36].reshape(6, 6, order="F"), w[36:43], w[43:]

    def found(state: np.ndarray, u: np.ndarray) -> np.ndarray:
        s = np.append((state[:4] - seen.mean(axis=0)) / seen.std(axis=0), state[4])
        before = np.asarray(slide.function(state[:4], u, p)[0]).ravel()
        inner = np.tanh(hidden[:, :5] @ s + hidden[:, 5])
        before[1] += np.std(rates) * (behind[:6] @ inner + behind[6])
        return np.append(before, (np.tanh(leaky[:5] @ s + leaky[5]) - state[4]) / 0.02)

    return found


def test_its_equations_are_the_formula(learned):
    slide = pam.AntagonisticSlide("DMSP-20-200N", 2.0)
    expected, random = by_hand(learned, slide), np.random.default_rng(5)
    p = learned.vector("parameter")
    for _ in range(10):
        state = np.append(random.uniform(0, 1, 4) * [0.01, 0.3, 5e5, 5e5], random.uniform(-1, 1))
        u = random.uniform(0, 6e5, 2)
        rates = np.asarray(learned.function(state, u, p)[0]).ravel()
        assert np.allclose(rates, expected(state, u), rtol=1e-10)


def test_its_plan_is_verified(learned):
    plan = pam.plan(learned, stops=[{"x": -0.015}, {"x": 0.015}], cyclic=True, minimise="time")
    assert plan.verified


@pytest.mark.slow
def test_its_fmu_moves_as_scipy_has_it(learned, fmi, tmp_path):
    path = exported(learned, tmp_path, fmi, tolerance=1e-11)
    u = dict(zip((v.name for v in learned.inputs), (4e5, 2.5e5), strict=True))
    names = [v.name for v in learned.states]
    t = np.linspace(0, 0.3, 31)
    expected = scipy_states(learned, lambda _: np.array(list(u.values())), t, rtol=1e-12)
    asked = {"stop_time": 0.3, "output_interval": 0.01, "relative_tolerance": 1e-11}
    for kind in KINDS:
        found = fmpy.simulate_fmu(str(path), fmi_type=kind, start_values=u, output=names, **asked)
        for n, column in zip(names, expected.T, strict=True):
            error = np.abs(found[n] - column).max() / learned.variable(n).nominal
            assert error < 1e-9 if kind == "CoSimulation" else error < 1e-6


@pytest.mark.slow
@needs_compiler
def test_its_predictive_controller_in_c_moves_it_the_same(learned, tmp_path):
    mpc = pam.Mpc(learned, horizon=10, sample_time=0.005, track={"x": 1.0})

    def told(t):
        return {"wanted.x": 0.004 + 0.004 * (t > 0.05)}

    run = same_loop(block(mpc), learned, tmp_path / "c", told, duration=0.15)
    assert run["x"][-1] == pytest.approx(0.008, abs=1e-3)
