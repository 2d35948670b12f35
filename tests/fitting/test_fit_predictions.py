"""Predictions of static fits: quantities as written, no push, and where the data end."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from conftest import refused
from static_tables import fit_20, measured

import pam_ocp as pam


@pytest.fixture(scope="module")
def fit() -> Any:
    return fit_20()


@pytest.mark.parametrize(
    ("p", "kappa"),
    [("3 bar", 0.1), (3e5, "10 %"), ("0.3 MPa", "0.1"), (["3 bar", "300 kPa"], ["10 %", 0.1])],
)
def test_texts_with_units_are_quantities(fit: Any, p: Any, kappa: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit.predict(p, kappa)
    np.testing.assert_allclose(found.force, fit.law.tension(3e5, 0.1), rtol=1e-12)


def test_a_pressure_in_bar_is_doubted_with_the_unit_that_was_meant(fit: Any) -> None:
    with pytest.warns(pam.UnitWarning, match="did you mean 3 bar"):
        fit.predict(3, 0.1)
    with pytest.warns(pam.UnitWarning, match="did you mean 6 bar"):
        fit.predict([1, 3, 6], 0.1)


@pytest.mark.parametrize(
    ("p", "kappa", "words"),
    [
        (3e5, 10, "did you mean 10 % = 0.1"),
        (3e5, -1.2, "no contraction ratio"),
        (-2e5, 0.1, "below vacuum"),
        ("3 kg", 0.1, "something else than 'Pa'"),
        ("much", 0.1, "not a number"),
        (float("nan"), 0.1, "finite"),
        (3e5, True, "kappa = True"),
        ([[1e5, 2e5], [3e5]], 0.1, "rows differ in length"),
        ([1e5, 2e5, 3e5], [0.1, 0.2], "broadcast"),
    ],
)
def test_what_no_muscle_can_be_is_refused(fit: Any, p: Any, kappa: Any, words: str) -> None:
    refused(words, fit.predict, p, kappa)


def test_a_muscle_never_pushes(fit: Any) -> None:
    p, kappa = np.meshgrid(np.linspace(0.4e5, 6.7e5, 9), np.linspace(0.02, 0.25, 9))
    found = fit.predict(p, kappa)
    law = np.asarray(fit.law.tension(p, kappa))
    assert law.min() < -100
    np.testing.assert_array_equal(found.slack, law <= 0)
    np.testing.assert_allclose(found.force, np.maximum(law, 0.0))
    for low, high in (found.confidence, found.prediction):
        assert low.min() >= 0
        assert np.all((low <= found.force) & (found.force <= high))


def test_places_without_data_are_marked_and_said(fit: Any) -> None:
    with pytest.warns(pam.muscles.ValidityWarning, match="1 of 3 predictions lie outside"):
        found = fit.predict([3e5, 6e5, 9e5], 0.1)
    assert found.outside.tolist() == [False, False, True]


def test_a_corner_that_was_not_measured_is_outside_of_a_triangle_of_cells() -> None:
    table = measured()
    kept = table.subset(table.contraction < 0.28 - 0.26 * table.pressure / 6.75e5)
    part = pam.fit_force(kept, "polynomial-1-2")
    with pytest.warns(pam.muscles.ValidityWarning):
        assert part.predict(6.5e5, 0.2).outside
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not part.predict(1.5e5, 0.15).outside


def test_muscles_of_a_joint_fit_predict_likewise() -> None:
    member = pam.fit_forces({"a": measured(), "b": measured()})["a"]
    assert member.predict("1 bar", "20 %").force == 0
    refused("10 %", member.predict, "3 bar", 10)


def test_a_pressure_says_from_where_it_counts(fit: Any) -> None:
    assert fit.predict("1.5 bar(g)", 0.15).force == fit.predict("1.5 bar", 0.15).force
    assert fit.predict("1.5 barg", 0.15).force == fit.predict(1.5e5, 0.15).force
    for absolute in ("2.5 bar abs", "2.5 bara", "36 psia"):
        refused("gauge pressures here; take the ambient", fit.predict, absolute, 0.15)


def test_one_doubt_is_said_once(fit: Any) -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fit.predict(3, 0.1)
    assert sum("did you mean 3 bar" in str(w.message) for w in said) == 1
