"""State feedback as a controller of its own: its law, its FMU,
and plant and controller in an SSP.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import casadi as ca
import fmpy
import fmpy.ssp.simulation
import fmpy.ssp.ssd
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from fmu_tools import COMMANDS, coupled, sound
from hostile import contents

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.control import block, chain
from pam_ocp.control.controller_plants import state_feedback_controller
from pam_ocp.core.block import Block
from pam_ocp.export import check_fmu, export_fmu, export_ssp
from pam_ocp.export.runner import Runner, UnpackedFmu

STATES = ("x", "v", "muscle1.pressure", "muscle2.pressure")
STEP = 1e-3


@pytest.fixture(scope="module")
def feedback() -> Any:
    plant = benchmark_slide()
    point = plant.equilibrium(x=0.002, stiffness=2.2e4)
    return pam.lqr(plant, point, integral={"x": 200.0, "stiffness": 10.0}, sample_time=STEP)


def test_it_is_the_law_with_the_integral_of_the_error(feedback):
    built, point = state_feedback_controller(feedback), feedback.point
    dx = np.array([3e-4, -2e-3, 800.0, -500.0])
    error = {"x": dx[0] - 1e-4, "stiffness": 20.0}
    given = dict(zip(STATES, point.x + dx, strict=True))
    given |= {"stiffness": point["stiffness"] + 20.0, "reference.x": point["x"] + 1e-4}
    t = np.linspace(0.0, 0.2, 21)
    found = pam.simulate(built, given, t=t)
    law = feedback.K @ dx
    z = np.array([error["x"], error["stiffness"]])[:, None] * t
    expected = point.u[:, None] - law[:, None] - feedback.Ki @ z
    for row, name in zip(expected, COMMANDS, strict=True):
        assert found[name] == pytest.approx(row, rel=1e-8)
        assert np.ptp(found[name]) > 100.0


def test_held_commands_let_the_integrals_run_back(feedback):
    """To where the commands asked for are as far beyond their range as the error drives them."""
    built, point = state_feedback_controller(feedback, windup_time=0.05), feedback.point
    given = {**dict(zip(STATES, point.x, strict=True)), "stiffness": point["stiffness"]}
    run = pam.simulate(built, {**given, "reference.x": 0.2}, t=np.linspace(0, 3, 31))
    plant = point.plant
    high = [plant.variable(n).max for n in COMMANDS]
    assert run[COMMANDS[0]][-1] == pytest.approx(high[0])
    # without the way back the integral would be at -0.198 * 3 s
    assert run["integral.x"][-1] == pytest.approx(run["integral.x"][-6], rel=1e-3)
    assert abs(run["integral.x"][-1]) < 0.198 * 3 / 4


def test_as_an_fmu_it_does_the_same(feedback, fmi, tmp_path):
    built, point, t = state_feedback_controller(feedback), feedback.point, np.linspace(0, 0.1, 21)
    given: dict[str, Any] = dict(zip(STATES, point.x, strict=True))
    given |= {"stiffness": point["stiffness"], "x": lambda s: point["x"] + 5e-4 * np.sin(60 * s)}
    motion = pam.simulate(built, given, t=t)
    path = export_fmu(built, tmp_path / "f.fmu", fmi=fmi, platforms="native")
    checked = check_fmu(path, motion)
    assert checked.ok, str(checked)


def test_without_integrals_it_is_the_static_law_and_can_follow_a_motion(tmp_path):
    plant = benchmark_slide()
    plain = pam.lqr(plant, plant.equilibrium(x=0.0, stiffness=2.2e4))
    built = state_feedback_controller(plain, follow=True)
    given = dict(zip(STATES, plain.point.x, strict=True))
    given |= {"reference.x": 1e-3, "feedforward.muscle1.command": 2.5 * BAR}
    u0 = np.array([2.5 * BAR, plain.point.u[1]])
    expected = u0 - plain.K @ np.array([-1e-3, 0, 0, 0])
    run = pam.simulate(built, given, duration=0.1)
    assert [run[n][-1] for n in COMMANDS] == pytest.approx(expected, rel=1e-12)
    assert check_fmu(export_fmu(built, tmp_path / "f.fmu", platforms="native"), run).ok


WIRES = {
    **{f"plant.{n}": f"feedback.{n}" for n in COMMANDS},
    **{f"feedback.{n}": f"plant.{n}" for n in (*STATES, "stiffness")},
    "feedback.reference.x": "goal.x",
    "feedback.reference.stiffness": "goal.stiffness",
}


def goal(times: Any, x: Any, stiffness: Any) -> pam.Trajectory:
    plant = benchmark_slide()
    variables = [plant.variable(n) for n in ("x", "stiffness")]
    return pam.Trajectory(times, {"x": x, "stiffness": stiffness}, variables)


def test_in_an_ssp_it_takes_a_heavier_slide_to_its_goal_in_fmpy_as_here(feedback, tmp_path):
    plant = benchmark_slide()
    t = np.array([0.0, 0.1, 0.3, 2.0])
    parts = {
        "goal": goal(t, np.array([0.002, 0.002, 0.004, 0.004]), np.full(4, 2.3e4)),
        "feedback": state_feedback_controller(feedback),
        "plant": plant.with_values(mass=1.3 * float(plant.variable("mass").start or 1.0)),
    }
    path = export_ssp(parts, WIRES, tmp_path / "s.ssp", platforms="native", stop_time=1.5)
    here = coupled(path, tmp_path, 1500, STEP)
    there = fmpy.ssp.simulation.simulate_ssp(str(path), stop_time=1.5 - STEP / 2, step_size=STEP)
    assert there["plant.x"] == pytest.approx(here["plant.x"], abs=1e-12)
    assert here["plant.x"][-1] == pytest.approx(0.004, abs=1e-6)
    assert here["plant.stiffness"][-1] == pytest.approx(2.3e4, rel=1e-4)


def test_what_is_no_state_feedback_is_refused(feedback):
    with pytest.raises(InputError, match="feedback is an AntagonisticSlide, not a StateFeedback"):
        state_feedback_controller(benchmark_slide())
    refused("windup_time = 0 s must be > 0", state_feedback_controller, feedback, windup_time=0.0)


# ---- gains as arrays ----------------------------------------------------------------------------


def test_gains_are_one_array_in_fmi_3_tunable_while_running(tmp_path):
    """Against the block's own step with these gains, whose entries FMI 2 has one by one."""
    plant = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)
    rest = plant.equilibrium(x=0.0, stiffness=2e4)
    law = pam.lqr(plant, rest, integral={"x": 20.0}, sample_time=2e-3)
    made = block(chain([law], name="whole"), plant=plant)
    unit = sound(made, tmp_path, "3.0", matrices=True)
    (name,) = (n for n in unit.references if n.endswith(".K"))
    shape = [int(d.start) for d in unit.variables[name].dimensions]
    assert shape == list(law.K.shape) == [2, 4]
    assert unit.variables[name].variability == "tunable"
    assert not [n for n in unit.references if n.startswith(f"{name}.")]
    x = {"x": 1e-3, "v": 0.02, "muscle1.pressure": 3.1e5, "muscle2.pressure": 2.9e5}
    gains = np.random.default_rng(3).uniform(0.5, 1.5, 8) * law.K.ravel()
    entries = [v.name for v in made.parameters if v.name.startswith(f"{name}.")]
    outputs = [v.name for v in made.outputs]
    memory, parameters = made.start("memory"), made.start("parameters")
    places = [[v.name for v in made.parameters].index(n) for n in entries]
    inputs = np.array([x.get(v.name, v.start or 0.0) for v in made.inputs])
    with Runner(unit, "CoSimulation") as runner:
        runner.initialize(x, 0.0, None)
        reference = [unit.references[name]]
        read = runner.inner.getFloat64(reference, 8)
        assert list(read) == list(law.K.ravel())
        for k in range(6):
            if k == 3:
                runner.inner.setFloat64(reference, gains.tolist())
                parameters[places] = gains
            memory, wanted = (np.asarray(r).ravel() for r in made.step(memory, inputs, parameters))
            runner.step(k * 2e-3, 2e-3)
            assert runner.get(outputs) == pytest.approx(wanted, rel=1e-12)
        refused("rror", runner.inner.setFloat64, reference, gains[:7].tolist(), error=Exception)
    for words, given in {
        "matrices = 'yes': give True or False": {"matrices": "yes"},
        "'source' means no binaries at all; give it alone": {"platforms": ["source", "native"]},
        "FMI 2 has no arrays": {"matrices": True},
        "a plant has none": {"system": plant, "fmi": "3.0", "matrices": True},
    }.items():
        refused(words, export_fmu, path=tmp_path / "k.fmu", **{"system": made, **given})


