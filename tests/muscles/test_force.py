"""Force, stiffness, inverse and clamp of the six-parameter law."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from conftest import refused

from pam_ocp.core.errors import InputError
from pam_ocp.muscles.catalogue import muscle
from pam_ocp.muscles.gas import closed_stiffness, iso6358
from pam_ocp.muscles.law import LAWS, SixParameterLaw, clamp
from pam_ocp.muscles.pneumatic_muscle import Muscle
from pam_ocp.muscles.validity import ValidityWarning

# Published set of the DMSP-20-400N: p in bar, kappa in percent, F in N.
A1, A2, A3, A4, A5, A6 = -4.35573, 281.22370, -0.32866, -9.27035, 302.20107, -263.69185


@pytest.fixture
def law() -> SixParameterLaw:
    return SixParameterLaw.from_published([A1, A2, A3, A4, A5, A6])


@pytest.fixture
def fluidic(law: SixParameterLaw) -> Muscle:
    return Muscle(
        law, rest_length=0.4, diameter=0.02, slack_width=2.0, contraction_range=(-0.05, 0.4)
    )


def printed_force(bar: float, percent: float) -> float:
    """Equation (3) as it is printed."""
    return (A1 * bar + A2) * math.exp(A3 * percent) + A4 * percent * bar + A5 * bar + A6


@pytest.mark.parametrize("bar", [0.0, 1.0, 3.5, 6.0])
@pytest.mark.parametrize("percent", [-2.0, 0.0, 5.0, 12.5, 25.0])
def test_law_in_si_equals_equation_3_in_bar_and_percent(law, bar, percent):
    assert law.tension(bar * 1e5, percent / 100) == pytest.approx(
        printed_force(bar, percent), rel=1e-13
    )


@pytest.mark.parametrize(("bar", "percent"), [(2.0, 3.0), (4.0, 10.0), (6.0, 20.0)])
def test_stiffness_is_equation_4_with_its_minus_sign_and_the_factor_of_percent(
    fluidic, bar, percent
):
    slope = A3 * (A1 * bar + A2) * math.exp(A3 * percent) + A4 * bar  # dF/dkappa, N per percent
    by_hand = -100 * slope / 0.4
    assert by_hand > 0
    assert fluidic.stiffness(bar * 1e5, percent / 100) == pytest.approx(by_hand, rel=1e-13)


def test_a_pressure_beyond_what_was_measured_is_said(fluidic):
    with pytest.warns(ValidityWarning, match=r"pressure = 1434 bar is outside"):
        assert fluidic.pressure(300e3, 0.1) > 1e7


def test_inverse_is_refused_where_pressure_does_not_raise_the_force(law):
    refused("does not raise the force", law.pressure, 100.0, 0.40)


def test_blocked_force_and_largest_contraction_at_6_bar_are_those_published():
    expected = {"DMSP-10": (595, 23.1), "DMSP-20-200N": (1752, 26.5), "DMSP-20-400N": (1805, 27.9)}
    for name, (force, percent) in expected.items():
        known = muscle(name, rest_length=0.25)
        assert known.blocked_force(6e5) == pytest.approx(force, abs=0.5)
        assert 100 * known.max_contraction(6e5) == pytest.approx(percent, abs=0.05)


# ---- the clamp ---------------------------------------------------------------------------


def clamp_with_slopes(width: float) -> ca.Function:
    t = ca.SX.sym("t")
    outputs = [clamp(t, width)]
    for _ in range(3):
        outputs.append(ca.jacobian(outputs[-1], t))
    return ca.Function("clamp", [t], outputs)


def test_clamp_is_exact_from_its_width_on_and_zero_below():
    function = clamp_with_slopes(2.0)
    for tension in (2.0, 2.5, 100.0, 1e6):
        assert float(function(tension)[0]) == tension
    for tension in (-2.0, -3.0, -1e6):
        assert float(function(tension)[0]) == 0.0


@pytest.mark.parametrize("edge", [-2.0, 2.0])
def test_clamp_has_three_continuous_derivatives(edge):
    function = clamp_with_slopes(2.0)
    inside, outside = edge - math.copysign(1e-7, edge), edge + math.copysign(1e-7, edge)
    for here, there in zip(function(inside), function(outside), strict=True):
        assert float(here) == pytest.approx(float(there), abs=1e-5)


def test_clamp_lies_at_most_016_widths_above_the_sharp_maximum_and_never_falls():
    t = np.linspace(-3, 3, 6001)
    values = np.array(clamp_with_slopes(2.0)(t.reshape(1, -1))[0]).ravel()
    excess = values - np.maximum(t, 0)
    assert excess.min() >= -1e-14
    assert 0.15 * 2.0 < excess.max() < 0.16 * 2.0
    assert np.all(np.diff(values) >= -1e-14)


def test_force_is_never_negative_and_equals_the_law_where_taut(fluidic):
    p, kappa = np.meshgrid(np.linspace(0, 6e5, 50), np.linspace(0, 0.35, 50))
    force, tension = fluidic.force(p, kappa), fluidic.tension(p, kappa)
    assert force.min() >= 0
    taut = tension > 2.0
    assert np.array_equal(force[taut], tension[taut])


# ---- shapes, symbols, errors ---------------------------------------------------------------


def test_scalars_give_floats_and_arrays_broadcast(fluidic):
    assert isinstance(fluidic.force(1e5, 0.1), float)
    assert fluidic.force(np.full((3, 1), 2e5), np.zeros(4)).shape == (3, 4)
    assert fluidic.force([], 0.1).shape == (0,)
    assert fluidic.stiffness([1e5, 2e5], 0.1).shape == (2,)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (lambda m: m.force([1e5] * 2, [0.1] * 3), r"p has shape \(2,\), kappa has shape \(3,\):"),
        (lambda m: closed_stiffness(m, [1e5] * 2, [0.1] * 3), "p has shape"),
        (lambda m: iso6358([2e5] * 2, [1e5] * 3, 1e-8), "upstream has shape .* that broadcast"),
    ],
)
def test_shapes_that_do_not_fit_are_refused_by_name(fluidic, asked, said):
    refused(said, asked, fluidic)


def test_symbols_give_expressions_with_the_same_value(fluidic):
    p, kappa = ca.SX.sym("p"), ca.SX.sym("kappa")
    both = ca.Function("f", [p, kappa], [fluidic.force(p, kappa), fluidic.pressure(500.0, kappa)])
    force, pressure = both(3e5, 0.1)
    assert float(force) == fluidic.force(3e5, 0.1)
    assert float(pressure) == pytest.approx(fluidic.pressure(500.0, 0.1), rel=1e-15)


def test_coefficients_are_described_as_parameters():
    variables = SixParameterLaw.coefficient_variables("muscle1.")
    assert [v.name for v in variables] == [f"muscle1.a{i}" for i in range(1, 7)]
    assert {v.causality for v in variables} == {"parameter"}
    assert LAWS["six-parameter"] is SixParameterLaw


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rest_length": -0.4}, "rest_length = -0.4 m must be > 0"),
        ({"rest_length": 0.0}, "rest_length = 0 m must be > 0"),
        ({"rest_length": math.nan}, "must be a finite number"),
        ({"rest_length": 0.4, "diameter": -1.0}, "diameter = -1 m must be > 0"),
        ({"rest_length": 0.4, "slack_width": 0.0}, "slack_width = 0 N must be > 0"),
        ({"rest_length": 0.4, "pressure_range": (6e5, 0.0)}, "the first the smaller"),
    ],
)
def test_impossible_muscles_are_refused_with_the_value_seen(law, arguments, words):
    refused(words, Muscle, law, **arguments)


def test_a_law_is_asked_for_where_something_else_is_given():
    with pytest.raises(InputError, match="must be a ForceLaw"):
        Muscle("six-parameter", rest_length=0.4)  # type: ignore[arg-type]


@pytest.mark.parametrize("values", [[1, 2, 3], [1, 2, 3, 4, 5, math.inf]])
def test_a_published_set_needs_six_finite_numbers(values):
    refused("six finite numbers", SixParameterLaw.from_published, values)
