"""Model predictive control: the known optimum, bounds, warm start, delay, fallback,
closed loops.
"""

import numpy as np
import pytest
from conftest import benchmark_slide, refused, scipy_states
from mpc_cases import COMMANDS, exact, mass, slide_mpc

import pam_ocp as pam
from pam_ocp.control import mpc_statistics
from pam_ocp.control.estimators.extended_kalman import KalmanFilter
from pam_ocp.control.loop import closed_loop
from pam_ocp.control.mpc import sqp
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.control.mpc.stage_qp import StageQp
from pam_ocp.core.errors import UnknownNameError

SOLVERS = ("hpipm", "piqp", "ipopt", "riccati")


def mass_mpc(limit: float = np.inf, **options) -> Mpc:
    settings = {"horizon": 20, "sample_time": 0.1, "track": {"x": 1.0}, **options}
    return Mpc(mass(limit), **settings)


@pytest.fixture(scope="module")
def rest() -> pam.operating.OperatingPoint:
    return benchmark_slide().equilibrium(x=0.0, stiffness=2e4)


SLOW = {"v": (-0.4, 0.4)}


def square(t: float) -> float:
    return 0.010 if t % 0.4 < 0.2 else -0.010


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_linear_plant_with_idle_bounds_gets_the_lqr_of_riccati(solver):
    h, n, q, r = 0.1, 20, np.diag([3.0, 0.5]), np.array([[0.2]])
    a, b = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h / 2], [h]])
    p = q
    for _ in range(n):
        gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ gain)
    mpc = mass_mpc(track={"x": 3.0, "v": 0.5, "f": 0.2}, solver=solver)
    x = np.array([0.7, -0.3])
    assert mpc.control(x)["f"] == pytest.approx((-gain @ x).item(), abs=1e-5)


def test_weights_on_changes_see_the_input_applied_before():
    """One step of horizon: min x1^2/2 + r (u - u0)^2/2, by hand."""
    h, r, before = 0.1, 0.3, 0.8
    mpc = mass_mpc(horizon=1, track={"v": 1.0}, terminal={"v": 1.0}, rate={"f": r})
    mpc.reset({"f": before})
    assert mpc.control([0.0, 0.5])["f"] == pytest.approx((r * before - h * 0.5) / (h * h + r))


def test_terminal_weights_replace_those_of_track_by_name():
    """Two steps by hand: x after the last keeps its weight, v has another one there, f none."""
    h, q, last, r = 0.1, np.diag([3.0, 0.5]), np.diag([3.0, 40.0]), 0.2
    a, b = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h / 2], [h]])
    late = np.hstack([a @ b, b])  # of f0 and f1 in the last state
    x = np.array([0.7, -0.3])
    square = late.T @ last @ late + np.diag([r, r])
    square[0, 0] += (b.T @ q @ b).item()
    push = late.T @ last @ a @ a @ x
    push[0] += (b.T @ q @ a @ x).item()
    mpc = mass_mpc(horizon=2, track={"x": 3.0, "v": 0.5, "f": r}, terminal={"v": 40.0})
    assert mpc.control(x)["f"] == pytest.approx(-np.linalg.solve(square, push)[0], abs=1e-6)


