"""Designs of static measurements: against designs known from theory, and against re-fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from static_tables import fit_20

import pam_ocp as pam
from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.fitting import ForceFit, ForceTable, fit_force
from pam_ocp.fitting.experiments.cells import Criterion, design_cells, exchange, refine
from pam_ocp.fitting.experiments.signals import design_experiment

NONE = np.zeros((3, 3))
LINE = np.linspace(-1, 1, 41)
QUADRATIC = np.stack([np.ones_like(LINE), LINE, LINE**2], axis=1)


def counts(rows: np.ndarray) -> dict[float, int]:
    values, numbers = np.unique(np.round(rows, 9), return_counts=True)
    return dict(zip(values.tolist(), numbers.tolist(), strict=True))


@pytest.fixture(scope="module")
def fit() -> ForceFit:
    return fit_20()


# ---- designs of theory ---------------------------------------------------------------------------
def test_a_plane_is_measured_at_the_corners() -> None:
    grid = np.stack(np.meshgrid(LINE, LINE), -1).reshape(-1, 2)
    rows = np.concatenate([np.ones((len(grid), 1)), grid], axis=1)
    found = exchange(rows, 4, Criterion((0, 1, 2)), NONE, repeats=4)
    corners = {tuple(p) for p in grid[found.indices].tolist()}
    assert corners == {(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)}
    assert found.efficiency == pytest.approx(1.0)  # the equivalence theorem: no design is better
    assert found.value == pytest.approx(-3 * np.log(4))  # M = 4 I


def test_a_parabola_is_measured_at_its_ends_and_in_the_middle() -> None:
    """D: equal numbers; A: 1 : 2 : 1 (Pukelsheim, Optimal Design of Experiments, 9.5)."""
    d = exchange(QUADRATIC, 12, Criterion((0, 1, 2)), NONE, repeats=12)
    assert counts(LINE[d.indices]) == {-1.0: 4, 0.0: 4, 1.0: 4}
    assert d.efficiency == pytest.approx(1.0)
    a = exchange(QUADRATIC, 12, Criterion((), np.eye(3)), NONE, repeats=12)
    assert counts(LINE[a.indices]) == {-1.0: 3, 0.0: 6, 1.0: 3}
    assert a.value == pytest.approx(8 / 12)  # the least trace is 8/n
    assert a.efficiency == pytest.approx(1.0)


MOMENTS = np.array([[1, 0, 1 / 3], [0, 1 / 3, 0], [1 / 3, 0, 1 / 5]])


@pytest.mark.parametrize(
    ("criterion", "value"),
    [
        # the quadratic coefficient against the others (Kiefer 1961)
        pytest.param(Criterion((2,)), np.log(4 / 8), id="D_s of the curvature alone"),
        # least mean variance over [-1, 1], in sigma2/n
        pytest.param(Criterion((), MOMENTS), 32 / 15 / 8, id="I over its interval"),
    ],
)
def test_a_parabola_is_measured_twice_as_often_in_the_middle(criterion: Any, value: float) -> None:
    """1 : 2 : 1 at -1, 0, 1."""
    found = exchange(QUADRATIC, 8, criterion, NONE, repeats=8)
    assert counts(LINE[found.indices]) == {-1.0: 2, 0.0: 4, 1.0: 2}
    assert found.value == pytest.approx(value)


def test_what_is_known_already_counts() -> None:
    """Nine points at -1, nine at 0: all that is missing for a parabola is at 1."""
    known = QUADRATIC[[0] * 9 + [20] * 9]
    found = exchange(QUADRATIC, 3, Criterion((0, 1, 2)), known.T @ known, repeats=3)
    assert counts(LINE[found.indices]) == {1.0: 3}


def test_a_candidate_is_not_chosen_more_often_than_allowed() -> None:
    found = exchange(QUADRATIC, 9, Criterion((0, 1, 2)), NONE, repeats=1)
    assert len(set(found.indices.tolist())) == 9
    assert {0, 20, 40} <= set(found.indices.tolist())


def test_points_move_off_a_grid_that_misses_the_optimum() -> None:
    """A cubic is best measured at -1, -1/sqrt(5), 1/sqrt(5), 1 (Guest 1958)."""

    def gradient(points: np.ndarray) -> np.ndarray:
        rows = np.stack([points[:, 0] ** i for i in range(4)], axis=1)
        return np.where(np.abs(points) <= 1, rows, np.nan)

    coarse = np.linspace(-1, 1, 6)[:, None]
    asked = Criterion((0, 1, 2, 3)), np.zeros((4, 4))
    begun = exchange(gradient(coarse), 4, *asked, repeats=4)
    found = refine(coarse[begun.indices], np.array([0.4]), gradient, *asked, halvings=12)
    assert np.sort(found[:, 0]) == pytest.approx([-1, -(5**-0.5), 5**-0.5, 1], abs=1e-3)


def test_too_few_points_or_candidates_are_refused() -> None:
    with pytest.raises(InputError, match="2 points do not determine 3 parameters"):
        exchange(QUADRATIC, 2, Criterion((0, 1, 2)), NONE, repeats=2)
    with pytest.raises(InputError, match="each at most 1 times: there are too few"):
        exchange(QUADRATIC, 42, Criterion((0, 1, 2)), NONE, repeats=1)


# ---- cells of a muscle ---------------------------------------------------------------------------
def test_designed_cells_stay_within_the_bench_and_are_taut(fit: ForceFit) -> None:
    design = design_cells(fit, 8, pressure=(1e5, 5e5), contraction=(0.02, 0.20))
    cells = design.cells
    assert len(cells) == 8
    assert np.all((cells.pressure >= 1e5 * (1 - 1e-9)) & (cells.pressure <= 5e5 * (1 + 1e-9)))
    assert np.all((cells.contraction >= 0.02 - 1e-9) & (cells.contraction <= 0.20 + 1e-9))
    assert cells.force == pytest.approx(fit.law.tension(cells.pressure, cells.contraction))
    assert np.all(cells.force >= 3 * fit.sigma * (1 - 1e-9))


@pytest.mark.parametrize(("criterion", "measure"), [("D", "det"), ("A", "relative"), ("I", "mean")])
def test_designed_cells_beat_random_ones(fit: ForceFit, criterion: Any, measure: str) -> None:
    """Information of random taut cells, computed here from the fit's own Jacobian."""
    design = design_cells(fit, 6, criterion=criterion)
    taut = fit.cells
    weight = 1 / np.array([float(fit.law.values[n]) for n in fit.free]) ** 2

    def judged(p: Any, kappa: Any) -> float:
        rows = np.concatenate([fit.jacobian, fit._sensitivity(np.asarray(p), np.asarray(kappa))[1]])
        size = np.linalg.norm(rows, axis=0)
        c = np.linalg.inv((rows / size).T @ (rows / size)) / np.outer(size, size)
        if measure == "det":
            return float(np.prod(np.linalg.eigvalsh(c * np.outer(size, size))))
        if measure == "relative":
            return float(np.sum(weight * np.diag(c)))
        return float(np.mean(np.einsum("ij,jk,ik->i", fit.jacobian, c, fit.jacobian)))

    drawn = np.random.default_rng(3).integers(0, len(taut), (300, 6))
    best = min(judged(taut.pressure[i], taut.contraction[i]) for i in drawn)
    assert judged(design.cells.pressure, design.cells.contraction) < 0.95 * best


