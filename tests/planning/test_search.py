"""The planner's one method: starts, the walk along the smoothing path, what is kept."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp
from searches import engine_of, search_of, solved

import pam_ocp as pam
from pam_ocp.planning.candidate import Engine
from pam_ocp.planning.continuation import Continuation
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.search import Search
from pam_ocp.planning.settings import SETTINGS, Settings
from pam_ocp.planning.solvers.solver import PROJECTIONS, SETTLED
from pam_ocp.planning.transcription.guess import from_solution
from pam_ocp.planning.transcription.mesh import Collocation
from pam_ocp.planning.transcription.transcription import smoothed

MASS, LAG, RUB, SPEED = 2.0, 0.05, 3.0, 0.02


def rubbing(widest: float = 0.3, relaxed: float = 0.0) -> pam.Plant:
    """m v' = f - RUB tanh(v/SPEED), LAG f' = u - f, smoothed over ``widest`` [m/s] at first, with
    ``relaxed`` times the mass.
    """
    plant = pam.Plant("rubbing")
    heavier = plant.parameter("heavier", 1.0, min=0.0, relaxed=relaxed)
    speed = plant.parameter("speed", SPEED, min=0.0, unit="m/s", widest=widest)
    x, v = plant.state("x", nominal=0.1), plant.state("v", nominal=0.5)
    f = plant.state("f", nominal=10.0)
    u = plant.input("u", min=-20.0, max=20.0, nominal=10.0)
    plant.der(x, v)
    plant.der(v, (f - RUB * ca.tanh(v / speed)) / MASS / heavier)
    plant.der(f, (u - f) / LAG)
    return plant


def planner(relaxed: float = 0.0, widest: float = 0.3, **wish: Any) -> Planner:
    wish = {"duration": 0.6, "minimise": "effort", "method": Collocation(8, 3), **wish}
    return Planner(rubbing(widest, relaxed), [{"x": 0.0}, {"x": 0.1}], **wish)


@cache
def usual(widest: float = 0.3) -> pam.planning.Plan:
    """The plan that nothing has disturbed."""
    return planner(widest=widest)()


def places(plan: pam.planning.Plan) -> list[float]:
    """Of the path that led on, in their order."""
    found = []
    for s in plan.statistics["stages"]:
        place = re.match(r"place ([\d.]+) of the path", s["reason"])
        if s["name"] == "smoothing" and s["solved"] and place:
            found.append(float(place.group(1)))
    return found


def ends_at(plan: pam.planning.Plan) -> np.ndarray:
    """The end of SciPy's integration of the inputs, held on each interval."""
    signals = plan.trajectory.signals
    x = np.zeros(3)
    for begin, end, u in zip(
        signals.breaks[:-1], signals.breaks[1:], signals.coefficients[:, 0, 0], strict=True
    ):

        def rate(t: float, z: np.ndarray, u: float = u) -> list[float]:
            return [z[1], (z[2] - RUB * np.tanh(z[1] / SPEED)) / MASS, (u - z[2]) / LAG]

        x = solve_ivp(rate, (begin, end), x, method="Radau", rtol=1e-9, atol=1e-11).y[:, -1]
    return x


def test_the_path_leads_from_the_widest_smoothing_to_the_plants_own() -> None:
    plan = usual()
    assert plan.verified
    path = places(plan)
    assert path == sorted(path)
    assert path[-1] == 1.0
    assert path[0] <= SETTINGS.step
    assert max(np.diff([0.0, *path])) <= SETTINGS.step + 5e-3  # as printed
    assert plan._solved.program.problem.plant.variable("speed").start == SPEED
    scale = np.array([0.1, 0.5, 10.0])
    assert np.abs((ends_at(plan) - [0.1, 0.0, 0.0]) / scale).max() < 1.1e-3


