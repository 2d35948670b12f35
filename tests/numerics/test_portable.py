"""exp, expm1 and tanh by sums and products alone."""

import math

import casadi as ca
import numpy as np
import pytest

from pam_ocp.export.c_code.generated import counted
from pam_ocp.numerics.portable import portable, written_out


@pytest.mark.parametrize("name", ["exp", "expm1", "tanh"])
def test_they_are_those_of_the_c_library_to_two_units_in_the_last_place(name):
    x = ca.SX.sym("x")
    written = portable(ca.Function("f", [x], [getattr(ca, name)(x)]))
    random = np.random.default_rng(0)
    points = np.concatenate(
        [random.uniform(-690, 690, 3000), random.normal(size=3000), 1e-4 * random.normal(size=3000)]
    )
    exact = getattr(np, name)(points)
    found = np.asarray(written(points[None])).ravel()
    assert np.max(np.abs(found - exact) / np.abs(exact)) <= 3 * 2.0**-52
    assert math.isnan(float(written(math.nan)))
    flat = written_out(written)
    codes = {flat.instruction_id(k) for k in range(flat.n_instructions())}
    assert not codes & {ca.OP_EXP, ca.OP_EXPM1, ca.OP_TANH, ca.OP_CALL}
    assert np.array_equal(np.asarray(flat(points[None])).ravel(), found)


def test_they_stand_once_in_c_code_and_each_call_counts():
    x = ca.SX.sym("x", 3)
    written = portable(ca.Function("f", [x], [ca.exp(x) + ca.exp(2 * x)]))
    generator = ca.CodeGenerator("f.c")
    generator.add(written)
    assert generator.dump().count("floor(") == 1
    once, six = counted(portable(ca.Function("f", [x], [ca.exp(x[0])]))), counted(written)
    assert once.whole
    assert six.whole
    assert six.by_kind["roundings"] == 6 * once.by_kind["roundings"] == 6


def test_all_else_of_a_function_stays_as_it_is():
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y")
    results = [ca.exp(x[0]) * y + ca.sqrt(x), ca.if_else(y > 1, ca.atan2(x[1], y), 0), ca.SX(2, 2)]
    function = ca.Function("f", [x, y], results)
    one, other = function([0.1, 0.2, 0.3], 2.0), portable(function)([0.1, 0.2, 0.3], 2.0)
    assert [e.shape for e in one] == [e.shape for e in other]
    for a, b in zip(one, other, strict=True):
        assert np.asarray(b) == pytest.approx(np.asarray(a), rel=1e-15, abs=0)


def test_a_function_without_them_is_left_alone():
    x = ca.SX.sym("x")
    function = ca.Function("f", [x], [ca.sqrt(x)])
    assert portable(function) is function
