"""plan: the benchmark PAM-2DIR, known optima, and what is refused."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import refused, scipy_states

import pam_ocp as pam
from pam_ocp import Collocation, InputError, PlanError

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import pam_2dir

STOPS = [{"x": -0.015}, {"x": 0.015}]


@pytest.mark.parametrize(("intervals", "seconds"), [(50, 0.060778), (100, 0.060630)])
def test_the_benchmark_in_minimum_time(slide, intervals, seconds):
    plan = pam.plan(slide, STOPS, cyclic="mirrored", method=Collocation(intervals))
    assert plan.duration == pytest.approx(seconds, abs=1e-6)
    assert plan.replay_error < 1e-6
    assert plan.replay.violation < 1e-6


def test_the_benchmark_as_a_whole_cycle(slide):
    plan = pam.plan(slide, STOPS, cyclic=True, minimise="time")
    assert plan.durations == pytest.approx([0.060778, 0.060778], abs=1e-6)
    assert plan.replay_error < 1e-6
    end = plan.trajectory
    nominal = slide.vector("state", attribute="nominal")
    states = end.array(end.named("state"))
    assert np.max(np.abs(states[-1] - states[0]) / nominal) < 1e-8


def test_the_replay_error_is_what_scipy_finds_too(slide):
    plan = pam.plan(slide, STOPS, cyclic="mirrored", method=Collocation(20, 2))
    motion = plan.trajectory
    u = motion.array(motion.named("input"))

    def held(time):
        return u[min(int(np.searchsorted(motion.t, time, side="right")) - 1, len(u) - 1)]

    states = motion.array(motion.named("state"))
    exact = scipy_states(slide, held, motion.t, states[0])
    error = np.max(np.abs(exact - states) / slide.vector("state", attribute="nominal"))
    assert error > 1e-6  # a coarse plan, so that there is something to find
    assert plan.replay_error == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize(
    ("method", "objective", "error"),
    [
        (Collocation(50, 4), 0.89646, 1e-5),
        (Collocation(100, 4), 0.89597, 1e-5),
        (Collocation(6, 9, "polynomial"), 0.89577, 8.9e-5),
    ],
)
def test_the_benchmark_with_least_rate_of_command(method, objective, error):
    # the benchmark's force has no smooth clamp, and F = 0 is active here: a narrow one comes near
    plan = pam.plan(pam_2dir.commanded(), STOPS, method=method, **pam_2dir.WISHES["b"])
    assert plan.objective == pytest.approx(objective, abs=error)


def test_forces_stay_within_the_bounds_asked_for(slide):
    plan = pam.plan(slide, STOPS, cyclic=True, bounds={"muscle1.force": (100.0, 800.0)})
    force = plan.replay.trajectory["muscle1.force"]
    assert force.min() > 100.0 - 0.5
    assert force.max() < 800.0 + 0.5
    assert plan.duration > 2 * 0.060778


def test_no_plan_lets_a_muscle_go_slack(slide):
    plan = pam.plan(slide, STOPS, cyclic=True)
    motion = plan.replay.trajectory
    for i, sign in ((1, 1), (2, -1)):
        kappa = 0.10 + sign * motion["x"] / 0.2
        tension = pam.muscle("DMSP-20-200N").tension(motion[f"muscle{i}.pressure"], kappa)
        assert tension.min() > -0.1


@pytest.mark.slow
def test_an_impossible_motion_names_the_most_violated_constraint(slide):
    with pytest.raises(
        PlanError, match=r"most violated constraint is stop 2: x \(= 15 mm\)"
    ) as caught:
        pam.plan(slide, STOPS, duration=0.03, method=Collocation(10, 3))
    sealed = caught.value.plan
    assert not sealed.success
    assert sealed.conflicts[0].label.startswith("stop")  # a tie is named from both sides
    assert sealed.log[-1]["inf_pr"] > 0
    names = [s["name"] for s in sealed.statistics["stages"]]
    assert names[0] == "starts"
    assert "other guesses" in names
    with pytest.raises(PlanError, match="holds no solution"):
        _ = sealed.trajectory
    assert len(sealed.unverified()) == 1 + 10 * 3


@pytest.mark.parametrize(
    ("stops", "arguments", "message"),
    [
        ([{"x": 0.0}], {}, "at least two stops"),
        ({"x": 0.0}, {}, "list of mappings"),
        ([{"x": 0.0}, {}], {}, "stop 2 is empty"),
        ([{"x": 0.0}, {"x": 0.05}], {}, "x = 50 mm is outside the stroke -16 mm .. 16 mm"),
        ([{"x": 0.0}, {"y": 0.01}], {}, "unknown variable"),
        ([{"x": 0.0}, {"mass": 1.0}], {}, "mass is a parameter"),
        (STOPS, {"bounds": {"x": (0.01, -0.01)}}, "crossed"),
        (STOPS, {"bounds": {"x": (1.0, 2.0)}}, "lie outside the plant's own"),
        (STOPS, {"bounds": {"x": (-0.01, 0.01)}}, "outside the stroke"),
        (STOPS, {"bounds": {"mass": (1.0, 2.0)}}, "with_values"),
        (STOPS, {"duration": -1.0}, "duration = -1 s must be > 0"),
        (STOPS, {"duration": (2.0, 1.0)}, "crossed"),
        (STOPS, {"duration": [1.0, 1.0]}, "2 entries for 1 phases"),
        (STOPS, {"minimise": "tyme"}, "time"),
        (STOPS, {"minimise": "effort"}, "needs a fixed duration"),
        (STOPS, {"cyclic": "sideways"}, "choose True, False or 'mirrored'"),
        ([{"x": -0.015}, {"x": 0.010}], {"cyclic": "mirrored"}, "not the mirror image"),
        (STOPS, {"options": {"no_such_option": 1}}, "options"),
    ],
)
def test_what_cannot_be_meant_is_refused(slide, stops, arguments, message):
    refused(message, pam.plan, slide, stops, **arguments)


def test_a_plant_without_inputs_can_be_timed():
    """A pendulum-free check of the transcription: x' = -x from 1 to 1/e takes one second."""
    plant = pam.Plant("decay")
    x = plant.state("x", start=1.0)
    plant.der(x, -x)
    plan = pam.plan(
        plant, [{"x": 1.0}, {"x": float(np.exp(-1))}], rest=False, method=Collocation(5, 5)
    )
    assert plan.duration == pytest.approx(1.0, rel=1e-8)
    assert isinstance(plan.plant.expression("x"), ca.SX)


