"""Rest with memory: hysteresis keeps a force at rest, and the point on the continuum is chosen."""

import re
from pathlib import Path

import casadi as ca
import control
import numpy as np
import pytest
from conftest import BAR, refused
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import InputError, vibration
from pam_ocp.operating import EquilibriumError
from pam_ocp.operating.held import at_rest, carried, driven_names, held, surroundings
from pam_ocp.operating.several import equilibria, equilibrium_branch, equilibrium_path
from pam_ocp.plants.regulated import RegulatedLoad

GRAVITY = 9.80665
WEIGHT = 20 * GRAVITY
FRICTION, YIELD, LENGTH = 18.0, 0.006, 0.4
MUSCLE = pam.muscle("DMSP-20-400N")


def hanging(*losses, **more):
    return pam.HangingLoad(
        MUSCLE, 20.0, losses=losses or (pam.losses.BoucWen(FRICTION, YIELD),), **more
    )


def rest_by_hand(pressure, friction):
    """Position at which the law's pull, less friction, carries the load."""
    return LENGTH * brentq(
        lambda k: float(MUSCLE.tension(pressure, k)) - friction - WEIGHT, 0.0, 0.27
    )


# ---- found ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rest_is_found_in_balance_and_stays_for_all_arrangements_feeds_and_losses(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import harness
    import rest_study

    rows = harness.run(rest_study.cases, harness.asked(10, 20261122, controlled=0))
    assert len(rows) == 60
    assert all(r["found"] for r in rows), [r["why"] for r in rows if not r["found"]]
    assert max(r["missed"] for r in rows) < 1e-9
    assert np.nanmax([r["moved"] for r in rows]) < 1e-6


@pytest.mark.parametrize(("memory", "share"), [("virgin", 0), ("above", -1), ("below", 1)])
def test_a_load_rests_where_friction_from_its_side_holds_it(memory, share):
    point = hanging().equilibrium({"muscle.command": 3 * BAR}, memory=memory)
    assert point["x"] == pytest.approx(rest_by_hand(3 * BAR, share * FRICTION), rel=1e-9)
    assert point.memory == {"muscle.hysteresis": share}
    assert point.residual < 1e-9


def test_a_memory_among_the_values_is_given_and_one_that_is_free_is_found():
    plant = hanging()
    given = plant.equilibrium({"muscle.command": 3 * BAR, "muscle.hysteresis": 0.4})
    assert given["x"] == pytest.approx(rest_by_hand(3 * BAR, 0.4 * FRICTION), rel=1e-9)
    x = rest_by_hand(3 * BAR, -0.7 * FRICTION)
    found = plant.equilibrium({"muscle.command": 3 * BAR, "x": x}, free=["muscle.hysteresis"])
    assert found.memory["muscle.hysteresis"] == pytest.approx(-0.7, rel=1e-6)


def odd(kind):
    """A load on a muscle in coordinates whose rate is no state: a gear, a momentum."""
    plant = pam.Plant("odd")
    x = plant.state("x", unit="m", min=0.0, max=0.1, nominal=0.01)
    w = plant.state("w", nominal=1.0)
    speed = {"gear": w / 2, "backwards": -3 * w, "momentum": w / 20.0}[kind]
    part = plant.add_muscle(
        "muscle", MUSCLE, shortening=x, rate=speed, losses=(pam.losses.BoucWen(FRICTION, YIELD),)
    )
    pull = part.force - WEIGHT - 200 * speed
    plant.der(x, speed)
    plant.der(w, {"gear": pull / 10, "backwards": -pull / 60, "momentum": pull}[kind])
    return plant


@pytest.mark.parametrize("kind", ["gear", "backwards", "momentum"])
def test_sides_are_those_of_the_position_in_any_coordinates(kind):
    plant = odd(kind)
    for memory, share in (("above", -1), ("below", 1)):
        point = plant.equilibrium({"muscle.command": 3 * BAR}, memory=memory)
        assert point["x"] == pytest.approx(rest_by_hand(3 * BAR, share * FRICTION), rel=1e-9)


