"""What the judge asks of a start: rest, temperatures, tanks, spools, memories."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import judged_held, refused

import pam_ocp as pam
from pam_ocp.judge import Motion, Statement, judge


def heated(**supply) -> pam.Plant:
    gas = pam.gas.Gas(heat=pam.muscles.ConstantHeatTransfer(5.0))
    feed = pam.feeds.SpoolValve(gas=gas, **supply)
    return pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)


@pytest.mark.slow
def test_a_warm_start_is_told_where_it_was_said():
    warm = {"x": 0.01, "muscle.temperature": 330.0, "der(muscle.pressure)": (None, None)}
    plan = pam.plan(heated(), [warm, {"x": 0.04}], method=pam.Collocation(15, 3))
    assert plan.trajectory["muscle.temperature"][0] == pytest.approx(330.0, abs=1e-3)
    assert "muscle.temperature" in str(plan.verdict)


@pytest.mark.parametrize(
    ("source", "pressure", "expected"),
    [
        (pam.feeds.Compressor(pressure=6e5), 6e5, 6e5),
        pytest.param(pam.feeds.Compressor(pressure=6e5), 4e5, 6e5, marks=pytest.mark.slow),
        (None, 5e5, 5e5),
    ],
)
def test_a_receiver_begins_where_its_source_or_its_filling_leaves_it(source, pressure, expected):
    tank = pam.feeds.Receiver(2e-3, pressure=pressure, source=source)
    feed = pam.feeds.SpoolValve(supply=tank)
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    plan = pam.plan(plant, [{"x": 0.01}, {"x": 0.04}], method=pam.Collocation(15, 3))
    assert plan.verified
    assert plan.trajectory["receiver.air_pressure"][0] == pytest.approx(expected, abs=50.0)


def test_a_tank_that_begins_fuller_than_its_compressor_makes_it_is_named():
    tank = pam.feeds.Receiver(2e-3, source=pam.feeds.Compressor(pressure=6e5))
    feed = pam.feeds.SpoolValve(supply=tank)
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    rest = plant.equilibrium(x=0.02)
    start = np.array([rest[v.name] for v in plant.states], float)
    start[[v.name for v in plant.states].index("receiver.air_pressure")] = 7e5
    constraint = judged_held(plant, start, [0.0], [{"x": 0.02}] * 2, 0.5).constraint
    assert constraint == "stop 1: receiver.air_pressure as its surroundings leave it"


@pytest.mark.slow
def test_a_spool_stands_where_its_command_holds_it_before_a_motion():
    feed = pam.feeds.SpoolValve(spool=pam.feeds.FirstOrderSpool(time=0.01))
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    plan = pam.plan(plant, [{"x": 0.01}, {"x": 0.04}], method=pam.Collocation(15, 3))
    assert plan.verified
    assert abs(plan.trajectory["muscle.valve.spool"][0]) < 0.021  # closed, or in its overlap


def test_a_spool_held_beside_its_middle_has_not_moved_in_its_play():
    """Against a leak it is held open; what its play would do with another command is no matter."""
    spool = pam.feeds.FirstOrderSpool(time=0.01, hysteresis=0.02)
    feed = pam.feeds.SpoolValve(spool=spool, leak=1e-10)
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed)
    rest = plant.equilibrium(x=0.02)
    start = np.array([rest[v.name] for v in plant.states], float)
    assert rest["muscle.valve.spool"] > 1e-3
    for memory in ("virgin", "below"):  # positions do not move a spool
        stays = judged_held(
            plant, start, [rest["muscle.command"]], [{"x": 0.02}] * 2, 0.5, memory=memory
        )
        assert stays.violation < 1e-3


@pytest.mark.parametrize(
    ("part", "memory", "wrong"),
    [(1.0, "below", False), (1.06, "below", True), (0.9, "below", True), (1.0, "above", True)],
)
def test_a_play_stands_at_the_envelope_of_its_place_and_side(part, memory, wrong):
    """C = contracting (1 + 2 kappa), as a part of that at full contraction: above, a play has let
    go before the motion begins; below, or on the other side, nothing has brought it.
    """
    muscle = pam.muscle("DMSP-20-400N")
    kappa, top = 0.2, muscle.contraction_range[1]
    losses = (pam.losses.PrandtlIshlinskii(),)
    plant = pam.HangingLoad(muscle, 8.0, feed=pam.feeds.Regulator(), losses=losses)
    plays = [v.name for v in plant.states if v.memory == "held"]
    envelope = (1 + 2 * kappa) / (1 + 2 * top)
    x = kappa * float(muscle.rest_length)
    rest = plant.equilibrium(x=x)
    stands = dict.fromkeys(plays, part * envelope)
    start = np.array([stands.get(v.name, rest[v.name]) for v in plant.states], float)
    verdict = judged_held(plant, start, [rest["muscle.command"]], [{"x": x}] * 2, memory=memory)
    off = [f for f in verdict.findings if f.label.endswith("at the start") and f.by > 1e-2]
    assert bool(off) == wrong
    assert {f.label.split()[2] for f in off} <= set(plays)


@pytest.mark.parametrize(
    ("memory", "m", "by"),
    [("virgin", 2.0, 0.0), ("virgin", 3.0, 0.25), ({"m": 0.5}, 0.5, 0.0), ({"m": 3.0}, 2.0, 0.25)],
)
def test_a_memory_begins_where_it_comes_to_unless_it_is_said(memory, m, by):
    """m is the largest x so far, which begins at 2."""
    plant = pam.Plant("marker")
    x, v = plant.state("x"), plant.state("v")
    mark = plant.state("m", min=0.0, max=10.0, nominal=4.0, memory="held")
    plant.der(x, v)
    plant.der(v, plant.input("u", min=-1.0, max=1.0))
    plant.der(mark, ca.fmax(x - mark, 0.0) / 0.01)
    for rest in (True, False):  # also where the motion does not begin at rest
        stops = [pam.Stop({"x": 2.0}, rest=rest), {}]
        found = judged_held(plant, [2.0, 0.0, m], [0.0], stops, memory=memory)
        assert found.violation == pytest.approx(by, abs=1e-6)
        assert found.constraint in ("stop 1: m at the start", "") or by == 0.0


@pytest.mark.parametrize(
    ("start", "label", "by"),
    [
        ([0.0, 0.3, 0.0, 0.3, 1.0], "", 0.0),
        ([0.0, 0.3, 0.5, 0.3, 1.0], "stop 1: crept settled", 0.5),
        ([0.0, 0.3, 0.0, 0.7, 1.0], "stop 1: filtered settled", 0.4),
        ([0.0, 0.3, 0.0, 0.3, 1.5], "stop 1: lost at the start", 0.5),
    ],
)
def test_a_motion_that_begins_moving_has_a_past(start, label, by):
    """A given velocity: what creeps and filters has followed it, what sums up begins at 1."""
    plant = pam.Plant("moving")
    x, v, crept = plant.state("x"), plant.state("v"), plant.state("crept", memory="settling")
    filtered, lost = plant.state("filtered"), plant.state("lost", start=1.0)
    for state, rate in ((x, v), (v, plant.input("u")), (crept, -crept / 2)):
        plant.der(state, rate)
    plant.der(filtered, (v - filtered) / 0.1)
    plant.der(lost, v**2)
    for rest in (True, False):
        stops = [pam.Stop({"x": 0.0, "v": 0.3}, rest=rest), pam.Stop({}, rest=False)]
        found = judged_held(plant, start, [0.0], stops)
        assert found.violation == pytest.approx(by, abs=1e-6)
        assert found.constraint == label or not label


@pytest.mark.parametrize(
    ("memory", "words"),
    [
        ("sideways", "choose 'virgin', 'above', 'below'"),
        (3, "choose 'virgin', 'above', 'below'"),
        ({"x": 0.0}, "x is no state with a held memory; known: muscle.slip1"),
        ({"muscle.slip1": 7.0}, "memory = 7 is outside -1 .. 1"),
    ],
)
def test_a_memory_that_cannot_be_is_refused(memory, words):
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, losses=(pam.losses.MaxwellSlip(),))
    rest = plant.equilibrium(x=0.02)
    inputs, stops = [rest["muscle.command"]], [{"x": 0.02}] * 2
    refused(words, judged_held, plant, rest.x, inputs, stops, memory=memory)


def test_a_tank_that_drains_before_a_motion_is_no_rest():
    """Level h' = -in, w' = in - out: with both ways open w stands, and the tank runs empty."""
    plant = pam.Plant("tank")
    tank = plant.state("tank", unit="Pa", start=5e5, min=0.0, max=1e6, nominal=1e5, memory="held")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    w = plant.state("w", unit="Pa", start=1e5, nominal=1e5)
    fill, vent = (plant.input(n, min=0.0, max=1.0) for n in ("fill", "vent"))
    flows = fill * (tank - w), vent * w
    plant.der(tank, -flows[0])
    plant.der(w, flows[0] - flows[1])
    plant.der(x, v)
    plant.der(v, 1e-5 * w - v - x)
    leaky = [pam.Constraint(vent, low=0.5, name="leaky")]
    start, stops = [5e5, 1.0, 0.0, 1e5], [{"x": 1.0}, pam.Stop({}, rest=False)]
    judgement = judged_held(plant, start, [0.125, 0.5], stops, 0.1, constraints=leaky)
    assert {f.label: f.by for f in judgement.findings}["stop 1: tank settled"] > 0.01


@pytest.mark.parametrize(("slid", "fits"), [(0.3, 1), (1.0, 1), (1.3, 1), (1.5, 0), (-0.1, 0)])
def test_a_memory_whose_envelope_grows_with_the_inputs_is_left_by_any_that_hold(slid, fits):
    """v' = a - b - z, where z has come from below and was let down to its envelope c (a + b):
    inputs of 0 to 4 hold the cart where z is between 0 and 8 c/(1 + c) = 1.33.
    """
    c, plant = 0.2, pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s2")
    a, b = (plant.input(name, unit="m/s2", min=0.0, max=4.0) for name in "ab")
    z = plant.state("z", min=-2.0, max=2.0, memory="held")  # in 1 m/s2
    plant.der(x, v)
    plant.der(v, a - b - z)
    beyond = ca.fmax(z - c * (a + b), 0) + ca.fmin(z + c * (a + b), 0)
    plant.der(z, 10 * v - 20 * beyond)
    lines = {name: ([0.0, 0.5], [2.0, 2.0]) for name in "ab"}  # the motion begins with others
    motion = Motion.of(plant, {"x": 0.0, "z": slid}, lines, [0.5])
    statement = Statement([{"x": 0.0}, {"x": 0.0}], memory="below", duration=0.5)
    said = {f.label for f in judge(plant, statement, motion).findings if f.by > 1e-3}
    assert ("stop 1: z at the start" not in said) == bool(fits)
