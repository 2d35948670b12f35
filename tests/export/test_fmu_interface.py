"""The choice of an FMU's inputs and outputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fmpy
import fmpy.validation
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from hostile import contents

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError
from pam_ocp.export import check_fmu, export_fmu
from pam_ocp.export.runner import Runner, UnpackedFmu

FIRST, SECOND = "muscle1.command", "muscle2.command"


def chosen(folder: Path, fmi: Any, **options: Any) -> Path:
    options = {"inputs": [FIRST], "outputs": ["x", "stiffness"], **options}
    plant = options.pop("plant", None) or benchmark_slide()
    return export_fmu(plant, folder / f"{fmi[0]}.fmu", fmi=fmi, platforms="native", **options)


def kinds(path: Path) -> dict[str, tuple[str, str]]:
    described = fmpy.read_model_description(str(path))
    return {v.name: (v.causality, v.variability) for v in described.modelVariables}


def test_what_is_left_out_is_a_parameter_or_a_local_variable(fmi, tmp_path):
    path = chosen(tmp_path, fmi)
    assert fmpy.validation.validate_fmu(str(path)) == []
    found = kinds(path)
    assert found[FIRST] == ("input", "continuous")
    assert found[SECOND] == ("parameter", "tunable")
    assert {n for n, (c, _) in found.items() if c == "output"} == {"x", "stiffness"}
    for name in ("v", "muscle1.pressure", "muscle1.force"):
        assert found[name] == ("local", "continuous")
    structure = fmpy.read_model_description(str(path))
    assert [u.variable.name for u in structure.outputs] == ["x", "stiffness"]
    rates = {f"der({v.name})" for v in benchmark_slide().states}
    assert {u.variable.name for u in structure.initialUnknowns} == {"stiffness", *rates}
    (stiffness,) = [u for u in structure.outputs if u.variable.name == "stiffness"]
    inputs = {v.name for v in stiffness.dependencies}
    assert inputs == {"x", "muscle1.pressure", "muscle2.pressure"}


def test_it_moves_as_the_plant_with_the_other_input_held(fmi, tmp_path):
    plant, t = benchmark_slide().with_values({SECOND: 2 * BAR}), np.linspace(0, 0.3, 61)
    motion = pam.simulate(plant, {FIRST: lambda s: (3 + np.sin(20 * s)) * BAR}, t=t)
    checked = check_fmu(chosen(tmp_path, fmi, plant=plant), motion)
    assert checked.ok, str(checked)
    assert np.ptp(motion["x"]) > 1e-3
    assert set(checked.deviations["CoSimulation"]) == {"x", "stiffness"}


def test_the_held_input_can_be_tuned_and_locals_can_be_read(fmi, tmp_path):
    plant, step = benchmark_slide(), 5e-3
    names = ["x", "v", "muscle2.pressure", "muscle2.force"]
    fmu = UnpackedFmu(chosen(tmp_path, fmi), tmp_path / "unpacked")
    rows = []
    with Runner(fmu, "CoSimulation") as run:
        run.initialize({}, 0.0, None)
        for k in range(40):
            if k == 20:
                run.set({SECOND: 4.5 * BAR})
            run.step(k * step, step)
            rows.append(run.get(names))
    t = step * np.arange(41)
    held = np.where(t < 20 * step - 1e-9, 3 * BAR, 4.5 * BAR)
    motion = pam.simulate(plant, {SECOND: held}, t=t)
    nominal = [plant.variable(n).nominal for n in names]
    assert np.max(np.abs(np.array(rows) - motion.array(names)[1:]) / nominal) < 1e-6
    assert np.ptp(motion["x"]) > 1e-3


def test_without_any_input_the_plant_runs_by_itself(tmp_path):
    plant = benchmark_slide().with_values({"x": 0.005})
    path = chosen(tmp_path, "2.0", plant=plant, inputs=[], outputs=None)
    assert "input" not in {c for c, _ in kinds(path).values()}
    checked = check_fmu(path, pam.simulate(plant, duration=0.2))
    assert checked.ok, str(checked)


def test_a_reference_shows_what_the_fmu_shows(tmp_path):
    plant = benchmark_slide()
    motion = pam.simulate(plant, {FIRST: 4 * BAR}, duration=0.1)
    inside = contents(chosen(tmp_path, "2.0", reference=motion))
    lines = {n.rpartition("_")[2]: c.decode() for n, c in inside.items() if n.endswith(".csv")}
    tables = {n: text.splitlines()[0] for n, text in lines.items()}
    page = inside["documentation/index.html"].decode()
    assert tables == {"in.csv": f'"time","{FIRST}"', "ref.csv": '"time","x","stiffness"'}
    assert page.index("Outputs") < page.index(">stiffness<") < page.index("Local variables")
    assert page.index("Local variables") < page.index(">muscle1.force<")
    other = pam.simulate(plant, {SECOND: 4 * BAR}, duration=0.1)
    with pytest.raises(InputError, match=r"muscle2\.command is left out .* holds it at 3 bar"):
        chosen(tmp_path, "2.0", reference=other)
    elsewhere = pam.simulate(plant, duration=0.1, start={"x": 0.005})
    with pytest.raises(
        InputError, match=r"begins at x = 5 mm, the FMU at 0 mm; export plant\.with"
    ):
        chosen(tmp_path, "2.0", reference=elsewhere)
    heavier = pam.simulate(plant.with_values(mass=3.0), {FIRST: 4 * BAR}, duration=0.1)
    wrong = r"x is 5\.\d+ mm, this plant.s 4\.\d+ mm .* of another plant"
    with pytest.raises(InputError, match=wrong):
        chosen(tmp_path, "2.0", reference=heavier)


def test_terminals_gather_what_can_be_connected(tmp_path):
    inside = contents(chosen(tmp_path, "3.0"))
    text = inside["terminalsAndIcons/terminalsAndIcons.xml"].decode()
    assert f'variableName="{FIRST}"' in text
    assert 'variableName="stiffness"' in text
    assert "muscle1.force" not in text
    assert SECOND not in text


def test_names_that_do_not_fit_are_refused(tmp_path):
    refused("inputs: x is a state", chosen, tmp_path, "2.0", inputs=["x"])
    refused(r"outputs: muscle1\.command is an input", chosen, tmp_path, "2.0", outputs=[FIRST])
    with pytest.raises(UnknownNameError, match="did you mean 'stiffness'"):
        chosen(tmp_path, "2.0", outputs=["stifness"])
    refused("outputs is empty", chosen, tmp_path, "2.0", outputs=[])
    assert list(tmp_path.iterdir()) == []
