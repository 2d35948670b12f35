"""Valves under control: dead zones inverted,
so that controllers start from closed valves at rest.
"""

from __future__ import annotations

import math
import pickle
import warnings
from typing import Any

import control
import numpy as np
import pytest
from conftest import BAR, rates_and_outputs, refused
from searches import search_of

import pam_ocp as pam
from pam_ocp.control.controller_plants import pid_controller, state_feedback_controller
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.pid import PressureLoop
from pam_ocp.export import export_fmu
from pam_ocp.muscles.law import clamp

OVERLAPS = (0.0, 0.02, 0.1)
AMBIENT, RHO, B = 1.01325e5, 1.185, 0.3
C = pam.gas.conductance_from_flow(700.0)


def hanging(overlap: float = 0.02, **feed: Any) -> pam.Plant:
    valve = pam.feeds.SpoolValve(overlap=overlap, **feed)
    return pam.HangingLoad("DMSP-20-400N", mass=20.0, feed=valve)


def at_rest(plant: pam.Plant, point: Any) -> dict[str, float]:
    return {v.name: point[v.name] for v in plant.states}


# ---- the inverse ---------------------------------------------------------------------------------
def opening_by_hand(c: float, overlap: float) -> float:
    """The spool's opening as documented: rounded within the overlap, a straight line beyond."""
    half = overlap / 2
    size = abs(c)
    s = size / overlap
    beyond = size - half if size >= overlap else half * s**4 * (2 * s**2 - 6 * s + 5)
    return math.copysign(beyond / (1 - half), c)


@pytest.mark.parametrize("overlap", [1e-4, 0.02, 0.1, 0.35])
def test_the_command_gives_exactly_the_opening(overlap):
    inversion = pam.plants.Inversion(hanging(overlap))
    sizes = np.concatenate([np.linspace(0, 1, 201), np.geomspace(1e-12, 1.0, 60)])
    for w in [*sizes, *-sizes]:
        sent = inversion.commands({"muscle.opening": w})["muscle.command"]
        assert abs(sent) <= 1
        assert opening_by_hand(sent, overlap) == pytest.approx(w, rel=1e-11, abs=1e-15)


def test_a_critically_lapped_valve_is_rounded_over_1e_4_of_its_travel():
    sent = pam.plants.Inversion(hanging(0.0)).commands({"muscle.opening": 0.3})
    assert sent["muscle.command"] == pytest.approx(0.3 * (1 - 5e-5) + 5e-5, rel=1e-12)


def test_the_overlap_is_a_parameter_of_the_plant():
    plant = hanging(0.02).with_values({"muscle.valve.overlap": 0.2})
    sent = pam.plants.Inversion(plant).commands({"muscle.opening": -0.5})
    assert sent["muscle.command"] == pytest.approx(-(0.5 * 0.9 + 0.1), rel=1e-12)


def flow_by_hand(w: float, p: float) -> float:
    """ISO 6358 at 20 degrees for an opening, gauge pressure p in the muscle, 6 bar supply."""
    up, down = (6e5 + AMBIENT, p + AMBIENT) if w > 0 else (p + AMBIENT, AMBIENT)
    ratio = max(down / up, B)
    return w * C * RHO * up * math.sqrt(1 - ((ratio - B) / (1 - B)) ** 2)


@pytest.mark.parametrize(
    "feed", [pam.feeds.SpoolValve(overlap=0.1), pam.feeds.OnOffValves()], ids=["spool", "on/off"]
)
def test_the_flow_is_that_of_the_opening(feed):
    plant = pam.HangingLoad("DMSP-20-400N", mass=20.0, feed=feed)
    inversion, at = pam.plants.Inversion(plant), {"x": 0.05, "muscle.pressure": 2.2 * BAR}
    for w in (-1.0, -0.3, -0.002, 0.002, 0.4, 1.0):
        opening, expected = {"muscle.opening": w}, flow_by_hand(w, 2.2 * BAR)
        for model, u in ((plant, inversion.commands(opening)), (plant.in_openings(), opening)):
            flow = rates_and_outputs(model, at | u)[1]["muscle.mass_flow"]
            assert flow == pytest.approx(expected, rel=1e-9)