def test_known_disturbances_parameters_and_offsets_are_planned_for():
    mpc = mass_mpc(horizon=40, rate={"f": 0.1})
    mpc.reset({"f": -2.0})
    assert mpc.control([0, 0], values={"push": 2.0})["f"] == pytest.approx(-2.0, abs=1e-5)
    mpc.reset({"f": -2.0})
    values = {"der(v)": 0.5, "m": 4.0}
    assert mpc.control([0, 0], values=values)["f"] == pytest.approx(-2.0, abs=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_bounds_of_inputs_hold_and_those_of_states_where_they_can(solver):
    mpc = mass_mpc(1.0, rate={"f": 1e-3}, bounds=SLOW, solver=solver, iterations=5)
    loop = mpc.closed_loop(mass(1.0), {"x": 1.0}, 4.0)
    assert np.abs(loop.trajectory["f"]).max() <= 1.0
    assert np.abs(loop.trajectory["v"]).max() <= 0.4 + 1e-4
    assert loop.trajectory["x"][-1] == pytest.approx(1.0, abs=1e-2)
    assert loop.statistics.failures == 0


def test_a_state_outside_its_soft_bound_is_brought_back():
    mpc = mass_mpc(1.0, rate={"f": 1e-3}, bounds=SLOW, iterations=5)
    loop = closed_loop(mpc, mass(1.0), {"x": 1.0}, duration=2.0, start={"v": 0.8})
    assert loop.statistics.fallbacks == loop.statistics.failures == 0
    assert loop.trajectory["v"][5:].max() <= 0.4 + 1e-3


def test_hard_bounds_that_cannot_be_kept_are_reported():
    mpc = mass_mpc(1.0, horizon=5, soft=False, bounds=SLOW)
    assert np.isfinite(mpc.control([0.0, 2.0])["f"])
    assert mpc.statistics.fallbacks == mpc.statistics.failures == 1


def test_a_shifted_solution_needs_fewer_iterations_than_a_cold_start():
    warm, cold = slide_mpc(iterations=20), slide_mpc(iterations=20)
    x = benchmark_slide().equilibrium(x=0.0, stiffness=2e4)
    warm.reset({v.name: x[v.name] for v in x.plant.inputs})
    reference = {"x": 0.008, "stiffness": 2e4}
    state, counts = x.x, []
    for _ in range(6):
        cold.reset({v.name: x[v.name] for v in x.plant.inputs})
        warm.control(state, reference)
        cold.control(state, reference)
        counts.append((warm.statistics.steps[-1].iterations, cold.statistics.steps[0].iterations))
        predicted = warm.prediction()
        state = [predicted[v.name][1] for v in x.plant.states]
    assert sum(w for w, _ in counts[1:]) < 0.7 * sum(c for _, c in counts[1:])


@pytest.mark.parametrize("method", ["rk4", "rosenbrock"])
def test_the_prediction_is_the_motion_that_an_exact_integrator_gives(rest, method):
    mpc = slide_mpc(method=method, substeps=8, iterations=30, tolerance=1e-6)
    mpc.control(rest.x, {"x": 0.008, "stiffness": 2e4})
    plan = mpc.prediction()
    assert plan.compare(pam.simulate(mpc.plant, plan), ["x", "v"]).largest < 1e-3


def test_a_solution_by_sqp_is_that_of_ipopt(rest):
    found = []
    for solver in SOLVERS:
        mpc = slide_mpc(solver=solver, iterations=30, tolerance=1e-6)
        mpc.reset({v.name: rest[v.name] for v in rest.plant.inputs})
        found.append(list(mpc.control(rest.x, {"x": 0.008, "stiffness": 2e4}).values()))
    assert found[1] == pytest.approx(found[2], abs=20.0)  # Pa
    assert found[0] == pytest.approx(found[2], abs=300.0)  # HPIPM stops at a larger gap


def test_with_a_delay_it_plans_from_where_the_inputs_under_way_will_have_led(rest):
    under_way = {"muscle1.command": 4e5, "muscle2.command": 2e5}
    late, at_once = (slide_mpc(delay=d, iterations=30, tolerance=1e-6) for d in (1, 0))
    late.reset(under_way)
    at_once.reset(under_way)
    start = {v.name: rest[v.name] for v in rest.plant.states}
    meanwhile = pam.simulate(rest.plant, under_way, start=start, duration=0.005)
    there = [meanwhile[n][-1] for n in start]
    reference = {"x": 0.008, "stiffness": 2e4}
    chosen = late.control(rest.x, reference)
    assert at_once.control(there, reference) == pytest.approx(chosen, abs=50.0)  # Pa


def test_seeded_noise_gives_the_same_run_twice():
    def run(seed: int) -> pam.Trajectory:
        wanted, more = {"x": square, "stiffness": 2e4}, {"noise": {"x": 1e-5}, "seed": seed}
        return closed_loop(slide_mpc(), benchmark_slide(), wanted, duration=0.1, **more).trajectory

    assert np.array_equal(run(3)["x"], run(3)["x"])
    assert not np.array_equal(run(3)["x"], run(4)["x"])


def test_hpipm_called_directly_solves_the_quadratic_program_that_piqp_solves(rest):
    """After a jump of the reference, with hard bounds and soft ones, some of them active."""
    mpc = slide_mpc(iterations=1, bounds={"x": (None, 0.007)})
    mpc.reset({v.name: rest[v.name] for v in rest.plant.inputs})
    mpc.control(rest.x, {"x": -0.008, "stiffness": 2e4})
    point, p = mpc._sqp.point, mpc.program
    mpc._references({"x": 0.012, "stiffness": 2e4})
    point()
    rows, columns = p.h_entries
    point.h[rows == columns] += sqp.PROXIMAL
    direction = np.zeros(p.size)
    StageQp(point, direction)()
    assert np.abs(direction).max() > 0.1
    assert direction == pytest.approx(exact(p, point), abs=1e-4)


def test_without_the_library_hpipm_is_reached_through_casadi(rest, monkeypatch):
    found = []
    for direct in (True, False):
        monkeypatch.setattr(sqp, "available", lambda direct=direct: direct)
        mpc = slide_mpc(iterations=30, work=None, tolerance=1e-5)
        mpc.reset({v.name: rest[v.name] for v in rest.plant.inputs})
        found.append(list(mpc.control(rest.x, {"x": 0.008, "stiffness": 2e4}).values()))
        assert (mpc.statistics.steps[0].work > 0) == direct
    assert found[0] == pytest.approx(found[1], abs=300.0)  # Pa; CasADi's stops at a larger gap


def test_the_work_of_a_call_is_bounded_after_a_jump_and_the_solution_completed_later(rest):
    bounded, free = slide_mpc(iterations=30), slide_mpc(iterations=30, work=None)
    for mpc in (bounded, free):
        mpc.reset({v.name: rest[v.name] for v in rest.plant.inputs})
        state = rest.x
        for k in range(30):
            mpc.control(state, {"x": 0.0 if k == 0 else 0.012, "stiffness": 2e4})
            plan = mpc.prediction()  # the plant follows the model
            state = [plan[v.name][1] for v in rest.plant.states]
        steps = mpc.statistics.steps[1:]
        assert mpc.statistics.fallbacks == 0
        if mpc is bounded:
            assert max(s.work for s in steps) < 12 + 20  # the last program is finished
            assert not steps[0].converged
        else:
            assert max(s.work for s in steps) > 30
            assert steps[0].converged
        assert steps[-1].converged
        assert state[0] == pytest.approx(0.012, abs=2e-4)


@pytest.mark.slow
def test_a_wrong_load_is_found_and_rejected_against_the_fmu(tmp_path):
    """30 % more mass and a constant force that the model leaves out: found as an offset of v'."""
    plant = benchmark_slide()
    rest = plant.equilibrium(x=0.0, stiffness=2e4)
    start = {v.name: rest[v.name] for v in (*plant.states, *plant.inputs)}
    model = plant.with_values(start)
    known = {"measured": {"x": 2e-5, "muscle1.pressure": 500, "muscle2.pressure": 500}}
    known |= {"process": {"v": 0.01}, "unknown": {"mass": (0.5, 0.05)}}
    observer = KalmanFilter(model, sample_time=0.005, **known)
    weights = {"track": {"x": 1.0, "stiffness": 0.05}, "rate": dict.fromkeys(COMMANDS, 0.05)}
    mpc = Mpc(model, horizon=30, sample_time=0.005, delay=1, **weights)
    fmu = pam.export_fmu(plant, tmp_path / "slide.fmu", platforms=["native"])
    wanted = {"x": lambda t: square(t) if t < 1 else 0.005, "stiffness": 2e4}
    real = {"estimator": observer, "parameters": {"mass": 2.6}, "start": start}
    loop = closed_loop(mpc, fmu, wanted, duration=1.6, **real)
    assert loop.steady_error("x", 0.2) < 2e-4
    assert loop.estimate["mass"][-1] == pytest.approx(2.6, rel=0.1)
    assert loop.statistics.failures == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"horizon": 0}, "horizon = 0"),
        ({"sample_time": -1.0}, "sample_time = -1"),
        ({"delay": 2}, "delay = 2"),
        ({"work": 0}, "work = 0"),
        ({"track": {"x": -1.0}}, "track"),
        ({"track": {}}, "at least one weight"),
        ({"rate": {"x": 1.0}}, "x is a state"),
        ({"rate": {"push": 1.0}}, "push is a disturbance"),
        ({"bounds": {"m": (0, 1)}}, "m is a parameter"),
        ({"bounds": {"v": (1, -1)}}, "the first the smaller"),
        ({"solver": "magic"}, "solver = 'magic'"),
        ({"method": "euler"}, "method = 'euler'"),
    ],
)
def test_arguments_that_cannot_be_meant_are_refused(change, words):
    refused(words, mass_mpc, **{"horizon": 5, **change})


