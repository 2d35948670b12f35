"""Choice among structures: nested, honest, in parallel; and the yardstick."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from conftest import refused
from test_black_boxes import arx_process

import pam_ocp as pam
from pam_ocp.core.errors import FitError, InputError, OutOfTime
from pam_ocp.fitting import ArxStructure, choose


@dataclass(frozen=True)
class Power:
    """y = a polynomial of t, by least squares."""

    degree: int
    fails: bool = False

    @property
    def complexity(self) -> float:
        return self.degree + 1.0

    def fit(self, records: Sequence[pam.Trajectory], /) -> Any:
        if self.fails:
            raise FitError("never")
        t = np.concatenate([r.t for r in records])
        return np.polyfit(t, np.concatenate([r["y"] for r in records]), self.degree)

    def losses(self, model: Any, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        return np.array([np.mean((np.polyval(model, r.t) - r["y"]) ** 2) for r in records])


def parabolas(seed: int, count: int = 24, noise: float = 0.3) -> list[pam.Trajectory]:
    random = np.random.default_rng(seed)
    t = np.linspace(-1, 1, 12)
    return [
        pam.Trajectory(t, {"y": 1 + t - 2 * t**2 + noise * random.standard_normal(t.size)})
        for _ in range(count)
    ]


POWERS = {f"degree {d}": Power(d) for d in range(6)}


def test_the_simplest_that_is_not_behind_is_taken() -> None:
    names = [choose(POWERS, parabolas(s), seed=s).name for s in range(12)]
    assert names.count("degree 2") >= 10  # at 95 %, one in twenty may be taken for better
    assert all(n in ("degree 2", "degree 3", "degree 4", "degree 5") for n in names)


def test_losses_of_a_record_come_from_fits_without_its_fold() -> None:
    records = parabolas(3)
    found = choose(POWERS, records, seed=1)
    for i in (0, 7, 20):
        training = [r for r, k in zip(records, found.folds, strict=True) if k != found.folds[i]]
        by_hand = Power(2).losses(Power(2).fit(training), [records[i]])
        np.testing.assert_allclose(found["degree 2"].losses[i], by_hand)
    assert sorted(np.bincount(found.folds)) == [4, 5, 5, 5, 5]


def test_the_choice_of_a_fold_does_not_see_its_records() -> None:
    """Records of one fold may be anything: what is chosen for that fold stays the same."""
    records = parabolas(5)
    fair = choose(POWERS, records, seed=2)
    spoilt = [
        pam.Trajectory(r.t, {"y": 100 * np.sin(9 * r.t) + i}) if k == 0 else r
        for i, (r, k) in enumerate(zip(records, fair.folds, strict=True))
    ]
    again = choose(POWERS, spoilt, seed=2)
    np.testing.assert_array_equal(fair.folds, again.folds)
    assert again.chosen[0] == fair.chosen[0]
    winner = Power(int(again.chosen[0][-1]))
    model = winner.fit([r for r, k in zip(records, fair.folds, strict=True) if k != 0])
    left_out = [r for r, k in zip(spoilt, fair.folds, strict=True) if k == 0]
    by_hand = winner.losses(model, left_out)
    np.testing.assert_allclose(again.nested[again.folds == 0][:, 0], by_hand)


def test_the_winner_of_many_useless_structures_is_too_good_and_the_nested_loss_is_not() -> None:
    """Constants drawn at random: the best of 40 looks better than it is."""

    gaps = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        records = [pam.Trajectory([0.0, 1.0], {"y": random.standard_normal(2)}) for _ in range(12)]
        many = {f"{i}": _Guess(float(c)) for i, c in enumerate(random.normal(0, 0.5, 40))}
        found = choose(many, records, folds=4, rule="best", seed=seed, refit=False)
        gaps.append(found.rmse["RMSE"] ** 2 - float(found[found.name].loss[0]))
    assert min(gaps) > -1e-12
    assert np.mean(gaps) > 0


@dataclass(frozen=True)
class _Guess:
    value: float
    complexity: float = 1.0

    def fit(self, records: Sequence[pam.Trajectory], /) -> float:
        return self.value

    def losses(self, model: float, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        return np.array([np.mean((r["y"] - model) ** 2) for r in records])


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_any_executor_gives_the_same(pool: Any) -> None:
    records = parabolas(1)
    here = choose(POWERS, records, seed=4)
    told: list[tuple[int, int]] = []
    with pool(2) as executor:
        asked = {"executor": executor, "progress": lambda *a: told.append(a)}
        there = choose(POWERS, records, seed=4, **asked)
    assert there.name == here.name
    np.testing.assert_array_equal(there.nested, here.nested)
    assert told[-1] == (len(POWERS) * 15, len(POWERS) * 15)


def test_groups_stay_together_and_failures_are_told() -> None:
    records = parabolas(2)
    groups = [i // 3 for i in range(24)]
    found = choose({**POWERS, "broken": Power(2, fails=True)}, records, groups=groups, seed=0)
    for g in range(8):
        assert len(set(found.folds[3 * g : 3 * g + 3])) == 1
    assert "failed: FitError: never" in found.table()
    assert found.name != "broken"


@pytest.mark.parametrize(
    ("structures", "count", "options", "error", "words"),
    [
        (POWERS, 24, {"folds": 2}, InputError, "folds = 2"),
        (POWERS, 3, {}, InputError, "3 independent records make no 5 folds"),
        ({"a": 3}, 24, {}, InputError, r"structures\['a'\] is an int"),
        ({"broken": Power(2, fails=True)}, 24, {}, FitError, "no structure could be fitted"),
        (POWERS, 24, {"time_limit": 1e-9}, OutOfTime, None),
    ],
)
def test_what_cannot_be_is_refused(
    structures: Any, count: int, options: Any, error: Any, words: str | None
) -> None:
    refused(words, choose, structures, parabolas(0)[:count], error=error, **options)


def test_a_record_that_is_given_twice_is_refused_unless_both_are_in_one_group() -> None:
    records = parabolas(0)[:9]
    again = [*records, pam.Trajectory(records[4].t, {"y": records[4]["y"].copy()})]
    refused(r"records\[9\] is records\[4\] once more", choose, POWERS, again, folds=3)
    fold = choose(POWERS, again, folds=3, seed=1, groups=[*range(9), 4], refit=False).folds
    assert fold[9] == fold[4]


def test_an_arx_model_of_an_arx_process_predicts_it_to_its_noise() -> None:
    records = arx_process(0, 9, samples=80, noise=0.0, step=0.01)
    structure = ArxStructure(["q"], ["u"], 2, (0.1, 0.3), 0.05)
    model = structure.fit(records)
    np.testing.assert_allclose(model.coefficients[:, 0], [1.5, -0.7, 0.4, 0.2, 0], atol=1e-9)
    assert np.max(structure.losses(model, records)) < 1e-16
    orders = {f"{n}": ArxStructure(["q"], ["u"], n, (0.1, 0.3), 0.05) for n in (1, 2, 3)}
    assert choose(orders, records, folds=3, seed=0).rmse["RMSE 2"] < 1e-6
