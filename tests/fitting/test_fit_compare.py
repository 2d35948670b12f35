"""Laws compared: known figures, criteria, and a level left out computed a second way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import refused
from static_tables import measured, six, six_by_scipy

from pam_ocp.core.errors import FitError, UnknownNameError
from pam_ocp.fitting import LawComparison, compare_laws, fit_force
from pam_ocp.fitting.static.search import minimise, minimise_near


@pytest.fixture(scope="module")
def long() -> LawComparison:
    laws = ["six-parameter", "five-parameter", "thick-wall", "geometric"]
    return compare_laws(measured(), laws, fixed={"rest_diameter": 0.02})


@pytest.mark.parametrize(("name", "error"), [("DMSP-20-300", 17.6), ("DMSP-10-250", 5.8)])
def test_the_six_parameter_law_has_its_known_error_at_levels_left_out(
    name: str, error: float
) -> None:
    """Mean RMSE over the interior levels left out."""
    found = compare_laws(measured(name), ["six-parameter"])
    assert found.best.left_out_rmse == pytest.approx(error, abs=0.05)


def test_a_level_left_out_agrees_with_scipy(long: LawComparison) -> None:
    law = long["six-parameter"]
    assert law.fit is not None
    taut = law.fit.cells
    kappa, p, force = taut.contraction * 100, taut.pressure / 1e5, taut.force
    there = np.abs(taut.contraction - 0.11) < 0.01
    k, q = kappa[~there], p[~there]
    starts = ([1, 300, a3, -9, 270, -300] for a3 in (-1.0, -0.5, -0.2))
    answers = (six_by_scipy(k, q, force[~there], start) for start in starts)
    best = min(answers, key=lambda answer: answer.cost)
    error = np.sqrt(np.mean((six(best.x, p[there], kappa[there]) - force[there]) ** 2))
    left_out = {round(k, 3): e for k, e in law.left_out.items()}
    assert left_out[0.11] == pytest.approx(error, rel=1e-4)
    assert list(left_out) == [0.06, 0.11, 0.167]  # the interior ones of five levels


def test_a_level_left_out_is_that_of_a_fit_which_knows_no_start(long: LawComparison) -> None:
    """The thin scan about the optimum of the whole table leads where a wide one leads."""
    for law in (law for law in long.laws if law.fit is not None):
        for kappa, error in law.left_out.items():
            taut = law.fit.cells
            there = np.abs(taut.contraction - kappa) < 0.01
            held = {n: v for n, v in law.fit.law.values.items() if law.fit.coefficients[n].held}
            again = fit_force(taut.subset(~there), type(law.fit.law), fixed=held)
            tension = np.ravel(again.law.tension(taut.pressure[there], taut.contraction[there]))
            expected = np.sqrt(np.mean((tension - taut.force[there]) ** 2))
            assert error == pytest.approx(expected, rel=1e-5)


def test_criteria_of_independent_errors_are_those_of_akaike_and_schwarz() -> None:
    law = compare_laws(measured(), ["five-parameter"], errors="independent")["five-parameter"]
    assert law.fit is not None
    squares = np.sum(law.fit.residuals**2)
    # 5 coefficients and the variance, 60 taut cells
    assert law.aic == pytest.approx(60 * np.log(squares / 60) + 12)
    assert law.bic == pytest.approx(60 * np.log(squares / 60) + 6 * np.log(60))


def test_the_table_is_sorted_by_the_error_left_out_and_names_what_is_missing(
    long: LawComparison,
) -> None:
    ranked = ["thick-wall", "five-parameter", "six-parameter", "geometric"]
    assert [law.name for law in long.laws] == ranked
    lines = str(long).splitlines()
    assert lines[2].split()[:2] == ["thick-wall", "5"]
    assert "needs fixed={'radius': ...}" in lines[-1]
    assert np.isnan(long["geometric"].aic)


def test_names_that_no_law_knows_are_refused() -> None:
    table = measured("DMSP-10-250")
    with pytest.raises(UnknownNameError, match="'radios'"):
        compare_laws(table, ["geometric"], fixed={"radios": 0.005})
    with pytest.raises(UnknownNameError, match="did you mean 'six-parameter'"):
        compare_laws(table, ["six-parametre"])
    refused("laws is empty", compare_laws, table, [])


@pytest.mark.parametrize("asked", [{}, {"loss": "huber"}, {"censored": True}], ids=str)
def test_resampled_tables_are_fitted_no_worse_than_by_a_wide_scan(asked: Any) -> None:
    fit = fit_force(measured(), "five-parameter", **asked)
    start = fit.vector[None, list(fit.problem.nonlinear)]
    random = np.random.default_rng(20261130)
    problems = []
    for size in (1.0, 1.0, 0.8, 0.6):  # tables of several sizes go down side by side
        drawn = random.integers(0, len(fit.cells), round(size * len(fit.cells)))
        cells, weights = fit.problem.cells.subset(drawn), fit.problem.weights[drawn]
        problems.append(replace(fit.problem, cells=cells, weights=weights))
    for problem, near in zip(problems, minimise_near(problems, start), strict=True):
        assert not isinstance(near, FitError)
        assert near.cost <= minimise(problem).cost * (1 + 1e-6)
        assert asked or near.solver.status == "Newton_Converged"  # IPOPT would mend what is wrong
