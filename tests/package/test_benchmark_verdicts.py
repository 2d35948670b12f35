"""benchmarks/motion_check.py sees what is wrong with a motion made by hand, and nothing else;
random_tasks.py draws what the catalogue and the library have.
"""

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.plants import kinds as kinds_of

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
MODULES = ("motion_check", "random_tasks", "verdict_study")


@pytest.fixture(scope="module")
def study():
    """The modules of the study, by name."""
    sys.path.insert(0, str(FOLDER))
    try:
        yield SimpleNamespace(**{name: __import__(name) for name in MODULES})
    finally:
        sys.path.remove(str(FOLDER))
        for name in MODULES:
            sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def cart():
    """x''' = u: from rest to rest over 1 m in 2 s with u = 4, -4, 4 (a quarter, a half, a
    quarter of the time), at most 1 m/s.
    """
    plant = pam.Plant("cart")
    x, v, a = plant.state("x", unit="m"), plant.state("v", unit="m/s"), plant.state("a")
    plant.der(x, v)
    plant.der(v, a)
    plant.der(a, plant.input("u", min=-20.0, max=20.0))
    return plant


def moved(begin, breaks, jerks):
    """(times, states) of the cart, by the polynomials."""
    times, rows = [0.0], [np.array(begin, float)]
    for u, (start, end) in zip(jerks, pairwise(breaks), strict=True):
        x, v, a = rows[-1]
        for s in np.linspace(0, end - start, 6)[1:]:
            times.append(start + s)
            place = x + v * s + a * s**2 / 2 + u * s**3 / 6
            rows.append(np.array([place, v + a * s + u * s**2 / 2, a + u * s]))
    return np.array(times), np.array(rows)


@pytest.fixture
def answered(study):
    """Answers of the cart: the right one, or with something changed."""

    def answer(begin=(0, 0, 0), jerks=(4, -4, 4), breaks=(0, 0.5, 1.5, 2), objective=2.0, **more):
        t, states = moved(begin, breaks, jerks)
        signals = np.array(jerks, float)[:, None, None]
        durations = more.pop("durations", (float(breaks[-1]),))
        made = study.motion_check.Answer(
            t, states, np.array(breaks, float), signals, durations, objective
        )
        return replace(made, **more)

    return answer


@pytest.fixture
def held(study):
    """The answer of one second with the same inputs."""

    def answer(t, states, inputs, objective=1.0):
        column = np.array([[np.atleast_1d(inputs)]], float)
        times, breaks = np.asarray(t, float), np.array([0.0, 1.0])
        return study.motion_check.Answer(times, states, breaks, column, (1.0,), objective)

    return answer


@pytest.fixture
def kinds(study, cart):
    """(answer, arguments of the task) -> the kinds of what is wrong."""

    def found(answer, stops=({"x": 0.0}, {"x": 1.0}), positions=("x",), plant=None, **arguments):
        task = study.random_tasks.Task("", plant or cart, list(stops), positions, arguments)
        return {each.kind for each in study.motion_check.wrong(task, answer)}

    return found


def test_a_right_motion_has_nothing_wrong(answered, kinds):
    assert kinds(answered()) == set()
    assert kinds(answered(), bounds={"v": (-1.0, 1.0)}, budgets={"time": (None, 2.0)}) == set()


def test_a_speed_at_a_stop_is_seen(answered, kinds):
    assert "speed" in kinds(answered(begin=(0.0, 0.1, 0.0)))


def test_an_acceleration_at_a_stop_is_seen(answered, kinds):
    """u = 0 and a = 0.5 all along: 1 m in 2 s; the first stop has no speed, but an acceleration."""
    pushed = answered(begin=(0, 0, 0.5), jerks=(0, 0, 0))
    assert kinds(pushed, ({"x": 0.0}, pam.Stop({"x": 1.0}, rest=False))) == {
        "acceleration",
        "start",  # nor would it stay there
    }