def test_a_terminal_weight_on_what_inputs_act_on_is_refused():
    plant = mass()
    drawn = plant.with_output("drawn", plant.expression("f") * plant.expression("v"))
    refused(
        "drawn depends on the inputs",
        Mpc,
        drawn,
        horizon=5,
        sample_time=0.1,
        track={"x": 1.0},
        terminal={"drawn": 1.0},
    )
    assert Mpc(drawn, horizon=5, sample_time=0.1, track={"x": 1.0}, terminal={"drawn": 0.0})


def test_unknown_names_get_the_nearest_one():
    mpc = mass_mpc(horizon=5)
    refused("push", mpc.control, [0, 0], error=UnknownNameError, values={"pushh": 1.0})
    refused("tracked", mpc.control, [0, 0], {"v": 1.0}, error=UnknownNameError)
    refused("v is missing", mpc.control, {"x": 0.0})
    refused("6 of them", mpc.control, [0, 0], {"x": [1.0, 2.0]})


def test_a_closed_loop_refuses_what_cannot_be_meant(tmp_path):
    mpc, real = mass_mpc(horizon=5), mass()
    with pytest.raises(UnknownNameError, match="push"):
        closed_loop(mpc, real, {"x": 1.0}, duration=1.0, disturbances={"pushh": 1.0})
    refused("no such FMU", closed_loop, mpc, tmp_path / "none.fmu", {"x": 1.0}, duration=1.0)
    refused("the controller comes first", pam.closed_loop, real, mpc, duration=1.0)


