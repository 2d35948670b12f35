"""FMUs of sampled blocks: samples at their times, saved states, clocks, closed loops, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import casadi as ca
import fmpy.ssp.simulation
import numpy as np
import pytest
from conftest import refused
from fmpy.validation import validate_fmu
from fmu_tools import VERSIONS, event_mode, opened, started
from hostile import contents

import pam_ocp as pam
from pam_ocp import ExportError, UnknownNameError
from pam_ocp.cli.main import main
from pam_ocp.core.block import Block
from pam_ocp.core.variables import Variable
from pam_ocp.export import export_fmu, export_ssp
from pam_ocp.export.runner import UnpackedFmu

PERIOD = 0.004


def pi(seed: int = 0, unit: str = "1") -> Block:
    """Two commands of opposite sign by a PI law whose gains are random, with an exponential."""
    kp, ki, level = np.random.default_rng(seed).uniform([10, 100, 0.3], [30, 400, 0.6])
    m, u, p = ca.SX.sym("m", 2), ca.SX.sym("u", 2), ca.SX.sym("p", 3)
    lost = ca.logic_not(ca.fabs(u[0]) < 1e9)
    error = ca.if_else(lost, 0, u[1] - u[0])
    asked = p[0] * error + p[1] * (m[0] + PERIOD * error)
    command = p[2] * ca.tanh(asked / p[2])
    after = ca.vertcat(m[0] + PERIOD * error, m[1] + 1)
    shown = ca.vertcat(command, -command * ca.exp(-0.1 * error), m[1] + 1, lost)
    step = ca.Function("pi", [m, u, p], [after, shown])
    inputs = Variable("x", "input", unit="m"), Variable("wanted.x", "input", unit="m", start=2e-3)
    commands = (Variable(f"muscle{i}.command", "output", unit=unit) for i in (1, 2))
    outputs = *commands, Variable("samples", "output"), Variable("missing", "output")
    parameters = (
        Variable("kp", "parameter", unit="1/m", start=kp, tunable=True),
        Variable("ki", "parameter", unit="1/(m.s)", start=ki),
        Variable("level", "parameter", start=level, min=1e-3, max=1.0),
    )
    memory = Variable("sum", "state", unit="m.s", start=0.0), Variable("n", "state", start=0.0)
    words = "a PI controller of two muscles"
    ends = inputs, outputs, parameters, memory
    return Block("pi", PERIOD, *ends, step, words, missing=("x",))


class InPython:
    """The block's own step, sampled by the rule of the documentation."""

    def __init__(self, block: Block) -> None:
        self.block, self.memory = block, block.start("memory")
        self.parameters, self.count = block.start("parameters"), 0
        self.outputs = self._called(block.start("inputs"))[1]

    def _called(self, inputs: Any) -> tuple[Any, Any]:
        found = self.block.step(self.memory, inputs, self.parameters)
        return tuple(np.asarray(v).ravel() for v in found)  # type: ignore[return-value]

    def sample(self, inputs: Any) -> Any:
        self.memory, self.outputs = self._called(inputs)
        return self.outputs

    def step(self, to: float, inputs: Any) -> Any:
        while self.count * PERIOD < to - 1e-6 * PERIOD:
            self.sample(inputs)
            self.count += 1
        return self.outputs


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UnpackedFmu]:
    folder = tmp_path_factory.mktemp("sampled")
    found = {fmi: opened(pi(), folder, fmi) for fmi in VERSIONS}
    for fmi in VERSIONS:
        assert validate_fmu(str(folder / f"{fmi[0]}.fmu")) == []
    return found


NAMES = [v.name for v in pi().outputs]


@pytest.mark.parametrize("size", [PERIOD, PERIOD / 3, 2.5 * PERIOD, 0.00137, 0.031])
@pytest.mark.parametrize("start", [0.0, 17.3])
def test_whatever_the_steps_the_samples_are_those_of_python(units, fmi, size, start):
    rng, here = np.random.default_rng(round(size * 1e6)), InPython(pi())
    with started(units[fmi], "CoSimulation", time=start) as there:
        for k in range(60):
            x = float(rng.uniform(-3e-3, 3e-3)) if k % 7 else np.nan
            there.set({"x": x})
            there.step(start + k * size, size)
            found = there.get(NAMES)
            assert found == pytest.approx(here.step((k + 1) * size, [x, 2e-3]), rel=1e-13)


