"""ROS2 with inputs that change over the step."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.numerics.rosenbrock import ros2


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