def test_flags_are_booleans_and_tell_the_bits_of_the_status(fmi, tmp_path):
    """Off, blind and at an end of the range, against what the guard says these bits mean."""
    plant = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)
    law = pam.lqr(plant, plant.equilibrium(x=0.0, stiffness=2e4), sample_time=2e-3)
    limits = dict.fromkeys(COMMANDS, (2e5, 4e5))
    made = block(law, plant=plant, hold=1, limits=limits, fade_time=0.0)
    unit = sound(made, tmp_path, fmi, booleans=True)
    names = ["off", "missing", "lost", "at_range", "at_rate", "no_number"]
    assert unit.typed == dict.fromkeys(["enable", *(f"status.{n}" for n in names)], "Boolean")
    assert "status" not in unit.references
    assert unit.variables["enable"].variability == "discrete"
    rest = {"x": 0.0, "muscle1.pressure": 3e5, "muscle2.pressure": 3e5}
    cases = [
        ({"enable": 1.0}, set()),
        ({"enable": 0.0}, {"off"}),
        ({"enable": 1.0, "x": np.nan}, {"missing"}),
        ({"x": np.nan}, {"missing", "lost"}),
        ({"x": 1.0}, set()),  # in action again: the command begins where it stood
        ({}, {"at_range"}),
        ({"x": 0.0, "enable": 0.0}, {"off"}),
    ]
    with Runner(unit, "CoSimulation") as runner:
        runner.initialize(rest, 0.0, None)
        for k, (given, wanted) in enumerate(cases):
            runner.set(given)
            runner.step(k * 2e-3, 2e-3)
            found = dict(zip(names, runner.get([f"status.{n}" for n in names]), strict=True))
            assert {n for n, v in found.items() if v} == wanted, k
        reference = [unit.references["enable"]]
        read = runner.inner.getReal if fmi == "2.0" else runner.inner.getFloat64
        refused("rror", read, reference, error=Exception)
        refused("rror", runner.inner.getBoolean, [unit.references["x"]], error=Exception)
    refused("has no flags", export_fmu, block(law, guard=False), tmp_path / "c.fmu", booleans=True)