# ---- what its statistics say
def test_steps_that_are_applied_before_they_converged_are_counted():
    """A jump of the reference with one SQP step per call: not converged; at rest it is again."""
    mpc = slide_mpc(iterations=1, tolerance=1e-4)
    loop = mpc.closed_loop(benchmark_slide(), {"x": lambda t: 0.01 if t >= 0.1 else 0.0}, 0.2)
    steps = loop.statistics.steps
    expected = sum(s.last_step > 1e-4 for s in steps)
    assert 0 < expected < len(steps)
    assert loop.statistics.unconverged == expected
    assert f"not converged {expected} times" in str(loop)


def test_ipopt_is_asked_less_often_the_longer_it_fails(rest, monkeypatch):
    mpc = slide_mpc()
    none = sqp.SqpOutcome(False, False, 1, np.inf, 0.0)
    asked: list[int] = []
    monkeypatch.setattr(mpc._sqp, "solve", lambda *_: none)
    monkeypatch.setattr(mpc, "_by_ipopt", lambda: asked.append(1) or none)
    for _ in range(31):
        mpc.control(rest.x, {"x": 0.01, "stiffness": 2e4})
    assert len(asked) == 5  # calls 0, 2, 6, 14 and 30
    assert (mpc.statistics.failures, mpc.statistics.fallbacks) == (31, 5)


