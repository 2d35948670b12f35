"""Solvers of a plan: derivatives by stages, the choice by name, compiled functions."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import hardening_cart as cart
from conftest import refused

import pam_ocp as pam
from pam_ocp import Collocation, InputError
from pam_ocp.planning import Shooting
from pam_ocp.planning.continuation import ValveOpenings
from pam_ocp.planning.solvers.solver import Ipopt, Outcome
from pam_ocp.planning.transcription.derivatives import derivatives
from pam_ocp.planning.transcription.guess import by_stops

STOPS = [{"x": -0.015}, {"x": 0.015}]


MOVE = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]
ONE = {"rest": False, "duration": 1.0, "minimise": "effort"}
PROBLEMS = {
    "radau": (MOVE, ONE | {"method": Collocation(5, 3)}),
    "gauss": (MOVE, ONE | {"method": Collocation(5, 3, points="gauss")}),
    "shooting": (MOVE, ONE | {"method": Shooting(5, 2), "bounds": {"power": (-20.0, 20.0)}}),
    "linear inputs": (MOVE, ONE | {"method": Collocation(5, 3, "linear")}),
    "shooting with linear inputs": (MOVE, ONE | {"method": Shooting(5, 2, "linear")}),
    "polynomial inputs": (MOVE, ONE | {"method": Collocation(3, 5, "polynomial")}),
    "rate": (MOVE, ONE | {"minimise": {"rate": 1e-2, "effort": 1.0}, "method": Collocation(6, 2)}),
    "rate of polynomial inputs": (
        MOVE,
        ONE | {"minimise": {"rate": 1e-2}, "method": Collocation(3, 4, "polynomial")},
    ),
    "budget": (
        MOVE,
        ONE
        | {"budgets": {"square(u)": 300.0}, "minimise": "square(v)", "method": Collocation(5, 3)},
    ),
    "budget by shooting": (
        MOVE,
        ONE | {"budgets": {"square(u)": 300.0}, "minimise": "square(v)", "method": Shooting(5, 2)},
    ),
    "peak": (
        MOVE,
        ONE | {"minimise": {"peak(v)": 1.0, "effort": 1e-3}, "method": Collocation(5, 3)},
    ),
    "design": (MOVE, ONE | {"design": {"stiffness": (0.1, 5.0)}, "method": Collocation(5, 3)}),
    "profiles": (
        MOVE,
        ONE
        | {
            "bounds": {"v": (None, pam.Profile([0.0, 1.0], [2.0, 1.8]))},
            "track": {"x": pam.Profile([0.0, 0.3, 0.6, 1.0], [0.0, 0.2, 0.9, 1.0], smooth=True)},
            "method": Collocation(5, 3),
        },
    ),
    "three legs": (
        [*MOVE, {"x": 0.5, "v": 0.0}],
        {
            "rest": False,
            "minimise": {"time": 1.0, "effort": 1e-2},
            "cyclic": True,
            "phases": [None, pam.Phase(bounds={"v": (-0.8, 0.8)}), None],
            "method": Collocation(4, 3),
        },
    ),
    "terms of the end and of time": (
        [MOVE[0], {"x": (0.5, 1.0), "u": 0.0}],
        {
            "rest": False,
            "duration": (0.5, 2.0),
            "integrand": pam.planning.TIME * 0.1,
            "minimise": {"final(x)": -1.0, "effort": 0.1},
            "method": Collocation(4, 3),
        },
    ),
}


def planner(name: str, **more) -> pam.Planner:
    stops, arguments = PROBLEMS[name]
    return pam.Planner(cart(), stops, **{**arguments, **more})


def flat(value) -> np.ndarray:
    return np.asarray(ca.DM(value), float).ravel()


@pytest.fixture(params=PROBLEMS)
def program(request):
    return planner(request.param)._program


def test_derivatives_by_stages_are_casadis(program):
    """Against CasADi's own differentiation of the whole program, at a random point."""
    found = derivatives(program)
    if program.problem.profiles:
        assert found == {}  # tables: left to CasADi
        return
    x, p, f, g = (program.nlp[k] for k in ("x", "p", "f", "g"))
    own = ca.Function("own", [x, p], [f, g])
    w, q = ca.MX.sym("w", x.numel()), ca.MX.sym("q", p.numel())
    f, g = own(w, q)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
    curvature = ca.triu(ca.hessian(lam_f * f + ca.dot(lam_g, g), w)[0])
    reference = ca.Function(
        "reference", [w, q, lam_f, lam_g], [f, ca.gradient(f, w), g, ca.jacobian(g, w), curvature]
    )
    rng = np.random.default_rng(1)
    point = rng.uniform(0.5, 1.5, w.numel())
    values = program.parameters()
    multipliers = 0.7, rng.standard_normal(g.numel())
    expected = reference(point, values, *multipliers)
    results = (
        *found["grad_f"](point, values),
        *found["jac_g"](point, values),
        found["hess_lag"](point, values, *multipliers),
    )
    for a, b in zip(results, expected, strict=True):
        assert a.shape == b.shape
        assert flat(a) == pytest.approx(flat(b), rel=1e-10, abs=1e-10)


