"""OperatingPoint: states, inputs and outputs of a plant at one point, and small motion about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.shown import shown
from ..core.stop import locked
from ..core.units import significant
from ..plants.plant import Plant
from .held import held_names

Array: TypeAlias = NDArray[np.float64]

MARGIN = 1e-8
"""Real parts of poles within this part of the fastest pole count as zero."""
CONSERVED = 1e-6
"""A memory whose rate the others' rates give to this part of its largest slope is stuck to them."""


# ---- small motion about an equilibrium with memory -----------------------------------------------
# Friction elements stick and are springs. At rest the rate of a held memory z is a slope times a
# velocity, z' = G v, and the positions' rates are q' = T v; so z - M q with M T = G never changes,
# whatever the inputs do. To first order every motion that starts at the point has dz = M dq: an
# element that sticks is a spring. Put in, this takes z out of the linear system, and with it one
# pole at zero each that no input reaches, which would make every Riccati equation unsolvable.
# Transfer functions are the same.
#
# At an element that has slid fully (z at an end of its range) there is no such slope: one way it
# slides on, the other way it sticks. Its linear model has the mean of both, half the spring.
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


# ---- the point -----------------------------------------------------------------------------------
@shown
@locked
@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """States, inputs and outputs of a plant at one point; ``point["x"]`` gives a value [SI].

    Examples
    --------
    >>> point = plant.equilibrium(x=0.04)
    >>> print(f"{point['muscle.pressure'] / 1e5:.3f} bar")
    2.687 bar
    >>> point.stability
    'stable'
    """

    plant: Plant
    x: Array
    u: Array
    residual: float = field(default=0.0)
    """Largest scaled |xdot| [1/s] (0 at an equilibrium) of all that must vanish
    at rest: held memories keep any value of their range.
    """

    @cached_property
    def values(self) -> dict[str, float]:
        """All states, inputs and outputs by name."""
        y = np.asarray(self.plant.function(self.x, self.u, self.plant.vector("parameter"))[1])
        variables = (*self.plant.states, *self.plant.inputs, *self.plant.outputs)
        numbers = np.concatenate([self.x, self.u, y.ravel()])
        return {v.name: float(n) for v, n in zip(variables, numbers, strict=True)}

    def __getitem__(self, name: str) -> float:
        variable = self.plant.variable(name)
        if variable.causality == "parameter":
            return float(variable.start or 0.0)
        return self.values[variable.name]

    @property
    def memory(self) -> dict[str, float]:
        """What the held memories (hysteresis) keep here, by name; {} for a plant without."""
        return {name: self[name] for name in held_names(self.plant)}

    @cached_property
    def _matrices(self) -> tuple[Array, Array, Array]:
        """A, B, C of all states, inputs and outputs."""
        p = self.plant.vector("parameter")
        a, b, c, _ = (np.asarray(m) for m in self.plant.jacobians(self.x, self.u, p))
        return a, b, c

    @cached_property
    def stuck(self) -> Stuck:
        """How held memories follow the other states in small motion about the point."""
        return Stuck.of(self.plant, *self._matrices[:2])

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A [1/s], sorted by falling real part.

        Held memories stick to the motion about the point and have no pole of their own
        (:mod:`pam_ocp.operating.operating_point`).
        """
        nominal = self.plant.vector("state", attribute="nominal")[self.stuck.kept]
        a = self.stuck.reduced(*self._matrices)[0]
        found = np.linalg.eigvals(a * nominal / nominal[:, None])
        return np.asarray(found[np.argsort(-found.real)], dtype=np.complex128)

    @property
    def stability(self) -> Literal["stable", "unstable", "marginal"]:
        """By the first approximation; "marginal" when a pole lies on the imaginary axis (then the
        first approximation cannot tell, or a state is a pure integral)."""
        margin = MARGIN * float(np.abs(self.poles).max(initial=0.0))
        largest = float(self.poles.real.max(initial=-np.inf))
        if largest > margin:
            return "unstable"
        return "stable" if largest < -margin else "marginal"

    def _brief(self) -> str:
        shown = (f"{n} = {self.plant.variable(n).shown(v)}" for n, v in self.values.items())
        return f"of {self.plant.name}, {self.stability}: {', '.join(shown)}"

    def __str__(self) -> str:
        return "\n".join(
            f"{n:<24} {self.plant.variable(n).shown(v)}" for n, v in self.values.items()
        )


def pole_texts(poles: Iterable[complex]) -> list[str]:
    """Poles [1/s] as people read them, a pair in one; what is rounding beside the largest is 0."""
    found = list(poles)
    least = MARGIN * max(map(abs, found), default=0.0)
    parts = [(p.real * (abs(p.real) > least), p.imag * (abs(p.imag) > least)) for p in found]
    return [
        significant(re) + (f" ± {significant(im)} i" if im else "") for re, im in parts if im >= 0
    ]


def require_point_of(plant: Plant, point: OperatingPoint) -> None:
    """InputError where a point is of a plant with other states."""
    if {v.name for v in point.plant.states} != {v.name for v in plant.states}:
        raise InputError(f"the operating point belongs to {point.plant.name!r}, not {plant.name!r}")
