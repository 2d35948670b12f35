"""Tuning: what a rig teaches besides its model, and tracking with it."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import made, plant  # noqa: F401 - fixtures
from rig_tools import twin_at_random

import pam_ocp as pam
from pam_ocp.control import PID, HysteresisCompensation
from pam_ocp.control.references import sine
from pam_ocp.rig.tracking import (
    CREEPS,
    YIELDS,
    Answer,
    LearnedInverse,
    Memory,
    Residual,
    bent,
    lines,
    placed_by,
)


@pytest.mark.parametrize(
    ("stiffness", "error", "grows"),
    [("40 N/mm", 1e-3, 1.0), (1.5e4, 1.0, 0.0), (1.5e4, -1.0, 0.0)],
)
def test_the_integral_stops_where_no_muscle_is_left_to_act(stiffness, error, grows):
    """Of 40 N/mm one pressure is at its end, and the other still gives any acceleration; of 1e4
    m/s2 none does, and what was asked for beyond stays as it is, on either side.
    """
    h, ki = 0.005, 1e4
    plant = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)
    inner = HysteresisCompensation(plant, sample_time=h, stiffness=stiffness)
    none = Residual.none(Memory(0.0, 0.01, h))
    law = LearnedInverse(inner, none, 2 * h, PID(0.0, ki=ki))
    run = law.tracking({"x": lambda t: 0.008}, {}, True)
    measured = {"x": 0.008 - error, "muscle1.pressure": 4e5, "muscle2.pressure": 3e5}
    for k in range(600):
        run(k * h, measured)
    ends = np.isclose(run.asked[-1][1], 0) | np.isclose(run.asked[-1][1], inner.inverse.high)
    assert list(ends) == ([True, False] if grows else [True, True])
    step = ki * h * error
    assert run.added[-1] - run.added[-2] == pytest.approx(grows * step, rel=1e-9, abs=1e-12)
    measured["x"] += 2 * error  # what drives back acts at once
    run(600 * h, measured)
    assert run.added[-1] - run.added[-2] == pytest.approx(-step, rel=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_round_elements_are_those_of_bouc_and_wen(order):
    """Against explicit steps of z' = s' [1 - (sign(s' z) + 1)/2 |z|^n] / y, 200 a sample."""
    s = 0.3 * np.sin(np.linspace(0.0, 9.0, 60)) + 0.1 * np.sin(np.linspace(0.0, 31.0, 60))
    z = np.zeros((2, len(YIELDS)))
    exact = np.zeros(len(YIELDS))
    for ds in np.diff(s):
        z = bent(z, ds / YIELDS)
        for _ in range(200):
            held = (np.sign(ds * exact) + 1) / 2 * np.abs(exact) ** order
            exact = exact + ds / 200 / YIELDS * (1 - held)
        np.testing.assert_allclose(z[order - 1], exact, atol=5e-3)


def test_creep_is_found_along_another_motion():
    """A Kelvin-Voigt element of 1 s, integrated by hand, is a sum of the functions of Memory."""
    h, rng = 0.005, np.random.default_rng(5)

    def motion(seconds):
        t = np.arange(0.0, seconds, h)
        f, phase = rng.uniform(0.1, 1.5, (2, 6))
        x = 0.01 + 0.001 * np.sin(2 * np.pi * np.outer(t, f) + phase).sum(axis=1)
        v = np.gradient(x, h)
        slow, force = x[0], []
        for value in x:
            slow += (1 - np.exp(-h)) * (value - slow)
            force.append(700.0 * (value - slow) + 30.0 * value)
        return (x, v, np.gradient(v, h)), np.array(force)

    memory = Memory(0.01, 0.008, h)
    assert 1.0 in CREEPS
    learned, force = motion(20.0)
    found = Residual.none(memory).fitted(memory.along(*learned), force)
    other, force = motion(5.0)
    again = found.again()
    reckoned = np.array([again(*row) for row in zip(*other, strict=True)])
    assert np.std(reckoned - force) < 0.02 * np.std(force)


def test_the_inverse_finds_pressures_from_which_a_slack_muscle_is_far():
    """At 3 % short of the range this muscle is slack at half its pressure: no slope there."""
    plant = pam.HangingLoad("DMSP-10-250", mass=3.0, damping=100.0)
    inverse = pam.control.InverseDynamics(plant)
    for x in (0.005, 0.02, 0.03, 0.035):
        (pressure,) = inverse(x, 0.0, 0.0)
        at = plant.with_values({"x": x, "v": 0.0, "muscle.pressure": float(pressure)})
        rates = at.function(at.vector("state"), at.vector("input"), at.vector("parameter"))[0]
        place = [v.name for v in at.states].index("v")
        assert abs(float(rates[place])) < 1e-3
        rows = inverse.accelerations([x], [0.0], [[pressure]])
        assert rows[0] == pytest.approx(float(rates[place]), abs=1e-9)


def test_elements_of_a_twin_never_hold_more_than_they_can():
    losses = pam.losses.MaxwellSlip([9.0, 9.0], [2e-4, 5e-3])
    plant = pam.AntagonisticSlide("DMSP-20-300", mass=1.0, losses=losses)
    clock = pam.rig.SimulatedClock()
    twin = pam.rig.Twin(plant, clock=clock)
    twin.arm()
    for k in range(20):
        twin.write({f"muscle{i}.command": 3e5 + (-1) ** (k + i) * 1.5e5 for i in (1, 2)})
        clock.wait(clock.now() + 0.02)
        twin.tick()
    moved = twin.motion()
    assert np.ptp(moved["x"]) > 1e-3
    slips = [n for n in moved.names if ".slip" in n]
    assert slips
    assert all(np.max(np.abs(moved[n])) <= 1.0 for n in slips)


def test_stamps_of_a_transport_are_in_the_time_of_a_simulated_clock():
    rig, twin, _ = twin_at_random(3, way="modbus")
    rig.clock.wait(0.25)
    try:
        assert rig.read()["time"] == pytest.approx(0.25, abs=1e-3)
    finally:
        rig.close()
        twin.served.close()


def test_what_cannot_be_tuned_is_said(made):
    rig, _ = made()
    refused("not armed", rig.tune, error=pam.rig.RigError)
    rig.arm()
    refused("span", rig.tune, span=(0.04, 0.02))
    refused("at least 5 s", rig.tune, duration=1.0)
    refused("seed", rig.tune, seed="a")
    rig.plant = None
    refused("no model", rig.tune)


def moved(answer, asked, h=0.005, fine=20):
    """Errors at samples of M e'' + D e' + K e = d - u(t - T), by small steps; asked(k, e) -> u."""
    step, e, v, errors, sent = h / fine, 0.0, 0.0, [], []
    late = round(answer.late / step)
    for k in range(3200):
        errors.append(e)
        u, d = asked(k, e)
        sent += [(u, d)] * fine
        for j in range(k * fine, (k + 1) * fine):
            pull = sent[j][1] - (sent[j - late][0] if j >= late else 0.0)
            v += step * (pull - answer.damping * v - answer.stiffness * e) / answer.mass
            e += step * v
    return np.array(errors)


ANSWERS = pytest.mark.parametrize(
    "true", [Answer(0.8, 7.0, 11000.0, 0.008), Answer(1.25, 2.0, 300.0, 0.012)]
)


@ANSWERS
def test_what_a_rig_answers_is_found_from_a_run(true):
    """The model is integrated by hand; its position is read with noise."""
    rng = np.random.default_rng(1)
    t = 0.005 * np.arange(3200)
    phases = rng.uniform(0, 2 * np.pi, len(lines(0.005)))
    u = np.sin(2 * np.pi * np.outer(t, lines(0.005)) + phases).sum(axis=1)
    error = moved(true, lambda k, e: (u[k], 0.0))
    error = error + 0.02 * np.std(error) * rng.standard_normal(len(error))
    found = Answer.shown(error, u, 0.005, 2 * true.stiffness)
    assert found.mass == pytest.approx(true.mass, rel=0.05)
    assert found.stiffness == pytest.approx(true.stiffness, rel=0.05)
    assert found.damping == pytest.approx(true.damping, rel=0.2)
    assert found.late == pytest.approx(true.late, abs=5e-4)


@ANSWERS
def test_gains_damp_what_rings_and_follow_what_drifts(true):
    """Against no feedback, by hand, with another stiffness than was found; steps disturb."""
    rng = np.random.default_rng(2)
    steps = np.repeat(rng.standard_normal(32), 100)
    open_loop = moved(true, lambda k, e: (0.0, steps[k]))
    pid = placed_by(true, 0.005, open_loop, PID(0.0))
    assert pid.ki >= 2.0 * true.stiffness
    for part in (0.85, 1.15):
        other, law, again = (
            replace(true, stiffness=part * true.stiffness),
            replace(pid),
            replace(pid),
        )
        without = moved(other, lambda k, e: (0.0, steps[k]))
        with_it = moved(other, lambda k, e, law=law: (law(e, 0.005), steps[k]))
        assert np.std(with_it) < 0.8 * np.std(without)
        held = moved(other, lambda k, e, law=again: (law(e, 0.005), 1.0))
        assert abs(np.mean(held[-400:])) < 0.05 / other.stiffness


def test_what_creeps_goes_on_from_the_past():
    memory = Memory(0.01, 0.008, 0.005)
    t = 0.005 * np.arange(2000)
    x = 0.01 + 0.004 * np.sin(t) - 0.01 * (t < 3.0)
    rows = memory.along(x, 0.0 * x, 0.0 * x)
    crept = memory.crept(t, x)
    np.testing.assert_allclose((x[-1] - 0.01) / 0.008 - crept, rows[-1, -len(CREEPS) :], atol=1e-9)
    again = memory.along(x[-1:], np.zeros(1), np.zeros(1), crept)
    np.testing.assert_allclose(again[0, -len(CREEPS) :], rows[-1, -len(CREEPS) :], atol=0.02)


def test_a_rig_remembers_what_it_read(made):
    rig, _ = made()
    rig.arm()
    rig.run(lambda t: {"muscle.command": 3e5}, 0.5)
    times = np.array([t for t, _ in rig.past])
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] - times[0] > 0.5
    assert rig.past[-1][1]["x"] > rig.past[0][1]["x"] + 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("slide", {"rounds": 3}),  # it rings at 17 Hz: what the rig shows when it is shaken counts
        ("hanging", {"bandwidth": 4.0}),
    ],
)
def test_a_tuned_rig_tracks_unseen_motions(kind, options):
    """With short training motions; benchmarks/rig_study.py has longer ones, joints and gains that
    are found for all of them.
    """
    rig, twin, _ = twin_at_random(100, kind)
    rig.arm()
    rig.home()
    tuned = rig.tune(duration=15.0, **options)
    low, high = tuned.range
    position, stroke = tuned.law.position, high - low
    assert twin.now() < 1800.0
    assert "RMS" in tuned.report()
    for part in (0.5, 0.9):
        motion = sine((low + high) / 2 + 0.04 * stroke, 0.5 * part * stroke, 1.0)
        wanted = {position: lambda t, motion=motion: motion(t)[0]}
        begin = tuned.start(motion(0.0)[0])
        loop = pam.closed_loop(tuned.law, rig, wanted, duration=3.0, start=begin)
        missed = loop[position] - np.array([motion(t)[0] for t in loop.t])
        assert np.sqrt(np.mean(missed[loop.t > 1.0] ** 2)) < 0.005 * stroke
    limits = rig.readings[position]
    assert limits.low <= np.min(twin.motion()[position])
    assert np.max(twin.motion()[position]) <= limits.high
