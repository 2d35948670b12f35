"""Optima that are no one place: costs are flat along them, and solutions are settled by damping."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.planning.solvers.ipopt import DAMPED, WANDERING
from pam_ocp.planning.solvers.solver import Ipopt
from pam_ocp.planning.transcription.derivatives import derivatives
from pam_ocp.planning.transcription.guess import by_stops
from pam_ocp.planning.transcription.transcription import smoothed_at


def load(losses=()):
    """Lifted and let down; that takes no work, so when it goes down is free."""
    return pam.HangingLoad(
        "DMSP-20-400N", 3.5, feed=pam.feeds.Regulator(0.05, max_pressure=6e5), losses=losses
    )


def work_program(intervals=20):
    planner = pam.Planner(
        load(pam.losses.MaxwellSlip()),
        [{"x": 0.01}, {"x": 0.05}],
        minimise="work",
        duration=1.0,
        cyclic=True,
        method=pam.Collocation(intervals, 3),
    )
    return smoothed_at(planner._program, 0.0)


def kkt(program, outcome):
    """Largest (violation, slope of the Lagrangian), by CasADi's own derivatives of the program."""
    w, p = program.nlp["x"], program.nlp["p"]
    lam = ca.MX.sym("lam", program.nlp["g"].numel())
    f, g = (ca.Function("of", [w, p], [program.nlp[n]]) for n in "fg")
    w0, p0 = ca.MX.sym("w", w.numel()), ca.MX.sym("p", p.numel())
    slope = ca.gradient(f(w0, p0) + ca.dot(lam, g(w0, p0)), w0)
    value, slopes = ca.Function("kkt", [w0, p0, lam], [g(w0, p0), slope])(
        outcome.w, program.parameters(), outcome.lam_g
    )
    value = np.asarray(value).ravel()
    (low, high), (least, most) = program.limits(), program.bounds()
    beyond = [low - value, value - high, least - outcome.w, outcome.w - most]
    still = np.abs(np.asarray(slopes).ravel() + outcome.lam_x)
    return max(float(np.max(b, initial=0.0)) for b in beyond), float(still.max())


@pytest.mark.slow
def test_a_flat_optimum_ends_at_a_place_and_is_an_optimum():
    program = work_program(16)
    solver = Ipopt(program)
    guess = by_stops(program.problem, program.mesh, balanced=True)
    found = solver(program, guess)
    assert found.success
    # whether IPOPT alone wanders along it hangs on rounding: here it is told so
    log = ({"inf_pr": 1e-4, "inf_du": 1e-7},)
    late = replace(found, status="Maximum_Iterations_Exceeded", success=False, log=log)
    settled = solver.settled(program, late)
    assert settled.status == "Settled"
    for outcome in (found, settled):
        violation, slope = kkt(program, outcome)
        assert violation <= 1e-7  # multipliers and unknowns count in nominals
        assert slope <= 2e-6
    assert settled.objective == pytest.approx(found.objective, rel=1e-5)
    # a second way to it: along the flat there are many optima, all of one value
    other = solver(program, guess, "adaptive")
    assert other.success
    assert other.objective == pytest.approx(found.objective, rel=1e-5)


@pytest.mark.parametrize("start", ["finer", "damped", "last"])
def test_damping_moves_no_optimum(start):
    planner = pam.Planner(
        load(),
        [{"x": 0.01}, {"x": 0.05}],
        minimise="effort",
        duration=0.5,
        method=pam.Collocation(10, 3),
    )
    program = planner._program
    solver = Ipopt(program)
    exact = solver(program, by_stops(program.problem, program.mesh, balanced=True))
    assert exact.success
    scatter = np.random.default_rng(5).uniform(-1e-4, 1e-4, len(exact.w))
    low, high = program.bounds()
    guess = np.clip(exact.w + scatter, low, high)
    again = solver(program, guess, start, None if start == "finer" else exact)
    assert again.success
    assert again.objective == pytest.approx(exact.objective, rel=1e-7)
    assert kkt(program, again)[1] <= 2e-6