def test_few_intervals_of_high_degree_reach_the_benchmarks_limit(slide):
    plan = pam.plan(slide, STOPS, cyclic="mirrored", method=Collocation(6, 9, "polynomial"))
    assert plan.duration == pytest.approx(0.06048, rel=1e-3)


def test_refinement_meets_the_tolerance_asked_for(slide):
    coarse = pam.plan(slide, STOPS, cyclic="mirrored", method=Collocation(20, 3, "linear"))
    fine = pam.plan(
        slide, STOPS, cyclic="mirrored", method=Collocation(20, 3, "linear"), tolerance=1e-7
    )
    assert coarse.replay_error > 1e-6 > 1e-7 > fine.replay_error
    assert len(fine.meshes) > 1
    assert fine.duration == pytest.approx(0.06048, rel=1e-3)


@pytest.mark.parametrize("control", ["constant", "linear", "polynomial"])
def test_a_plan_replays_through_its_trajectory_also_from_a_file(slide, control, tmp_path):
    plan = pam.plan(slide, STOPS, cyclic=True, method=Collocation(15, 4, control))
    stored = pam.Trajectory.load(plan.trajectory.save(tmp_path / "plan.npz"))
    for motion in (plan.trajectory, stored):
        replay = pam.simulate(slide, motion)
        error = motion.compare(replay, motion.named("state")).largest
        assert error == pytest.approx(plan.replay_error, rel=1e-3)


def test_a_running_cost_of_ones_own_is_integrated():
    """min integral of (u^2 + x^2) of x' = u, x(0) = 1, free end, long horizon:
    the LQR's x0^2 = 1.
    """
    plant = pam.Plant("integrator")
    x = plant.state("x", start=1.0)
    u = plant.input("u")
    plant.der(x, u)
    plan = pam.plan(
        plant,
        [{"x": 1.0}, {"x": (-1.0, 1.0)}],
        rest=False,
        duration=12.0,
        minimise="effort",
        integrand=plant.expression("x") ** 2,
        method=Collocation(20, 6, "polynomial"),
    )
    assert plan.objective == pytest.approx(np.tanh(12.0), rel=1e-8)
    with pytest.raises(InputError, match="stranger"):
        pam.plan(plant, [{"x": 1.0}, {"x": 0.0}], duration=1.0, integrand=ca.SX.sym("stranger"))