@pytest.mark.parametrize("relaxed", [0.25, 50.0])
def test_what_is_relaxed_is_led_along_and_left_where_nothing_is_found_with_it(
    relaxed: float,
) -> None:
    """50 times the mass would take 4 m s / t^2 = 111 N, and there are 20."""
    plan = planner(relaxed)()
    assert plan.verified
    assert places(plan)[-1] == 1.0
    assert plan._solved.program.problem.plant.variable("heavier").start == 1.0
    assert plan.objective == pytest.approx(usual().objective, rel=1e-4)
    starts = [s for s in plan.statistics["stages"] if s["name"] == "starts"]
    assert starts[0]["solved"] is (relaxed < 1.0)
    assert starts[-1]["solved"]


@pytest.mark.parametrize("solved", [True, False])
def test_a_smooth_plant_is_relaxed_where_its_own_program_is_not_solved(
    solved: bool, monkeypatch: Any
) -> None:
    search = Search._solved

    def own_only(self: Search, *starts: Any) -> list[Any]:
        return search(self, *starts) if solved or self.place < 1.0 else []

    monkeypatch.setattr(Search, "_solved", own_only)
    plan = planner(0.25, widest=0.0)()
    assert plan.verified
    assert places(plan)[-1:] == ([] if solved else [1.0])
    monkeypatch.undo()
    assert plan.objective == pytest.approx(usual(0.0).objective, rel=1e-4)


def test_relaxed_values_go_to_their_own_evenly_in_their_logarithms() -> None:
    plant = rubbing(widest=0.32, relaxed=16.0)
    for relaxed, heavier in ((True, 4.0), (False, 1.0)):
        half = smoothed(plant, 0.5, relaxed)
        assert half.variable("heavier").start == pytest.approx(heavier)
        assert half.variable("speed").start == pytest.approx(0.08)  # sqrt(0.32 * 0.02)
        assert smoothed(plant, 1.0, relaxed).variable("heavier").start == 1.0


def fail_where(monkeypatch: Any, lost: Callable[[float, str, tuple[str, str]], bool]) -> None:
    """Solves are lost where ``lost`` says so, of their place, their start and why they are made."""
    solve = Engine.solve

    def sometimes(
        engine: Engine, program: Any, place: float, guess: Any, start: str, why: Any, *rest: Any
    ) -> Any:
        found = solve(engine, program, place, guess, start, why, *rest)
        if not lost(place, start, why):
            return found
        return replace(found, outcome=replace(found.outcome, success=False, status="lost"))

    monkeypatch.setattr(Engine, "solve", sometimes)


def fail_once(monkeypatch: Any, beyond: float) -> list[float]:
    """The first solve at a place beyond this one is lost; that place, once it came."""
    refused = list[float]()

    def lost(place: float, *_: Any) -> bool:
        if refused or place <= beyond:
            return False
        refused.append(place)
        return True

    fail_where(monkeypatch, lost)
    return refused


def test_a_place_that_is_not_reached_is_approached_in_shorter_steps(monkeypatch: Any) -> None:
    refused = fail_once(monkeypatch, 0.4)
    plan = planner()()
    assert plan.verified
    path = places(plan)
    first = next(p for p in path if 0.3 < p < refused[0])
    assert first - 0.3 == pytest.approx(SETTINGS.shrink * SETTINGS.step, abs=6e-3)  # as printed


@pytest.mark.parametrize("projection", ["feasible", "nearest"])
@pytest.mark.slow
def test_where_costs_lead_nowhere_the_next_motion_that_keeps_the_constraints_goes_on(
    projection: str, monkeypatch: Any
) -> None:
    def lost(place: float, start: str, why: tuple[str, str]) -> bool:
        at = re.match(r"place ([\d.]+) of the path", why[1])
        return bool(at) and 0.5 < float(at[1]) < 1.0 and start != projection

    fail_where(monkeypatch, lost)
    plan = planner()()
    assert plan.verified
    assert ends_at(plan) == pytest.approx([0.1, 0.0, plan.trajectory["f"][-1]], abs=2e-4)
    by = {s["start"] for s in plan.statistics["stages"] if s["reason"].startswith("place 0.6")}
    assert projection in by


