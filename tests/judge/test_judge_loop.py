"""What a closed loop did, judged from its signals alone: signals written by hand."""

from __future__ import annotations

import re

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.core.variables import Variable
from pam_ocp.judge.loop import LoopVerdict, judge_loop

T = np.linspace(0.0, 1.0, 101)
X = Variable("x", "state", unit="m", nominal=0.01, min=-0.05, max=0.05)
U = Variable("u", "input", unit="V", min=-1.0, max=1.0)


def signals(x, u=None) -> pam.Trajectory:
    columns = {"x": np.broadcast_to(x, T.shape), "u": np.sin(T) if u is None else u}
    return pam.Trajectory(T, {n: np.broadcast_to(v, T.shape) for n, v in columns.items()}, [X, U])


def goal(x) -> pam.Trajectory:
    return pam.Trajectory(T, {"x": np.broadcast_to(x, T.shape)}, [X])


def test_a_set_point_is_reached_within_a_hundredth_of_the_stroke():
    arrived = 0.02 * (1 - np.exp(-T / 0.1))
    assert judge_loop(signals(arrived), wanted=goal(0.02), inputs=["u"])
    # e^(-0.9/0.25) = 2.73 % of the stroke at the beginning of the last tenth
    late = judge_loop(signals(0.02 * (1 - np.exp(-T / 0.25))), wanted=goal(0.02), inputs=["u"])
    assert not late
    assert late.missed == {"x": pytest.approx(np.exp(-0.9 / 0.25), rel=1e-6)}
    assert "x ends 0.546 mm from its set point 20 mm" in str(late)


def test_how_a_set_point_is_missed_is_said():
    """e^(-t/0.25) falls to e^-2 over the second half; 5 Hz over 0.5 s pass their middle 5 times."""
    slow = judge_loop(signals(0.02 * (1 - np.exp(-T / 0.25))), wanted=goal(0.02), inputs=["u"])
    assert "(2.73 % of the stroke), still on its way" in str(slow)
    swings = judge_loop(
        signals(0.02 * np.minimum(10 * T, 1) + 2e-3 * np.sin(10 * np.pi * T)),
        wanted=goal(0.02),
        inputs=["u"],
    )
    told = re.search(r"swinging by 2 mm at ([0-9.]+) Hz", str(swings))
    assert told
    assert float(told[1]) == pytest.approx(5.0, rel=0.05)
    assert "dead zone" not in str(swings)
    run = signals(0.02 * np.minimum(10 * T, 1) + 2e-3 * np.sin(10 * np.pi * T))
    crossed = judge_loop(run, wanted=goal(0.02), inputs=["u"], behind=["u"])
    assert "the dead zone of u is crossed behind a part that moves" in str(crossed)
    beside = judge_loop(signals(0.015 * np.minimum(10 * T, 1)), wanted=goal(0.02), inputs=["u"])
    assert str(beside).endswith("(25 % of the stroke)")


def test_along_a_motion_nothing_is_a_set_point():
    assert judge_loop(signals(0.0), wanted=goal(0.02 * np.sin(9 * T)), inputs=["u"]).missed == {}


def test_what_is_to_stay_is_measured_by_its_nominal():
    """2 parts in a thousand of nominal are allowed, whatever the way was."""
    held = signals(0.01 + 1.9e-5 * np.sin(50 * T))
    assert judge_loop(held, wanted=goal(0.01), inputs=["u"])
    left = judge_loop(signals(3e-5), wanted=goal(5.2e-31), inputs=["u"])
    assert left.missed == {"x": pytest.approx(3e-5 / 2e-3)}
    assert "x ends 0.03 mm from its set point 0 mm (0.3 % of its nominal 10 mm)" in str(left)


def test_noise_that_the_controller_sees_is_nobodys_fault():
    run = signals(0.02 * (1 - np.exp(-T / 0.1)) + 3e-4)
    assert not judge_loop(run, wanted=goal(0.02), inputs=["u"])
    assert judge_loop(run, wanted=goal(0.02), inputs=["u"], noise={"x": 1e-4})


@pytest.mark.parametrize(
    ("size", "limits", "by"),
    [
        (0.055, {}, 0.005),
        (-0.055, {}, 0.005),
        (0.055, {"x": (-1.0, 0.03)}, 0.025),
        (-0.055, {"x": (-0.03, 1.0)}, 0.025),
        (0.05009, {}, 0.0),  # a hundredth of nominal is 0.1 mm
        (0.05011, {}, 0.00011),
    ],
)
def test_limits_are_those_of_the_variable_and_those_given(size, limits, by):
    run = signals(size * np.sin(np.pi * T), 3.0)  # the input acts within its range, whatever it is
    verdict = judge_loop(run, inputs=["u"], limits=limits)
    assert verdict.broken == ({"x": pytest.approx(by, rel=1e-6)} if by else {})
    assert ("limits kept" in verdict.kept) == (not by)
    assert not by or f"x leaves its range by {1e3 * by:.3g} mm" in str(verdict)


