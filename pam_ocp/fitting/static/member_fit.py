"""One muscle of a joint fit."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...core.cases import Place
from ...core.errors import InputError
from ..statistics import Array, Linearisation
from .doubts import at_edge, floor_doubts, unseen
from .force_fit import ForceFit

__all__ = ["MemberFit", "marginal_root"]


@dataclass(frozen=True, eq=False, repr=False)
class MemberFit(ForceFit):
    """One muscle of a joint fit: a ForceFit whose intervals know of the other muscles' data."""

    marginal: Linearisation = field(kw_only=True)
    """Of this muscle's coefficients, all others of the joint fit unknown."""

    @cached_property
    def linearisation(self) -> Linearisation:
        return self.marginal

    @property
    def dof(self) -> int:
        """Degrees of freedom of the joint fit."""
        return self.marginal.dof

    @property
    def sigma(self) -> float:
        """Standard deviation of a measurement of weight 1 of this table [N]."""
        return self.marginal.scale if self.dof else float("nan")

    @property
    def _scale(self) -> float:
        return self.sigma

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """As of a fit alone, but for the number of levels:
        the other tables tell more than these.
        """
        return (*floor_doubts(self), *unseen(self), *at_edge(self.solver.at_bound, self.law.values))

    @property
    def has_profile(self) -> bool:
        """No: a profile of one table alone leaves out what the others tell."""
        return False

    def profile_interval(
        self, name: str, level: float = 0.95, *, executor: Place = None
    ) -> tuple[float, float]:
        raise InputError("a muscle of a joint fit: take profile_interval of the joint fit")

    def bootstrap(self, n: int = 500, seed: int = 0, **options: Any) -> Any:
        raise InputError("a muscle of a joint fit cannot be resampled without the others")

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        raise InputError(
            "a muscle of a joint fit has intervals that its own table does not tell; save the "
            "muscle with save_muscle(fit.muscle(...), file)"
        )


def marginal_root(jacobian: Array, place: Any) -> Array:
    """R (k, k) with R^T R the information on some unknowns when the others are unknown too.

    The columns of the others are projected out of theirs (what is left of a QR decomposition).
    """
    norms = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(norms > 0, norms, 1.0)
    others = np.delete(scaled, place, axis=1)
    rest = scaled[:, place]
    if others.shape[1]:
        u, s, _ = np.linalg.svd(others, full_matrices=False)
        u = u[:, s > 1e-12 * max(float(s[0]), 1e-300)]
        rest = rest - u @ (u.T @ rest)
    return np.asarray(np.linalg.qr(rest, mode="r") * norms[place])
