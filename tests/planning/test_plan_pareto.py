"""pareto: the front of two objectives against known optima."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from conftest import pushed, refused

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.planning.studies.front import pareto

METHOD = Collocation(6, 6, "polynomial")
LIMIT, DISTANCE = 100.0, 1.0


STOPS = [{"x": 0.0, "v": 0.0}, {"x": DISTANCE, "v": 0.0}]


@pytest.mark.parametrize(("first", "second"), [("time", "effort"), ("effort", "time")])
def test_time_against_effort_of_the_double_integrator(first, second):
    """E = 12 d^2/T^3 while u = 6 d/T^2 (1 - 2 t/T) keeps its limit; bang-bang at its end, u^2 T."""
    limits = {} if first == "time" else {"duration": (0.05, 0.6)}
    asked = {"first": first, "second": second, "rest": False, "method": METHOD, "points": 9}
    asked["budgets"] = {"square(v)": 1e3}  # one of the user's own, far away
    front = pareto(pushed(LIMIT), STOPS, **asked, **limits)
    assert not front.failures
    time, effort = front.values.T if first == "time" else front.values.T[::-1]
    quickest = 2 * np.sqrt(DISTANCE / LIMIT)
    ends = [(quickest, LIMIT**2 * quickest), (0.6, 12 * DISTANCE**2 / 0.6**3)]
    for at, (t, e) in zip((0, -1), ends if first == "time" else ends[::-1], strict=True):
        assert (time[at], effort[at]) == (pytest.approx(t, rel=1e-5), pytest.approx(e, rel=1e-4))
    free = time > np.sqrt(6 * DISTANCE / LIMIT)
    assert free.sum() > 5
    assert effort[free] * time[free] ** 3 == pytest.approx(12 * DISTANCE**2, rel=1e-6)
    assert np.all(effort[~free] * time[~free] ** 3 > 12 * DISTANCE**2)
    frame = front.to_pandas()  # the table is the front itself
    assert frame.iloc[:, :2].to_numpy() == pytest.approx(front.values)
    assert [head.partition(" [")[0] for head in frame.columns[:2]] == [first, second]
    assert list(np.flatnonzero(frame["knee"])) == [front.knee]
    assert np.all(np.diff(front.values[:, 0]) > 0)
    assert np.all(np.diff(front.values[:, 1]) < 0)


def test_points_planned_side_by_side_are_the_front_and_the_same_bits_everywhere():
    """E = 12 d^2/T^3 between the ends, in this process and in two others."""
    asked = {"rest": False, "method": METHOD, "points": 5, "until": 0.6}
    here, there = (pareto(pushed(LIMIT), STOPS, executor=where, **asked) for where in (0, 2))
    assert not here.failures
    assert len(here) == 5
    assert np.array_equal(here.values, there.values)
    for one, other in zip(here.plans, there.plans, strict=True):
        assert np.array_equal(one.trajectory["x"], other.trajectory["x"])
    time, effort = here.values.T
    free = time > np.sqrt(6 * DISTANCE / LIMIT)
    assert free.sum() >= 3
    assert effort[free] * time[free] ** 3 == pytest.approx(12 * DISTANCE**2, rel=1e-6)


def test_rate_is_swept_as_the_second():
    """The least of the integral of u'^2 from rest to rest with u = 0 at the ends: 720 d^2/T^5."""
    asked = {"second": "rate", "points": 4, "until": 1.0, "method": METHOD}
    front = pareto(pushed(LIMIT), [{"x": 0.0}, {"x": DISTANCE}], **asked)
    time, rate = front.values.T
    assert time[-1] == pytest.approx(1.0)
    assert rate[-2:] * time[-2:] ** 5 == pytest.approx(720 * DISTANCE**2, rel=1e-5)
    assert rate[0] > 720 / time[0] ** 5


@pytest.mark.slow
def test_time_against_the_largest_force(slide):
    """Each point is the plan of least time under that force: solved alone, it is the same."""
    stops, method = [{"x": -0.01}, {"x": 0.01}], Collocation(15)
    front = pareto(
        slide, stops, first="peak(muscle1.force)", second="time", points=4, method=method
    )
    assert front.first.unit == "N"
    for plan, (force, time) in zip(front.plans[1:], front.values[1:], strict=True):
        assert np.max(plan.trajectory["muscle1.force"]) == pytest.approx(force)
        bounds = {"muscle1.force": (None, force * (1 + 1e-7))}
        alone = pam.plan(slide, stops, bounds=bounds, method=method)
        assert time == pytest.approx(alone.duration, rel=1e-5)
    assert str(front).count("\n") == len(front)
    assert "knee" in str(front).splitlines()[1 + front.knee]


