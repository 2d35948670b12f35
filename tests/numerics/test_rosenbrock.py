"""ROS2 with inputs that change over the step."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.numerics.rosenbrock import ros2, ros2_with_slopes


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
