"""Static fits: figures of the measured muscles, an independent optimum, errors, doubts,
refusals.
"""
# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.stats import f as fisher
from scipy.stats import t as student
from static_tables import PUBLISHED, TRUTH, fit_20, grid, measured, six, six_by_scipy, six_slopes

from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.fitting import ForceFit, ForceTable, fit_force
from pam_ocp.fitting.experiments.cells import design_cells
from pam_ocp.fitting.static.least_squares import nonlinear_coefficients
from pam_ocp.muscles.law import LAWS, ForceLaw, SixParameterLaw, coefficient
from pam_ocp.muscles.laws.user_defined import own_law, polynomial_law

NAMES = ("a1", "a2", "a3", "a4", "a5", "a6")


@pytest.fixture(scope="module")
def fit() -> ForceFit:
    return fit_20()


def synthetic(levels: int = 6, noise: float = 0.0, seed: int = 0) -> ForceTable:
    """The DMSP-20-300 as fitted, sampled on a grid; all cells taut."""
    p, kappa = grid(np.linspace(0.01, 0.16, levels), np.linspace(3e5, 6e5, 7))
    force = TRUTH.tension(p, kappa) + noise * np.random.default_rng(seed).standard_normal(p.size)
    return ForceTable(p, kappa, force, 0.300)


@pytest.fixture(scope="module")
def alone() -> ForceFit:
    """A fit to cells whose errors are known to be serially independent."""
    found = fit_force(synthetic(noise=5.0, seed=5), errors="independent")
    assert found.serial is None
    return found


# ---- figures -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "cells", "rmse"), [("DMSP-20-300", 60, 6.2), ("DMSP-10-250", 40, 1.1)]
)
def test_measured_muscles_give_the_known_coefficients(name: str, cells: int, rmse: float) -> None:
    found = fit_force(measured(name))
    assert found.n == cells
    assert found.rmse == pytest.approx(rmse, abs=0.05)
    assert isinstance(found.law, SixParameterLaw)
    assert list(found.law.published().values()) == pytest.approx(PUBLISHED[name], rel=5e-5)


@pytest.mark.parametrize("name", PUBLISHED)
def test_scipy_finds_no_better_optimum(name: str) -> None:
    taut = measured(name).taut
    p, kappa, force = taut.pressure / 1e5, taut.contraction * 100, taut.force
    best = np.inf
    for a3 in (-1.0, -0.5, -0.2, -0.05, 0.05):
        columns = np.delete(six_slopes([0, 0, a3, 0, 0, 0], p, kappa), 2, axis=1)
        a1, a2, a4, a5, a6 = np.linalg.lstsq(columns, force, rcond=None)[0]
        answer = six_by_scipy(kappa, p, force, [a1, a2, a3, a4, a5, a6])
        if 2 * answer.cost < best:
            best, coefficients = 2 * answer.cost, answer.x
    found = fit_force(measured(name))
    assert found.squares == pytest.approx(best, rel=1e-9)
    assert list(found.law.published().values()) == pytest.approx(coefficients, rel=1e-5)


RIG = {"radius": 0.010, "rest_diameter": 0.020, "max_contraction_ratio": 0.2}


@pytest.mark.parametrize(
    ("law", "rmse_20", "rmse_10"),
    [
        ("geometric", 159, 94),
        ("corrected", 45, 23),
        ("five-parameter", 9.3, 8.4),
        ("six-parameter", 6.2, 1.1),
        ("hildebrandt", 4.0, 1.1),
    ],
)
def test_every_law_reaches_its_known_rmse(law: str, rmse_20: float, rmse_10: float) -> None:
    for name, rmse, scale in (("DMSP-20-300", rmse_20, 1.0), ("DMSP-10-250", rmse_10, 0.5)):
        constants = {n: RIG[n] * scale for n in LAWS[law].fixed_coefficients() if n in RIG}
        found = fit_force(measured(name), law, fixed=constants)
        assert found.rmse == pytest.approx(rmse, abs=0.5 if rmse > 10 else 0.05)


