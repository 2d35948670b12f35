"""Where a plan's first guess fails: coarser meshes, points of rest, and what may be said then."""

import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import pushed
from searches import search_of

import pam_ocp as pam
from pam_ocp.planning import replay
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.solvers.diagnosis import elastic, explanation
from pam_ocp.planning.transcription.guess import by_rests, by_stops, path_of_rests, rest_point
from pam_ocp.planning.transcription.mesh import Collocation, Shooting, merged


def cart():
    return pushed(10.0)


def program(**wish):
    return Planner(cart(), [{"x": 0.0}, {"x": 1.0}], method=Collocation(8), **wish)._program


def test_a_merged_mesh_has_the_legs_of_the_fine_one():
    fine = Collocation(10, 3).mesh(2)
    coarse = merged(fine, 4)
    assert [i.leg for i in coarse.intervals] == [0] * 3 + [1] * 3
    assert [i.fraction for i in coarse.intervals] == pytest.approx([0.4, 0.4, 0.2] * 2)
    assert {i.degree for i in merged(Shooting(8, 3).mesh(1), 4).intervals} == {12}


def test_coarser_meshes_lead_to_the_optimum_on_the_mesh_that_was_asked_for():
    planner = Planner(cart(), [{"x": 0.0}, {"x": 1.0}], method=Collocation(8))
    search = search_of(planner)
    coarse = merged(planner._program.mesh, 4)
    search.meshes.ladder = [coarse, planner._program.mesh]
    search.continuation.led(next(search._guessed(coarse)))
    best = search.found.best
    assert best.mesh == planner._program.mesh
    # bang-bang from rest to rest: T = 2 sqrt(distance / acceleration)
    assert best.objective == pytest.approx(2 * np.sqrt(0.1), rel=1e-6)


def test_a_guess_along_points_of_rest_rests_between_the_stops():
    muscle = pam.muscle("DMSP-20-300")
    plant = pam.SeriesLoad(muscle, 8.0, 1.5e5)
    wish = {"duration": 60.0, "minimise": "effort"}
    planner = Planner(plant, [{"x": 0.01}, {"x": 0.04}], method=Collocation(8), **wish)
    problem, mesh = planner._program.problem, planner._program.mesh

    def unbalanced(guess):
        names = [v.name for v in plant.states]
        scale = np.array([v.nominal for v in plant.states])
        k = len(names) + 4 * (3 * len(names) + len(plant.inputs))  # in the middle of the way
        end = slice(k - len(names) - len(plant.inputs), k - len(plant.inputs))
        x = dict(zip(names, guess[end] * scale, strict=True))
        pull = muscle.tension(x["muscle.pressure"], x["muscle.shortening"] / 0.3)
        return abs(float(pull) - 8.0 * 9.80665)

    assert unbalanced(by_rests(problem, mesh)) < 0.05
    assert 5 * unbalanced(by_rests(problem, mesh)) < unbalanced(by_stops(problem, mesh, True))


def test_the_guess_along_points_of_rest_of_a_pair_that_leaves_its_stiffness_open_rests_too():
    muscle = pam.muscle("DMSP-20-400N")
    plant = pam.AntagonisticSlide(muscle, 2.0, feed=pam.feeds.IdealPressure())
    wish = {"duration": 60.0, "minimise": "effort", "method": Collocation(8)}
    problem = Planner(plant, [{"x": -0.02}, {"x": 0.025}], **wish)._program.problem
    path = path_of_rests(problem, problem.time_nominals)
    assert len(path.nodes) > 5
    for states, (p1, p2) in path.nodes:
        kappa = plant.variable("pre_contraction").start + states[0] / 0.4 * np.array([1.0, -1.0])
        pulls = [float(muscle.tension(p, k)) for p, k in zip((p1, p2), kappa, strict=True)]
        assert min(pulls) > -1e-3
        assert pulls[0] == pytest.approx(pulls[1], abs=0.05)


def test_a_slack_tendon_in_the_start_values_does_not_hide_the_point_of_rest():
    plant = pam.SeriesLoad(pam.muscle("DMSP-20-300"), 8.5, 1.5e5, feed=pam.feeds.OnOffValves())
    problem = Planner(plant, [{"x": 0.024}, {"x": 0.031}], method=Collocation(4))._program.problem
    x, _ = rest_point(problem, problem.stops[0])
    stretch = x[[v.name for v in plant.states].index("muscle.shortening")] - 0.024
    assert stretch * 1.5e5 == pytest.approx(8.5 * 9.80665, rel=1e-2)


# ---- what may be said ----------------------------------------------------------------------------
def test_an_elastic_solve_that_was_cut_off_proves_nothing():
    asked = program(duration=0.1)
    end = elastic(asked, by_stops(asked.problem, asked.mesh), {"max_iter": 1})
    assert not end.converged
    assert not end.conflicting
    assert not end.feasible


def test_an_elastic_solve_that_converged_names_what_is_missing():
    asked = program(duration=0.1)
    end = elastic(asked, by_stops(asked.problem, asked.mesh), None)
    assert end.conflicting
    # 0.1 s at 10 m/s2 to and fro: a T^2 / 4 = 0.025 m, of 1 m
    assert sum(c.excess for c in end.conflicts) > 0.4
    outcome = SimpleNamespace(stopped=False, status="s", iterations=3, advice="")
    words = explanation("cart", outcome, end.conflicts, feasible=False)
    assert words.startswith("no plan found for cart")
    assert words.endswith("which is no proof that there is no plan.")


def test_a_solver_at_its_limit_is_no_conflict():
    with pytest.raises(pam.PlanError, match="does not prove that there is no plan") as caught:
        pam.plan(cart(), [{"x": 0.0}, {"x": 1.0}], options={"max_iter": 1})
    assert caught.value.plan.conflicts == ()
    outcome = SimpleNamespace(stopped=False, status="s", iterations=3, advice="")
    assert "seems to exist" in explanation("cart", outcome, (), feasible=True)


# ---- Ctrl-C --------------------------------------------------------------------------------------
def test_ctrl_c_in_a_replay_ends_the_plan_and_nothing_is_tried_after_it(monkeypatch):
    moved, begun = replay.moved, []

    def pressed(*arguments, **options):
        begun.append(arguments)
        os.kill(os.getpid(), signal.SIGINT)
        return moved(*arguments, **options)

    monkeypatch.setattr(replay, "moved", pressed)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        pam.plan(cart(), [{"x": 0.0}, {"x": 1.0}], method=Collocation(8))
    assert len(begun) == 1
    assert signal.getsignal(signal.SIGINT) is before