def test_a_users_own_budget_stays(slide):
    """The sweep's bound never loosens what the user asks for."""
    stops, method = [{"x": -0.01}, {"x": 0.01}], Collocation(10)
    budgets = {"effort": 1.5, "time": 0.06}
    front = pareto(slide, stops, budgets=budgets, until=1.0, points=3, method=method)
    assert front.values[:, 0].max() <= 0.06 + 1e-7
    assert front.values[:, 1].max() <= 1.5 + 1e-7


@pytest.mark.slow
def test_work_that_is_not_minimised_is_that_of_the_motion(slide):
    """At the end of the least time: the integral of max(power, 0) over an integration."""
    asked = {"second": "work", "points": 2, "until": "80 ms", "method": Collocation(6)}
    front = pareto(slide, [{"x": -0.01}, {"x": 0.01}], **asked)
    for plan, (_, work) in zip(front.plans, front.values, strict=True):
        t = np.linspace(0.0, plan.duration, 4001)
        run = pam.simulate(slide, plan.trajectory, t=t)
        powers = (np.maximum(run[f"muscle{i}.power"], 0.0) for i in (1, 2))
        assert work == pytest.approx(sum(np.trapezoid(p, t) for p in powers), rel=1e-3)


def test_a_plan_that_another_is_no_worse_than_is_not_on_the_front():
    """All end at x = 1: the quickest is best. Bounds of a peak in units are kept, without a word
    about how far away none is."""
    asked = {"rest": False, "method": Collocation(2, 3), "points": 2, "until": "0.6 s"}
    front = pareto(pushed(LIMIT), STOPS, second="final(x)", **asked)
    assert len(front) == 1
    assert front.plans[0].duration == pytest.approx(2 * np.sqrt(DISTANCE / LIMIT), rel=1e-5)
    assert all("no worse in either" in words for _, words in front.failures)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        held = {**asked, "method": Collocation(8, 3)}
        bounds = {"v": ("-1 m/s", "800 cm/s")}
        slower = pareto(pushed(LIMIT), STOPS, second="peak(v)", bounds=bounds, **held)
    time, peak = slower.values.T
    assert peak[0] == pytest.approx(8.0, rel=1e-3)
    assert time[0] == pytest.approx(DISTANCE / 8.0 + 8.0 / LIMIT, rel=5e-3)
    assert time[1] == pytest.approx(0.6, rel=1e-6)
    assert 30 - np.sqrt(800.0) <= peak[1] < 2.0  # d/v + v/a = T, for inputs that are not held


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": 1}, "points = 1"),
        ({"first": "rate"}, "exchange first and second"),
        ({"first": "hurry"}, "unknown objective 'hurry'"),
        ({"minimise": "time"}, "minimise is not an argument"),
        ({"tolerance": 1e-6}, "tolerance is not an argument"),
        ({"until": 0.01}, "is not more than the least of time"),
        ({"second": "peak(force)"}, "unknown variable"),
        ({"executor": "two"}, "executor is a str"),
    ],
)
def test_what_cannot_be_swept_is_refused(slide, arguments, message):
    stops = [{"x": -0.01}, {"x": 0.01}]
    refused(message, pareto, slide, stops, **{"method": Collocation(10), **arguments})


def test_a_budget_of_time_ends_a_motion_of_least_effort():
    asked = {"rest": False, "minimise": "effort", "budgets": {"time": 0.8}, "method": METHOD}
    plan = pam.plan(pushed(LIMIT), [STOPS[0], {"x": 0.4}, STOPS[1]], **asked)
    assert sum(plan.durations) == pytest.approx(0.8, rel=1e-7)
    assert plan.objective == pytest.approx(12 / 0.8**3, rel=1e-6)  # passing 0.4 costs nothing


def test_plans_of_a_front_that_are_not_verified_are_marked(slide):
    stops = [{"x": -0.01}, {"x": 0.01}]
    front = pam.pareto(slide, stops, points=3, method=pam.Collocation(10, 3))
    assert front.unverified == ()
    assert "NOT VERIFIED" not in str(front)
    off = replace(front.plans[1].judgement, error=0.5, state="v")
    first, second, third = front.plans
    wrong = replace(front, plans=(first, replace(second, judgement=off), third))
    assert wrong.unverified == (1,)
    lines = str(wrong).splitlines()
    assert lines[0].startswith("NOT VERIFIED: 1 of 3 plans")
    assert "deviates by 0.5 (scaled by nominal values) in v" in lines[3]
    (axes,) = wrong.plot().axes
    (cross,) = (line for line in axes.lines if line.get_marker() == "x")
    assert len(cross.get_xdata()) == 1
