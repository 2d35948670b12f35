"""What all cross-validation here has in common: how far one model is behind another by what they
lose on the same parts. Fits are spread by :mod:`pam_ocp.core.cases`.
"""

from __future__ import annotations

import numpy as np

from ..statistics import Array, student_t

__all__ = ["mean_loss", "paired"]


def mean_loss(losses: Array) -> Array:
    """By criterion (m,) of losses (n, m), over the parts that can be judged by it (no NaN)."""
    seen = ~np.isnan(losses)
    total = np.where(seen, losses, 0.0).sum(axis=0)
    return np.asarray(np.where(seen.any(axis=0), total / np.maximum(seen.sum(axis=0), 1), np.nan))


def paired(differences: Array, level: float) -> tuple[float, float, float]:
    """(mean, its standard error, half width of its interval) of differences part by part: what
    makes a part hard for both models drops out. The parts count as independent.
    """
    n = len(differences)
    mean = float(differences.mean())
    if n < 2:
        return mean, float("inf"), float("inf")
    error = float(differences.std(ddof=1)) / float(np.sqrt(n))
    return mean, error, student_t(level, n - 1) * error