def test_of_a_pair_one_muscle_has_slid_each_way():
    losses = (pam.losses.MaxwellSlip((5.0,), (0.01,)),)
    other = pam.muscle("DMSP-20-300")
    for plant in (
        pam.AntagonisticSlide(MUSCLE, muscle2=other, losses=losses, feed=pam.feeds.SpoolValve()),
        pam.AntagonisticJoint(MUSCLE, muscle2=other, moment_arm2=0.03, losses=losses),
    ):
        assert held(plant, "above") == {"muscle1.slip1": -1.0, "muscle2.slip1": 1.0}
        assert held(plant, "below") == {"muscle1.slip1": 1.0, "muscle2.slip1": -1.0}


def test_sides_that_cannot_be_meant_are_refused():
    refused("choose 'virgin', 'above', 'below'", hanging().equilibrium, x=0.05, memory="left")
    with pytest.raises(InputError, match=r"memory: x is no state with a held memory"):
        hanging().equilibrium(x=0.05, memory={"x": 1.0})
    with pytest.raises(InputError, match=r"memory = 1.5 is outside -1 .. 1"):
        hanging().equilibrium(x=0.05, memory={"muscle.hysteresis": 1.5})


def test_surroundings_are_where_a_plant_comes_to_but_nothing_brings_it_back():
    """A compressor fills its tank to 6 bar and stops; a wall that gives its heat away is no more
    than where it comes to. What runs by itself is driven by nothing."""
    pump, full = pam.feeds.Compressor(pressure=6e5), pytest.approx(6e5, rel=1e-6)
    warm = pam.gas.Gas(heat=pam.muscles.ConstantHeatTransfer(30.0), rubber=pam.muscles.Rubber(20.0))
    for options, expected in (
        ({"source": pump}, {"receiver.air_pressure": full}),
        ({"source": None, "wall_conductance": 2.0}, {"receiver.air_temperature": 293.15}),
        (None, {}),
    ):
        tank = options and pam.feeds.Receiver(2e-3, pressure=4e5, **options)
        feed = pam.feeds.SpoolValve(supply=tank) if tank else pam.feeds.SpoolValve(gas=warm)
        plant = pam.HangingLoad(MUSCLE, 10.0, feed=feed)
        assert surroundings(plant) == expected
        assert driven_names(plant) == tuple(v.name for v in plant.states)
    basin = pam.Plant("basin")  # fills to 1, keeps what it has, spills over from 2 on
    level = basin.state("level", start=0.4, nominal=0.1, memory="settling")
    basin.der(level, 5 * (ca.fmax(1 - level, 0) - ca.fmax(level - 2, 0)))
    assert surroundings(basin) == {"level": pytest.approx(1.0)}
    clock = pam.Plant("clock")
    time, x, lag = (clock.state(n) for n in ("time", "x", "lag"))
    clock.der(time, 1.0)
    clock.der(x, clock.input("u") - x)
    clock.der(lag, x + time - lag)
    assert driven_names(clock) == ("x", "lag")


def test_a_receiver_whose_air_warms_slowly_begins_where_its_compressor_stops():
    """After 300 s its air was 0.3 K off, so that its pressure did not count as idle: plans chose
    10 bar."""
    source = pam.feeds.Compressor(pressure=8e5, band=2e4)
    tank = pam.feeds.Receiver(1e-3, pressure=7.5e5, source=source, wall_conductance=0.01)
    feed = pam.feeds.SpoolValve(supply=tank)
    load = pam.HangingLoad(MUSCLE, 10.0, damping=50.0, feed=feed)
    at = surroundings(load)
    assert at["receiver.air_pressure"] == pytest.approx(8e5, rel=1e-3)
    assert at["receiver.air_temperature"] == pytest.approx(293.15, abs=1e-3)


# ---- said ----------------------------------------------------------------------------------------

IMPOSSIBLE = [
    (hanging, {"mass": 70.0, "muscle.command": 2 * BAR}),
    (hanging, {"mass": 20.0, "x": 0.110}),
    (
        lambda: hanging(pam.losses.MaxwellSlip(), pam.losses.Creep()),
        {"mass": 70.0, "muscle.command": 2 * BAR},
    ),
    (
        lambda: hanging(pam.losses.MaxwellSlip(), feed=pam.feeds.SpoolValve()),
        {"mass": 70.0, "muscle.pressure": 2 * BAR},
    ),
    (
        lambda: pam.AntagonisticSlide(MUSCLE, losses=(pam.losses.MaxwellSlip(),)),
        {"x": 0.0, "stiffness": 1e5},
    ),
    (
        lambda: pam.AntagonisticJoint(
            MUSCLE, link_mass=3.0, link_length=0.3, losses=(pam.losses.BoucWen(),)
        ),
        {"muscle1.command": 0.0, "theta": 0.3},
    ),
]