def test_predictions_are_stable_where_a_plant_is_quickest():
    """A quick exhaust opens over 0.2 bar: some 4000/s on the way, 350/s elsewhere; rk4 is stable
    up to 2.785 over the pole (Hairer and Wanner, IV.2).
    """
    feed = pam.feeds.SpoolValve(tube=pam.feeds.Tube(), quick_exhaust=pam.feeds.QuickExhaust())
    plant = pam.HangingLoad("DMSP-20-200N", 10.0, feed=feed)
    mpc = Mpc(plant, horizon=5, sample_time=0.01, track={"x": 1.0})
    assert 0.01 * 2000 / 2.785 < mpc._how.substeps < 0.01 * 8000 / 2.785


def test_inputs_that_nothing_feels_do_not_keep_a_controller_from_converging():
    """No weight on rates, and two inputs for one tracked position: the last inputs of the horizon,
    and what both muscles have in common, have no place of their own.
    """
    for solver in ("hpipm", "riccati"):
        mpc = Mpc(benchmark_slide(), horizon=20, sample_time=0.01, track={"x": 1.0}, solver=solver)
        loop = mpc.closed_loop(benchmark_slide(), {"x": 0.01}, 0.4)
        assert loop.statistics.unconverged <= 4
        assert sum(s.iterations for s in loop.statistics.steps[10:]) <= 40
        assert np.ptp(loop["muscle1.command"][-10:]) < 100.0  # Pa
        assert loop.verdict


def test_the_error_of_a_prediction_is_that_of_a_tight_integration():
    """One RK4 step of 50 ms on a regulator's lag of 50 ms: by SciPy, from node to node."""
    mpc = slide_mpc(sample_time=0.05, substeps=1, horizon=8)
    mpc.control(mpc.plant.vector("state"), {"x": 0.01})
    motion, plant = mpc.prediction(), mpc.plant
    states = motion.array(motion.named("state"))
    inputs = motion.array(motion.named("input"))
    nominal = plant.vector("state", attribute="nominal")
    misses = [
        np.abs(scipy_states(plant, lambda _, u=u: u, [0.0, 0.05], x)[-1] - after) / nominal
        for x, u, after in zip(states[:-1], inputs[:-1], states[1:], strict=True)
    ]
    assert np.max(misses) > 1e-4  # a rough step
    assert mpc.prediction_error() == pytest.approx(np.max(misses), rel=1e-2)


def test_the_first_and_the_latest_calls_are_kept_and_all_are_counted(monkeypatch):
    monkeypatch.setattr(mpc_statistics, "KEPT", 5)
    calls = mpc_statistics.Calls()
    for k in range(1, 14):  # every third did not converge, of these the ninth failed, too
        failed = k == 9
        calls.record(1e-3 * k, 0.0, k, 0, 0.0, float(k % 3 > 0), float(failed), float(failed))
    found = calls.statistics
    assert [s.iterations for s in found.steps] == [1, 9, 10, 11, 12, 13]
    assert found.counts == {"all": 13, "unconverged": 3, "failed": 1}
    assert found.fallbacks == 1
    assert found.seconds == pytest.approx([9e-3, 10e-3, 11e-3, 12e-3, 13e-3])
    assert str(found).startswith("13 steps")
    assert len(calls._columns) == 6 * len(mpc_statistics._COLUMNS)
