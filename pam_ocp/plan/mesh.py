"""The mesh of a plan: intervals with their degrees, and how inputs run inside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

__all__ = ["Collocation", "Control", "Interval", "Mesh", "radau", "refined"]

Array: TypeAlias = NDArray[np.float64]
Control: TypeAlias = Literal["constant", "linear", "polynomial"]

HIGHEST_DEGREE = 9
"""CasADi's collocation points end here."""
SPLIT_DEGREE = 5
"""Degree of the two halves of an interval that was split."""


@cache
def _points(degree: int) -> tuple[float, ...]:
    return tuple(ca.collocation_points(degree, "radau"))


def radau(degree: int) -> Array:
    """Radau points in (0, 1]; the last is 1."""
    points = np.array(_points(degree))
    points[-1] = 1.0
    return points


@dataclass(frozen=True)
class Interval:
    """A part of a phase, ``fraction`` of its duration long, with polynomials of ``degree``."""

    phase: int
    fraction: float
    degree: int

    def columns(self, control: Control) -> int:
        """How many values of each input it holds."""
        return {"constant": 1, "linear": 2, "polynomial": self.degree}[control]

    def nodes(self, control: Control) -> Array:
        """Where in (0, 1) these values stand."""
        if control == "polynomial":
            return radau(self.degree)
        return np.array([0.0]) if control == "constant" else np.array([0.0, 1.0])

    def weights(self, control: Control, tau: float) -> Array:
        """Weights of the values that give the input at ``tau`` in 0 .. 1 (Lagrange)."""
        nodes = self.nodes(control)
        return np.array(
            [np.prod([(tau - b) / (a - b) for b in nodes if b != a]) for a in nodes],
            dtype=float,
        )

    def polynomial(self, control: Control, values: Array, length: float) -> Array:
        """Coefficients (columns, nu) of powers of the time since the interval's start."""
        nodes = self.nodes(control)
        coefficients = np.linalg.solve(np.vander(nodes, increasing=True), values)
        return np.asarray(coefficients / length ** np.arange(len(nodes))[:, None])


@dataclass(frozen=True)
class Mesh:
    """All intervals of a motion in order, and the form of the inputs."""

    intervals: tuple[Interval, ...]
    control: Control

    def first(self, node: int) -> int:
        """The first interval behind a node; the number of intervals at the last one."""
        return sum(i.phase < node for i in self.intervals)


@dataclass(frozen=True)
class Collocation:
    """Radau collocation: ``intervals`` per phase, polynomials of ``degree`` (1 to 9).

    control : inputs "constant" on each interval (as a digital controller holds them), "linear" and
        continuous, or "polynomial" with a value at each collocation point (few intervals of high
        degree then go a long way: 6 of degree 9, say).
    """

    intervals: int = 50
    degree: int = 3
    control: Control = "constant"

    def __post_init__(self) -> None:
        if not (isinstance(self.intervals, int) and self.intervals >= 1):
            raise InputError(f"intervals = {self.intervals!r}: give a whole number >= 1")
        if not (isinstance(self.degree, int) and 1 <= self.degree <= HIGHEST_DEGREE):
            raise InputError(
                f"degree = {self.degree!r}: give a whole number from 1 to {HIGHEST_DEGREE}"
            )
        if self.control not in ("constant", "linear", "polynomial"):
            raise InputError(
                f"control = {self.control!r}: choose 'constant', 'linear' or 'polynomial'"
            )

    def mesh(self, phases: int) -> Mesh:
        """Equal intervals on each phase."""
        one = tuple(
            Interval(phase, 1.0 / self.intervals, self.degree)
            for phase in range(phases)
            for _ in range(self.intervals)
        )
        return Mesh(one, self.control)


def refined(mesh: Mesh, errors: Sequence[float], tolerance: float) -> Mesh:
    """The mesh with more points where the error of an interval exceeds the tolerance.

    The degree is raised first (by 1 for each two decades, at least 1), then the interval is split.
    """
    intervals: list[Interval] = []
    for interval, error in zip(mesh.intervals, errors, strict=True):
        if not error > tolerance:
            intervals.append(interval)
            continue
        decades = np.log10(error / tolerance) if np.isfinite(error) else 4.0
        degree = interval.degree + max(1, int(np.ceil(decades / 2)))
        if degree <= HIGHEST_DEGREE:
            intervals.append(Interval(interval.phase, interval.fraction, degree))
        else:
            half = Interval(interval.phase, interval.fraction / 2, SPLIT_DEGREE)
            intervals += [half, half]
    return Mesh(tuple(intervals), mesh.control)
