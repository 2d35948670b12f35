"""What a search says of itself."""

import ast
import logging
import sys
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import benchmark_slide

import pam_ocp as pam

STOPS = [{"x": -0.01}, {"x": 0.01}]
COARSE = pam.Collocation(12, 3)
ROOT = Path(pam.__file__).parents[1]


@pytest.fixture(scope="module")
def plan():
    return pam.plan(benchmark_slide(pam.feeds.Regulator()), STOPS, method=COARSE)


def test_every_iteration_of_a_plan_belongs_to_a_stage(plan):
    stages = plan.statistics["stages"]
    assert sum(s["iterations"] for s in stages) == plan.statistics["iterations"]
    assert stages[0]["name"] == "starts"
    assert stages[0]["intervals"] == 12
    assert all(s["seconds"] > 0 and s["reason"] for s in stages)
    finer = [s for s in stages if s["name"] == "mesh"]
    assert len(finer) == len(plan.meshes) - 1
    assert finer[-1]["intervals"] == plan.statistics["intervals"]
    assert finer[-1]["objective"] == pytest.approx(plan.statistics["objective_on_mesh"], rel=1e-12)


def test_stages_are_said_as_they_happen(plan, caplog):
    with caplog.at_level(logging.INFO, logger="pam_ocp.planning"):
        again = pam.plan(plan.plant, STOPS, method=COARSE)
    said = [r.getMessage() for r in caplog.records if r.name.endswith("stages")]
    assert len(said) == len(again.statistics["stages"])
    assert said[0].startswith("starts (the usual guess): 12 intervals")


def test_an_explanation_has_a_line_for_each_stage_and_sums_their_seconds(plan):
    lines = plan.explain().splitlines()
    stages = plan.statistics["stages"]
    assert len(lines) == len(stages) + 2
    for line, s in zip(lines[1:], stages, strict=False):
        assert line.startswith(s["name"])
        assert line.endswith(s["reason"])
    starts = sum(s["seconds"] for s in stages if s["name"] == "starts")
    assert f"starts {starts:.2f} s" in lines[-1]


def test_stages_go_with_a_plan_into_its_file(plan, tmp_path):
    loaded = pam.load_plan(plan.save(tmp_path / "plan.npz"), plan.plant)
    assert loaded.explain() == plan.explain()


def test_starts_that_run_elsewhere_are_stages_too():
    """With valves their openings are the inputs of all starts, once these led to a plan."""
    plant = benchmark_slide(pam.feeds.SpoolValve())
    plan = pam.plan(plant, STOPS, method=COARSE, starts=3, tolerance=None)
    stages = plan.statistics["stages"]
    starts = [s for s in stages if s["name"].endswith("starts")]
    assert [s["name"] for s in starts] == ["valve openings / starts"] * len(starts)
    assert {s["reason"] for s in starts} == {"the usual guess", "2 more"}
    ends = plan.statistics["starts"]
    assert [s["iterations"] for s in starts] == [e["iterations"] for e in ends]
    back = [s for s in stages if s["reason"] == "back to commands"]
    assert len(back) == 1  # what ties with that leads nowhere else
    usual = pam.plan(plant, STOPS, method=COARSE, tolerance=None)
    assert len(usual.statistics["starts"]) == 2


def test_stages_are_called_in_no_circle():
    """The modules of the search by what each imports, and the stages of searches by what each was
    part of: both have an order. Only valve openings, another problem, have a search of their own.
    """
    modules = ("search", "arcs_search", "starts", "continuation", "mesh_sequence")
    modules += ("candidate", "replay")
    calls = {}
    for name in modules:
        tree = ast.parse((ROOT / "pam_ocp" / "planning" / f"{name}.py").read_text())
        imported = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        calls[name] = imported & set(modules)
    order = list(TopologicalSorter(calls).static_order())  # raises CycleError
    assert order.index("candidate") < order.index("continuation") < order.index("search")
    muscle, within = pam.muscle("DMSP-20-200N"), {}
    for feed, losses, term in (
        (pam.feeds.SpoolValve(), (), "air"),
        (pam.feeds.Regulator(), (pam.losses.CoulombFriction(10.0),), "work"),
    ):
        plant = pam.HangingLoad(muscle, 8.0, feed=feed, losses=losses)
        wish = {"duration": 0.4, "minimise": term, "method": COARSE}
        plan = pam.plan(plant, [{"x": 0.01}, {"x": 0.03}], **wish, starts=2)
        for s in plan.statistics["stages"]:
            for outer, inner in pairwise(s["name"].split(" / ")):
                within.setdefault(outer, set()).add(inner)
    assert within["valve openings"] >= {"starts"}
    tuple(TopologicalSorter(within).static_order())


def test_a_plan_of_smooth_terms_enters_few_files():
    """But for what is loaded at first use."""
    plant, entered = benchmark_slide(pam.feeds.Regulator()), set()

    def enters(frame, event, _):
        path = Path(frame.f_code.co_filename)
        if event == "call" and "pam_ocp" in path.parts and path.is_relative_to(ROOT / "pam_ocp"):
            entered.add(path)

    pam.plan(plant, STOPS, method=COARSE)
    before = sys.getprofile()
    sys.setprofile(enters)
    try:
        pam.plan(plant, STOPS, method=COARSE)
    finally:
        sys.setprofile(before)
    assert len({p for p in entered if "planning" in p.parts}) <= 20
    assert len(entered) <= 48