# ---- the choice of a solver ---------------------------------------------------------------------
def test_fatrop_is_ipopt_and_says_so():
    with pytest.warns(DeprecationWarning, match="'fatrop' is solver = 'ipopt'") as told:
        ours = planner("radau", solver="fatrop", options={"time_limit": 20.0})
    assert {w.filename for w in told} == {__file__}  # else nobody would see it
    found = ours()
    assert found.statistics["solver"] == "IPOPT"
    assert found.objective == pytest.approx(planner("radau")().objective, rel=1e-9)


def test_a_choice_that_cannot_be_meant_is_refused():
    refused("choose one of ipopt", planner, "radau", solver="snopt")


# ---- compiled -----------------------------------------------------------------------------------
@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of compiled libraries; zig keeps its own, which takes seconds to fill."""
    from pam_ocp.export.cache import cache_folder

    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache_folder() / "zig"))
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("name", ["shooting", "radau", "design"])
def test_compiled_functions_give_the_same_plan(name, cache):
    expected, found = planner(name)(), planner(name, compiled=True)()
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    assert found.statistics["iterations"] == pytest.approx(expected.statistics["iterations"], abs=3)
    assert found.costates["v"] == pytest.approx(expected.costates["v"], rel=1e-5, abs=1e-6)


def test_what_was_compiled_once_is_not_compiled_again(cache, monkeypatch):
    import pam_ocp.export.compile as fmu_compile

    planner("shooting", compiled=True)
    kept = sorted((cache / "plan").iterdir())
    assert len(kept) == 1

    def never(*_):
        raise AssertionError("compiled again")

    monkeypatch.setattr(fmu_compile, "_compile", never)
    assert planner("shooting", compiled=True)().success
    assert sorted((cache / "plan").iterdir()) == kept


def test_without_a_compiler_the_message_says_what_to_do(cache, monkeypatch):
    import pam_ocp.export.compile as fmu_compile

    monkeypatch.setattr(fmu_compile, "_zig", lambda: None)
    monkeypatch.setattr(fmu_compile, "_local", lambda: None)
    with pytest.raises(InputError, match=r"compiled = True: no C compiler .* pip install 'pam_ocp"):
        planner("radau", compiled=True)


def test_what_ipopt_refuses_has_taken_no_iterations():
    """CasADi leaves any number in ``iter_count`` then, which ended refinements by chance."""
    arrays = dict.fromkeys(("x", "f", "lam_g", "lam_x"), np.zeros(1))
    stats = {"return_status": "Not_Enough_Degrees_Of_Freedom", "success": False, "iterations": {}}
    assert Outcome.of(arrays, {**stats, "iter_count": 282635696}, 0.0).iterations == 0


# ---- warm starts --------------------------------------------------------------------------------
@pytest.mark.parametrize("factor", [1.01, 1.1, 1.5])
def test_a_warm_start_ends_at_the_same_optimum_sooner(slide, factor):
    ours = pam.Planner(slide, STOPS, cyclic="mirrored", method=Collocation(20, 3))
    first = ours()
    cold = ours(values={"mass": 2.0 * factor})
    warm = ours(values={"mass": 2.0 * factor}, guess=first)
    assert warm.objective == pytest.approx(cold.objective, rel=1e-7)
    assert warm.statistics["iterations"] < cold.statistics["iterations"]


@pytest.mark.parametrize(
    ("start", "most", "violation"),
    [
        ("corrector", 1e-1, 1e-4),
        ("restored", 1e-1, 1e-4),
        ("finer", 1e-3, 1e-8),
        ("last", 1e-6, 1e-8),
    ],
)
def test_starts_near_an_optimum_keep_constraints_and_the_residual_they_promise(
    start, most, violation
):
    """A neighbour of another stiffness, whose optimum these must reach too."""
    program = planner("radau")._program
    solver = Ipopt(program)
    other = replace(
        program, problem=replace(program.problem, plant=cart().with_values(stiffness=1.4))
    )
    guess = by_stops(program.problem, program.mesh)
    here, there = solver(program, guess), solver(other, guess)
    found = solver(other, here.w, start, here)
    assert found.success
    numbers = solver.arguments(other, found.w)
    assert max(solver._optimality(numbers, found.w, found.lam_g, found.lam_x)[:2]) <= most
    g = ca.Function("g", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    low, high = other.limits()
    values = np.asarray(g(found.w, other.parameters()), float).ravel()
    assert np.maximum(low - values, values - high).max() <= violation
    place = start in ("corrector", "restored")  # left again: costs need not be the least there
    assert found.objective == pytest.approx(there.objective, rel=1e-4 if place else 1e-6)
    assert abs(here.objective / there.objective - 1) > 1e-4


@pytest.mark.slow
def test_more_starts_keep_the_best(slide, monkeypatch):
    """Valves: many local optima, by their commands. The first of the objectives is that of the
    planner's own start; with openings as inputs the first start finds what six find here.
    """
    plant = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-400N"), 8.5, 0.10, feed=pam.feeds.SpoolValve()
    )
    task = {"stops": [{"x": -0.01}, {"x": 0.012}], "method": pam.Collocation(20, 3)}
    monkeypatch.setattr(ValveOpenings, "of", lambda *_: None)
    own = pam.plan(plant, **task, starts=1)
    best = pam.plan(plant, **task, starts=6)
    found = [end["objective"] for end in best.statistics["starts"] if end["solved"]]
    assert len(found) > 3
    assert found[0] == pytest.approx(own.objective, rel=1e-9)
    assert best.statistics["objective_on_mesh"] == min(found)
    assert best.objective <= own.objective * (1 + 1e-9)
    assert max(found) > min(found) * (1 + 1e-4)  # they differ here, or there were nothing to choose
    monkeypatch.undo()
    opened = pam.plan(plant, **task, starts=1)
    assert opened.verified
    assert opened.objective <= best.objective * (1 + 1e-6)


@pytest.mark.parametrize("starts", [0, 13, 2.0, "all", True])
def test_starts_are_a_whole_number(slide, starts):
    refused(r"starts = .*from 1 to 12", pam.plan, slide, STOPS, starts=starts)


@pytest.mark.parametrize("points", ["radau", "gauss"])
def test_a_plant_of_one_state_is_planned_by_points_of_the_lowest_degree(points):
    """x' = (u - x) / tau from 0.1 to 0.5 with least integral of u^2, by the implicit Euler or the
    midpoint rule: x+ = a x + b u, so that the least norm of u is by hand.
    """
    tau, n, first, last = 0.5, 4, 0.1, 0.5
    plant = pam.Plant("tank")
    x, u = plant.state("level"), plant.input("u", min=-5.0, max=5.0, nominal=1.0)
    plant.der(x, (u - x) / tau)
    asked = {"duration": 1.0, "minimise": "effort", "rest": False, "tolerance": None}
    stops, method = [{"level": first}, {"level": last}], Collocation(n, 1, points=points)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pam.PlanWarning)  # so few intervals are no plan
        plan = pam.plan(plant, stops, method=method, **asked)
    step = 1.0 / n / tau
    late = 1.0 if points == "radau" else 0.5  # where the rate is met
    a, b = (1 - (1 - late) * step) / (1 + late * step), step / (1 + late * step)
    weights = b * a ** np.arange(n)[::-1]
    least = weights * (last - first * a**n) / (weights @ weights)
    assert plan.objective == pytest.approx(np.sum(least**2) / n, rel=1e-7)
    assert plan.trajectory.signals.coefficients[:, 0, 0] == pytest.approx(least, rel=1e-6)
