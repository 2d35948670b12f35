"""The verdict of a plan: what its replay sees, by hand-made motions; interruption;
files that lie.
"""

import json
import os
import pickle
import re
import signal
import threading
import warnings

import numpy as np
import pytest
from conftest import pushed, refused
from searches import by_scipy

import pam_ocp as pam
from pam_ocp import Collocation, InputError, PlanWarning
from pam_ocp.core.signals import PiecewisePolynomial
from pam_ocp.core.workers import _Worker, forks
from pam_ocp.judge.statement import Statement
from pam_ocp.planning.problem.formulation import formulate
from pam_ocp.planning.replay import interval_errors, interval_states, replayed
from pam_ocp.planning.transcription.mesh import Form, Interval, Mesh
from pam_ocp.planning.transcription.solution import Solution
from pam_ocp.simulation.integrate import evaluated

MOVE = [{"x": 0.0}, {"x": 1.0}]


def cart(speed=np.inf):
    """x'' = u, nothing else; a path constraint on u + v, an output with the power u v."""

    def also(plant, x, v, u):
        plant.constraint("sum", u + v, max=20.0)
        plant.output("power", u * v)

    return pushed(10.0, also=also, x={"max": 2.0}, v={"max": speed})


def by_hand(plant, statement, pieces=((0.5, 4.0), (0.5, -4.0)), off=0.0):
    """The replay of a motion from rest whose inputs are held: (duration, value) of each interval.

    Exact states at the ends of the intervals, so only what happens between them can be wrong; but
    for the last position, which is claimed ``off``.
    """
    problem = formulate(plant, statement)
    total = sum(h for h, _ in pieces)
    intervals = [Interval(0, h / total, 1) for h, _ in pieces]
    mesh = Mesh(tuple(intervals), Form("radau", "constant"))
    t, states = [0.0], [[0.0, 0.0]]
    for h, u in pieces:
        x, v = states[-1]
        states.append([x + v * h + u * h**2 / 2, v + u * h])
        t.append(t[-1] + h)
    states[-1][0] += off
    inputs = PiecewisePolynomial(np.array(t), np.array([[[u]] for _, u in pieces]))
    solution = Solution(
        np.array(t),
        np.array(states),
        inputs,
        np.array([total]),
        np.zeros(0),
        np.ones(problem.m.numel()),
    )
    samples = evaluated(plant, solution.t, solution.states, inputs)
    return replayed(problem, plant, mesh, samples, solution)


FOURTH = tuple((0.25, u) for u in (4.0, 4.0, -4.0, -4.0))
"""x(1) = 1 with v = 2 in the middle, at rest at both ends."""


def test_a_motion_that_keeps_everything_has_no_violation():
    limits = {"v": (None, 2.0), "sum": (None, 6.0), "power": (None, 8.0)}  # touched, all of them
    replay = by_hand(
        cart(), Statement(MOVE, rest=False, bounds=limits, budgets={"effort": 16.0}), FOURTH
    )
    assert replay.error < 1e-9
    assert replay.violation < 1e-9


@pytest.mark.parametrize("off", [0.2, -0.2])
def test_a_position_that_is_claimed_too_large_or_too_small_deviates(off):
    replay = by_hand(cart(), Statement(MOVE), FOURTH, off)
    assert (replay.error, replay.state) == (pytest.approx(0.2, rel=1e-6), "x")


@pytest.mark.parametrize(
    ("statement", "label", "violation"),
    [
        # u + v = 6 just before the switch in the middle, seen from the left only
        ({"bounds": {"sum": (None, 5.0)}}, "sum", 1.0),
        ({"bounds": {"v": (None, 1.5)}}, "v", 0.5),
        ({"bounds": {"u": (None, 3.5)}}, "u", 0.5),
        ({"bounds": {"power": (None, 6.0)}}, "power", 2.0),  # u v = 8 before the switch
        (
            {"bounds": {"x": (None, pam.Profile([0.0, 1.0], [0.4, 0.4]))}},
            "x below its profile",
            0.6,
        ),
        ({"constraints": [pam.Avoid({"x": (0.5, 0.1)})]}, "forbidden region", 1.0),
        ({"budgets": {"effort": 15.0}}, "budget of effort", 1.0),  # integral of u^2 = 16
        ({"budgets": {"integral(power)": (1.0, None)}}, "budget of integral(power)", 1.0),
    ],
)
def test_a_path_that_is_violated_between_the_points_is_seen(statement, label, violation):
    replay = by_hand(cart(), Statement(MOVE, **statement), FOURTH)
    assert replay.error < 1e-9
    assert replay.constraint == label
    assert replay.violation == pytest.approx(violation, abs=2e-3)