def test_the_slope_of_a_closed_valve_is_the_mean_of_filling_and_venting():
    plant = hanging()
    point = plant.equilibrium(x=0.05)
    p = point["muscle.pressure"]
    system = plant.linearize(point, outputs=["muscle.mass_flow"])
    assert system.input_labels == ["muscle_opening"]
    mean = (flow_by_hand(1.0, p) - flow_by_hand(-1.0, p)) / 2
    assert system.D.item() == pytest.approx(mean, rel=1e-9)
    assert np.abs(plant.linearize(point, inputs=["muscle.command"]).B).max() < 1e-9


def test_openings_travel_with_a_plant():
    slide = pam.AntagonisticSlide("DMSP-20-200N", feed=pam.feeds.SpoolValve())
    plant = pickle.loads(pickle.dumps(slide))
    inner = plant.in_openings()
    assert [v.name for v in inner.inputs] == ["muscle1.opening", "muscle2.opening"]
    assert inner.mirror_map["muscle1.opening"] == (1.0, "muscle2.opening")
    assert plant.in_commands().openings == ()
    sent = pam.plants.Inversion(plant).commands({"muscle2.opening": 0.5})
    assert sent == {"muscle2.command": pytest.approx(0.5 * 0.99 + 0.01, rel=1e-12)}


def test_rest_with_on_off_valves_asks_one_condition_for_each_muscle():
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), feed=pam.feeds.OnOffValves())
    point = plant.equilibrium(x=0.004, stiffness=2e4)
    assert (point["x"], point["stiffness"]) == (pytest.approx(0.004), pytest.approx(2e4))
    assert np.allclose(point.u, 0.0, atol=1e-9)


def test_an_inversion_travels():
    inversion = pickle.loads(pickle.dumps(pam.plants.Inversion(hanging(0.1))))
    sent = inversion.commands({"muscle.opening": 0.2})
    assert sent["muscle.command"] == pytest.approx(0.2 * 0.95 + 0.05, rel=1e-12)


# ---- controllers from closed rest
def case(kind: str, feed: Any) -> tuple[pam.Plant, str, Any, Any]:
    """A plant, its position, a closed point of rest to start from, and one to reach."""
    strong, pair = pam.muscle("DMSP-20-400N"), pam.muscle("DMSP-20-200N")
    if kind == "hanging load":
        plant: pam.Plant = pam.HangingLoad(strong, mass=20.0, feed=feed)
        return plant, "x", plant.equilibrium(x=0.05), plant.equilibrium(x=0.08)
    if kind == "spring":
        plant = pam.SpringOverMuscle(pam.muscle("DMSP-20-300"), feed=feed)
        ends = (plant.equilibrium({"muscle.pressure": bar * BAR}) for bar in (2, 4))
        return plant, "x", *ends
    if kind == "slide":
        plant = pam.AntagonisticSlide(pair, mass=2.0, feed=feed)
        ends = (plant.equilibrium(x=x, stiffness=2.2e4) for x in (-0.004, 0.005))
        return plant, "x", *ends
    plant = pam.AntagonisticJoint(strong, link_mass=1.0, link_length=0.2, feed=feed)
    ends = (plant.equilibrium(theta=a, stiffness=25.0) for a in (0.0, 0.3))
    return plant, "theta", *ends


KINDS = ("hanging load", "spring", "slide", "joint")
FEEDS = [(k, OVERLAPS[i % 3]) for i, k in enumerate(KINDS)]
FEEDS += [
    pytest.param(k, OVERLAPS[(i + 1) % 3], marks=pytest.mark.slow) for i, k in enumerate(KINDS)
]


def missed(run: pam.Trajectory, name: str, start: Any, goal: Any) -> float:
    """The largest miss over the last 0.1 s, as a part of the stroke."""
    late = run.t >= run.t[-1] - 0.1
    return float(np.abs(run[name][late] - goal[name]).max() / abs(goal[name] - start[name]))


@pytest.mark.parametrize(("kind", "overlap"), FEEDS)
def test_lqr_and_tvlqr_reach_the_set_point_from_closed_rest(kind, overlap):
    plant, x, start, goal = case(kind, pam.feeds.SpoolValve(overlap=overlap))
    begin = at_rest(plant, start)
    loop = {"duration": 1.5, "sample_time": 4e-3, "rtol": 1e-6}
    still = pam.lqr(plant, goal, sample_time=4e-3)
    motion = closed_loop(still, plant, start=begin, **loop).trajectory
    assert missed(motion, x, start, goal) < 0.01
    times = np.linspace(0, 1.5, 151)
    along = pam.control.tvlqr(plant, motion, t=times, sample_time=4e-3, rtol=1e-5)
    begin[x] += 0.1 * (goal[x] - start[x])
    assert missed(closed_loop(along, plant, start=begin, **loop), x, start, goal) < 0.01