def test_projections_keep_the_constraints_and_end_near_their_guess() -> None:
    quick = solved(planner(widest=0.0, minimise="time", duration=(0.05, 2.0)))
    slower = engine_of(planner(widest=0.0, duration=0.4))
    program = slower.first
    guess = from_solution(program.problem, program.mesh, quick.solution)  # inputs at their limits
    values = ca.Function("g", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    for start in PROJECTIONS:
        found = slower.solve(program, 1.0, guess, start, ("test", "a test")).outcome
        assert found.success
        low, high = program.limits()
        g = np.asarray(values(found.w, program.parameters())).ravel()
        assert np.max(np.maximum(low - g, g - high)) < 1e-7
        least, most = program.bounds()
        assert np.max(np.maximum(least - found.w, found.w - most)) < 1e-7
        assert np.max(np.abs(found.w - guess)) < 2.0


def test_where_the_path_is_not_led_to_its_end_there_is_a_plan_by_shooting(monkeypatch: Any) -> None:
    fail_where(monkeypatch, lambda place, _, why: place > 0.7 and why[0] == "smoothing")
    plan = planner()()
    monkeypatch.undo()
    assert plan.verified
    assert max(places(plan)) < 1.0
    scale = np.array([0.1, 0.5, 10.0])
    assert np.abs((ends_at(plan) - [0.1, 0.0, 0.0]) / scale).max() < 1.1e-3
    best = usual().objective
    assert best * (1 - 1e-4) < plan.objective < 1.2 * best


def test_a_plan_by_shooting_gives_way_to_the_cheaper_one_at_the_end_of_the_path(
    monkeypatch: Any,
) -> None:
    fail_once(monkeypatch, 0.65)
    plan = planner()()
    stages = [(s["name"], s["solved"]) for s in plan.statistics["stages"]]
    assert ("shooting", True) in stages
    assert places(plan)[-1] == 1.0
    monkeypatch.undo()
    assert plan.objective == pytest.approx(usual().objective, rel=1e-4)


def test_a_path_whose_work_is_spent_says_so(monkeypatch: Any) -> None:
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", replace(SETTINGS, work=1e-3))
    refused("the iterations that are allowed ended on the way", planner(), error=pam.PlanError)


def test_a_search_ends_where_its_work_does(monkeypatch: Any) -> None:
    """In the midst of a solve: with the best so far, whose verdict says why; or without, in words.
    A time limit takes the place of that bound.
    """
    plant = pam.HangingLoad("DMSP-20-200N", 8.0, feed=pam.feeds.Regulator())
    wish: dict[str, Any] = {"duration": 0.3, "minimise": "work", "method": Collocation(40, 3)}
    stops = [{"x": 0.01}, {"x": 0.03}]
    whole = pam.plan(plant, stops, **wish)
    first = whole.statistics["stages"][0]["work"]
    assert 0.0 < first < sum(s["work"] for s in whole.statistics["stages"]) < SETTINGS.work
    little = replace(SETTINGS, most_work=1.5 * first)
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", little)
    with pytest.warns(pam.PlanWarning, match="was spent; time_limit= allows more"):
        plan = pam.plan(plant, stops, **wish)  # ended on the way to the mesh that was asked for
    assert not plan.verified
    assert plan.solved
    assert sum(s["work"] for s in plan.statistics["stages"]) <= little.most_work
    assert pam.plan(plant, stops, **wish, time_limit=100.0).verified
    less = replace(SETTINGS, most_work=0.5 * first)
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", less)
    with pytest.raises(pam.PlanError, match="work that a search may take, a few minutes, was"):
        pam.plan(plant, stops, **wish)


@pytest.mark.parametrize("found", ["nothing", "another motion"])
def test_where_a_mesh_for_the_costs_leads_nowhere_the_tolerance_is_met_all_the_same(
    found: str, monkeypatch: Any
) -> None:
    usual = Engine.refined
    left: list[Any] = []

    def refined(self: Engine, c: Any, mesh: Any, why: str, start: Any = "near") -> Any:
        better = usual(self, c, mesh, why, start)
        if not why.startswith("objective"):
            return better
        left.append(c)
        other = {"success": False} if found == "nothing" else {"objective": 3 * better.objective}
        outcome = replace(better.solved.outcome, **other)
        return replace(better, solved=replace(better.solved, outcome=outcome))

    monkeypatch.setattr(Engine, "refined", refined)
    monkeypatch.setattr(Continuation, "_beside", lambda self, failed, c: failed)
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", replace(SETTINGS, corrections=0))
    plant = pam.HangingLoad("DMSP-20-200N", 8.0, feed=pam.feeds.Regulator())
    wish: dict[str, Any] = {"duration": 0.3, "minimise": "work", "method": Collocation(10, 3)}
    plan = pam.plan(plant, [{"x": 0.01}, {"x": 0.03}], **wish, starts=1)
    assert plan.verified
    assert left
    assert all(c is left[0] for c in left)
    assert left[0].check.miss > 1e-3


def test_the_same_motion_in_commands_is_a_candidate_where_no_solver_gets_there(
    monkeypatch: Any,
) -> None:
    """From openings, by the inverse of the dead zone."""
    fail_where(monkeypatch, lambda place, start, why: why[1] == "back to commands")
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), 2.0, 0.1, feed=pam.feeds.SpoolValve())
    plan = pam.plan(plant, [{"x": -0.01}, {"x": 0.01}], method=Collocation(15, 3), starts=1)
    assert plan.verified
    assert all(s["name"].startswith("valve openings") for s in plan.statistics["stages"][:2])
    assert not any(s["name"] == "starts" for s in plan.statistics["stages"])


