"""Serially correlated errors: covariance by hand, coverage, open ends, odd tables."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from scipy.stats import t as student
from static_tables import TRUTH, joined

from pam_ocp.core.errors import PamError
from pam_ocp.fitting import ForceTable, fit_force
from pam_ocp.fitting.static.campaign import fit_forces
from pam_ocp.fitting.static.correlation import Order, neighbours, sequences, serial_errors, widening
from pam_ocp.muscles.laws.user_defined import polynomial_law

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

LINE = polynomial_law(1, 1)(g0=2e-3, g1=-6e-3, h0=-50.0, h1=-800.0)


def ramps(rho: float, seed: int, levels: int = 4, steps: int = 12, law=LINE) -> ForceTable:
    """Ramps of pressure, one for each level, with errors of 4 N that follow each other."""
    random = np.random.default_rng(seed)
    kappa = np.repeat(np.linspace(0.0, 0.15, levels), steps)
    p = np.tile(np.linspace(3e5, 6e5, steps), levels)
    error = random.standard_normal((levels, steps))
    for i in range(1, steps):
        error[:, i] = rho * error[:, i - 1] + np.sqrt(1 - rho**2) * error[:, i]
    return ForceTable(p, kappa, law.tension(p, kappa) + 4 * error.ravel(), 0.3)


def test_the_covariance_is_the_sandwich_with_the_correlation_written_out() -> None:
    found = fit_force(ramps(0.8, 3), polynomial_law(1, 1))
    serial, cells = found.serial, found.cells
    assert serial is not None
    assert serial.order == "along each ramp"
    p, k = cells.pressure, cells.contraction
    x = np.stack([p, p * k, np.ones_like(p), k], axis=1)
    lag = np.abs(np.subtract.outer(np.arange(p.size), np.arange(p.size)))
    r = np.where(k[:, None] == k, serial.correlation**lag, 0.0)
    # s2 of the errors: generalised least squares with that correlation
    root, size = np.linalg.cholesky(r), np.abs(x).max(axis=0)
    white = np.linalg.solve(root, np.column_stack([x / size, cells.force]))
    s2 = np.linalg.lstsq(white[:, :4], white[:, 4], rcond=None)[1][0] / (p.size - 4)
    inverse = np.linalg.inv((x / size).T @ (x / size)) / np.outer(size, size)
    expected = s2 * inverse @ x.T @ r @ x @ inverse
    order = [found.free.index(n) for n in ("g0", "g1", "h0", "h1")]
    np.testing.assert_allclose(found.covariance[np.ix_(order, order)], expected, rtol=1e-6)


def test_the_order_does_not_hang_on_rounding_where_all_orders_begin_alike() -> None:
    p, kappa = np.tile(np.linspace(1, 6, 6), 10), np.tile(np.repeat(np.linspace(0, 0.2, 5), 6), 2)
    branch = ("inflation",) * 30 + ("deflation",) * 30
    cells = ForceTable(1e5 * p, kappa, np.ones(60), branch=branch, floor=None)
    jacobian = np.stack([cells.pressure / 1e5, kappa, np.ones(60)], axis=1)
    orders = sequences(cells)
    assert len(orders) > 1
    for seed in (19, 154):
        r = np.random.default_rng(seed).standard_normal(60)
        found = [serial_errors(c * jacobian, c * r, orders) for c in (1.0, 3.3, 7.0, 1e3)]
        assert len({f and f.order for f in found}) == 1


def test_the_restricted_likelihood_is_that_of_error_contrasts() -> None:
    """Of K^T y with K^T X = 0, a normal density, its variance maximised (Patterson,
    Thompson 1971).
    """
    from pam_ocp.fitting.static.correlation import RHO, _likelihood
    from pam_ocp.fitting.statistics import spanned

    random = np.random.default_rng(1)
    x, y = random.standard_normal((15, 3)), random.standard_normal(15)
    y -= x @ np.linalg.lstsq(x, y, rcond=None)[0]
    order = Order("rows", np.arange(15), np.arange(15) % 5 > 0)
    values, _ = _likelihood(spanned(x), y, order)
    contrasts = np.linalg.svd(x)[0][:, 3:]
    lag = np.abs(np.subtract.outer(np.arange(15), np.arange(15)))
    block = np.arange(15)[:, None] // 5 == np.arange(15) // 5
    expected = []
    for rho in RHO:
        v = contrasts.T @ np.where(block, float(rho) ** lag, 0.0) @ contrasts
        e = contrasts.T @ y
        expected.append(-(np.linalg.slogdet(v)[1] + 12 * np.log(e @ np.linalg.solve(v, e))) / 2)
    np.testing.assert_allclose(values - values[0], np.array(expected) - expected[0], atol=1e-8)


def test_bands_and_intervals_hold_the_truth_though_errors_follow_each_other() -> None:
    hits, plain, inside = [], [], []
    where = np.linspace(3e5, 6e5, 8), 0.08
    for seed in range(80):
        fit = fit_force(ramps(0.7, 1000 + seed), polynomial_law(1, 1))
        low, high = fit.predict(*where).confidence
        inside.append(np.mean((low <= LINE.tension(*where)) & (LINE.tension(*where) <= high)))
        errors = fit.linearisation.independent.stderr()
        for n, e, (a, b) in zip(fit.free, errors, fit.intervals().values(), strict=True):
            hits.append(a <= LINE.values[n] <= b)
            half = student.ppf(0.975, fit.dof) * e
            plain.append(abs(fit.law.values[n] - LINE.values[n]) <= half)
    assert np.mean(plain) < 0.80  # what independent errors would have promised
    assert 0.90 <= np.mean(hits) <= 0.985
    assert 0.90 <= np.mean(inside) <= 0.985


def test_independent_errors_are_seldom_called_correlated() -> None:
    told = []
    for seed in range(60):
        serial = fit_force(ramps(0.0, seed), polynomial_law(1, 1)).serial
        told.append(serial is not None and serial.probability > 0.5)
    assert np.mean(told) < 0.15


def test_all_orders_of_a_table_sorted_by_pressure_are_tried() -> None:
    ramp = ramps(0.9, 5)
    by_pressure = ramp.subset(np.lexsort((ramp.contraction, ramp.pressure)))
    assert len(sequences(ramp)) == 2  # along pressure is along the ramp
    one, other = (fit_force(t, polynomial_law(1, 1)).serial for t in (ramp, by_pressure))
    assert one is not None
    assert other is not None
    assert other.correlation == pytest.approx(one.correlation, abs=0.1)


def test_a_joint_fit_widens_as_each_table_does_and_its_muscles_agree() -> None:
    joint = fit_forces([ramps(0.8, 1), ramps(0.8, 2)], polynomial_law(1, 1))
    assert joint.linearisation.serial is not None
    assert any("serially correlated" in w for w in joint.warnings)
    one = joint["1"]
    for n in ("g0", "g1", "h0", "h1"):
        assert one.coefficients[n].stderr == pytest.approx(joint.coefficients[n].stderr, rel=1e-6)
        assert one.interval(n) == pytest.approx(joint.interval(n), rel=1e-6)


@pytest.mark.parametrize("law", ["hildebrandt", "polynomial-1-3", "three-element", "six-parameter"])
def test_a_joint_fit_takes_every_kind_of_law(law: str) -> None:
    tables = [ramps(0.0, i, levels=6, law=TRUTH) for i in (1, 2)]
    joint = fit_forces(tables, law)
    alone = fit_force(joined(*tables), law)
    assert joint.cost == pytest.approx(alone.cost, rel=1e-7)


def test_the_dynamic_and_the_static_report_widen_by_one_formula() -> None:
    random = np.random.default_rng(0)
    e = random.standard_normal(200_000)
    for i in range(1, e.size):
        e[i] += 0.6 * e[i - 1]
    assert neighbours([e]) == pytest.approx(0.6, abs=0.01)
    means = e.reshape(-1, 1000).mean(axis=1)
    assert means.std() * np.sqrt(1000) / e.std() == pytest.approx(widening(0.6), rel=0.15)


def test_who_measured_in_random_order_may_say_so() -> None:
    table = ramps(0.8, 3)
    errors = ("as found", "independent")
    found, told = (fit_force(table, "polynomial-1-1", errors=e) for e in errors)
    assert told.serial is None
    assert "errors taken as independent" in told.report()
    assert told.law == found.law
    plain = found.linearisation.independent.stderr()
    np.testing.assert_allclose(told.linearisation.stderr(), plain)
    refused("'as found' or 'independent'", fit_force, table, errors="none")


def test_residuals_of_rounding_say_nothing() -> None:
    p, kappa = ramps(0.0, 1).pressure, ramps(0.0, 1).contraction
    exact = ForceTable(p, kappa, LINE.tension(p, kappa))
    fit = fit_force(exact, polynomial_law(1, 1))
    assert fit.serial is None
    assert np.all(np.isfinite(list(fit.intervals().values())))
    x = np.ones((20, 1))
    assert serial_errors(x, np.zeros(20), [Order("rows", np.arange(20), np.arange(20) > 0)]) is None


# ---- ends ----------------------------------------------------------------------------------------
def test_an_open_end_is_infinite_and_says_why(tmp_path: Path) -> None:
    """Three levels, six numbers for six coefficients: a3 may go to where its term is a straight
    line.
    """
    fit = fit_force(ramps(0.0, 5, levels=3, steps=8, law=TRUTH))
    ends = {n: np.isinf(pair) for n, pair in fit.intervals().items()}
    assert any(e.any() for e in ends.values())
    for name, opened in ends.items():
        assert bool(fit.open_ends().get(name)) == bool(opened.any())
    assert "(open: " in fit.report()
    import json

    content = json.loads(fit.to_json(tmp_path / "fit.json").read_text())
    assert set(content["open"]) == set(fit.open_ends())
    assert any(None in pair for pair in content["intervals"].values())


def test_a_band_holds_every_law_that_fits_as_well() -> None:
    """With a3 held anywhere in its interval the refitted force stays within the band."""
    table = ramps(0.0, 5, levels=3, steps=8, law=TRUTH)
    fit = fit_force(table)
    p, k = np.meshgrid(np.linspace(3e5, 6e5, 4), np.linspace(0.0, 0.15, 7))
    low, high = fit.predict(p, k).confidence
    limit = fit.cost + student.ppf(0.95, fit.dof) ** 2 * fit.sigma**2
    tried = 0
    for a3 in (-200.0, -120.0, -90.0, -70.0, -60.0, -50.0, -40.0, -35.0, -30.0):
        other = fit_force(table, fixed={"a3": a3})
        if other.cost <= limit:
            tried += 1
            force = other.law.tension(p, k)
            assert np.all((low - 1e-6 <= force) & (force <= high + 1e-6))
    assert tried >= 3


def test_a_flat_optimum_is_accepted_with_a_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    from pam_ocp.fitting.static import search

    monkeypatch.setattr(search, "STATIONARY", -1.0)  # no solver ever gets there
    fit = fit_force(ramps(0.0, 2, levels=6, law=TRUTH))
    assert fit.rmse < 5
    assert any("no stationary point" in w for w in fit.warnings)


# ---- other people's tables ----------------------------------------------------------------------
@pytest.mark.slow
def test_random_tables_of_all_laws_are_fitted_and_cover() -> None:
    """A small part of ``benchmarks/fit_study.py``; the study itself has 500."""
    import fit_study
    import harness

    results = [harness.judged(lambda n=n: fit_study.one(n, seed=11)) for n in range(20)]
    assert not [r["why"] for r in results if "verdict" in r]
    for key in ("coefficients", "band"):
        hits, count = np.sum([r[key] for r in results], axis=0)
        assert hits / count > 0.85


@pytest.mark.parametrize("loss", ["squares", "huber", "l1", "bisquare"])
def test_odd_tables_get_an_answer_or_one_sentence(loss: str) -> None:
    t = ramps(0.5, 4, law=TRUTH)
    p, k, force = t.pressure, t.contraction, t.force
    level = t.levels()
    noise, cell = 500 * np.random.default_rng(1).standard_normal(p.size), np.ones(20)
    odd = {
        "one level": t.subset(level == 0),
        "one pressure": t.subset(np.isclose(p, p.min())),
        "twice": t.subset(np.repeat(np.arange(len(t)), 2)),
        "constant force": ForceTable(p, k, np.full_like(force, 100.0)),
        "huge noise": ForceTable(p, k, force + noise),
        "exact": ForceTable(p, k, TRUTH.tension(p, k)),
        "one cell again": ForceTable(3e5 * cell, 0.1 * cell, 300 + np.arange(20.0) % 3),
    }
    for name, table in odd.items():
        for law in ("six-parameter", "polynomial-1-1"):
            try:
                fit = fit_force(table, law, loss=loss)
            except PamError:
                continue
            fit.report()
            assert not np.any(np.isnan(list(fit.intervals().values()))), name
            assert not np.any(np.isnan(fit.predict(3e5, 0.1).confidence)), name
