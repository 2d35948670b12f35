"""Plans, loops and exports of the page without a page: plain values, and the verbs' own results."""

import random

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.bench import script, study
from pam_ocp.bench.jobs import control as control_jobs
from pam_ocp.bench.jobs import export as export_jobs
from pam_ocp.bench.jobs import motion as jobs
from pam_ocp.bench.made import World, plant_of
from pam_ocp.bench.session import EMPTY

CATALOGUE = {"kind": "catalogue", "name": "DMSP-20-300", "rest_length": None}


def say(*words):
    return None


@pytest.fixture
def state():
    made = {**EMPTY, "muscle": CATALOGUE, "plant": {"arrangement": "AntagonisticSlide"}}
    return {**made, "point": {"x": 0.0, "muscle1.pressure": 3e5}}


@pytest.fixture
def motion(state, tmp_path):
    made = jobs.first_motion(plant_of(World(tmp_path, state)), "motions1", "Motion 1")
    return {**made, "method": "coarse"}


def test_what_is_dragged_is_the_optimum_that_a_cold_plan_finds(state, motion, tmp_path):
    for _ in range(3):
        motion["stops"][1]["at"] = random.uniform(0.004, 0.02)
        warm = jobs.dragged(say, World(tmp_path, state), motion)
        cold = pam.plan(
            plant_of(World(tmp_path, state)),
            **script.arguments(motion),
            method=jobs.DRAGGED,
            tolerance=None,
        )
        assert warm["duration"] == pytest.approx(cold.duration, rel=1e-5)
        assert warm["stop_times"] == pytest.approx([0.0, cold.duration], rel=1e-5)


@pytest.mark.slow
def test_the_impossible_is_told_in_place(state, motion, tmp_path):
    motion["durations"] = [0.004]
    told = jobs.dragged(say, World(tmp_path, state), motion)
    assert not told["ok"]
    assert told["conflicts"][0]["stop"] == 1
    motion["minimise"] = {"time": 0.0}
    refused("give one of them a weight", jobs.dragged, say, World(tmp_path, state), motion)


def test_stops_stand_where_the_plan_is_at_their_times(state, motion, tmp_path):
    via = {"at": 0.002, "second": None, "dwell": 0.0, "rest": False}
    stay = {"at": 0.006, "second": None, "dwell": 0.02, "rest": True}
    motion["stops"][1:1] = [via, stay]
    motion["durations"] = [0.04, None, 0.05]
    told = jobs.planned(say, World(tmp_path, state), motion)
    found = jobs.plan_of(World(tmp_path, state), motion)
    at = found.trajectory.at(np.array(told["stop_times"]))["x"]
    assert at == pytest.approx([s["at"] for s in motion["stops"]], abs=1e-6)
    assert told["stop_times"][1] == pytest.approx(0.04)


def test_a_record_is_compared_from_its_first_sample_on(state, motion, tmp_path):
    found = jobs.plan_of(World(tmp_path, state), motion)
    t = np.linspace(0.0, found.duration, 40)
    off = random.uniform(1e-4, 1e-3)
    x = found.replay.trajectory.at(t)["x"] + off
    (tmp_path / "files").mkdir()
    rows = "".join(f"{7 + a:.9f},{1e3 * b:.9f}\n" for a, b in zip(t, x, strict=True))
    (tmp_path / "files" / "r.csv").write_text("time [s],x [mm]\n" + rows, "utf-8")
    item = {"id": "data1", "name": "r", "file": "r.csv", "said": {"kind": "record"}}
    told = jobs.replayed(say, World(tmp_path, state), motion, item)
    (row,) = told["rows"]
    assert row["largest"] == pytest.approx(1e3 * off, rel=1e-3)


def test_a_live_run_is_the_closed_loop_sample_by_sample(state, tmp_path):
    plant = plant_of(World(tmp_path, state))
    said = control_jobs.first_controller(plant, state["point"], "lqr", "controllers1")
    said["study"] |= {"step": 2e-3, "duration": 0.1, "push": 0.0}
    run = control_jobs.loop_of(World(tmp_path, state), said)
    reached, reference = [], run.reference["x"][-1]
    for seconds in (0.03, 0.05, 0.02):
        ask = {"run": "a", "seconds": seconds, "reference": reference, "push": 0.0}
        reached += control_jobs.live(say, World(tmp_path, state), said, ask)["rows"]["x"]
    assert len(reached) == 100
    assert 1e-3 * np.array(reached) == pytest.approx(run["x"][:100], abs=1e-8)


def test_a_live_run_goes_on_where_it_stands_with_other_gains(state, tmp_path):
    plant = plant_of(World(tmp_path, state))
    said = control_jobs.first_controller(plant, state["point"], "lqr", "controllers1")
    ask = {"run": "b", "seconds": 0.1, "reference": state["point"].get("x", 0.0) + 2e-3, "push": 0}

    def live(**more):
        return control_jobs.live(say, World(tmp_path, state), {**said, **more}, ask)

    before = live()
    after = live(gains={**said["gains"], "effort": 2.0})
    assert before["restart"]
    assert after["built"]
    assert not after["restart"]
    assert after["t"][0] == pytest.approx(before["t"][-1] + said["sample_time"])
    step = np.diff(before["rows"]["x"]).max()
    assert abs(after["rows"]["x"][0] - before["rows"]["x"][-1]) <= step
    ask["run"] = "c"
    assert live()["restart"]