def test_a_violation_inside_an_interval_is_seen_though_its_ends_keep_the_limit():
    """x = 2 t (1 - t) on one interval: 0 at both ends, 0.5 in the middle."""
    plant = pam.Plant("thrown")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s", start=2.0)
    u = plant.input("u", min=-10.0, max=10.0)
    plant.der(x, v)
    plant.der(v, u)
    plant.constraint("height", 2 * x, max=0.6)
    stops = [{"x": 0.0, "v": 2.0}, {"x": 0.0, "v": -2.0}]
    problem = formulate(plant, Statement(stops, rest=False))
    t, states = np.array([0.0, 1.0]), np.array([[0.0, 2.0], [0.0, -2.0]])
    inputs = PiecewisePolynomial(t, np.full((1, 1, 1), -4.0))
    solution = Solution(t, states, inputs, np.array([1.0]), np.zeros(0), np.zeros(0))
    samples = evaluated(plant, t, states, inputs)
    for form, degree in ((Form("radau", "constant"), 1), (Form("shooting", "constant"), 4)):
        mesh = Mesh((Interval(0, 1.0, degree),), form)
        replay = replayed(problem, plant, mesh, samples, solution)
        assert replay.error < 1e-9
        assert replay.constraint == "height"
        assert replay.violation == pytest.approx(0.4, abs=1e-3)
        assert replay.beyond[0] == {"height": replay.violation}


@pytest.mark.parametrize(
    ("stops", "statement", "label", "violation"),
    [
        ([{"x": 0.0}, {"x": 1.3}], {}, "stop 2: x", 0.3),
        ([{"x": 0.0}, {"x": 1.0, "v": 0.25}], {}, "stop 2: v", 0.25),
        ([{"x": 0.0}, {"x": 1.0, "u": -3.5}], {}, "stop 2: u", 0.5),
        ([{"x": 0.0, "der(v)": 0.0}, {"x": 1.0}], {}, "stop 1: der(v)", 0.4),  # 4 of 10 nominals
    ],
)
def test_a_stop_that_is_missed_by_the_motion_is_seen(stops, statement, label, violation):
    replay = by_hand(cart(), Statement(stops, **{"rest": False, **statement}))
    assert replay.violation == pytest.approx(violation, abs=1e-6)
    assert replay.constraint == label
    assert replay.missed == replay.violation


def test_a_cycle_that_is_open_is_seen():
    replay = by_hand(cart(), Statement(MOVE, rest=False, cyclic=True), ((0.5, 4.0), (0.5, -4.0)))
    assert replay.constraint == "closing of the cycle: x"
    assert replay.violation == pytest.approx(1.0, abs=1e-9)


def test_the_objective_of_a_replay_is_that_of_the_motion():
    """u = +-4 for half a second each: effort 16, power integral 0, jump 8 over 0.5 s."""
    statement = Statement(
        MOVE, minimise={"time": 2.0, "effort": 0.5, "rate": 0.25, "final(x)": 3.0}
    )
    assert by_hand(cart(), statement).objective == pytest.approx(
        2 + 8 + 0.25 * 64 / 0.5 + 3, rel=1e-9
    )


def along(plant, wish, t, states, coefficients, form, degree):
    """The replay of a motion on one interval, its input a polynomial in t."""
    problem = formulate(plant, wish)
    mesh = Mesh((Interval(0, 1.0, degree),), form)
    inputs = PiecewisePolynomial(t[[0, -1]], np.array(coefficients).reshape(1, -1, 1))
    solution = Solution(t, states, inputs, t[-1:], np.zeros(0), np.ones(problem.m.numel()))
    samples = evaluated(plant, t, states, inputs)
    return replayed(problem, plant, mesh, samples, solution), mesh, solution


