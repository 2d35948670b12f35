"""Rest at stops, in whatever coordinates a plant is written; and what the past leaves at the first
stop.
"""

import warnings

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.operating.held import held, surroundings
from pam_ocp.planning.problem.formulation import formulate

METHOD = Collocation(10, 5)
COARSE = Collocation(8, 3)
"""Where only the begin of a motion is looked at."""


def moved(rate, spread, states=("v",), unit="1", name="x"):
    """x' = rate(x, velocities), velocities' = spread(velocities) u, |u| <= 1: always x'' = u."""
    plant = pam.Plant("mass")
    velocities = [plant.state(n) for n in states]  # before the position: the order says nothing
    x = plant.state(name, unit=unit)
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, rate(x, *velocities))
    for velocity, share in zip(velocities, spread(x, *velocities), strict=True):
        plant.der(velocity, share * u)
    return plant


COORDINATES = {
    "literal": moved(lambda x, v: v, lambda x, v: [1]),
    "gear": moved(lambda x, v: v / 2, lambda x, v: [2]),
    "momentum": moved(lambda x, p: p / 3, lambda x, p: [3], ["momentum"], "m"),
    "millimetres": moved(lambda x, v: 1e-3 * v, lambda x, v: [1e3]),
    "sum of two": moved(lambda x, v, w: v + w, lambda x, v, w: [0.3, 0.7], ["v", "w"]),
    "function": moved(lambda x, v: ca.sinh(v), lambda x, v: [1 / ca.cosh(v)]),
}


@pytest.mark.parametrize("coordinates", COORDINATES)
def test_a_motion_from_rest_to_rest_is_the_same_in_all_coordinates(coordinates):
    """T = 2 sqrt(d/a), with the switch on the mesh."""
    plan = pam.plan(COORDINATES[coordinates], [{"x": 0.0}, {"x": 1.0}], method=METHOD)
    assert plan.duration == pytest.approx(2.0, rel=1e-6)
    ends = plan.trajectory.array([v.name for v in plan.plant.states if v.name != "x"])[[0, -1]]
    assert ends.sum(axis=1) == pytest.approx([0.0, 0.0], abs=1e-8)


def pulled():
    """x'' = f + w, where f lags behind u."""
    plant = pam.Plant("pulled")
    x, v, f = plant.state("x"), plant.state("v"), plant.state("f", min=-4.0, max=4.0)
    u, w = (plant.input(n, min=-4.0, max=4.0) for n in "uw")
    plant.der(x, v)
    plant.der(v, f + w)
    plant.der(f, (u - f) / 0.1)
    return plant


def test_the_inputs_that_the_first_stop_names_hold_the_plant_there():
    stops, asked = [{"x": 0.0}, {"x": 1.0}], {"method": METHOD}
    for named, force in (({"w": -1.0}, 1.0), ({"u": 0.5}, 0.5)):
        plan = pam.plan(pulled(), [stops[0] | named, stops[1]], **asked)
        assert plan.trajectory["f"][0] == pytest.approx(force, abs=1e-7)


def test_a_dwell_is_two_stops_with_the_same_place():
    """Other inputs hold the plant when it leaves than when it came, and the next leg's are free."""
    asked = {"method": METHOD}
    stay, ends = [None, pam.Phase(bounds={"x": (0.499, 0.501)}), None], [{"x": 0.0}, {"x": 1.0}]
    dwell = pam.Stop({"x": 0.5, "w": (-9.0, 9.0)}, dwell=0.5)
    plan = pam.plan(pulled(), [ends[0], dwell, ends[1]], **asked)
    stops = [ends[0], {"x": 0.5}, {"x": 0.5}, ends[1]]
    two = pam.plan(pulled(), stops, duration=[None, 0.5, None], phases=stay, **asked)
    assert plan.duration == pytest.approx(two.duration, rel=1e-6)


def test_a_dwell_keeps_no_limits_of_the_leg_behind_it():
    plant = pulled()
    own = pam.Constraint(plant.expression("w"), high=1.0, name="own")
    stops = [{"x": 0.0}, pam.Stop({"x": 0.5}, dwell=0.5), {"x": 1.0}]
    said = pam.judge.Statement(stops, phases=[None, pam.Phase(constraints=[own])])
    paths = [[c.label for c in leg.path] for leg in formulate(plant, said).legs]
    assert paths == [[], ["dwell at stop 2: x"], ["own"]]


