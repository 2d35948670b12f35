"""Plant, controller and planned motion as one system (SSP): it runs, and it controls. A fit sets a
unit through a file of parameters (SSV), as a tool without Python reads it.
"""

from __future__ import annotations

from pathlib import Path

import fmpy
import fmpy.ssp.simulation
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from fmpy.ssp.ssd import read_ssv
from fmu_tools import COMMANDS, coupled

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError
from pam_ocp.cli.main import main
from pam_ocp.control.controller_plants import pid_controller
from pam_ocp.export import check_fmu, export_fmu, export_ssp, save_ssv

STEP, DURATION = 1e-3, 0.8
SIGNS = dict(zip(COMMANDS, (-1.0, 1.0), strict=True))
WIRES = {
    **{f"plant.{n}": f"pid.{n}" for n in COMMANDS},
    **{f"pid.feedforward.{n}": f"motion.{n}" for n in COMMANDS},
    "pid.reference": "motion.x",
    "pid.position": "plant.x",
}


def controller(plant: pam.Plant, **gains: float) -> pam.Plant:
    gains = {"proportional": 2e6, "integral": 1.5e8, "derivative": 1e4, **gains}
    return pid_controller(plant, "x", {n: -s for n, s in SIGNS.items()}, **gains)


def motion(plant: pam.Plant) -> pam.Trajectory:
    """A slow swing, as the plant of the plan makes it."""
    t = np.linspace(0, DURATION, 801)
    swing = {n: (lambda t, s=s: (3 + s * (np.cos(8 * t) - 1)) * BAR) for n, s in SIGNS.items()}
    return pam.simulate(plant, swing, t=t)


def weaker(plant: pam.Plant) -> pam.Plant:
    return plant.with_values({"muscle1.a5": 0.9 * plant.variable("muscle1.a5").start})


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pam.Trajectory]:
    """A slide with one muscle weaker than planned, and a controller that makes good for it."""
    plan = benchmark_slide()
    swing = motion(plan)
    parts = {"motion": swing, "pid": controller(plan), "plant": weaker(plan)}
    path = tmp_path_factory.mktemp("ssp") / "slide.ssp"
    export_ssp(parts, WIRES, path, platforms="native", stop_time=DURATION)
    return path, swing


def test_fmpy_runs_it_as_its_parts_run_here(system, tmp_path):
    path, _ = system
    end = DURATION - STEP / 2
    result = fmpy.ssp.simulation.simulate_ssp(str(path), stop_time=end, step_size=STEP)
    expected = coupled(path, tmp_path, 800, STEP)
    assert len(result) == 800
    for name in COMMANDS:
        assert result[f"plant.{name}"] == pytest.approx(expected[f"plant.{name}"], rel=1e-12)
    assert result["plant.x"] == pytest.approx(expected["plant.x"], abs=1e-12)


def test_the_controller_keeps_a_weaker_slide_on_its_motion(system, tmp_path):
    path, swing = system
    x = coupled(path, tmp_path, 800, STEP)["plant.x"]
    alone = pam.simulate(weaker(benchmark_slide()), swing, t=swing.t)
    wanted = swing["x"][1:]
    left = np.sqrt(np.mean((x - wanted) ** 2))
    assert np.ptp(wanted) > 5e-3
    assert left < 0.5 * np.sqrt(np.mean((alone["x"][1:] - wanted) ** 2))


def test_the_controller_is_a_pid_with_feed_forward(tmp_path):
    """Against a step by step solution of e, its integral and its filtered slope."""
    pid = controller(benchmark_slide(), proportional=1e7, integral=2e8, derivative=1e5)
    t = np.linspace(0, 0.05, 51)
    error, tau = 1e-3, 5e-3
    given = {"reference": error, "position": 0.0}
    given |= {f"feedforward.{n}": 3 * BAR for n in COMMANDS}
    found = pam.simulate(pid, given, t=t)
    action = 1e7 * error + 2e8 * error * t + 1e5 * error / tau * np.exp(-t / tau)
    assert found[COMMANDS[0]] == pytest.approx(3 * BAR + action, rel=1e-8)
    assert found[COMMANDS[1]] == pytest.approx(3 * BAR - action, rel=1e-8)
    checked = check_fmu(export_fmu(pid, tmp_path / "pid.fmu", platforms="native"), found)
    assert checked.ok, str(checked)


