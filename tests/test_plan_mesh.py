"""Refinement: where the mesh is made finer, and where inputs are looked at between their points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.plan import mesh as rules
from pam_ocp.plan.replay import excesses

TASK = [{"x": 0.0372}, {"x": 0.0260}]
METHOD = Collocation(7, 8, "polynomial")


@pytest.fixture(scope="module")
def by_valve() -> pam.Plant:
    """A valve that switches from one end to the other: its polynomial swings."""
    return pam.HangingLoad(pam.muscle("DMSP-20-400N"), 20.9, feed=pam.SpoolValve())


def test_inputs_end_within_their_bounds_between_the_points_too(by_valve, monkeypatch):
    plan = pam.plan(by_valve, TASK, method=METHOD, tolerance=1e-4)
    assert plan.statistics["tolerance_met"]
    assert plan.replay_error < 1e-3
    assert plan.replay.violation < rules.MOST_EXCESS
    monkeypatch.setattr(rules, "MOST_EXCESS", np.inf)
    loose = pam.plan(by_valve, TASK, method=METHOD, tolerance=1e-4)
    assert loose.replay.violation > 0.02


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
        plant, [{"x": 0.0}, {"x": 0.05}], duration=0.5, rest=False, minimise="effort",
        method=Collocation(4, 2, "linear"), tolerance=tolerance,
    )  # fmt: skip
    assert plan.statistics["tolerance_met"]
    assert plan.replay_error <= tolerance


def test_an_excess_is_that_of_the_polynomial_itself(by_valve):
    """Against NumPy's polynomial through the values at the points, on a thousand places."""
    found = pam.plan(by_valve, TASK, method=replace(METHOD, guarded=False))._solved
    mesh = rules.Mesh(found.program.mesh.intervals, rules.Form("radau", "polynomial", guarded=True))
    seen = excesses(found.program.problem, mesh, found.solution)
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


def test_checks_are_added_only_where_they_are_needed():
    mesh = METHOD.mesh(1)
    closer = rules.guarded(mesh, [0.0, 0.2, 0.0, 0.009, 0.011, 0.0, 0.0])
    assert [i.guards for i in closer.intervals] == [3, 15, 3, 3, 15, 3, 3]
    assert rules.guarded(mesh, [0.0] * 7) == mesh
    assert len(closer.form.guard_taus(8, 15)) == 1 + 8 * 15