# ---- enumerations -------------------------------------------------------------------------------


def test_codes_of_a_plant_are_enumerations_in_both_modes(fmi, tmp_path):
    """A tank that fills with 0, 1 or 5 a second, half of it in one gear: by hand."""
    plant = pam.Plant("tank")
    x = plant.state("x", start=0.5)
    speed = plant.input("speed", codes="off slow fast")
    gear = plant.parameter("gear", 1.0, codes="half whole", tunable=True)
    plant.der(x, speed * (1 + 1.5 * (speed - 1)) * (1 + gear) / 2)
    unit = sound(plant, tmp_path, fmi, enumerations=True)
    assert unit.typed == {"speed": "Enumeration", "gear": "Enumeration"}
    kinds = unit.description.typeDefinitions
    items = [{i.name: int(i.value) for i in k.items} for k in kinds if k.items]
    assert items == [{"off": 0, "slow": 1, "fast": 2}, {"half": 0, "whole": 1}]
    for mode in ("CoSimulation", "ModelExchange"):
        start = {"speed": 2.0, "gear": 0.0}
        run = {"fmi_type": mode, "stop_time": 1.0, "start_values": start, "output": ["x"]}
        found = fmpy.simulate_fmu(str(unit.folder), **run)
        assert found["x"][-1] == pytest.approx(0.5 + 5 / 2, rel=1e-6), mode
    with Runner(unit, "CoSimulation") as runner:
        runner.initialize({"speed": 1.0}, 0.0, None)
        assert runner.get(["speed", "gear", "der(x)"]) == pytest.approx([1, 1, 1])
        for value in (3.0, -1.0):
            refused("rror", runner.set, {"gear": value}, error=Exception)
        read = runner.inner.getReal if fmi == "2.0" else runner.inner.getFloat64
        refused("rror", read, [unit.references["speed"]], error=Exception)


def test_enumerations_of_nothing_are_refused(tmp_path):
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0)
    with pytest.raises(pam.InputError, match="no variable has codes"):
        export_fmu(plant, tmp_path / "p.fmu", platforms="native", enumerations=True)