@pytest.mark.parametrize(("make", "conditions"), IMPOSSIBLE)
def test_what_is_said_to_do_does(make, conditions):
    plant = make()
    with pytest.raises(EquilibriumError) as caught:
        plant.equilibrium(conditions, memory="below")
    words = str(caught.value)
    remedies = re.findall(r"(?:is, | or )([\w.]+) = (\S+)(?: \S+)? would do(?! \(beyond)", words)
    assert " =  " not in words
    assert "is, would" not in words
    assert remedies
    for name, value in remedies:
        changed = {**conditions, name: float(value) * plant.variable(name).display_factor}
        assert changed[name] != conditions[name]
        plant.equilibrium(changed, memory="below")


# ---- bands ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "loss", [pam.losses.BoucWen(12.0), pam.losses.MaxwellSlip((7.0, 5.0), (0.002, 0.01))]
)
def test_the_points_of_rest_are_one_band_with_its_ends(loss):
    found = equilibria(hanging(loss), {"muscle.command": 3 * BAR})
    assert len(found) == len(found.bands) == 1
    (band,) = found.bands
    assert band.virgin["x"] == found[0]["x"] == pytest.approx(rest_by_hand(3 * BAR, 0.0), rel=1e-9)
    assert band.below["x"] == pytest.approx(rest_by_hand(3 * BAR, 12.0), rel=1e-9)
    assert band.above["x"] == pytest.approx(rest_by_hand(3 * BAR, -12.0), rel=1e-9)
    assert band["x"] == (band.below["x"], band.above["x"])
    assert re.search(r"x +\d\S* mm \.\. \d\S* mm \(virgin", str(band))
    (above,) = equilibria(hanging(loss), {"muscle.command": 3 * BAR}, memory="above")
    assert above["x"] == pytest.approx(band.above["x"], rel=1e-12)


def test_paths_and_branches_keep_the_memory():
    masses = np.linspace(10.0, 25.0, 4)
    path = equilibrium_path(hanging(), "mass", masses, {"muscle.command": 3 * BAR}, memory="below")
    branch = equilibrium_branch(
        hanging(), "mass", 10.0, 25.0, {"muscle.command": 3 * BAR}, memory="below"
    )
    for point in (*path.points, *branch.points):
        pull = float(MUSCLE.tension(3 * BAR, point["x"] / LENGTH)) - FRICTION
        assert pull == pytest.approx(point["mass"] * GRAVITY, rel=1e-9)


# ---- keeping -------------------------------------------------------------------------------------


def test_at_rest_bouc_wen_keeps_its_force():
    plant = hanging()
    for z, kept in ((0.9, 0.9), (-0.5, -0.5), (1.0, 0.98)):
        point = plant.equilibrium({"muscle.command": 3 * BAR}, memory={"muscle.hysteresis": z})
        run = pam.simulate(
            plant,
            {"muscle.command": 3 * BAR},
            duration=300.0,
            start={v.name: x for v, x in zip(plant.states, point.x, strict=True)},
        )
        assert run["muscle.hysteresis"][-1] == pytest.approx(kept, abs=2e-3 if z == 1 else 1e-9)


@pytest.mark.parametrize("rate", [1e-7, 1e-5, 1e-3])
def test_bouc_wen_stays_in_its_range_however_slow_the_motion(rate):
    plant = pam.Plant("drawn")
    x = plant.state("x", unit="m")
    plant.der(x, rate * LENGTH)
    plant.add_muscle(
        "muscle", MUSCLE, shortening=x, rate=rate * LENGTH, losses=(pam.losses.BoucWen(),)
    )
    run = pam.simulate(plant, duration=0.05 / rate)
    assert run["muscle.hysteresis"].max() <= 1 + 1e-9
    assert run["muscle.hysteresis"][-1] > 0.98


def test_states_beyond_their_range_by_rounding_are_taken_at_its_end():
    plant = hanging()
    moved = plant.with_values({"muscle.hysteresis": 1 + 1e-9})
    assert moved.variable("muscle.hysteresis").start == 1.0
    run = pam.simulate(plant, start={"muscle.hysteresis": -1 - 1e-7}, duration=0.01)
    assert run["muscle.hysteresis"][0] == -1.0
    refused(r"outside -1 .. 1", plant.with_values, {"muscle.hysteresis": 1 + 1e-5})