def test_memory_is_no_variable_and_comes_back_with_the_state(units, fmi):
    unit = units[fmi]
    assert not {"sum", "n"} & set(unit.variables)
    with started(unit, "CoSimulation") as first, started(unit, "CoSimulation") as second:
        for k in range(9):
            first.set({"x": 1e-3 * k})
            first.step(k * 0.003, 0.003)
        two = fmi == "2.0"
        state = first.inner.getFMUstate() if two else first.inner.getFMUState()
        if two:
            data = first.inner.serializeFMUstate(state)
            second.inner.setFMUstate(second.inner.deSerializeFMUstate(data))
        else:
            data = first.inner.serializeFMUState(state)
            second.inner.setFMUState(second.inner.deserializeFMUState(data))
        for runner in (first, second):
            runner.step(0.027, 0.01)
        assert list(second.get(NAMES)) == list(first.get(NAMES))


def test_ticks_of_the_clock_close_the_loop_without_a_delay(units):
    """FMI 3 with event mode: measurement and command belong to one instant, as in Python."""
    unit, here = units["3.0"], InPython(pi())
    clock = [unit.references["clock"]]
    inputs, outputs = ([unit.references[n] for n in names] for names in (("x", "wanted.x"), NAMES))
    inner = event_mode(unit)
    inner.enterInitializationMode(startTime=0.0)
    inner.exitInitializationMode()
    x = 0.0
    for k in range(40):
        inner.setClock(clock, [True])
        inner.setFloat64(inputs, [x, 2e-3])
        found = inner.getFloat64(outputs)
        assert found == pytest.approx(here.sample([x, 2e-3]), rel=1e-13)
        inner.updateDiscreteStates()
        inner.enterStepMode()
        inner.doStep(k * PERIOD, PERIOD)
        inner.enterEventMode()
        x = 0.9 * x + 1e-4 * found[0]
    inner.terminate()
    inner.freeInstance()


def test_a_reference_that_is_no_number_and_a_late_fixed_parameter_are_refused(units, fmi):
    with started(units[fmi], "CoSimulation") as runner:
        for values in ({"wanted.x": np.nan}, {"x": np.inf}, {"ki": 3.0}, {"level": 0.5}):
            refused("rror", runner.set, values, error=Exception)
        runner.set({"kp": 0.0})
        runner.step(0.0, PERIOD)


# ---- closed loop --------------------------------------------------------------------------------


def plant_with_valves(kind: str) -> pam.Plant:
    """Spool valves with a dead zone, and muscles with memory."""
    muscle = pam.muscle("DMSP-20-200N")
    feed = pam.feeds.SpoolValve(overlap=0.03)
    losses = pam.losses.PrandtlIshlinskii(edge=0.02)
    if kind == "slide":
        plant = pam.AntagonisticSlide(muscle, 2.0, losses=losses, feed=feed)
    else:
        plant = pam.AntagonisticJoint(muscle, losses=losses, feed=feed)
    return plant.with_values({"muscle1.pressure": 2.5e5, "muscle2.pressure": 2.5e5})


def motion_to(x: float, plant: pam.Plant) -> pam.Trajectory:
    return pam.Trajectory([0.0, 1.0], {"x": [x, x]}, [plant.variables[0]])


def stepped(plant: pam.Plant) -> Any:
    """(states, inputs) -> states one period later, by CVODES at 1e-13."""
    scale, p = plant.vector("state", None, "nominal"), plant.vector("parameter")
    z, u = ca.SX.sym("z", len(scale)), ca.SX.sym("u", len(plant.inputs))
    ode = plant.function(z * scale, u, p)[0] / scale
    options = {"reltol": 1e-13, "abstol": 1e-13, "max_num_steps": 100_000}
    flow = ca.integrator("flow", "cvodes", {"x": z, "p": u, "ode": ode}, 0, PERIOD, options)
    return lambda x, u: np.asarray(flow(x0=x / scale, p=u)["xf"]).ravel() * scale