# ---- what enters ---------------------------------------------------------------------------------
def test_slack_cells_are_no_equalities(fit: ForceFit) -> None:
    table = fit.table
    deeper = np.where(table.slack, -500.0, table.force)
    below = ForceTable(table.pressure, table.contraction, deeper, table.rest_length)
    for other in (table.taut, below):
        assert fit_force(other).law.values == pytest.approx(fit.law.values, rel=1e-12)


def test_the_order_of_cells_does_not_matter(fit: ForceFit) -> None:
    shuffled = fit.table.subset(np.random.default_rng(3).permutation(len(fit.table)))
    assert fit_force(shuffled).law.values == pytest.approx(fit.law.values, rel=1e-9)


def test_a_weight_of_root_two_counts_a_cell_twice(fit: ForceFit) -> None:
    table = fit.table
    twice = np.concatenate([np.arange(len(table)), np.nonzero(table.pressure > 4e5)[0]])
    weights = np.where(table.pressure > 4e5, np.sqrt(2.0), 1.0)
    weighted, doubled = fit_force(table, weights=weights), fit_force(table.subset(twice))
    assert weighted.law.values == pytest.approx(doubled.law.values, rel=1e-8)
    assert weighted.squares == pytest.approx(doubled.squares, rel=1e-10)
    assert weighted.law.values != pytest.approx(fit.law.values, rel=1e-3)


def test_a_common_factor_of_the_weights_changes_nothing(fit: ForceFit) -> None:
    weights = 1 / (1 + fit.table.pressure / 1e5)
    one, many = (fit_force(fit.table, weights=c * weights) for c in (1.0, 1e3))
    assert many.interval("a3") == pytest.approx(one.interval("a3"), rel=1e-6)
    bands = [np.ravel(f.predict(3e5, [0.05, 0.1]).prediction) for f in (one, many)]
    assert bands[1] == pytest.approx(bands[0], rel=1e-6)
    said = {"candidates": ([2e5, 4e5, 6e5], [0.05, 0.1, 0.15])}
    designs = [design_cells(f, 2, **said) for f in (one, many)]
    assert designs[1].stderr_after == pytest.approx(designs[0].stderr_after, rel=1e-6)
    assert many.warnings == one.warnings


def test_a_new_measurement_scatters_as_the_cells_do_on_average() -> None:
    random = np.random.default_rng(6)
    p, kappa = (a.ravel() for a in np.meshgrid(np.linspace(1e5, 6e5, 9), np.linspace(0, 0.2, 7)))
    size = 1 + 4 * p / 6e5
    force = 2e-3 * p * (1 - 3 * kappa) + 300.0 + random.normal(0, size)
    found = fit_force(ForceTable(p, kappa, force), "polynomial-1-1", weights=100 / size)
    band = found.predict(3e5, 0.1)
    half = [(high - low) / 2 for low, high in (band.prediction, band.confidence)]
    t = student.ppf(0.975, found.dof)
    assert np.sqrt(half[0] ** 2 - half[1] ** 2) == pytest.approx(
        t * np.sqrt(np.mean(size**2)), rel=0.2
    )


def test_held_coefficients_stay_and_the_rest_is_linear_least_squares(fit: ForceFit) -> None:
    held = fit_force(fit.table, fixed={"a3": -40.0})
    p, kappa = held.cells.pressure, held.cells.contraction
    e = np.exp(-40.0 * kappa)
    columns = np.stack([p * e, e, kappa * p, p, np.ones_like(p)], 1)
    best, squares, *_ = np.linalg.lstsq(columns / columns.max(axis=0), held.cells.force, rcond=None)
    assert held.law.values["a3"] == -40.0
    free = [held.law.values[n] for n in ("a1", "a2", "a4", "a5", "a6")]
    assert free == pytest.approx(best / columns.max(axis=0), rel=1e-8)
    assert held.squares == pytest.approx(float(squares[0]), rel=1e-10)
    assert held.interval("a3") == (-40.0, -40.0)
    assert (held.dof, held.coefficients["a3"].stderr) == (55, 0.0)


