"""Small motion about an equilibrium with memory: friction elements stick and are springs.

At rest the rate of a held memory z is a slope times a velocity, z' = G v, and the positions' rates
are q' = T v; so z - M q with M T = G never changes, whatever the inputs do. To first order every
motion that starts at the point has dz = M dq: an element that sticks is a spring. Put in, this
takes z out of the linear system, and with it one pole at zero each that no input reaches, which
would make every Riccati equation unsolvable. Transfer functions are the same.

At an element that has slid fully (z at an end of its range) there is no such slope: one way it
slides on, the other way it sticks. Its linear model has the mean of both, half the spring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..plants.plant import Plant
from .held import held_names

__all__ = ["Stuck"]

Array: TypeAlias = NDArray[np.float64]

CONSERVED = 1e-6
"""A memory whose rate the others' rates give to this part of its largest slope is stuck to them."""


@dataclass(frozen=True)
class Stuck:
    """Held memories expressed by the other states: dx[held] = slope @ dx[kept], SI units."""

    kept: NDArray[np.int_]
    held: NDArray[np.int_]
    slope: Array

    @classmethod
    def of(cls, plant: Plant, a: Array, b: Array, inputs: Sequence[str] | None = None) -> Stuck:
        """Of a plant whose Jacobians at an equilibrium are A (nx, nx) and B (nx, inputs).

        inputs : those that B has columns for; by default all.
        A memory that is not bound to the motion (of a plant of one's own) stays as it is: slope 0.
        """
        names = held_names(plant)
        holds = np.array([v.name in names for v in plant.states], dtype=bool)
        kept, held = np.flatnonzero(~holds), np.flatnonzero(holds)
        if not len(held):
            return cls(kept, held, np.zeros((0, len(kept))))
        nominal = plant.vector("state", attribute="nominal")
        names_in = [v.name for v in plant.inputs] if inputs is None else inputs
        sizes = np.concatenate([nominal, [plant.variable(n).nominal for n in names_in]])
        rates = np.hstack([unfading(a, held), b]) * sizes / nominal[:, None]
        scale = np.maximum(np.abs(rates).max(axis=1), 1e-300)
        rates = rates / scale[:, None]
        found = np.linalg.lstsq(rates[kept].T, rates[held].T, rcond=1e-12)[0].T
        missed = np.abs(found @ rates[kept] - rates[held]).max(axis=1)
        found[missed > CONSERVED] = 0.0
        size = nominal * scale
        return cls(kept, held, found * size[held][:, None] / size[kept])

    def reduced(self, a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
        """A, B and C without the held memories."""
        k, h = self.kept, self.held
        return (
            a[np.ix_(k, k)] + a[np.ix_(k, h)] @ self.slope,
            b[k],
            c[:, k] + c[:, h] @ self.slope,
        )

    def lift(self, nominal: Array | None = None, more: int = 0) -> Array:
        """E (all states + more, kept states + more) of dx = E dx[kept].

        nominal : sizes of all states, for states in units of these. more : states behind them that
        stay (integrals, disturbances).
        """
        size = np.ones(len(self.kept) + len(self.held)) if nominal is None else nominal
        n = len(size)
        found = np.zeros((n + more, len(self.kept) + more))
        found[self.kept, np.arange(len(self.kept))] = 1.0
        found[self.held, : len(self.kept)] = self.slope * size[self.kept] / size[self.held, None]
        found[n:, len(self.kept) :] = np.eye(more)
        return found

    def pick(self, more: int = 0) -> Array:
        """P (kept states + more, all states + more), which takes the kept states: P E = 1."""
        n = len(self.kept) + len(self.held)
        return np.asarray(np.eye(n + more)[[*self.kept, *range(n, n + more)]])


def unfading(a: Array, held: NDArray[np.int_]) -> Array:
    """A without the fading of held memories, which the rounded edge of sliding brings with it."""
    still = np.array(a)
    still[held[:, None], held] = 0.0
    return still