@pytest.mark.slow
def test_more_starts_are_never_worse_than_one() -> None:
    """The usual guess leads nowhere here, another one further than the other starts."""
    muscle, losses = pam.muscle("DMSP-20-400N"), (pam.losses.BoucWen(10.7, 0.0073),)
    plant = pam.RegulatedLoad(muscle, 24.0, gain=1.3e6, lag=0.088, losses=losses)
    stops = [{"x": 0.0546}, {"x": 0.0731}]
    one, four = (pam.plan(plant, stops, starts=starts) for starts in (1, 4))
    assert one.verified
    assert four.verified
    assert four.objective <= one.objective * (1 + 1e-6)


def at_the_end() -> tuple[Any, Any, Any]:
    """(engine, continuation, a candidate of the user's own problem)."""
    search = search_of(planner())
    return search.engine, search.continuation, search._candidate(solved(planner()), 1.0)


@pytest.mark.parametrize(
    ("reason", "cost", "taken"),
    [
        ("place 1.00", 0.5, True),
        ("place 1.00", 2.0, False),
        ("a mesh", 1.005, True),
        ("a mesh", 1.1, False),
    ],
)
def test_what_a_solver_had_where_its_work_ended_is_taken_where_it_is_worth_it(
    reason: str, cost: float, taken: bool, monkeypatch: Any
) -> None:
    """At the end of the path, and on a finer mesh: the motion next to where it stopped."""
    engine, continuation, c = at_the_end()

    def solve(
        program: Any, place: float, guess: Any, start: str, why: Any, warm: Any = None
    ) -> Any:
        late = start in ("last", "near", "finer")
        objective = c.objective * (cost if warm is not None and warm.objective == 7.0 else 1.0)
        given = {"success": not late, "status": "Maximum_Iterations_Exceeded" if late else SETTLED}
        outcome = replace(c.solved.outcome, objective=7.0 if late else objective, **given)
        return replace(c.solved, outcome=outcome)

    monkeypatch.setattr(engine, "solve", solve)
    if reason == "a mesh":
        finer = continuation._finer(c, [(engine.first.mesh, reason)])
    else:
        finer = continuation._further(c, 1.0, last=False)
    assert finer is not None
    assert finer.objective == pytest.approx(c.objective * (cost if taken else 1.0))