def test_the_rest_length_of_a_law_comes_from_the_table() -> None:
    assert fit_force(measured("DMSP-20-300"), "three-element").law.values["rest_length"] == 0.300


def test_nonlinear_coefficients_are_found_from_the_formula() -> None:
    assert nonlinear_coefficients(SixParameterLaw) == ("a3",)
    assert nonlinear_coefficients(SixParameterLaw, frozenset({"a3"})) == ()
    assert nonlinear_coefficients(SixParameterLaw, frozenset({"a1", "a2"})) == ("a3",)
    assert nonlinear_coefficients(polynomial_law(2, 2)) == ()


@dataclass(frozen=True)
class TwoExponentials(ForceLaw):
    """F = b p exp(-c kappa) - d exp(f kappa) + g: two nonlinear coefficients."""

    b: Any = coefficient("N/Pa", 1e-3, "gain")
    c: Any = coefficient("1", 1.0, "decay of the gain", minimum=0.0)
    d: Any = coefficient("N", 100.0, "wall")
    f: Any = coefficient("1", 10.0, "growth of the wall's force")
    g: Any = coefficient("N", 100.0, "constant")
    name: ClassVar[str] = "two-exponentials"
    title: ClassVar[str] = "Two exponentials"
    reference: ClassVar[str] = "this test"

    def formula(self, p: Any, kappa: Any) -> Any:
        gain = self.b * p * ca.exp(-self.c * kappa)
        return gain - self.d * ca.exp(self.f * kappa) + self.g


def test_a_law_with_two_nonlinear_coefficients_is_found_again() -> None:
    truth = TwoExponentials(2.5e-3, 4.0, 60.0, 12.0, -30.0)
    p, kappa = grid(np.linspace(0, 0.15, 7), np.linspace(3e5, 6e5, 5))
    found = fit_force(ForceTable(p, kappa, truth.tension(p, kappa)), TwoExponentials)
    assert nonlinear_coefficients(TwoExponentials) == ("c", "f")
    assert found.law.values == pytest.approx(truth.values, rel=1e-6)


# ---- what the data say ---------------------------------------------------------------------------
def test_standard_errors_agree_with_a_finite_difference_jacobian(alone: ForceFit) -> None:
    p, kappa, force = alone.cells.pressure, alone.cells.contraction, alone.cells.force
    c = np.array([alone.law.values[n] for n in NAMES])
    steps = 1e-5 * np.abs(c)
    each = (six(c + h, p, kappa) - six(c - h, p, kappa) for h in np.diag(steps))
    jacobian = np.stack([*each], axis=1) / (2 * steps)
    size = np.abs(jacobian).max(axis=0)
    np.testing.assert_allclose(alone.jacobian / size, jacobian / size, rtol=1e-6, atol=1e-8)
    scale = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    variance = np.sum((force - six(c, p, kappa)) ** 2) / alone.dof
    covariance = variance * inverse
    stderr = np.sqrt(np.diag(covariance))
    assert [alone.coefficients[n].stderr for n in NAMES] == pytest.approx(stderr, rel=1e-5)
    expected = covariance / np.outer(stderr, stderr)
    np.testing.assert_allclose(alone.correlation, expected, rtol=1e-4, atol=1e-5)
    half = student.ppf(0.975, alone.dof) * stderr[0]
    ends = alone.interval("a1", linearised=True)
    assert ends == pytest.approx((c[0] - half, c[0] + half), rel=1e-5)


def test_prediction_adds_the_scatter_of_a_measurement(alone: ForceFit) -> None:
    p, kappa = np.array([4e5, 5e5]), np.array([[0.02], [0.1], [0.15]])
    answer = alone.predict(p, kappa, level=0.9)
    assert answer.force.shape == (3, 2)
    np.testing.assert_allclose(answer.force, alone.law.tension(p, kappa))
    low, high = answer.confidence
    wide_low, wide_high = answer.prediction
    t = student.ppf(0.95, alone.dof)
    np.testing.assert_allclose((high - low) / 2, t * answer.stderr)
    np.testing.assert_allclose((wide_high - wide_low) / 2, t * np.hypot(answer.stderr, alone.sigma))


