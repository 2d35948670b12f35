"""Planning again for other numbers, and on many intervals: what is carried over."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import pushed

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.planning.candidate import on_mesh
from pam_ocp.planning.transcription.solution import unpack
from pam_ocp.planning.transcription.transcription import transcribe

FAR = [{"x": 0.0}, {"x": 0.3}]


@pytest.fixture(scope="module")
def cart() -> pam.Plant:
    """x'' = u / mass: everything about its motions is known."""
    return pushed(2.0, mass=1.0)


def test_a_fixed_duration_may_change_and_the_mesh_stays(cart):
    """The least integral of u^2 is 12 d^2 / T^3 on free inputs; a motion of another duration is
    that of a plan that was built for it.
    """
    task = {"minimise": "effort", "method": Collocation(12, 3)}
    planner = pam.Planner(cart, FAR, duration=1.0, **task)
    first = planner()
    again = planner(duration=1.6, guess=first)
    built = pam.plan(cart, FAR, duration=1.6, **task)
    assert again.verified
    assert again.duration == pytest.approx(1.6)
    assert [len(m.intervals) for m in again.meshes] == [12]
    assert again.objective == pytest.approx(built.objective, rel=1e-7)
    assert again.objective == pytest.approx(12 * 0.3**2 / 1.6**3, rel=0.02)


def test_many_intervals_are_solved_from_few_and_are_those_asked_for(cart):
    """Minimum time from rest to rest: 2 sqrt(d m / u)."""
    plan = pam.plan(cart, FAR, method=Collocation(200, 2))
    assert plan.verified
    assert [len(m.intervals) for m in plan.meshes] == [200]
    assert plan.duration == pytest.approx(2 * np.sqrt(0.3 / 2.0), rel=1e-6)
    assert len(plan.log) - 1 < plan.statistics["iterations"]  # the coarse mesh's count


def test_a_finer_mesh_is_that_of_the_next_plan_too():
    """Degree 1 leaves too much: the first plan is refined, its neighbour begins there."""
    plant = pam.Plant("pendulum")
    x = plant.state("x", unit="rad")
    v = plant.state("v", unit="rad/s", nominal=5.0)
    u = plant.input("u", unit="N.m", min=-60.0, max=60.0, nominal=10.0)
    inertia = plant.parameter("inertia", 1.0, unit="kg.m2", min=0.1, max=10.0)
    plant.der(x, v)
    plant.der(v, (u - 40.0 * ca.sin(x)) / inertia)
    stops = [{"x": 0.0}, {"x": 1.0}]
    planner = pam.Planner(plant, stops, method=Collocation(20, 1), duration=1.0, minimise="effort")
    first = planner()
    assert first.verified
    assert first.meshes[-1] != first.meshes[0]
    near = planner(values={"inertia": 1.001}, guess=first)
    assert near.verified
    assert near.meshes == (first.meshes[0], first.meshes[-1])
    assert near._solved.program.nlp is first._solved.program.nlp
    cold = planner(values={"inertia": 1.001})
    assert near.statistics["iterations"] < cold.statistics["iterations"]
    assert near.objective == pytest.approx(cold.objective, rel=1e-3)


def test_meshes_that_differ_by_margins_share_expressions_and_keep_their_own_limits(cart):
    planner = pam.Planner(cart, FAR, method=Collocation(5, 4, "polynomial", guarded=False))
    problem, mesh = planner._program.problem, planner._program.mesh

    def watching(*margins: float):
        each = zip(mesh.intervals, margins * (len(mesh.intervals) // len(margins)), strict=True)
        return replace(mesh, intervals=tuple(replace(i, watched=(("u", m),)) for i, m in each))

    known = transcribe(problem, watching(0.0))
    shared = on_mesh(problem, watching(0.1), [known])
    own = transcribe(problem, watching(0.1))
    assert shared.nlp is known.nlp
    for ours, theirs in zip(shared.limits(), own.limits(), strict=True):
        assert np.array_equal(ours, theirs)
    assert not np.array_equal(known.limits()[1], own.limits()[1])
    assert on_mesh(problem, mesh, [known]).nlp is not known.nlp
    # intervals that share their rows can have but one margin
    several = watching(0.1, 0.2, 0.1, 0.2, 0.1)
    found, own = on_mesh(problem, several, [known, shared]), transcribe(problem, several)
    for ours, theirs in zip(found.limits(), own.limits(), strict=True):
        assert np.array_equal(ours, theirs)


def test_a_program_serves_no_other_plant_and_no_other_objective(cart):
    """Openings in place of commands have the same stops: of a cycle a program was taken for that of
    another plant, with other inputs."""
    twin = pam.Plant("cart")
    x, v = twin.state("x", unit="m"), twin.state("v", unit="m/s")
    push, pull = (twin.input(n, unit="N", min=0.0, max=2.0) for n in ("push", "pull"))
    twin.der(x, v)
    twin.der(v, push - pull)
    mine, other = (
        pam.Planner(p, FAR, method=Collocation(5, 4, "polynomial", guarded=False))._program
        for p in (cart, twin)
    )
    assert other.problem.plant is twin
    goal, u = mine.problem.objective, mine.problem.plant.u
    dearer = replace(goal, integrand=goal.integrand + ca.sumsqr(u))
    for problem in (other.problem, replace(mine.problem, objective=dearer)):
        found = on_mesh(problem, mine.mesh, [mine])
        assert found.nlp is not mine.nlp
        assert found.problem is problem
    assert on_mesh(mine.problem, mine.mesh, [other, mine]).nlp is mine.nlp


def test_unknowns_are_unpacked_interval_by_interval(cart):
    """Against a loop over the intervals, of several degrees, some joined."""
    planner = pam.Planner(cart, FAR, method=Collocation(4, 2))
    problem, mesh = planner._program.problem, planner._program.mesh
    kinds = [(3, False), (2, False), (2, True), (5, True)]
    parts = tuple(
        replace(i, degree=d, joined=j) for i, (d, j) in zip(mesh.intervals, kinds, strict=True)
    )
    mesh = replace(mesh, intervals=parts)
    w = np.random.default_rng(3).uniform(0.5, 1.0, transcribe(problem, mesh).nlp["x"].numel())
    found = unpack(problem, mesh, w)
    duration = float(w[-1 - problem.m.numel()] * problem.time_nominals[0])
    states, inputs, times, at = [w[:2]], [], [0.0], 2
    for k, (degree, joined) in enumerate(kinds):
        for tau in mesh.form.state_taus(degree):
            states.append(w[at : at + 2])
            times.append(duration * (k + tau) / 4)
            at += 2
        inputs.append(inputs[-1] if joined else w[at])
        at += 1
    assert found.states == pytest.approx(np.array(states))
    assert found.t == pytest.approx(np.array(times))
    assert found.inputs.coefficients[:, 0, 0] == pytest.approx(np.array(inputs))


def test_a_motion_that_is_a_polynomial_has_no_defects_whatever_the_degrees(cart):
    """x = t^2 / 2 under a force of 1 N, unknown by unknown, on intervals of several degrees."""
    planner = pam.Planner(cart, FAR, method=Collocation(4, 2))
    problem, mesh = planner._program.problem, planner._program.mesh
    degrees = [3, 2, 2, 5]
    parts = tuple(replace(i, degree=d) for i, d in zip(mesh.intervals, degrees, strict=True))
    program = transcribe(problem, replace(mesh, intervals=parts))
    nominal = cart.vector("state", attribute="nominal")
    force = cart.variable("u").nominal
    duration, w = 0.8, [0.0, 0.0]
    for k, degree in enumerate(degrees):
        for tau in mesh.form.state_taus(degree):
            t = duration * (k + tau) / 4
            w += [t**2 / 2 / nominal[0], t / nominal[1]]
        w.append(1.0 / force)
    rows = ca.Function("g", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])

    def defects(last: float) -> float:
        values = np.array([*w, last / problem.time_nominals[0], *np.zeros(problem.m.numel())])
        g = np.asarray(rows(values, program.parameters())).ravel()
        kinds = np.concatenate([np.full(row.size, row.kind) for row in program.rows])
        return float(np.abs(g[kinds == "defect"]).max())

    assert defects(duration) == pytest.approx(0.0, abs=1e-13)
    assert defects(1.1 * duration) > 1e-2
