"""The Kalman filter's correction by a measurement, for all estimators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

__all__ = ["corrected", "taken_in"]

Array: TypeAlias = NDArray[np.float64]


def taken_in(
    known: tuple[ca.SX, ca.SX],
    at: ca.SX,
    seen: tuple[ca.SX, ca.SX],
    measured: ca.SX,
    noise: Array,
    weights: Sequence[ca.SX],
) -> tuple[ca.SX, ca.SX]:
    """Mean and covariance (n, n) after a measurement, from those before, ``known``.

    seen : the measurement of the model and its Jacobian (measured, n) at the state ``at``.
    noise : variances of the measured values, which are independent and so taken in one by one.
    weights : what their inverses are multiplied by; 0 for a value that is missing.
    The covariance in Joseph's form, which rounding leaves symmetric and positive (R. S. Bucy and
    P. D. Joseph, Filtering for Stochastic Processes, 1968).
    """
    mean, covariance = known
    values, slopes = seen
    eye = ca.SX.eye(mean.numel())
    for i, (variance, weight) in enumerate(zip(noise.tolist(), weights, strict=True)):
        c = slopes[i, :]
        across = covariance @ c.T
        gain = across / (weight * (c @ across) + variance)
        mean = mean + weight * gain * (measured[i] - values[i] - c @ (mean - at))
        keep = eye - weight * gain @ c
        covariance = keep @ covariance @ keep.T + weight * variance * gain @ gain.T
    return mean, covariance


def corrected(covariance: Array, c: Array, noise: Array) -> tuple[Array, Array]:
    """Gain (n, measured) and covariance (n, n) after a measurement y = c x + noise.

    noise : variances. The covariance in Joseph's form, which rounding leaves symmetric and positive
    (R. S. Bucy and P. D. Joseph, Filtering for Stochastic Processes, 1968).
    """
    r = np.diag(noise)
    gain = np.linalg.solve(c @ covariance @ c.T + r, c @ covariance).T
    keep = np.eye(len(covariance)) - gain @ c
    return gain, keep @ covariance @ keep.T + gain @ r @ gain.T