def test_the_status_of_an_mpc_is_an_enumeration(fmi, tmp_path):
    """Its values against the block's own step, at rest and after a jump of what is wanted."""
    rate, plant = dict.fromkeys(COMMANDS, 0.1), benchmark_slide()
    mpc = pam.Mpc(plant, horizon=2, sample_time=5e-3, track={"x": 1.0}, rate=rate, iterations=1)
    made = block(mpc, plant=plant)
    unit = sound(made, tmp_path, fmi, booleans=True, enumerations=True)
    assert unit.variables["solver.status"].type == "Enumeration"
    kind = unit.variables["solver.status"].declaredType
    assert [i.name for i in kind.items] == ["solved", "unfinished", "failed", "fallback"]
    place = [v.name for v in made.outputs].index("solver.status")
    wanted = [v.name for v in made.inputs].index("wanted.x")
    memory, inputs = made.start("memory"), made.start("inputs")
    seen = []
    with Runner(unit, "CoSimulation") as runner:
        runner.initialize({}, 0.0, None)
        for k in range(6):
            inputs[wanted] = 0.0 if k < 3 else 0.01
            runner.set({"wanted.x": inputs[wanted]})
            runner.step(k * 5e-3, 5e-3)
            memory, told = made.step(memory, inputs, made.start("parameters"))
            seen.append(float(told[place]))
            assert runner.get(["solver.status"]) == [seen[-1]]
    assert {0.0, 1.0} == set(seen)


# ---- single precision ---------------------------------------------------------------------------


def test_a_unit_of_single_precision_computes_with_floats(tmp_path):
    """A PI law with a limit, by NumPy's float32 in the same order, to the last bit."""
    m, x, k = (ca.SX.sym(n, size) for n, size in (("m", 1), ("x", 1), ("k", 2)))
    error = 0.1 - x
    u = ca.fmax(k[0] * error + m, -2.0)
    step = ca.Function("step", [m, x, k], [m + k[1] * error, ca.vertcat(u, u * u / 3)])
    gains = (
        pam.Variable("kp", "parameter", start=7.3, max=9),
        pam.Variable("ki", "parameter", start=0.07, max=0.1),
    )
    outputs = (pam.Variable("u", "output"), pam.Variable("power", "output"))
    memory = (pam.Variable("sum", "state", start=0.3),)
    law = Block("law", STEP, (pam.Variable("x", "input"),), outputs, gains, memory, step)
    single: dict[str, Any] = {"fmi": "3.0", "precision": "single"}
    unit, f = sound(law, tmp_path, **single), np.float32
    assert unit.typed == dict.fromkeys(["x", "kp", "ki", "u", "power"], "Float32")
    total, rng = f(0.3), np.random.default_rng(4)
    with Runner(unit, "CoSimulation") as runner:
        runner.initialize({"kp": 5.9}, 0.0, None)
        for i in range(20):
            x_ = f(rng.normal())
            runner.set({"x": float(x_)})
            runner.step(i * STEP, STEP)
            off = f(f(0.1) - x_)
            sent = np.maximum(f(f(f(5.9) * off) + total), f(-2.0))
            total = f(total + f(f(0.07) * off))
            assert list(runner.get(["u", "power"])) == [sent, f(f(sent * sent) / f(3))]
        refused("rror", runner.inner.getFloat64, [unit.references["u"]], error=Exception)
    with Runner(unit, "CoSimulation") as runner:
        runner.set({"ki": 0.1})  # the end of its range, which is 0.1 in double precision
        runner.restore(runner.save())
        refused("rror", runner.set, {"ki": 0.10001}, error=Exception)
    for words, given in {
        "FMI 2 and arrays of gains have no such numbers": {"precision": "single"},
        "only blocks compute so": {**single, "system": benchmark_slide()},
        "choose 'double' or 'single'": {"precision": "half"},
    }.items():
        refused(words, export_fmu, path=tmp_path / "l.fmu", **{"system": law, **given})


# ---- in a system --------------------------------------------------------------------------------

SSP = "{http://ssp-standard.org/SSP1/SystemStructure%s}"