@pytest.mark.parametrize(
    ("missed", "finer", "taken"), [(0.05, 0.98, 0.98), (0.05, 1.4, 1.26), (0.5, 0.98, 1.26)]
)
def test_a_finer_mesh_that_costs_more_is_solved_by_short_steps_too(
    missed: float, finer: float, taken: float, monkeypatch: Any
) -> None:
    """Where the coarser mesh, off by ``missed`` in all, had resolved its motion."""
    engine, continuation, c = at_the_end()
    c.__dict__["errors"] = [missed]

    def solve(
        program: Any, place: float, guess: Any, start: str, why: Any, warm: Any = None
    ) -> Any:
        costs = {"near": 1.26, "finer": finer}[start]
        return replace(c.solved, outcome=replace(c.solved.outcome, objective=costs * c.objective))

    monkeypatch.setattr(engine, "solve", solve)
    found = continuation._finer(c, [(engine.first.mesh, "costs")])
    assert found is not None
    assert found.objective == pytest.approx(taken * c.objective)


@pytest.mark.parametrize(("costs", "starts"), [(1.0, ["feasible"]), (5.0, ["feasible", "finer"])])
def test_the_motion_next_to_a_flat_optimum_is_taken_where_it_is_the_same(
    costs: float, starts: list[str], monkeypatch: Any
) -> None:
    """From one mesh to the next; a projection onto the constraints may end at another motion."""
    task = planner()
    near = solved(task)
    near = replace(near, outcome=replace(near.outcome, status=SETTLED))
    engine, asked = engine_of(task), []
    engine._until = np.inf

    def solve(program: Any, place: float, guess: Any, start: str, why: Any) -> Any:
        asked.append(start)
        objective = near.outcome.objective * (costs if start == "feasible" else 1.0)
        return replace(near, outcome=replace(near.outcome, objective=objective))

    monkeypatch.setattr(engine, "solve", solve)
    found = engine.onto(engine.first, near, 1.0, ("mesh", "a test"))
    assert asked == starts
    assert found.outcome.objective == pytest.approx(near.outcome.objective)


def test_work_that_is_spent_ends_a_search_with_what_it_has(monkeypatch: Any) -> None:
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", replace(SETTINGS, work=1e-3))
    plant = pam.HangingLoad("DMSP-20-200N", 8.0, feed=pam.feeds.SpoolValve())
    plan = pam.plan(plant, [{"x": 0.01}, {"x": 0.03}], method=Collocation(15, 3))
    assert plan.verified
    assert len(plan.statistics.get("starts", ())) < SETTINGS.several


def test_a_search_that_is_led_to_no_end_says_so(monkeypatch: Any) -> None:
    monkeypatch.setattr(Continuation, "led", lambda self, c: None)
    refused("no way from wider smoothing to the plant's own terms", planner(), error=pam.PlanError)


