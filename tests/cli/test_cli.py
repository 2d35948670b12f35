"""The command line as a user meets it, and the tour."""

import json
import subprocess
import sys

import numpy as np
import pytest
from cli_tools import run

import pam_ocp as pam
from pam_ocp.cli.main import main

TABLE = "DMSP-10-250_static.csv"


def test_help_says_where_to_start(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    assert "pam-ocp tour" in capsys.readouterr().out
    assert run(capsys)[0] == 2


def test_fit_prints_a_report_and_writes_the_muscle(capsys, tmp_path):
    file, plot = tmp_path / "muscle.json", tmp_path / "fit.png"
    given = f"fit {TABLE} --rest-length 0.25 --diameter 0.01"
    code, out, _ = run(capsys, given, "--out", file, "--plot", plot)
    assert code == 0
    assert "RMSE 1.10" in out
    muscle = pam.load_muscle(file)
    assert muscle.rest_length == 0.25
    assert muscle.force(3e5, 0.1) == pytest.approx(
        pam.muscle("DMSP-10-250").force(3e5, 0.1), rel=1e-4
    )
    assert plot.stat().st_size > 20_000


def test_a_saved_fit_goes_into_a_report(capsys, tmp_path):
    file, page = tmp_path / "fit.json", tmp_path / "fit.html"
    code, _, err = run(capsys, "fit", TABLE, "--rest-length", 0.25, "--save", file)
    assert (code, err) == (0, "")
    saved = pam.load(file)
    assert run(capsys, "report", file, "--out", page)[0] == 0
    low, high = saved.interval("a3")
    assert low < saved.law.values["a3"] < high
    assert f"{low:.4g} .. {high:.4g}" in page.read_text("utf-8")


def test_a_fitted_muscle_goes_into_an_fmu(capsys, tmp_path):
    muscle, fmu = tmp_path / "muscle.toml", tmp_path / "load.fmu"
    run(capsys, "fit", TABLE, "--rest-length", 0.25, "--out", muscle)
    given = "export hanging_load --set mass=5 --platform native"
    code, out, err = run(capsys, given, "--muscle", muscle, "--out", fmu)
    assert (code, err) == (0, "")
    assert str(fmu) in out
    from fmpy import read_model_description

    start = {v.name: v.start for v in read_model_description(str(fmu)).modelVariables}
    assert float(start["mass"]) == 5.0
    assert float(start["muscle.a3"]) == pytest.approx(-42.455, abs=0.01)
    code, out, _ = run(capsys, "check", fmu)
    assert code == 0
    assert "all well" in out


def test_a_law_may_be_named_by_its_form(capsys, tmp_path):
    file = tmp_path / "muscle.toml"
    law = "spline-2:0,0.12,0.25"
    code, _, err = run(capsys, "fit", TABLE, "--law", law, "--rest-length", 0.25, "--out", file)
    assert (code, err) == (0, "")
    assert pam.load_muscle(file).law.name == "spline-2:0.0,0.12,0.25"
    code, out, _ = run(capsys, "muscles", "show", file)
    assert code == 0
    assert "B-splines of degree 2 in 2 pieces" in out


def test_check_tells_by_its_exit_code(capsys, tmp_path):
    plant = pam.HangingLoad(pam.muscle("DMSP-20-400N"), 20.0)
    fmu = pam.export_fmu(plant, tmp_path / "load.fmu", platforms="native")
    command = {"muscle.command": np.linspace(2e5, 4e5, 21)}
    motion = pam.simulate(plant, command, t=np.linspace(0, 0.2, 21))
    good = motion.save(tmp_path / "good.npz")
    motion["x"][:] += 1e-4
    bad = motion.save(tmp_path / "bad.npz")
    assert run(capsys, "check", fmu, "--against", good)[0] == 0
    code, out, _ = run(capsys, "check", fmu, "--against", bad)
    assert code == 1
    assert "x deviates" in out


def test_export_takes_a_plant_from_a_users_file(capsys, tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "import pam_ocp as pam\n"
        "plant = pam.Plant('mine')\n"
        "x = plant.state('x', start=1.0)\n"
        "plant.der(x, -x)\n"
    )
    given = f"{file}:plant", "--out", tmp_path / "m.fmu"
    code, _, err = run(capsys, "export --platform native --fmi 3", *given)
    assert (code, err) == (0, "")
    assert pam.check_fmu(tmp_path / "m.fmu").ok


def test_a_misspelt_command_is_told_which_was_meant(capsys):
    with pytest.raises(SystemExit) as ended:
        run(capsys, "tur")
    assert ended.value.code == 2
    assert capsys.readouterr().err.rstrip().endswith("did you mean tour?")


def test_muscles_lists_the_catalogue(capsys):
    code, out, _ = run(capsys, "muscles")
    assert code == 0
    assert all(name in out for name in pam.muscles.muscle_names())
    assert "14-27 %" in out


def test_one_muscle_is_shown_with_its_forces(capsys, tmp_path):
    plot = tmp_path / "muscle.png"
    code, out, _ = run(capsys, "muscles show DMSP-20-400N", "--plot", plot)
    assert code == 0
    assert "1804.6" in out  # F(0) at 6 bar of the published set
    assert "27.9 %" in out
    assert plot.stat().st_size > 20_000


def test_what_is_slow_to_load_is_not_loaded_for_a_fit_and_poles():
    """Each costs a third of a second and more, and the tour needs none of them."""
    program = (
        "import sys, pam_ocp as pam\n"
        "from pam_ocp.operating.linear import linear_model, modes\n"
        "fit = pam.fit_force(pam.read_table('DMSP-20-300_static.csv', rest_length=0.300))\n"
        "assert 'profile likelihood' in fit.report()\n"
        "plant = pam.HangingLoad(fit.muscle(rest_length=0.300, diameter=0.020), 20.0)\n"
        "assert modes(linear_model(plant, plant.equilibrium(x=0.03)))\n"
        "import pam_ocp.planning.planner\n"
        "print(*({'control', 'matplotlib', 'pandas'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, []), done.stderr


@pytest.mark.slow
def test_the_tour_leaves_its_figures_fmus_and_summary(capsys, tmp_path):
    code, out, _ = run(capsys, "tour", "--out", tmp_path / "tour")
    assert code == 0
    assert "[6/6]" in out
    written = {p.name for p in (tmp_path / "tour").iterdir()}
    pictures = {f"{name}.png" for name in ("bode", "fit", "fmu", "motion")}
    files = {"muscle.json", "plan.csv", "slide_fmi2.fmu", "slide_fmi3.fmu"}
    assert written == {*pictures, *files, "summary.json", "summary.md"}
    summary = json.loads((tmp_path / "tour" / "summary.json").read_text())
    assert summary["fit"]["rmse_N"] == pytest.approx(6.2, abs=0.05)
    assert summary["plan"]["replay_error_of_nominal"] < 1e-6
    for version in ("2.0", "3.0"):
        check = summary["fmu"][version]
        assert check["findings"] == []
        assert set(check["largest"]) == {"CoSimulation", "ModelExchange"}
        assert max(check["largest"].values()) < 1e-6
        assert len(check["platforms"]) == 5
