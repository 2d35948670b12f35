"""The Kalman filter's correction by a measurement, for all estimators."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["corrected"]

Array: TypeAlias = NDArray[np.float64]


def corrected(covariance: Array, c: Array, noise: Array) -> tuple[Array, Array]:
    """Gain (n, measured) and covariance (n, n) after a measurement y = c x + noise.

    noise : variances. The covariance in Joseph's form, which rounding leaves symmetric and positive
    (R. S. Bucy and P. D. Joseph, Filtering for Stochastic Processes, 1968).
    """
    r = np.diag(noise)
    gain = np.linalg.solve(c @ covariance @ c.T + r, c @ covariance).T
    keep = np.eye(len(covariance)) - gain @ c
    return gain, keep @ covariance @ keep.T + gain @ r @ gain.T
