"""Scales of robust fits: what a measurement scatters by when a few are far off."""

from __future__ import annotations

import numpy as np

from ..statistics import Array
from .least_squares import Terms

__all__ = ["BISQUARE", "HUBER", "robust_scale", "spread"]

HUBER = 1.345
"""Standard deviations at which Huber's loss goes over: 95 % efficient for normal errors."""
BISQUARE = 4.685
"""Standard deviations from which Tukey's bisquare counts a cell no more: also 95 % efficient."""


def spread(residuals: Array, fitted: int) -> float:
    """Standard deviation of normal errors from the median of the largest n - fitted residuals.

    A fit of k coefficients by absolute values leaves k residuals at zero, which say nothing.
    """
    size = np.sort(np.abs(residuals))[min(fitted, residuals.size - 1) :]
    return float(np.median(size) / 0.6745)


def robust_scale(terms: Terms, residuals: Array, fitted: int) -> float:
    """The factor s of the covariance s^2 (J^T J)^-1 of a robust fit (weighted residuals [N]).

    Huber, bisquare: P. Huber, Robust Statistics (1981), eq. 7.6.6, with its correction for small
    samples.
    Absolute values: 1/(2 f(0)), the density f of the residuals by a normal kernel of Silverman's
    width (asymptotic; G. Bassett, R. Koenker, J. Am. Stat. Assoc. 73 (1978) 618-622).
    """
    n = residuals.size
    if terms.loss == "huber":
        inside = float(np.mean(np.abs(residuals) <= terms.threshold))
        slopes = np.clip(residuals, -terms.threshold, terms.threshold)
        correction = 1 + fitted / n * (1 - inside) / inside
        return float(correction * np.sqrt(np.sum(slopes**2) / (n - fitted)) / inside)
    if terms.loss == "bisquare":
        near = terms.reweighting(residuals, 0.0)  # 1 - u2
        slopes = residuals * near**2
        bends = near * (5 * near - 4)  # (1 - u2)(1 - 5 u2), 0 beyond
        mean = float(np.mean(bends))
        correction = 1 + fitted / n * float(np.var(bends)) / mean**2
        return float(correction * np.sqrt(np.sum(slopes**2) / (n - fitted)) / mean)
    width = 1.06 * spread(residuals, fitted) * n**-0.2
    if not width > 0:
        return 0.0  # most residuals are zero: the fit is exact
    density = np.mean(np.exp(-((residuals / width) ** 2) / 2)) / (width * np.sqrt(2 * np.pi))
    return float(1 / (2 * density) * np.sqrt(n / (n - fitted)))
