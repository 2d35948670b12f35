"""A rig as a side of closed loops: controllers, estimators, plans, records, homing, learning."""

import json
import math

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import instruments, made, plant  # noqa: F401 - fixtures
from rig_tools import on_twin, twin_at_random, wanted_sine

import pam_ocp as pam
from pam_ocp.control.references import sine


def test_a_controller_with_an_estimator_runs_on_the_rig_as_on_the_plant(made, plant):
    start = plant.equilibrium(x=0.03)
    goal = plant.equilibrium(x=0.04)
    rig, twin = made()
    law = pam.lqr(plant, goal, integral={"x": 100.0}, sample_time=0.005)
    known = pam.KalmanFilter(
        plant, sample_time=0.005, measured={"x": 1e-5, "muscle.pressure": 200.0}
    )
    rig.arm()
    loop = pam.closed_loop(law, rig, {"x": 0.04}, duration=2.0, start=start, estimator=known)
    assert loop.verdict, str(loop.verdict)
    assert abs(twin.motion()["x"][-1] - 0.04) < 1e-4
    assert abs(loop["x"][0] - 0.03) < 5e-4
    assert loop.estimate is not None
    assert np.max(np.abs(loop.seen["v"][-20:])) < 0.01
    same = pam.closed_loop(law, plant, {"x": 0.04}, duration=2.0, start=start, estimator=known)
    assert type(same) is type(loop)
    late = same.t > 1.0  # when the step of taking over has faded
    assert np.max(np.abs(same["x"] - np.interp(same.t, loop.t, loop["x"]))[late]) < 2e-4
    noise = np.std(np.diff(loop["x"][-50:])) / np.sqrt(2)
    assert noise < 2e-5  # nothing was added to what the rig measures


def test_an_mpc_runs_on_the_rig(made, plant):
    start, goal = plant.equilibrium(x=0.03), 0.035
    rig, _ = made()
    mpc = pam.Mpc(plant, horizon=10, sample_time=0.02, track={"x": 1.0})
    known = pam.KalmanFilter(
        plant, sample_time=0.02, measured={"x": 1e-5, "muscle.pressure": 200.0}
    )
    rig.arm()
    loop = pam.closed_loop(mpc, rig, {"x": goal}, duration=1.0, start=start, estimator=known)
    assert abs(loop["x"][-1] - goal) < 5e-4
    assert loop.statistics.failures == 0


def test_a_slope_stands_in_for_a_velocity_that_nothing_measures(made, plant):
    readings = [
        pam.rig.Reading("x"),
        pam.rig.Reading("muscle.pressure"),
        pam.rig.Reading("v", slope_of="x", filter="5 ms"),
    ]
    rig, twin = made(readings=readings, noise=False)
    rig.arm()
    run = rig.run(lambda t: {"muscle.command": 3e5 + 5e4 * np.sin(6 * t)}, 2.0)
    rows = twin.motion()
    real = np.interp(run.t[200:] - 0.005, rows.t, rows["v"])
    assert np.max(np.abs(run["v"][200:] - real)) < 0.03 * np.max(np.abs(real))


def test_what_a_rig_has_not_is_refused_in_a_sentence(made, plant):
    rig, _ = made()
    rig.arm()
    for options, words in (({"parameters": {"mass": 2.0}}, "parameters"), ({"parts": 3}, "parts")):
        refused(words, pam.closed_loop, lambda t, s: {}, rig, duration=0.1, **options)
    refused("supply", pam.Rig, rig.driver, [pam.rig.Reading("supply")], plant=plant)
    refused("vent", pam.rig.Command, "u", "V", low=-10.0, high=10.0)
    refused("straight line", pam.rig.Command, "u", "Pa", scale="V*V * 1 bar/V^2", low=0.0, high=1e5)
    refused("a driver has read, write, vent, close", pam.Rig, object(), plant=plant)
    assert rig.check("100 ms")["time"]["missing"] == 0.0
    for wrong in (-1.0, math.nan, "1 bar", None):
        refused("duration", rig.check, wrong)
    x, v = pam.rig.Reading("x"), pam.rig.Reading("v", slope_of="x")
    a = pam.rig.Reading("a", "m/s2", slope_of="v")
    pam.Rig(rig.driver, [x, v, a], plant=plant)
    for order in ([x, a, v], [x, pam.rig.Reading("v", "m/s", slope_of="v")]):
        refused("slope_of = 'v' is a slope itself", pam.Rig, rig.driver, order, plant=plant)


