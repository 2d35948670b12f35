"""Refinement: where the mesh is made finer, and where inputs are looked at between their points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.planning.transcription import mesh as rules

TASK = [{"x": 0.0372}, {"x": 0.0260}]
METHOD = Collocation(7, 8, "polynomial")


@pytest.fixture(scope="module")
def by_valve() -> pam.Plant:
    """A valve that switches from one end to the other: its polynomial swings."""
    return pam.HangingLoad(pam.muscle("DMSP-20-400N"), 20.9, feed=pam.feeds.SpoolValve())


@pytest.mark.slow
def test_inputs_end_within_their_bounds_between_the_points_too(by_valve):
    with pytest.warns(pam.PlanWarning, match="not verified"):
        loose = pam.plan(by_valve, TASK, method=METHOD, tolerance=None, starts=1)
    assert max(each.get("muscle.command", 0.0) for each in loose.replay.beyond) > 0.02
    plan = pam.plan(by_valve, TASK, method=METHOD, starts=1)
    assert plan.verified
    u = plan.trajectory.signals(np.linspace(0.0, plan.duration, 20001))
    assert np.max(np.abs(u)) <= 1.0 + 1e-3 * 0.1  # nominal 0.1


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_the_tolerance_is_that_of_the_whole_motion(tolerance):
    """A plant that grows along the motion: x'' = 400 x + u, errors by exp(20 t)."""
    plant = pam.Plant("falling")
    x = plant.state("x", unit="m")
    v = plant.state("v", unit="m/s")
    u = plant.input("u", unit="m/s2", min=-40.0, max=40.0, nominal=10.0)
    plant.der(x, v)
    plant.der(v, 400 * x + u)
    plan = pam.plan(
        plant,
        [{"x": 0.0}, {"x": 0.05}],
        duration=0.5,
        rest=False,
        minimise="effort",
        method=Collocation(4, 2, "linear"),
        tolerance=tolerance,
    )
    assert plan.verified
    assert plan.replay_error <= tolerance


def test_an_excess_is_that_of_the_polynomial_itself(by_valve):
    """Against NumPy's polynomial through the values at the points, on a thousand places."""
    rough = {"tolerance": None, "starts": 1, "method": replace(METHOD, guarded=False)}
    with pytest.warns(pam.PlanWarning):
        plan = pam.plan(by_valve, TASK, **rough)
    found, mesh = plan._solved, plan.meshes[-1]
    seen = [each.get("muscle.command", 0.0) for each in plan.replay.beyond]
    nx = len(by_valve.states)
    taus = rules.Form("radau", "polynomial").input_taus(8)
    bounds = np.array(found.program.problem.legs[0].bounds["muscle.command"])
    low, high = bounds / by_valve.variable("muscle.command").nominal
    begin, expected = nx, []
    for _ in mesh.intervals:
        begin += nx * len(taus)
        values = found.outcome.w[begin : begin + len(taus)]
        begin += len(taus)
        u = np.polynomial.Polynomial.fit(taus, values, 7)(np.linspace(0, 1, 1001))
        expected.append(max(0.0, float(np.max(u)) - high, low - float(np.min(u))))
    assert max(expected) > 0.1
    assert seen == pytest.approx(expected, abs=5e-3 * max(expected))


@pytest.mark.slow
def test_kinks_are_narrowed_on_meshes_that_resolve_the_motion_with_as_many_inputs_as_asked_for():
    # a slide that swings while pressures cost little
    slip = pam.losses.MaxwellSlip((6.0, 6.0), (0.005, 0.02))
    muscle = pam.muscle("DMSP-20-200N")
    plant = pam.AntagonisticSlide(muscle, 2.0, feed=pam.feeds.IdealPressure(), losses=(slip,))
    stops, coarse = [{"x": -0.006}, {"x": 0.006}], pam.Collocation(10, 2)
    plan = pam.plan(plant, stops, duration=0.3, minimise="effort", method=coarse)
    assert plan.verified
    points = [sum(i.degree for i in mesh.intervals) for mesh in plan.meshes]
    assert points[0] == 20
    assert points[-1] > 20
    assert [len(mesh.held()) for mesh in plan.meshes] == [10] * len(plan.meshes)
