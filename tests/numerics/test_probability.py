"""Student's t and Fisher's F of our own, against SciPy's."""

import numpy as np
import pytest
from scipy.special import betainc, fdtrc, stdtr
from scipy.stats import t as student

from pam_ocp.numerics.probability import LONGEST, f_beyond, half_width, mixed_half_width, within


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 7, 54, 999, 1000, LONGEST, LONGEST + 1, 60_000])
def test_students_probabilities_and_half_widths(dof):
    half = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 60)])
    share = half**2 / (dof + half**2)
    assert within(half, dof) == pytest.approx(betainc(0.5, dof / 2, share), rel=1e-10)
    for level in (0.01, 0.5, 0.683, 0.95, 0.99, 0.999):
        assert half_width(level, dof) == pytest.approx(student.ppf((1 + level) / 2, dof), rel=1e-9)


def test_half_widths_of_improbable_levels_stay_exact():
    """Of one and two degrees of freedom they have closed forms."""
    for level in (1e-6, 0.999999, 1 - 1e-9):
        cauchy = np.tan(np.pi * level / 2)
        assert half_width(level, 1) == pytest.approx(cauchy, rel=1e-6)
        assert half_width(level, 2) == pytest.approx(level * np.sqrt(2 / (1 - level**2)), rel=1e-6)


def test_a_mixture_of_spreads_has_the_level_that_is_asked_for():
    drawn = np.random.default_rng(3)
    for dof in (3, 54, 5000):
        spreads = drawn.uniform(0.5, 8.0, 30)
        weights = drawn.uniform(0.0, 1.0, 30)
        weights /= weights.sum()
        for level in (0.5, 0.95, 0.999):
            half = mixed_half_width(level, dof, weights, spreads)
            reached = weights @ (2 * stdtr(dof, half / spreads) - 1)
            assert reached == pytest.approx(level, abs=1e-12)


def test_fishers_tail_against_scipy():
    drawn = np.random.default_rng(4)
    for largest in (6, 60, LONGEST, 4 * LONGEST):
        for _ in range(300):
            more, dof = drawn.integers(1, largest, 2).tolist()
            f = float(10 ** drawn.uniform(-3, 3))
            expected = float(fdtrc(more, dof, f))
            assert f_beyond(more, dof, f) == pytest.approx(expected, rel=1e-10, abs=1e-280)
    assert f_beyond(3, 4, 0.0) == 1.0
    assert f_beyond(3, 4, float("inf")) == 0.0
    assert np.isnan(f_beyond(3, 4, float("nan")))
