"""Tables of estimates for LaTeX, read back by a small parser of their own."""

import math
import re

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.fitting.estimates import Tabled
from pam_ocp.fitting.statistics import Coefficient


def parsed(text):
    """{parameter: (value, standard error or None, (low, high) or None, unit)} of a table."""
    begin, *lines, end = text.splitlines()
    assert begin == r"\begin{tabular}{lrrl}"
    assert end == r"\end{tabular}"
    rules = [line for line in lines if line.endswith("rule")]
    assert rules == [r"\toprule", r"\midrule", r"\bottomrule"]
    found = {}
    for line in lines[3:-1]:
        assert line.count("{") == line.count("}")
        name, value, interval, unit = re.split(r"(?<!\\)&", line.removesuffix(r"\\"))
        scale = 10.0 ** int((re.findall(r"\\times 10\^\{(-?\d+)\}", value) or ["0"])[0])
        power = int((re.findall(r"10\^\{(-?\d+)\}", interval or value) or ["0"])[0])
        assert scale == 10.0**power or not interval.strip()
        both = [scale * float(n) for n in re.findall(r"-?\d+\.?\d*", value.split(r"\times")[0])]
        text = interval.replace(r"\infty", "inf")
        ends = re.findall(r"\[(.*?),\\ (.*?)\]", text)
        bounds = tuple(scale * float(n) for n in ends[0]) if ends else None
        error = both[1] if len(both) > 1 else None
        found[name.strip().replace("\\", "")] = (both[0], error, bounds, unit.strip())
    return found


def test_a_force_fits_table_says_its_numbers_to_the_second_digit_of_their_errors():
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    fit = pam.fit_force(table, fixed={"a3": -50.0})
    rows = parsed(fit.to_latex())
    assert list(rows) == list(fit.coefficients)
    for name, c in fit.coefficients.items():
        value, error, bounds, unit = rows[name]
        assert unit == ("" if c.unit == "1" else c.unit)
        if c.held:
            assert (value, error, bounds) == (-50.0, None, None)
            continue
        step = 10.0 ** (math.floor(math.log10(c.stderr)) - 1)
        assert value == pytest.approx(c.value, abs=0.501 * step)
        assert error == pytest.approx(c.stderr, abs=0.501 * step)
        assert bounds == pytest.approx(fit.interval(name), abs=0.501 * step)
    assert parsed(fit.to_latex(0.5))["a5"][2][1] < rows["a5"][2][1]


class Some(Tabled):
    """Numbers that are hard to write."""

    coefficients = {  # noqa: RUF012
        "muscle_1.C": Coefficient("muscle_1.C", 1.2345e-9, 3e-11, "m3/(s.Pa)", False),
        "share": Coefficient("share", 5666.0, 450.0, "%", False),
        "zero": Coefficient("zero", 0.0, 0.013, "1", False),
        "blind": Coefficient("blind", 4.0e6, math.inf, "N", False),
    }

    def intervals(self, level=0.95):
        found = self.coefficients.items()
        return {n: (c.value - 2 * c.stderr, c.value + 2 * c.stderr) for n, c in found}


def test_signs_powers_and_open_ends_are_written_as_latex_reads_them():
    text = Some().to_latex()
    assert r"muscle\_1.C & $(1.234 \pm 0.030) \times 10^{-9}$" in text
    assert r"& m$^{3}$/(s\,Pa) \\" in text
    assert r"share & $5670 \pm 450$ & $[4770,\ 6570]$ & \% \\" in text
    assert r"zero & $0.000 \pm 0.013$ & $[-0.026,\ 0.026]$ &" in text
    assert r"$(4.000 \pm \infty) \times 10^{6}$ & $[-\infty,\ \infty] \times 10^{6}$" in text
    assert re.search(r"(?<!\\)_", text) is None


def test_fits_of_plants_and_of_several_muscles_have_the_same_table():
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    joint = pam.fit_forces({"a": table, "b": table})
    assert np.all([v[0] for v in parsed(joint.to_latex()).values()])
    assert list(parsed(joint.to_latex())) == list(joint.coefficients)
