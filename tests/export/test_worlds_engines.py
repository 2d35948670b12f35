"""Muscles in MuJoCo and Modelica, and alone as an FMU."""

import dataclasses
import re
import xml.etree.ElementTree as ET

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from hostile import replaced

import pam_ocp as pam
from pam_ocp.export.worlds.modelica import RESERVED, identifiers

MUSCLE = "DMSP-20-300"
REST, PRE = 0.3, 0.1
BARS = {"muscle1.command": 3e5, "muscle2.command": 2e5}


# ---- MuJoCo --------------------------------------------------------------------------------------


def slide_in(feed, losses=()):
    """Two muscles on a slide: one by joint, one by sites; as the plant has them."""
    muscle, length = pam.muscle(MUSCLE), REST * (1 - PRE)
    made = pam.export.MujocoMuscle
    return [
        made("muscle1", muscle, {"x": -1.0}, feed, losses, offset=length),
        made("muscle2", muscle, ["wall", "cart"], feed, losses, offset=length - 0.5),
    ]


WORLD = """<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 0"/><worldbody>
<site name="wall" pos="-0.5 0 0"/><body><joint name="x" type="slide" axis="1 0 0" damping="20"/>
<geom type="box" size=".05 .05 .05" mass="2"/><site name="cart"/></body></worldbody>
{muscles}</mujoco>"""


@pytest.mark.parametrize(
    ("feed", "losses", "commands", "step"),
    [
        (pam.feeds.Regulator(0.05), (), BARS, 1e-3),
        (pam.feeds.Regulator(0.05), (pam.losses.BoucWen(20.0, 0.005),), BARS, 1e-3),
        (pam.feeds.SpoolValve(), (), {"muscle1.command": 0.2, "muscle2.command": -0.1}, 5e-4),
        (pam.feeds.OnOffValves(), (), {"muscle1.fill": 0.3, "muscle2.vent": 0.2}, 5e-4),
    ],
)
def test_a_slide_moves_in_mujoco_as_in_simulate(feed, losses, commands, step):
    mujoco = pytest.importorskip("mujoco")
    made = pam.export(slide_in(feed, losses), world="mujoco")
    model = mujoco.MjModel.from_xml_string(WORLD.format(step=step, muscles=made.mjcf()))
    data = mujoco.MjData(model)
    made.reset(model, data, commands)
    steps, path = round(0.5 / step), []
    with made.installed(model):
        for _ in range(steps):
            mujoco.mj_step(model, data)
            path.append([data.qpos[0], data.qvel[0]])
        mujoco.mj_forward(model, data)
    parts = {"feed": feed, "losses": losses, "damping": 20.0}
    plant = pam.AntagonisticSlide(MUSCLE, mass=2.0, pre_contraction=PRE, **parts)
    truth = pam.simulate(plant, commands, t=np.arange(steps + 1) * step)
    found = np.array(path)
    for i, name in enumerate(("x", "v")):
        off = np.abs(found[:, i] - truth[name][1:]) / plant.variable(name).nominal
        assert np.max(off) < 1e-3
    force = data.sensor("muscle1.force").data[0]
    assert np.isclose(-force, truth["muscle1.force"][-1], rtol=1e-3)
    assert mujoco.get_mjcb_act_dyn() is None


