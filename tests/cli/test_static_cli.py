"""The commands of static measurements say and write what the calls do."""

import json
import re

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.cli.main import main

LAW = pam.muscle("DMSP-20-300").law
PRESSURE, KAPPA = (
    a.ravel() for a in np.meshgrid(np.linspace(0.5e5, 6e5, 8), np.linspace(0, 0.2, 5))
)


@pytest.fixture
def table(tmp_path):
    """Headers that say little, pressure in kPa, both branches."""
    random, rows = np.random.default_rng(4), []
    for branch, offset in (("up", -4.0), ("down", 4.0)):
        force = np.maximum(LAW.tension(PRESSURE, KAPPA) + offset + random.normal(0, 1, 40), 0)
        rows += [
            f"{300 * (1 - k):.3f},{p / 1e3:.3f},{f:.3f},{branch}\n"
            for k, p, f in zip(KAPPA, PRESSURE, force, strict=True)
        ]
    path = tmp_path / "DMSP-20-300.csv"
    path.write_text("length [mm],P1,F [N],branch\n" + "".join(rows), "utf-8")
    return path


READ = ["--rest-length", "0.3", "--columns", "pressure=P1", "--units", "pressure=kPa"]


def test_fit_takes_columns_units_and_held_coefficients(table, capsys):
    assert main(["fit", str(table), *READ, "--fixed", "a6=-300", "--branches"]) == 0
    shown = capsys.readouterr().out
    assert "a6: -300 N (held)" in shown
    assert "[[Branch deflation]]" in shown
    assert float(re.search(r"less inflation ([\d.]+)", shown)[1]) == pytest.approx(8.0, abs=1.0)
    assert main(["fit", str(table), *READ, "--branches", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said["branches"]) == {"inflation", "deflation"}
    assert said["hysteresis"]["mean"] == pytest.approx(8.0, abs=1.0)


def test_fit_takes_the_names_of_columns_of_a_file_without_headers(table, tmp_path, capsys):
    bare = tmp_path / "bare.csv"
    rows = table.read_text("utf-8").splitlines()[1:41]
    bare.write_text("".join(f"{row.rsplit(',', 1)[0]}\n" for row in rows), "utf-8")
    names = ["length [mm]", "pressure [kPa]", "force [N]"]
    assert main(["fit", str(bare), "--rest-length", "0.3", "--columns", *names]) == 0
    assert "taut cells of 40" in capsys.readouterr().out


def test_fit_ranks_several_laws_and_takes_the_best(table, capsys):
    laws = ["--law", "five-parameter", "--law", "six-parameter"]
    assert main(["fit", str(table), *READ, *laws]) == 0
    shown = capsys.readouterr().out
    assert shown.index("six-parameter ") < shown.index("five-parameter ")
    assert "Six-parameter law" in shown


def test_a_campaign_is_printed_and_written(table, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--columns", "pressure=P1", "--units", "pressure=kPa", "--out", str(out)]
    options += ["--delimiter", ",", "--bad-lines", "drop"]
    assert main(["campaign", str(table.parent), *options]) == 0
    assert "rest length 300 mm" in capsys.readouterr().out
    assert (out / "DMSP-20-300.toml").exists()


def test_holds_are_fitted_from_a_file(tmp_path, capsys):
    at_0, at_1 = (np.asarray(LAW.tension(p, np.linspace(0.02, 0.18, 20))) for p in (0.0, 1e5))
    x = 0.3 * np.linspace(0.02, 0.18, 20)
    p = 1e5 * (150.0 + 5e3 * x - at_0) / (at_1 - at_0)
    path = tmp_path / "holds.csv"
    rows = "".join(f"{a / 1e5:.9f},{1e3 * b:.9f}\n" for a, b in zip(p, x, strict=True))
    path.write_text("muscle_pressure [bar],x [mm]\n" + rows, "utf-8")
    command = ["fit-holds", str(path), "--plant", "SpringOverMuscle", "--estimate"]
    names = ["spring_stiffness", "preload"]
    assert main([*command, *names, "--out", str(tmp_path / "f.json")]) == 0
    assert "20 equilibria" in capsys.readouterr().out
    found = json.loads((tmp_path / "f.json").read_text("utf-8"))["estimates"]
    assert found["preload"]["value"] == pytest.approx(150.0, rel=1e-5)


def test_fit_and_look_say_what_slack_cells_read(tmp_path, capsys):
    force = LAW.tension(PRESSURE, KAPPA)
    random = np.random.default_rng(7)
    shown = np.maximum(force, 0) + 6 + random.normal(0, 1, force.size)
    path = tmp_path / "rig.csv"
    rows = zip(KAPPA, PRESSURE, shown, strict=True)
    text = "".join(f"{k:.4f},{p:.0f},{f:.3f}\n" for k, p, f in rows)
    path.write_text("kappa [1],p [Pa],F [N]\n" + text, "utf-8")
    slack = int(np.sum(force < -5))
    for command in ("look", "fit"):
        assert main([command, str(path)]) == 0
        words = capsys.readouterr().out
        count = int(re.search(r"(\d+) cells read [\d.]+ ± [\d.]+ N where the muscle", words)[1])
        assert slack <= count <= slack + 3
        assert "--floor zero" in words
        assert "floor=" not in words
    assert main(["fit", str(path), "--floor", "zero", "--json"]) == 0
    mended = json.loads(capsys.readouterr().out)
    assert mended["cells"] == len(force) - count
    assert mended["rmse"] < 2.0
    assert main(["fit", str(path), "--floor", "none", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cells"] == len(force)