@pytest.mark.parametrize(("kind", "overlap"), FEEDS)
def test_mpc_reaches_the_set_point_from_closed_rest(kind, overlap):
    on_off = overlap == 0.1 and kind == "joint"
    feed = pam.feeds.OnOffValves() if on_off else pam.feeds.SpoolValve(overlap=overlap)
    plant, x, start, goal = case(kind, feed)
    track = {x: 1.0} | ({"stiffness": 0.05} if kind in ("slide", "joint") else {})
    rate = {v.name: 0.05 for v in plant.inputs}
    mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, track=track, rate=rate)
    loop = mpc.closed_loop(plant, {n: goal[n] for n in track}, 1.0, start=at_rest(plant, start))
    assert loop.statistics.failures == 0
    assert missed(loop.trajectory, x, start, goal) < 0.01


@pytest.mark.parametrize("solver", ["hpipm", "piqp", "ipopt"])
def test_every_solver_moves_the_closed_hanging_load(solver):
    plant, x, start, goal = case("hanging load", pam.feeds.SpoolValve())
    how = {"horizon": 15, "sample_time": 0.02, "rate": {"muscle.command": 0.05}}
    mpc = pam.Mpc(plant, track={x: 1.0}, solver=solver, **how)
    loop = mpc.closed_loop(plant, {x: goal[x]}, 0.6, start=at_rest(plant, start))
    assert loop.trajectory["muscle.command"][0] > 0.3
    assert missed(loop.trajectory, x, start, goal) < 0.01


def test_mpc_takes_weights_and_bounds_of_commands_and_predicts_in_commands():
    plant, x, start, goal = case("hanging load", pam.feeds.SpoolValve(overlap=0.1))
    asked = {"track": {x: 1.0, "muscle.command": 1e-3}, "bounds": {"muscle.command": (-0.3, 0.4)}}
    mpc = pam.Mpc(plant, horizon=10, sample_time=0.02, **asked)
    sent = mpc.control(at_rest(plant, start), {x: goal[x], "muscle.command": 0.1})
    assert sent["muscle.command"] == pytest.approx(0.4, rel=1e-6)
    predicted = mpc.prediction()
    assert predicted["muscle.command"][0] == pytest.approx(sent["muscle.command"], rel=1e-9)
    again = pam.simulate(plant, predicted, t=predicted.t, start=at_rest(plant, start))
    assert again[x] == pytest.approx(predicted[x], abs=1e-5)  # rk4 against a tight integrator


def test_mpc_against_the_plants_fmu_sends_commands(tmp_path):
    plant, x, start, goal = case("hanging load", pam.feeds.SpoolValve())
    path = export_fmu(plant, tmp_path / "plant.fmu", platforms="native")
    weights = {"track": {x: 1.0}, "rate": {"muscle.opening": 0.05}}
    mpc = pam.Mpc(plant, horizon=15, sample_time=0.02, **weights)
    begin, measured = at_rest(plant, start), {x: 1e-5, "muscle.pressure": 200.0}
    estimator = pam.KalmanFilter(plant, sample_time=0.02, measured=measured, start=begin)
    loop = mpc.closed_loop(path, {x: goal[x]}, 1.0, start=begin, estimator=estimator, seed=3)
    assert missed(loop.trajectory, x, start, goal) < 0.01


def test_a_kalman_filter_follows_the_pressure_from_the_commands():
    """LQG on a noisy position alone: the estimate of the pressure goes with the true one."""
    plant, x, start, goal = case("hanging load", pam.feeds.SpoolValve(overlap=0.1))
    feedback = pam.lqr(plant, goal, integral={x: 5.0}, sample_time=2e-3)
    known = {"measured": {x: 2e-5}, "process": {"v": 1.0, "muscle.pressure": 1.0}}
    watch = pam.control.kalman(plant, goal, **known, sample_time=2e-3)
    loop = {"duration": 1.0, "sample_time": 2e-3, "rtol": 1e-6, "noise": {x: 2e-5}}
    loop["start"] = {**at_rest(plant, goal), x: goal[x]}
    run = closed_loop(pam.control.WithEstimate(feedback, watch), plant, **loop)
    assert missed(run, x, start, goal) < 0.01
    estimate = watch.point.x[2] + watch.deviation[2]
    assert estimate == pytest.approx(run["muscle.pressure"][-1], abs=0.03 * BAR)


