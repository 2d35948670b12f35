"""The sampled plant: its motion by SciPy, its slopes by the matrix exponential."""

import casadi as ca
import numpy as np
import pytest
from conftest import benchmark_slide, scipy_states
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp.simulation.sampled import SampledPlant, stepped


def spring():
    """m x'' = u + 2 w - 30 x - x'."""
    plant = pam.Plant("spring")
    x, v = plant.state("x", nominal=0.01), plant.state("v", nominal=0.2)
    u, w = plant.input("u", nominal=5.0), plant.input("w")
    m = plant.parameter("m", 0.7)
    plant.der(x, v)
    plant.der(v, (u + 2 * w - 30 * x - v) / m)
    return plant


def test_its_slopes_are_the_matrix_exponential():
    h, m = 0.05, 1.3
    whole = np.zeros((4, 4))
    whole[:2] = [[0, 1, 0, 0], [-30 / m, -1 / m, 1 / m, 2 / m]]
    exact = expm(whole * h)[:2]
    sampled, x, u = SampledPlant(spring(), h), np.array([0.02, -0.3]), np.array([4.0, 1.0])
    a, b = sampled.slopes(x, u, np.array([m]))
    assert np.hstack([a, b]) == pytest.approx(exact, rel=1e-6, abs=1e-8)
    assert sampled.slopes(x, u, np.array([m]), [1])[1] == pytest.approx(exact[:, [3]], rel=1e-6)
    end = sampled(x, u, np.array([m]))[-1]
    assert end == pytest.approx(exact @ np.concatenate([x, u]), rel=1e-7)


def test_its_parts_are_the_motion_between():
    plant, rng = benchmark_slide(), np.random.default_rng(8)
    rest = plant.equilibrium(x=0.002, stiffness=2e4)
    for _ in range(3):
        x = rest.x + rng.normal(size=4) * [1e-3, 0.02, 1e4, 1e4]
        u = rng.uniform(2e5, 4e5, 2)
        found = SampledPlant(plant, 0.02, parts=4)(x, u)
        exact = scipy_states(plant, lambda _, u=u: u, 0.005 * np.arange(5), x)[1:]
        nominal = plant.vector("state", attribute="nominal")
        assert np.abs((found - exact) / nominal).max() < 1e-7


@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("rosenbrock", 3)])
def test_steps_for_programs_are_of_their_order(method, order):
    """A pendulum, against SciPy."""
    tight = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    exact = solve_ivp(lambda _, z: [z[1], -np.sin(z[0])], (0, 1), [1.2, 0.5], **tight).y[:, -1]
    x = ca.SX.sym("x", 2)

    def slopes(z):
        jacobian = ca.SX.zeros(2, 2)
        jacobian[0, 1], jacobian[1, 0] = 1.0, -ca.cos(z[0])
        return ca.vertcat(z[1], -ca.sin(z[0])), jacobian

    errors = []
    for substeps in (16, 32):
        after = stepped(slopes, x, 1.0, method, substeps)
        found = np.asarray(ca.Function("f", [x], [after])([1.2, 0.5])).ravel()
        errors.append(np.abs(found - exact).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)