def test_commands_stay_in_their_range_and_the_integral_runs_back():
    plant = benchmark_slide()
    pid = controller(plant, derivative=0.0)
    given = {"reference": 1.0, "position": 0.0}
    given |= {f"feedforward.{n}": 3 * BAR for n in COMMANDS}
    found = pam.simulate(pid, given, t=np.linspace(0, 1.0, 101))
    high = plant.variable(COMMANDS[0]).max
    assert np.all(found[COMMANDS[0]] == high)
    assert np.all(found[COMMANDS[1]] == plant.variable(COMMANDS[1]).min)
    # without the way back the integral would be at ki e t = 4e8
    assert abs(found["integrated"][-1]) < 1e8


def test_what_does_not_fit_is_refused_in_a_sentence(tmp_path):
    plant = benchmark_slide()
    parts = {"motion": motion(plant), "pid": controller(plant), "plant": plant}
    path = tmp_path / "slide.ssp"
    opened = {k: v for k, v in WIRES.items() if k != "pid.position"}
    refused(r"nothing leads to pid\.position", export_ssp, parts, opened, path)
    with pytest.raises(UnknownNameError, match=r"plant\.y"):
        export_ssp(parts, {**WIRES, "pid.position": "plant.y"}, path)
    with pytest.raises(UnknownNameError, match=r"pid\.speed"):
        export_ssp(parts, {**WIRES, "pid.speed": "plant.v"}, path)
    wrong = {**WIRES, "pid.position": "plant.v"}
    refused("do not fit; connect an output in m$", export_ssp, parts, wrong, path)
    gauge = pam.Trajectory([0, 1], {"p": [1, 2]}, [pam.Variable("p", "output", unit="bar")])
    wrong = {**WIRES, "pid.feedforward.muscle1.command": "gauge.p"}
    words = r"is in Pa, but gauge\.p is in bar: .* one in Pa \(its values times 100000\)"
    refused(words, export_ssp, {**parts, "gauge": gauge}, wrong, path)
    refused("weight 0", pid_controller, plant, "x", {COMMANDS[0]: 0.0}, proportional=1.0)
    refused("give inputs of the plant", pid_controller, plant, "x", {"v": 1.0}, proportional=1.0)
    assert not path.exists()


def test_an_empty_system_is_refused_and_nothing_is_written(tmp_path):
    refused("components is empty", export_ssp, {}, {}, tmp_path / "empty.ssp")
    assert list(tmp_path.iterdir()) == []


# ---- parameters (SSV) ----------------------------------------------------------------------------

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
    commands = dict(zip(COMMANDS, (4.0 * BAR, 2.0 * BAR), strict=True))
    rows = [(t, *commands.values()) for t in (0.0, 0.2)]
    inputs = np.array(rows, dtype=[(n, float) for n in ("time", *commands)])
    asked = {"stop_time": 0.2, "output_interval": 0.02, "fmi_type": "CoSimulation"}
    asked["start_values"] = {n: v for n, (v, _) in told.items()}
    found = fmpy.simulate_fmu(str(path), input=inputs, **asked)
    fitted = pam.AntagonisticSlide(fit.muscle(), 2.0)
    here = pam.simulate(fitted, commands, t=found["time"])
    assert np.ptp(here["x"]) > 1e-3
    assert found["x"] == pytest.approx(here["x"], abs=1e-7)


def test_the_command_line_writes_it_beside_the_muscle(tmp_path):
    table, values = made_table(12)
    cells = np.column_stack([table.pressure, table.contraction, table.force]).tolist()
    rows = ["pressure [Pa],contraction [1],force [N]", *(",".join(map(repr, c)) for c in cells)]
    (tmp_path / "t.csv").write_text("\n".join(rows) + "\n")
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
    refused("mass", save_ssv, plant, tmp_path / "b.ssv", {"mass": -1.0})
    refused(r"\.ssv", save_ssv, plant, tmp_path / "b.txt")


def test_of_shared_parameters_only_those_are_told_that_the_unit_takes(tmp_path):
    slide = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-300"), mass=2.0, stroke=0.016, pre_contraction=0.1
    )
    unit = export_fmu(slide, tmp_path / "s.fmu", platforms=["source"], share=True)
    described = fmpy.read_model_description(str(unit)).modelVariables
    settable = [v.name for v in described if v.causality == "parameter"]
    assert "muscle.a1" in settable
    assert "muscle1.a1" not in settable
    assert sorted(read(save_ssv(slide, tmp_path / "s.ssv", share=True))) == sorted(settable)
    given = {"muscle1.a1": 1.0}
    refused("muscle1.a1 is neither", save_ssv, slide, tmp_path / "t.ssv", given, share=True)


@pytest.mark.parametrize("character", ["\x01", "\x1f", "\ud800", "\uffff"])
def test_no_file_holds_what_xml_does_not_allow(character, tmp_path):
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0)
    refused("which XML does not", save_ssv, plant, tmp_path / "p.ssv", name=f"a{character}b")
    assert list(tmp_path.iterdir()) == []