# ---- small motion --------------------------------------------------------------------------------


def spring_of(point):
    """Of the law, by its own slope, and of the element that sticks [N/m]."""
    k = point["x"] / LENGTH
    step = 1e-6
    law = (MUSCLE.tension(3 * BAR, k - step) - MUSCLE.tension(3 * BAR, k + step)) / (2 * step)
    return float(law) / LENGTH, FRICTION / YIELD / LENGTH


def test_an_element_that_sticks_is_a_spring():
    plant = hanging(feed=pam.feeds.IdealPressure(), damping=pam.losses.ConstantDamping(60.0))
    for z, share in ((0.0, 1.0), (0.9, 1.0), (-1.0, 0.5)):
        memory = {"muscle.hysteresis": z}
        point = plant.equilibrium({"muscle.pressure": 3 * BAR}, memory=memory)
        law, friction = spring_of(point)
        expected = np.roots([20.0, 60.0, law + share * friction])
        assert np.sort_complex(point.poles) == pytest.approx(np.sort_complex(expected), rel=1e-5)
        assert point.stability == "stable"


def test_the_stuck_system_answers_as_the_whole_one_and_as_the_plant():
    plant = hanging(damping=pam.losses.ConstantDamping(60.0))
    point = plant.equilibrium({"muscle.command": 3 * BAR}, memory={"muscle.hysteresis": 0.5})
    whole = plant.linearize(point, inputs=["muscle.command"], outputs=["x", "muscle.hysteresis"])
    stuck = plant.linearize(
        point, inputs=["muscle.command"], outputs=["x", "muscle.hysteresis"], stuck=True
    )
    assert (whole.nstates, stuck.nstates) == (4, 3)
    w = np.geomspace(0.1, 300, 30)
    assert stuck(1j * w) == pytest.approx(whole(1j * w), rel=1e-8)
    t = np.linspace(0, 0.5, 101)
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)}
    run = pam.simulate(plant, {"muscle.command": 3 * BAR + 0.1}, t=t, start=start, rtol=1e-13)
    expected = np.asarray(control.forced_response(stuck, t, np.full((1, len(t)), 0.1)).outputs)
    for name, row in zip(("x", "muscle.hysteresis"), expected, strict=True):
        assert run[name] - point[name] == pytest.approx(row, abs=0.01 * np.abs(row).max())


@pytest.mark.parametrize(
    "losses",
    [(pam.losses.BoucWen(),), (pam.losses.MaxwellSlip(), pam.losses.Creep())],
    ids=["bouc-wen", "slip and creep"],
)
def test_lqr_and_kalman_hold_a_joint_with_hysteresis(losses):
    plant = pam.AntagonisticJoint(MUSCLE, losses=losses, damping=pam.losses.ConstantDamping(1.0))
    point = plant.equilibrium({"theta": 0.1, "muscle2.command": 2 * BAR}, memory="above")
    feedback = pam.lqr(plant, point, integral={"theta": 30.0}, sample_time=2e-3)
    columns = [v.memory == "held" for v in plant.states]
    assert np.all(feedback.K[:, columns] == 0)
    assert feedback.poles.real.max() < -0.1
    filtered = pam.control.kalman(plant, point, measured={"theta": 1e-4}, sample_time=2e-3)
    controller = pam.control.WithEstimate(feedback, filtered)
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)} | {"theta": 0.13}
    for used in (feedback, controller):
        run = pam.closed_loop(used, plant, duration=2.0, sample_time=2e-3, start=start)
        assert run["theta"][-1] == pytest.approx(0.1, abs=0.003)


def test_tvlqr_ends_as_lqr_holds():
    plant = hanging()
    memory = {"muscle.hysteresis": 0.5}
    point = plant.equilibrium({"muscle.command": 3 * BAR}, memory=memory)
    start = {v.name: x for v, x in zip(plant.states, point.x, strict=True)}
    still = pam.simulate(plant, {"muscle.command": 3 * BAR}, duration=0.2, start=start)
    along = pam.control.tvlqr(plant, still)
    assert along.K[-1] == pytest.approx(pam.lqr(plant, point).K, rel=1e-5, abs=1e-9)


