"""A loop in Python and the same loop as a system (SSP) exchange alike: delay, first command, order.

The master here is written by hand with FMPy's instances, as the SSP's exchange is described.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from fmu_tools import COMMANDS, System
from hostile import contents

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.control import BlockController, KalmanFilter, WithEstimate, block, chain, kalman
from pam_ocp.export import export_ssp
from pam_ocp.export.runner import Runner, UnpackedFmu

H, SAMPLES = 2e-3, 100


def run_system(path: Path, folder: Path, steps: int, size: float) -> dict[str, Any]:
    """Hand over; then, again and again, all step and all hand over. Values at k size from 0 on."""
    system, rows = System(path, folder), []
    for unit in system.units.values():
        unit.begin(0.0)
    for _ in system.units:  # a chain of outputs through inputs is as long as there are parts
        system.set(system.values())
    for unit in system.units.values():
        unit.end_initialization()
    for k in range(steps + 1):
        system.set(system.values())
        rows.append(system.values())
        if k < steps:
            system.step(k * size, size)
    system.free()
    return {n: np.array([row[n] for row in rows]) for n in rows[0]}


def slide() -> tuple[pam.Plant, Any]:
    plant = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)
    point = plant.equilibrium(x=0.0, stiffness=2e4)
    return plant.with_values(point), point


def pid_law(delay: int) -> tuple[Any, Any]:
    plant, point = slide()
    pid = pam.control.PointPid(plant, point, 1e6, 2e7, 1e4, sample_time=H)
    return plant, block(pid, plant=plant, delay=delay)


def lqi(plant: pam.Plant, point: Any) -> Any:
    return pam.lqr(plant, point, integral={"x": 20.0}, sample_time=H)


def lqi_law(delay: int) -> tuple[Any, Any]:
    plant, point = slide()
    return plant, block(lqi(plant, point), plant=plant, delay=delay)


def lqg_law(delay: int) -> tuple[Any, Any]:
    plant, point = slide()
    filter = kalman(plant, point, measured={"x": 1e-5}, sample_time=H)
    return plant, block(WithEstimate(lqi(plant, point), filter, delay=delay), plant=plant)


def mpc_law(delay: int) -> tuple[Any, Any]:
    plant, _ = slide()
    rate = dict.fromkeys(COMMANDS, 0.1)
    how = {"sample_time": H, "iterations": 1, "delay": delay}
    mpc = pam.Mpc(plant, horizon=4, track={"x": 1.0}, rate=rate, **how)
    return plant, block(mpc, plant=plant)


LAWS = {"pid": pid_law, "lqi": lqi_law, "lqg": lqg_law, "mpc": mpc_law}


def wanted(t: float) -> float:
    return min(t / 0.08, 1.0) * 3e-3


def system(
    plant: pam.Plant,
    law: Any,
    path: Path,
    platforms: str = "native",
    names: tuple[str, str] = ("law", "plant"),
    **options: Any,
) -> Path:
    t = np.array([0.0, 0.08, 1.0])
    columns = {"x": [wanted(s) for s in t], "one": np.ones(3)}
    variables = [plant.variable("x"), pam.Variable("one", "output")]
    goal = pam.Trajectory(t, columns, variables, "linear")
    here, there = names
    wires = {f"{there}.{c}": f"{here}.{c}" for c in COMMANDS}
    for v in law.inputs:
        of = "goal.x" if v.name == "wanted.x" else f"{there}.{v.name}"
        wires[f"{here}.{v.name}"] = "goal.one" if v.name == "enable" else of
    parts = {"goal": goal, here: law, there: plant}
    return export_ssp(parts, wires, path, platforms=platforms, tolerance=1e-11, **options)


@pytest.mark.parametrize("kind", LAWS)
def test_a_loop_here_and_its_system_agree_to_1e_9(kind, tmp_path):
    plant, law = LAWS[kind](1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = system(plant, law, tmp_path / "loop.ssp")
    there = run_system(path, tmp_path / "run", SAMPLES, H)
    controller = BlockController(law, lambda t: {"wanted.x": wanted(t)})
    here = pam.closed_loop(controller, plant, duration=SAMPLES * H, rtol=1e-12)
    assert here.delay == here.designed_delay == 1
    assert np.ptp(here["x"]) > 4e-4
    for name in [v.name for v in plant.states]:
        error = np.abs(there[f"plant.{name}"] - here[name]) / plant.variable(name).nominal
        assert error.max() < 1e-9, name
    for name in COMMANDS:  # as they act on the plant, from the first one on
        error = np.abs(there[f"plant.{name}"] - here[name])[:-1] / plant.variable(name).nominal
        assert error.max() < 1e-9, name
        assert there[f"plant.{name}"][0] == plant.variable(name).start


def test_the_first_command_can_be_set_and_outputs_are_the_laws_from_the_first_sample_on(tmp_path):
    plant, law = lqi_law(1)
    path = system(plant, law, tmp_path / "loop.ssp")
    (tmp_path / "law.fmu").write_bytes(contents(path)["resources/law.fmu"])
    assert pam.check_fmu(tmp_path / "law.fmu").ok
    law_unit = UnpackedFmu(tmp_path / "law.fmu", tmp_path / "unit")
    first = law_unit.variables[COMMANDS[0]]
    assert (first.initial, float(first.start)) == ("exact", plant.variable(COMMANDS[0]).start)
    with Runner(law_unit, "CoSimulation") as unit:
        unit.initialize({COMMANDS[0]: 1.5e5}, 0.0, None)
        assert unit.get([COMMANDS[0]]) == [1.5e5]
        unit.step(0.0, H)
        assert unit.get([COMMANDS[0]])[0] == pytest.approx(first_lqi_command(), rel=1e-9)
        refused("rror", unit.set, {COMMANDS[0]: 1.5e5}, error=Exception)


def test_the_first_command_is_the_plants_under_any_name_of_the_parts(tmp_path):
    plant, law = lqi_law(1)
    plant = plant.with_values(dict.fromkeys(COMMANDS, 1.7e5))
    path = system(plant, law, tmp_path / "loop.ssp", names=("cell.law", "cell.plant"))
    (tmp_path / "law.fmu").write_bytes(contents(path)["resources/cell.law.fmu"])
    unit = UnpackedFmu(tmp_path / "law.fmu", tmp_path / "unit")
    assert [float(unit.variables[c].start) for c in COMMANDS] == [1.7e5, 1.7e5]


def first_lqi_command() -> float:
    """At the point itself, before anything is wanted: the point's own command."""
    return float(slide()[1][COMMANDS[0]])