def test_an_acceleration_that_an_input_sets_at_once_needs_an_input_that_holds(held, kinds):
    """x'' = u + 3: within |u| <= 1 nothing holds it, within |u| <= 5 u = -3 does."""
    for most, wrong in ((1.0, {"acceleration", "start"}), (5.0, set())):
        plant = pam.Plant("pushed")
        x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
        plant.der(x, v)
        plant.der(v, plant.input("u", min=-most, max=most) + 3.0)
        t = np.linspace(0, 1, 11)
        states = np.column_stack([t**2, 2 * t])  # u = -1
        stops = ({"x": 0.0}, pam.Stop({"x": 1.0}, rest=False))
        assert kinds(held(t, states, -1.0), stops, plant=plant) == wrong


def test_a_value_that_a_stop_asks_for_and_a_limit_between_the_points_are_seen(answered, kinds):
    assert kinds(answered(), ({"x": 0.0}, {"x": 1.01})) == {"stop"}
    assert kinds(answered(), bounds={"v": (-1.0, 0.99)}) == {"limit"}
    inside = pam.Avoid({"x": (0.5, 0.1), "v": (1.0, 0.2)})
    assert kinds(answered(), constraints=[inside]) == {"limit"}
    beside = pam.Avoid({"x": (0.5, 0.1), "v": (0.5, 0.2)})
    assert kinds(answered(), constraints=[beside]) == set()


def test_a_wrong_objective_budget_or_duration_is_seen(answered, kinds):
    assert kinds(answered(objective=2.004)) == {"objective"}
    # the integral of u^2 is 2 * 16 = 32
    assert kinds(answered(objective=32.0), minimise="effort", duration=2.0) == set()
    assert kinds(answered(), budgets={"effort": 30.0}) == {"budget"}
    assert kinds(answered(), duration=1.9) == {"time"}
    assert "time" in kinds(answered(durations=(1.0, 1.0)))


def test_states_that_do_not_follow_from_the_inputs_are_seen(answered, kinds):
    right = answered()
    shifted = right.states.copy()
    shifted[7, 0] += 0.01
    assert kinds(answered(states=shifted)) == {"replay"}


def test_a_cycle_that_does_not_close_is_seen(answered, kinds):
    there_and_back = answered(
        jerks=(4, -4, 4, -4, 4, -4),
        breaks=(0, 0.5, 1.5, 2, 2.5, 3.5, 4),
        durations=(2.0, 2.0),
        objective=4.0,
    )
    assert kinds(there_and_back, cyclic=True) == set()
    short = answered(
        jerks=(4, -4, 4, -4, 4, -3.9),
        breaks=(0, 0.5, 1.5, 2, 2.5, 3.5, 4),
        durations=(2.0, 2.0),
        objective=4.0,
    )
    assert "cycle" in kinds(short, cyclic=True)


def warm(decay):
    """A cart of two actuators that hold each other, and air whose temperature decays to 293 K."""
    plant = pam.Plant("warm")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    one, other = (plant.state(f"s{i}") for i in (1, 2))
    air = plant.state("air", unit="K", start=293.0, nominal=30.0)
    plant.der(x, v)
    plant.der(v, one - other - v)
    for s, name in ((one, "u1"), (other, "u2")):
        plant.der(s, plant.input(name, min=0.0, max=0.5) - s)
    plant.der(air, decay * (293.0 - air))
    return plant


@pytest.mark.parametrize(
    ("hold", "kelvin", "decay", "wrong"),
    [
        (0.4, 293.0, 1.0, set()),
        (0.8, 293.0, 1.0, {"start"}),  # no input above 0.5 keeps it
        (0.4, 350.0, 1.0, {"start"}),  # it cools down
        (0.4, 350.0, 0.0, {"start"}),  # it does not, but nobody said that it was warm
    ],
)
def test_a_start_that_does_not_last_or_is_no_rest_of_its_surroundings_is_seen(
    held, kinds, hold, kelvin, decay, wrong
):
    plant, t = warm(decay), np.linspace(0.0, 1.0, 21)
    sent = min(hold, 0.5)
    pull = sent + (hold - sent) * np.exp(-t)
    air = 293.0 + (kelvin - 293.0) * np.exp(-decay * t)
    states = np.column_stack([0 * t, 0 * t, pull, pull, air])
    answer = held(t, states, [sent, sent])
    stops = ({"x": 0.0}, pam.Stop({"x": 0.0}))
    assert kinds(answer, stops, plant=plant, duration=1.0) == wrong
    named = replace(answer, verdict="verified; at the start air, s1, s2 are not at rest")
    assert kinds(named, stops, plant=plant, duration=1.0) == set()


