"""Plant, controller and planned motion as one system (SSP): it runs, and it controls."""

from __future__ import annotations

from pathlib import Path

import fmpy.ssp.simulation
import numpy as np
import pytest
from conftest import BAR, benchmark_slide
from fmu_tools import COMMANDS, coupled

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError
from pam_ocp.control.controller_plants import pid_controller
from pam_ocp.export import check_fmu, export_fmu, export_ssp

STEP, DURATION = 1e-3, 0.8
WIRES = {
    **{f"plant.{n}": f"pid.{n}" for n in COMMANDS},
    **{f"pid.feedforward.{n}": f"motion.{n}" for n in COMMANDS},
    "pid.reference": "motion.x",
    "pid.position": "plant.x",
}


def controller(plant: pam.Plant, **gains: float) -> pam.Plant:
    gains = {"proportional": 2e6, "integral": 1.5e8, "derivative": 1e4, **gains}
    return pid_controller(plant, "x", {COMMANDS[0]: 1.0, COMMANDS[1]: -1.0}, **gains)


def motion(plant: pam.Plant) -> pam.Trajectory:
    """A slow swing, as the plant of the plan makes it."""
    swing = {
        COMMANDS[0]: lambda t: (3 - np.cos(8 * t) + 1) * BAR,
        COMMANDS[1]: lambda t: (3 + np.cos(8 * t) - 1) * BAR,
    }
    return pam.simulate(plant, swing, t=np.linspace(0, DURATION, 801))


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
    result = fmpy.ssp.simulation.simulate_ssp(
        str(path), stop_time=DURATION - STEP / 2, step_size=STEP
    )
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
    with pytest.raises(InputError, match=r"nothing leads to pid\.position"):
        export_ssp(parts, opened, path)
    with pytest.raises(UnknownNameError, match=r"plant\.y"):
        export_ssp(parts, {**WIRES, "pid.position": "plant.y"}, path)
    with pytest.raises(UnknownNameError, match=r"pid\.speed"):
        export_ssp(parts, {**WIRES, "pid.speed": "plant.v"}, path)
    with pytest.raises(InputError, match="do not fit"):
        export_ssp(parts, {**WIRES, "pid.position": "plant.v"}, path)
    with pytest.raises(InputError, match="weight 0"):
        pid_controller(plant, "x", {COMMANDS[0]: 0.0}, proportional=1.0)
    with pytest.raises(InputError, match="give inputs of the plant"):
        pid_controller(plant, "x", {"v": 1.0}, proportional=1.0)
    assert not path.exists()


def test_an_empty_system_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(InputError, match="components is empty"):
        export_ssp({}, {}, tmp_path / "empty.ssp")
    assert list(tmp_path.iterdir()) == []