def test_the_mean_variance_of_fitted_forces_is_s2_times_k_over_n(alone: ForceFit) -> None:
    # trace of the hat matrix = number of coefficients
    error = alone.predict(alone.cells.pressure, alone.cells.contraction).stderr
    assert np.mean(error**2) == pytest.approx(alone.sigma**2 * 6 / alone.n, rel=1e-9)


def test_profile_interval_ends_where_the_f_statistic_does(alone: ForceFit) -> None:
    low, high = alone.profile_interval("a3", 0.95)
    p, kappa, force = alone.cells.pressure, alone.cells.contraction, alone.cells.force
    for a3 in (low, high):
        e = np.exp(a3 * kappa)
        columns = np.stack([p * e, e, kappa * p, p, np.ones_like(p)], 1)
        squares = np.linalg.lstsq(columns / columns.max(axis=0), force, rcond=None)[1][0]
        ratio = (squares - alone.squares) / (alone.squares / alone.dof)
        assert ratio == pytest.approx(fisher.ppf(0.95, 1, alone.dof), rel=1e-4)
    a3 = alone.law.values["a3"]
    assert a3 - low > high - a3 > 0  # lopsided: steep is hard to tell


def test_profile_interval_of_a_linear_law_is_the_linearised_one(fit: ForceFit) -> None:
    linear = fit_force(fit.table, polynomial_law(1, 2))
    for name in linear.free:
        assert linear.profile_interval(name) == pytest.approx(linear.interval(name), rel=1e-5)


def test_intervals_are_profiles_found_all_at_once(alone: ForceFit) -> None:
    """Against one bisection after the other, each with a alone from scratch."""
    from pam_ocp.fitting.static.optimum import profile_end

    reach = student.ppf(0.975, alone.dof)
    limit = alone.cost + (reach * alone.sigma) ** 2
    assert alone.has_profile
    assert "95 % interval (profile likelihood)" in alone.report()
    for name, (low, high) in alone.intervals().items():
        size = alone.coefficients[name].stderr
        assert low == pytest.approx(profile_end(alone, name, -size, limit)[0], abs=1e-4 * size)
        assert high == pytest.approx(profile_end(alone, name, size, limit)[0], abs=1e-4 * size)
        assert alone.interval(name) == pytest.approx((low, high), rel=1e-9)


def test_intervals_are_linearised_where_there_is_no_profile(fit: ForceFit) -> None:
    for other in (fit_force(fit.table, loss="huber"), fit_force(fit.table, censored=True)):
        assert not other.has_profile
        assert other.intervals() == other.intervals(linearised=True)
        assert "(profile likelihood)" not in other.report()


def test_three_contraction_levels_are_called_saturated(fit: ForceFit) -> None:
    few = fit_force(synthetic(levels=3, noise=1.0))
    assert any("3 contraction levels" in w and "saturated" in w for w in few.warnings)
    assert not any("saturated" in w for w in fit.warnings)  # 5 levels, condition 25


def test_unseen_combinations_are_named() -> None:
    flat = fit_force(synthetic(levels=2, noise=1.0))  # two straight lines in p: four numbers
    assert flat.rank == 4
    assert sum("do not see this combination" in w for w in flat.warnings) == 2
    assert np.isinf(flat.coefficients["a3"].stderr)
    assert flat.profile_interval("a3") == (-np.inf, np.inf)
    # where it was measured the force is known all the same, elsewhere it is not
    inside, outside = flat.predict(4e5, flat.cells.contraction[0]), flat.predict(4e5, 0.08)
    assert inside.stderr < 1.0
    assert np.isinf(outside.stderr)


