"""A fit sets an FMU through a file of parameters (SSV), as a tool without Python reads it."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np
import pytest
from conftest import BAR
from fmpy.ssp.ssd import read_ssv

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.cli.main import main
from pam_ocp.export import export_fmu, save_ssv

NAMES = ("muscle1", "muscle2")


def read(path: Path) -> dict[str, tuple[float, str]]:
    """Values and units, validated against the standard's schema."""
    found = read_ssv(str(path))
    return {p.name: (float(p.value), p.unit) for p in found.parameters}


def made_table(seed: int) -> tuple[pam.fitting.ForceTable, dict[str, float]]:
    """A table of the six-parameter law with random coefficients."""
    law = pam.muscle("DMSP-20-200N").law
    spread = np.random.default_rng(seed).uniform(0.9, 1.1, len(law.values))
    values = {n: v * s for (n, v), s in zip(law.values.items(), spread, strict=True)}
    p, k = np.meshgrid(np.linspace(1e5, 6e5, 6), np.linspace(0.0, 0.15, 8))
    force = np.asarray(type(law)(**values).tension(p.ravel(), k.ravel())).ravel()
    return pam.fitting.ForceTable(p.ravel(), k.ravel(), force, rest_length=0.21), values


def test_the_fmu_of_another_muscle_becomes_that_of_the_fitted_one(fmi, tmp_path):
    fit = pam.fit_force(made_table(11)[0])
    told = read(fit.save_ssv(tmp_path / "m.ssv", NAMES))
    assert told["muscle1.rest_length"] == (0.21, "m")
    assert told["muscle2.a3"][0] == fit.law.values["a3"]
    other = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), 2.0)
    path = export_fmu(other, tmp_path / "s.fmu", fmi=fmi, platforms="native", tolerance=1e-9)
    inputs = np.array(
        [(0.0, 4.0 * BAR, 2.0 * BAR), (0.2, 4.0 * BAR, 2.0 * BAR)],
        dtype=[(n, float) for n in ("time", "muscle1.command", "muscle2.command")],
    )
    found = fmpy.simulate_fmu(
        str(path),
        stop_time=0.2,
        output_interval=0.02,
        start_values={n: v for n, (v, _) in told.items()},
        input=inputs,
        fmi_type="CoSimulation",
    )
    fitted = pam.AntagonisticSlide(fit.muscle(), 2.0)
    commands = {f"{n}.command": v * BAR for n, v in zip(NAMES, (4.0, 2.0), strict=True)}
    here = pam.simulate(fitted, commands, t=found["time"])
    assert np.ptp(here["x"]) > 1e-3
    assert found["x"] == pytest.approx(here["x"], abs=1e-7)


def test_the_command_line_writes_it_beside_the_muscle(tmp_path):
    table, values = made_table(12)
    rows = zip(table.pressure, table.contraction, table.force, strict=True)
    text = "pressure [Pa],contraction [1],force [N]\n" + "".join(
        f"{p!r},{k!r},{f!r}\n" for p, k, f in (tuple(map(float, row)) for row in rows)
    )
    (tmp_path / "t.csv").write_text(text)
    target = tmp_path / "m.ssv"
    arguments = ["fit", str(tmp_path / "t.csv"), "--rest-length", "210 mm", "--ssv", str(target)]
    assert main([*arguments, "--muscles", *NAMES]) == 0
    told = read(target)
    assert {n.partition(".")[0] for n in told} == set(NAMES)
    for name, value in values.items():
        assert told[f"muscle2.{name}"][0] == pytest.approx(value, rel=1e-5)


def test_values_of_a_plant_are_checked_and_may_have_units(tmp_path):
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0)
    told = read(save_ssv(plant, tmp_path / "p.ssv", {"mass": "12 kg", "x": "5 mm"}))
    assert told == {"mass": (12.0, "kg"), "x": (0.005, "m")}
    assert len(read(save_ssv(plant, tmp_path / "a.ssv"))) == len(plant.parameters)
    with pytest.raises(InputError, match=r"muscle.command is neither a parameter nor a state"):
        save_ssv(plant, tmp_path / "b.ssv", {"muscle.command": 1e5})
    with pytest.raises(InputError, match="mass"):
        save_ssv(plant, tmp_path / "b.ssv", {"mass": -1.0})
    with pytest.raises(InputError, match=r"\.ssv"):
        save_ssv(plant, tmp_path / "b.txt")
