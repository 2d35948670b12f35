"""The closed loop, exact inverse, PID and cascade."""

import numpy as np
import pytest
from conftest import BAR, refused
from design_tools import Fixed
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.control.inverse import InverseDynamics, stiffness_of
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.pid import PID, PositionController, PressureLoop
from pam_ocp.control.references import hold, moves, sine
from pam_ocp.plants.valves import OnOffValves, SpoolValve


# ---- the loop itself
def test_between_samples_the_plant_moves_as_in_simulate(slide):
    answer = lambda t: {"muscle1.command": (3 + (t > 0.0499)) * BAR, "muscle2.command": 3 * BAR}  # noqa: E731
    run = closed_loop(Fixed(answer), slide, duration=0.2, sample_time=5e-3, parts=4)
    assert len(run.t) == 161
    motion = pam.simulate(slide, run.trajectory, t=run.t)
    assert run.trajectory.compare(motion).largest < 1e-6


def test_what_the_controller_asks_is_kept_within_the_plants_range(slide):
    run = closed_loop(Fixed({"muscle1.command": 20 * BAR}), slide, duration=0.05, sample_time=1e-2)
    assert np.all(run["muscle1.command"] == slide.variable("muscle1.command").max)
    assert np.all(run["muscle2.command"] == slide.variable("muscle2.command").start)


def test_a_delay_lets_the_start_values_run_first(slide):
    run = closed_loop(
        Fixed({"muscle1.command": 4 * BAR}), slide, duration=0.05, sample_time=1e-2, delay=2
    )
    assert run["muscle1.command"][:4] == pytest.approx([3 * BAR, 3 * BAR, 4 * BAR, 4 * BAR])


def test_bad_arguments_of_the_closed_loop_are_named(slide):
    for answer, change, words in (
        ({}, {"duration": 1e-4, "sample_time": 1e-3}, "at least one sample"),
        ({"x": 0.0}, {}, "x is a state of the plant, not an input"),
        ({"muscle1.command": np.nan}, {}, "controller's answer at t = 0 s is not finite"),
        ({}, {"noise": {"muscle1.command": 1.0}}, r"noise: muscle1\.command is not measured"),
    ):
        with pytest.raises(InputError, match=words):
            closed_loop(Fixed(answer), slide, **{"duration": 0.1, "sample_time": 1e-2, **change})


@pytest.mark.slow
def test_the_fmu_as_the_plant_gives_the_same_closed_loop(slide, tmp_path):
    fmu = pam.export_fmu(slide, tmp_path / "slide.fmu", platforms="native")
    there = slide.equilibrium(x=0.003, stiffness=2.2e4)
    feedback = lqr(slide, there, integral={"x": 50.0}, sample_time=2e-3)
    shared = {"duration": 0.3, "sample_time": 2e-3, "parameters": {"mass": 2.6}, "parts": 2}
    plant, unit = (closed_loop(feedback, side, **shared).trajectory for side in (slide, fmu))
    assert plant["x"][-1] != pytest.approx(plant["x"][0], abs=1e-3)
    assert plant.compare(unit).largest < 1e-6


# ---- exact inverse, PID, cascade
def test_the_inverse_is_the_allocation_of_a_pair(joint):
    inverse, allocation = InverseDynamics(joint), pam.operating.Allocation(joint)
    theta, omega, alpha, stiffness = 0.3, 0.7, 5.0, 26.0
    effort = 0.05 * alpha + 0.3 * omega + 1.0 * 9.80665 * 0.2 * np.sin(theta)
    expected = allocation.pressures(theta, effort, stiffness)
    assert inverse(theta, omega, alpha, stiffness) == pytest.approx(np.ravel(expected), rel=1e-10)


def test_the_inverse_of_one_muscle_is_its_law_turned_round(long_muscle):
    plant = pam.HangingLoad(long_muscle, mass=20.0, damping=pam.losses.ConstantDamping(50.0))
    found = InverseDynamics(plant)(0.05, 0.2, 1.5)
    force = 20.0 * (9.80665 + 1.5) + 50.0 * 0.2
    assert found[0] == pytest.approx(long_muscle.pressure(force, 0.05 / 0.4), rel=1e-10)


def test_out_of_reach_the_inverse_stays_in_range_and_keeps_the_acceleration_if_it_can(joint):
    inverse = InverseDynamics(joint)
    stiff = inverse(0.0, 0.0, 0.0, 500.0)
    assert stiff == pytest.approx([6e5, 6e5])
    tilted = inverse(0.3, 0.0, 0.0, 500.0)
    assert tilted.max() == 6e5
    x = {"theta": 0.3, "muscle1.pressure": tilted[0], "muscle2.pressure": tilted[1]}
    moved = joint.with_values(x)
    given = moved.vector("state"), moved.vector("input"), joint.vector("parameter")
    xdot, *_ = joint.function(*given)
    assert float(xdot[1]) == pytest.approx(0.0, abs=1e-6)


