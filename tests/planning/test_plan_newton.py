"""Re-solves by Newton's method along the stages: IPOPT's optimum, sooner, or IPOPT."""

import casadi as ca
import numpy as np
import pytest
from conftest import hardening_cart as cart

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.planning import Shooting
from pam_ocp.planning.solvers.condensed import Condensed
from pam_ocp.planning.solvers.newton import Newton, Optimality, Point

MOVE = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]
EFFORT = {"rest": False, "duration": 1.0, "minimise": "effort"}
STOPS = [{"x": -0.015}, {"x": 0.015}]


# {name: (stops, keywords of a planner, what changes)}
PROBLEMS = {
    "radau": (MOVE, EFFORT | {"method": Collocation(10, 3)}, {"values": {"mass": 1.6}}),
    "gauss": (
        MOVE,
        EFFORT | {"method": Collocation(10, 3, points="gauss")},
        {"values": {"mass": 1.6}},
    ),
    "shooting, a path": (
        MOVE,
        EFFORT | {"method": Shooting(12, 2), "bounds": {"power": (-8.0, 8.0)}},
        {"values": {"mass": 1.55}},
    ),
    "polynomial inputs": (
        MOVE,
        EFFORT | {"method": Collocation(3, 5, "polynomial")},
        {"values": {"stiffness": 0.8}},
    ),
    "two legs, free durations": (
        [{"x": 0.0, "v": 0.0}, {"x": 0.6}, {"x": 1.0, "v": 0.0}],
        {"rest": False, "minimise": {"time": 1.0, "effort": 0.1}, "method": Collocation(6, 3)},
        {"values": {"mass": 1.53}},
    ),
    "a limit moves in": (
        MOVE,
        EFFORT | {"method": Collocation(16, 3), "bounds": {"v": (-1.0, 1.45)}},
        {"bounds": {"v": (-1.0, 1.35)}},
    ),
    "limits become active": (
        MOVE,
        EFFORT | {"method": Collocation(16, 3), "bounds": {"u": (-9.0, 9.0)}},
        {"bounds": {"u": (-7.8, 7.8)}},
    ),
    "a limit is left": (
        MOVE,
        EFFORT | {"method": Collocation(16, 3), "bounds": {"u": (-7.8, 7.8)}},
        {"bounds": {"u": (-9.5, 9.5)}},
    ),
    "a peak": (
        MOVE,
        EFFORT | {"minimise": {"effort": 1.0, "peak(v)": 2.0}, "method": Collocation(10, 2)},
        {"values": {"mass": 1.55}},
    ),
}


def resolved(name, plant=None):
    """(planner, neighbour, the changed program, its numbers, Newton's point)."""
    stops, keywords, change = PROBLEMS[name]
    planner = pam.Planner(plant or cart(), stops, **keywords)
    first = planner(tolerance=None)
    change = dict(change)
    program = planner._with(change.pop("values", None), change)
    numbers = planner._solver.arguments(program, first._solved.outcome.w)
    newton = Newton.made(planner._program)
    assert newton is not None
    near = first._solved.outcome
    return planner, near, program, numbers, newton(numbers, Point(near.w, near.lam_g, near.lam_x))


def conditions(program, point):
    """(stationarity, violation, complementarity) by CasADi's derivatives of the whole program."""
    nlp = program.nlp
    lam = ca.MX.sym("lam", nlp["g"].numel())
    slope = ca.gradient(nlp["f"] + ca.dot(lam, nlp["g"]), nlp["x"])
    function = ca.Function("kkt", [nlp["x"], nlp["p"], lam], [slope, nlp["g"]])
    slope, g = (np.asarray(r).ravel() for r in function(point.w, program.parameters(), point.lam_g))
    miss, gap = 0.0, 0.0
    for values, lam, (low, high) in (
        (g, point.lam_g, program.limits()),
        (point.w, point.lam_x, program.bounds()),
    ):
        miss = max(miss, np.max(low - values), np.max(values - high))
        for value, pull, a, b in zip(values, lam, low, high, strict=True):
            if a < b and pull:
                gap = max(gap, abs(pull * ((b if pull > 0 else a) - value)))
    return np.max(np.abs(slope + point.lam_x)), miss, gap


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_ends_at_ipopts_optimum(name):
    planner, _, program, numbers, found = resolved(name)
    assert found is not None
    expected = planner._solver(program, numbers["x0"])
    assert expected.success
    assert found.log[-1]["obj"] == pytest.approx(expected.objective, rel=1e-7, abs=1e-9)
    assert found.w == pytest.approx(expected.w, rel=1e-4, abs=1e-4)
    assert 1 < len(found.log) < expected.iterations


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_meets_the_optimality_conditions(name):
    _, _, program, _, found = resolved(name)
    dual, miss, gap = conditions(program, found)
    assert dual < 1.1e-9
    assert miss < 1.1e-9
    assert gap < 1.1e-10


def active(numbers, point):
    """Which unknowns stand at a bound."""
    free = numbers["lbx"] < numbers["ubx"]
    return free & (np.abs(point.lam_x) > 1e-6)


@pytest.mark.parametrize("name", ["limits become active", "a limit is left"])
def test_bounds_come_and_go(name):
    _, near, _, numbers, found = resolved(name)
    before, now = active(numbers, near), active(numbers, found)
    assert (before != now).any()
    assert now.sum() > before.sum() if name == "limits become active" else now.sum() < before.sum()