def test_mpc_moves_a_slide_whose_muscles_have_slid():
    plant = pam.AntagonisticSlide(
        MUSCLE, losses=(pam.losses.MaxwellSlip((6.0, 6.0), (0.003, 0.02)),)
    )
    point = plant.equilibrium({"x": 0.0, "muscle1.command": 3 * BAR}, memory="above")
    rate = {v.name: 0.02 for v in plant.inputs}
    mpc = pam.Mpc(
        plant, horizon=15, sample_time=0.02, track={"x": 10.0}, rate=rate, method="rosenbrock"
    )
    start = {v.name: point[v.name] for v in (*plant.states, *plant.inputs)}
    loop = mpc.closed_loop(plant, {"x": 0.004}, 0.6, start=start)
    assert mpc.statistics.failures == 0
    assert loop.trajectory["x"][-1] == pytest.approx(0.004, abs=4e-5)


# ---- vibration -----------------------------------------------------------------------------------


def test_the_hopf_border_is_that_of_the_stuck_spring():
    mass, c, lag = 20.0, 9.0, 0.1
    plant = RegulatedLoad(
        MUSCLE,
        mass,
        lag=lag,
        damping=pam.losses.ConstantDamping(c),
        losses=(pam.losses.BoucWen(FRICTION, YIELD),),
    )
    found = vibration.hopf(
        plant, "muscle.gain", (1e5, 2e7), {"x": 0.04, "muscle.reference": 0.04}, memory="virgin"
    )
    pressure, kappa = found.point["muscle.pressure"], 0.1
    k = float(MUSCLE.stiffness(pressure, kappa)) + FRICTION / YIELD / LENGTH
    slope = float(MUSCLE.tension(pressure + 1, kappa) - MUSCLE.tension(pressure - 1, kappa)) / 2
    gain = ((mass + c * lag) * (c + k * lag) / (mass * lag) - k) / slope
    assert found.value == pytest.approx(gain, rel=1e-6)
    poles = vibration.stability_path(
        plant, "muscle.gain", [0.9 * gain, 1.1 * gain], {"x": 0.04, "muscle.reference": 0.04}
    )
    assert list(poles.stable) == [True, False]


def test_a_muscle_drawn_to_an_offset_has_carried_its_memory_along():
    plant = hanging(pam.losses.BoucWen(FRICTION, YIELD, order=1.0), feed=pam.feeds.IdealPressure())
    point = plant.equilibrium({"muscle.pressure": 3 * BAR})
    for offset in (0.003, -0.002):
        z = carried(plant, point.x, point.u, "x", offset)["muscle.hysteresis"]
        slid = 1 - np.exp(-abs(offset) / LENGTH / YIELD)  # dz/dkappa = (1 - |z|)/yield
        assert z == pytest.approx(np.sign(offset) * slid, rel=1e-3)


def test_small_free_vibration_has_the_frequency_of_the_stuck_spring():
    slip = pam.losses.MaxwellSlip((FRICTION,), (YIELD,))
    plant = hanging(slip, feed=pam.feeds.IdealPressure(), damping=pam.losses.ConstantDamping(10.0))
    found = vibration.free_vibration(plant, {"muscle.pressure": 3 * BAR}, 1e-4, cycles=4, rtol=1e-9)
    expected = np.sqrt(sum(spring_of(found.point)) / 20.0) / (2 * np.pi)
    assert found.frequency == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("memory", ["above", "below"])
def test_from_the_end_of_a_band_a_load_swings_about_where_friction_leaves_it(memory):
    plant = hanging(feed=pam.feeds.IdealPressure(), damping=pam.losses.ConstantDamping(20.0))
    at = {"muscle.pressure": 3 * BAR}
    found = vibration.free_vibration(plant, at, 0.004, cycles=12, rtol=1e-9, memory=memory)
    ends = [plant.equilibrium(at, memory=side)["x"] for side in ("below", "above")]
    assert ends[0] < found.rest < ends[1]
    z = float(found.trajectory["muscle.hysteresis"][-1])
    assert found.rest == pytest.approx(rest_by_hand(3 * BAR, z * FRICTION), abs=3e-4)
    assert np.all(np.diff(found.amplitudes) < 0)


