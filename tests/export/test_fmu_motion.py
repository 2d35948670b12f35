"""A planned motion as an FMU that plays it, and as a table in FMI's reference format."""

from __future__ import annotations

from typing import Any

import fmpy
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from fmpy.util import read_csv
from fmu_tools import COMMANDS, KINDS

import pam_ocp as pam
from pam_ocp import UnknownNameError
from pam_ocp.export import check_fmu, export_fmu, export_motion, save_input_table
from pam_ocp.export.runner import Runner, UnpackedFmu


def held() -> pam.Trajectory:
    """Commands that jump every 5 ms."""
    t = np.arange(41) * 0.005
    values = np.random.default_rng(8).uniform(1 * BAR, 5 * BAR, (2, 41))
    return pam.simulate(benchmark_slide(), dict(zip(COMMANDS, values, strict=True)), t=t)


def curved() -> pam.Trajectory:
    """Commands that are functions of time, so curved."""
    functions = {
        "muscle1.command": lambda t: (3 + 2 * np.sin(20 * t)) * BAR,
        "muscle2.command": lambda t: (3 - 1.5 * np.sin(15 * t)) * BAR,
    }
    return pam.simulate(benchmark_slide(), functions, duration=0.2)


def lines() -> pam.Trajectory:
    """A record without signals, from 1 s on, its samples joined by lines."""
    t = 1.0 + np.array([0.0, 0.03, 0.05, 0.2])
    columns = dict(zip(COMMANDS, ([1e5, 3e5, 2e5, 4e5], [3e5, 3e5, 1e5, 2e5]), strict=True))
    command = pam.Trajectory(t, columns, benchmark_slide().inputs, "linear")
    assert command.signals is None
    return command


def truth(motion: pam.Trajectory, t: Any) -> Any:
    """The commands at times inside the motion, behind a jump there."""
    t = np.minimum(np.asarray(t) + 1e-12, motion.t[-1])
    if motion.signals is not None:
        return motion.signals(t)
    return np.column_stack([np.interp(t, motion.t, motion[n]) for n in COMMANDS])


@pytest.mark.parametrize("make", [held, curved, lines])
def test_every_mode_plays_the_inputs_as_they_ran(make, fmi, tmp_path):
    motion = make()
    path = export_motion(motion, tmp_path / "motion.fmu", fmi=fmi, platforms="native")
    found = check_fmu(path)
    assert found.ok, str(found)
    for kind in KINDS:
        result = fmpy.simulate_fmu(str(path), fmi_type=kind, stop_time=0.2, output_interval=0.001)
        at_end = np.flatnonzero(np.diff(result["time"], append=np.inf) > 1e-12)  # behind an event
        rows = result[at_end]
        played = np.column_stack([rows[n] for n in COMMANDS])
        expected = truth(motion, motion.t[0] + np.round(rows["time"], 9))
        assert len(rows) == 201
        assert np.max(np.abs(played - expected)) < 1e-9 * 5 * BAR
        assert np.ptp(played[:, 0]) > BAR


def test_jumps_are_time_events_of_model_exchange(fmi, tmp_path):
    jumping = export_motion(held(), tmp_path / "held.fmu", fmi=fmi, platforms="native")
    smooth = export_motion(lines(), tmp_path / "lines.fmu", fmi=fmi, platforms="native")
    asked = {"fmi_type": "ModelExchange", "stop_time": 0.2, "output_interval": 0.005}
    for path, events in ((jumping, 39), (smooth, 0)):
        times = fmpy.simulate_fmu(str(path), **asked)["time"]
        assert np.sum(np.diff(times) == 0) in (events, events + 1)  # one more at the end


@pytest.mark.parametrize("between", ["linear", "previous"])
def test_outside_of_its_time_a_motion_stands_still(between, tmp_path):
    motion = lines().running(between)
    path = export_motion(motion, tmp_path / "motion.fmu", platforms="native")
    fmu = UnpackedFmu(path, tmp_path / "unpacked")
    for begin, row in ((0.0, 0), (1.3, -1)):
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({"clock": begin}, 0.0, None)
            runner.step(0.0, 0.1)
            assert runner.get(["clock"])[0] == pytest.approx(begin + 0.1, abs=1e-12)
            assert list(runner.get(list(COMMANDS))) == [motion[n][row] for n in COMMANDS]


def test_chosen_columns_are_joined_by_lines_beside_the_inputs(tmp_path):
    motion, chosen = held(), {"names": ["x", "muscle2.command"], "name": "some"}
    path = export_motion(motion, tmp_path / "some.fmu", **chosen, platforms="native")
    result = fmpy.simulate_fmu(str(path), stop_time=0.2, output_interval=0.001)
    t = np.round(result["time"], 9)
    assert result["x"] == pytest.approx(np.interp(t, motion.t, motion["x"]), abs=1e-12)
    assert result["muscle2.command"] == pytest.approx(truth(motion, t)[:, 1], abs=1e-4)


def test_derivatives_are_the_slopes(tmp_path):
    motion = curved()
    path = export_motion(motion, tmp_path / "motion.fmu", fmi="3.0", platforms="native")
    fmu = UnpackedFmu(path, tmp_path / "unpacked")
    with Runner(fmu, "ModelExchange") as runner:
        runner.initialize({"clock": 0.07}, 0.0, None)
        slopes = runner.directional(list(COMMANDS), ["clock"], [1.0])
        expected = [2e5 * 20 * np.cos(20 * 0.07), -1.5e5 * 15 * np.cos(15 * 0.07)]
        assert slopes == pytest.approx(expected, rel=1e-5)
        references = (runner.references(list(COMMANDS)), runner.references(["clock"]))
        adjoint = runner.inner.getAdjointDerivative(*references, [2.0, -3.0], 1)
        assert adjoint[0] == pytest.approx(2 * slopes[0] - 3 * slopes[1], rel=1e-12)


def test_the_table_drives_the_plant_as_the_motion_did(tmp_path):
    plant, motion = benchmark_slide(), held()
    table = read_csv(str(save_input_table(motion, tmp_path / "motion_in.csv")))
    path = export_fmu(plant, tmp_path / "slide.fmu", platforms="native")
    asked = {"fmi_type": "ModelExchange", "stop_time": 0.2, "output_interval": 0.005}
    asked |= {"input": table, "output": ["x", "v"], "relative_tolerance": 1e-9}
    result = fmpy.simulate_fmu(str(path), **asked)
    for name in ("x", "v"):
        found = np.interp(motion.t, result["time"], result[name])
        assert found == pytest.approx(motion[name], abs=1e-6 * motion.variable(name).nominal)
        assert np.ptp(motion[name]) > 1e-3


@pytest.mark.parametrize("make", [curved, lines])
def test_straight_lines_through_the_table_follow_the_motion(make, tmp_path):
    motion = make()
    table = read_csv(str(save_input_table(motion, tmp_path / "motion_in.csv")))
    for column, name in enumerate(COMMANDS):
        found = np.interp(motion.t, table["time"], table[name])
        assert found == pytest.approx(truth(motion, motion.t)[:, column], abs=1e-3)


def test_what_cannot_be_played_is_refused_in_a_sentence(tmp_path):
    motion, path = held(), tmp_path / "motion.fmu"
    with pytest.raises(UnknownNameError, match=r"muscle3\.command"):
        export_motion(motion, path, names=["muscle3.command"])
    refused("at least one column", export_motion, motion, path, names=[])
    refused("one sample", export_motion, motion.at([0.1]), path)
    refused("clock", export_motion, pam.Trajectory([0.0, 1.0], {"clock": [0.0, 1.0]}), path)
    assert not path.exists()