def test_generalised_coordinates_rest_as_the_place_does():
    """q with x = sinh(q) and q' = v/cosh(q)."""
    plant = pam.Plant("generalised")
    q, v = plant.state("q"), plant.state("v")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(q, v / ca.cosh(q))
    plant.der(v, u)
    plant.output("x", ca.sinh(q))
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}], method=METHOD)
    assert plan.duration == pytest.approx(2.0, rel=1e-6)


def test_a_wheel_that_counts_and_an_integral_ask_for_nothing_more():
    plant = pam.Plant("mass")
    x, v = plant.state("x"), plant.state("v")
    wheel, total = plant.state("wheel"), plant.state("total")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, v)
    plant.der(v, u)
    plant.der(wheel, -3 * v)
    plant.der(total, x)
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}], method=METHOD)
    assert plan.duration == pytest.approx(2.0, rel=1e-6)
    assert plan.trajectory["total"][0] == pytest.approx(0.0, abs=1e-9)


def test_a_lag_before_the_force_must_have_settled_but_may_not_rest():
    """m x'' = f, f' = (u - f)/lag: velocity and acceleration vanish, the force's rate need not."""

    def plant_with(scale):
        plant = pam.Plant("lagging")
        x, v, f = plant.state("x"), plant.state("v"), plant.state("f")
        u = plant.input("u", min=-1.0, max=1.0)
        plant.der(x, v * scale)
        plant.der(v, f / scale)
        plant.der(f, (u - f) / 0.1)
        return plant

    plans = [
        pam.plan(plant_with(scale), [{"x": 0.0}, {"x": 1.0}], method=Collocation(20, 3))
        for scale in (1.0, 0.5)
    ]
    assert plans[0].duration == pytest.approx(plans[1].duration, rel=1e-6)
    for plan in plans:
        motion = plan.trajectory
        assert motion.array(["v", "f"])[[0, -1]] == pytest.approx(np.zeros((2, 2)), abs=1e-7)
        assert abs(motion["u"][-1] - motion["f"][-1]) / 0.1 > 1.0


@pytest.mark.slow
def test_a_stop_is_a_place_where_inputs_could_hold_the_plant():
    """A thrown ball has no velocity at its height, but cannot stay there: |u| < g."""
    plant = pam.Plant("ball")
    x, v = plant.state("x"), plant.state("v")
    u = plant.input("u", min=-5.0, max=5.0)
    plant.der(x, v)
    plant.der(v, u - 9.81)
    with pytest.raises(pam.PlanError, match=r"at rest|holds it"):
        pam.plan(plant, [{"x": 0.0}, {"x": 0.1}], method=COARSE, starts=1, tolerance=None)


def test_inputs_that_would_hold_a_stop_keep_the_path_constraints():
    """Where the ball comes to, no thrust that its place allows can hold it."""
    plant = pam.Plant("ball")
    x, v = plant.state("x"), plant.state("v")
    u = plant.input("u", min=-30.0, max=30.0)
    plant.der(x, v)
    plant.der(v, u - 9.81)
    plant.constraint("thrust", u + 250 * x, max=30.0)  # 17.5 at x = 0.05, 5 at x = 0.1
    assert pam.plan(plant, [{"x": 0.0}, {"x": 0.05}], method=METHOD).solved
    with pytest.raises(pam.PlanError, match="no plan found"):
        pam.plan(plant, [{"x": 0.0}, {"x": 0.1}], method=METHOD)


def test_where_nothing_can_rest_it_is_said():
    plant = pam.Plant("decay")
    y = plant.state("y")
    plant.der(y, -y)
    refused("rest=False", pam.plan, plant, [{"y": 1.0}, {"y": 0.5}])


@pytest.mark.slow
def test_a_level_without_a_position_stands_where_an_input_can_hold_it():
    plant = pam.Plant("lag")
    y, u = plant.state("y"), plant.input("u", min=-1.0, max=1.0)
    plant.der(y, (u - y) / 0.1)
    plan = pam.plan(plant, [{"y": 0.0}, {"y": 0.5}])
    assert plan.verified
    assert plan.duration == pytest.approx(0.1 * np.log(2.0), rel=1e-6)  # u = 1 all along
    with pytest.raises(pam.PlanError):  # no input holds 1.5
        pam.plan(plant, [{"y": 0.0}, {"y": 1.5}], starts=1)


