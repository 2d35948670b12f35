"""Defects of a mesh that are corrected: the motion is the plant's, on a mesh that does not resolve
it.
"""

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp
from searches import by_scipy, engine_of, solved

import pam_ocp as pam
from pam_ocp.planning.candidate import Candidate
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.replay import Corrected, corrected, left_as
from pam_ocp.planning.transcription.mesh import Collocation
from pam_ocp.planning.transcription.solution import unpack


def tank(tau=0.5):
    plant = pam.Plant("tank")
    x = plant.state("level", nominal=2.0)
    u = plant.input("u", min=0.0, max=1.0)
    plant.der(x, (u - x) / tau)
    return plant


@pytest.fixture(scope="module")
def rough():
    """Four intervals of two Radau points, 1/3 and 1."""
    wish = {"duration": 1.0, "minimise": "effort", "rest": False}
    stops = [{"level": 0.1}, {"level": 0.6}]
    planner = Planner(tank(), stops, method=Collocation(4, 2), **wish)
    return engine_of(planner), solved(planner)


def test_the_defect_is_what_the_exact_solution_leaves_in_the_equations(rough):
    engine, found = rough
    shift = corrected(engine.first, found.solution, Candidate(found).exact).shift
    start = found.solution.states[:-1:2, 0]
    u = found.solution.inputs.coefficients[:, 0, 0]
    expected, nodes = [], np.array([0.0, 1 / 3, 1.0])
    for x, held in zip(start, u, strict=True):
        exact = held + (x - held) * np.exp(-0.25 * nodes / 0.5)
        slope = np.polyval(np.polyder(np.polyfit(nodes, exact, 2)), nodes)
        expected += list((0.25 * (held - exact[1:]) / 0.5 - slope[1:]) / 2.0)
    assert shift[:8] == pytest.approx(expected, abs=1e-9)
    assert np.abs(expected).max() > 1e-4
    assert shift[8:] == pytest.approx(0.0)


def test_a_corrected_program_has_the_plants_own_motion(rough):
    engine, found = rough
    for _ in range(6):
        program = corrected(engine.first, found.solution, Candidate(found).exact)
        outcome = engine.solver(program, found.outcome.w, "near")
        solution = unpack(program.problem, program.mesh, outcome.w)
        found = type(found)(program, outcome, solution)
    u = found.solution.inputs.coefficients[:, 0, 0]
    level = [0.1]
    for value in u:
        held = solve_ivp(
            lambda t, x, v=value: (v - x) / 0.5, (0, 0.25), level[-1:], rtol=1e-10, atol=1e-10
        )
        level.append(held.y[0, -1])
    assert found.solution.states[::2, 0] == pytest.approx(level, abs=1e-6)
    assert level[-1] == pytest.approx(0.6, abs=1e-6)
    low, high = left_as(engine.first, found.solution).limits()
    assert low[:8] == pytest.approx(program.shift[:8], abs=1e-6)
    assert high == pytest.approx(low)


@pytest.fixture(scope="module")
def slipping():
    muscle = pam.muscle("DMSP-20-400N")
    slip = pam.losses.MaxwellSlip((5.0, 5.0, 3.0, 3.0))
    return pam.HangingLoad(muscle, 8.0, feed=pam.feeds.Regulator(lag=0.05), losses=(slip,))


@pytest.fixture(scope="module")
def plan(slipping):
    return pam.plan(slipping, [{"x": 0.02}, {"x": 0.06}])


def test_kinks_are_corrected_where_meshes_resolve_them_slowly(slipping, plan):
    assert plan.verified
    assert plan.verdict.corrected
    assert "defects were corrected" in str(plan).splitlines()[0]
    assert isinstance(plan._solved.program, Corrected)
    assert plan.statistics["intervals"] < 100
    motion, nominal = plan.trajectory, slipping.vector("state", attribute="nominal")
    at = [np.argmin(np.abs(motion.t - t)) for t in motion.signals.breaks]
    planned = motion.array([v.name for v in slipping.states])[at] / nominal
    assert np.abs(by_scipy(plan) - planned).max() < 1e-3


def test_a_plan_whose_mesh_resolves_the_motion_says_nothing_of_correction():
    again = pam.plan(tank(), [{"level": 0.1}, {"level": 0.5}], duration=1.0, rest=False)
    assert again.verified
    assert not again.verdict.corrected
    assert "corrected" not in str(again)


def test_a_corrected_plan_is_read_back_and_a_changed_one_is_not(slipping, plan, tmp_path):
    path = plan.save(tmp_path / "plan.npz")
    again = pam.load_plan(path, slipping)
    assert again.verified
    assert again.verdict.corrected
    assert again.replay_error == pytest.approx(plan.replay_error, rel=1e-3)
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["states"] = arrays["states"].copy()
    arrays["states"][20:40] += 0.5 * slipping.vector("state", attribute="nominal")
    np.savez(path, **arrays)
    refused("do not follow from its inputs", pam.load_plan, path, slipping)