def test_the_rate_of_a_polynomial_input_is_the_integral_of_its_squared_slope():
    """u = 6 t^2 + 2 t^3 over 0.8 s: u' = 12 t + 6 t^2; x = t^4/2 + t^5/10, v = 2 t^3 + t^4/2."""
    form, end = Form("radau", "polynomial"), 0.8
    t = np.concatenate([[0.0], end * np.asarray(form.state_taus(4))])
    states = np.column_stack([t**4 / 2 + t**5 / 10, 2 * t**3 + t**4 / 2])
    stops = [{"x": 0.0}, {"x": states[-1, 0]}]
    wish = Statement(stops, rest=False, duration=end, minimise={"rate": 0.5})
    replay, *_ = along(cart(), wish, t, states, [0, 0, 6.0, 2.0], form, 4)
    expected = 144 * end**3 / 3 + 144 * end**4 / 4 + 36 * end**5 / 5
    assert replay.error < 1e-9
    assert replay.objective == pytest.approx(0.5 * expected, rel=1e-9)


@pytest.mark.slow
def test_a_motion_that_runs_away_is_no_plan():
    """x' = x^2 from 1 ends at 1 s in infinity; a line was planned, for 2 s."""
    plant = pam.Plant("runaway")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, x**2 + u)
    t = np.array([0.0, 2.0])
    wish = Statement([{"x": 1.0}, {"x": 3.0}], rest=False)
    form = Form("radau", "constant")
    replay, mesh, solution = along(plant, wish, t, np.array([[1.0], [3.0]]), [0.0], form, 1)
    assert (replay.error, replay.violation) == (np.inf, np.inf)
    (stopped,) = re.findall(r"the replay stops at t = ([\d.]+) s", replay.state)
    assert 0.7 < float(stopped) <= 1.0
    assert replay.constraint == "everything behind"
    run = interval_states(plant, mesh, solution)
    assert interval_errors(plant, solution, run) == [np.inf]


# ---- the verdict of a plan
# ------------------------------------------------------------------------
def falling(rate):
    """x'' = rate^2 x + u: errors grow by exp(rate t)."""
    plant = pam.Plant("falling")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    u = plant.input("u", min=-1e3, max=1e3, nominal=10.0)
    plant.der(x, v)
    plant.der(v, rate**2 * x + u)
    return plant


ROUGH = {
    "duration": 1.0,
    "rest": False,
    "minimise": "effort",
    "method": Collocation(3, 1, "linear"),
}


def test_what_is_not_verified_says_so_first_of_all():
    with pytest.warns(
        PlanWarning, match=r"the plan of falling is not verified: its replay deviates"
    ):
        plan = pam.plan(falling(5.0), [{"x": 0.0}, {"x": 0.05}], **ROUGH, tolerance=None)
    assert plan.solved
    assert not plan.verified
    assert not plan.success
    assert not plan.verdict
    assert str(plan).startswith("NOT VERIFIED: its replay deviates by")
    assert f"{plan.replay_error:.2g} (scaled by nominal values) in" in str(plan.verdict)
    assert plan.trajectory["x"][-1] == pytest.approx(0.05)
    assert plan.verdict.tolerance == 1e-3


def test_by_default_the_mesh_is_refined_until_the_plan_is_verified(recwarn):
    plan = pam.plan(falling(5.0), [{"x": 0.0}, {"x": 0.05}], **ROUGH)
    assert plan.verified
    assert plan.replay_error <= 1e-3
    assert len(plan.meshes) > 1
    assert not [w for w in recwarn if w.category is PlanWarning]
    assert str(plan).startswith("verified")