# ---- the cost of a delay is said ----------------------------------------------------------------


def test_a_system_warns_of_a_delay_that_the_design_does_not_know(tmp_path):
    path = tmp_path / "loop.ssp"
    late = r"commands of law act one step .* is designed for no delay: 0.72 deg of phase"
    for kind, delay, options, words in (
        ("mpc", 0, {}, late),
        ("lqi", 0, {}, late),
        ("pid", 0, {"step_size": H / 2}, late.replace("0.72", "0.36")),
        ("mpc", 1, {"step_size": H / 2}, r"\(1 ms\) .* is designed for 2 ms: 0.36 deg of"),
    ):
        with pytest.warns(UserWarning, match=words):
            system(*LAWS[kind](delay), path, "source", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system(*lqi_law(0), path, "source", step_size=H / 20)


def test_a_system_warns_of_blocks_in_a_row(tmp_path):
    plant, point = slide()
    filter = block(kalman(plant, point, measured={"x": 1e-5}, sample_time=H), delay=1)
    law = block(lqi(plant, point), plant=plant, delay=1)
    wires = {f"plant.{c}": f"law.{c}" for c in COMMANDS} | {"filter.x": "plant.x"}
    wires |= {f"filter.sent.{c}": f"law.{c}" for c in COMMANDS}
    wires |= {f"law.{v.name}": f"filter.estimate.{v.name}" for v in plant.states}
    wires |= {"law.wanted.x": "plant.x", "law.enable": "law.status"}
    wires["filter.enable"] = "filter.status"
    for v in filter.inputs:
        wires.setdefault(f"filter.{v.name}", f"plant.{v.name}")
    parts = {"filter": filter, "law": law, "plant": plant}
    words = r"law gets what filter gives one step \(2 ms\) later"
    with pytest.warns(UserWarning, match=words) as w:
        export_ssp(parts, wires, tmp_path / "two.ssp", platforms="source")
    assert len(w) == 1  # what the filter is told was sent is of the sample before anyway


def test_a_loop_here_warns_of_a_delay_that_the_design_does_not_know(tmp_path):
    plant, law = mpc_law(0)
    with pytest.warns(UserWarning, match=r"act 1 sample \(2 ms\) after the meas.*, not 0 as the"):
        late = pam.closed_loop(BlockController(law), plant, {"x": 0.0}, duration=0.02, delay=1)
    assert "not 0 as the controller is designed for" in str(late)
    late.save(tmp_path / "late.npz")
    assert str(type(late).load(tmp_path / "late.npz")) == str(late)
    cart = pam.closed_loop(BlockController(law), plant, {"x": 1e-3}, duration=0.02)
    with pytest.warns(UserWarning, match="not 0 as") as told:
        late = pam.closed_loop(BlockController(law), plant, {"x": 1e-3}, duration=0.02, delay=1)
    off = 1e3 * np.max(np.abs(late["x"] - cart["x"]))
    figure = re.search(r"x is up to (\S+) mm from where it would be", str(told[0].message))
    assert figure is not None
    assert float(figure[1]) == pytest.approx(off, rel=1e-3)
    assert off > 1e-3
    plant, law = mpc_law(1)
    with pytest.warns(UserWarning, match="act at once, but the controller is designed for a delay"):
        pam.closed_loop(BlockController(law), plant, {"x": 0.0}, duration=0.02, delay=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loop = pam.closed_loop(BlockController(law), plant, {"x": 0.0}, duration=0.02)
    assert loop.delay == 1  # the block tells it, as its Mpc would
    assert loop[COMMANDS[0]][0] == plant.variable(COMMANDS[0]).start


def test_estimators_take_the_commands_that_acted():
    """Under a delay, against the filter in the loop, which is told what acts by the loop itself."""
    plant, point = slide()
    law = pam.lqr(plant, point, sample_time=H)
    begin = plant.with_values({"x": 2e-3})
    for filter in (
        kalman(plant, point, measured={"x": 1e-5}, sample_time=H),
        KalmanFilter(plant, sample_time=H, measured={"x": 1e-5}),
    ):
        whole = block(chain([filter, law], delay=1), plant=plant)
        quiet = {"duration": 0.1, "delay": 1, "noise": {}}
        there = pam.closed_loop(law, begin, estimator=filter, **quiet)
        here = pam.closed_loop(BlockController(whole), begin, **quiet)
        deviation = np.abs(there["x"] - here["x"]).max()
        unaware = block(chain([filter, law]), plant=plant)
        with pytest.warns(UserWarning, match="not 0 as the controller"):
            wrong = pam.closed_loop(BlockController(unaware), begin, **quiet)
        assert deviation < 1e-9 < 1e-7 < np.abs(there["x"] - wrong["x"]).max()


def test_a_filter_with_its_law_is_the_same_here_and_as_a_block():
    plant, point = slide()
    filter = kalman(plant, point, measured={"x": 1e-5}, sample_time=H)
    both = WithEstimate(pam.lqr(plant, point, sample_time=H), filter, delay=1)
    begin = plant.with_values({"x": 2e-3})
    here = pam.closed_loop(both, begin, duration=0.1, sample_time=H)
    there = pam.closed_loop(BlockController(block(both, plant=plant)), begin, duration=0.1)
    assert here.delay == there.delay == 1
    assert here["x"] == pytest.approx(there["x"], abs=1e-12)


# ---- names and units ----------------------------------------------------------------------------


def test_a_component_named_like_its_parameters_is_refused(tmp_path):
    plant, point = slide()
    filter = kalman(plant, point, measured={"x": 1e-5}, sample_time=H)
    law = block(chain([filter, lqi(plant, point)], delay=1), plant=plant)
    first = law.parameters[0].name.partition(".")[0]
    with pytest.raises(InputError, match=f"component '{first}' is named like the beginning of its"):
        export_ssp({first: law, "plant": plant}, {}, tmp_path / "a.ssp")
    with pytest.raises(InputError, match=r"component 'muscle1' .* such as 'the_muscle1'"):
        export_ssp({"muscle1": plant}, {}, tmp_path / "a.ssp")
    assert not (tmp_path / "a.ssp").exists()


def test_a_pid_takes_units_from_its_plant():
    plant, _ = slide()
    ends = {"measured": "x", "command": COMMANDS[0]}
    made = block(pam.control.PID(1e6), plant=plant, sample_time=H, **ends)
    units = {"wanted.x": "m", "x": "m", "enable": "1", COMMANDS[0]: "Pa", "status": "1"}
    assert {v.name: v.unit for v in (*made.inputs, *made.outputs)} == units
    refused("no variable", block, lqi(*slide()), plant=pam.HangingLoad("DMSP-20-300", mass=2.0))


def test_delays_that_contradict_each_other_are_refused():
    plant, point = slide()
    rate = dict.fromkeys(COMMANDS, 0.1)
    mpc = pam.Mpc(plant, horizon=5, sample_time=H, track={"x": 1.0}, rate=rate, delay=1)
    refused("mpc is designed for delay = 1; give that", block, mpc, delay=2)
    refused("is a block already; leave out delay", block, block(mpc, guard=False), delay=1)
    refused("delay", block, lqi(plant, point), delay=-1)