def test_the_chosen_coefficient_gains_most_where_it_is_asked_for(fit: ForceFit) -> None:
    every, one = design_cells(fit, 4), design_cells(fit, 4, parameters=["a3"])
    assert one.stderr_after["a3"] < every.stderr_after["a3"] < one.stderr_before["a3"]
    assert one.stderr_before["a3"] == pytest.approx(fit.coefficients["a3"].stderr)


@pytest.mark.slow
def test_promised_standard_errors_are_the_scatter_of_re_fits(fit: ForceFit) -> None:
    """200 synthetic tables of the old and the new cells, fitted from scratch."""
    design = design_cells(fit_force(fit.table, errors="independent"), 12)
    noise, old, new = design.noise, fit.cells, design.cells
    p = np.concatenate([old.pressure, new.pressure])
    kappa = np.concatenate([old.contraction, new.contraction])
    truth = fit.law.tension(p, kappa)
    random = np.random.default_rng(5)
    found = []
    for _ in range(200):
        force = np.maximum(truth + noise * random.standard_normal(p.size), 0.01)
        found.append([float(v) for v in fit_force(ForceTable(p, kappa, force)).law.values.values()])
    scatter = np.std(found, axis=0, ddof=1)
    promised = np.array(list(design.stderr_after.values()))
    # 200 draws know a standard deviation to 5 %; a3 bends the linearisation by some per cent more
    assert scatter == pytest.approx(promised, rel=0.16)