def test_mjcf_goes_into_a_model_or_stands_alone(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    muscles = slide_in(pam.feeds.Regulator(0.05))
    whole = tmp_path / "model.xml"
    whole.write_text(WORLD.format(step=1e-3, muscles=""))
    made = pam.export(muscles, tmp_path / "with.xml", model=whole)
    model = mujoco.MjModel.from_xml_path(str(made))
    assert (model.nu, model.na, model.ntendon, model.nsensor) == (2, 2, 2, 6)
    alone = ET.parse(pam.export.export_mjcf(muscles, tmp_path / "m.xml"))
    assert alone.getroot().tag == "mujocoinclude"


def test_what_mujoco_cannot_do_is_told(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    made = pam.export.to_mujoco(slide_in(pam.feeds.Regulator(1e-3)))
    text = WORLD.format(step=0.01, muscles=made.mjcf())
    model = mujoco.MjModel.from_xml_string(text)
    with (
        pytest.raises(pam.InputError, match=r"timestep = 0.01 s is too long.*0.0025 s"),
        made.installed(model),
    ):
        pass
    refused("give MujocoMuscle", pam.export.to_mujoco, [pam.muscle(MUSCLE)])
    with pytest.raises(pam.InputError, match="has no actuator 'muscle1'"):
        made.reset(mujoco.MjModel.from_xml_string("<mujoco/>"), None)
    (tmp_path / "no.xml").write_text("<robot/>")
    with pytest.raises(pam.InputError, match="no MJCF"):
        pam.export.export_mjcf(made.muscles, tmp_path / "m.xml", model=tmp_path / "no.xml")
    assert not (tmp_path / "m.xml").exists()


# ---- Modelica ------------------------------------------------------------------------------------


@pytest.fixture
def pymoca(monkeypatch):
    """Another reader of Modelica, with the functions that CasADi calls otherwise."""
    parser = pytest.importorskip("pymoca.parser")
    from pymoca.backends.casadi import generator

    monkeypatch.setattr(ca.MX, "__div__", ca.MX.__truediv__, raising=False)
    monkeypatch.setattr(ca.MX, "noEvent", lambda self: self, raising=False)
    for name in ("asin", "acos", "atan", "asinh", "acosh", "atanh"):
        other = getattr(ca.MX, name.replace("a", "arc", 1))
        monkeypatch.setattr(ca.MX, name, other, raising=False)
    return lambda text, name: generator.generate(parser.parse(text), name)


PLANTS = {
    "hanging": lambda m: pam.HangingLoad(m, 5.0, losses=pam.losses.BoucWen(20.0, 0.005)),
    "valve": lambda m: pam.HangingLoad(m, 5.0, feed=pam.feeds.SpoolValve()),
    "joint": lambda m: pam.AntagonisticJoint(m, feed=pam.feeds.Regulator(0.05, max_rate=1e6)),
}


@pytest.mark.parametrize("kind", PLANTS)
def test_another_reader_finds_the_same_slopes_in_the_modelica_source(kind, pymoca, tmp_path):
    plant = PLANTS[kind](pam.muscle(MUSCLE))
    path = pam.export(plant, tmp_path / "plant.mo")
    text = path.read_text("utf-8")
    model = pymoca(text, re.match(r"model (\w+)", text)[1])
    names = identifiers([v.name for v in plant.variables], RESERVED)
    x, u, p = (plant.vector(c) for c in ("state", "input", "parameter"))
    x = x + 1e-3 * plant.vector("state", attribute="nominal")
    xdot, y, _ = (np.ravel(r) for r in plant.function(x, u, p))
    groups, numbers = (plant.states, plant.inputs, plant.parameters, plant.outputs), (x, u, p, y)
    values = {}
    for group, some in zip(groups, numbers, strict=True):
        values |= {names[v.name]: n for v, n in zip(group, some, strict=True)}
    values |= {f"der({names[v.name]})": n for v, n in zip(plant.states, xdot, strict=True)}
    groups = (model.states, model.der_states, model.alg_states, model.inputs, model.parameters)
    symbols = {v.symbol.name(): v.symbol for group in groups for v in group}
    shared = [n for n in symbols if n not in values]
    residual = ca.Function("r", list(symbols.values()), [ca.vertcat(*model.equations)])
    for i, name in enumerate(shared):  # each is given by those before it
        values |= dict.fromkeys(shared[i:], 0.0)
        values[name] = -float(residual(*(values[n] for n in symbols))[i])
    left = np.ravel(residual(*(values[n] for n in symbols)))[len(shared) :]
    wanted = np.concatenate([xdot, y])
    assert len(left) == len(wanted)
    np.testing.assert_allclose(left / (np.abs(wanted) + 1e-6), 0.0, atol=1e-9)


def test_a_muscle_is_a_component_with_flanges_and_a_port(pymoca, tmp_path):
    path = pam.export(pam.muscle(MUSCLE), tmp_path / "Muscle.mo")
    text = path.read_text("utf-8")
    model = pymoca(text, "DMSP20300.Muscle")
    names = {v.symbol.name() for v in (*model.states, *model.alg_states, *model.inputs)}
    assert {"flange_a.f", "flange_b.s", "port.m_flow", "port.p", "force", "volume"} <= names
    assert "Mach. Theory 85 (2015)" in text
    assert "flange_b.f = force;" in text
    with pytest.raises(pam.InputError, match="has no diameter"):
        pam.export(pam.Muscle(pam.muscle(MUSCLE).law, rest_length=0.3), tmp_path / "other.mo")


@pytest.mark.parametrize("name", ["my model", "2nd", "a-b", "model", "Übung", ""])
def test_a_model_gets_no_name_that_modelica_does_not_take(name, tmp_path):
    for system in (pam.muscle(MUSCLE), pam.HangingLoad(MUSCLE)):
        refused("name = .* is none of a Modelica model", pam.export.export_modelica, system,
                tmp_path / "m.mo", name=name)  # fmt: skip
    assert not (tmp_path / "m.mo").exists()


def test_names_of_the_language_are_written_otherwise(tmp_path):
    plant = pam.Plant("real")
    for name in ("Real", "der", "time"):
        x = plant.state(name)
        plant.der(x, -x)
    text = pam.export.export_modelica(plant, tmp_path / "m.mo").read_text("utf-8")
    assert text.startswith("model MReal")
    assert all(f"der({n}_2) = -{n}_2;" in text for n in ("Real", "der", "time"))
    piece = dataclasses.replace(pam.muscle(MUSCLE), name="Übungsmuskel")
    text = pam.export.export_modelica(piece, tmp_path / "m.mo").read_text("utf-8")
    assert re.match(r"package [A-Za-z]\w* ", text, re.ASCII)


# ---- a muscle alone ------------------------------------------------------------------------------


def test_a_muscle_alone_pulls_as_its_law_says():
    muscle = pam.muscle(MUSCLE)
    alone = pam.plants.muscle_alone(muscle, feed=pam.feeds.IdealPressure())
    given = {"muscle.length": 0.27, "muscle.pressure": 3e5}
    run = pam.simulate(alone, given, duration=0.01)
    assert np.isclose(run["muscle.force"][-1], muscle.force(3e5, 0.1), rtol=1e-12)
    longer = alone.with_values({"muscle.rest_length": 0.6})
    run = pam.simulate(longer, given | {"muscle.length": 0.54}, duration=0.01)
    assert np.isclose(run["muscle.force"][-1], muscle.force(3e5, 0.1), rtol=1e-12)


@pytest.mark.slow
def test_check_compares_start_values_of_binary_and_description(tmp_path):
    path = pam.export.export_muscle(MUSCLE, tmp_path / "muscle.fmu", platforms=["native"])
    assert pam.check_fmu(path).ok
    for old, new, said in (
        ('start="0.3"', 'start="0.31"', "muscle.length is 0.3 at the start"),
        ('max="0.6" nominal="0.078"', 'max="0.2" nominal="0.078"', "outside of 0 .. 0.2"),
    ):
        other = replaced(path, tmp_path / "other.fmu", "modelDescription.xml", old, new)
        assert any(said in finding for finding in pam.check_fmu(other).findings)
