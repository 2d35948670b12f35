"""Controllers from closed rest on feeds whose dead zone stands behind something that moves."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import rates_and_outputs, refused
from test_valve_control import opening_by_hand

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.control import block
from pam_ocp.control.blocks.running import BlockController
from pam_ocp.control.controller_plants import state_feedback_controller
from pam_ocp.control.linear_quadratic import effort_units
from pam_ocp.planning.continuation import ValveOpenings

F = pam.feeds
LAG, OVERLAP = 5e-3, 0.1


class OwnSpool(F.SpoolValve):
    """Two lags in a row before a dead zone that is declared."""

    def openings(self, plant: Any, name: str) -> tuple[ca.SX, ca.SX]:
        command = plant.input(f"{name}.command", min=-1.0, max=1.0, nominal=0.1)
        moved = command
        for part in ("coil", "slide"):
            state = plant.state(f"{name}.{part}", min=-2.0, max=2.0)
            plant.der(state, (moved - state) / 4e-3)
            moved = state
        effect = plant.dead_zone(moved, OVERLAP)
        return ca.fmax(effect, 0), ca.fmax(-effect, 0)


class Undeclared(F.SpoolValve):
    """A lag before a dead zone of which nobody is told."""

    def openings(self, plant: Any, name: str) -> tuple[ca.SX, ca.SX]:
        command = plant.input(f"{name}.command", min=-1.0, max=1.0, nominal=0.1)
        spool = plant.state(f"{name}.spool", min=-2.0, max=2.0, nominal=0.1)
        plant.der(spool, (command - spool) / LAG)
        return 10 * ca.fmax(spool - 0.05, 0) ** 2, 10 * ca.fmax(-spool - 0.05, 0) ** 2


FEEDS = {
    "first order": F.SpoolValve(spool=F.FirstOrderSpool()),
    "second order": F.SpoolValve(spool=F.SecondOrderSpool()),
    "no overlap": F.SpoolValve(overlap=0.0, spool=F.FirstOrderSpool()),
    "unlike sides": F.SpoolValve(
        overlap=0.1, exhaust_overlap=0.04, offset=0.03, spool=F.FirstOrderSpool()
    ),
    "hysteresis": F.SpoolValve(spool=F.FirstOrderSpool(hysteresis=0.02)),
    "hysteresis of second order": F.SpoolValve(spool=F.SecondOrderSpool(hysteresis=0.01)),
    "tube": F.SpoolValve(spool=F.FirstOrderSpool(), tube=F.Tube()),
    "own": OwnSpool(),
    "servo valve": F.ServoValve(pressure_gain=5e-6, spool=F.FirstOrderSpool()),
    "late servo valve": F.ServoValve(
        pressure_gain=5e-6, command_lag=5e-3, spool=F.FirstOrderSpool(hysteresis=0.01)
    ),
}
TYPICAL = ("first order", "unlike sides", "own", "late servo valve")
EVERY = [n if n in TYPICAL else pytest.param(n, marks=pytest.mark.slow) for n in FEEDS]
UNFINISHED = "ignore:closed loop. not as asked. [0-9]+ of [0-9]+ solves did not converge$"


def hanging(feed: Any) -> tuple[pam.Plant, Any, Any, dict[str, float]]:
    """DMSP-20-400N with 10 kg: (plant, closed rest, goal, states to begin with)."""
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    start, goal = plant.equilibrium(x=0.05), plant.equilibrium(x=0.08)
    return plant, start, goal, {v.name: start[v.name] for v in plant.states}


def ends_at(run: Any, goal: float, stroke: float) -> bool:
    late = run.t >= run.t[-1] - 0.1
    return bool(np.abs(run["x"][late] - goal).max() < 0.01 * stroke)


@pytest.mark.filterwarnings(UNFINISHED)
@pytest.mark.parametrize("name", EVERY)
def test_mpc_moves_a_hanging_load_from_closed_rest(name):
    plant, _, goal, begin = hanging(FEEDS[name])
    rate = {v.name: 0.05 for v in plant.inputs}
    mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, track={"x": 1.0}, rate=rate)
    loop = mpc.closed_loop(plant, {"x": goal["x"]}, 1.0, start=begin, rtol=1e-6)
    assert ends_at(loop, goal["x"], 0.03)


@pytest.mark.parametrize("name", EVERY)
def test_lqr_and_tvlqr_move_a_hanging_load_from_closed_rest(name):
    plant, _, goal, begin = hanging(FEEDS[name])
    step = 1e-3 if "second order" in name else 4e-3
    loop = {"duration": 1.2, "sample_time": step, "rtol": 1e-6}
    feedback = pam.lqr(plant, goal, sample_time=step, sampled=True)
    motion = pam.closed_loop(feedback, plant, start=begin, **loop).trajectory
    assert ends_at(motion, goal["x"], 0.03)
    times = np.linspace(0, 1.2, 121)
    along = pam.control.tvlqr(plant, motion, t=times, sample_time=step, rtol=1e-5)
    beside = begin | {"x": begin["x"] + 0.003}
    assert ends_at(pam.closed_loop(along, plant, start=beside, **loop), motion["x"][-1], 0.03)


def test_a_pair_behind_spools_holds_position_and_stiffness():
    feed = F.SpoolValve(overlap=0.05, spool=F.FirstOrderSpool())
    plant = pam.AntagonisticSlide("DMSP-20-200N", mass=2.0, feed=feed)
    start, goal = (plant.equilibrium(x=x, stiffness=2.2e4) for x in (-0.004, 0.005))
    law = pam.lqr(plant, goal, sample_time=4e-3, sampled=True)
    begin = {v.name: start[v.name] for v in plant.states}
    run = pam.closed_loop(law, plant, duration=1.5, start=begin, sample_time=4e-3, rtol=1e-6)
    assert ends_at(run, 0.005, 0.009)
    assert run["stiffness"][-1] == pytest.approx(2.2e4, rel=0.01)


def test_a_spool_is_too_quick_for_a_long_sample_time_and_that_is_said():
    plant, _, goal, begin = hanging(FEEDS["second order"])
    with pytest.raises(InputError, match=r"sample_time = 0\.04 s is too long.*sampled=True"):
        pam.lqr(plant, goal, sample_time=0.04)
    motion = pam.simulate(plant, duration=0.1, start=begin)
    with pytest.raises(InputError, match=r"tvlqr: sample_time = 0\.04 s .*sampled=True"):
        pam.control.tvlqr(plant, motion, sample_time=0.04, rtol=1e-5)


def test_spools_move_as_they_like_under_the_default_weights():
    """What is moved is weighed: the position of a spool of second order is not."""
    plant, _, goal, _ = hanging(FEEDS["second order"])
    named = pam.lqr(plant, goal, weights={"x": 10.0, "v": 1.0}, sample_time=1e-3)
    assert pytest.approx(named.K, rel=1e-12) == pam.lqr(plant, goal, sample_time=1e-3).K
    assert list(plant.load_positions) == ["x"]


def test_inputs_are_weighed_by_what_they_reach():
    """A servo valve of 2e-5/Pa is open at 0.5 bar, a fifth of which counts; a regulator has its
    nominal 1 bar, though one of two muscles goes slack when it is let down.
    """
    for feed, unit in ((F.ServoValve(pressure_gain=2e-5), 1e4), (F.Regulator(), 1e5)):
        plant = pam.AntagonisticSlide("DMSP-20-200N", mass=2.0, feed=feed)
        goal = plant.equilibrium(x=0.0, stiffness=2.2e4)
        names = [v.name for v in plant.inputs]
        assert effort_units(plant, goal.x, goal.u, names) == pytest.approx([unit, unit], rel=0.3)


@pytest.mark.slow
def test_a_dead_zone_that_is_not_declared_is_said_once():
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=Undeclared())
    rest = pam.HangingLoad("DMSP-20-400N", 10.0).equilibrium(x=0.05)
    begin = {"x": 0.05, "muscle.pressure": rest["muscle.pressure"]}
    point = pam.operating.OperatingPoint(plant, plant.vector("state", begin), plant.vector("input"))
    refused(r"muscle\.command has no influence on x here", pam.lqr, plant, point)
    mpc = pam.Mpc(plant, horizon=15, sample_time=0.01, track={"x": 1.0})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        loop = mpc.closed_loop(plant, {"x": 0.08}, 0.3, start=begin)
    assert [str(w.message) for w in said] == [f"closed loop: {loop.verdict}"]
    assert loop.verdict.idle == ("muscle.command",)
    with pytest.warns(UserWarning, match="no influence on x over the horizon"):
        pam.Mpc(plant, horizon=15, sample_time=0.01, track={"x": 1.0}).control(point.x)


# ---- the inverse ---------------------------------------------------------------------------------
def play_by_hand(s: float, before: float, half: float) -> float:
    """Where a part with backlash stands that is moved to s."""
    return float(np.clip(before, s - half, s + half))


@pytest.mark.parametrize("w", [-0.7, -0.05, 0.02, 0.4])
@pytest.mark.parametrize("begin", [-0.3, 0.0, 0.3])
def test_at_rest_the_command_leaves_the_valve_at_the_opening(w, begin):
    width = 0.02
    feed = F.SpoolValve(overlap=OVERLAP, spool=F.FirstOrderSpool(LAG, hysteresis=width))
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    inversion = pam.plants.Inversion(plant)
    for side in (-1.0, 0.0, 1.0):  # where in its play the spool stands
        here = {"muscle.valve.spool": begin, "muscle.valve.play": side}
        sent = inversion.commands({"muscle.opening": w}, measured=here)["muscle.command"]
        position = play_by_hand(sent, begin - width / 2 * side, width / 2)
        assert opening_by_hand(position, OVERLAP) == pytest.approx(w, abs=1e-3)


def test_inside_the_spool_follows_the_opening_and_nothing_is_lost_on_the_way():
    plant, start, _, _ = hanging(F.SpoolValve(overlap=OVERLAP, spool=F.FirstOrderSpool(LAG)))
    inversion = pam.plants.Inversion(plant)
    assert not inversion.exact
    system = plant.linearize(start, inputs=["muscle.opening"])
    spool = system.state_labels.index("muscle_valve_spool")
    assert system.A[spool, spool] == pytest.approx(-1 / LAG, rel=1e-12)
    assert system.B[spool, 0] == pytest.approx(1 / LAG, rel=1e-12)
    for s in (-0.8, -0.04, 0.0, 0.07, 0.5):
        x = start.x.copy()
        x[spool] = s
        moved = inversion.inside(x)
        assert moved[spool] == pytest.approx(opening_by_hand(s, OVERLAP), abs=1e-14)
        if abs(s) >= OVERLAP:  # closed it has forgotten where in the overlap it was
            assert inversion.inside(moved, inwards=False)[spool] == pytest.approx(s, rel=1e-12)


def test_the_rest_of_a_valve_that_leaks_is_the_plants_own():
    feed = F.SpoolValve(overlap=OVERLAP, leak=1e-10, spool=F.SecondOrderSpool(hysteresis=0.02))
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    point = plant.equilibrium(x=0.05)
    rates = np.asarray(plant.function(point.x, point.u, plant.vector("parameter"))[0]).ravel()
    assert np.abs(rates / plant.vector("state", attribute="nominal")).max() < 1e-6
    assert opening_by_hand(point["muscle.valve.spool"], OVERLAP) > 1e-3  # fills what leaks
    assert point["muscle.command"] == pytest.approx(point["muscle.valve.spool"], rel=1e-9)


def test_a_plant_with_moving_spools_travels():
    plant = pickle.loads(pickle.dumps(hanging(FEEDS["late servo valve"])[0]))
    inversion = pam.plants.Inversion(plant)
    assert [v.name for v in inversion.inner.inputs] == ["muscle.aim"]
    assert set(inversion.carried) == {"muscle.valve.spool", "muscle.demand"}


def test_plans_do_not_take_openings_that_are_not_exact():
    plant = hanging(FEEDS["first order"])[0]
    assert ValveOpenings.of(plant, None) is None  # type: ignore[arg-type]


def test_a_position_that_follows_no_input_is_refused():
    plant = pam.Plant("p")
    s = plant.state("s")
    refused("follows one input by states whose equations", plant.dead_zone, s, 0.1)


# ---- blocks and controllers as plants ------------------------------------------------------------
def test_blocks_of_controllers_send_the_same_commands():
    plant, _, goal, begin = hanging(FEEDS["hysteresis of second order"])
    feedback = pam.lqr(plant, goal, sample_time=2e-3, sampled=True)
    rng = np.random.default_rng(5)
    made = BlockController(block(feedback))
    u, nominal = plant.variable("muscle.command"), plant.vector("state", attribute="nominal")
    for _ in range(8):
        off = 0.3 * nominal * rng.standard_normal(len(nominal))
        seen = {n: v + e for (n, v), e in zip(begin.items(), off, strict=True)}
        wanted = np.clip(feedback(0.0, seen)["muscle.command"], u.min, u.max)
        assert made(0.0, seen)["muscle.command"] == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_a_controller_as_a_plant_carries_the_spool():
    plant, _, goal, begin = hanging(FEEDS["unlike sides"])
    feedback = pam.lqr(plant, goal, sample_time=2e-3)
    built = state_feedback_controller(feedback)
    seen = {**begin, "x": goal["x"] - 1e-6, "muscle.valve.spool": 0.1}
    seen["muscle.pressure"] = goal["muscle.pressure"]
    told = {v.name: seen[v.name] for v in built.inputs if v.name in seen}
    sent = rates_and_outputs(built, told)[1]["muscle.command"]
    wanted = np.clip(feedback(0.0, seen)["muscle.command"], -1, 1)
    assert sent == pytest.approx(wanted, rel=1e-6)


def test_an_estimate_is_one_of_the_plants_own_states():
    plant, _, goal, begin = hanging(F.SpoolValve(overlap=OVERLAP, spool=F.FirstOrderSpool()))
    loop = {"duration": 1.2, "sample_time": 4e-3, "rtol": 1e-6}
    feedback = pam.lqr(plant, goal, sample_time=4e-3, sampled=True)
    measured = {"x": 1e-5, "muscle.pressure": 300.0}
    watch = pam.control.kalman(plant, goal, measured=measured, sample_time=4e-3)
    law = pam.control.WithEstimate(feedback, watch)
    run = pam.closed_loop(law, plant, start=begin, **loop)
    assert ends_at(run, goal["x"], 0.03)


@pytest.mark.slow
def test_on_a_sample_of_all_feeds_nothing_is_silent(monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import harness
    import valve_study

    rows = harness.run(valve_study.cases, harness.asked(4, 31))
    counts = valve_study.counted(rows)
    assert sum(c["SILENT"] + c["TWICE"] for c in counts.values()) == 0, capsys.readouterr().out
    assert counts["Mpc"]["within"] >= 3
