"""Force laws: published errors, the table of laws on measured maps, and what all laws answer."""

from __future__ import annotations

import math
import pickle
import warnings

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.integrate import quad
from scipy.interpolate import BSpline

from pam_ocp.core.errors import UnknownNameError
from pam_ocp.core.quantities import UnitWarning
from pam_ocp.fitting import read_table
from pam_ocp.muscles.catalogue import muscle
from pam_ocp.muscles.law import LAWS, SixParameterLaw, coefficient
from pam_ocp.muscles.laws.braid import CorrectedLaw, GeometricLaw, ThickWallLaw
from pam_ocp.muscles.laws.empirical import (
    FiveParameterLaw,
    HildebrandtLaw,
    LengthScaledLaw,
    ThreeElementLaw,
    TwoSlopeThreeElementLaw,
)
from pam_ocp.muscles.laws.user_defined import (
    law_named,
    own_law,
    polynomial_law,
    spline_law,
    with_bladder,
    with_ends,
)
from pam_ocp.muscles.pneumatic_muscle import Muscle
from pam_ocp.muscles.validity import Validity, ValidityWarning, forget_warnings
from pam_ocp.plants.hanging import HangingLoad

REST_LENGTH = {"DMSP-20-300": 0.300, "DMSP-10-250": 0.250}

SAMPLES = {
    law.name: law
    for law in (
        GeometricLaw(alpha0=math.radians(24.42), radius=0.01),
        CorrectedLaw(alpha0=0.42, a_e=0.3, b_e=1.05, radius=0.01),
        SixParameterLaw.from_published(
            [-4.35573, 281.22370, -0.32866, -9.27035, 302.20107, -263.69185]
        ),
        FiveParameterLaw(2.49e-4, 314.3, -38.4, -8.32e-3, 2.616e-3),
        ThickWallLaw.from_published("DMSP-20-300"),
        HildebrandtLaw(2.75e-3, -9.98e-3, 4.99e-3, 1.078e4, -126.2, -1.993e4, 2.131e4),
        LengthScaledLaw.from_published("20", rest_length=0.3),
        ThreeElementLaw.reynolds(rest_length=0.2),
        TwoSlopeThreeElementLaw.festo(rest_length=0.3),
    )
}
AFFINE = sorted(n for n, law in SAMPLES.items() if law.is_affine())


@pytest.fixture(autouse=True)
def quiet():
    """Most of these tests leave the stated ranges on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ValidityWarning)
        yield


def measured(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pressure [Pa], contraction and force [N] of the cells with F > 0."""
    taut = read_table(f"{name}_static.csv", rest_length=REST_LENGTH[name]).taut
    return taut.pressure, taut.contraction, taut.force


# ---- against measurements ---------------------------------------------------------------------


@pytest.mark.parametrize(("name", "percent"), [("DMSP-20-300", 2.37), ("DMSP-10-250", 4.26)])
def test_thick_wall_law_has_its_published_largest_error(name, percent):
    p, kappa, force = measured(name)
    error = np.abs(ThickWallLaw.from_published(name).tension(p, kappa) - force)
    assert 100 * error.max() / force.max() == pytest.approx(percent, abs=0.005)


def test_catalogue_sets_fitted_here_have_the_errors_their_source_states():
    for name, rmse in (("DMSP-20-300", 6.2), ("DMSP-10-250", 1.1)):
        p, kappa, force = measured(name)
        error = muscle(name).tension(p, kappa) - force
        assert math.sqrt(np.mean(error**2)) == pytest.approx(rmse, abs=0.05)


# ---- what all laws answer ------------------------------------------------------------------------


def test_every_law_of_the_library_is_tried_here():
    assert set(SAMPLES) == set(LAWS)
    for law in LAWS.values():
        assert law.title
        assert law.reference
        assert law.__doc__


@pytest.mark.parametrize("name", SAMPLES)
def test_slopes_are_those_of_the_force(name):
    law, p, kappa = SAMPLES[name], 4.1e5, np.linspace(0.02, 0.15, 6)
    h = 1e-5
    by_kappa = (law.tension(p, kappa + h) - law.tension(p, kappa - h)) / (2 * h)
    by_p = (law.tension(p + 10, kappa) - law.tension(p - 10, kappa)) / 20
    assert law.dtension_dkappa(p, kappa) == pytest.approx(by_kappa, rel=1e-5)
    assert law.dtension_dp(p, kappa) == pytest.approx(by_p, rel=1e-6)
    assert np.all(by_kappa < 0)
    assert np.all(by_p > 0)


