"""Loops of fits, maps and plans give the same bits by processes as here."""

from __future__ import annotations

import numpy as np
import pytest

import pam_ocp as pam


@pytest.fixture(scope="module")
def table() -> pam.fitting.ForceTable:
    return pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)


def test_a_bootstrap(table: pam.fitting.ForceTable) -> None:
    fit = pam.fit_force(table)
    here, there = (fit.bootstrap(12, seed=4, executor=n) for n in (0, 2))
    assert here.samples.shape == (12, 6)
    assert np.array_equal(here.samples, there.samples)


def test_ranked_laws(table: pam.fitting.ForceTable) -> None:
    names = ["six-parameter", "five-parameter", "polynomial-2-2"]
    here, there = (pam.compare_laws(table, names, executor=n) for n in (0, 2))
    assert str(here) == str(there)
    assert here.best.left_out == there.best.left_out


@pytest.mark.slow
def test_drawn_plants_and_planners() -> None:
    slide = pam.AntagonisticSlide("DMSP-20-400N", mass=2.0)
    ways = {"share": None, "method": pam.Collocation(10, 3)}
    stops = [{"x": -0.01}, {"x": 0.01}]
    draws = [{"mass": m} for m in (1.96, 2.0, 2.04)]
    runs = [
        pam.robust_plan(slide, stops, draws=draws, spread={"x": 1e-3}, executor=n, **ways)
        for n in (0, 2)
    ]
    one, two = (r.members.deviation("x") for r in runs)
    assert np.array_equal(one, two)
    planner = pam.Planner(slide, stops, method=pam.Collocation(10, 3))
    masses = [{"mass": m} for m in (1.5, 2.0, 2.5)]
    here, there = (pam.each(planner, masses, executor=n) for n in (0, 2))
    assert [p.duration for p in here] == [p.duration for p in there]
    assert here[0].duration < here[1].duration < here[2].duration