def switch(late: int) -> Block:
    """On from one sample on, and the stage of the work, as codes."""
    n, nothing = ca.SX.sym("n"), ca.SX.sym("u", 0)
    on = n >= late
    step = ca.Function("step", [n, nothing, ca.SX.sym("p", 0)], [n + 1, ca.vertcat(on, 2 * on)])
    outputs = (
        pam.Variable("on", "output"),
        pam.Variable("stage", "output", codes="waiting filling moving"),
    )
    memory = (pam.Variable("n", "state", start=0.0),)
    return Block("switch", STEP, (), outputs, (), memory, step, flags={"on": {}})


def test_a_system_has_booleans_enumerations_and_arrays(feedback, fmi, tmp_path):
    """The switch drives ``enable`` as a Boolean; by FMPy's master."""
    plant = benchmark_slide()
    law = block(feedback, plant=plant, delay=1)
    goals = {f"wanted.{n}": f"goal.{n}" for n in ("x", "stiffness")} | {"enable": "switch.on"}
    wires = {f"plant.{c}": f"law.{c}" for c in COMMANDS}
    wires |= {f"law.{v.name}": goals.get(v.name, f"plant.{v.name}") for v in law.inputs}
    wanted = goal(np.array([0.0, 1.0]), np.full(2, 2e-3), np.full(2, 2.2e4))
    parts = {"law": law, "switch": switch(5), "plant": plant, "goal": wanted}
    shapes: dict[str, Any] = {"booleans": True, "enumerations": True, "matrices": fmi == "3.0"}
    shapes |= {"fmi": fmi, "platforms": "native"}
    with pytest.warns(UserWarning, match="law gets what switch gives one step"):
        path = export_ssp(parts, wires, tmp_path / "s.ssp", **shapes)
    fmpy.ssp.ssd.read_ssd(str(path))  # validates
    inside = contents(path)
    root = ElementTree.fromstring(inside["SystemStructure.ssd"])
    (tmp_path / "law.fmu").write_bytes(inside["resources/law.fmu"])
    types = {
        (part.get("name"), end.get("name")): end[0].tag.partition("}")[2]
        for part in root.iter(SSP % "Description" + "Component")
        for end in part.iter(SSP % "Description" + "Connector")
    }
    booleans = [("law", "enable"), ("law", "status.off"), ("switch", "on")]
    assert {types[end] for end in booleans} == {"Boolean"}
    assert types["switch", "stage"] == "Enumeration"
    assert types["law", "x"] == "Real"
    items = [i.attrib for i in root.iter(SSP % "Common" + "Item")]
    names = ["waiting", "filling", "moving"]
    assert items == [{"name": n, "value": str(k)} for k, n in enumerate(names)]
    variables = UnpackedFmu(tmp_path / "law.fmu", tmp_path / "law").variables
    told = {p.get("name") for p in root.iter(SSP % "ParameterValues" + "Parameter")}
    gains = {v.name for v in law.parameters if v.name.startswith("K.")}
    assert ("K" in variables, len(gains & told)) == ((True, 0) if fmi == "3.0" else (False, 8))
    with pytest.raises(InputError, match=r"plant\.muscle1\.command is in Pa"):
        export_ssp(parts, {**wires, "plant.muscle1.command": "switch.on"}, path, booleans=True)
    with pytest.raises(InputError, match=r"switch\.on is none: they do not fit"):
        export_ssp({"one": number(), "switch": switch(5)}, {"one.u": "switch.on"}, path, **shapes)
    if fmi == "2.0":  # FMPy's master knows no 3.0; what it hands over acts a step later
        found = fmpy.ssp.simulation.simulate_ssp(str(path), stop_time=0.02, step_size=STEP)
        off = found["law.status.off"]
        assert off.dtype == bool
        assert (off[3], off[-1]) == (True, False)
        assert list(found["switch.stage"][[3, -1]]) == [0, 2]


def number() -> Block:
    u = ca.SX.sym("u")
    step = ca.Function("step", [ca.SX.sym("m", 0), u, ca.SX.sym("p", 0)], [ca.SX(0, 1), u])
    ends = (pam.Variable("u", "input"),), (pam.Variable("y", "output"),)
    return Block("one", STEP, *ends, (), (), step)


def test_forms_that_no_part_of_a_system_has_are_refused(tmp_path):
    parts, path = {"plant": benchmark_slide()}, tmp_path / "s.ssp"
    refused("booleans = True: no block has flags", export_ssp, parts, {}, path, booleans=True)
    refused("FMI 2 has no arrays", export_ssp, parts, {}, path, matrices=True)