def test_antagonistic_twins_do_not_show_the_constant() -> None:
    """Of two equal muscles pulling against each other only a difference is seen: a6 cancels."""

    @dataclass(frozen=True)
    class Difference(SixParameterLaw):
        def formula(self, p: Any, kappa: Any) -> Any:
            return super().formula(p, kappa) - super().formula(6e5 - p, -kappa)

    p, kappa = grid(np.linspace(-0.1, 0, 5), np.linspace(4e5, 6e5, 5))
    force = TRUTH.tension(p, kappa) - TRUTH.tension(6e5 - p, -kappa)
    found = fit_force(ForceTable(p, kappa, force), Difference)
    assert np.isinf(found.coefficients["a6"].stderr)
    assert any("changing a6 by" in w for w in found.warnings)
    # the difference is blind to the sign of a3 too: e^(a3 kappa) and e^(-a3 kappa) change places
    assert abs(found.law.values["a3"]) == pytest.approx(abs(TRUTH.values["a3"]), rel=1e-5)


def test_an_exponent_that_runs_away_is_reported() -> None:
    p, kappa = grid(np.linspace(0, 0.15, 6), np.linspace(2e5, 6e5, 5))
    straight = ForceTable(p, kappa, 3e-3 * p - (1e3 + 8e-3 * p) * kappa)
    found = fit_force(straight)  # exp(a3 kappa) -> 1 + a3 kappa, a3 -> 0
    assert found.solver.at_bound == ("a3",)
    assert any("a3" in w and "edge of its range" in w for w in found.warnings)


# ---- out of it -----------------------------------------------------------------------------------
def test_the_muscle_carries_law_and_ranges_of_the_table(fit: ForceFit) -> None:
    muscle = fit.muscle(rest_length=0.300, diameter=0.020, name="mine")
    assert (muscle.law, muscle.rest_length, muscle.diameter) == (fit.law, 0.300, 0.020)
    assert muscle.pressure_range == (35e3, 675e3)
    assert muscle.contraction_range == pytest.approx((0.004 / 0.3, 0.078 / 0.3))
    assert fit.muscle().rest_length == 0.300
    rest = fit.cells.force - muscle.tension(fit.cells.pressure, fit.cells.contraction)
    np.testing.assert_allclose(rest, fit.residuals)


def test_the_report_names_every_coefficient_in_both_unit_systems(fit: ForceFit) -> None:
    text = fit.report()
    for words in ("60 taut cells of 126", "RMSE 6.196 N", "54 degrees of freedom"):
        assert words in text
    for words in ("a3: -56.66 ± ", "a1 12.79 ± ", "C(a2, a3) = ", "Newton_Converged"):
        assert words in text
    assert "[[Warnings]]" in fit_force(measured("DMSP-10-250")).report()
    assert "a3: -40 (held)" in fit_force(fit.table, fixed={"a3": -40.0}).report()


def test_a_saved_fit_comes_back_exactly(tmp_path: Path, fit: ForceFit) -> None:
    weighted = fit_force(fit.table, fixed={"a6": -300.0}, weights=1 + fit.table.pressure / 1e5)
    for one in (fit, weighted):
        read = ForceFit.from_json(one.to_json(tmp_path / "fit.json"))
        assert (read.law, read.held, read.solver) == (one.law, one.held, one.solver)
        assert read.report() == one.report()
        np.testing.assert_array_equal(read.covariance, one.covariance)
    assert [p.name for p in tmp_path.iterdir()] == ["fit.json"]


def test_a_fit_of_a_law_of_ones_own_is_read_with_its_class(tmp_path: Path, fit: ForceFit) -> None:
    held = {"a": coefficient("N/Pa", 1e-3, "area"), "b": coefficient("N", 1e3, "slope")}
    law = own_law("plane", lambda p, kappa, a, b: a * p - b * kappa, held)
    path = fit_force(fit.table, law).to_json(tmp_path / "fit.json")
    assert isinstance(ForceFit.from_json(path, law).law, law)
    refused(r"unknown force law 'plane'.*law=\.\.\.", ForceFit.from_json, path)


