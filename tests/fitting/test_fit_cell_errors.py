"""A table that carries the errors of its cells is fitted with them."""

from __future__ import annotations

import numpy as np
from conftest import refused

import pam_ocp as pam
from pam_ocp.fitting import ForceTable

TRUE = np.array([30.0, 900.0, -1500.0, 2000.0])


def terms(p: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """polynomial-1-1: 1, p, kappa, p kappa, in bar."""
    return np.column_stack([np.ones_like(p), p / 1e5, kappa, p / 1e5 * kappa])


def table(known: bool = True) -> ForceTable:
    random = np.random.default_rng(5)
    p, kappa = (a.ravel() for a in np.meshgrid(1e5 * np.arange(2, 7), [0.0, 0.05, 0.1, 0.15]))
    error = random.uniform(2.0, 20.0, p.size)
    force = terms(p, kappa) @ TRUE + error * random.standard_normal(p.size) + 3000.0
    return ForceTable(p, kappa, force, 0.3, error=error if known else None)


def weighted(cells: ForceTable, w: np.ndarray) -> np.ndarray:
    a = terms(cells.pressure, cells.contraction)
    return a @ np.linalg.lstsq(a * w[:, None], cells.force * w, rcond=None)[0]


def test_cells_weigh_by_their_errors() -> None:
    cells = table()
    assert cells.error is not None
    usual = np.median(cells.error)
    w = 1 / np.maximum(cells.error, 0.3 * usual)
    fit = pam.fit_force(cells, "polynomial-1-1")
    found = cells.force - fit.residuals
    np.testing.assert_allclose(found, weighted(cells, w), rtol=1e-6)
    assert "cells are weighted, from" in fit.report()


def test_as_equals_where_that_is_wished_or_nothing_is_known() -> None:
    for cells, weights in ((table(), "equal"), (table(known=False), None)):
        fit = pam.fit_force(cells, "polynomial-1-1", weights=weights)
        found = cells.force - fit.residuals
        np.testing.assert_allclose(found, weighted(cells, np.ones(len(cells))), rtol=1e-6)
        assert fit.weights is None
    refused("weights = 'even'", pam.fit_force, table(), weights="even")