def test_a_load_study_takes_losses_and_a_side():
    found = {
        memory: pam.load_study(
            MUSCLE,
            (20.0,),
            (3 * BAR,),
            losses=(pam.losses.BoucWen(FRICTION, YIELD),),
            memory=memory,
        ).cases[0]
        for memory in ("virgin", "above", "below")
    }
    for memory, share in (("virgin", 0), ("above", -1), ("below", 1)):
        case = found[memory]
        assert case.position == pytest.approx(rest_by_hand(3 * BAR, share * FRICTION), rel=1e-6)
        assert case.frequency > 1
        assert 0 < case.settling_time < 4
    plain = pam.load_study(MUSCLE, (20.0,), (3 * BAR,)).cases[0]
    assert found["below"].overshoot < plain.overshoot


def test_a_virgin_rubber_at_rest_has_been_as_far_as_it_stands():
    loss = pam.losses.Preconditioning(reached=0.03)
    plant = hanging(loss, feed=pam.feeds.Regulator())
    small, large = plant.equilibrium(x=0.004), plant.equilibrium(x=0.04)
    assert small["muscle.reached"] == pytest.approx(0.03)
    assert large["muscle.reached"] == pytest.approx(0.04 / LENGTH, abs=1e-3)
    rates = np.asarray(plant.function(large.x, large.u, plant.vector("parameter"))[0]).ravel()
    assert np.abs(rates[:-1]).max() < 1e-4  # of the rest nothing moves either


def test_a_play_that_has_slid_stands_at_the_envelope_of_its_place():
    """z is the force in parts of the envelope at the end of the stroke: fully slid it is not 1, but
    C(kappa)/C(end), with C = contracting (1 + growth kappa)."""
    loss = pam.losses.PrandtlIshlinskii((10.0,), (6.0,), (0.004,), contracting_growth=2.0)
    plant = hanging(loss, feed=pam.feeds.Regulator())
    point = plant.equilibrium({"x": 0.04}, memory="below")
    end = MUSCLE.contraction_range[1]
    expected = (1 + 2.0 * 0.04 / LENGTH) / (1 + 2.0 * end)
    assert point["muscle.play1"] == pytest.approx(expected, abs=0.03)  # it is rounded
    assert point["muscle.play1"] < 0.9


@pytest.mark.parametrize("leak", [2e-12, 1e-11])
def test_a_leaking_pair_rests_at_commands_that_feed_the_leaks(leak):
    """Within the dead zone the inverted commands left 2e-3 bar/s, which nobody said."""
    feed = pam.feeds.SpoolValve(leak=leak)
    plant = pam.AntagonisticSlide("DMSP-20-200N", 2.0, feed=feed, damping=50.0)
    point = plant.equilibrium({"x": -0.006, "muscle1.pressure": 2.5e5})
    rates = np.asarray(plant.function(point.x, point.u, plant.vector("parameter"))[0]).ravel()
    assert np.abs(rates).max() < 1e-6  # Pa/s
    run = pam.simulate(
        plant,
        dict(zip(("muscle1.command", "muscle2.command"), point.u, strict=True)),
        t=[0.0, 5.0],
        start=dict(zip((v.name for v in plant.states), point.x, strict=True)),
    )
    assert run["muscle1.pressure"][-1] == pytest.approx(2.5e5, abs=10.0)


@pytest.mark.parametrize("short", [0.02, 0.03, 0.1])
def test_a_play_that_has_slid_fully_is_at_its_present_envelope(short):
    """C (1 + 2 kappa), as a part of the largest: what lies above has been let go at once."""
    muscle = pam.muscle("DMSP-20-400N")
    top = muscle.contraction_range[1]
    kappa = top - short
    losses = (pam.losses.PrandtlIshlinskii(),)
    plant = pam.HangingLoad(muscle, 8.0, feed=pam.feeds.Regulator(), losses=losses)
    point = plant.equilibrium(x=kappa * float(muscle.rest_length), memory="below")
    wanted = held(plant, "below")
    x = np.array([wanted.get(v.name, point[v.name]) for v in plant.states])
    u = np.array([point[v.name] for v in plant.inputs])
    found = at_rest(plant, x, wanted, u)
    envelope = (1 + 2 * kappa) / (1 + 2 * top)
    assert set(wanted.values()) == {1.0}
    assert all(envelope <= value <= envelope + 5e-3 for value in found.values())
