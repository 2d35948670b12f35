"""What fits of plants tell alike: intervals, covariance, tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import courtesy
from ...core.errors import UnknownNameError
from ..statistics import Array, Coefficient, student_t
from ..tabled import Tabled

if TYPE_CHECKING:
    from .coverage import Coverage

__all__ = ["FittedPlant"]


class FittedPlant(Tabled, ABC):
    """Coefficients with standard errors, and what follows from them."""

    @property
    @abstractmethod
    def coefficients(self) -> Mapping[str, Coefficient]:
        """By name; standard errors with all that widens them."""

    @abstractmethod
    def _freedom(self, name: str) -> int:
        """Degrees of freedom of a coefficient's interval."""

    @abstractmethod
    def _plain(self) -> Array:
        """Covariance of the coefficients before their standard errors were widened."""

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval by Student's t, of as many residuals as are independent; standard
        errors count autocorrelation (see ``coefficients``).
        """
        if name not in self.coefficients:
            raise UnknownNameError("fitted parameter", name, self.coefficients)
        c = self.coefficients[name]
        half = student_t(level, self._freedom(name)) * c.stderr
        return c.value - half, c.value + half

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of all fitted parameters."""
        return {n: self.interval(n, level) for n in self.coefficients}

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, in the order of ``coefficients``."""
        plain = self._plain()
        size = np.sqrt(np.maximum(np.diag(plain), 1e-300))
        wider = np.array([c.stderr for c in self.coefficients.values()])
        ratio = np.where(np.isfinite(wider), wider / size, 1.0)
        return np.asarray(plain * np.outer(ratio, ratio))

    def coverage(self, other: Any, **options: Any) -> Coverage:
        """Where the records of this fit have been, against a record or a signal that is to be
        predicted: see :func:`pam_ocp.fitting.coverage`.
        """
        return courtesy.coverage(self, other, **options)