def test_a_pair_that_is_slack_at_its_start_is_as_stiff_as_between_first_pull_and_full_pressure():
    """By SciPy and the law alone: thin muscles of 250 mm pull from 3.4 bar on at 11 % only."""
    muscle, at = pam.muscle("DMSP-10-250"), 0.11
    pair = pam.AntagonisticSlide(muscle, pre_contraction=at)
    highest = pair.variable("muscle1.pressure").max
    first = brentq(lambda p: float(muscle.force(p, at)) - 1e-3, 1e5, highest)
    middle, step = (first + highest) / 2, 1e-5
    steep = float(muscle.force(middle, at - step)) - float(muscle.force(middle, at + step))
    expected = 2 * steep / (2 * step * muscle.rest_length)
    assert float(muscle.force(pair.variable("muscle1.pressure").start, at)) == 0.0
    assert stiffness_of(pair) == pytest.approx(expected, rel=0.02)


def test_the_inverse_says_what_it_lacks(joint, long_muscle):
    refused("give a stiffness for a pair", InverseDynamics(joint), 0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=r"only through a tendon .* \(higher relative degree"):
        InverseDynamics(pam.SeriesLoad(long_muscle))
    resting = pam.Plant("resting")
    resting.der(resting.state("x"), 0.0)
    refused("needs a plant with one position", InverseDynamics, resting)
    refused("not a Plant", InverseDynamics, long_muscle)


@pytest.mark.parametrize(
    "reference", [moves([0.0, 0.4, -0.2], [0.1, 0.8], 0.5), sine(0.1, 0.3, 1.5), hold(0.2)]
)
def test_velocity_and_acceleration_of_a_reference_are_its_derivatives(reference):
    h = 1e-4
    for t in (0.05, 0.23, 0.47, 0.7, 1.1):
        x, v, a = reference(t)
        before, after = reference(t - h), reference(t + h)
        assert v == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-5)
        assert a == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-4)
        assert np.isfinite(x)


def test_feed_forward_by_the_inverse_alone_follows_the_motion_it_was_made_for(long_muscle):
    """Inverse, then plant: the identity, up to inputs held over a sample (error of order dt)."""
    plant = pam.AntagonisticJoint(
        long_muscle, link_mass=1.0, link_length=0.2, feed=pam.feeds.IdealPressure()
    )
    reference = moves([0.0, 0.4], [0.05], 0.5)
    errors = []
    for sample_time in (2e-3, 1e-3):
        how = {"sample_time": sample_time, "stiffness": 25.0}
        controller = PositionController(plant, reference, PID(0.0), **how)
        run = closed_loop(controller, plant, duration=0.7, sample_time=sample_time)
        errors.append(np.abs(run["theta"] - [reference(t)[0] for t in run.t]).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_a_pid_is_placed_where_it_says():
    pid = PID.placed(2.0, damping=0.7)
    w = 4 * np.pi
    expected = [-w, complex(-0.7 * w, w * np.sqrt(0.51)), complex(-0.7 * w, -w * np.sqrt(0.51))]
    found = np.roots([1.0, pid.kd, pid.kp, pid.ki])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_the_derivative_of_a_pid_is_filtered_by_its_filter_time():
    """Of a ramp of slope 3 sampled each 1 ms, filter 4 ms: 3 (1 - 0.8^n) after n samples."""
    pid = PID(0.0, kd=1.0, filter_time=4e-3)
    found = [pid(3e-3 * n, 1e-3) for n in range(12)]
    assert found == pytest.approx([3 * (1 - 0.8**n) for n in range(12)], rel=1e-12)


def test_a_saturated_pid_does_not_wind_up():
    pid = PID(1.0, ki=10.0)
    for _ in range(100):
        pid(1.0, 0.01, saturated=False)
    before = pid(1.0, 0.01, saturated=True)
    assert pid(1.0, 0.01, saturated=True) == before
    assert pid(-1.0, 0.01, saturated=True) < before - 2.0


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_what_is_added_to_a_pid_says_which_way_it_is_saturated(way):
    """Whatever the sign of its own output: 0.1 of integral per second of an error that may act."""
    pid = PID(1.0, ki=10.0)
    for error in (0.5, -0.5):
        acts = 0.0 if error * way > 0 else 0.1 * error
        before = pid(error, 0.01, saturated=7.0 * way)
        assert pid(error, 0.01, saturated=7.0 * way) - before == pytest.approx(acts, abs=1e-12)


def test_the_stiffness_of_a_position_controller_may_have_a_unit(slide):
    made = (
        PositionController(slide, hold(0.0), PID(1e3), sample_time=1e-3, stiffness=k)
        for k in (2.2e4, "22 N/mm")
    )
    first, second = (list(one.pressures(0.0)) for one in made)
    assert first == second


def test_a_position_controller_does_not_wind_up_however_long_it_is_out_of_reach(long_muscle):
    """A load held below its reference for 0.2 s or 4 s: once free, the same pressures follow."""
    plant = pam.HangingLoad(long_muscle, 20.0)
    after = []
    for samples in (100, 2000):
        pid = PID(2000.0, ki=4000.0)
        controller = PositionController(plant, hold(0.06), pid, sample_time=2e-3)
        at = {"v": 0.0, "muscle.pressure": 6 * BAR}
        for i in range(samples):
            held = controller(i * 2e-3, {"x": 0.0, **at})
            assert i == 0 or held["muscle.command"] == pytest.approx(6 * BAR)
        after.append(
            [controller(1.0, {"x": 0.06 + e, **at})["muscle.command"] for e in (0.01, 0.005, 0.0)]
        )
    assert after[1] == pytest.approx(after[0], rel=1e-9)
    assert after[0][0] < 5.9 * BAR


def test_a_position_controller_comes_back_where_its_model_asks_for_too_much(long_muscle):
    """The model's load needs more than the highest pressure, the true one hangs too high."""
    plant = pam.HangingLoad(long_muscle, 100.0, feed=pam.feeds.IdealPressure())
    controller = PositionController(plant, hold(0.05), PID(0.0, ki=1e4), sample_time=2e-3)
    sent = [controller(0.0, {"x": 0.06})["muscle.pressure"] for _ in range(200)]
    assert sent[0] == plant.inputs[0].max
    assert sent[-1] < 0.99 * sent[0]


def test_a_pair_that_cannot_be_as_stiff_as_wanted_still_integrates_its_position():
    feed = pam.feeds.IdealPressure()
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, feed=feed)
    pid, how = PID(0.0, ki=1e5), {"sample_time": 2e-3, "stiffness": 1e6}
    controller = PositionController(plant, hold(0.0), pid, **how)
    sent = [controller(0.0, {"x": -0.001}) for _ in range(20)]
    ends = {v.name: v.max for v in plant.inputs}
    assert any(sent[0][n] == ends[n] for n in ends)
    inverse = InverseDynamics(plant)
    a = [inverse.accelerations([0.0], [0.0], [[*u.values()]])[0] for u in sent]
    assert np.diff(a) == pytest.approx(1e5 * 0.001 * 2e-3, rel=1e-6)


