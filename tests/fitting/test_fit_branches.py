"""Repeats and branches: what is kept, the F-test against its theory, and hysteresis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.stats import f as f_distribution
from scipy.stats import kstest

from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.fitting import ForceFit, ForceTable, fit_force, read_table
from pam_ocp.fitting.static.report import hysteresis, lack_of_fit
from pam_ocp.fitting.static.static import fit_branches
from pam_ocp.muscles.law import SixParameterLaw
from pam_ocp.muscles.laws.user_defined import polynomial_law

TRUTH = SixParameterLaw.from_published((12.789, 419.48, -0.45, -8.7013, 267.672, -309.603))
KAPPA = np.array([0.0, 0.03, 0.06, 0.1, 0.15])
PRESSURE = np.array([3e5, 4e5, 5e5, 6e5])


def cycles(repeats: int = 2, noise: float = 2.0, width: float = 0.0, seed: int = 0) -> ForceTable:
    """Every cell measured on inflation and deflation, ``repeats`` times; apart by ``width``."""
    random = np.random.default_rng(seed)
    rows = []
    for run in range(repeats):
        for branch, shift in (("inflation", -width / 2), ("deflation", width / 2)):
            for kappa in KAPPA:
                for p in PRESSURE if branch == "inflation" else PRESSURE[::-1]:
                    error = shift + noise * random.standard_normal()
                    force = float(TRUTH.tension(p, kappa)) + error
                    rows.append((p, kappa, force, branch, str(run + 1)))
    p, k, f, b, r = zip(*rows, strict=True)
    return ForceTable(np.array(p), np.array(k), np.array(f), 0.3, "cycles", b, r)


# ---- labels --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("branch", ("inflation", "inflation", "deflation")),
        ("Direction", ("up", "Up", "down")),
        ("phase", ("filling", "inflating", "venting")),
        ("direction", (1, 1, -1)),
        ("direction", (1.0, 1.0, -1.0)),
        ("direction", ("+", "+1", "-")),
    ],
)
def test_branches_are_recognised_in_the_usual_words(header: str, words: tuple[Any, ...]) -> None:
    cells = {"p [bar]": [2, 4, 4], "kappa": [0.1, 0.1, 0.1], "F [N]": [100, 300, 310]}
    table = read_table({**cells, header: words, "repeat": [1, 1, 2]})
    assert table.branch == ("inflation", "inflation", "deflation")
    assert table.run == ("1", "1", "2")
    assert table.branches == ("inflation", "deflation")
    assert table.of_branch("deflation").force.tolist() == [310]
    assert table.subset([2, 0]).branch == ("deflation", "inflation")
    assert table.subset(slice(1, 3)).run == ("1", "2")


def test_labels_of_other_columns_and_words(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("p_bar;kappa;F_N;way;cycle\n2;0.1;100;A;x\n4;0.1;300;B;y\n")
    table = read_table(path, columns={"branch": "way"})
    assert (table.branch, table.run) == (("A", "B"), ("x", "y"))
    assert read_table({"p_bar": [2], "kappa": [0.1], "F_N": [9]}).branch == ()
    refused("branch of the table 'C'", table.of_branch, "C", error=UnknownNameError)
    with pytest.raises(InputError, match="'direction' and 'phase' both read as branch"):
        read_table({"p_bar": [2], "kappa": [0.1], "F_N": [9], "direction": [1], "phase": ["up"]})
    with pytest.raises(InputError, match="branch has 1 labels for 2 cells"):
        ForceTable(np.ones(2), np.ones(2), np.ones(2), branch=("up",))


def test_labels_survive_a_saved_fit(tmp_path: Path) -> None:
    fit = fit_force(cycles())
    again = ForceFit.from_json(fit.to_json(tmp_path / "fit.json"))
    assert again.table.branch == fit.table.branch
    assert again.table.run == fit.table.run


# ---- repeats -------------------------------------------------------------------------------------
def test_the_f_test_is_that_of_an_analysis_of_variance() -> None:
    """A law linear in its coefficients, against sums computed group by group."""
    table = cycles(repeats=3, noise=3.0, seed=4)
    fit = fit_force(table, polynomial_law(1, 2))
    groups: dict[Any, list[float]] = {}
    for p, k, force, branch in zip(
        table.pressure, table.contraction, table.force, table.branch, strict=True
    ):
        groups.setdefault((p, k, branch), []).append(force)
    pure = sum(np.var(g) * len(g) for g in groups.values())
    left = fit.squares - pure
    a, b = len(groups) - len(fit.free), len(table) - len(groups)
    found = lack_of_fit(fit)
    assert (found.misfit_dof, found.pure_dof) == (a, b)
    assert found.pure_error == pytest.approx(np.sqrt(pure / b))
    assert found.f == pytest.approx(left / a / (pure / b))
    assert found.probability == pytest.approx(f_distribution.sf(found.f, a, b))


@pytest.mark.slow
def test_a_true_law_is_rejected_as_often_as_the_level_says() -> None:
    found = [lack_of_fit(fit_force(cycles(seed=seed))).probability for seed in range(80)]
    assert kstest(found, "uniform").pvalue > 0.01


def test_a_wrong_law_is_rejected() -> None:
    fit = fit_force(cycles(), "geometric", fixed={"radius": 0.01})
    assert lack_of_fit(fit).probability < 1e-6
    assert "leaves something out" in fit.report()
    assert fit.lack_of_fit() == lack_of_fit(fit)


def test_what_the_test_needs_is_named() -> None:
    with pytest.raises(InputError, match="no cell of the table was measured twice"):
        lack_of_fit(fit_force(read_table("DMSP-20-300_static.csv", rest_length=0.3)))
    refused("loss='squares'", lack_of_fit, fit_force(cycles(), loss="huber"))
    assert "[[Repeats]]" not in fit_force(cycles(repeats=1)).report()


# ---- branches ------------------------------------------------------------------------------------
def test_hysteresis_is_the_width_between_the_branches() -> None:
    found = hysteresis(cycles(repeats=3, noise=2.0, width=30.0))
    assert found.width.size == 60
    assert found.mean == pytest.approx(30.0, abs=3 * found.stderr)
    # each width holds one cell of inflation and the mean of three of deflation
    assert found.stderr == pytest.approx(2.0 * np.sqrt((1 + 1 / 3) / 60), rel=0.25)
    assert list(found.by_level()) == pytest.approx(KAPPA)
    assert "deflation less inflation" in str(found)


def test_deflation_is_interpolated_along_pressure_only() -> None:
    p, kappa = np.array([2e5, 4e5, 3e5, 5e5, 2.5e5]), np.array([0.1] * 4 + [0.2])
    force = np.array([100.0, 300.0, 190.0, 390.0, 50.0])
    branch = ("deflation",) * 2 + ("inflation",) * 3
    found = hysteresis(ForceTable(p, kappa, force, branch=branch))
    assert found.pressure.tolist() == [3e5]
    assert found.width == pytest.approx([200.0 - 190.0])


def test_each_branch_is_fitted_and_reported() -> None:
    table = cycles(repeats=2, noise=0.5, width=20.0)
    fits = fit_branches(table)
    assert tuple(fits) == ("inflation", "deflation")
    gap = fits["deflation"].law.tension(4e5, 0.05) - fits["inflation"].law.tension(4e5, 0.05)
    assert gap == pytest.approx(20.0, abs=1.0)
    report = fit_force(table).report()
    assert "[[Branches]]" in report
    line = next(row for row in report.splitlines() if row.strip().startswith("deflation:"))
    assert float(line.split(",")[1].split()[0]) == pytest.approx(10.0, abs=0.5)


def test_the_rest_length_of_a_table_may_be_a_text_with_its_unit() -> None:
    table = ForceTable(np.ones(2), np.ones(2) * 0.1, np.ones(2), "300 mm")  # type: ignore[arg-type]
    assert table.rest_length == pytest.approx(0.3)


def test_tables_without_branches_are_refused() -> None:
    plain = ForceTable(np.ones(2), np.ones(2) * 0.1, np.ones(2))
    refused(r"no cells of inflation \(branches: none\)", hysteresis, plain)
    refused("the table has no branches", fit_branches, plain)
    refused("weights belong to a whole table", fit_branches, cycles(), weights=np.ones(80))
    p, branch = np.array([1e5, 2e5, 3e5]), ("inflation", "deflation", "deflation")
    apart = ForceTable(p, np.full(3, 0.1), np.ones(3), branch=branch)
    refused("share no range of pressure", hysteresis, apart)
