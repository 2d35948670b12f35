"""Steps of ROS2, with inputs that change meanwhile, and of Runge and Kutta on graphs too."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from pam_ocp.numerics.rosenbrock import ros2, ros2_with_slopes
from pam_ocp.numerics.runge_kutta import rk4


def test_ros2_is_of_second_order_with_inputs_that_rise():
    """x' = -x + t from 0: x = t - 1 + exp(-t)."""
    x = ca.SX.sym("x")
    errors = []
    for steps in (10, 20):
        h, after = 1.0 / steps, x
        for k in range(steps):
            early = lambda z, k=k, h=h: (-z + k * h, ca.SX(-1))  # noqa: E731
            after = ros2(early, lambda z, k=k, h=h: -z + (k + 1) * h, after, h)
        errors.append(abs(float(ca.Function("f", [x], [after])(0.0)) - np.exp(-1.0)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_ros2_damps_what_is_much_quicker_than_its_step():
    x = ca.SX.sym("x")
    after = ros2(lambda z: (-1e8 * z, ca.SX(-1e8)), lambda z: -1e8 * z, x, 0.1)
    assert abs(float(ca.Function("f", [x], [after])(1.0))) < 1e-5


def test_slopes_of_ros2_stage_by_stage_are_those_of_its_step():
    """Also where the length of the step and the inputs depend on what is sought."""
    x, z, s = ca.SX.sym("x", 2), ca.SX.sym("z", 2), ca.SX.sym("s", 2, 3)
    h = 0.1 * (1 + z[0])

    def rates(q, u):
        return ca.vertcat(q[1] * z[0] + u, -ca.sin(q[0]) * z[1] - q[1] ** 3 + u * q[0])

    first = rates(x, 0.3 * z[1])
    after, slopes = ros2_with_slopes(first, lambda q: rates(q, 0.7), (x, s), (z, 1), h)
    plain = ros2(lambda _: (first, ca.jacobian(first, x)), lambda q: rates(q, 0.7), x, h)
    exact = ca.jacobian(plain, x) @ s + ca.horzcat(ca.jacobian(plain, z), ca.SX(2, 1))
    both = ca.Function("both", [x, z, s], [after - plain, slopes - exact, exact])
    step, gap, size = both([0.4, -0.8], [1.3, 2.1], np.arange(6).reshape(2, 3) / 3)
    assert np.abs(step).max() < 1e-15
    assert np.abs(gap).max() < 1e-12 < np.abs(size).max()


# ---- Runge and Kutta -----------------------------------------------------------------------------
def test_a_polynomial_of_degree_3_in_time_is_integrated_exactly():
    slope = lambda x, at: np.array([1 - 4 * (0.1 * at) + 9 * (0.1 * at) ** 2])  # noqa: E731
    t = 0.3
    assert rk4(slope, np.zeros(1), 0.1, 3) == pytest.approx(t - 2 * t**2 + 3 * t**3, abs=1e-15)


def test_the_error_falls_with_the_fourth_power_of_the_step():
    frequency = np.array([[0.0, 1.0], [-4.0, -0.3]])
    exact = expm(frequency) @ [1.0, -0.5]
    error = [
        np.abs(rk4(lambda x, at: frequency @ x, np.array([1.0, -0.5]), 1 / n, n) - exact).max()
        for n in (20, 40)
    ]
    assert np.log2(error[0] / error[1]) == pytest.approx(4, abs=0.1)


def test_a_graph_gives_what_numbers_give_and_the_step_may_be_a_symbol():
    x, h = ca.SX.sym("x", 2), ca.SX.sym("h")
    slope = lambda z, at: ca.vertcat(z[1], -ca.sin(z[0]) + at * h)  # noqa: E731
    graph = ca.Function("after", [x, h], [rk4(slope, x, h, 5)])
    by_hand = rk4(
        lambda z, at: np.array([z[1], -np.sin(z[0]) + at * 0.02]), np.array([1.0, 0.0]), 0.02, 5
    )
    assert np.asarray(graph([1.0, 0.0], 0.02)).ravel() == pytest.approx(by_hand, rel=1e-14)