def test_a_law_with_a_covariance_serves_as_its_fit_does(fit: ForceFit) -> None:
    limits = {"pressure": (0.35e5, 6.75e5), "contraction": (0.02, 0.25)}
    one = design_cells(fit, 5, **limits)
    other = design_cells(fit.law, 5, covariance=fit.covariance, noise=fit.sigma, **limits)
    assert other.cells.pressure == pytest.approx(one.cells.pressure, rel=1e-6)
    for name, error in one.stderr_after.items():
        assert other.stderr_after[name] == pytest.approx(error, rel=1e-6)


def test_a_law_alone_gets_a_table_from_nothing(fit: ForceFit) -> None:
    design = design_cells(fit.law, 12, noise=5.0, pressure=(0, 6e5), contraction=(0, 0.25))
    assert all(np.isinf(v) for v in design.stderr_before.values())
    assert all(np.isfinite(v) for v in design.stderr_after.values())
    assert design.efficiency > 0.7
    assert len(np.unique(np.round(design.cells.contraction, 3))) >= 3


def test_given_candidates_are_kept(fit: ForceFit) -> None:
    p, kappa = np.meshgrid([2e5, 4e5, 6e5], [0.05, 0.10, 0.15])
    design = design_cells(fit, 4, candidates=(p.ravel(), kappa.ravel()), repeats=1)
    cells = set(zip(design.cells.pressure.tolist(), design.cells.contraction.tolist(), strict=True))
    assert len(cells) == 4
    assert cells <= set(zip(p.ravel().tolist(), kappa.ravel().tolist(), strict=True))


def test_report_and_file_say_what_to_measure(fit: ForceFit, tmp_path: Path) -> None:
    design = design_experiment(fit, 3)
    text = design.report()
    assert "3 further cells for the six-parameter law, D-optimal" in text
    for name in fit.free:
        assert f"\n{name} " in text
    low, high = design.interval("a3")
    assert (low + high) / 2 == pytest.approx(float(fit.law.values["a3"]))
    rows = np.genfromtxt(design.save(tmp_path / "next.csv"), delimiter=",", names=True)
    assert rows["length_m"] == pytest.approx(0.3 * (1 - design.cells.contraction), rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"n": 0}, "n = 0: give a whole number"),
        ({"criterion": "E"}, "choose 'D', 'A' or 'I'"),
        ({"parameters": ["a9"]}, "unknown free coefficient in parameters 'a9'"),
        ({"parameters": "a3"}, "give a list of free coefficients"),
        ({"pressure": (6e5, 1e5)}, "the first the smaller"),
        ({"pressure": (0, 1e4), "contraction": (0.2, 0.25)}, "slack at all candidates"),
        ({"candidates": ([1e5], [0.1]), "pressure": (0, 1e5)}, "leave pressure and contraction"),
        ({"candidates": ([1e5, 2e5], [0.1])}, "equally long"),
        ({"repeats": 0}, "repeats = 0"),
        ({"noise": -1.0}, "noise = -1 N must be > 0"),
        ({"covariance": np.eye(6)}, "belong to a law"),
    ],
)
def test_bad_arguments_are_refused_in_words(
    fit: ForceFit, arguments: dict[str, Any], words: str
) -> None:
    refused(words, design_cells, fit, error=(InputError, UnknownNameError), **{"n": 4} | arguments)


def test_what_a_law_needs_is_named(fit: ForceFit) -> None:
    refused("noise is missing", design_cells, fit.law, 8)
    refused("pressure is missing", design_cells, fit.law, 8, noise=5.0)
    with pytest.raises(InputError, match=r"give finite numbers, \(6, 6\)"):
        design_cells(fit.law, 8, noise=5.0, covariance=np.eye(5))
    with pytest.raises(InputError, match="not positive definite"):
        design_cells(fit.law, 8, noise=5.0, covariance=np.diag([1, 1, 1, 1, 1, -1]))
    refused("known is a Muscle", design_experiment, pam.muscle("DMSP-20-400N"), 8)
