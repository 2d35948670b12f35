"""Objects show themselves: one line as repr, tables and a picture in notebooks."""

import itertools
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.figures.canvas import COLOURS
from pam_ocp.figures.sheets import MOST_ROWS, Grid, Sheet


@pytest.fixture(scope="module")
def things(static_fit, load_10kg, short_plan):
    pressure = {"muscle.pressure": 2e5}
    points = pam.equilibrium(load_10kg, pressure), pam.operating.equilibria(load_10kg, pressure)
    mpc = pam.Mpc(short_plan.plant, horizon=5, sample_time=0.01, track={"x": 1.0})
    muscle, plan = pam.muscle("DMSP-20-300"), short_plan
    nouns = [muscle, load_10kg, load_10kg.variable("x"), *points]
    return [*nouns, static_fit.table, static_fit, plan, plan.verdict, plan.trajectory, mpc]


def parsed(thing):
    """The form for notebooks, which must be well formed."""
    return ET.fromstring(thing._repr_html_())


@pytest.mark.slow
def test_every_noun_and_result_has_a_line_and_a_form_for_notebooks(things):
    for thing in things:
        line = repr(thing)
        assert "\n" not in line
        assert "object at" not in line
        assert len(line) < 400
        block = parsed(thing)
        assert block.find("b").text
        assert block.find("table") is not None or block.find("pre") is not None, thing


def test_a_plan_shows_its_verdict_first_and_its_picture(things):
    plan = things[7]
    block = parsed(plan)
    assert str(plan.verdict) in block[1].text
    assert block.find("img").get("src").startswith("data:image/png;base64,iVBOR")


def test_tables_show_values_in_display_units(things):
    point = things[3]
    rows = {r[0].text: [c.text for c in r] for r in parsed(point).iter("tr") if r[0].tag == "td"}
    assert rows["muscle.pressure"][1:3] == ["2", "bar"]
    assert rows["x"][1:3] == [f"{1e3 * point['x']:.4g}", "mm"]
    kept = point.to_pandas().set_index("name")  # a table has all digits
    assert float(kept.loc["x", "value"]) == pytest.approx(1e3 * point["x"], rel=1e-14)


def test_what_rounding_leaves_of_a_zero_is_read_as_zero():
    """In a position 1e-24 m are none; a parameter so small was given so."""
    x = pam.Variable("x", "state", unit="m", nominal=0.02)
    assert [x.shown(v) for v in (-1.2e-27, 1e-12, 1e-10)] == ["0 mm", "0 mm", "1e-07 mm"]
    assert pam.Variable("leak", "parameter").shown(1.23456e-11) == "1.235e-11"


def test_numbers_have_four_digits_and_stiffness_is_in_newtons_per_millimetre():
    k = pam.Variable("k", "output", unit="N/m", nominal=1e4)
    said = [k.shown(v) for v in (9001.4, 1e8 / 3, -20e3)]
    assert said == ["9.001 N/mm", "33330 N/mm", "-20 N/mm"]


def test_what_names_and_notes_hold_is_text_and_no_markup():
    sheet = Sheet("<script>alert(1)</script>", grids=(Grid(("a",), [["<b>"]]),), notes=("<i>",))
    block = ET.fromstring(sheet.html())
    assert block.find("b").text == "<script>alert(1)</script>"
    assert not list(block.iter("script"))
    assert not list(block.iter("i"))


def test_long_tables_are_cut_and_say_so():
    rows = [[str(i)] for i in range(MOST_ROWS + 7)]
    assert "7 more rows" in Grid(("n",), rows).html()


def test_a_figure_is_a_picture_in_notebooks_and_opens_no_window_without_a_display(things):
    picture = things[9].plot()
    assert picture._repr_png_().startswith(b"\x89PNG")
    refused(r"opens no windows.*savefig", picture.show)


def test_fits_and_muscles_have_a_plot_and_a_frame(things):
    muscle, fit = things[0], things[6]
    assert len(muscle.plot().axes) >= 2
    assert len(fit.plot().axes) >= 2
    frame = fit.to_pandas()
    assert list(frame.index) == list(fit.coefficients)
    assert frame.loc["a3", "low"] == fit.interval("a3")[0]


def test_columns_of_a_trajectory_complete_by_tab(things):
    motion = things[9]
    assert "muscle1_pressure" in dir(motion)
    assert np.array_equal(motion.muscle1_pressure, motion["muscle1.pressure"])
    assert "muscle1.pressure" in motion._ipython_key_completions_()
    with pytest.raises(AttributeError, match="muscle9_pressure"):
        _ = motion.muscle9_pressure


# G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, IEEE TVCG 15 (2009) 1291-1298, severity 1
BLINDNESS = {
    "none": np.eye(3),
    "protanope": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranope": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanope": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def seen(colour, matrix):
    """CIE L*a*b* of an sRGB colour as an eye of this kind sees it."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = to_xyz @ np.clip(np.array(matrix) @ linear, 0, 1) / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("eye", BLINDNESS)
def test_any_two_colours_are_told_apart_by_every_eye(eye):
    """Ten units of L*a*b* are a clear difference; 2.3 are just noticeable."""
    labs = [seen(colour, BLINDNESS[eye]) for colour in COLOURS]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(labs, 2)) > 10