def test_both_ends_of_a_dwell_are_looked_at() -> None:
    """On a mesh that is far too coarse the load arrives with a larger acceleration than it leaves
    with, or ends with.
    """
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=pam.feeds.Regulator(), damping=30.0)
    stops = [{"x": 0.01}, pam.Stop({"x": 0.03}, dwell=0.2), {"x": 0.02}]
    with pytest.warns(pam.PlanWarning):
        plan = pam.plan(plant, stops, method=Collocation(4, 2), tolerance=None)
    motion, off = plan.replay.trajectory, []
    for end, x in zip(np.cumsum(plan.durations), (0.03, 0.03, 0.02), strict=True):
        k = int(np.argmin(abs(motion.t - end)))
        here = [motion[v.name][k] for v in plant.states], [motion["muscle.command"][k]]
        acceleration = float(plant.function(*here, plant.vector("parameter"))[0][1])
        off.append(max(abs(acceleration), abs(motion["x"][k] - x) / 0.01, abs(here[0][1]) / 0.1))
    assert off[0] > 1.2 * max(off[1:])
    assert plan.replay.missed == pytest.approx(off[0], rel=1e-6)
    # the points of the mesh between both keep the dwell's band, the motion there does not
    band, t = 1e-3 * plant.variable("x").nominal, plan.trajectory.t[9:17]
    assert t[0] > plan.durations[0]
    assert t[-1] == pytest.approx(sum(plan.durations[:2]))
    beyond = (abs(np.interp(t, motion.t, motion["x"]) - 0.03) - band) / band
    assert abs(plan.trajectory["x"][9:17] - 0.03).max() <= band * (1 + 1e-6)
    assert plan.replay.at_points == pytest.approx(beyond.max(), rel=1e-6)


# ---- what is kept --------------------------------------------------------------------------------
def fake(miss: float, objective: float) -> Any:
    replay = SimpleNamespace(objective=objective)
    solved = SimpleNamespace(program=SimpleNamespace(nlp=None))
    return SimpleNamespace(
        check=SimpleNamespace(miss=miss, replay=replay), solved=solved, mesh=None
    )


@pytest.mark.parametrize(
    ("kept", "other", "better"),
    [
        ((1e-4, 2.0), (1e-4, 1.0), True),  # both verified: the cheaper
        ((1e-4, 1.0), (1e-5, 2.0), False),
        ((1e-4, 2.0), (5e-2, 1.0), False),  # what is not verified never replaces what is
        ((5e-2, 1.0), (1e-4, 2.0), True),
        ((5e-2, 1.0), (3e-2, 2.0), True),  # neither: the nearer
        ((5e-2, 2.0), (6e-2, 1.0), False),
    ],
)
def test_a_verified_plan_is_replaced_by_a_verified_and_better_one_alone(
    kept: tuple[float, float], other: tuple[float, float], better: bool
) -> None:
    search = search_of(planner())
    first, second = fake(*kept), fake(*other)
    search._take(first)
    search._take(second)
    assert search.found.best is (second if better else first)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
def test_more_starts_are_never_worse(seed: int) -> None:
    """Valves and tendons, where local optima are many."""
    rng = np.random.default_rng([seed, 20261126])
    muscle = pam.muscle(str(rng.choice(["DMSP-20-200N", "DMSP-20-400N", "DMSP-10-250"])))
    feed = pam.feeds.SpoolValve() if rng.uniform() < 0.5 else pam.feeds.OnOffValves()
    mass, travel = rng.uniform(1.0, 6.0), rng.uniform(0.03, 0.1) * muscle.rest_length
    plant: pam.Plant
    if rng.uniform() < 0.5:
        plant, begin = pam.AntagonisticSlide(muscle, mass, feed=feed), -travel / 2
    else:
        plant, begin = pam.HangingLoad(muscle, mass, feed=feed), 0.05 * muscle.rest_length
    task: dict[str, Any] = {"method": Collocation(20, 3)}
    stops = [{"x": begin}, {"x": begin + travel}]
    one, four = (pam.plan(plant, stops, **task, starts=n) for n in (1, 4))
    assert four.verified or not one.verified
    assert four.objective <= one.objective * (1 + 1e-9)


def test_all_numbers_of_the_method_stand_in_one_place_and_say_why() -> None:
    source = Path(pam.__file__).parent.joinpath("planning/settings.py").read_text("utf-8")
    names = [f.name for f in fields(Settings)]
    assert len(names) <= 25
    for name in names:
        assert re.search(rf'\n    {name}: (int|float) = [^\n]+\n    """', source), name