@pytest.mark.parametrize("name", SAMPLES)
def test_pressure_is_the_inverse_of_tension(name):
    law = SAMPLES[name]
    p, kappa = np.meshgrid([5e4, 2e5, 4e5, 6e5], [0.0, 0.03, 0.1, 0.15])
    assert law.pressure(law.tension(p, kappa), kappa) == pytest.approx(p, rel=1e-9)
    assert isinstance(law.pressure(500.0, 0.05), float)


@pytest.mark.parametrize("name", SAMPLES)
def test_unloaded_muscle_ends_where_its_tension_vanishes(name):
    law = SAMPLES[name]
    ends = law.max_contraction([3e5, 5e5])
    for p, end in zip((3e5, 5e5), ends, strict=True):
        assert 0.1 < end < 0.45
        assert abs(law.tension(p, end)) < 1e-8
        assert law.blocked_force(p) == law.tension(p, 0.0) > 0


@pytest.mark.parametrize("name", SAMPLES)
def test_every_law_moves_a_load_in_a_plant_with_finite_derivatives(name):
    law = SAMPLES[name]
    length = law.values.get("rest_length", 0.3)
    plant = HangingLoad(Muscle(law, rest_length=length, diameter=0.02), mass=10.0)
    values = [plant.vector(c) for c in ("state", "input", "parameter")]
    for block in plant.jacobians(*values):
        assert np.all(np.isfinite(np.asarray(block)))
    xdot = np.asarray(plant.function(*values)[0]).ravel()
    rise = float(law.tension(values[0][2], 0.0)) / 10.0 - 9.80665
    assert xdot[1] == pytest.approx(rise, rel=1e-12)


def test_laws_straight_in_pressure_are_told_from_the_others():
    assert set(SAMPLES) - set(AFFINE) == {"corrected", "three-element-two-slopes"}


@pytest.mark.parametrize("name", AFFINE)
def test_gain_area_is_the_integral_of_the_gain(name):
    law, end = SAMPLES[name], 0.18
    area = float(ca.evalf(ca.SX(law.gain_area(ca.SX(end)))))
    gain = quad(lambda x: law.dtension_dp(0.0, x), 0, end, epsabs=1e-16, epsrel=1e-12)[0]
    assert area == pytest.approx(gain, rel=1e-12)


def test_non_affine_laws_refuse_what_only_affine_ones_have():
    law = SAMPLES["corrected"]
    refused("not a straight line in pressure", law.gain_area, ca.SX.sym("k"))
    refused("no closed inverse", law.pressure, ca.SX.sym("F"), 0.1)
    refused("no pressure up to", law.pressure, 500.0, 0.40)


# ---- each against its formula by hand ----------------------------------------------------------


def test_geometric_law_is_the_work_of_the_braid_on_its_gas():
    r0, alpha, l0, p = 0.01, math.radians(24.42), 0.4, 3e5
    fibre, turns = l0 / math.cos(alpha), l0 * math.tan(alpha) / (2 * math.pi * r0)

    def volume(length):
        return math.pi * length * (fibre**2 - length**2) / (2 * math.pi * turns) ** 2

    law = GeometricLaw(alpha, r0)
    for kappa in (0.0, 0.1, 0.25):
        length = l0 * (1 - kappa)
        work = -p * (volume(length + 1e-6) - volume(length - 1e-6)) / 2e-6
        assert law.tension(p, kappa) == pytest.approx(work, rel=1e-8)


def test_corrected_law_is_the_geometric_one_at_a_stretched_contraction():
    law, plain = SAMPLES["corrected"], GeometricLaw(0.42, 0.01)
    for bar in (0.5, 2.0):
        stretch = 0.3 * math.exp(-bar) + 1.05
        assert law.tension(bar * 1e5, 0.1) == pytest.approx(plain.tension(bar * 1e5, stretch * 0.1))


