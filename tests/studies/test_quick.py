"""One page from one file: the files of each step, what is assumed, doubted, and cannot be done."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.core.errors import InputError
from pam_ocp.studies import quick

TABLE, LENGTH = "DMSP-20-300_static.csv", 0.3


@pytest.fixture(scope="module")
def made(tmp_path_factory: Any) -> Any:
    return quick(TABLE, tmp_path_factory.mktemp("quick") / "out", rest_length="300 mm")


def test_every_step_leaves_what_others_read(made: Any) -> None:
    assert set(made.files) == {"muscle", "plan", "fmu", "workbook", "page"}
    muscle = pam.load_muscle(made.files["muscle"])
    assert muscle.force(3e5, 0.1) == pytest.approx(float(made.fit.law.tension(3e5, 0.1)), rel=1e-6)
    assert pam.load_plan(made.files["plan"], made.plant).verified
    with zipfile.ZipFile(made.files["fmu"]) as unit:
        assert "modelDescription.xml" in unit.namelist()
    page = made.files["page"].read_text()
    for said in made.assumptions.values():
        assert said.split(" (")[0].replace("'", "&#x27;") in page
    for heading in ("The laws", "The law", "The plant", "The motion", "The table"):
        assert f">{heading}</h2>" in page


def test_the_motion_is_that_of_its_inputs(made: Any) -> None:
    """By SciPy, from the plan's start under the plan's inputs."""
    plant, motion = made.plant, made.plan.motion
    p, x = plant.vector("parameter"), motion.start
    inputs = motion.inputs
    for k, (begin, end) in enumerate(zip(inputs.breaks[:-1], inputs.breaks[1:], strict=True)):

        def rates(t: float, x: Any, k: int = k, begin: float = begin) -> Any:
            powers = (t - begin) ** np.arange(inputs.coefficients.shape[1])
            u = powers @ inputs.coefficients[k]
            return np.asarray(plant.function(x, u, p)[0], float).ravel()

        x = solve_ivp(rates, (begin, end), x, "Radau", rtol=1e-9, atol=1e-9).y[:, -1]
    assert x[0] == pytest.approx(made.plan.trajectory["x"][-1], abs=1e-5)
    assert abs(x[1]) < 1e-3


def test_the_linearised_plant_swings_as_its_stiffness_says(made: Any) -> None:
    """x'' = -K/m x - c/m x' with constant pressures: one pair of poles; two lags of 0.05 s."""
    rest = made.plant.equilibrium({"x": 0.0, "muscle1.pressure": 6.75e5 / 2})
    mass, damping = (made.plant.variable(n).start for n in ("mass", "damping"))
    poles = np.roots([mass, damping, rest["stiffness"]])
    found = made.linear.poles()
    for wanted in (*poles, -20.0):
        assert np.abs(found - wanted).min() < 1e-3 * abs(wanted)


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_a_load_in_place_of_a_second_muscle_and_what_the_user_says(tmp_path: Path) -> None:
    options: Any = {"law": "six-parameter", "counterforce": "load", "mass": "20 kg"}
    made = quick(TABLE, tmp_path, rest_length=LENGTH, stops=["10 mm", "30 mm"], **options)
    assert made.fit.law.name == "six-parameter"
    assert made.comparison is None
    assert made.plant.variable("mass").start == 20.0
    assert "mass" not in made.assumptions
    assert made.plan.trajectory["x"][[0, -1]] == pytest.approx([0.01, 0.03], abs=1e-5)


@pytest.mark.usefixtures("plain_pictures")
def test_what_is_wrong_and_what_cannot_be_done_is_in_doubt_and_the_rest_goes_on(
    tmp_path: Path,
) -> None:
    """Stops outside the stroke, a cell of twice its force, and the zero of the load cell."""
    table = pam.read_table(TABLE, rest_length=LENGTH)
    force = np.where(table.slack, 0.0, table.force) - 40.0
    force[np.argmax(force)] *= 2.0
    columns = {"pressure": table.pressure, "contraction": table.contraction, "force": force}
    options: Any = {"law": "six-parameter", "stops": [-0.5, 0.5]}
    made = quick(columns, tmp_path, rest_length=LENGTH, **options)
    assert made.plan is None
    assert any(said.startswith("motion") and "outside the stroke" in said for said in made.doubts)
    assert set(made.files) == {"muscle", "fmu", "workbook", "page"}
    assert "In doubt" in made.files["page"].read_text()
    assert any("stand apart from the law" in said for said in made.doubts)
    assert any("zero of the load cell" in said for said in made.doubts)


@pytest.mark.usefixtures("plain_pictures")
def test_wrong_cells_are_told_where_the_law_is_not_quite_right(tmp_path: Path) -> None:
    """Polynomials miss this muscle's forces by up to a tenth: many cells lie beyond six standard
    deviations by the median, two of them by the fault.
    """
    muscle = pam.muscle("Festo-three-element", rest_length=0.3)
    levels = np.linspace(1.5e5, 5.5e5, 7), np.linspace(0.0, 0.24, 10)
    p, k = (each.ravel() for each in np.meshgrid(*levels))
    force = np.array([max(float(muscle.force(*at)), 0.0) for at in zip(p, k, strict=True)])
    wrong = np.flatnonzero(force > 0.4 * force.max())[[1, 7]]
    force[wrong] *= 2.5
    columns = {"pressure": p, "contraction": k, "force": force}
    made = quick(columns, tmp_path, rest_length=0.3, law="polynomial-1-3", stops=[-0.5, 0.5])
    (said,) = (doubt for doubt in made.doubts if "stand apart from the law" in doubt)
    assert "2 cell(s)" in said
    assert all(f"{p[i] / 1e5:.3g} bar, {100 * k[i]:.3g} %" in said for i in wrong)


def test_a_table_of_two_cells_is_refused_by_their_number(tmp_path: Path) -> None:
    columns = {"pressure": [1e5, 2e5], "contraction": [0.0, 0.05], "force": [100.0, 200.0]}
    with pytest.raises(pam.FitError, match="the table has 2 taut cells, fewer than"):
        quick(columns, tmp_path, rest_length=LENGTH)


def test_nothing_is_replaced_unasked_and_wrong_words_are_refused(tmp_path: Path) -> None:
    (tmp_path / "plant.fmu").write_text("mine")
    refused(r"plant\.fmu stand there.*overwrite=True", quick, TABLE, tmp_path, rest_length=LENGTH)
    with pytest.raises(InputError, match="counterforce = 'rope': choose 'pair' or 'load'"):
        quick(TABLE, tmp_path / "new", rest_length=LENGTH, counterforce="rope")  # type: ignore[arg-type]
    assert (tmp_path / "plant.fmu").read_text() == "mine"
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("plain_pictures")
@pytest.mark.slow
def test_the_command_says_what_it_assumed(tmp_path: Path, capsys: Any) -> None:
    given = [
        TABLE,
        "--rest-length",
        "300mm",
        "--law",
        "six-parameter",
        "--out",
        f"{tmp_path / 'o'}",
    ]
    assert main(["quick", *given, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["law"] == "six-parameter"
    assert told["verified"]
    assert {Path(f).name for f in told["files"].values()} >= {"report.html", "plant.fmu"}
    assert main(["quick", *given]) == 2
    assert "--force" in capsys.readouterr().err