def test_the_damped_hessian_differs_by_its_diagonal():
    program = work_program(4)
    solver = Ipopt(program)
    plain, damped = (solver._solver(name).get_function("nlp_hess_l") for name in ("cold", "damped"))
    w = by_stops(program.problem, program.mesh, balanced=True)
    rng = np.random.default_rng(0)
    given = w, program.parameters(), 1.0, rng.standard_normal(program.nlp["g"].numel())
    difference = np.asarray(ca.DM(damped(*given) - plain(*given)))
    np.testing.assert_allclose(difference, DAMPED["damped"] * np.eye(len(w)), atol=1e-9)
    assert "hess_lag" in derivatives(program)


def test_what_does_not_settle_has_failed(monkeypatch):
    program = work_program(4)
    solver = Ipopt(program)
    found = solver(program, by_stops(program.problem, program.mesh, balanced=True))
    last = {"inf_pr": 1e-3, "inf_du": 1e-7}
    astray = replace(
        found, status="Maximum_Iterations_Exceeded", success=False, log=(*found.log, last)
    )
    assert astray.wandered
    steep = {**last, "inf_du": 2 * WANDERING["acceptable_dual_inf_tol"]}
    assert not replace(astray, log=(steep,)).wandered
    assert not found.wandered or found.status == "Solved_To_Acceptable_Level"
    settled = solver.settled(program, astray)
    assert settled.success
    assert settled.iterations > astray.iterations
    monkeypatch.setattr(Ipopt, "__call__", lambda *given: replace(found, success=False, status="X"))
    failed = solver.settled(program, replace(astray, status="Solved_To_Acceptable_Level"))
    assert not failed.success
    assert failed.status == "Maximum_Iterations_Exceeded"


def test_what_ends_close_to_an_optimum_is_led_to_it():
    program = work_program(10)
    solver = Ipopt(program)
    found = solver(program, by_stops(program.problem, program.mesh, balanced=True))
    assert found.success
    low, high = program.bounds()
    scatter = np.random.default_rng(2).uniform(-3e-3, 3e-3, len(found.w))
    log = ({"inf_pr": 0.5, "inf_du": 5e-3},)
    near = replace(
        found,
        w=np.clip(found.w + scatter, low, high),
        status="Maximum_CpuTime_Exceeded",
        success=False,
        log=log,
    )
    assert near.led_on(damped=False) == ("last", "feasible")
    assert not near.wandered
    again = solver.settled(program, near, "cold")
    assert again.success
    violation, slope = kkt(program, again)
    assert violation <= 1e-7
    assert slope <= 2e-6
    assert again.objective == pytest.approx(found.objective, rel=1e-4)


def test_who_says_when_a_solve_ends_is_obeyed():
    program = work_program(4)
    guess = by_stops(program.problem, program.mesh, balanced=True)
    short = Ipopt(program, {"max_iter": 3})(program, guess)
    assert (short.success, short.iterations) == (False, 3)
    ours = [n for n in WANDERING if n != "acceptable_iter"]
    chosen = Ipopt(program, {"acceptable_iter": 5})._options("cold")["ipopt"]
    assert chosen["acceptable_iter"] == 5
    assert not set(ours) & set(chosen)  # IPOPT's own, as it is documented


def test_options_of_ones_own_are_not_second_guessed():
    program = work_program(4)
    rough = {f"acceptable_{n}": 1e2 for n in ("tol", "dual_inf_tol", "constr_viol_tol")}
    rough |= {"acceptable_compl_inf_tol": 1e2, "acceptable_obj_change_tol": 1e20}
    solver = Ipopt(program, {"acceptable_iter": 1, **rough})
    found = solver(program, by_stops(program.problem, program.mesh, balanced=True))
    assert found.status == "Solved_To_Acceptable_Level"
    assert found.success