@pytest.mark.parametrize("kind", ["slide", "joint"])
def test_a_loop_through_valves_and_memory_is_that_of_python_to_1e_9(kind, tmp_path):
    """FMPy's exchange: all parts step, then all hand over; what is connected begins at 0."""
    plant = plant_with_valves(kind)
    position = plant.states[0]
    block = pi() if kind == "slide" else in_angles(pi())
    motion = pam.Trajectory([0.0, 1.0], {position.name: [2e-3, 2e-3]}, [position])
    wires = {f"plant.{n}": f"pi.{n}" for n in ("muscle1.command", "muscle2.command")}
    wires |= {"pi.x": f"plant.{position.name}", "pi.wanted.x": f"motion.{position.name}"}
    parts, how = {"pi": block, "motion": motion, "plant": plant}, {"platforms": "native"}
    path = export_ssp(parts, wires, tmp_path / "loop.ssp", tolerance=1e-11, **how)
    steps = 100
    stop = (steps - 0.5) * PERIOD
    found = fmpy.ssp.simulation.simulate_ssp(str(path), stop_time=stop, step_size=PERIOD)
    here, flow = InPython(block), stepped(plant)
    x, commands, seen, wanted, rows = plant.vector("state"), np.zeros(2), 0.0, 0.0, []
    for _ in range(steps):
        sent = here.sample([seen, wanted])
        x = flow(x, commands)
        commands, seen, wanted = sent[:2], x[0], 2e-3
        rows.append([*x, *sent])
    names = [*(f"plant.{v.name}" for v in plant.states), *(f"pi.{n}" for n in NAMES)]
    there = np.array([found[n] for n in names]).T[-steps:]
    scale = [*plant.vector("state", None, "nominal"), *np.ones(len(NAMES))]
    assert np.ptp(np.array(rows)[:, 0]) > 1e-3
    assert np.max(np.abs(there - rows) / scale) < 1e-9


def in_angles(block: Block) -> Block:
    inputs = tuple(replace(v, unit="rad", display_unit="") for v in block.inputs)
    return replace(block, inputs=inputs)


def test_a_system_tells_its_units_its_places_and_its_master(tmp_path):
    plant = plant_with_valves("slide")
    wires = {f"antagonistic_slide.{v.name}": f"pi.{v.name}" for v in plant.inputs}
    wires |= {"pi.x": "antagonistic_slide.x", "pi.wanted.x": "motion.x"}
    parts = [plant, pi(), motion_to(1e-3, plant)]
    path = export_ssp(parts, wires, tmp_path / "s.ssp", fmi="3.0", platforms="native")
    fmpy.ssp.ssd.read_ssd(str(path))  # validates
    inside = contents(path)
    text = inside["SystemStructure.ssd"].decode()
    for part in (
        'name="x" kind="input">\n            <ssc:Real unit="m" />',
        f'<oms:FixedStepMaster description="oms-ma" stepSize="{PERIOD}"',
        "<ssd:ElementGeometry x1=",
        "<ssd:ConnectorGeometry x=",
        '<ssc:Unit name="Pa">',
    ):
        assert part in text
    (tmp_path / "pi.fmu").write_bytes(inside["resources/pi.fmu"])
    assert fmpy.read_model_description(str(tmp_path / "pi.fmu")).fmiVersion == "3.0"


@pytest.mark.parametrize(("version", "fmi"), [("1.0", "3.0"), ("2.0", "2.0"), ("2.0", "3.0")])
def test_ssp_2_has_the_name_spaces_of_1_and_the_types_of_fmi_3(version, fmi, tmp_path):
    """As the schemas of SSP 2.0 say: SystemStructureDescription, ParameterValues, Common."""
    plant = plant_with_valves("slide")
    wires = {f"plant.{v.name}": f"pi.{v.name}" for v in plant.inputs}
    wires |= {"pi.x": "plant.x", "pi.wanted.x": "plant.x"}
    options = {"fmi": fmi, "version": version, "platforms": "native"}
    path = export_ssp({"plant": plant, "pi": pi()}, wires, tmp_path / "s.ssp", **options)
    root = ElementTree.fromstring(contents(path)["SystemStructure.ssd"])
    space = "http://ssp-standard.org/SSP1/SystemStructure"
    assert root.tag == f"{{{space}Description}}SystemStructureDescription"
    sets = list(root.iter(f"{{{space}ParameterValues}}ParameterSet"))
    assert [e.get("version") for e in (root, *sets)] == [version] * 3
    kind = "Float64" if (version, fmi) == ("2.0", "3.0") else "Real"
    connectors = list(root.iter(f"{{{space}Description}}Connector"))
    assert {c[0].tag for c in connectors} == {f"{{{space}Common}}{kind}"}
    parameters = list(root.iter(f"{{{space}ParameterValues}}Parameter"))
    assert {p[0].tag for p in parameters} == {f"{{{space}ParameterValues}}{kind}"}
    with pytest.raises(UnknownNameError, match="SSP version"):
        export_ssp({"plant": plant, "pi": pi()}, wires, tmp_path / "t.ssp", version="1.1")


# ---- refused ------------------------------------------------------------------------------------


