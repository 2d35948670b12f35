"""The optimum of a static fit: the fitted law at its cells, and its linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...muscles.law import ForceLaw
from ..estimates import Estimates
from ..statistics import (
    Array,
    Coefficient,
    Linearisation,
    SerialErrors,
    SolverStatistics,
    forces_and_slopes,
)
from ..tables.force_table import ForceTable
from .correlation import sequences, serial_errors
from .least_squares import BISQUARE, HUBER, PLAIN, LeastSquares, Terms, robust_scale, spread


def sensitivity(law: ForceLaw, free: Sequence[str], p: Array, kappa: Array) -> tuple[Array, Array]:
    """Tension (n,) [N] and its derivatives with respect to the ``free`` coefficients (n, k)."""
    names, values = list(law.values), np.array([[float(v) for v in law.values.values()]])
    tension, jacobian = forces_and_slopes(type(law), p, kappa, values)
    return tension[0], jacobian[0][:, [names.index(n) for n in free]]


@dataclass(frozen=True, eq=False)
class Optimum(Estimates):
    """A force law at the coefficients that fit a table best, and the problem near them; the fields
    are those of :class:`ForceFit`.
    """

    law: ForceLaw
    table: ForceTable
    held: tuple[str, ...]
    weights: Array | None
    solver: SolverStatistics
    terms: Terms = PLAIN

    # ---- the fit itself ---------------------------------------------------------------------
    @cached_property
    def cells(self) -> ForceTable:
        """The taut cells, in the order of ``residuals``."""
        return self.table.taut

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted coefficients."""
        return tuple(n for n in self.law.values if n not in self.held)

    @property
    def root_weights(self) -> Array:
        """Factor of each residual; ones without weights."""
        return np.ones(len(self.cells)) if self.weights is None else self.weights

    def _sensitivity(self, p: Array, kappa: Array) -> tuple[Array, Array]:
        """Tension (n,) and its derivatives with respect to the free coefficients (n, k)."""
        return sensitivity(self.law, self.free, p, kappa)

    @cached_property
    def _at_cells(self) -> tuple[Array, Array]:
        return self._sensitivity(self.cells.pressure, self.cells.contraction)

    @property
    def residuals(self) -> Array:
        """Measured minus fitted force of the taut cells [N]."""
        return self.cells.force - self._at_cells[0]

    @property
    def jacobian(self) -> Array:
        """Exact derivatives of the force, (taut cells, free coefficients) [N/unit]."""
        return self._at_cells[1]

    @property
    def n(self) -> int:
        """Number of taut cells."""
        return len(self.cells)

    @cached_property
    def problem(self) -> LeastSquares:
        """The problem that was solved."""
        held = {n: float(self.law.values[n]) for n in self.held}
        return LeastSquares.of(type(self.law), self.table, held, self.root_weights, self.terms)

    @property
    def dof(self) -> int:
        """Degrees of freedom: taut cells and priors less fitted coefficients."""
        return self.n + len(self.problem.priors[0]) - len(self.free)

    @property
    def cost(self) -> float:
        """What the fit made smallest [N2]: ``squares``, or the robust loss, and the priors."""
        return self.problem.cost(self.vector)

    @property
    def squares(self) -> float:
        """Weighted sum of squared residuals."""
        return float(np.sum((self.root_weights * self.residuals) ** 2))

    @property
    def rmse(self) -> float:
        """Root of the mean squared residual over the taut cells, without weights [N]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def r2(self) -> float:
        """1 - (squared residuals)/(squared deviations from the mean), without weights."""
        spread = float(np.sum((self.cells.force - self.cells.force.mean()) ** 2))
        return 1 - float(np.sum(self.residuals**2)) / spread if spread else float("nan")

    @property
    def sigma(self) -> float:
        """Standard deviation s of a measurement of weight 1 [N], robust after a robust fit."""
        if not self.dof:
            return float("nan")
        if self.terms.loss == "bisquare":
            return self.terms.threshold / BISQUARE
        if self.terms.loss != "squares":
            return spread(self.root_weights * self.residuals, len(self.free))
        return float(np.sqrt(self.cost / self.dof))

    # ---- near the optimum ---------------------------------------------------------------------
    @cached_property
    def linearisation(self) -> Linearisation:
        """The weighted least-squares problem near its optimum."""
        variables = {v.name: v for v in self.law.coefficient_variables()}
        jacobian = self.problem.with_priors(self.vector[None])[1][0][:, list(self.problem.free)]
        return Linearisation(
            self.free,
            np.array([float(self.law.values[n]) for n in self.free]),
            [variables[n].unit for n in self.free],
            jacobian,
            self._scale,
            self.dof,
            self._active,
            None
            if self.terms.independent
            else serial_errors(jacobian, self._influential, sequences(self.cells)),
        )

    @property
    def _influential(self) -> Array:
        """Weighted residuals as they count: cells far off do not after a robust fit."""
        residuals = self.root_weights * self.residuals
        if np.linalg.norm(residuals) <= 1e-9 * np.linalg.norm(self.root_weights * self.cells.force):
            return np.zeros(self.n)  # rounding errors are serially correlated, too
        if self.terms.loss == "squares":
            return residuals
        if self.terms.loss == "l1":
            edge = HUBER * spread(residuals, len(self.free))
            return np.clip(residuals, -edge, edge)
        return residuals * self.terms.reweighting(residuals, 0.0) ** 2

    @property
    def serial(self) -> SerialErrors | None:
        """The serial correlation of errors along a ramp, if any; it widens all intervals."""
        return self.linearisation.serial

    @property
    def vector(self) -> Array:
        """All coefficients of the law, in its order."""
        return np.array([float(v) for v in self.law.values.values()])

    @property
    def _scale(self) -> float:
        """The factor s of the covariance s^2 (J^T J)^-1."""
        if self.terms.loss == "squares" or not self.dof:
            return self.sigma
        return robust_scale(self.terms, self.root_weights * self.residuals, len(self.free))

    @property
    def _active(self) -> Array | None:
        """Gradients of the slack cells at which the law would pull more if it could."""
        if not self.problem.censored:
            return None
        tension, gradients = self.problem.tension_where_slack(self.vector)
        return gradients[tension > 0.999 * self.problem.slack_tolerance][:, list(self.problem.free)]

    @property
    def has_profile(self) -> bool:
        """Whether intervals are those of the profile likelihood."""
        return self.terms.loss == "squares" and not self.problem.limited and self.dof > 0

    @property
    def _called(self) -> str:
        return f"coefficient of the {self.law.name} law"

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every coefficient by name, held ones included."""
        errors = dict(zip(self.free, self.linearisation.stderr(), strict=True))
        return {
            v.name: Coefficient(
                v.name,
                float(self.law.values[v.name]),
                float(errors.get(v.name, 0.0)),
                v.unit,
                v.name in self.held,
                v.description,
            )
            for v in self.law.coefficient_variables()
        }