def test_a_sum_of_states_stands_still_where_no_state_is_a_position():
    """A double integrator in a = x + v, b = x - v: 2 sqrt(distance) as in any other coordinates."""
    plant = pam.Plant("turned")
    a, b, u = plant.state("a"), plant.state("b"), plant.input("u", min=-1.0, max=1.0)
    plant.der(a, (a - b) / 2 + u)
    plant.der(b, (a - b) / 2 - u)
    plant.output("x", (a + b) / 2)
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}])
    assert plan.verified
    assert plan.duration == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(
    "plant",
    [
        pam.AntagonisticSlide(
            pam.muscle("DMSP-20-200N"), losses=(pam.losses.MaxwellSlip(), pam.losses.Creep())
        ),
        pam.HangingLoad(
            pam.muscle("DMSP-20-200N"), feed=pam.feeds.SpoolValve(tube=pam.feeds.Tube())
        ),
        pam.RegulatedLoad(pam.muscle("DMSP-20-200N"), losses=(pam.losses.BoucWen(),)),
    ],
    ids=lambda plant: plant.name,
)
def test_pressures_and_memories_are_no_positions(plant):
    assert [q.name for q in plant.resting()] == ["x"]


# ---- memory ----------------------------------------------------------------------------------
LOSSES = (pam.losses.MaxwellSlip(), pam.losses.Creep())
MEMORIES = [f"muscle.slip{i}" for i in (1, 2, 3, 4)]


@pytest.fixture(scope="module")
def lossy():
    return pam.HangingLoad(pam.muscle("DMSP-20-200N"), mass=10.0, losses=LOSSES)


WAY = [{"x": 0.010}, {"x": 0.030}]


@pytest.mark.parametrize(("memory", "expected"), [("virgin", 0.0), ("above", -1.0), ("below", 1.0)])
def test_a_plan_begins_with_the_memory_it_is_given_and_settled_creep(lossy, memory, expected):
    plan = pam.plan(lossy, WAY, memory=memory, method=COARSE, tolerance=None)
    motion = plan.trajectory
    assert motion.array(MEMORIES)[0] == pytest.approx(np.full(4, expected), abs=1e-6)
    assert motion["muscle.creep1"][0] == pytest.approx(0.010 / 0.2, rel=1e-6)  # its contraction
    assert np.all(np.abs(motion.array(MEMORIES)) <= 1.05)


@pytest.mark.slow
def test_a_plan_with_slipping_memory_is_verified(lossy):
    plan = pam.plan(lossy, WAY)
    assert plan.verified
    replay = pam.simulate(lossy, plan.trajectory)
    assert replay["x"][-1] == pytest.approx(0.030, abs=1e-5)
    assert np.all(np.abs(replay.array(MEMORIES)) <= 1.0 + 1e-6)


def test_single_memories_are_given_by_name_and_a_cycle_closes_them(lossy):
    plan = pam.plan(lossy, WAY, memory={"muscle.slip4": -0.5}, method=COARSE, tolerance=None)
    assert plan.trajectory.array(MEMORIES)[0] == pytest.approx([0.0, 0.0, 0.0, -0.5], abs=1e-6)
    refused("closes its memories", pam.plan, lossy, WAY, memory="below", cyclic=True)
    refused("slip9", pam.plan, lossy, WAY, memory={"muscle.slip9": 0.0})


def test_a_sensor_has_settled_and_a_total_begins_at_its_start():
    plant = pam.Plant("measured")
    x, v = plant.state("x"), plant.state("v")
    y, spent = plant.state("y"), plant.state("spent", unit="J", start=2.0)
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, v)
    plant.der(v, u)
    plant.der(y, (x - y) / 0.3)
    plant.der(spent, u**2)
    stops = [{"x": 0.5}, {"x": 1.0}]
    plan = pam.plan(plant, stops, method=METHOD)
    assert plan.trajectory["y"][0] == pytest.approx(0.5, abs=1e-8)
    assert plan.trajectory["spent"][0] == pytest.approx(2.0, abs=1e-8)
    cycle = pam.plan(plant, stops, method=METHOD, cyclic=True)
    assert cycle.trajectory["y"][[0, -1]] == pytest.approx(cycle.trajectory["y"][[0, 0]], abs=1e-8)
    assert cycle.trajectory["spent"][-1] > 2.1