def test_five_parameter_law_is_the_six_parameter_law_without_force_at_rest():
    five = SAMPLES["five-parameter"]
    six = SixParameterLaw(*five.values.values(), a6=-five.a2)
    assert five.tension(3e5, 0.1) == pytest.approx(six.tension(3e5, 0.1), rel=1e-14)
    assert five.tension(0.0, 0.0) == pytest.approx(0.0, abs=1e-12)


def test_hildebrandt_law_tends_to_the_printed_one_and_has_a_finite_slope_at_rest():
    values = list(SAMPLES["hildebrandt"].values.values())[:7]
    c0, c1, c2, b0, b1, b2, b3 = values
    p, k = 4e5, 0.1
    printed = p * (c0 + c1 * k + c2 * k**2) - (b0 * k ** (2 / 3) + b1 + b2 * k + b3 * k**2)
    assert HildebrandtLaw(*values, 1e-9).tension(p, k) == pytest.approx(printed, rel=1e-4)
    assert math.isfinite(SAMPLES["hildebrandt"].dtension_dkappa(p, 0.0))


@pytest.mark.parametrize(
    ("diameter", "a", "full"),
    [
        ("10", (0.568208, 4.254425, 0.559728), 620 * 0.4895 * math.atan(0.03068 * 0.2425 * 620)),
        ("20", (0.257853, 6.476614, 1.320877), 620 * 1.4877 * math.atan(0.0248 * 0.2425 * 620)),
        ("40", (0.122366, 10.471434, 2.023288), 6398.4),
    ],
)
def test_length_scaled_law_is_its_formula_at_250_mm(diameter, a, full):
    law = LengthScaledLaw.from_published(diameter, rest_length=0.25, max_contraction_ratio=0.2)
    for kpa, kappa in ((620, 0.0), (400, 0.05), (300, 0.1)):
        r = kappa / 0.2
        f = a[0] * (math.exp(-a[1] * r) - 1) + kpa / 620 * math.exp(-a[2] * r**2)
        assert law.tension(kpa * 1e3, kappa) == pytest.approx(full * f, rel=1e-7)
    assert 0.2 < law.max_contraction(620e3) < 0.21  # where the published sets end


def test_longer_muscles_pull_harder_in_the_length_scaled_law():
    forces = [muscle("DMSP-10-scaled", rest_length=x).blocked_force(6e5) for x in (0.1, 0.2, 0.4)]
    assert forces == sorted(forces)
    assert muscle("DMSP-40", rest_length=0.3).blocked_force(620e3) == pytest.approx(
        6398.4, rel=1e-7
    )


def test_three_element_sets_are_those_printed():
    kpa, mm = 400.0, 20.0
    reynolds = 179.2 + 1.39 * kpa - (5.71 + 0.0307 * kpa) * mm
    assert SAMPLES["three-element"].tension(4e5, mm / 200) == pytest.approx(reynolds)
    for kpa, stiffness in ((200.0, 32.7 - 0.0321 * 200), (500.0, 17 + 0.0179 * 500)):
        festo = 2.91 * kpa + 44.6 - stiffness * mm
        assert SAMPLES["three-element-two-slopes"].tension(kpa * 1e3, mm / 300) == pytest.approx(
            festo
        )


def test_a_small_force_may_need_less_than_no_pressure():
    """F = 2.91 P + 44.6 at rest length."""
    law = SAMPLES["three-element-two-slopes"]
    assert law.pressure(20.0, 0.0) == pytest.approx((20 - 44.6) / 2.91e-3, rel=1e-9)


def test_rest_length_of_a_law_is_that_of_its_muscle():
    law = ThickWallLaw.from_published("DMSP-20-300")
    refused(r"holds 0\.3 m", Muscle, law, rest_length=0.25)
    longer = Muscle(law, rest_length=0.3).with_rest_length(0.35)
    assert longer.law.rest_length == longer.rest_length == 0.35
    plant = HangingLoad(longer)
    assert [v.name for v in plant.parameters].count("muscle.rest_length") == 1
    refused("did you mean", ThickWallLaw.from_published, "DMSP-20-30", error=UnknownNameError)