def test_a_verdict_tells_an_unstable_motion_from_a_mesh_that_is_too_coarse():
    """Errors of x'' = 25 x + u grow by (1 + 5) exp(5 t) at most."""
    asked = ROUGH | {"method": Collocation(20, 5, "linear"), "duration": 4.0}
    with pytest.warns(PlanWarning, match=r"the motion is unstable: .* with feedback"):
        plan = pam.plan(falling(5.0), [{"x": 0.05, "v": 0.0}] * 2, **asked, tolerance=None)
    assert plan.verdict.unstable
    assert 1e3 < plan.verdict.growth < 6 * np.exp(20.0)
    with pytest.warns(PlanWarning):
        coarse = pam.plan(falling(5.0), [{"x": 0.0}, {"x": 0.05}], **ROUGH, tolerance=None)
    assert not coarse.verdict.unstable
    assert "unstable" not in str(coarse.verdict)


@pytest.mark.parametrize("points", ["radau", "gauss"])
def test_a_bound_on_a_state_holds_between_the_points_too(points):
    """Bryson and Denham's limit, which a coarse mesh keeps at its points only."""
    asked = {"duration": 1.0, "minimise": "effort", "rest": False, "bounds": {"x": (None, 1 / 9)}}
    stops = [{"x": 0.0, "v": 1.0}, {"x": 0.0, "v": -1.0}]
    method = Collocation(4, 3, "linear", points)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlanWarning)
        rough = pam.plan(cart(), stops, **asked, method=method, tolerance=None)
    assert rough.replay_error < 1e-6
    assert rough.replay.violation > 5e-4
    assert rough.replay.constraint == "x"
    plan = pam.plan(cart(), stops, **asked, method=method, tolerance=1e-5)
    assert plan.verified
    assert plan.replay.trajectory["x"].max() <= 1 / 9 + 1e-5


@pytest.mark.slow
def test_a_joint_of_set_pressures_with_hysteresis_is_planned_without_wandering_off():
    """Wide roundings of Bouc-Wen's speed would lead z along the root of the rate; SciPy replays."""
    muscle, loss = pam.muscle("DMSP-20-400N"), pam.losses.BoucWen(6.0, 0.0084)
    feed = pam.feeds.IdealPressure()
    plant = pam.AntagonisticJoint(muscle, 0.16, 0.037, feed=feed, losses=(loss,))
    stops = [{"theta": -0.43}, {"theta": 0.5}]
    plan = pam.plan(plant, stops, duration=2.0, minimise="effort")
    assert plan.verified
    end, names = by_scipy(plan)[-1], [v.name for v in plant.states]
    nominal = plant.vector("state", attribute="nominal")
    assert end == pytest.approx(plan.trajectory.array(names)[-1] / nominal, abs=1e-3)
    assert end[names.index("theta")] * nominal[0] == pytest.approx(0.5, abs=1e-3)


def test_polynomial_inputs_end_verified_too(recwarn):
    stops = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]
    plan = pam.plan(cart(), stops, rest=False, method=Collocation(5, 8, "polynomial"))
    assert plan.verified
    t = np.linspace(0, plan.duration, 20001)
    u = plan.trajectory.signals(t)[:, 0]
    assert np.max(np.abs(u)) <= 10.0 + 1e-3
    assert plan.duration == pytest.approx(2 * np.sqrt(1 / 10), rel=1e-2)


# ---- Ctrl-C --------------------------------------------------------------------------------------
def test_ctrl_c_ends_a_solve_and_nothing_is_tried_after_it(slide, monkeypatch):
    from pam_ocp.planning import search

    def never(*_):
        raise AssertionError("a diagnosis after Ctrl-C")

    monkeypatch.setattr(search, "elastic", never)
    seen = []

    def press(iteration, objective, violation):
        seen.append(iteration)
        if iteration == 4:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], progress=press)
    assert seen == [0, 1, 2, 3, 4]
    assert signal.getsignal(signal.SIGINT) is before
    assert pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], method=Collocation(10)).solved


def test_what_a_progress_function_raises_ends_the_solve_and_comes_out(slide):
    def fails(iteration, objective, violation):
        raise OSError("no terminal")

    with pytest.raises(OSError, match="no terminal"):
        pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], progress=fails)