def test_a_scheduled_feedback_and_an_offset_free_one_move_valves():
    plant, x, start, goal = case("hanging load", pam.feeds.SpoolValve())
    loop = {"duration": 1.2, "sample_time": 4e-3, "rtol": 1e-6, "start": at_rest(plant, start)}
    axes, wanted = {x: [0.05, goal[x], 0.09]}, lambda t: {x: goal[x]}
    grid = pam.control.scheduled_lqr(plant, axes, wanted, sample_time=4e-3)
    assert missed(closed_loop(grid, plant, **loop), x, start, goal) < 0.01
    known = {"measured": {x: 1e-5, "muscle.pressure": 500.0}}
    known["disturbances"] = {"muscle.command": 0.1}
    watch = pam.control.kalman(plant, goal, **known, sample_time=4e-3)
    free = pam.control.OffsetFree(pam.lqr(plant, goal, sample_time=4e-3), watch, hold=[x])
    loop["start"] = at_rest(plant, plant.equilibrium(x=goal[x] - 0.004))
    leaking = closed_loop(free, plant, parameters={"muscle.gas.leak": 1e-10}, **loop)
    assert missed(leaking, x, start, goal) < 0.01


def test_as_nlsys_gives_a_linear_model_that_can_be_controlled():
    plant = hanging()
    point = plant.equilibrium(x=0.05)
    system = pam.operating.as_nlsys(plant, point)
    assert system.input_labels == ["muscle_opening"]
    linear = control.linearize(system, system.x0, system.u0)
    assert np.linalg.matrix_rank(control.ctrb(linear.A, linear.B / 1e8)) >= 2
    assert np.abs(linear.B).max() > 1e6
    commanded = pam.operating.as_nlsys(plant, point, inputs=["muscle.command"])
    assert commanded.input_labels == ["muscle_command"]


def test_the_pressure_loop_leaves_no_error_in_the_dead_zone():
    plant = hanging(0.2)
    left, loop = [], {"duration": 0.8, "sample_time": 2e-3, "rtol": 1e-6}
    loop["start"] = {"x": 0.06, "muscle.pressure": 2.9 * BAR}
    for model in (plant, plant.in_commands()):
        inner = PressureLoop(model, gain=5e-6)
        law = lambda t, y, inner=inner: inner({"muscle": 3.0 * BAR}, y)  # noqa: E731
        run = closed_loop(law, plant, **loop)
        left.append(abs(run["muscle.pressure"][-1] - 3.0 * BAR))
    assert left[0] < 500.0 < 2000.0 < left[1]


def test_an_lqr_of_a_pair_is_stable_in_all_its_motions():
    """Closed valves hold any co-contraction: nothing in the default weights would bring it back."""
    for seed in range(4):
        bar = np.random.default_rng(seed).uniform(1.2, 4.5, 2) * BAR
        plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-400N"), feed=pam.feeds.OnOffValves())
        point = plant.equilibrium({"muscle1.pressure": bar[0], "muscle2.pressure": bar[1]})
        for integral in (None, {"x": 5.0}):
            poles = pam.lqr(plant, point, integral=integral).poles
            assert poles.real.max() < -0.1


# ---- in the C code of a controller
def answers(
    path: Any, inputs: list[dict[str, float]], outputs: list[str], folder: Any
) -> list[Any]:
    from pam_ocp.export.runner import Runner, UnpackedFmu

    with Runner(UnpackedFmu(path, folder), "ModelExchange") as run:
        run.initialize(inputs[0], 0.0, None)
        found = []
        for values in inputs:
            run.set(values)
            found.append(run.get(outputs))
    return found


@pytest.mark.parametrize("overlap", [0.02, 0.1])
def test_the_fmu_of_a_state_feedback_contains_the_inversion(overlap, tmp_path):
    plant = hanging(overlap)
    feedback = pam.lqr(plant, {"x": 0.06})
    path = export_fmu(state_feedback_controller(feedback), tmp_path / "c.fmu", platforms="native")
    rng = np.random.default_rng(5)
    seen = []
    for _ in range(25):
        x = feedback.point.x + rng.normal(size=3) * [0.004, 0.05, 1e4] * 10 ** rng.uniform(-3, 0)
        seen.append(dict(zip(("x", "v", "muscle.pressure"), x.tolist(), strict=True)))
    found = answers(path, seen, ["muscle.command"], tmp_path / "unpacked")
    for values, (sent,) in zip(seen, found, strict=True):
        wanted = np.clip(feedback(0.0, values)["muscle.command"], -1, 1)
        assert sent == pytest.approx(wanted, abs=1e-9)
    openings = [opening_by_hand(float(sent), overlap) for (sent,) in found]
    deviations = np.array([[*v.values()] for v in seen]) - feedback.point.x
    by_hand = np.clip(-deviations @ feedback.K.ravel(), -1, 1)
    assert openings == pytest.approx(by_hand, abs=1e-9)