# ---- economical motions -------------------------------------------------------------------------
@pytest.mark.slow
def test_least_work_of_a_slide_is_found_and_is_what_its_replay_gives():
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))
    plan = pam.plan(
        slide,
        [{"x": -0.010}, {"x": 0.010}],
        duration=0.3,
        minimise="work",
        method=Collocation(20, 3),
    )
    assert plan.verified
    motion = plan.replay.trajectory
    sides = {1: 1.0, 2: -1.0}  # x shortens the first muscle and stretches the second
    given = sum(
        np.maximum(motion[f"muscle{i}.force"] * sign * motion["v"], 0.0)
        for i, sign in sides.items()
    )
    work = np.sum((given[1:] + given[:-1]) / 2 * np.diff(motion.t))
    assert plan.objective == pytest.approx(work, rel=5e-3)


def test_air_is_not_saved_by_venting_what_was_given():
    load = pam.HangingLoad(pam.muscle("DMSP-20-200N"), mass=10.0, feed=pam.feeds.SpoolValve())
    with pytest.warns(pam.PlanWarning, match="at rest with muscle.pressure"):
        plan = pam.plan(
            load,
            WAY,
            duration=0.5,
            minimise="air",
            method=Collocation(15, 3),
            tolerance=None,
            starts=1,
        )
    at_rest = load.equilibrium(x=0.010)
    assert plan.trajectory["muscle.pressure"][0] == pytest.approx(
        at_rest["muscle.pressure"], rel=1e-5
    )
    assert plan.objective > 0.1  # grams


def test_a_tank_holds_what_it_was_filled_with_from_whichever_side_the_load_came():
    tank = pam.feeds.Receiver(2e-3, pressure=5e5, source=None, wall_conductance=2.0)
    feed = pam.feeds.SpoolValve(supply=tank)
    slide = pam.AntagonisticSlide("DMSP-20-200N", feed=feed)
    load = pam.HangingLoad("DMSP-20-200N", 10.0, feed=feed, losses=pam.losses.BoucWen())
    for memory, side in (("above", -1.0), ("below", 1.0)):
        assert held(slide, memory) == {"receiver.air_pressure": 5e5}
        assert held(load, memory) == {"receiver.air_pressure": 5e5, "muscle.hysteresis": side}


def test_a_tank_does_not_drain_through_open_valves_before_a_motion():
    """With both ways open the muscle's pressure stood still while the tank, cooled by the flow, ran
    empty: quicker by a tank at 180 K, and verified."""
    tank = pam.feeds.Receiver(6e-3, pressure=8e5, source=None, wall_conductance=1.3)
    load = pam.HangingLoad("DMSP-20-300", 40.0, feed=pam.feeds.OnOffValves(supply=tank))
    plan = pam.plan(load, [{"x": 0.012}, {"x": 0.034}], duration=(0.02, 8.0))
    assert plan.verified
    assert plan.trajectory["receiver.air_temperature"][0] == pytest.approx(293.15, abs=0.3)


@pytest.mark.slow
def test_a_tank_that_leaks_before_a_motion_has_to_be_named():
    """No rest keeps its air; with its pressure named, the motion begins as it is said."""
    tank = pam.feeds.Receiver(5e-3, pressure=7e5, source=None)
    feed = pam.feeds.OnOffValves(supply=tank, leak=1e-11)
    load = pam.HangingLoad("DMSP-20-400N", 10.0, damping=50.0, feed=feed)
    with pytest.raises(pam.PlanError, match=r"receiver\.air_pressure.*name that state"):
        pam.plan(load, [{"x": 0.02}, {"x": 0.05}], starts=1)
    named = {"x": 0.02, "receiver.air_pressure": 7e5}
    plan = pam.plan(load, [named, {"x": 0.05}], starts=1)
    assert plan.verified


def test_a_compressor_that_feeds_a_leak_has_settled_where_both_flows_agree():
    """The tank was held where it stands with valves closed, 0.7 kPa above."""
    source = pam.feeds.Compressor(flow=1e-3, pressure=8e5, band=2e4)
    tank = pam.feeds.Receiver(1e-3, pressure=7.5e5, source=source, wall_conductance=1.0)
    feed = pam.feeds.SpoolValve(supply=tank, leak=3e-11, max_pressure=6e5)
    load = pam.HangingLoad("DMSP-20-400N", 10.0, damping=50.0, feed=feed)
    wish = {"duration": 0.6, "minimise": "effort", "starts": 1}
    plan = pam.plan(load, [{"x": 0.02}, {"x": 0.05}], **wish)
    assert plan.verified
    x = np.array([plan.trajectory[v.name][0] for v in load.states])
    names, p = [v.name for v in load.states], load.vector("parameter")

    def rates(command: float) -> np.ndarray:
        return np.asarray(load.function(x, [command], p)[0], float).ravel()

    pressure, tank_pressure = (names.index(f"{n}pressure") for n in ("muscle.", "receiver.air_"))
    command = brentq(lambda u: rates(u)[pressure], -1.0, 1.0, xtol=1e-13)
    at_rest = rates(command) / load.vector("state", attribute="nominal")
    assert np.abs(at_rest).max() < 1e-6
    assert x[tank_pressure] < surroundings(load)["receiver.air_pressure"] - 100.0