def test_a_receiver_above_what_its_compressor_brings_about_is_seen(held, kinds):
    """Closed valves, a hanging load at rest: all stands, but 7 bar come from nowhere."""
    tank = pam.feeds.Receiver(1e-3, 6e5, pam.feeds.Compressor(1e-3, 6e5))
    plant = pam.HangingLoad("DMSP-20-200N", 10.0, feed=pam.feeds.SpoolValve(supply=tank))
    rest = plant.equilibrium(x=0.02)
    for pressure, wrong in ((6e5, set()), (7e5, {"start"})):
        state = np.array([rest[v.name] for v in plant.states])
        state[[v.name for v in plant.states].index("receiver.air_pressure")] = pressure
        answer = held([0.0, 1.0], np.array([state, state]), 0.0)
        assert kinds(answer, ({"x": 0.02}, {"x": 0.02}), plant=plant, duration=1.0) == wrong


def still(held, plant, rest):
    """The answer of a plant that stays where it rests for a second."""
    state = np.array([[rest[v.name] for v in plant.states]], float)
    return held([0.0], state, [rest[v.name] for v in plant.inputs])


@pytest.mark.parametrize(
    ("parts", "memory", "others"),
    [
        # slid fully, elements give up their last 2 % at rest
        ({"losses": pam.losses.MaxwellSlip()}, "above", ("virgin", "below")),
        ({"losses": pam.losses.BoucWen()}, "below", ("virgin", "above")),
        # positions do not move a spool
        (
            {"feed": pam.feeds.SpoolValve(spool=pam.feeds.FirstOrderSpool(hysteresis=0.02))},
            "below",
            (),
        ),
    ],
)
def test_memories_begin_where_the_task_says(held, kinds, parts, memory, others):
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, **parts)
    answer = still(held, plant, plant.equilibrium(x=0.02, memory=memory))
    stops, words = ({"x": 0.02}, {"x": 0.02}), {"plant": plant, "duration": 1.0}
    assert kinds(answer, stops, memory=memory, **words) == set()
    for other in others:
        assert kinds(answer, stops, memory=other, **words) == {"start"}


def test_a_muscle_has_reached_at_least_where_it_stands(held, kinds):
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, losses=pam.losses.Preconditioning())
    stops, words = ({"x": 0.02}, {"x": 0.02}), {"plant": plant, "duration": 1.0}
    here = plant.equilibrium(x=0.02)["muscle.contraction"]
    hard = plant.with_values({"muscle.softening_part": 0.0}).equilibrium(x=0.02)
    x = np.where([v.name == "muscle.reached" for v in plant.states], 0.0, hard.x)
    assert kinds(still(held, plant, replace(hard, x=x)), stops, **words) == {"start"}
    for memory, wrong in (("virgin", set()), ({"muscle.reached": here + 0.05}, {"start"})):
        rest = plant.equilibrium({"x": 0.02}, memory=memory)
        assert kinds(still(held, plant, rest), stops, **words) == wrong


def test_differences_are_derivatives_beside_a_stiff_part_too(held, kinds):
    """x'' = f, f' = (1 - f)/s with s = 10 us: at the start f is 0, 20 us later 0.86."""
    plant, s, t = pam.Plant("stiff"), 1e-5, np.linspace(0.0, 1.0, 11)
    x, v, f = plant.state("x", unit="m"), plant.state("v", unit="m/s"), plant.state("f")
    plant.der(x, v)
    plant.der(v, f)
    plant.der(f, (plant.input("u", min=0.0, max=1.0) - f) / s)
    grown = 1 - np.exp(-t / s)
    states = np.column_stack([t**2 / 2 - s * t + s**2 * grown, t - s * grown, grown])
    answer = held(t, states, 1.0)
    stops = ({"x": 0.0}, pam.Stop({}, rest=False))
    assert kinds(answer, stops, plant=plant, duration=1.0) == set()
    states[:, 2] = 1.0  # f = 1 from the start: an acceleration
    states[:, 0], states[:, 1] = t**2 / 2, t
    assert "acceleration" in kinds(answer, stops, plant=plant, duration=1.0)