def test_a_pid_moves_openings_by_its_gains():
    plant = hanging(0.1)
    pid = pid_controller(plant, "x", {"muscle.command": 2.0}, proportional=10.0)
    assert "muscle.valve.overlap" in {v.name for v in pid.parameters}
    for error, ff in ((0.004, 0.0), (-0.01, 0.3), (0.2, 0.0), (1e-5, 0.0)):
        given = {"reference": 0.05 + error, "position": 0.05, "feedforward.muscle.command": ff}
        u = [given[v.name] for v in pid.inputs]
        x = [0.0 if v.name == "integrated" else error for v in pid.states]
        sent = float(pid.function(x, u, pid.vector("parameter"))[1])
        wanted = opening_by_hand(ff, 0.1) + 2.0 * 10.0 * error
        assert opening_by_hand(sent, 0.1) == pytest.approx(min(wanted, 1.0), abs=1e-12)


# ---- plants of one's own, and refusals
def cart(declared: bool) -> pam.Plant:
    """A cart on a motor whose first 0.4 of 5 do nothing."""
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    volt = plant.input("motor", min=-5.0, max=5.0)
    if declared:
        effect = plant.dead_zone(volt, 0.8)
    else:
        effect = clamp(volt - 0.4, 0.4) - clamp(-volt - 0.4, 0.4)
    plant.der(x, v)
    plant.der(v, 2.0 * effect - v)
    return plant


def test_a_dead_zone_of_ones_own_is_inverted():
    plant = cart(True)
    feedback = pam.lqr(plant, {"x": 0.0})
    sent = feedback(0.0, {"x": -0.01, "v": 0.0})["motor"]
    u = 0.01 * feedback.K[0, 0]
    s = sent / 0.8
    assert 0.4 * s**4 * (2 * s**2 - 6 * s + 5) == pytest.approx(u, rel=1e-9)
    run = closed_loop(feedback, plant, duration=8.0, sample_time=0.01, start={"x": 0.5})
    assert abs(run["x"][-1]) < 5e-3
    assert plant.in_openings().inputs[0].max == pytest.approx(4.6)


def test_an_input_without_influence_is_called_so():
    plant = cart(False)
    point = pam.operating.OperatingPoint(plant, np.zeros(2), np.zeros(1))
    refused("motor has no influence on x here: its slope is 0", pam.lqr, plant, point)
    mpc = pam.Mpc(plant, horizon=5, sample_time=0.05, track={"x": 1.0})
    with pytest.warns(UserWarning, match="motor has no influence on x over the horizon"):
        mpc.control([0.0, 0.0], {"x": 0.1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mpc = pam.Mpc(cart(True), horizon=5, sample_time=0.05, track={"x": 1.0})
        assert mpc.control([0.0, 0.0], {"x": 0.1})["motor"] > 0.4


# ---- plans ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("bounds", [None, {"muscle.command": (-0.5, 0.6)}], ids=["free", "bounded"])
def test_a_plan_in_openings_is_a_start_near_the_optimum_in_commands(bounds):
    plant = hanging(0.1)
    stops, way = [{"x": 0.05}, {"x": 0.075}], pam.Collocation(15, 3)
    planner = pam.Planner(plant, stops, bounds=bounds, method=way)
    search = search_of(planner)
    (near,), (first, *_) = search._from_openings(0, 1), search._solved(search._tasks(1), 0)
    assert near.objective < 1.01 * first.objective
    low, high = (bounds or {"muscle.command": (-1.0, 1.0)})["muscle.command"]
    solution = near.solved.solution
    sent = solution.inputs(np.linspace(0.0, solution.durations[0], 200))
    assert low - 1e-6 <= sent.min() < -0.2
    assert 0.2 < sent.max() <= high + 1e-6


def test_a_wish_about_commands_is_not_planned_in_openings():
    wish = {"time": 1.0, "square(muscle.command)": 0.1}
    planner = pam.Planner(hanging(0.1), [{"x": 0.05}, {"x": 0.06}], minimise=wish)
    assert search_of(planner)._from_openings(0, 1) == []
