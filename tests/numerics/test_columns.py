"""Functions at many columns, against CasADi's map."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.numerics import columns
from pam_ocp.numerics.columns import Columns

x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
VALUES = ca.vertcat(ca.sin(x[0]) * p[0], u * x[1] ** 2, p[1], 0, ca.if_else(u > 0, x[0], -u))


@pytest.mark.parametrize("at_once", [3, 7, 4096])
def test_columns_are_what_casadi_maps(monkeypatch, at_once):
    monkeypatch.setattr(columns, "AT_ONCE", at_once)
    random = np.random.default_rng(1)
    states, inputs, shared = random.normal(size=(2, 7)), random.normal(size=(1, 7)), [0.3, -2.0]
    found = Columns([x, u, p], VALUES)(states, inputs, np.array(shared))
    function = ca.Function("f", [x, u, p], [VALUES])
    expected = np.column_stack(
        [
            np.asarray(function(a, b, shared)).ravel()
            for a, b in zip(states.T, inputs.T, strict=True)
        ]
    )
    assert found == pytest.approx(expected, rel=1e-14)


def test_nothing_has_no_rows():
    assert Columns([x, u, p], ca.SX(0, 1))(np.ones((2, 5)), np.ones((1, 5)), np.ones(2)).shape == (
        0,
        5,
    )
