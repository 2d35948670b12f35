"""Motions that are brought to their stops by exact runs where a mesh does not resolve them."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.planning.checked import checked
from pam_ocp.planning.landing import landed
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.run import Run
from pam_ocp.planning.solvers.backend import Backend
from pam_ocp.planning.transcription.mesh import Collocation

MASS, LAG, RUB, SPEED = 2.0, 0.05, 3.0, 0.02


def rubbing():
    """m v' = f - RUB tanh(v/SPEED), LAG f' = u - f: kinks that six intervals do not resolve."""
    plant = pam.Plant("rubbing")
    x, v = plant.state("x", nominal=0.1), plant.state("v", nominal=0.5)
    f = plant.state("f", nominal=10.0)
    u = plant.input("u", min=-20.0, max=20.0, nominal=10.0)
    plant.der(x, v)
    plant.der(v, (f - RUB * ca.tanh(v / SPEED)) / MASS)
    plant.der(f, (u - f) / LAG)
    return plant


def coarse(stops=({"x": 0.0}, {"x": 0.1}), **more):
    wish = {"duration": 0.6, "minimise": "effort", **more}
    planner = Planner(rubbing(), list(stops), method=Collocation(8, 3), **wish)
    run = Run(planner._program, Backend(), planner._solver)
    return run.solve(None)


def flown(solution):
    """The end of SciPy's integration of the inputs, held on each interval."""
    x, breaks = solution.states[0], solution.inputs.breaks
    for k, u in enumerate(solution.inputs.coefficients[:, 0, 0]):
        x = solve_ivp(
            lambda t, z, u=u: [z[1], (z[2] - RUB * np.tanh(z[1] / SPEED)) / MASS, (u - z[2]) / LAG],
            breaks[k : k + 2],
            x,
            method="Radau",
            rtol=1e-9,
            atol=1e-11,
        ).y[:, -1]
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