@pytest.mark.slow
def test_where_pressures_are_given_the_plant_rests():
    """Leaks have to be fed, creep has to have come to its end: no rest was found, and start values
    stood for it."""
    pair = pam.AntagonisticSlide(
        "DMSP-20-200N",
        2.0,
        feed=pam.feeds.SpoolValve(leak=2e-12, tube=pam.feeds.Tube()),
        losses=pam.losses.LoadCreep(),
        damping=50.0,
    )
    with pytest.warns(pam.PlanWarning, match="at rest with"):
        plan = pam.plan(pair, [{"x": -0.006}, {"x": 0.001}], duration=1.0, minimise="exergy")
    assert plan.verified


@pytest.mark.slow
def test_least_air_begins_with_muscles_as_warm_as_their_surroundings():
    """Without rows for air and rubber it began at 500 K, and saved the air that cools."""
    gas = pam.gas.Gas(heat=pam.muscles.ConstantHeatTransfer(50.0), rubber=pam.muscles.Rubber())
    load = pam.HangingLoad("DMSP-20-200N", mass=10.0, feed=pam.feeds.SpoolValve(gas=gas))
    with pytest.warns(pam.PlanWarning, match="at rest with muscle.pressure"):
        plan = pam.plan(load, WAY, duration=0.5, minimise="air", method=Collocation(15, 3))
    assert plan.verified
    for name in ("muscle.temperature", "muscle.rubber_temperature"):
        assert plan.trajectory[name][0] == pytest.approx(load.variable(name).start, abs=0.01)


# ---- where muscles are slack, or a dead band hides what acts -------------------------------------
def accelerations_at_the_ends(plan, velocity):
    plant, run = plan.plant, plan.replay.trajectory
    names, p = [v.name for v in plant.states], plant.vector("parameter")
    x, u = run.array(names), run.array([v.name for v in plant.inputs])
    rates = [np.ravel(plant.function(x[i], u[i], p)[0]) for i in (0, -1)]
    return [rate[names.index(velocity)] for rate in rates]


def test_a_slide_whose_muscles_may_be_slack_rests_at_its_stops():
    """Without rows for it, the least time had 121 and -101 m/s2 at its stops."""
    slide = pam.AntagonisticSlide("DMSP-10-250", 2.0, damping=20.0, feed=pam.feeds.Regulator())
    plan = pam.plan(slide, [{"x": -0.010}, {"x": 0.010}])
    assert plan.verified
    assert accelerations_at_the_ends(plan, "v") == pytest.approx([0.0, 0.0], abs=0.05)


@pytest.mark.parametrize("spring", [0.0, 20.0])
def test_what_only_pushes_beyond_a_dead_band_is_led_to_rest(spring):
    """Rows of acceleration have no slope inside the band, where the motion may begin."""
    plant = pam.Plant("pushed")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    p, q = (plant.state(n, min=0.0, max=1.0) for n in "pq")
    a, b = (plant.input(n, min=0.0, max=1.0) for n in "ab")
    plant.der(x, v)
    plant.der(v, 10 * (ca.fmax(p - 0.4, 0) - ca.fmax(q - 0.4, 0)) - v - spring * x)
    plant.der(p, (a - p) / 0.05)
    plant.der(q, (b - q) / 0.05)
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 0.1}], duration=1.5, minimise="effort")
    assert plan.verified
    assert accelerations_at_the_ends(plan, "v") == pytest.approx([0.0, 0.0], abs=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("minimise", ["effort", "air"])
def test_what_has_slid_under_pressure_begins_at_the_envelope_of_that_pressure(minimise):
    """Dry friction (1 + per_pressure p) F0: a falling pressure lets go what it does not hold, so
    the state, in units of the widest envelope, is at (1 + per_pressure p)/(1 + per_pressure most).
    """
    per_pressure, most = 1.5e-6, 6e5
    slip = pam.losses.MaxwellSlip((4.0, 3.0), (0.003, 0.01), per_pressure=per_pressure)
    muscle = pam.muscle("DMSP-20-400N")
    feed = pam.feeds.SpoolValve() if minimise == "air" else pam.feeds.Regulator()
    plant = pam.HangingLoad(muscle, 12.0, losses=slip, feed=feed)
    assert plant.variable("muscle.pressure").max == pytest.approx(most)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pam.PlanWarning)  # pressures are given where air counts
        wish = {"duration": 0.8, "minimise": minimise, "memory": "above", "starts": 1}
        plan = pam.plan(plant, [{"x": 0.02}, {"x": 0.035}], **wish)
    assert plan.verified
    begin = plan.trajectory
    share = (1 + per_pressure * begin["muscle.pressure"][0]) / (1 + per_pressure * most)
    assert share < 0.8
    for name in ("muscle.slip1", "muscle.slip2"):
        # rounded, it gives up or keeps a little
        assert -1.03 * share <= begin[name][0] <= -0.95 * share