def test_the_stroke_is_the_whole_way_of_what_was_wanted():
    """From -20 mm to 20 mm, from the middle: 0.3 mm are less than a hundredth of 40 mm."""
    wanted = goal(np.where(T < 0.5, -0.02, 0.02))
    run = signals(np.where(T < 0.5, 0.0, 0.0203))
    assert judge_loop(run, wanted=wanted, inputs=["u"])
    off = judge_loop(signals(np.where(T < 0.5, 0.0, 0.0205)), wanted=wanted, inputs=["u"])
    assert off.missed == {"x": pytest.approx(0.0125)}


@pytest.mark.parametrize(
    ("left", "failed", "fine"), [(0, 0, True), (20, 0, True), (21, 0, False), (0, 1, False)]
)
def test_a_fifth_of_the_solves_may_be_unfinished_and_none_may_fail(left, failed, fine):
    calls = {"all": 100, "unconverged": left, "failed": failed}
    verdict = judge_loop(signals(0.0), inputs=["u"], calls=calls)
    assert bool(verdict) is fine
    assert verdict.unconverged == (left + failed) / 100


@pytest.mark.parametrize(
    ("step", "noise", "share"),
    [(1, 0.0, 0.3), (2, 0.0, 0.3), (1, 1e-5, 0.15), (1, 2.2e-5, 0.0), (1, 7e-5, None)],
)
def test_predictions_are_measured_by_the_changes_over_a_sample(step, noise, share):
    """Each is 30 % of its change beside it: 60 um of 200 um, of which noise excuses three times."""
    x = 0.02 * T
    told = x[step::step] + 0.3 * 0.02 * 0.01 * step
    told[3] = np.nan  # that one was not told
    arguments = {"sample_time": 0.01 * step, "noise": {"x": noise}, "inputs": ["u"]}
    verdict = judge_loop(signals(x), predicted={"x": told, "u": [np.nan]}, **arguments)
    assert verdict.prediction == (None if share is None else pytest.approx(share, abs=1e-9))
    assert bool(verdict) == (share != 0.3)
    if share == 0.3:
        assert str(verdict) == (
            "not as asked: predictions of x over one sample miss 30 % of its changes"
        )
    if share == 0.15:
        assert "predictions of x miss 15.0 % of its changes" in str(verdict)


def test_of_several_predictions_the_worst_is_told():
    x, u = 0.02 * T, 0.5 * T
    near = {"x": x[1:] + 0.2 * 0.02 * 0.01, "u": u[1:] + 0.1 * 0.5 * 0.01}
    verdict = judge_loop(signals(x, u), inputs=["u"], predicted=near, sample_time=0.01)
    assert verdict.prediction == pytest.approx(0.2)


def test_at_rest_predictions_tell_nothing():
    verdict = judge_loop(
        signals(0.01), inputs=["u"], predicted={"x": np.full(100, 0.01 + 1e-9)}, sample_time=0.01
    )
    assert verdict.prediction is None
    assert verdict


@pytest.mark.parametrize(
    ("u", "x", "known", "idle", "words"),
    [
        (0.0, 0.0, (), ("u",), "u had no influence on x"),
        (0.0, 0.01 * T, (), ("u",), "u had no influence on x"),
        (1.0, 0.0, (), ("u",), "u stood at an end of the range all the time"),
        (-1.0, 0.0, (), ("u",), "u stood at an end of the range all the time"),
        (np.sin(20 * T), 0.0, (), ("u",), "u had no influence on x"),
        (np.sin(20 * T), 0.01 * T, ("u",), ("u",), "u had no influence on x"),
        (np.sin(20 * T), 0.01 * T, (), (), "(55 % of the stroke)"),
        (np.where(T < 0.76, 1.0, 0.0), 0.01 * T, (), (), "u is at its limits 51 % of the time"),
        (np.where(T < 0.74, -1.0, 0.0), 0.01 * T, (), (), "(55 % of the stroke)"),
    ],
)
def test_an_input_that_does_nothing_is_named_where_something_was_missed(u, x, known, idle, words):
    verdict = judge_loop(signals(x, u), wanted=goal(0.02), inputs=["u"], idle=known)
    assert verdict.idle == idle
    assert str(verdict).endswith(words)
    assert judge_loop(signals(0.02, u), wanted=goal(0.02), inputs=["u"], idle=known)


def test_an_input_at_its_limits_says_why_a_set_point_was_missed():
    swinging = signals(0.02 + 0.01 * np.sin(30 * T), np.sign(np.sin(30 * T)))
    told = str(judge_loop(swinging, wanted=goal(0.02), inputs=["u"]))
    assert "u is at its limits 100 % of the time" in told


def test_a_verdict_without_faults_says_what_was_looked_at():
    assert str(LoopVerdict()) == "as asked: nothing was to be reached or kept"
    run = signals(0.02 * (1 - np.exp(-T / 0.1)))
    assert str(judge_loop(run, wanted=goal(0.02), inputs=["u"])) == (
        "as asked: x within 1 % of the stroke; limits kept"
    )
