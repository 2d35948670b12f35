"""Every file that a command writes, given to every command that takes one.

Each pair either works, or is refused in one sentence that says what the file is and who takes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_tools import run

import pam_ocp as pam

pytestmark = pytest.mark.slow

PROBLEM = """
minimise = "time"
method = { intervals = 6, degree = 3 }

[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar", max_rate = "40 bar/s" }

[[stops]]
x = "-15 mm"
[[stops]]
x = "15 mm"
"""
HANGING = '[plant]\narrangement = "HangingLoad"\nmuscle = "DMSP-20-400N"\nmass = 10.0\n'
COMMANDS = ["--rest", "muscle1.command=3 bar", "--rest", "muscle2.command=2 bar"]
COMMANDS += ["--input", "muscle1.command=4 bar", "--input", "muscle2.command=2 bar"]
MOVED = [*COMMANDS, "--duration", "60 ms", "--samples", "21"]
LENGTHS = ["--rest-length", "DMSP-20-300=300 mm", "DMSP-10-250=250mm"]

PLANTS = {"problem.toml", "hanging.toml", "motion.npz", "plan.npz", "loop.npz", "holds.json"}
PLANTS |= {"linear.json", "plantfit.json"}
SLIDES = PLANTS - {"hanging.toml", "holds.json"}
MUSCLES = {"muscle.toml", "muscle.json", "campaign/DMSP-20-300.json", "campaign/DMSP-20-300.toml"}
PLAYED = {f"{n}.{e}" for n, e in [("motion", "csv"), ("motion", "npz"), ("motion", "parquet")]}
PLAYED |= {"motion.xlsx", "plan.npz", "plan.csv", "plan.xlsx", "loop.npz", "loop.csv"}
MOTIONS = PLAYED | {"inputs.csv"}
UNITS = {"slide.fmu"}
SHOWN = PLANTS | MUSCLES | MOTIONS | UNITS
"""Files by what they can be taken as; all others are refused there."""

READERS: dict[str, tuple[set[str], Any]] = {
    "linearize": (PLANTS, lambda f: ["linearize", f]),
    "simulate": (PLANTS, lambda f: ["simulate", f, "--duration", "5 ms"]),
    "export": (PLANTS, lambda f: ["export", f, "--platform", "native", "--out", "again.fmu"]),
    "mpc": (PLANTS, lambda f: ["mpc", f, "--duration", "20 ms"]),
    "muscle": (MUSCLES, lambda f: ["linearize", "HangingLoad", "--muscle", f]),
    "show": (MUSCLES, lambda f: ["muscles", "show", f]),
    "inputs": (MOTIONS, lambda f: ["simulate", "problem.toml", "--inputs", f]),
    "against": (PLAYED, lambda f: ["check", "slide.fmu", "--against", f]),
    "first": (MOTIONS, lambda f: ["compare", f, "long.npz"]),
    "second": (MOTIONS, lambda f: ["compare", "short.npz", f]),
    "record": (PLAYED, lambda f: ["fit-plant", "--plant", "plan.npz", f, "--free", "mass"]),
    "fitted": (PLANTS, lambda f: ["fit-plant", "--plant", f, "--variables"]),
    "report": (SHOWN, lambda f: ["report", f, "--out", "again.html"]),
    "look": (SHOWN | {"muscle.ssv", "plant.ssv", "plan.png", "report.html"}, lambda f: ["look", f]),
    "check": (UNITS, lambda f: ["check", f]),
    "fit": (set(), lambda f: ["fit", f, "--rest-length", "300 mm"]),
}
WANTING = {("against", "plan.csv"), ("against", "plan.xlsx")}
"""Tables of a solver's samples, which do not say how inputs run between: found wanting."""
OTHERS = {("against", "inputs.csv"), ("record", "inputs.csv")}
"""Taken as asked, and refused because inputs alone are nothing to compare."""
FILES = sorted(SHOWN | {"muscle.ssv", "plant.ssv", "plan.png", "report.html", "fit.xlsx"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All files, as commands write them."""
    place = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        (place / "problem.toml").write_text(PROBLEM)
        (place / "hanging.toml").write_text(HANGING)
        plant = pam.HangingLoad("DMSP-20-400N", 10.0)
        pressures = np.linspace(3e5, 5.5e5, 6)
        rows = [(p / 1e5, 1e3 * plant.equilibrium({"muscle.pressure": p})["x"]) for p in pressures]
        lines = ["muscle_pressure [bar],x [mm]", *(f"{p},{x}" for p, x in rows)]
        (place / "holds.csv").write_text("\n".join(lines))
        write_all()
    return place


def write_all() -> None:
    def ran(*words: Any) -> None:
        assert pam_ocp_main([str(w) for w in words]) == 0, words

    from pam_ocp.cli.main import main as pam_ocp_main

    ran("plan", "problem.toml", "--out", "plan.npz", "--csv", "plan.csv", "--excel", "plan.xlsx",
        "--fmu-inputs", "inputs.csv", "--plot", "plan.png")  # fmt: skip
    for ending in ("csv", "npz", "parquet", "xlsx"):
        ran("simulate", "problem.toml", *MOVED, "--out", f"motion.{ending}")
    ran("simulate", "problem.toml", *COMMANDS, "--duration", "20 ms", "--out", "short.npz")
    ran("simulate", "problem.toml", *COMMANDS, "--duration", "90 ms", "--out", "long.npz")
    ran("linearize", "problem.toml", "--out", "linear.json")
    ran("export", "problem.toml", "--platform", "native", "--out", "slide.fmu")
    for ending in ("npz", "csv"):
        ran("mpc", "problem.toml", "--duration", "60 ms", "--out", f"loop.{ending}")
    table = ["DMSP-20-300_static.csv", "--rest-length", "300 mm"]
    ran("fit", *table, "--out", "muscle.toml", "--ssv", "muscle.ssv", "--excel", "fit.xlsx")
    ran("fit", *table, "--out", "muscle.json")
    ran("campaign", Path(pam.__file__).parent / "data", *LENGTHS, "--out", "campaign")
    ran("fit-plant", "--plant", "plan.npz", "motion.csv", "--free", "mass", "--out",
        "plantfit.json", "--ssv", "plant.ssv")  # fmt: skip
    ran("fit-holds", "--plant", "hanging.toml", "holds.csv", "--estimate", "mass", "--out",
        "holds.json")  # fmt: skip
    ran("report", "plan.npz", "--out", "report.html")


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("file", FILES)
def test_a_pair_works_or_is_refused_with_what_the_file_is(
    file: str, reader: str, folder: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    works, command = READERS[reader]
    code, _, err = run(capsys, *command(file))
    if file in works:
        assert code == (1 if (reader, file) in WANTING else 0), err
        return
    assert code == (1 if (reader, file) == ("look", "fit.xlsx") else 2), err
    said = [line for line in err.splitlines() if line.startswith("pam-ocp")]
    if code == 2:
        assert Path(file).name in said[-1] or (reader, file) in OTHERS
        assert "Traceback" not in err


def test_what_is_taken_from_a_file_is_what_was_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    plant, arguments = pam.planning.load_problem("problem.toml")
    for file in sorted(SLIDES):
        found = pam.plants.load_plant(file)
        assert [v.name for v in found.variables] == [v.name for v in plant.variables]
        x, u = np.array([0.003, 0.1, 2.1e5, 1.4e5]), np.array([2.5e5, 1e5])
        here = plant.function(x, u, plant.vector("parameter"))
        there = found.function(x, u, plant.vector("parameter"))
        for one, other in zip(here, there, strict=True):
            assert np.array_equal(np.asarray(one), np.asarray(other))
    moved = pam.Trajectory.load("motion.npz")
    for file in ("motion.csv", "motion.parquet", "motion.xlsx"):
        assert moved.compare(pam.load(file), ["x", "muscle1.command"]).largest < 1e-12
    plan = pam.load("plan.npz")
    played = pam.Trajectory.load("inputs.csv")
    start = {n: plan.trajectory[n][0] for n in plan.trajectory.named("state")}
    end = pam.simulate(plan.plant, played, start=start, t=[0.0, plan.duration])
    assert end["x"][-1] == pytest.approx(arguments["stops"][-1].values["x"], abs=1e-5)
