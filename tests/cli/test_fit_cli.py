"""The commands that fit, as a user meets them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_tools import run

import pam_ocp as pam
from pam_ocp.fitting.dynamic.plant_fit import load_plant_fit
from pam_ocp.plants.plant_file import plant_of

STUDY = """
records = ["run0.csv"]
validate = ["run1.csv"]
free = ["damping", "muscle*.lag"]
interpolation = "previous"
set = { damping = "15 N.s/m" }

[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
mass = "2 kg"
pre_contraction = "10 %"
feed = { kind = "Regulator", lag = "40 ms", max_pressure = "6 bar" }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two records of a slide with damping 20 N s/m and lag 50 ms, and a study file."""
    path = tmp_path_factory.mktemp("study")
    (path / "study.toml").write_text(STUDY)
    feed = pam.feeds.Regulator(0.05, max_pressure=6e5)
    plant = pam.AntagonisticSlide("DMSP-20-200N", 2.0, 0.1, feed=feed)
    for seed in range(2):
        random = np.random.default_rng(seed)
        t = np.arange(0, 1.005, 0.01)
        levels = random.uniform(2.2, 4.5, (2, 5))[:, np.minimum((t / 0.25 + 1e-9).astype(int), 4)]
        commands = {f"muscle{i + 1}.command": (t, 1e5 * levels[i]) for i in (0, 1)}
        even = {"muscle1.pressure": 3e5, "muscle2.pressure": 3e5}
        motion = pam.simulate(plant, commands, t=t, start=even)
        x = 1e3 * motion["x"] + 0.02 * random.standard_normal(t.size)
        table = np.column_stack([t, *levels, x])
        head = "time [s],muscle1_command [bar],muscle2_command [bar],x [mm]"
        np.savetxt(path / f"run{seed}.csv", table, delimiter=",", header=head, comments="")
    return path


def interval(report: str, name: str) -> tuple[float, float]:
    """``low .. high`` of a parameter's line."""
    line = next(row for row in report.splitlines() if row.strip().startswith(f"{name}:"))
    low, high = line.rsplit(",", 1)[1].split("..")
    return float(low), float(high)


@pytest.mark.slow
def test_a_study_file_gives_report_validation_plots_and_a_file(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    out, plot = tmp_path / "fit.json", tmp_path / "fit.png"
    study = folder / "study.toml"
    code, text, _ = run(capsys, "fit-plant --plant", study, "--out", out, "--plot", plot)
    assert code == 0
    low, high = interval(text, "damping")
    assert low - 0.3 <= 20.0 <= high + 0.3
    low, high = interval(text, "muscle*.lag")
    assert low - 2e-4 <= 0.05 <= high + 2e-4
    assert "[[Validation]] record 1, only its initial state estimated" in text
    fit_percent = float(text.split("[[Validation]]")[1].split("fit")[1].split("%")[0])
    assert fit_percent > 99
    assert plot.stat().st_size > 20_000
    assert (tmp_path / "fit-validate.png").stat().st_size > 20_000
    plant = plant_of({"arrangement": "AntagonisticSlide", "muscle": "DMSP-20-200N"})
    found = load_plant_fit(out, plant).interval("muscle*.lag")
    assert found == pytest.approx((low, high), rel=1e-3)


def test_the_command_line_comes_before_the_file(folder: Path, capsys: Any) -> None:
    given = "--free damping --set muscle1.lag=50ms --set muscle2.lag=0.05 --noise x=0.02mm"
    files = folder / "run1.csv", "--plant", folder / "study.toml", "--validate", folder / "run0.csv"
    code, text, _ = run(capsys, "fit-plant", *files, *given.split())
    assert code == 0
    assert "muscle*.lag:" not in text
    assert "1 with 101 samples of x" in text


def test_the_variables_are_listed(folder: Path, capsys: Any) -> None:
    code, text, _ = run(capsys, "fit-plant", "--plant", folder / "study.toml", "--variables")
    assert code == 0
    for words in ("muscle1.command", "muscle2.pressure", "damping", "15 N.s/m"):
        assert words in text


def test_a_plant_of_the_library_needs_no_file(folder: Path, capsys: Any) -> None:
    given = "fit-plant --plant hanging_load --muscle DMSP-20-400N --variables"
    code, text, _ = run(capsys, given)
    assert code == 0
    assert text.startswith("hanging_load")


def test_records_that_do_not_allow_the_fit_end_with_1(folder: Path, capsys: Any) -> None:
    code, _, words = run(capsys, "fit-plant --free muscle*.a6 --plant", folder / "study.toml")
    assert code == 1
    assert "muscle*.a6: no influence on x" in words


def test_what_cannot_be_meant_ends_with_2_and_a_reason(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    study = folder / "study.toml"

    def refused(*arguments: Any) -> str:
        code, _, words = run(capsys, "fit-plant", *arguments)
        assert code == 2
        assert words.startswith("pam-ocp fit-plant: ")
        return words

    assert "did you mean 'damping'" in refused("--plant", study, "--free", "dampin")
    assert "give NAME=VALUE" in refused("--plant", study, "--set", "mass")
    assert "no record: give files" in refused("--plant", "hanging_load", "--free", "mass")
    assert "--free is missing" in refused(folder / "run0.csv", "--plant", "antagonistic_slide")
    assert "3 values" in refused("--plant", study, "--delay", "0", "1", "2")
    assert "unknown" in refused("--plant", "hanging_lode", "--variables")
    assert "run9.csv" in refused(folder / "run9.csv", "--plant", study)
    other = tmp_path / "other.toml"
    other.write_text('fre = ["damping"]\n' + STUDY)
    assert "did you mean 'free'" in refused("--plant", other)
    other.write_text('free = ["damping"]\n')
    assert "describes no plant" in refused("--plant", other)
    back = tmp_path / "back.csv"
    lines = (folder / "run0.csv").read_text().splitlines()
    back.write_text("\n".join([*lines[:20], *lines[5:9], *lines[20:]]))
    assert "time runs backwards in row 20" in refused(back, "--plant", study)


def test_what_was_left_out_of_a_file_is_said_in_a_line(tmp_path: Any) -> None:
    rows = [f"{k},{p},{1e-3 * p * (0.25 - k)}" for k in (0.0, 0.1, 0.2) for p in (1e5, 3e5, 5e5)]
    table = tmp_path / "table.csv"
    table.write_text("\n".join(["contraction,pressure_Pa,force_N", *rows, "0.05,,20"]))
    command = [sys.executable, "-m", "pam_ocp", "fit", str(table), "--law", "polynomial-1-1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stderr.startswith("pam-ocp: table.csv: 1 of 10 rows"), done
    assert "UserWarning" not in done.stderr
    assert ".py" not in done.stderr


def test_a_robust_fit_of_a_table(capsys: Any) -> None:
    given = "fit DMSP-10-250_static.csv --rest-length 0.25 --loss"
    code, text, _ = run(capsys, given, "bisquare")
    assert code == 0
    assert "a6: " in text
    code, _, words = run(capsys, given, "cubes")
    assert code == 2
    assert "'squares', 'huber', 'l1' or 'bisquare'" in words