def test_a_fit_of_a_polynomial_is_read_by_its_name(tmp_path: Path, fit: ForceFit) -> None:
    found = fit_force(fit.table, "polynomial-2-2")
    assert found.law == fit_force(fit.table, polynomial_law(2, 2)).law
    assert ForceFit.from_json(found.to_json(tmp_path / "fit.json")).law == found.law


def test_of_many_combinations_that_are_not_seen_a_few_are_spelled_out(fit: ForceFit) -> None:
    """26 coefficients, 5 contraction levels: each of them tells two numbers, so 16 are not seen."""
    told = fit_force(fit.table, "polynomial-12-12").warnings
    assert sum("see this combination" in w for w in told) == 3
    more = [w for w in told if "more combinations of the 26 coefficients" in w]
    assert len(more) == 1
    assert int(more[0].split()[0]) >= 13


def test_files_that_hold_no_fit_are_refused(tmp_path: Path, fit: ForceFit) -> None:
    path = tmp_path / "x.json"
    refused("no such file", ForceFit.from_json, path)
    path.write_text('{"a": 1}')
    refused("is no fit", ForceFit.from_json, path)
    content = json.loads(fit.to_json(path).read_text("utf-8"))
    del content["coefficients"]["a4"]
    path.write_text(json.dumps(content))
    refused(r"cannot be read as a fit: .*a4", ForceFit.from_json, path)


# ---- what is refused -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"law": "six_parameter"}, "did you mean 'six-parameter'"),
        ({"law": 6}, "class of force laws"),
        ({"law": "geometric"}, r"needs fixed=\{'radius': \.\.\.\} \(inner radius"),
        ({"fixed": {"a7": 1.0}}, "unknown coefficient .* in fixed 'a7'"),
        ({"fixed": {"a3": "steep"}}, "a3: fixed = 'steep' is not a number"),
        ({"fixed": dict.fromkeys(NAMES, 1.0)}, "leave at least one free"),
        ({"start": {"alpha": 1.0}}, "in start 'alpha'"),
        ({"start": {"a3": float("inf")}}, "must be finite"),
        ({"weights": np.ones(60)}, r"one weight per cell of the table, \(126,\)"),
        ({"weights": np.zeros(126)}, "must be finite and > 0"),
    ],
)
def test_bad_arguments_are_refused_in_words(
    arguments: dict[str, Any], words: str, fit: ForceFit
) -> None:
    refused(words, fit_force, fit.table, **arguments)


def test_tables_that_cannot_carry_the_law_are_refused(fit: ForceFit) -> None:
    with pytest.raises(InputError, match="5 taut cells, fewer than the 6 coefficients"):
        fit_force(fit.cells.subset(np.arange(5)))
    refused("66 cells of the table are slack", fit_force, fit.table.subset(fit.table.slack))
    refused("read_table", fit_force, {"p": [1.0]})
    refused("must lie between 0 and 1", fit.interval, "a1", 95)
    refused("a7", fit.interval, "a7", error=UnknownNameError)
    exact = fit_force(fit.cells.subset(np.linspace(0, 59, 6).astype(int)), fixed={"a3": -50.0})
    assert exact.dof == 1


def test_a_scan_goes_on_where_some_of_its_points_overflow() -> None:
    """exp(-b kappa) at b = -3162, an end of the scan, is no number at 30 % contraction."""
    held = {"a": coefficient("N/Pa", 1e-3, "area"), "b": coefficient("1", 100.0, "steepness")}
    law = own_law("steep", lambda p, kappa, a, b: a * p * ca.exp(-b * kappa), held)
    truth = law(a=4e-3, b=12.0)
    p, kappa = grid(np.linspace(0.0, 0.3, 9), np.array([1e5, 3e5, 5e5]))
    found = fit_force(ForceTable(p, kappa, truth.tension(p, kappa), 0.3), law)
    assert found.law.values == pytest.approx(truth.values, rel=1e-6)
