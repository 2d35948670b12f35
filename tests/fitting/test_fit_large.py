"""Large tables and serially correlated errors: the same answers in little memory."""

import tracemalloc

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

import pam_ocp as pam
from pam_ocp.fitting import ForceTable, compare_laws, fit_force
from pam_ocp.fitting.static import local_optimum
from pam_ocp.fitting.static.correlation import RHO, Order, _meats, surprise
from pam_ocp.fitting.static.report import repeats

LAW = pam.muscle("DMSP-20-300").law


def ramps(cells, seed, correlation=0.0, noise=1.0):
    """Ten contraction levels, a slow ramp of pressure at each."""
    random = np.random.default_rng(seed)
    each = cells // 10
    kappa = np.repeat(np.linspace(0, 0.2, 10), each)
    p = np.tile(3.2e5 - 2.7e5 * np.cos(np.linspace(0, 2 * np.pi, each)), 10)
    errors = lfilter([1.0], [1.0, -correlation], random.normal(0, noise, p.size))
    return ForceTable(p, kappa, np.asarray(LAW.tension(p, kappa)) + errors, 0.3)


def test_twenty_thousand_cells_take_little_memory_and_scipy_agrees(monkeypatch):
    monkeypatch.setattr(local_optimum, "_solver", None)  # IPOPT would be asked for here
    table = ramps(20_000, 1)
    fit_force(table.subset(slice(0, 20_000, 100)))  # functions are built once
    tracemalloc.start()
    fit = fit_force(table)
    intervals = fit.intervals()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6
    cells = table.taut
    size = np.array([abs(v) for v in LAW.values.values()])

    def residuals(z):
        a1, a2, a3, a4, a5, a6 = z * size
        p, k = cells.pressure, cells.contraction
        return (a1 * p + a2) * np.exp(a3 * k) + a4 * k * p + a5 * p + a6 - cells.force

    other = least_squares(residuals, list(LAW.values.values()) / size, x_scale="jac", xtol=1e-14)
    assert fit.squares == pytest.approx(2 * other.cost, rel=1e-12)
    assert all(low < fit.law.values[n] < high for n, (low, high) in intervals.items())


def test_correlated_covariance_is_that_of_the_dense_matrix():
    random = np.random.default_rng(2)
    jacobian = random.normal(size=(30, 3))
    order = random.permutation(28)  # two rows of priors behind
    follows = random.random(28) < 0.8
    follows[0] = False
    chain = np.cumsum(~follows)
    found = _meats(jacobian, Order("so", order, follows), RHO)
    for rho, meat in list(zip(RHO, found, strict=True))[::12]:
        steps = np.abs(np.subtract.outer(np.arange(28), np.arange(28)))
        dense = np.where(np.equal.outer(chain, chain), rho**steps, 0.0)
        rows = jacobian[:28][order]
        wanted = rows.T @ dense @ rows + jacobian[28:].T @ jacobian[28:]
        np.testing.assert_allclose(meat, wanted, rtol=1e-10, atol=1e-10)


def test_repeats_are_numbered_as_cell_by_cell():
    random = np.random.default_rng(3)
    p, k = random.choice([1e5, 2e5, 3e5], 80), random.choice([0.0, 0.05], 80)
    p, k = p + random.uniform(-900, 900, 80), k + random.uniform(-7e-4, 7e-4, 80)
    table = ForceTable(p, k, np.ones(80), branch=tuple(random.choice(["a", "b"], 80)))
    near, first, wanted = 0.005 * np.abs(p).max(), [], []
    for i in range(80):
        same = [
            n
            for n, j in enumerate(first)
            if abs(p[i] - p[j]) <= near
            and abs(k[i] - k[j]) <= 0.001
            and table.branch[i] == table.branch[j]
        ]
        if not same:
            first.append(i)
        wanted.append(same[0] if same else len(first) - 1)
    assert repeats(table).tolist() == wanted


@pytest.mark.parametrize("method", ["residuals", "cases"])
def test_the_bootstrap_counts_errors_that_follow_each_other(method):
    fit = fit_force(ramps(200, 5, correlation=0.7))
    found, plain = fit.bootstrap(120, method=method), fit.linearisation.independent.stderr()
    ratios = [found.stderr[n] / fit.coefficients[n].stderr for n in fit.free]
    assert 0.75 < np.median(ratios) < 1.3
    assert np.median(np.array([*found.stderr.values()]) / plain) > 1.25


def test_the_likelihood_of_errors_that_follow_each_other_is_that_of_a_normal_vector():
    random = np.random.default_rng(7)
    r = lfilter([1.0], [1.0, -0.6], random.normal(size=40))
    follows = np.arange(40) % 20 > 0
    steps = np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    same = np.equal.outer(np.arange(40) // 20, np.arange(40) // 20)
    wanted = []
    for rho in RHO:
        dense = np.where(same, rho**steps, 0.0)
        variance = r @ np.linalg.solve(dense, r) / 40
        wanted.append(40 * np.log(variance) + np.linalg.slogdet(dense)[1])
    found = surprise(r, [Order("so", np.arange(40), follows)], 2.0)
    assert found == pytest.approx(min(wanted) + 2.0)


def test_criteria_do_not_take_a_ramp_for_many_pieces_of_evidence():
    table = ramps(200, 6, correlation=0.8)
    laws = ["six-parameter", "five-parameter"]
    counted, alone = (compare_laws(table, laws, errors=e) for e in ("as found", "independent"))
    gain = [c["five-parameter"].aic - c["six-parameter"].aic for c in (counted, alone)]
    assert 0 < gain[0] < gain[1]
    squares = alone["six-parameter"].fit.squares
    n = alone["six-parameter"].fit.n
    assert alone["six-parameter"].aic == pytest.approx(n * np.log(squares / n) + 14)
