"""Instruments against closed forms, and in closed loops."""

import math

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.simulation import Instrument, measured

X = pam.Variable("x", "state", unit="m", nominal=0.01, display_unit="mm")


def record(function, t):
    return pam.Trajectory(t, {"x": function(t)}, [X])


def test_a_filter_follows_a_ramp_as_the_closed_form_says():
    """y' = (q - y)/tau with q = r t: y = r (t - tau (1 - exp(-t/tau)))."""
    t = np.sort(np.random.default_rng().uniform(0, 0.3, 40))
    t[0] = 0.0
    tau, rate = 0.02, 0.7
    read = measured(record(lambda t: rate * t, t), {"x": Instrument(filter="20 ms")})
    assert read["x"] == pytest.approx(rate * (t - tau * (1 - np.exp(-t / tau))), abs=1e-14)


@pytest.mark.parametrize("delay", [0.0, 0.0037, 0.010, 0.0251])
def test_a_delay_of_any_length_is_exact_on_a_line(delay):
    t = np.linspace(0, 0.1, 21)
    read = measured(record(lambda t: 0.1 * t + 0.02, t), {"x": Instrument(delay=delay)})
    assert read["x"] == pytest.approx(0.1 * np.maximum(t - delay, 0) + 0.02, abs=1e-15)


def test_sample_and_hold_delay_gain_bias_and_drift_in_their_order():
    t = np.linspace(0, 0.1, 101)
    how = Instrument(gain=2.0, bias=0.001, drift=0.05, sample_time=0.01, delay=0.003)
    read = measured(record(lambda t: t**2, t), {"x": how})
    held = np.maximum(0.01 * np.floor((t - 0.003) / 0.01 + 1e-9), 0)
    assert read["x"] == pytest.approx(2 * held**2 + 0.001 + 0.05 * held, abs=1e-13)


def test_readings_are_whole_steps_within_the_range():
    t = np.linspace(0, 1, 57)
    how = Instrument(resolution="0.5 mm", low="-2 mm", high="3.2 mm")
    read = measured(record(lambda t: 0.01 * np.sin(9 * t), t), {"x": how})["x"]
    steps = read / 5e-4
    assert np.allclose(steps, np.round(steps), atol=1e-9)
    limited = np.clip(0.01 * np.sin(9 * t), -2e-3, 3.2e-3)
    assert np.abs(read - limited).max() <= 2.5e-4 + 1e-12


def test_noise_is_white_and_of_its_size_and_one_per_sample():
    t = 1e-3 * np.arange(40_001)
    how = Instrument(noise=2e-5, sample_time=0.002)
    seed = int(np.random.default_rng().integers(2**31))
    read = measured(record(lambda t: 0 * t, t), {"x": how}, seed=seed)["x"]
    assert np.array_equal(read[0:-1:2], read[1::2])  # held between samples
    new = read[::2]
    n = len(new)
    assert np.std(new) == pytest.approx(2e-5, rel=5 / math.sqrt(2 * n))
    assert abs(np.corrcoef(new[1:], new[:-1])[0, 1]) < 5 / math.sqrt(n)
    assert np.array_equal(read, measured(record(lambda t: 0 * t, t), {"x": how}, seed=seed)["x"])


def test_a_random_walk_grows_with_the_root_of_time_whatever_the_step():
    ends = []
    for seed in range(400):
        t = np.linspace(0, 4.0, 3 + seed % 5)
        ends.append(measured(record(lambda t: 0 * t, t), {"x": Instrument(wander=1e-3)}, seed=seed))
    spread = np.std([m["x"][-1] for m in ends])
    assert spread == pytest.approx(1e-3 * 2.0, rel=5 / math.sqrt(800))


def test_a_record_has_its_own_sample_time_and_keeps_other_columns():
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0)
    motion = pam.simulate(plant, {"muscle.command": 3e5}, duration=0.2)
    seen = measured(motion, {"x": Instrument(bias="1 mm")}, sample_time="10 ms")
    assert seen.t == pytest.approx(0.01 * np.arange(21))
    assert seen["x"] == pytest.approx(motion.at(seen.t)["x"] + 1e-3, abs=1e-12)
    assert np.array_equal(seen["v"], motion.at(seen.t)["v"])


def test_a_loop_regulates_what_its_sensor_reads_not_what_is():
    """With integral action the reading ends at the reference: the truth misses it by the bias."""
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)
    point = slide.equilibrium(x=0.0, stiffness=1.6e4)
    law = pam.lqr(slide, point, integral={"x": 50.0})
    bias = Instrument(bias="0.5 mm", delay="1.5 ms", filter="1 ms")
    loop = pam.closed_loop(law, slide, duration=2.0, start=point, sensors={"x": bias})
    assert loop["x"][-1] - point["x"] == pytest.approx(-5e-4, abs=2e-5)
    assert loop.seen["x"][-1] == pytest.approx(point["x"], abs=2e-5)


def test_an_instrument_changes_nothing_where_it_is_ideal():
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)
    point = slide.equilibrium(x=0.0, stiffness=1.6e4)
    law, start = pam.lqr(slide, point), {**point.values, "x": 0.003}
    start = {v.name: start[v.name] for v in (*slide.states, *slide.inputs)}
    plain, ideal = (
        pam.closed_loop(law, slide, duration=0.1, start=start, sensors=sensors)
        for sensors in (None, {"x": Instrument()})
    )
    assert np.array_equal(plain["x"], ideal["x"])


@pytest.mark.parametrize(
    ("instrument", "words"),
    [
        (Instrument(noise=-1.0), "noise"),
        (Instrument(delay="3 mm"), "something else"),
        (Instrument(gain=0.0), "reads nothing"),
        (Instrument(low=1.0, high=0.0), "must lie below"),
        (Instrument(sample_time=0.0), "sample_time"),
        (Instrument(resolution=math.nan), "resolution"),
        (3.0, "Instrument"),
    ],
)
def test_what_cannot_be_meant_is_said(instrument, words):
    refused(words, measured, record(lambda t: t, np.linspace(0, 1, 3)), {"x": instrument})


def test_a_sensor_of_nothing_is_refused():
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)
    with pytest.raises(pam.UnknownNameError, match="velocity"):
        pam.closed_loop(lambda t, y: {}, slide, duration=0.1, sensors={"velocity": Instrument()})