def test_a_solve_in_another_thread_leaves_the_signal_alone(slide):
    found = []
    before = signal.getsignal(signal.SIGINT)
    work = threading.Thread(
        target=lambda: found.append(
            pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], method=Collocation(10))
        )
    )
    work.start()
    work.join()
    assert found[0].verified
    assert signal.getsignal(signal.SIGINT) is before


# ---- files ---------------------------------------------------------------------------------------
EVERYTHING = {
    "minimise": {"time": 1.0, "effort": 1e-3, "peak(power)": 1e-3},
    "duration": (0.2, 3.0),
    "constraints": [pam.Avoid({"x": (1.5, 0.3)}, name="wall")],
    "bounds": {"v": (None, pam.Profile([0.0, 0.5, 3.0], [3.0, 2.0, 2.0]))},
    "budgets": {"effort": 200.0},
    "method": Collocation(12, 4, "linear"),
}


@pytest.fixture(scope="module")
def moved():
    return pam.plan(cart(), MOVE, **EVERYTHING)


def test_a_loaded_plan_is_judged_as_the_one_that_was_saved(moved, tmp_path):
    again = pam.load_plan(moved.save(tmp_path / "plan.npz"), cart())
    assert again.verified
    assert again.objective == pytest.approx(moved.objective, rel=1e-9)
    assert again.replay_error == pytest.approx(moved.replay_error, rel=1e-3, abs=1e-12)
    assert again.replay.violation == pytest.approx(moved.replay.violation, rel=1e-3, abs=1e-9)
    assert again.durations == moved.durations
    copy = pickle.loads(pickle.dumps(moved))
    assert str(copy.verdict) == str(moved.verdict)
    assert pam.load_plan(copy.save(tmp_path / "copy.npz"), cart()).objective == again.objective


def changed(path, meta=None, **arrays):
    """The file with some of its arrays and meta data replaced by functions of what they were."""
    with np.load(path) as file:
        held = {name: file[name] for name in file.files}
    said = json.loads(str(held["meta"]))
    if meta is not None:
        meta(said)
    held["meta"] = np.array(json.dumps(said))
    for name, change in arrays.items():
        held[name] = change(held[name])
    np.savez_compressed(path, **held)
    return path


def shorter(said):
    said["durations"] = [0.9 * d for d in said["durations"]]


def cheaper(said):
    said["objective"] *= 0.99