def test_the_pressure_loop_closes_with_its_time_constant(hanging):
    loop = PressureLoop(hanging, time_constant=0.01)

    class Hold:
        def reset(self): ...

        def __call__(self, t, measured):
            return loop({"muscle": 3.5 * BAR}, measured)

    start = {"x": 0.06, "muscle.pressure": 3 * BAR}
    run = closed_loop(Hold(), hanging, duration=0.05, sample_time=1e-4, start=start)
    expected = 3.5 * BAR - 0.5 * BAR * np.exp(-run.t / 0.01)
    assert run["muscle.pressure"] == pytest.approx(expected, abs=0.01 * BAR)


def test_pressures_of_a_position_controller_move_the_plant_as_its_reference(slide):
    path = sine(0.0, 0.006, 2.0)
    controller = PositionController(slide, path, PID(0.0), sample_time=2e-3, stiffness=2e4)
    for t, more in ((0.07, 0.0), (0.31, 0.4)):
        x, v, a = path(t)
        assert abs(a) > 0.3
        p1, p2 = controller.pressures(t, more)
        at = {"x": x, "v": v, "muscle1.pressure": p1, "muscle2.pressure": p2}
        states, inputs = slide.vector("state", at), slide.vector("input")
        rates = np.ravel(slide.function(states, inputs, slide.vector("parameter"))[0])
        assert rates[1] == pytest.approx(a + more, abs=1e-6)


@pytest.mark.parametrize("feed", [pam.feeds.Regulator(0.05), SpoolValve(), OnOffValves()], ids=type)
def test_feed_forward_makes_the_error_a_fifth_of_the_pids_alone(long_muscle, feed):
    plant = pam.AntagonisticJoint(long_muscle, link_mass=1.0, link_length=0.2, feed=feed)
    reference = moves([0.0, 0.5], [0.1], 0.5)
    largest = {}
    for feedforward in (True, False):
        how = {"sample_time": 2e-3, "stiffness": 25.0, "inner": PressureLoop(plant, 0.01)}
        pid = PID.placed(3.0)
        controller = PositionController(plant, reference, pid, feedforward=feedforward, **how)
        first = controller.pressures(0.0)
        start = {f"muscle{i + 1}.pressure": first[i] for i in (0, 1)}
        real = {"start": start, "parameters": {"link_mass": 1.2}}
        run = closed_loop(controller, plant, duration=0.8, sample_time=2e-3, **real)
        largest[feedforward] = np.abs(run["theta"] - [reference(t)[0] for t in run.t]).max()
    assert largest[True] < largest[False] / 5