def test_short_steps_lead_back_to_the_constraints():
    """To the nearest motion, and no nearer to the optimum than the place was."""
    program = work_program(10)
    solver = Ipopt(program)
    found = solver(program, by_stops(program.problem, program.mesh, balanced=True))
    low, high = program.bounds()
    scatter = np.random.default_rng(8).uniform(-1e-4, 1e-4, len(found.w))
    scattered = np.clip(found.w + scatter, low, high)
    g = ca.Function("g", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    least, most = program.limits()

    def violation(w):
        values = np.asarray(g(w, program.parameters()), float).ravel()
        return np.maximum(least - values, values - most).max()

    assert violation(scattered) > 1e-5
    for start, exact in (("feasible", 1e-8), ("corrector", 1e-4), ("restored", 1e-4)):
        back = solver(program, scattered, start, None if start == "restored" else found)
        assert back.success
        assert violation(back.w) <= exact
        assert np.linalg.norm(back.w - scattered) <= 1.5 * np.linalg.norm(found.w - scattered)


@pytest.mark.parametrize(
    ("status", "violation", "wanders"),
    [
        ("Infeasible_Problem_Detected", 1e-4, True),
        ("Restoration_Failed", 1e-4, True),
        ("Infeasible_Problem_Detected", 1e-2, False),
        ("Invalid_Number_Detected", 1e-4, False),
    ],
)
def test_an_optimum_beside_its_constraints_is_no_contradiction(status, violation, wanders):
    """Steps so long that no way back was found; what is far from its constraints contradicts."""
    program = work_program(4)
    found = Ipopt(program)(program, by_stops(program.problem, program.mesh, balanced=True))
    log = ({"inf_pr": violation, "inf_du": 1e-7},)
    assert replace(found, status=status, success=False, log=log).wandered is wanders


@pytest.mark.parametrize(
    ("residuals", "starts"),
    [
        ((1e-4, 1e-7), ("damped", "feasible")),  # at its optimum, which is no one place
        ((1e-3, 5e-3), ("feasible",)),  # costs are nearly at their least: as it is
        ((1e-1, 5e-3), ()),  # too far from the constraints for short steps
        ((1e-3, 5e-2), ()),
    ],
)
def test_a_motion_that_is_nearly_there_is_brought_back_as_it_is(residuals, starts):
    program = work_program(4)
    found = Ipopt(program)(program, by_stops(program.problem, program.mesh, balanced=True))
    log = (dict(zip(("inf_pr", "inf_du"), residuals, strict=True)),)
    late = replace(found, status="Maximum_Iterations_Exceeded", success=False, log=log)
    assert late.led_on(damped=True) == starts
    if starts == ("feasible",):
        settled = Ipopt(program).settled(program, late, "last")
        assert settled.status == "Settled"
        assert kkt(program, settled)[0] <= 1e-6


def test_iterations_are_many_where_they_cost_little():
    """24 s of a common machine, whatever the machine; a third where a motion is there. What an
    iteration costs grows with the intervals.
    """
    small, large, larger = (Ipopt(work_program(n)) for n in (4, 200, 400))
    most = [solver._options("cold")["ipopt"]["max_iter"] for solver in (small, large, larger)]
    assert most[0] == 800
    assert most[2] == 250
    assert most[1] == pytest.approx(24.0 / large.cost, abs=1.0)
    assert larger.cost == pytest.approx(2 * large.cost, rel=0.02)
    assert large._options("last")["ipopt"]["max_iter"] == int(8.0 / large.cost)


def test_where_costs_have_all_but_stopped_to_fall_a_solve_ends_and_its_motion_is_kept(monkeypatch):
    slide = pam.AntagonisticSlide(
        "DMSP-20-300",
        mass=2.0,
        pre_contraction=0.1,
        damping=pam.losses.ConstantDamping(20.0),
        feed=pam.feeds.Regulator(0.05, max_pressure=6e5),
    )
    stops, given = [{"x": -0.01}, {"x": 0.01}], {"minimise": "effort", "duration": 0.5}
    monkeypatch.setattr("pam_ocp.planning.solvers.solver.PROGRESS", (1000, 0.0))
    whole = pam.plan(slide, stops, **given)
    monkeypatch.setattr("pam_ocp.planning.solvers.solver.PROGRESS", (4, 1e-2))
    early = pam.plan(slide, stops, **given)
    starts = [(s["status"], s["iterations"]) for s in early.statistics["stages"]]
    assert starts[0][0] == "Slow_Progress"
    assert starts[0][1] < whole.statistics["stages"][0]["iterations"]
    assert early.verified
    assert early.objective == pytest.approx(whole.objective, rel=2e-3)
