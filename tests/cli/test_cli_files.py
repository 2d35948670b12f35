"""What a command writes, other commands read, by the file alone."""

import json

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.cli.main import main

PROBLEM = """
cyclic = true
minimise = "time"

[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"
pre_contraction = "10 %"

[[stops]]
x = "-10 mm"

[[stops]]
x = "10 mm"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A problem, its plan as every kind of motion, and the plant's FMU."""
    place = tmp_path_factory.mktemp("files")
    (place / "slide.toml").write_text(PROBLEM)
    problem = str(place / "slide.toml")
    outs = [("--out", "plan.npz"), ("--csv", "plan.csv")]
    said = [text for option, name in outs for text in (option, str(place / name))]
    assert main(["plan", problem, *said, "--quiet"]) == 0
    replayed = ["simulate", problem, "--inputs", str(place / "plan.npz"), "--quiet"]
    for ending in ("npz", "csv", "parquet"):
        assert main([*replayed, "--out", str(place / f"motion.{ending}")]) == 0
    fmu = ["export", problem, "--platform", "native", "--out", str(place / "slide.fmu")]
    assert main([*fmu, "--quiet"]) == 0
    return place


MOTIONS = ("plan.npz", "plan.csv", "motion.npz", "motion.csv", "motion.parquet")
READERS = {
    "simulate": ("simulate", "slide.toml", "--inputs", "{}", "--out", "again.npz"),
    "check": ("check", "slide.fmu", "--against", "{}"),
    "compare with a plan": ("compare", "plan.npz", "{}", "--tolerance", "0.01"),
    "compare a plan": ("compare", "{}", "plan.npz", "--tolerance", "0.01"),
    "report": ("report", "{}", "--out", "report.html"),
    "look": ("look", "{}", "--kind", "record"),
}


@pytest.mark.parametrize("file", MOTIONS)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_takes_every_motion(folder, capsys, monkeypatch, reader, file):
    monkeypatch.chdir(folder)
    code = main([text.format(file) for text in READERS[reader]])
    assert code == 0, capsys.readouterr().err


def test_a_plan_in_a_file_is_replayed_to_its_stops(folder, capsys):
    names = [str(folder / n) for n in ("slide.toml", "plan.npz")]
    assert main(["simulate", names[0], "--inputs", names[1], "--json"]) == 0
    last = json.loads(capsys.readouterr().out)
    assert last["x"] == pytest.approx(-0.010, abs=2e-5)
    motion = pam.Trajectory.load(folder / "plan.npz")
    assert np.max(motion["x"]) == pytest.approx(0.010, abs=1e-5)
    assert motion.variable("x").unit == "m"


def test_a_plan_with_its_motion_is_still_a_plan(folder):
    muscle = pam.muscle("DMSP-20-200N")
    slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
    assert pam.load_plan(folder / "plan.npz", slide).verified


def test_an_objective_by_the_word_of_the_field_is_told_by_its_name(folder, capsys):
    file = folder / "energy.toml"
    file.write_text(PROBLEM.replace('"time"', '"energy"'))
    assert main(["plan", str(file)]) == 2
    assert "unknown objective 'energy': did you mean 'work'?" in capsys.readouterr().err