def test_a_peak_between_samples_counts(held, kinds):
    """Two lags of 2 ms in a row, the first at 1: the second has 1/e at most."""
    plant, s, t = pam.Plant("lags"), 2e-3, np.array([0.0, 1.0])
    a, b = plant.state("a"), plant.state("b")
    plant.der(a, (plant.input("u") - a) / s)
    plant.der(b, (a - b) / s)
    states = np.array([[1.0, 0.0], [0.0, 0.0]])
    stops = (pam.Stop({}, rest=False),) * 2
    for said, wrong in ((np.exp(-1), set()), (0.36, {"objective"})):
        answer = held(t, states, 0.0, said)
        words = {"plant": plant, "minimise": "peak(b)", "duration": 1.0, "positions": ()}
        assert kinds(answer, stops, **words) == wrong


def test_a_plan_of_the_library_has_nothing_wrong(study, kinds):
    plant, stops = pam.HangingLoad("DMSP-20-200N", 10.0), ({"x": 0.01}, {"x": 0.03})
    plan = pam.plan(plant, list(stops), minimise="work", duration=0.5)
    assert plan.verified
    answer = study.motion_check.Answer.of(plan)
    assert kinds(answer, stops, plant=plant, minimise="work", duration=0.5) == set()


# ---- the tasks -----------------------------------------------------------------------------------
def registered(registry, but=()):
    return {registry[name] for name in registry} - set(but)


def test_all_muscles_losses_and_loads_are_drawn(study):
    tasks, draw = study.random_tasks, np.random.default_rng(3)
    assert {tasks.any_muscle(draw).name for _ in range(200)} == set(pam.muscles.muscle_names())
    drawn = {w for _ in range(200) for w in tasks.losses(draw, 5e5, 500.0)[2].split(", ")}
    assert drawn == {*tasks.LOSSES, ""}
    losses = {type(tasks.one_loss(draw, kind, 5e5, 500.0)[0]) for kind in tasks.LOSSES}
    assert losses == registered(kinds_of.LOSSES)
    loads = {type(one) for _ in range(200) for one in tasks.loads(draw, 500.0, 0.1).made}
    assert loads == registered(kinds_of.LOADS)


def test_all_feeds_valves_supplies_and_heats_are_drawn(study):
    tasks, draw, muscle = study.random_tasks, np.random.default_rng(4), pam.muscle("DMSP-20-200N")
    feeds = [tasks.feed(draw, muscle, 5e5, pair=True)[0] for _ in range(300)]
    regulated = pam.plants.PositionFeedback  # which only a regulated load has
    assert {type(each) for each in feeds} == registered(kinds_of.FEEDS, [regulated])
    parts = {
        "tube": kinds_of.TUBES,
        "spool": kinds_of.SPOOLS,
        "quick_exhaust": kinds_of.QUICK_EXHAUSTS,
    }
    parts |= {"dead_time": kinds_of.DEAD_TIMES}
    for argument, registry in parts.items():
        found = {type(p) for each in feeds if (p := getattr(each, argument, None)) is not None}
        assert found == registered(registry)
    tanks = [each.supply for each in feeds if hasattr(getattr(each, "supply", None), "connect")]
    assert {type(t.source) for t in tanks} == {*registered(kinds_of.SOURCES), type(None)}
    heats = {type(each.gas.heat).__name__ for each in feeds if hasattr(each, "gas")}
    assert heats == {"ConstantHeatTransfer", "PressureHeatTransfer", "NoneType"}


def test_a_number_gives_the_same_task_again(study):
    first, again = (str(study.verdict_study.drawn(3, 5)) for _ in range(2))
    assert first == again