def test_calibrations_lead_from_volts_to_si_and_back(plant):
    readings = [
        pam.rig.Reading("x", scale="V * 20 mm/V - 50 mm"),
        pam.rig.Reading("muscle.pressure", scale="bar"),
    ]
    commands = [pam.rig.Command("muscle.command", scale="V * 1 bar/V - 0.5 bar")]
    rig, twin = on_twin(plant, readings, commands)
    raw = twin.read()
    true = twin.values
    assert raw["x"] == pytest.approx((true["x"] + 0.05) / 0.02)
    assert rig.read()["x"] == pytest.approx(true["x"], abs=1e-12)
    rig.arm()
    rig.run(lambda t: {"muscle.command": 2e5}, 3.0)
    assert np.max(twin.motion()["muscle.command"]) == pytest.approx(2e5)


@pytest.mark.slow
def test_records_are_whole_lines_that_readers_and_fits_take(made, plant, tmp_path):
    rig, _ = made(record=tmp_path / "runs")
    rig.arm()
    levels = [1e5, 3e5, 2e5, 4e5]
    for _ in range(2):
        loop = pam.closed_loop(
            lambda t, s: {"muscle.command": levels[int(t / 0.5) % 4]}, rig, duration=2.0
        )
    paths = sorted((tmp_path / "runs").glob("run_*.csv"))
    assert [p.name for p in paths] == ["run_0001.csv", "run_0002.csv"]
    about = json.loads(paths[0].with_suffix(".json").read_text())
    assert about["ended"]
    assert about["samples"] == 400
    assert about["missed"] == 0
    assert about["versions"]["pam_ocp"] == pam.__version__
    assert about["channels"]["x"]["frozen"] == 0.03
    read = pam.rig.read_run(paths[1])
    assert read.named("input") == ("muscle.command",)
    assert np.allclose(read["x"][: len(loop.t)], loop["x"], atol=1e-9)
    record = pam.read_record(paths[1], plant)
    assert np.allclose(record["muscle.command"], read["muscle.command"])
    with paths[1].open("a") as file:
        file.write("2.005,0.04")  # killed while it wrote
    assert len(pam.rig.read_run(paths[1])) == len(read)
    fit = pam.fit_plant(
        plant.with_values(mass=8.0), read.at(read.t[:-1:4]), ["mass"], outputs=["x"]
    )
    assert abs(fit.values["mass"] - 10.0) < 0.1


def test_homing_finds_zeros_noise_slack_and_range(made, plant):
    readings = [
        pam.rig.Reading("x", low="-20 mm", high="60 mm"),
        pam.rig.Reading("muscle.pressure", low="-0.3 bar", high="6 bar"),
    ]
    sensors = {
        "x": pam.simulation.Instrument(noise=2e-5, bias=1e-3),
        "muscle.pressure": pam.simulation.Instrument(noise=300.0, bias=4e3),
    }
    rig, _ = on_twin(plant, readings, sensors=sensors)
    rig.arm()
    found = rig.home(level="5 bar")
    assert found.ok, found.report()
    assert found.noise["x"] == pytest.approx(2e-5, rel=0.25)
    assert found.noise["muscle.pressure"] == pytest.approx(300.0, rel=0.25)
    assert found.zeros["muscle.pressure"] == pytest.approx(4e3, abs=100.0)
    assert rig.zeros == dict(found.zeros)
    assert found.ranges["x"][1] < 0.06  # turned round before its limit
    assert found.ranges["x"][1] > 0.04
    rest = plant.equilibrium(muscle_pressure=found.slack["muscle.command"])
    assert abs(rest["x"]) < 5e-3
    rig.clock.wait(rig.clock.now() + 2.0)
    assert abs(rig.read()["muscle.pressure"]) < 1500.0
    assert "no warnings" in found.report()


@pytest.mark.parametrize("supply", [{"low": "3 bar"}, {"low": "3 bar", "high": "10 bar"}])
def test_homing_sweeps_though_a_reading_rests_beyond_its_lower_limit(made, supply):
    readings = [
        pam.rig.Reading("x", low="-20 mm", high="40 mm"),
        pam.rig.Reading("muscle.pressure"),
        pam.rig.Reading("supply", "Pa", **supply),
    ]
    rig, _ = made(readings=readings)
    rig.arm()
    found = rig.home(level="5 bar")
    assert found.ok, found.report()
    assert 0.034 < found.ranges["x"][1] < 0.040  # turned round after 0.9 of the way


def test_homing_doubts_a_valve_that_does_nothing(made):
    rig, _ = made(
        [pam.rig.Fault("supply")],
        readings=[pam.rig.Reading("x"), pam.rig.Reading("muscle.pressure")],
    )
    rig.arm()
    found = rig.home(level="3 bar", sweep_time=1.0, hold_time=0.5)
    assert not found.ok
    assert any("nothing moved with muscle.command" in words for words in found.doubts)