KNOWN = {
    "geometric": {"radius": None},
    "corrected": {"radius": None, "unit_pressure": 1e5},
    "thick-wall": {
        "rest_diameter": None, "rest_length": None, "wall": 1.8e-3,
        "fibre_angle": math.radians(28.6),
    },
    "hildebrandt": {"smoothing": 1e-3},
    "length-scaled": {
        "max_contraction_ratio": None, "rest_length": None, "dead_length": 7.5e-3,
        "full_pressure": 620e3,
    },
    "three-element": {"rest_length": None},
    "three-element-two-slopes": {"rest_length": None, "rounding": 200.0},
    "six-parameter+bladder": {"threshold_width": 2e3},
    "six-parameter+ends": {"rigid": 0.0},
}  # fmt: skip
"""Constants of the braid, the muscle or the rounding, which no measurement of forces gives; None
has to be given."""
STATED = {
    "corrected": ((0.0, 2e5), (-math.inf, math.inf)),
    "thick-wall": ((0.0, 7e5), (-0.01, 0.27)),
    "length-scaled": ((0.0, 6.2e5), (0.0, 0.45)),
    "three-element": ((207e3, 621e3), (-math.inf, math.inf)),
    "three-element-two-slopes": ((150e3, 550e3), (-math.inf, math.inf)),
}


@pytest.mark.parametrize("name", [*LAWS, "six-parameter+bladder", "six-parameter+ends"])
def test_known_constants_are_told_from_what_a_fit_determines(name):
    law = law_named(name)
    assert law.fixed_coefficients() == KNOWN.get(name, {})
    assert {*law.free_coefficients(), *law.fixed_coefficients()} == {
        v.name for v in law.coefficient_variables()
    }
    everywhere = ((-math.inf, math.inf), (-math.inf, math.inf))
    assert (law.validity.pressure, law.validity.contraction) == STATED.get(name, everywhere)


def test_a_coefficient_has_a_range():
    alpha = GeometricLaw.coefficient_variables()[0]
    assert (alpha.min, alpha.max) == (math.radians(5.0), math.radians(54.7))
    refused("alpha0", GeometricLaw, 1.2, 0.01)


# ---- free laws ---------------------------------------------------------------------------------


def test_polynomial_law_is_its_polynomials():
    law = polynomial_law(1, 2)(3e-3, -9e-3, 10.0, -500.0, 800.0)
    k = 0.12
    by_hand = (3e-3 - 9e-3 * k) * 4e5 + 10 - 500 * k + 800 * k**2
    assert law.tension(4e5, k) == pytest.approx(by_hand, rel=1e-14)
    assert type(law) is polynomial_law(1, 2)
    assert law.free_coefficients() == ("g0", "g1", "h0", "h1", "h2")
    area = ca.evalf(ca.SX(law.gain_area(ca.SX(k))))
    assert float(area) == pytest.approx(3e-3 * k - 9e-3 * k**2 / 2, rel=1e-14)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_spline_law_is_scipys_spline_and_goes_on_beyond_its_ends(degree):
    breaks = (0.0, 0.05, 0.12, 0.25)
    count = len(breaks) - 1 + degree
    rng = np.random.default_rng(3)
    g, h = rng.uniform(1e-3, 3e-3, count), rng.uniform(-300, 0, count)
    law = spline_law(breaks, degree)(*g, *h)
    knots = [0.0] * degree + list(breaks) + [0.25] * degree
    kappa = np.concatenate([np.linspace(-0.03, 0.3, 67), breaks])
    expected = BSpline(knots, g, degree)(kappa) * 4e5 + BSpline(knots, h, degree)(kappa)
    assert law.tension(4e5, kappa) == pytest.approx(expected, rel=1e-11)
    assert law.validity.contraction == (0.0, 0.25)
    gain = BSpline(knots, g, degree).antiderivative()
    for end in (-0.02, 0.03, 0.2, 0.28):
        area = float(ca.evalf(ca.SX(law.gain_area(ca.SX(end)))))
        assert area == pytest.approx(float(gain(end) - gain(0.0)), rel=1e-12)


