"""What an FMU says of itself: types, terminals, words, references, shared parameters."""

from __future__ import annotations

import math
import posixpath
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, refused
from fmpy.validation import validate_fmu
from fmu_tools import VERSIONS, event_mode, exported, opened
from hostile import contents
from lxml import etree

import pam_ocp as pam
from pam_ocp.export import export_fmu

SCHEMAS = Path(fmpy.__file__).parent / "schema/fmi3"
SAID = {"author": "A. Author", "version": "7", "copyright": "(c) somebody", "license": "CC BY 4.0"}
DATE = "2026-03-01T12:00:00+01:00"


def motion() -> pam.Trajectory:
    commands = {f"muscle{i}.command": (2.0 + i) * BAR for i in (1, 2)}
    return pam.simulate(benchmark_slide(), commands, t=np.linspace(0, 0.1, 11))


@pytest.fixture(scope="module", params=VERSIONS)
def unit(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    more = {**SAID, "date": DATE, "reference": motion(), "share": True}
    path = exported(benchmark_slide(), tmp_path_factory.mktemp("said"), request.param, **more)
    assert validate_fmu(str(path)) == []
    return path


def read(unit: Path, name: str = "modelDescription.xml") -> Any:
    return ElementTree.fromstring(contents(unit)[name])


def test_words_about_the_model_stand_in_its_description(unit):
    root = read(unit)
    assert {name: root.get(name) for name in SAID} == SAID
    assert root.get("generationDateAndTime") == "2026-03-01T11:00:00Z"
    assert root.get("generationTool").startswith("pam_ocp ")


def test_each_quantity_is_declared_once_with_unit_and_range(unit):
    root, declared = read(unit), {}
    for type_ in root.find("TypeDefinitions"):
        about = type_.attrib if type_.tag == "Float64Type" else type_[0].attrib
        declared[type_.get("name")] = {k: v for k, v in about.items() if k != "name"}
    kinds = [tuple(sorted(v.items())) for v in declared.values()]
    assert len(set(kinds)) == len(kinds)
    for variable in root.find("ModelVariables"):
        about = variable[0].attrib if len(variable) else variable.attrib
        if variable.get("causality") == "independent":
            continue
        known = declared[about["declaredType"]]
        for name in ("unit", "displayUnit", "min", "max"):
            assert about.get(name) == known.get(name)


def test_every_parameter_has_a_largest_value_which_is_kept(unit):
    described = fmpy.read_model_description(str(unit))
    parameters = [v for v in described.modelVariables if v.causality == "parameter"]
    assert parameters
    for v in parameters:
        assert math.isfinite(float(v.max))
        assert float(v.max) >= 9 * abs(float(v.start)) or v.name == "pre_contraction"
    with pytest.raises(Exception, match="rror"):
        fmpy.simulate_fmu(str(unit), stop_time=0.01, start_values={"mass": 1e7})


@pytest.mark.parametrize(
    ("file", "schema"),
    [
        ("terminalsAndIcons/terminalsAndIcons.xml", "fmi3TerminalsAndIcons.xsd"),
        ("sources/buildDescription.xml", "fmi3BuildDescription.xsd"),
    ],
)
def test_neighbours_follow_their_schemas_in_both_versions(unit, file, schema):
    inside = contents(unit)
    document = etree.fromstring(inside[file])
    etree.XMLSchema(file=str(SCHEMAS / schema)).assertValid(document)
    for picture in document.iter("TerminalGraphicalRepresentation"):
        assert f"terminalsAndIcons/{picture.get('iconBaseName')}.png" in inside


def test_terminals_of_muscles_match_by_name_and_have_a_place(unit):
    root = read(unit, "terminalsAndIcons/terminalsAndIcons.xml")
    found = {t.get("name"): t for t in root.iter("Terminal")}
    assert {"muscle1", "muscle2"} < set(found)
    for name in ("muscle1", "muscle2"):
        assert found[name].get("matchingRule") == "bus"
        assert found[name].get("terminalKind") == "org.pam_ocp.muscle"
        members = {m.get("memberName") for m in found[name].iter("TerminalMemberVariable")}
        assert {"command", "pressure", "force"} <= members
    corners, drawn = ("x1", "y1", "x2", "y2"), root.iter("TerminalGraphicalRepresentation")
    assert len({tuple(p.get(c) for c in corners) for p in drawn}) == len(found)


def test_the_reference_motion_is_found_by_its_layered_standard(unit):
    folder = "extra/org.fmi-standard.fmi-ls-ref"
    space = "{http://fmi-standard.org/fmi-ls-manifest}"
    manifest = read(unit, f"{folder}/fmi-ls-manifest.xml")
    assert manifest.get(f"{space}fmi-ls-name") == "org.fmi-standard.fmi-ls-ref"
    for related in manifest.iter("Related"):
        assert posixpath.normpath(f"{folder}/{related.get('source') or ''}") in contents(unit)
    (experiment,) = read(unit, f"{folder}/experiments.xml")
    assert float(experiment.get("stopTime")) == 0.1
    assert [e.tag for e in experiment] == ["Stimuli", "References"]


def test_equal_muscles_share_parameters_and_move_as_before(unit, tmp_path):
    described = fmpy.read_model_description(str(unit))
    kinds = {v.name: v.causality for v in described.modelVariables}
    assert kinds["muscle.a1"] == "parameter"
    assert kinds["muscle1.a1"] == kinds["muscle2.a1"] == "calculatedParameter"
    commands = {"muscle1.command": 3.5 * BAR, "muscle2.command": 1.5 * BAR}
    asked = {"stop_time": 0.1, "output_interval": 0.01, "fmi_type": "CoSimulation"}
    asked["start_values"] = {"muscle.rest_length": 0.21, **commands}
    found = fmpy.simulate_fmu(str(unit), output=["x", "muscle2.rest_length"], **asked)
    shorter = benchmark_slide().with_values({f"muscle{i}.rest_length": 0.21 for i in (1, 2)})
    here = pam.simulate(shorter, commands, t=found["time"])
    assert np.ptp(here["x"]) > 1e-4
    assert found["x"] == pytest.approx(here["x"], abs=1e-7)
    assert set(found["muscle2.rest_length"]) == {0.21}


def test_muscles_that_differ_keep_their_own(tmp_path):
    plant = benchmark_slide().with_values({"muscle1.a3": -30.0})
    path = export_fmu(plant, tmp_path / "s.fmu", platforms="source", share=True)
    kinds = {v.name: v.causality for v in fmpy.read_model_description(str(path)).modelVariables}
    assert kinds["muscle1.a3"] == kinds["muscle2.a3"] == "parameter"
    assert kinds["muscle2.a1"] == "calculatedParameter"


def test_in_event_mode_a_jump_of_a_command_shows_at_once(tmp_path):
    """FMI 3 Co-Simulation: with an ideal feed the force follows the command within the event."""
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), feed=pam.feeds.IdealPressure())
    unit = opened(plant, tmp_path, "3.0")
    command, force = ([unit.references[f"muscle1.{n}"]] for n in ("pressure", "force"))
    inner = event_mode(unit)
    inner.enterInitializationMode()
    inner.setFloat64(command, [2e5])
    inner.exitInitializationMode()
    inner.updateDiscreteStates()
    inner.enterStepMode()
    inner.doStep(0.0, 1e-3)
    before = inner.getFloat64(force)[0]
    inner.enterEventMode()
    inner.setFloat64(command, [4e5])
    assert inner.getFloat64(force)[0] > before + 50.0
    inner.updateDiscreteStates()
    inner.enterStepMode()
    inner.doStep(1e-3, 1e-3)
    inner.terminate()
    inner.freeInstance()


def test_words_that_cannot_be_meant_are_refused(tmp_path):
    for said, match in (
        ({"author": "two\nlines"}, "author = .* give one line"),
        ({"date": "yesterday"}, "date = 'yesterday': give a datetime or ISO 8601"),
        ({"share": "no"}, "share = 'no': give True or False"),
        ({"reference": 3, "platforms": "source"}, "reference = 3: give a Trajectory or None"),
    ):
        refused(match, export_fmu, benchmark_slide(), tmp_path / "s.fmu", **said)
    assert list(tmp_path.iterdir()) == []
