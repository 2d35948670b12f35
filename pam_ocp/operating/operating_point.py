"""OperatingPoint: states, inputs and outputs of a plant at one point."""

from __future__ import annotations

from collections.abc import Iterable
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
from .stuck import Stuck

__all__ = ["OperatingPoint", "pole_texts", "require_point_of"]

Array: TypeAlias = NDArray[np.float64]

MARGIN = 1e-8
"""Real parts of poles within this part of the fastest pole count as zero."""


@shown
@locked
@dataclass(frozen=True)
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
        (:mod:`pam_ocp.operating.stuck`).
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
