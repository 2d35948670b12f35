"""CasADi expressions over arrays, against CasADi point by point."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.numerics import elementwise
from pam_ocp.numerics.elementwise import Columns, Elementwise

x, y = ca.SX.sym("x"), ca.SX.sym("y")


@pytest.mark.parametrize(
    "expression",
    [
        x + y,
        x - y,
        x * y,
        x / y,
        -x,
        x**2,
        2 * x,
        1 / y,
        x**y,
        x**3.5,
        ca.sqrt(x),
        ca.exp(x),
        ca.expm1(x),
        ca.log(y),
        ca.log1p(x),
        ca.sin(x),
        ca.cos(x),
        ca.tan(x),
        ca.asin(x / 9),
        ca.acos(x / 9),
        ca.atan(x),
        ca.atan2(x, y),
        ca.sinh(x),
        ca.cosh(x),
        ca.tanh(x),
        ca.asinh(x),
        ca.acosh(1 + y),
        ca.atanh(x / 9),
        ca.hypot(x, y),
        ca.erf(x),
        ca.fabs(x - 1),
        ca.sign(x - 1),
        ca.floor(x),
        ca.ceil(x),
        ca.fmin(x, y),
        ca.fmax(x, y),
        ca.fmod(x, y),
        ca.if_else(x < y, x, y),
        ca.if_else(x <= 1, 1, y),
        x == y,
        x != y,
        ca.copysign(x, -y),
        ca.logic_and(x > 1, y > 1),
        ca.logic_or(x > 1, y > 1),
        ca.logic_not(x > 1),
    ],
    ids=str,
)  # one per operation
def test_each_operation_gives_what_casadi_does(expression):
    function = ca.Function("f", [x, y], [expression])
    a, b = np.meshgrid([0.3, 1.0, 2.7], [0.6, 1.0, 4.2])
    (found,) = Elementwise(function)(a, b)
    wanted = [
        [float(function(p, q)) for p, q in zip(r, s, strict=True)]
        for r, s in zip(a, b, strict=True)
    ]
    np.testing.assert_allclose(np.broadcast_to(found, a.shape), wanted, rtol=1e-14)


def test_arguments_broadcast_and_outputs_come_in_the_order_of_nonzeros():
    vector = ca.SX.sym("v", 2)
    sparse = ca.SX(2, 2)
    sparse[1, 0], sparse[0, 1] = x * vector[0], vector[1]
    found = Elementwise(ca.Function("f", [x, vector], [sparse, x + 1]))(
        np.arange(3.0)[None], np.array([[2.0], [3.0]]), 5.0
    )
    np.testing.assert_array_equal(found[0], [[0, 2, 4], [0, 3, 6]])
    assert found[1] == 5.0
    np.testing.assert_array_equal(found[2], [[1, 2, 3]])


def test_what_numpy_does_not_know_is_left_to_casadi():
    v, w = ca.MX.sym("v"), ca.MX.sym("w")
    function = ca.Function("f", [v, w], [v * w, v + w])
    product, total = Elementwise(function)(np.arange(4.0), 2.0)
    np.testing.assert_array_equal(product, [0, 2, 4, 6])
    np.testing.assert_array_equal(total, [2, 3, 4, 5])


# ---- many columns ----
X, U, P = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
VALUES = ca.vertcat(ca.sin(X[0]) * P[0], U * X[1] ** 2, P[1], 0, ca.if_else(U > 0, X[0], -U))


@pytest.mark.parametrize("at_once", [3, 7, 4096])
def test_columns_are_what_casadi_maps(monkeypatch, at_once):
    monkeypatch.setattr(elementwise, "AT_ONCE", at_once)
    random = np.random.default_rng(1)
    states, inputs, shared = random.normal(size=(2, 7)), random.normal(size=(1, 7)), [0.3, -2.0]
    found = Columns([X, U, P], VALUES)(states, inputs, np.array(shared))
    function = ca.Function("f", [X, U, P], [VALUES])
    expected = np.column_stack(
        [
            np.asarray(function(a, b, shared)).ravel()
            for a, b in zip(states.T, inputs.T, strict=True)
        ]
    )
    assert found == pytest.approx(expected, rel=1e-14)


def test_nothing_has_no_rows():
    assert Columns([X, U, P], ca.SX(0, 1))(np.ones((2, 5)), np.ones((1, 5)), np.ones(2)).shape == (
        0,
        5,
    )
