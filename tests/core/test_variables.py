"""Units and variables."""

import math

import pytest
from conftest import refused

from pam_ocp import UnknownNameError, Variable
from pam_ocp.core.quantities import quantity
from pam_ocp.core.units import unit


@pytest.mark.parametrize(
    ("name", "exponents", "factor"),
    [
        ("Pa", {"kg": 1, "m": -1, "s": -2}, 1.0),
        ("bar", {"kg": 1, "m": -1, "s": -2}, 1e5),
        ("N.s/m", {"kg": 1, "s": -1}, 1.0),
        ("N.m/rad", {"kg": 1, "m": 2, "s": -2, "rad": -1}, 1.0),
        ("m3/(s.Pa)", {"kg": -1, "m": 4, "s": 1}, 1.0),
        ("mm/s2", {"m": 1, "s": -2}, 1e-3),
        ("1/s", {"s": -1}, 1.0),
        ("cm³", {"m": 3}, 1e-6),
        ("µm/s²", {"m": 1, "s": -2}, 1e-6),
        ("N·m/°", {"kg": 1, "m": 2, "s": -2, "rad": -1}, 180 / math.pi),
        ("%", {}, 0.01),
        ("1", {}, 1.0),
    ],
)
def test_units_reduce_to_si_base_units(name, exponents, factor):
    assert unit(name).base_exponents == exponents
    assert unit(name).factor == pytest.approx(factor, rel=1e-15)


def test_unknown_unit_names_the_nearest():
    refused("kPa", unit, "KPa", error=UnknownNameError)
    refused("N.m", unit, "Nm", error=UnknownNameError)


def test_a_frequency_is_read_as_its_unit_is_shown():
    assert quantity("f", "90 1/min", "1/s") == pytest.approx(1.5)
    assert quantity("x", "\u22122 mm", "m") == -0.002  # the typesetter's minus
    assert quantity("T", "20 °C", "K") == quantity("T", "20 degC", "K") == 293.15


def test_a_variable_shows_its_value_in_the_unit_people_read():
    assert Variable("p", "state", unit="Pa").shown(2.5e5) == "2.5 bar"
    assert Variable("x", "state", unit="m").shown(0.015) == "15 mm"
    assert Variable("k", "output", display_unit="%").shown(0.1) == "10 %"


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"name": "2x"}, "letters, digits"),
        ({"name": "x..y"}, "letters, digits"),
        ({"name": "x", "min": 2.0, "max": 1.0}, "min = 2 must not lie above max = 1"),
        ({"name": "x", "nominal": 0.0}, "nominal"),
        ({"name": "x", "nominal": math.inf}, "nominal"),
        ({"name": "x", "start": math.nan}, "finite"),
        ({"name": "x", "start": 3.0, "max": 1.0}, "outside"),
        ({"name": "x", "unit": "m", "display_unit": "bar"}, "does not measure the same"),
        ({"name": "x", "codes": ["off", "on"]}, "two different words"),
        ({"name": "x", "codes": "off off"}, "two different words"),
        ({"name": "x", "codes": "off on", "unit": "Pa"}, "codes have no unit"),
        ({"name": "x", "codes": "off on", "start": 2.0}, "outside"),
        ({"name": "x", "codes": "off on", "start": 0.5}, "give one of the codes"),
    ],
)
def test_a_variable_refuses_what_makes_no_sense(attributes, message):
    refused(message, Variable, causality="state", **attributes)
