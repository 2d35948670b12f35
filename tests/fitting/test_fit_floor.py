"""Slack cells that do not read zero: found, named, censored, in every fit and view of a table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.special import pdtrc

import pam_ocp as pam
from pam_ocp.fitting import ForceTable, hysteresis, look
from pam_ocp.fitting.tables.floor import _poisson
from pam_ocp.muscles.law import SixParameterLaw

TRUTH = SixParameterLaw.from_published((12.789, 419.48, -0.45, -8.7013, 267.672, -309.603))
P, KAPPA = (a.ravel() for a in np.meshgrid(np.linspace(0.5e5, 6e5, 12), np.linspace(0, 0.24, 7)))
PULL = np.asarray(TRUTH.tension(P, KAPPA))


def readings(floor: Any, scatter: float, seed: int = 0, noise: float = 4.0, zero: Any = 0.0) -> Any:
    """What a load cell shows: ``floor`` where slack, ``zero`` beside the force elsewhere."""
    random = np.random.default_rng(seed)
    taut = PULL + zero + noise * random.standard_normal(P.size)
    return np.where(PULL > 0, taut, floor + scatter * random.standard_normal(P.size))


def measured(floor: Any, scatter: float = 0.8, **options: Any) -> ForceTable:
    return ForceTable(P, KAPPA, readings(floor, scatter, **options), rest_length=0.3)


def held(fit: Any) -> int:
    return sum(low <= TRUTH.values[name] <= high for name, (low, high) in fit.intervals().items())


# ---- found and named -----------------------------------------------------------------------------
@pytest.mark.parametrize("scatter", [0.0, 0.8, 3.0])
@pytest.mark.parametrize("floor", [-5.0, 0.0, 5.0, 12.0])
def test_a_floor_is_found_and_its_cells_are_no_forces(floor: float, scatter: float) -> None:
    table = measured(floor, scatter, seed=3)
    # no cell where the law pushes is left among the forces; of those that pull hardly one is lost
    assert PULL[~table.slack].min() > -2 * 4.0
    assert PULL[table.slack].max() < max(floor, 0.0) + 4 * scatter + 3 * 4.0
    fit = pam.fit_force(table)
    assert fit.rmse < 6.0
    assert held(fit) >= 5
    found = table.floor_found
    if scatter:
        assert found is not None
        assert found.value == pytest.approx(floor, abs=4 * max(scatter, 0.5) / np.sqrt(found.cells))
        assert found.scatter == pytest.approx(scatter, rel=0.6)
        assert any(f"{found.cells} cells read" in words for words in fit.warnings)
        assert f"{found.cells} cells read" in fit.report()


def test_few_readings_far_below_zero_are_a_floor_for_no_muscle_pushes() -> None:
    """Seven of 46 cells: too few for the surface of the others to say that they are slack."""
    cells = np.meshgrid(np.linspace(1e5, 6e5, 6), [0, 0.1, 0.2, 0.23])
    pressure, kappa = (a.ravel() for a in cells)
    pull = np.asarray(TRUTH.tension(pressure, kappa))
    reads = np.maximum(pull, 0.0) - 35.0
    found = ForceTable(pressure, kappa, reads).floor_found
    assert found is not None
    assert found.value == pytest.approx(-35.0, abs=5.0)
    assert abs(found.cells - np.sum(pull <= 0)) <= 2  # of those that hardly pull
    noise = 2.0 * np.random.default_rng(1).standard_normal(pull.size)
    usual = ForceTable(pressure, kappa, np.maximum(pull, 0.0) + noise).floor_found
    assert usual is None or abs(usual.value) < 3.0  # noise about zero is no floor below it


def test_a_floor_that_is_not_looked_for_spoils_the_fit() -> None:
    """What the floor is for: the same readings, taken for forces."""
    table = measured(5.0)
    spoiled = pam.fit_force(table.with_floor(None))
    assert spoiled.rmse > 5 * pam.fit_force(table).rmse


def test_floors_by_branch_are_told_apart() -> None:
    branch = np.where(np.arange(P.size) % 2 == 0, "inflation", "deflation")
    shown = readings(np.where(branch == "inflation", 6.0, -3.0), 0.5)
    table = ForceTable(P, KAPPA, shown, branch=tuple(branch))
    found = table.floor_found
    assert found is not None
    assert found.by["inflation"] == pytest.approx(6.0, abs=0.5)
    assert found.by["deflation"] == pytest.approx(-3.0, abs=0.5)
    assert PULL[~table.slack].min() > -8.0
    fits = pam.fitting.fit_branches(table).values()
    assert sum(len(f.table) - f.n for f in fits) == table.slack.sum()


@pytest.mark.parametrize("words", ["with pressure", "from the first to the last"])
def test_a_floor_that_moves_is_named_so(words: str) -> None:
    along = P / 6e5 if words == "with pressure" else np.arange(P.size) / P.size
    table = measured(3.0 + 8.0 * along, 0.2)
    assert table.floor_found is not None
    assert words in table.floor_found.trend
    assert PULL[~table.slack].min() > -8.0


# ---- nothing is invented -------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(8))
def test_no_floor_is_invented_where_all_cells_pull(seed: int) -> None:
    random = np.random.default_rng(seed)
    chosen = np.nonzero(random.uniform(1, 40) < PULL)[0]
    force = PULL[chosen] + random.choice([0.1, 1.0, 4.0]) * random.standard_normal(chosen.size)
    table = ForceTable(P[chosen], KAPPA[chosen], np.maximum(force, 0.5))
    assert table.floor_found is None
    assert not table.slack.any()


@pytest.mark.parametrize(
    ("count", "expected"), [(3, 1e-9), (3, 0.4), (12, 2.5), (40, 39.0), (5, 0)]
)
def test_the_chance_of_so_many_readings_is_that_of_poisson(count: int, expected: float) -> None:
    assert _poisson(count, expected) == pytest.approx(float(pdtrc(count - 1, expected)), rel=1e-12)


def test_repeats_of_the_least_cell_are_no_floor() -> None:
    p, k = np.tile([3e5, 4e5, 5e5, 6e5], 5), np.repeat([0.0, 0.03, 0.06, 0.1, 0.15], 4)
    force = np.asarray(TRUTH.tension(p, k))
    three = np.tile(force, 3) + np.random.default_rng(1).normal(0, 1.0, 60)
    table = ForceTable(np.tile(p, 3), np.tile(k, 3), three)
    assert not table.slack.any()


def test_small_forces_that_follow_the_law_are_forces() -> None:
    """Near its largest contraction a muscle pulls with a few newtons at every pressure."""
    p, k = (a.ravel() for a in np.meshgrid(np.linspace(1e5, 6e5, 8), np.linspace(0, 0.245, 8)))
    force = 1e-3 * p * (1 - k / 0.25)  # 2 to 12 N at the last contraction
    force += np.random.default_rng(0).normal(0, 0.3, p.size)
    table = ForceTable(p, k, force)
    assert not table.slack.any()


def test_bundled_tables_are_as_they_were() -> None:
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
    np.testing.assert_array_equal(table.slack, table.force <= 0)


# ---- the zero of a load cell ---------------------------------------------------------------------
def test_the_zero_of_a_load_cell_is_taken_off_all_forces_when_asked() -> None:
    table = measured(8.0, 0.8, zero=8.0)
    assert held(pam.fit_force(table.with_floor("zero"))) == 6
    mended = table.with_floor("zero")
    assert np.mean((mended.force - PULL)[PULL > 0]) == pytest.approx(0.0, abs=1.5)
    assert mended.with_floor("zero").force == pytest.approx(mended.force)  # once is enough
    refused("'5 N', 'found', 'zero' or None", table.with_floor, "what")


@pytest.mark.parametrize(
    ("zero", "words"), [(8.0, "taut cells carry it, too"), (0.0, "taut cells do not carry it")]
)
def test_a_fit_says_whether_taut_cells_carry_the_zero(zero: float, words: str) -> None:
    """F = pi r2 p (a (1 - kappa)2 - b), a = 3/tan2(alpha), b = 1/sin2(alpha), has no constant."""
    p, k = (a.ravel() for a in np.meshgrid(np.linspace(1e5, 6e5, 8), np.linspace(0, 0.45, 10)))
    a, b = 3 / np.tan(0.4) ** 2, 1 / np.sin(0.4) ** 2
    pull = np.pi * 0.01**2 * p * (a * (1 - k) ** 2 - b)
    shown = np.where(pull > 0, pull + zero, 8.0)
    shown += np.random.default_rng(2).normal(0, 1.0, p.size)
    fit = pam.fit_force(ForceTable(p, k, shown), "geometric", fixed={"radius": 0.01})
    assert any(words in text for text in fit.warnings)


def test_there_is_no_zero_to_take_off_without_slack_cells() -> None:
    chosen = PULL > 50
    table = ForceTable(P[chosen], KAPPA[chosen], PULL[chosen])
    refused("no cells that are slack", table.with_floor, "zero")


# ---- everywhere ----------------------------------------------------------------------------------
def columns(table: ForceTable, **more: Any) -> dict[str, Any]:
    return {"p [Pa]": table.pressure, "kappa [1]": table.contraction, "F [N]": table.force, **more}


def test_a_file_is_read_with_its_floor_which_look_says() -> None:
    data = columns(measured(5.0))
    with pytest.warns(pam.fitting.ReadingWarning, match="cells read .* where the muscle is slack"):
        table = pam.read_table(data)
    assert PULL[~table.slack].min() > -8.0
    assert "where the muscle is slack" in str(look(data))
    assert pam.read_table(data, floor=None).slack.sum() == np.sum(table.force <= 0)
    with pytest.warns(pam.fitting.ReadingWarning, match="floor of the sensor, 9 N"):
        assert (pam.read_table(data, floor="9 N").force[table.slack] <= 0).all()
    with pytest.warns(pam.fitting.ReadingWarning, match="taken off all forces"):
        zero = pam.read_table(data, floor="zero")
    assert zero.force[~zero.slack].max() == pytest.approx(table.force.max() - 5.0, abs=0.5)


def test_laws_are_ranked_on_the_same_cells() -> None:
    table = measured(5.0)
    found = pam.compare_laws(table, ["six-parameter", "polynomial-1-1"])
    assert {law.fit.n for law in found.laws if law.fit} == {int(np.sum(~table.slack))}
    assert found.best.name == "six-parameter"
    assert found.best.left_out_rmse < 10.0


def test_joint_fits_and_campaigns_leave_slack_cells_out() -> None:
    tables = {"one": measured(5.0, seed=1), "two": measured(-4.0, 3.0, seed=2)}
    joint = pam.fit_forces(tables)
    assert joint.rmse < 6.0
    assert any(words.startswith("one: ") for words in joint.warnings)
    campaign = pam.fit_forces(tables, candidates=["six-parameter"], rest_length=0.3)
    assert max(study.fit.rmse for study in campaign.muscles.values()) < 6.0


def test_hysteresis_is_that_of_taut_cells() -> None:
    force = np.concatenate([readings(6.0, 0.5, noise=0.5), readings(-2.0, 0.5, noise=0.5, zero=20)])
    branch = ("inflation",) * P.size + ("deflation",) * P.size
    table = ForceTable(np.tile(P, 2), np.tile(KAPPA, 2), force, branch=branch)
    found = hysteresis(table)
    assert found.mean == pytest.approx(20.0, abs=0.5)
    assert found.width.min() > 15.0


def test_censored_cells_may_hide_what_the_load_cell_does() -> None:
    fit = pam.fit_force(measured(5.0, 2.0), censored=True)
    assert fit.rmse < 6.0
    assert held(fit) >= 5


def test_a_saved_fit_keeps_its_floor(tmp_path: Any) -> None:
    fit = pam.fit_force(measured(5.0).with_floor("zero"))
    again = pam.fitting.ForceFit.from_json(fit.to_json(tmp_path / "fit.json"))
    np.testing.assert_array_equal(again.table.slack, fit.table.slack)
    assert again.table.floor_found == fit.table.floor_found
    assert again.rmse == pytest.approx(fit.rmse)


def test_a_ramp_with_a_floor_is_fitted_as_one_without() -> None:
    """15 slow ramps of pressure, 1 N of noise: cells across the kink are left out, too."""
    random = np.random.default_rng(5)
    p = np.tile(np.concatenate([np.linspace(0.3e5, 6e5, 300), np.linspace(6e5, 0.3e5, 300)]), 8)
    k = np.repeat(np.linspace(0, 0.22, 8), 600)
    pull = np.maximum(np.asarray(TRUTH.tension(p, k)), 0.0)
    data = {"p [Pa]": p, "kappa [1]": k, "F [N]": pull + 6.0 + random.normal(0, 1.0, p.size)}
    with pytest.warns(pam.fitting.ReadingWarning):
        table = pam.read_table(data, rest_length=0.3, floor="zero")
    assert pam.fit_force(table).rmse < 2.0


def test_a_law_that_pushes_at_a_reading_says_so() -> None:
    """Two slack cells are too few for a floor; the law that is far below them is a sign."""
    chosen = np.nonzero(PULL > 30)[0]
    low = np.argsort(PULL)[:2]
    force = np.concatenate([PULL[chosen], [6.0, 7.0]])
    index = np.concatenate([chosen, low])
    fit = pam.fit_force(ForceTable(P[index], KAPPA[index], force), loss="bisquare")
    assert any("the law pushes at 2 taut cells" in words for words in fit.warnings)