@pytest.mark.slow
def test_what_has_slid_begins_at_the_envelope_of_a_pressure_that_is_the_input():
    """The same law where the pressure is no state and jumps as the motion begins: what has slid
    knows the one that held the load before.
    """
    slip = pam.losses.MaxwellSlip((4.0, 3.0), (0.003, 0.01), per_pressure=1.5e-6)
    feed = pam.feeds.IdealPressure(6e5)
    plant = pam.HangingLoad("DMSP-20-400N", 12.0, losses=slip, feed=feed)
    stops = [{"x": 0.02}, {"x": 0.035}]
    plan = pam.plan(plant, stops, duration=0.8, minimise="effort", memory="above")
    assert plan.verified

    def share(pressure):
        return (1 + 1.5e-6 * pressure) / (1 + 1.5e-6 * 6e5)

    def falls(pressure):
        x = [0.02, 0.0, -share(pressure), -share(pressure)]
        return float(plant.function(x, [pressure], plant.vector("parameter"))[0][1])

    held = share(brentq(falls, 1e3, 6e5))
    assert abs(held - share(plan.trajectory["muscle.pressure"][0])) > 0.03
    for name in ("muscle.slip1", "muscle.slip2"):
        assert -1.03 * held <= plan.trajectory[name][0] <= -0.98 * held


@pytest.mark.slow
def test_a_pair_that_chooses_its_pressures_begins_at_their_envelopes():
    slip = pam.losses.MaxwellSlip((4.0,), (0.003,), per_pressure=1.5e-6)
    plant = pam.AntagonisticSlide("DMSP-20-400N", 3.0, losses=slip, feed=pam.feeds.Regulator())
    most = plant.variable("muscle1.pressure").max
    wish = {"duration": 0.6, "minimise": "effort", "memory": "below"}
    plan = pam.plan(plant, [{"x": -0.008}, {"x": 0.01}], **wish)
    assert plan.verified
    for k in (1, 2):
        pressure = plan.trajectory[f"muscle{k}.pressure"][0]
        share = (1 + 1.5e-6 * pressure) / (1 + 1.5e-6 * most)
        assert 0.95 * share <= abs(plan.trajectory[f"muscle{k}.slip1"][0]) <= 1.03 * share


@pytest.mark.parametrize("reached", [0.0, 0.3])
@pytest.mark.slow
def test_a_muscle_behind_a_tendon_was_contracted_before_as_far_as_it_rests(reached):
    # a stop says where the load is; where the muscle's end is follows from the tendon
    muscle = pam.muscle("DMSP-20-300")
    loss = pam.losses.Preconditioning(reached=reached)
    plant = pam.SeriesLoad(muscle, 10.0, 2e4, feed=pam.feeds.Regulator(), losses=loss)
    wish = {"duration": 1.0, "minimise": "rate", "method": Collocation(10, 3), "starts": 1}
    plan = pam.plan(plant, [{"x": 0.035}, {"x": 0.01}], **wish)
    assert plan.verified
    stretch = 10.0 * 9.80665 / 2e4
    contraction = (0.035 + stretch) / 0.3
    begun = plan.trajectory["muscle.reached"][0]
    assert begun == pytest.approx(max(reached, contraction), abs=1e-3)  # over which it is rounded
