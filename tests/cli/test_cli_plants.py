"""The commands that simulate, compare and linearise, and what all commands share."""

import json
import subprocess
import sys

import numpy as np
import pytest
from cli_tools import run
from scipy.integrate import solve_ivp

import pam_ocp as pam


def test_a_simulation_on_the_command_line_is_that_of_scipy(capsys, tmp_path):
    out = tmp_path / "motion.npz"
    given = "simulate HangingLoad --set 'mass=12 kg' --input 'muscle.command=3 bar'"
    given += " --rest 'x=15 mm' --duration '200 ms' --json"
    code, text, _ = run(capsys, given, "--out", out)
    assert code == 0
    last = json.loads(text.partition("\n")[0])
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=12.0)
    start = plant.equilibrium(x=0.015)
    p = plant.vector("parameter")
    field = lambda t, x: np.asarray(plant.function(x, [3e5], p)[0]).ravel()  # noqa: E731
    found = solve_ivp(field, (0, 0.2), start.x, method="Radau", rtol=1e-9, atol=1e-12)
    assert last["x"] == pytest.approx(found.y[0, -1], abs=1e-8)
    assert pam.Trajectory.load(out)["x"][-1] == last["x"]


def test_two_trajectories_are_compared_and_the_exit_code_judges(capsys, tmp_path):
    t = np.linspace(0, 1, 11)
    x = [pam.Variable("x", "output", unit="m", nominal=0.1)]
    for name, shift in (("a", 0.0), ("b", 2e-3)):
        pam.Trajectory(t, {"x": t + shift}, x).save(tmp_path / f"{name}.npz")
    pair = tmp_path / "a.npz", tmp_path / "b.npz"
    assert run(capsys, "compare", *pair)[0] == 0
    code, text, _ = run(capsys, "compare --tolerance 0.01 --json", *pair)
    assert code == 1
    assert json.loads(text.partition("\n")[0])["largest"] == pytest.approx(0.02)
    assert run(capsys, "compare --tolerance 0.03", *pair)[0] == 0


def test_a_linear_system_is_written_in_display_units_with_the_poles_of_its_matrix(capsys, tmp_path):
    out = tmp_path / "linear.json"
    code, text, _ = run(capsys, "linearize HangingLoad --rest 'x=20 mm' --json --out", out)
    assert code == 0
    found, told = json.loads(out.read_text()), json.loads(text)
    assert (told["units"]["x"], told["units"]["muscle_pressure"]) == ("m", "Pa")
    size = {"mm": 1e-3, "m/s": 1.0, "bar": 1e5}
    sizes = np.array([size[found["units"][n]] for n in found["states"]])
    assert np.allclose(np.array(told["A"]), found["A"] * sizes[:, None] / sizes, rtol=1e-12)
    assert found["units"]["x"] == "mm"
    assert found["units"]["muscle_pressure"] == "bar"
    poles = sorted(np.linalg.eigvals(np.array(found["A"])), key=lambda s: (-s.real, s.imag))
    wanted = sorted((complex(*p) for p in found["poles"]), key=lambda s: (-s.real, s.imag))
    assert np.allclose(poles, wanted, rtol=1e-6)


def test_loads_take_units(capsys):
    tables = []
    for masses, pressures in (
        (("5", "10"), ("2", "3")),
        (("5000 g", "10 kg"), ("2 bar", "300 kPa")),
    ):
        code, text, _ = run(capsys, "loads", "--masses", *masses, "--pressures", *pressures)
        assert code == 0
        tables.append(text)
    assert tables[0] == tables[1]


def test_the_module_runs_as_the_command_and_knows_its_version():
    command = [sys.executable, "-m", "pam_ocp", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"pam-ocp {pam.__version__}\n"


def test_lengths_take_units(capsys, tmp_path):
    written = []
    for length, diameter in (("0.3", "0.02"), ("300 mm", "2 cm")):
        out = tmp_path / f"{len(written)}.json"
        sizes = ("--rest-length", length, "--diameter", diameter, "--name", "mine")
        assert run(capsys, "fit", "DMSP-20-300_static.csv", *sizes, "--out", out)[0] == 0
        written.append(out.read_text())
    assert written[0] == written[1]
