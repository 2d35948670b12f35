"""Newton's method and curves followed by their arc length, against closed forms."""

import casadi as ca
import numpy as np
import pytest
from conftest import refused

from pam_ocp.numerics.continuation import ImplicitCurve, Walk
from pam_ocp.numerics.newton import NewtonError, casadi_equations, iterate, least_squares, newton


def of(function, slope):
    """Equations of one unknown."""
    return lambda w: (np.array([function(w[0])]), least_squares(np.array([[slope(w[0])]])))


ATAN = of(np.arctan, lambda x: 1 / (1 + x**2))


def test_damped_steps_converge_where_full_ones_run_away():
    """arctan: full steps diverge from |x| > 1.39 (Dennis and Schnabel)."""
    assert newton(ATAN, np.array([10.0]))[0] == pytest.approx(0.0, abs=1e-12)
    runaway = iterate(ATAN, np.array([10.0]), tolerance=1e-12, steps=4, halvings=0)
    assert runaway.reason
    assert abs(runaway.w[0]) > 100


def test_a_graph_is_solved_and_the_residual_told():
    w, p = ca.SX.sym("w", 2), ca.SX.sym("p")
    r = ca.vertcat(w[0] ** 2 + w[1] ** 2 - p, w[0] - w[1])
    function = ca.Function("r", [w, p], [r, ca.jacobian(r, w)])
    found, size = newton(casadi_equations(function, 8.0), np.array([1.0, 3.0]))
    assert found == pytest.approx([2.0, 2.0])
    assert size <= 1e-10


def test_each_failure_has_its_reason():
    with pytest.raises(NewtonError, match=r"stops at a residual of 1\.0e\+00"):
        newton(of(lambda x: x**2 + 1, lambda x: 2 * x + 1e-30), np.array([0.3]))
    with pytest.raises(NewtonError, match="no finite numbers at the starting guess"):
        newton(of(lambda x: np.nan, lambda x: 1.0), np.array([0.0]))
    flat = lambda w: (w * 0 + 1, lambda right: np.linalg.solve(np.zeros((1, 1)), right))  # noqa: E731
    with pytest.raises(NewtonError, match="singular at Newton step 1") as error:
        newton(flat, np.array([2.0]))
    assert error.value.last == pytest.approx([2.0])


def test_steps_stay_within_bounds_and_below_their_longest():
    line = of(lambda x: x - 7.0, lambda x: 1.0)
    bounded = (np.array([0.0]), np.array([5.0]))
    assert iterate(line, np.array([1.0]), settled=1e-9, within=bounded, halvings=0).w == 5.0
    assert iterate(line, np.array([1.0]), tolerance=1e-9, steps=3, longest=0.5).w == 2.5


def circle(w):
    return np.array([w @ w - 1.0]), 2 * w[None, :]


def test_a_circle_is_walked_round_and_steps_follow_its_curvature():
    curve = ImplicitCurve(circle)
    walk = Walk(
        curve,
        np.array([1.0, 0.0]),
        np.array([0.0, 1.0]),
        length=2.0,
        longest=0.6,
        shortest=1e-6,
        growth=2.0,
        least_cosine=0.9,
    )
    angles = []
    while len(angles) < 40:
        walk.advance()
        assert np.hypot(*walk.place) == pytest.approx(1.0, abs=1e-9)
        angles.append(np.arctan2(walk.place[1], walk.place[0]))
    turned = np.diff(np.unwrap(angles))
    assert np.all(turned > 0)
    assert np.all(np.cos(turned) > 0.9)
    assert turned.sum() > 2 * np.pi


def test_a_place_within_a_step_is_found_and_a_curve_that_ends_is_told():
    curve = ImplicitCurve(circle)
    top = curve.where(lambda w: w[0], np.array([0.6, 0.8]), np.array([-0.8, 0.6]), 0.7)
    assert top == pytest.approx([0.0, 1.0], abs=1e-9)
    ended = ImplicitCurve(lambda w: (np.array([w[0] ** 2 + w[1] ** 2 + 1]), 2 * w[None, :]))
    walk = Walk(ended, np.array([1.0, 0.0]), np.array([0.0, 1.0]), 0.1, 0.1, 1e-3, 1.5, 0.9)
    refused(r"even steps of .* fail", walk.advance, error=NewtonError)