def test_systems_that_do_not_fit_are_refused_in_a_sentence(tmp_path):
    plant, path = plant_with_valves("slide"), tmp_path / "s.ssp"
    wires = {f"plant.{v.name}": f"pi.{v.name}" for v in plant.inputs}
    wires |= {"pi.x": "plant.x", "pi.wanted.x": "motion.x"}
    parts = {"plant": plant, "pi": pi(), "motion": motion_to(1e-3, plant)}

    def unfit(match: str, changed: dict[str, Any], **options: Any) -> None:
        refused(match, export_ssp, {**parts, **changed}, wires, path, **options)
        assert not path.exists()

    slower = replace(pi(), name="slower", sample_time=0.01)
    unfit("sample times differ: pi 0.004 s, slow 0.01 s", {"slow": slower})
    unfit("muscle1.command is in 1, but pi.muscle1.command is in Pa", {"pi": pi(unit="Pa")})
    unfit("step_size = 0.003 s does not go into the sample time", {}, step_size=0.003)
    unfit("input of the system.*plant.muscle1.command", {"plant": motion_to(1e-3, plant)})
    del wires["pi.x"]
    unfit("nothing leads to pi.x", {})


def test_blocks_that_cannot_run_in_a_tool_are_refused(tmp_path):
    refused("below 1e-06 s", export_fmu, replace(pi(), sample_time=1e-7), tmp_path / "a.fmu")
    refused("inputs: a block has none", export_fmu, pi(), tmp_path / "a.fmu", inputs=["x"])
    refused("tolerance: a block has none", export_fmu, pi(), tmp_path / "a.fmu", tolerance=1e-4)
    m = ca.MX.sym("m", 0), ca.MX.sym("u", 1), ca.MX.sym("p", 0)
    problem = {"x": ca.MX.sym("x"), "p": ca.MX.sym("p")}
    problem["f"] = (problem["x"] - problem["p"]) ** 2
    solver = ca.nlpsol("s", "ipopt", problem, {"print_time": 0})
    step = ca.Function("s", m, [ca.MX(0, 1), solver(p=m[1])["x"]])
    ends = (Variable("u", "input"),), (Variable("y", "output"),)
    unbounded = Block("unbounded", 0.1, *ends, (), (), step)
    with pytest.raises(ExportError, match="unbounded"):
        export_fmu(unbounded, tmp_path / "a.fmu", platforms="native")
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_writes_a_system_from_its_file(tmp_path, capsys):
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))
    motion_to(1e-3, plant).save(tmp_path / "motion.npz")
    (tmp_path / "mine.py").write_text(
        "import pam_ocp as pam\n"
        "from pam_ocp.control import block\n"
        "plant = pam.AntagonisticSlide(pam.muscle('DMSP-20-200N'))\n"
        "law = pam.lqr(plant, plant.equilibrium(x=0.0, stiffness=2e4), sample_time=0.002)\n"
        "def controller():\n    return block(law)\n"
    )
    (tmp_path / "s.toml").write_text(
        'stop_time = "100 ms"\n[components]\nmotion = "motion.npz"\n'
        'controller = "mine.py:controller"\n[components.plant]\n'
        'arrangement = "AntagonisticSlide"\nmuscle = "DMSP-20-200N"\n[connections]\n'
        + "".join(f'"plant.{c}.command" = "controller.{c}.command"\n' for c in MUSCLES)
        + "".join(f'"controller.{n}" = "plant.{n}"\n' for n in ("x", "v"))
        + "".join(f'"controller.{c}.pressure" = "plant.{c}.pressure"\n' for c in MUSCLES)
        + '"controller.enable" = "plant.x"\n'
    )
    arguments = ["export", str(tmp_path / "s.toml"), "--platform", "native"]
    target = tmp_path / "s.ssp"
    assert main([*arguments, "--out", str(target)]) == 2
    assert "--allow-code" in capsys.readouterr().err
    assert main([*arguments, "--out", str(target), "--allow-code"]) == 2
    assert "controller.enable is in 1, but plant.x is in m" in capsys.readouterr().err
    text = (tmp_path / "s.toml").read_text().replace('"plant.x"\n', '"controller.status"\n')
    text = text.replace('"controller.x" = "controller.status"', '"controller.x" = "plant.x"')
    (tmp_path / "s.toml").write_text(text)
    assert main([*arguments, "--out", str(target), "--allow-code"]) == 0
    fmpy.ssp.ssd.read_ssd(str(target))
    text = text.replace('"controller.status"', '"controller.status.off"')
    (tmp_path / "s.toml").write_text(f"booleans = true\n{text}")
    assert main([*arguments, "--out", str(target), "--allow-code"]) == 0
    text = contents(target)["SystemStructure.ssd"]
    assert text.count(b"<ssc:Boolean />") == 7  # enable, 6 bits


MUSCLES = ("muscle1", "muscle2")
