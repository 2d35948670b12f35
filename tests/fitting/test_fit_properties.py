"""What must hold for every start, every muscle and every noise: global optimum, honest errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f as fisher
from static_tables import PUBLISHED, TRUTH, fit_20, grid, measured

from pam_ocp.fitting import ForceFit, ForceTable, fit_force
from pam_ocp.muscles.law import SixParameterLaw

DATA_SETS = 500
SOME = 40
"""Of them, where each is looked at one by one."""
NOISE = 5.0
# |kappa| levels and pressures of the DMSP-20-300's table, where the noise turns no cell slack
P, KAPPA = grid(np.array([0.0133, 0.06, 0.11, 0.1667, 0.21]), np.linspace(1e5, 6.75e5, 12))
TENSION = TRUTH.tension(P, KAPPA)
TAUT = TENSION > 6 * NOISE


def profile_squares(fit: ForceFit, name: str, value: float) -> float:
    """Least squares of a whole fit with one coefficient held."""
    return fit_force(fit.table, type(fit.law), fixed={name: value}).squares


def values(fit: ForceFit) -> np.ndarray:
    return np.array(list(fit.law.values.values()))


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_300_random_starts_of_each_muscle_end_at_one_optimum(name: str) -> None:
    table = measured(name)
    reference = values(fit_force(table))
    random = np.random.default_rng(1000)
    for _ in range(300):
        start = float(random.choice([-1, 1]) * 10 ** random.uniform(-4, 5))
        np.testing.assert_allclose(
            values(fit_force(table, start={"a3": start})), reference, rtol=1e-6
        )


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(
        st.floats(-10, 15),
        st.floats(150, 450),
        st.floats(-0.7, -0.2),
        st.floats(-10, -2),
        st.floats(150, 350),
        st.floats(-320, -150),
    ),
    st.floats(-5, 5),
)
def test_exact_data_give_the_coefficients_back(
    published: tuple[float, ...], exponent: float
) -> None:
    truth = SixParameterLaw.from_published(published)
    p, kappa = grid(np.linspace(0, 0.2, 6), np.linspace(2e5, 8e5, 6))
    force = truth.tension(p, kappa)
    table = ForceTable(p, kappa, force)
    if np.sum(~table.slack) < 24 or len(np.unique(kappa[~table.slack])) < 5:
        return
    found = fit_force(table, start={"a3": 10**exponent})
    np.testing.assert_allclose(values(found), list(truth.values.values()), rtol=1e-5, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 10))
def test_a_stronger_muscle_scales_its_force_coefficients_alone(factor: float) -> None:
    one, table = fit_20(), measured()
    other = fit_force(ForceTable(table.pressure, table.contraction, factor * table.force))
    scale = np.array([factor, factor, 1, factor, factor, factor])
    np.testing.assert_allclose(values(other), scale * values(one), rtol=1e-7)
    assert other.rmse == pytest.approx(factor * one.rmse)
    assert other.coefficients["a3"].stderr == pytest.approx(one.coefficients["a3"].stderr)


@pytest.fixture(scope="module")
def replicas() -> list[ForceFit]:
    """Fits of one muscle measured again and again with noise of 5 N."""
    random = np.random.default_rng(2015)
    p, kappa, tension = P[TAUT], KAPPA[TAUT], TENSION[TAUT]
    noise = NOISE * random.standard_normal((DATA_SETS, p.size))
    return [fit_force(ForceTable(p, kappa, tension + e), errors="independent") for e in noise]


@pytest.mark.slow
def test_95_percent_intervals_cover_the_truth_in_93_to_97_percent(
    replicas: list[ForceFit],
) -> None:
    """The intervals that a report prints, for all six.

    Linearised ones are a little short for a2 and a3, which stand in one term (92.8 and 93.6 %).
    """
    everything = [fit.intervals() for fit in replicas]
    for name, truth in TRUTH.values.items():
        within = [low <= truth <= high for low, high in (e[name] for e in everything)]
        assert 0.93 <= np.mean(within) <= 0.97, name
        # the same without ends: inside where holding the truth costs no more than F(1, dof) allows
        inside = [
            profile_squares(fit, name, truth) - fit.squares
            <= fisher.ppf(0.95, 1, fit.dof) * fit.squares / fit.dof
            for fit in replicas[:SOME]
        ]
        assert sum(a != b for a, b in zip(within, inside, strict=False)) <= 1


@pytest.mark.slow
def test_prediction_intervals_cover_a_new_measurement(replicas: list[ForceFit]) -> None:
    random, hits = np.random.default_rng(7), 0
    for fit in replicas:
        low, high = fit.predict(4e5, 0.09).prediction
        hits += bool(low <= TRUTH.tension(4e5, 0.09) + NOISE * random.standard_normal() <= high)
    assert 0.93 <= hits / DATA_SETS <= 0.97


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_repeated_measurements(replicas: list[ForceFit]) -> None:
    scatter = np.std([values(f) for f in replicas], axis=0, ddof=1)
    stated = np.mean([[c.stderr for c in f.coefficients.values()] for f in replicas], axis=0)
    # a standard deviation from 500 samples is itself known to 3 %; three of these
    np.testing.assert_allclose(stated, scatter, rtol=0.10)
    assert np.mean([f.sigma for f in replicas]) == pytest.approx(NOISE, rel=0.03)
