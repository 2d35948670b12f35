"""The command mpc: problem files, options, errors; the run itself against the plant and its FMU."""

import re

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.cli.main import main

PROBLEM = """
duration = "1 s"
real = { mass = "2600 g" }

[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"

[reference]
x = { stops = ["6 mm", -0.006], dwell = "300 ms", rest = 0.0, rest_from = 0.6 }
stiffness = 2e4

[controller]
horizon = 30

[estimator]
kind = "moving-horizon"
unknown = { mass = [0.5, 0.05] }
"""


def number(text: str, pattern: str) -> float:
    found = re.search(pattern + r"\s*([-+.\de]+)", text)
    assert found, text
    return float(found[1])


@pytest.mark.slow
def test_a_problem_file_is_run_and_reported(tmp_path, capsys):
    problem, motion, picture = (tmp_path / n for n in ("p.toml", "motion.csv", "run.png"))
    problem.write_text(PROBLEM)
    assert main(["mpc", str(problem), "--out", str(motion), "--plot", str(picture)]) == 0
    told = capsys.readouterr().out
    assert number(told, "steady error of x:") < 0.2  # mm
    assert number(told, "found: mass =") == pytest.approx(2.6, abs=0.15)
    assert "median" in told
    assert "worst" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    run = pam.Trajectory.load(motion)
    assert run.t[-1] == pytest.approx(1.0)
    assert np.abs(run["x"][run.t > 0.9]).max() < 2e-4


def test_options_go_over_the_file(tmp_path, capsys):
    problem = tmp_path / "p.toml"
    problem.write_text(PROBLEM)
    options = "--duration 0.05 --estimator none --real mass=2.2 --set mass=2.2"
    assert main(["mpc", str(problem), *options.split()]) == 0
    told = capsys.readouterr().out
    assert "mass = 2.2" in told
    assert ", 0.05 s" in told
    assert "found" not in told


def test_without_a_file_the_default_plant_is_run(capsys):
    assert main(["mpc", "--duration", "0.02"]) == 0
    assert "antagonistic_slide against plant" in capsys.readouterr().out


@pytest.mark.slow
def test_against_the_fmu_the_run_is_that_against_the_plant(tmp_path, capsys):
    runs = []
    for side in ("plant", "fmu"):
        motion = tmp_path / f"{side}.npz"
        assert main(["mpc", "--duration", "0.5", "--against", side, "--out", str(motion)]) == 0
        runs.append(pam.Trajectory.load(motion))
    assert np.abs(runs[0]["x"] - runs[1]["x"]).max() < 1e-5


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("horizon = 3", "unknown key"),
        ("controller = 3", "give a table"),
        ("duration = '1 kg'", "measures something else"),
        ("[plant]\nmuscle = 'DMSP-20-200N'", "arrangement"),
        ("[controller]\nhorizont = 3", "did you mean 'horizon'"),
        ("[estimator]\nkind = 'magic'", "estimator.kind"),
        ("[estimator]\nhorizon = 3", "horizon"),
        ("[reference]\nx = { dwell = 1.0 }", "give stops"),
        ("[reference]\nx = { stop = [1.0] }", "did you mean 'stops'"),
        ("[disturbances]\n'muscle1.command' = [1.0, 2.0, 3.0]", "from when on"),
        ("[disturbances]\npush = 1.0", "unknown variable"),
        ("against = 'thing'", "give plant, fmu"),
        ("against = 'none.fmu'", "would run the machine code of that FMU"),
        ("[set", "cannot be read as a TOML file"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_words(tmp_path, capsys, content, words):
    problem = tmp_path / "p.toml"
    problem.write_text(content)
    assert main(["mpc", str(problem)]) == 2
    assert words in capsys.readouterr().err
