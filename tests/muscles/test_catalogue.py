"""The catalogue: names, sources, figures and refusals."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import refused

from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.muscles.catalogue import (
    attribution_table,
    catalogue_entry,
    muscle,
    muscle_names,
    summary,
    transfer_note,
)
from pam_ocp.muscles.law import coefficient
from pam_ocp.muscles.laws.user_defined import law_named, own_law, polynomial_law, spline_law
from pam_ocp.muscles.muscle_file import load_muscle, save_muscle
from pam_ocp.muscles.pneumatic_muscle import Muscle

HEAD = 'format = "pam_ocp muscle 1"\nrest_length = 0.3\n'
PLANE = 'law = "polynomial-0-0"\n[coefficients]\ng0 = 1e-3\nh0 = 0.0\n'

# REFERENCE: name -> (a1 .. a6 for bar and percent)
SETS = {
    "DMSP-10": (-9.2194029, 203.7012413, -0.34221042, -3.2255991, 109.2038216, -208.372034),
    "DMSP-20-200N": (-4.00180705, 292.4620246, -0.32930845, -9.33564098, 294.0538256, -280.498151),
    "DMSP-20-400N": (-4.35573, 281.22370, -0.32866, -9.27035, 302.20107, -263.69185),
    "DMSP-20-300": (12.789, 419.48, -0.56665, -8.7013, 267.672, -309.603),
    "DMSP-10-250": (-3.0515, 168.235, -0.42455, -2.90206, 91.4042, -201.027),
}


@pytest.mark.parametrize("name", SETS)
def test_the_five_six_parameter_sets_are_those_of_the_literature(name):
    known = muscle(name, rest_length=0.3)
    assert list(known.law.published().values()) == pytest.approx(SETS[name], rel=1e-12)


def test_every_entry_builds_a_muscle_that_says_whose_numbers_it_has():
    for name in muscle_names():
        known, entry = muscle(name, rest_length=0.25), catalogue_entry(name)
        assert (known.name, known.source, known.law.name) == (name, entry["source"], entry["law"])
        assert known.source
        assert transfer_note() in known.note
        assert known.construction in ("braided", "netted", "embedded")
        assert known.obtained in ("published", "transcribed", "fitted here")
        assert known.pressure_range[1] > 1e5
        assert known.force(min(5e5, known.pressure_range[1]), 0.05) > 0


def test_the_page_of_the_muscles_is_what_the_catalogue_says():
    page = (Path(__file__).parents[2] / "docs" / "muscles.md").read_text("utf-8")
    assert attribution_table() in page
    assert transfer_note() in page


def test_rest_lengths_are_those_of_the_muscles_and_can_be_replaced():
    lengths = {"DMSP-20-200N": 0.2, "DMSP-20-400N": 0.4, "DMSP-20-300": 0.3, "DMSP-10-250": 0.25}
    for name, length in lengths.items():
        assert muscle(name).rest_length == length
    assert muscle("DMSP-20-400N", rest_length=0.5).rest_length == 0.5


def test_a_muscle_without_length_asks_for_it():
    refused("no rest length in the catalogue; give rest_length", muscle, "DMSP-10")


def test_an_unknown_name_gives_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean") as caught:
        muscle("DMSP-20-400")
    assert "DMSP-20-400N" in caught.value.nearest


def test_a_wrong_length_is_refused_with_its_value():
    refused(r"rest_length = -0.1 m must be > 0", muscle, "DMSP-10", rest_length=-0.1)


def test_bundled_tables_are_named_by_the_sets_fitted_to_them():
    named = {n: catalogue_entry(n).get("data") for n in muscle_names()}
    assert named["DMSP-20-300"] == named["DMSP-20-300-wall"] == "DMSP-20-300_static.csv"
    assert named["DMSP-20-400N"] is None


def test_three_diameters_can_be_had():
    assert {muscle(n, rest_length=0.3).diameter for n in muscle_names()} >= {0.01, 0.02, 0.04}


def test_law_and_muscle_share_a_replaced_rest_length():
    longer = muscle("DMSP-20-300-wall", rest_length=0.31)
    assert longer.rest_length == longer.law.values["rest_length"] == 0.31


@pytest.mark.parametrize("ending", ["json", "toml"])
@pytest.mark.parametrize("name", ["DMSP-20-400N", "DMSP-20-300-wall", "DMSP-40", "Reynolds-2003"])
def test_a_muscle_of_any_law_survives_its_file(name, ending, tmp_path):
    known = replace(muscle(name, rest_length=0.3), mass=0.25)
    assert load_muscle(save_muscle(known, tmp_path / f"muscle.{ending}")) == known


@pytest.mark.parametrize("ending", ["json", "toml"])
@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("polynomial-1-2", polynomial_law(1, 2)),
        ("spline-2:0.0,0.1,0.25", spline_law([0, 0.1, 0.25], 2)),
    ],
)
def test_so_does_one_whose_form_was_chosen(name, law, ending, tmp_path):
    numbers = {v.name: 1e-3 * (i + 1) for i, v in enumerate(law.coefficient_variables())}
    known = Muscle(law(**numbers), rest_length=0.3, name="mine", pressure_range=(0, 5e5))
    assert law_named(name) is law
    again = load_muscle(save_muscle(known, tmp_path / f"muscle.{ending}"))
    assert again == known
    assert again.law.name == name


def test_a_law_of_ones_own_is_in_no_file(tmp_path):
    own = own_law("mine", lambda p, kappa, a: a * p, {"a": coefficient("N/Pa", 1e-3, "area")})
    with pytest.raises(InputError, match="law 'mine' is one of your own"):
        save_muscle(Muscle(own(a=1e-3), rest_length=0.3), tmp_path / "m.toml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.toml", "x = [", "cannot be read as a TOML file"),
        ("a.json", "{", "cannot be read as a muscle file"),
        ("b.toml", "x = 1", "its 'format' must be"),
        ("b.json", "[1]", "its 'format' must be"),
        ("c.toml", HEAD + 'law = "spline-3:0,x"', "numbers behind the colon"),
        ("d.toml", HEAD + 'law = "hexagonal"', "unknown force law 'hexagonal'"),
        (
            "e.toml",
            HEAD + 'law = "six-parameter"\ncoefficients = 3',
            "coefficients = 3: give a table",
        ),
        ("f.toml", HEAD + PLANE.replace("0.0", "'x'"), "coefficients.h0 = 'x' is not a number"),
        ("g.toml", HEAD + "pressure_range = [0, 1, 2]\n" + PLANE, "give \\(low, high\\)"),
        ("h.yaml", "", "ends in .toml or .json"),
    ],
)
def test_a_file_that_is_no_muscle_is_refused(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    refused(words, load_muscle, tmp_path / name)


def test_what_is_no_muscle_or_no_name_is_refused(tmp_path):
    refused("muscle is an int", save_muscle, 3, tmp_path / "m.toml")
    refused("path is an int", load_muscle, 3)


def test_summary_tells_law_size_range_and_source():
    text = summary("DMSP-20-300-wall")
    for part in (
        "thick-wall",
        "300 mm",
        "20 mm",
        "0 .. 6.75 bar",
        "to 26 %",
        "published",
        "Martens",
    ):
        assert part in text
    assert "rest length not known" in summary("DMSP-10")