def elsewhere(said):
    said["statement"]["stops"][-1]["values"]["x"] = 1.001


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ({"states": lambda x: x + np.array([1.0, 0.0])}, "does not keep"),
        ({"states": lambda x: x * 1.01}, "do not follow from its inputs"),
        ({"coefficients": lambda c: 1.02 * c}, "do not follow from its inputs"),
        ({"states": lambda x: x[:-1]}, "its states have the shape"),
        ({"states": lambda x: np.where(x > 0.9, np.nan, x)}, "not a finite number"),
        ({"t": lambda t: 1.1 * t}, "its times are not those of its durations"),
        ({"meta": shorter}, "its times are not those of its durations"),
        ({"meta": cheaper}, "its objective is"),
        ({"meta": elsewhere}, "stop 2: x"),
        ({"meta": lambda said: said.update(format="pam_ocp plan 1")}, "by a former version"),
        ({"meta": lambda said: said.pop("statement")}, "cannot be read as a plan file"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(moved, tmp_path, what, message):
    path = changed(moved.save(tmp_path / "plan.npz"), **what)
    refused(message, pam.load_plan, path, cart())


def test_a_plan_of_a_plant_that_moves_otherwise_is_refused(moved, tmp_path):
    other = pam.Plant("cart")
    x, v = other.state("x", unit="m", max=2.0), other.state("v", unit="m/s")
    u = other.input("u", unit="m/s2", min=-10.0, max=10.0)
    other.der(x, v)
    other.der(v, 0.9 * u)
    other.constraint("sum", u + v, max=20.0)
    other.output("power", u * v)
    with pytest.raises(InputError, match="do not follow from its inputs"):
        pam.load_plan(moved.save(tmp_path / "plan.npz"), other)


def test_an_unverified_plan_is_unverified_from_a_file_too(tmp_path):
    with pytest.warns(PlanWarning):
        plan = pam.plan(falling(5.0), [{"x": 0.0}, {"x": 0.05}], **ROUGH, tolerance=None)
    path = plan.save(tmp_path / "plan.npz")
    with pytest.warns(PlanWarning, match="not verified"):
        again = pam.load_plan(path, falling(5.0))
    assert not again.verified
    assert again.replay_error == pytest.approx(plan.replay_error, rel=1e-6)


# ---- several starts
# -----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def by_valve():
    return pam.HangingLoad(pam.muscle("DMSP-20-400N"), 20.0, feed=pam.feeds.SpoolValve())


UP = {"stops": [{"x": 0.02}, {"x": 0.04}], "method": Collocation(10, 3)}


@pytest.fixture
def two_processors(monkeypatch):
    """Starts are solved by two workers, however little work they are; the processes begun."""
    monkeypatch.setattr("pam_ocp.core.cases.PAYS", 0.0)
    monkeypatch.setattr("pam_ocp.core.workers.processors", lambda: 2)
    begun, started = [], _Worker.started.__func__

    def noted(kind, errand):
        begun.append(started(kind, errand))
        return begun[-1]

    monkeypatch.setattr(_Worker, "started", classmethod(noted))
    return begun


def ended(workers):
    return all(worker.process.exitcode is not None for worker in workers)


@pytest.mark.slow
@pytest.mark.skipif(not forks(), reason="workers are forks")
def test_starts_in_processes_end_where_they_end_in_this_one(by_valve, two_processors):
    beside = pam.plan(by_valve, **UP, starts=4)
    assert two_processors
    assert ended(two_processors)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pam_ocp.core.cases.PAYS", np.inf)
        alone = pam.plan(by_valve, **UP, starts=4)
    assert len(alone.statistics["starts"]) == len(beside.statistics["starts"]) == 4
    for one, two in zip(alone.statistics["starts"], beside.statistics["starts"], strict=True):
        assert one == {**two, "objective": pytest.approx(two["objective"], rel=1e-6)}
    stages = ("name", "start", "status", "iterations")
    each = [[tuple(s[n] for n in stages) for s in p.statistics["stages"]] for p in (alone, beside)]
    assert sorted(each[0]) == sorted(each[1])
    assert "starts     4, of which" in str(beside)


def test_several_starts_are_for_valves_and_tendons_only():
    from pam_ocp.planning.starts import number_of_starts

    muscle = pam.muscle("DMSP-20-400N")
    several = [
        pam.HangingLoad(muscle, 10.0, feed=pam.feeds.OnOffValves()),
        pam.AntagonisticSlide(muscle, 5.0, feed=pam.feeds.SpoolValve(tube=pam.feeds.Tube())),
        pam.SeriesLoad(muscle, 10.0),
    ]
    one = [
        pam.HangingLoad(muscle, 10.0, losses=[pam.losses.BoucWen()]),
        pam.AntagonisticSlide(muscle, 5.0, feed=pam.feeds.Regulator(0.05, max_rate=4e6)),
        pam.HangingLoad(muscle, 10.0, feed=pam.feeds.Regulator(0.05, venting_lag=0.1)),
        pam.SpringOverMuscle(muscle, 1.0, 1e3, 50.0),
        cart(),
    ]
    assert [number_of_starts(plant) for plant in several] == [4, 4, 4]
    assert [number_of_starts(plant) for plant in one] == [1] * 5


@pytest.mark.skipif(not forks(), reason="workers are forks")
def test_ctrl_c_among_several_starts_leaves_no_process_behind(
    by_valve, two_processors, monkeypatch
):
    handing = _Worker.begin

    def press(worker, task):
        if len(two_processors) == 2:
            threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        return handing(worker, task)

    monkeypatch.setattr(_Worker, "begin", press)
    with pytest.raises(KeyboardInterrupt):
        pam.plan(by_valve, UP["stops"], method=Collocation(40, 4), starts=8)
    assert len(two_processors) == 2
    assert ended(two_processors)
