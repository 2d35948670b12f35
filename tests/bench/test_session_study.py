"""The study file of a session repeats what the page shows: the same figures from ``run_study``."""

import ast
import re

import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.bench.jobs import control as jobs
from pam_ocp.bench.jobs.motion import first_motion, motion_figures, plan_of
from pam_ocp.bench.made import World, muscle_of, plant_of, table_of
from pam_ocp.bench.script import PLATFORMS, script_of
from pam_ocp.bench.session import EMPTY, Session
from pam_ocp.bench.study import save_muscle_file, study_of
from pam_ocp.export.compile import native, platforms_named
from pam_ocp.studies import run_study
from pam_ocp.studies.study_file import read_study

SLIDE = {
    **EMPTY,
    "muscle": {"kind": "catalogue", "name": "DMSP-20-200N", "rest_length": None},
    "plant": {"arrangement": "AntagonisticSlide", "mass": 2.5},
    "point": {"x": 0.004, "stiffness": 2.2e4},
}
STUDY = {"step": 0.003, "duration": 0.08, "push": 12.0, "push_from": 0.03, "noise": 1e-5}


def law(kind, number, study=STUDY, sample_time=2e-3, **gains):
    usual = {name: value for name, (_, value) in jobs.GAINS[kind].items()}
    return {
        "id": f"controllers{number}",
        "name": kind,
        "kind": kind,
        "sample_time": sample_time,
        "gains": {**usual, **gains},
        "study": study,
    }


LAWS = [
    law("pid", 1, proportional=1.3e7, integral=2e8),
    law("lqr", 2),
    law("lqr", 3, integral=0.0),
    law("mpc", 4, sample_time=5e-3, horizon=8.0),
]


def unit(id, **more):
    return {"id": id, "kind": "fmu", "fmi": "2.0", "step_size": 2e-3, "motion": "", **more}


def ran(state, folder, **options):
    path = folder / "session.toml"
    path.write_text(study_of(World(folder, state, options.get("allow_code", False))), "utf-8")
    return run_study(path, folder / "out", cache=folder / "kept", **options)


@pytest.mark.slow
def test_the_runs_of_all_kinds_of_controllers(tmp_path):
    state = {**SLIDE, "controllers": LAWS}
    result = ran(state, tmp_path)
    assert result.ok, result
    for said in LAWS:
        own = jobs.loop_figures(jobs.loop_of(World(tmp_path, state), said), "x")
        numbers = result[said["id"]].numbers
        for name, kind in (("final", "last"), ("max", "max"), ("min", "min")):
            assert numbers[f"x.{kind}"][0] == pytest.approx(own[f"{name}(x)"], rel=1e-9), said
        assert numbers["push.max"][0] == 12.0


@pytest.mark.parametrize("key", PLATFORMS)
def test_script_and_study_build_for_the_platforms_that_were_chosen(key, tmp_path):
    state = {**SLIDE, "exports": [unit("exports1", platforms=key)]}
    path = tmp_path / "session.toml"
    path.write_text(study_of(World(tmp_path, state)), "utf-8")
    step = read_study(path).entries["exports1"].said
    text = script_of(state)
    assert "pam.export_fmu(" in text
    expected = platforms_named(PLATFORMS[key][1] or None)
    assert platforms_named(step.get("platforms")) == expected
    (said,) = re.findall(r"platforms=(\[.*?\])", text) or [None]
    assert platforms_named(said and ast.literal_eval(said)) == expected
    assert native() in expected  # for here it is checked


@pytest.mark.slow
def test_an_fmu_held_against_rest_a_system_and_c_code(tmp_path, monkeypatch):
    exports = [unit("exports1"), unit("exports2", kind="c", controller="controllers1")]
    state = {**SLIDE, "controllers": LAWS[:1], "exports": exports}
    result = ran(state, tmp_path)
    assert result.ok, result
    assert result["exports1-check"].numbers["largest"][0] < 1e-4
    c = tmp_path / "out" / "exports2" / "c"
    # the script makes the same C, but for the day on which it was made
    text = script_of(state)
    alone = tmp_path / "alone"
    alone.mkdir()
    monkeypatch.chdir(alone)
    exec(compile(text, "session.py", "exec"), {})
    (made,) = alone.glob("exports2_c/*_selftest.c")
    assert (c / made.name).read_text() == made.read_text()


@pytest.mark.slow
def test_a_system_of_plant_and_motion(tmp_path):
    motion = {
        **first_motion(plant_of(World(tmp_path, SLIDE)), "motions1", "Motion"),
        "method": "coarse",
    }
    export = unit("exports1", kind="ssp", motion=motion["id"])
    state = {**SLIDE, "motions": [motion], "exports": [export]}
    result = ran(state, tmp_path)
    assert result.ok, result
    own = motion_figures(plan_of(World(tmp_path, state), motion))
    assert result[motion["id"]].numbers["duration"][0] == pytest.approx(own["duration"], rel=1e-9)
    assert (tmp_path / "out" / "exports1" / "system.ssp").is_file()