def test_a_pid_about_a_point_has_the_poles_of_its_equations():
    rng = np.random.default_rng()
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=rng.uniform(2, 20))
    p, i, d = rng.uniform(1e5, 1e6), rng.uniform(1e5, 5e6), rng.uniform(0, 2e4)
    made = pam.control.PointPid(plant, {"x": 0.02}, p, i, d, filter_time=4e-3)
    linear = plant.linearize(plant.equilibrium(x=0.02), inputs=["muscle.command"], outputs=["x"])
    for pole in made.poles:  # 1 + PID(s) G(s) = 0
        pid = p + i / pole + d * pole / (4e-3 * pole + 1)
        assert abs(1 + pid * complex(np.squeeze(linear(pole)))) < 1e-6
    run = pam.closed_loop(
        pam.control.PointPid(plant, {"x": 0.02}, 1e5, 3e5),
        plant,
        {"x": 0.021},
        duration=0.05,
        start=plant.equilibrium(x=0.02),
    )
    assert run["x"][-1] > 0.02
    refused("is not followed", made.tracking, {"v": lambda t: 0.0}, {}, False)


@pytest.mark.slow
def test_the_script_of_motions_and_controllers_gives_the_same_figures(state, motion, tmp_path):
    (tmp_path / "files").mkdir()
    plant = plant_of(World(tmp_path, state))
    via = {"at": 0.001, "second": None, "dwell": 0.0, "rest": False}
    motion["stops"].insert(1, via)
    motion |= {"durations": [None, 0.03], "minimise": {"time": 1.0, "effort": random.random()}}
    motion["bounds"] = [{"name": "v", "low": -2.0, "high": None}]
    controllers = []
    for k, kind in enumerate(control_jobs.GAINS):
        said = control_jobs.first_controller(plant, state["point"], kind, f"controllers{k + 1}")
        said["study"] |= {"duration": 0.05, "push": 3.0, "push_from": 0.02, "noise": 1e-6}
        controllers.append(said)
    state |= {"motions": [motion], "controllers": controllers}
    text = script.script_of(state)
    assert max(map(len, text.splitlines())) < 140
    told = export_jobs.script_checked(say, World(tmp_path, state), text)
    assert told["ok"], [row for row in told["rows"] if not row["ok"]]
    assert len(told["rows"]) > 20


def test_a_study_says_the_plan_as_the_script_does(state, motion, tmp_path):
    from pam_ocp.core.files import read_toml
    from pam_ocp.studies.study_file import read_study

    motion["stops"][1] |= {"rest": False}
    motion |= {"durations": [0.05], "bounds": [{"name": "v", "low": None, "high": 1.5}]}
    path = tmp_path / "session.toml"
    path.write_text(study.study_of(World(tmp_path, {**state, "motions": [motion]})), "utf-8")
    assert list(read_study(path).entries) == ["muscle", "plant", "linear", "motions1"]
    steps = read_toml(path)["steps"]
    assert steps["plant"]["muscle"] == "muscle"
    one = steps["motions1"]
    assert one["bounds"] == {"v": {"max": 1.5}}
    assert one["duration"] == [0.05]
    assert one["stops"][1] == {"x": motion["stops"][1]["at"], "rest": False}


@pytest.mark.parametrize("cyclic", [False, True])
def test_a_stop_more_or_less_leaves_the_other_legs_their_times(cyclic):
    """Legs are told apart by their ends: what joins the same stops keeps its time."""
    from pam_ocp.bench.tabs.motion import legs_with, legs_without

    def named(stops, times):
        ends = [*stops[1:], stops[0]] if cyclic else stops[1:]
        assert len(times) == len(ends)
        return dict(zip(zip(stops, ends, strict=False), times, strict=True))

    stops = ["a", "b", "c", "d"]
    times = [0.1, 0.2, 0.3, *([0.4] if cyclic else [])]
    before = named(stops, times)
    for i in range(5):
        more = [*stops[:i], "new", *stops[i:]]
        after = named(more, legs_with(times, i, cyclic))
        assert after == {leg: before.get(leg) for leg in after}
    for i in range(4):
        less = [s for s in stops if s != stops[i]]
        after = named(less, legs_without(times, i, cyclic))
        assert after == {leg: before.get(leg) for leg in after}


def test_a_report_has_all_motions_whatever_their_names(state, motion, tmp_path):
    motions = [
        {**motion, "id": f"motions{i}", "name": name, "durations": [0.05 + 0.01 * i]}
        for i, name in enumerate(("Plant", "swing", "swing"), start=1)
    ]
    world = World(tmp_path, {**state, "motions": motions})
    (tmp_path / "files").mkdir()
    page = tmp_path / "exports" / export_jobs.report(say, world, "")["file"]
    text = page.read_text("utf-8")
    assert all(f"{t} s</td>" in text for t in ("0.06", "0.07", "0.08"))
    assert "swing (2)" in text
    assert "AntagonisticSlide antagonistic_slide" in text or "antagonistic_slide: " in text