def test_own_law_is_the_same_as_function_and_as_expression():
    described = {
        "area": coefficient("N/Pa", 1e-3, "area", minimum=0.0),
        "spring": coefficient("N", 1e3, "spring"),
    }
    p, kappa, area, spring = (ca.SX.sym(n) for n in ("p", "kappa", "area", "spring"))
    classes = [
        own_law("mine", lambda p, kappa, area, spring: area * p - spring * kappa, described),
        own_law("mine", area * p - spring * kappa, described),
    ]
    for law in classes:
        known = Muscle(law(area=3e-3, spring=6e3), rest_length=0.3)
        assert known.force(4e5, 0.1) == pytest.approx(600.0)
        assert known.stiffness(4e5, 0.1) == pytest.approx(6e3 / 0.3)
        assert known.pressure(600.0, 0.1) == pytest.approx(4e5)
        assert HangingLoad(known).variable("muscle.spring").unit == "N"


def test_own_law_names_what_it_does_not_know():
    p, kappa, stranger = ca.SX.sym("p"), ca.SX.sym("kappa"), ca.SX.sym("stranger")
    refused("it holds stranger too", own_law, "mine", p * kappa + stranger, {})
    refused("choose another name", own_law, "mine", p, {"kappa": coefficient("1", 1.0, "taken")})


PLANE = polynomial_law(1, 1)(1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    "law",
    [SAMPLES["thick-wall"], PLANE, with_bladder(PLANE, 1e4), with_ends(SAMPLES["thick-wall"])],
)
def test_laws_survive_pickling(law):
    assert pickle.loads(pickle.dumps(law)) == law


# ---- ranges --------------------------------------------------------------------------------------


def test_leaving_the_stated_range_warns_once_with_the_value_and_the_range():
    law = SAMPLES["corrected"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        forget_warnings()
        law.tension(1e5, 0.1)
        assert caught == []
        law.tension(ca.SX.sym("p"), 0.1)
        law.tension([1e5, 3e5], 0.1)
        law.tension(4e5, 0.1)
    assert [str(w.message) for w in caught] == [
        "corrected law: pressure = 3 bar is outside 0 bar .. 2 bar, where it holds; the force is "
        "an extrapolation (the correction is stated for at most 200 kPa)"
    ]


def test_a_muscle_warns_where_it_was_not_measured():
    forget_warnings()
    with pytest.warns(ValidityWarning, match=r"contraction = 30 % is outside 0 % \.\. 20\.8 %"):
        muscle("DMSP-10-250").force(3e5, 0.30)


@pytest.mark.parametrize("part", [0.5, 2.0])
def test_rounding_at_the_end_of_a_range_is_no_extrapolation(part):
    """A thousand-millionth of the upper end, whatever the unit."""
    told = Validity(pressure=(1e5, 6e5), contraction=(0.0, 0.25))
    for pressure, kappa in ((6e5 * (1 + part * 1e-9), 0.1), (1e5 - part * 6e-4, 0.1),
                            (2e5, 0.25 * (1 + part * 1e-9)), (2e5, -part * 0.25e-9)):  # fmt: skip
        forget_warnings()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            told.check("law", pressure, kappa)
        assert len(caught) == (part > 1)


def test_a_law_without_a_stated_range_holds_everywhere():
    assert Validity() == Validity((-math.inf, math.inf), (-math.inf, math.inf))
    half = Validity(pressure=(0.0, math.inf))
    forget_warnings()
    with pytest.warns(ValidityWarning, match=r"pressure = -0.1 bar"):
        half.check("half", [-1e4, 9e9], 7.0)


@pytest.mark.parametrize("breaks", [[0.0, 0.2, 0.1], [0.0, 0.1, 0.1], [0.0, 0.1, math.nan], [0.1]])
def test_breaks_of_a_spline_must_increase(breaks):
    refused("two or more increasing contractions", spline_law, breaks)


def test_the_largest_contraction_is_looked_for_up_to_45_percent():
    end = own_law(
        "line", lambda p, kappa, end: p * (end - kappa), {"end": coefficient("1", 0.1, "its end")}
    )
    assert end(0.4493).max_contraction(3e5) == pytest.approx(0.4493, abs=1e-12)
    assert math.isnan(end(0.4507).max_contraction(3e5))
    assert math.isnan(end(-0.01).max_contraction(3e5))


def test_a_pressure_range_typed_in_bar_is_doubted():
    with pytest.warns(UnitWarning, match="pressure_range = 6 Pa.*6 bar"):
        Muscle(SAMPLES["six-parameter"], 0.3, pressure_range=(0.0, 6.0))