def test_cells_that_are_off_are_off_in_the_study(tmp_path):
    item = {"id": "data1", "name": "t", "bundled": "DMSP-20-300_static.csv", "is": "table"}
    item |= {"said": {"rest_length": 0.3}, "off": [40, 0, 17]}
    fitted = {"kind": "fit", "table": item, "law": "three-element", "rest_length": 0.3}
    state = {**EMPTY, "muscle": {**fitted, "coefficients": {}, "moved": False}}
    result = ran(state, tmp_path)
    assert result["table"].numbers["cells"][0] == 123
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    own = pam.fit_force(table.subset([i not in (0, 17, 40) for i in range(126)]), "three-element")
    for name, c in own.coefficients.items():
        assert result["fit"].numbers[name][0] == pytest.approx(c.value, rel=1e-9)


def test_a_plant_of_ones_own_in_script_and_study(tmp_path, monkeypatch):
    files = tmp_path / "files"
    files.mkdir()
    (files / "0-my own.py").write_text(
        "import pam_ocp as pam\n\n\ndef load(muscle):\n"
        "    return pam.HangingLoad(muscle, mass=7.0)\n",
        "utf-8",
    )
    plant = {"arrangement": "0-my own.py:load", "set": {"gravity": 3.7}}
    study = {**STUDY, "push": 0.0, "step": 0.001}
    state = {**SLIDE, "plant": plant, "point": {"muscle.pressure": 2e5}}
    state["controllers"] = [law("pid", 1, study, proportional=2e6)]
    own = plant_of(World(tmp_path, state, True))
    at = pam.equilibrium(own, state["point"])
    refused("--allow-code", ran, state, tmp_path)
    result = ran(state, tmp_path, allow_code=True)
    assert result.ok, result
    assert result["linear"].numbers["x"][0] == pytest.approx(at["x"], rel=1e-9)
    text = script_of(state)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(text, "session.py", "exec"), names)
    assert names["plant"].variable("gravity").start == 3.7
    figures = jobs.loop_figures(
        jobs.loop_of(World(tmp_path, state, True), state["controllers"][0]), "x"
    )
    assert names["figures"]["controllers1.final(x)"] == figures["final(x)"]
    assert result["controllers1"].numbers["x.last"][0] == pytest.approx(figures["final(x)"], 1e-9)


def test_a_muscle_moved_by_hand_lies_beside_the_study(tmp_path):
    law_of = pam.muscle("DMSP-20-300").law
    said = {
        "kind": "fit",
        "table": {"bundled": "DMSP-20-300_static.csv", "said": {}},
        "law": "six-parameter",
        "coefficients": dict(law_of.values),
        "moved": True,
        "rest_length": 0.3,
        "pressure_range": [0.0, 6e5],
        "contraction_range": [0.0, 0.25],
        "name": "mine",
        "source": "by hand",
    }
    state = {**SLIDE, "muscle": said, "point": None}
    path = save_muscle_file(World(tmp_path, state))
    path.rename(tmp_path / path.name)
    (tmp_path / "session.toml").write_text(study_of(World(tmp_path, state)), "utf-8")
    assert run_study(tmp_path / "session.toml", tmp_path / "out", cache=tmp_path / "kept").ok
    assert "muscle" not in read_study(tmp_path / "session.toml").entries
    assert muscle_of(World(tmp_path, state)).name == "mine"


@pytest.mark.parametrize("said", [{"floor": "zero"}, {"floor": "none"}, {"missing": [777.0]}])
def test_a_table_is_read_in_the_study_as_on_the_page(tmp_path, said):
    """A load cell that reads 35 N where it hangs free, and a mark of what is missing."""
    shape = {k: 3 * (1 - k / 100) ** 2 - 1 for k in range(0, 50, 5)}
    cells = [
        (p, k, 777 if (p, k) == (3, 10) else max(100 * p * c - 40, 0) + 35 + 0.1 * ((p + k) % 3))
        for p in range(1, 6)
        for k, c in shape.items()
    ]
    text = "".join(f"{p},{k},{force}\n" for p, k, force in cells)
    session = Session(tmp_path)
    file = session.store("t.csv", f"pressure [bar],contraction [%],force [N]\n{text}".encode())
    item = {"id": "data1", "name": "t.csv", "file": file, "is": "table", "said": said, "off": [2]}
    fitted = {"kind": "fit", "table": item, "law": "polynomial-1-3", "rest_length": 0.3}
    state = {**EMPTY, "muscle": {**fitted, "coefficients": {}, "moved": False}}
    seen = table_of(World(tmp_path, state), item)
    result = ran(state, tmp_path)
    assert result["table"].numbers["cells"][0] == len(seen)
    for name, c in pam.fit_force(seen, "polynomial-1-3").coefficients.items():
        assert result["fit"].numbers[name][0] == pytest.approx(c.value, rel=1e-9)