@pytest.mark.slow
def test_identification_finds_what_the_twin_has(plant):
    readings = [
        pam.rig.Reading("x", low="-20 mm", high="80 mm"),
        pam.rig.Reading("muscle.pressure", low="-0.3 bar", high="6.5 bar"),
    ]
    sensors = instruments(x=2e-5, pressure=300.0)
    true = plant.with_values({"mass": 12.0, "muscle.lag": 0.07})
    rig, twin = on_twin(plant, readings, true=true, sensors=sensors)
    rig.arm()
    found = rig.identify(["mass", "muscle.lag"], duration=1.0, rounds=2, width=0.02)
    assert found.reached, found.report()
    assert found.plant.variable("mass").start == pytest.approx(12.0, rel=0.02)
    assert found.plant.variable("muscle.lag").start == pytest.approx(0.07, rel=0.02)
    assert np.max(twin.motion()["x"]) < 0.08
    assert "excitations" in found.report()
    assert not twin.armed
    short = rig.identify(["mass"], duration=1.0, rounds=3, width=1e-6, within=1.5)
    assert len(short.records) == 1
    assert "1.5 s are over" in short.report()


def slide(seed):
    """A rig of an antagonistic slide whose twin differs by chance: (rig, twin, model)."""
    rng = np.random.default_rng(seed)
    muscle = pam.muscle("DMSP-20-200N")
    losses = (pam.losses.BoucWen(), pam.losses.Creep())
    true = pam.AntagonisticSlide(muscle, losses=losses)
    model, clock = pam.AntagonisticSlide(muscle), pam.rig.SimulatedClock()
    pressures = ("muscle1.pressure", "muscle2.pressure")
    sensors = {n: pam.simulation.Instrument(noise=200.0) for n in pressures}
    sensors["x"] = pam.simulation.Instrument(noise=1e-5)
    zone = [
        pam.rig.Fault("dead_zone", f"muscle{i}.command", float(rng.uniform(2e3, 8e3)))
        for i in (1, 2)
    ]
    options = {"scale": float(rng.uniform(0.8, 1.2)), "delay": 0.005, "seed": seed, "faults": zone}
    twin = pam.rig.Twin(true, clock=clock, sensors=sensors, **options)
    readings = [
        pam.rig.Reading("x", low="-30 mm", high="30 mm"),
        *(pam.rig.Reading(n, low="-0.3 bar", high="6.5 bar") for n in pressures),
    ]
    rig = pam.Rig(pam.rig.driver("twin", twin=twin), readings, plant=model, clock=clock)
    return rig, twin, model


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_learning_brings_the_error_of_a_sine_down_to_a_fifth(seed):
    rig, _, model = slide(seed)
    law = pam.control.PositionController(
        model, sine(0.0, 0.01, 1.0), pam.control.PID.placed(3.0), sample_time=0.005, stiffness=2.5e4
    )
    start = model.equilibrium(x=-0.01, stiffness=2.5e4)
    wanted = pam.closed_loop(law, model, duration=2.0, start=start).trajectory
    rig.arm()
    found = rig.learn(wanted, "x", runs=6)
    assert min(found.errors) <= found.errors[0] / 5, found.report()
    assert max(found.errors) <= 2 * found.errors[0]
    again = rig.run(found.inputs, start=found.start)
    error = np.interp(again.t, wanted.t, wanted["x"]) - again["x"]
    assert np.sqrt(np.mean(error**2)) < 1.5 * min(found.errors)


@pytest.mark.slow
def test_a_load_that_swings_long_is_learned_and_each_run_begins_at_rest():
    """85 kg on a muscle, which swing on for seconds after a motion: decay at 0.59/s."""
    rig, _, model = twin_at_random(66)
    wanted, position = wanted_sine(model)
    rig.arm()
    found = rig.learn(wanted, position, runs=10)
    assert found.gain >= 5.0, found.report()
    assert max(found.errors) <= 2 * found.errors[0]
    size = np.ptp(wanted[position])
    for run in found.runs:
        assert np.ptp(run[position][run.t < 0.02]) < 0.02 * size


def test_a_plan_is_replayed_on_the_rig(made, plant):
    rig, _ = made(noise=False)
    plan = pam.plan(plant, [{"x": 0.02}, {"x": 0.04}], duration=0.6)
    rig.arm()
    run = rig.run(plan)
    wanted = np.interp(run.t, plan.trajectory.t, plan.trajectory["x"])
    assert np.max(np.abs(run["x"] - wanted)) < 5e-4
    assert run.duration == pytest.approx(plan.duration, abs=0.01)


def test_a_command_reads_nothing_and_a_spike_is_every_other_reading(made):
    rig, _ = made(noise=False, faults=[pam.rig.Fault("spike", "x", 0.5, at=0.0)])
    read = []
    for _ in range(6):
        rig.driver.write({"muscle.command": 0.0})
        read.append(rig.driver.read()["x"] > 0.25)
    assert sorted((read[::2], read[1::2])) == [[False] * 3, [True] * 3]
