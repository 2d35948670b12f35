"""The method of Runge and Kutta, on numbers and on graphs."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.numerics.runge_kutta import rk4


def test_a_polynomial_of_degree_3_in_time_is_integrated_exactly():
    slope = lambda x, at: np.array([1 - 4 * (0.1 * at) + 9 * (0.1 * at) ** 2])  # noqa: E731
    t = 0.3
    assert rk4(slope, np.zeros(1), 0.1, 3) == pytest.approx(t - 2 * t**2 + 3 * t**3, abs=1e-15)


def test_the_error_falls_with_the_fourth_power_of_the_step():
    frequency = np.array([[0.0, 1.0], [-4.0, -0.3]])
    from scipy.linalg import expm

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