def test_the_judge_sees_each_condition():
    planner, _, program, numbers, found = resolved("radau")
    judge = Optimality(
        *(planner._solver._first.get_function(f"nlp_{n}") for n in ("grad_f", "jac_g"))
    )
    random = np.random.default_rng(3)
    for w, lam_g, lam_x in (
        (found.w, found.lam_g, found.lam_x),
        (found.w + 1e-3 * random.normal(size=len(found.w)), found.lam_g, found.lam_x),
        (found.w, found.lam_g + 1e-3, found.lam_x),
        (found.w, found.lam_g, found.lam_x - 1e-3),
    ):
        expected = conditions(program, Point(w, lam_g, lam_x))
        assert judge(numbers, w, lam_g, lam_x) == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    "keywords",
    [
        {"method": Collocation(5, 3, "linear")},
        {"method": Collocation(6, 2), "minimise": {"rate": 1e-2, "effort": 1.0}},
        {"method": Collocation(5, 3), "budgets": {"square(u)": 300.0}, "minimise": "square(v)"},
    ],
    ids=["linear inputs", "jumps cost", "a budget"],
)
def test_programs_that_do_not_go_stage_by_stage_are_ipopts(keywords):
    planner = pam.Planner(cart(), MOVE, **(EFFORT | keywords))
    assert Condensed.made(planner._program) is None
    first = planner(tolerance=None)
    again = planner({"mass": 1.52}, guess=first, tolerance=None)
    assert again.statistics["solver"] == "IPOPT"


# ---- in a planner -------------------------------------------------------------------------------
def test_a_planner_says_who_solved_it(slide):
    planner = pam.Planner(slide, STOPS, cyclic="mirrored", method=Collocation(20, 3))
    first = planner()
    assert first.statistics["solver"] == "IPOPT"
    near = planner({"mass": 2.02}, guess=first)
    assert near.verified
    assert near.statistics["solver"] == "Newton"
    assert near.objective == pytest.approx(planner({"mass": 2.02}).objective, rel=1e-7)
    assert len(near.log) == near.statistics["iterations"] + 1
    assert near.log[-1]["obj"] == near.statistics["objective_on_mesh"]


def test_options_are_ipopts():
    keywords = {**EFFORT, "method": Collocation(5, 3)}
    planner = pam.Planner(cart(), MOVE, options={"tol": 1e-8}, **keywords)
    again = planner({"mass": 1.52}, guess=planner(tolerance=None), tolerance=None)
    assert again.statistics["solver"] == "IPOPT"


def test_progress_is_told():
    seen = []
    keywords = {**EFFORT, "method": Collocation(5, 3)}
    planner = pam.Planner(cart(), MOVE, progress=lambda *each: seen.append(each), **keywords)
    first = planner(tolerance=None)
    seen.clear()
    again = planner({"mass": 1.52}, guess=first, tolerance=None)
    assert again.statistics["solver"] == "Newton"
    assert [each[0] for each in seen] == list(range(len(again.log)))
    assert seen[-1][1] == pytest.approx(again.objective)
    assert seen[-1][2] < 1e-9 < seen[0][2]


@pytest.mark.parametrize(
    "answer",
    [
        lambda point: None,
        lambda point: Point(point.w + 1e-5, point.lam_g, point.lam_x, point.log),
        lambda point: Point(point.w, point.lam_g * 1.01, point.lam_x, point.log),
        lambda point: Point(point.w * np.nan, point.lam_g, point.lam_x, point.log),
    ],
    ids=["gave up", "other unknowns", "other multipliers", "no numbers"],
)
def test_what_is_no_optimum_goes_to_ipopt(monkeypatch, answer):
    planner = pam.Planner(cart(), MOVE, **EFFORT, method=Collocation(8, 3))
    first = planner(tolerance=None)
    expected = planner({"mass": 1.6}, tolerance=None)
    ours = Newton.__call__
    monkeypatch.setattr(Newton, "__call__", lambda self, *given: answer(ours(self, *given)))
    found = planner({"mass": 1.6}, guess=first, tolerance=None)
    assert found.statistics["solver"] == "IPOPT"
    assert found.objective == pytest.approx(expected.objective, rel=1e-8)


def test_far_neighbours_are_ipopts(slide):
    planner = pam.Planner(slide, STOPS, cyclic="mirrored", method=Collocation(20, 3))
    first = planner()
    far = [{"x": -0.005}, {"x": 0.005}]
    found = planner(stops=far, guess=first)
    assert found.statistics["solver"] == "IPOPT"
    assert found.objective == pytest.approx(planner(stops=far).objective, rel=1e-7)


def test_a_maximum_is_no_answer():
    """x' = u from 0 to 0 with the cost -u^2: standing still is stationary, and the worst."""
    plant = pam.Plant("point")
    x = plant.state("x")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, u)
    planner = pam.Planner(
        plant,
        [{"x": 0.0}, {"x": 0.0}],
        rest=False,
        duration=1.0,
        integrand=-(plant.expression("u") ** 2),
        method=Collocation(4, 2),
    )
    program, solver = planner._program, planner._solver
    near = np.where(program.bounds()[0] == program.bounds()[1], program.bounds()[0], 1e-3)
    numbers = solver.arguments(program, near)
    zero = np.zeros(program.nlp["g"].numel()), np.zeros(len(near))
    newton = Newton.made(program)
    assert newton(numbers, Point(near, *zero)) is None
