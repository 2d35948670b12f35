"""Student's t and Fisher's F without SciPy, which takes a third of a second to load.

Student's t for whole degrees of freedom by its finite series (M. Abramowitz, I. Stegun, Handbook of
Mathematical Functions (1964), 26.7.3 and 26.7.4): the probability of |t| < x is a polynomial in
cos(theta), tan(theta) = x / sqrt(dof), of positive terms. Fisher's F by the continued fraction of
the incomplete beta function (the same, 26.5.8 and 26.6.2).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["f_beyond", "half_width", "mixed_half_width", "within"]

Array: TypeAlias = NDArray[np.float64]

LONGEST = 2000
"""Degrees of freedom up to which we compute ourselves [1]; beyond SciPy is quicker and, for want of
digits of the gamma function's logarithm, more exact.
"""
TINY = 1e-300
"""Stands for a zero in Lentz' method."""
STEPS = 2000
"""Most Newton steps; an unlikely quantile of one degree of freedom is approached by doubling."""


def within(half: Array, dof: int) -> Array:
    """The probability that |t| < half (>= 0) with so many degrees of freedom (>= 1)."""
    if dof > LONGEST or dof != int(dof):
        from scipy.special import stdtr

        return np.asarray(1.0 - 2.0 * stdtr(dof, -np.asarray(half, float)))
    half = np.asarray(half, float)[..., None]
    angle = np.arctan(half / math.sqrt(dof))
    sine, cosine = np.sin(angle), np.cos(angle)
    odd = int(dof) % 2
    k = np.arange(1, (int(dof) - odd) // 2)  # terms behind the first
    factors = (2 * k - 1 + odd) / (2 * k + odd)
    series = 1.0 + np.sum(np.cumprod(factors * cosine**2, axis=-1), axis=-1, keepdims=True)
    if not odd:
        return np.asarray((sine * series)[..., 0])
    rest = sine * cosine * series if dof > 1 else 0.0
    return np.asarray(((angle + rest) * (2 / math.pi))[..., 0])


def _density(half: Array, dof: int) -> Array:
    """The derivative of :func:`within`."""
    size = math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2) - 0.5 * math.log(dof * math.pi)
    return np.asarray(2 * np.exp(size - (dof + 1) / 2 * np.log1p(half**2 / dof)))


def mixed_half_width(level: float, dof: int, weights: Array, spreads: Array) -> float:
    """The h with sum(weights P(|t| < h / spreads)) = level, of weights whose sum is one.

    The sum rises ever less steeply: Newton's method from the left never passes the root.
    """
    # a normal quantile lies to the left of Student's, the least spread to the left of all
    half = _normal_half(level) * float(np.min(spreads))
    for _ in range(STEPS):
        missing = level - float(weights @ within(half / spreads, dof))
        slope = float(weights @ (_density(half / spreads, dof) / spreads))
        longer = half + missing / slope if slope > 0 else half
        if not longer > half * (1 + 1e-15):
            return half
        half = longer
    return half


@lru_cache(maxsize=256)
def half_width(level: float, dof: int) -> float:
    """The h with P(|t| < h) = level, 0 < level < 1."""
    return mixed_half_width(level, dof, np.ones(1), np.ones(1))


def _normal_half(level: float) -> float:
    from statistics import NormalDist

    return NormalDist().inv_cdf((1 + level) / 2) * (1 - 1e-9) if level < 1 - 1e-15 else 1.0


def f_beyond(more: float, dof: float, f: float) -> float:
    """The probability that Fisher's F with (more, dof) degrees of freedom (> 0) exceeds f."""
    if math.isnan(f) or f <= 0:
        return math.nan if math.isnan(f) else 1.0
    if max(more, dof) > LONGEST:
        from scipy.special import fdtrc

        return float(fdtrc(more, dof, f))
    below = dof + more * f
    a, b, x, y = dof / 2, more / 2, dof / below, more * f / below
    if x < (a + 1) / (a + b + 2):  # where the fraction converges quickly
        return _beta_share(a, b, x, y)
    return 1.0 - _beta_share(b, a, y, x)


def _beta_share(a: float, b: float, x: float, y: float) -> float:
    """The regularised incomplete beta function I_x(a, b), y = 1 - x, by modified Lentz' method."""
    if x <= 0:
        return 0.0
    size = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    front = math.exp(size + a * math.log(x) + b * math.log(y)) / a
    c, d = 1.0, 1.0 / _nonzero(1.0 - (a + b) * x / (a + 1))
    value = d
    for m in range(1, STEPS):
        factor = 1.0
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d, c = 1.0 / _nonzero(1.0 + term * d), _nonzero(1.0 + term / c)
            factor *= c * d
        value *= factor
        if abs(factor - 1.0) < 1e-16:
            break
    return front * value


def _nonzero(value: float) -> float:
    return value if abs(value) > TINY else TINY
