"""Motions that are brought to their stops by exact runs where a mesh does not resolve them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.planning import refine
from pam_ocp.planning.approach import Approach
from pam_ocp.planning.checked import checked
from pam_ocp.planning.landing import landed
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.refine import Refinement
from pam_ocp.planning.run import Run
from pam_ocp.planning.solvers.backend import Backend
from pam_ocp.planning.transcription.mesh import Collocation

MASS, LAG, RUB, SPEED = 2.0, 0.05, 3.0, 0.02


def rubbing(widest=0.0):
    """m v' = f - RUB tanh(v/SPEED), LAG f' = u - f: kinks that six intervals do not resolve.

    widest : where the way of plans begins [m/s].
    """
    plant = pam.Plant("rubbing")
    speed = plant.parameter("speed", SPEED, min=0.0, unit="m/s", widest=widest)
    x, v = plant.state("x", nominal=0.1), plant.state("v", nominal=0.5)
    f = plant.state("f", nominal=10.0)
    u = plant.input("u", min=-20.0, max=20.0, nominal=10.0)
    plant.der(x, v)
    plant.der(v, (f - RUB * ca.tanh(v / speed)) / MASS)
    plant.der(f, (u - f) / LAG)
    return plant


def coarse(stops=({"x": 0.0}, {"x": 0.1}), control="constant", **more):
    wish = {"duration": 0.6, "minimise": "effort", **more}
    planner = Planner(rubbing(), list(stops), method=Collocation(8, 3, control), **wish)
    run = Run(planner._program, Backend(), planner._solver)
    return run.solve(None)


def flown(solution):
    """The end of SciPy's integration of the inputs, held or linear on each interval."""
    x, breaks = solution.states[0], solution.inputs.breaks
    for k, powers in enumerate(solution.inputs.coefficients[:, :, 0]):

        def rate(t, z, begin=breaks[k], powers=powers):
            u = np.polynomial.polynomial.polyval(t - begin, powers)
            return [z[1], (z[2] - RUB * np.tanh(z[1] / SPEED)) / MASS, (u - z[2]) / LAG]

        ends = breaks[k : k + 2]
        x = solve_ivp(rate, ends, x, method="Radau", rtol=1e-9, atol=1e-11).y[:, -1]
    return x


def test_a_landed_motion_ends_where_it_shall():
    found = coarse()
    before = flown(found.solution)
    assert max(abs(before - [0.1, 0.0, 0.0]) / [0.1, 0.5, 10.0]) > 2e-3
    closed = landed(found, 1e-3)
    after = flown(closed.solution)
    # at rest the load's acceleration vanishes: the force is that of the friction, none
    assert max(abs(after - [0.1, 0.0, 0.0]) / [0.1, 0.5, 10.0]) < 1.1e-3
    assert after == pytest.approx(closed.solution.states[-1], abs=1e-6)
    u = closed.solution.inputs.coefficients[:, 0, 0]
    assert np.all((u >= -20.0) & (u <= 20.0))
    moved = np.abs(u - found.solution.inputs.coefficients[:, 0, 0])
    assert 0 < moved.max() < 3.0
    replay = checked(closed).replay
    assert replay.error < 1e-6
    assert replay.violation < 1e-3


def test_linear_inputs_stay_continuous_and_inside_their_bounds():
    found = coarse(control="linear")
    before = flown(found.solution)
    assert max(abs(before - [0.1, 0.0, 0.0]) / [0.1, 0.5, 10.0]) > 1.5e-3
    closed = landed(found, 1e-3)
    after = flown(closed.solution)
    assert max(abs(after - [0.1, 0.0, 0.0]) / [0.1, 0.5, 10.0]) < 1.1e-3
    inputs = closed.solution.inputs
    lengths = np.diff(inputs.breaks)
    ends = inputs.coefficients[:, 0, 0] + inputs.coefficients[:, 1, 0] * lengths
    begins = inputs.coefficients[:, 0, 0]
    assert ends[:-1] == pytest.approx(begins[1:], abs=1e-6)
    assert np.all(np.abs([ends, begins]) <= 20.0)
    assert np.abs(ends - begins).max() > 0.1  # not held


def test_the_objective_is_that_of_the_landed_motion():
    found = coarse()
    closed = landed(found, 1e-3)
    assert closed.outcome.objective == pytest.approx(checked(closed).replay.objective, rel=1e-6)
    assert closed.outcome.objective != pytest.approx(found.outcome.objective, rel=1e-6)


def test_stops_between_are_kept_too():
    found = coarse(({"x": 0.0}, {"x": 0.1}, {"x": 0.03}), duration=1.2)
    closed = landed(found, 1e-3)
    assert checked(closed).replay.missed < 1e-3


def test_a_cycle_ends_where_it_begins():
    found = coarse(cyclic=True, duration=0.6)
    before = flown(found.solution)
    scale = [0.1, 0.5, 10.0]
    assert max(abs(before - found.solution.states[0]) / scale) > 2e-3
    closed = landed(found, 1e-3)
    begin, middle = closed.solution.states[0], checked(closed)
    assert max(abs(flown(closed.solution) - begin) / scale) < 1.1e-3
    assert middle.replay.missed < 1e-3  # both stops, and the closing
    assert middle.replay.error < 1e-6


def test_budgets_are_left_alone():
    assert landed(coarse(budgets={"effort": (None, 5.0)}), 1e-3) is None


def blocked(monkeypatch, part):
    """A way from a wide rounding to the plant's own whose places beyond a part are not found."""
    planner = Planner(
        rubbing(widest=0.3),
        [{"x": 0.0}, {"x": 0.1}],
        method=Collocation(15, 3),
        duration=0.6,
        minimise="effort",
    )
    run = Run(planner._program, Backend().near())
    (wide, *_), _ = run.several(1, wide=True)
    onward = Approach._onward

    def ends(self, there):
        found = onward(self, there)
        if there < part:
            return found
        return replace(found, outcome=replace(found.outcome, success=False, status="lost"))

    monkeypatch.setattr(Approach, "_onward", ends)
    way = Approach(run, wide, run.backend)
    assert way.solved() is None
    return way


def test_a_way_that_is_blocked_near_its_end_is_landed(monkeypatch):
    """By SciPy the motion rests at its stop under the narrow kink, which no solve has met."""
    way, scale = blocked(monkeypatch, 0.8), [0.1, 0.5, 10.0]
    assert max(abs(flown(way._here.solution) - [0.1, 0.0, 0.0]) / scale) > 2e-3
    found = way.landed(1e-3)
    assert found.program.problem.plant.variable("speed").start == SPEED
    assert max(abs(flown(found.solution) - [0.1, 0.0, 0.0]) / scale) < 1.1e-3


def test_a_way_that_has_only_begun_is_not_landed(monkeypatch):
    assert blocked(monkeypatch, 0.3).landed(1e-3) is None


@pytest.mark.parametrize(("dearer", "takes"), [(1.1e-2, True), (0.9e-2, False)])
def test_what_costs_more_than_it_may_is_not_taken(monkeypatch, dearer, takes):
    """Landed where finer meshes are still to be tried, at 1 % more than the mesh's optimum."""
    found = coarse()
    refinement = Refinement(checked(found), np.inf, Backend())
    refinement.tolerance = 1e-3
    good = landed(found, 1e-3)
    costly = replace(good.outcome, objective=1.01 * found.outcome.objective)
    monkeypatch.setattr(refine, "landed", lambda *_: replace(good, outcome=costly))
    assert refinement._landed(refinement.best, dearer) is takes
