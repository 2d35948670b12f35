"""The unknowns of a program as one symbol, and which part of it is what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..problem.problem import Problem
from .mesh import Mesh

__all__ = ["Unknowns"]

Index: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True)
class Unknowns:
    """Scaled unknowns of the program: the first state; states at points, inputs and auxiliaries
    interval by interval; then durations, design, peaks.

    They are one symbol, of which each part is taken at once: to put it together of hundreds takes
    longer than all the rest of a program.
    """

    w: ca.MX
    begins: list[int]
    """Where the unknowns of each interval stand; and behind the last."""
    sizes: list[tuple[int, int, int]]
    """How many states at points, values of inputs and auxiliaries each has."""
    values: list[int]
    """How many values each input has in each interval."""
    nx: int
    nu: int
    tail: tuple[int, int, int]
    """How many durations, design parameters and peaks there are."""

    @classmethod
    def of(cls, problem: Problem, mesh: Mesh) -> Unknowns:
        nx, nu, na = len(problem.plant.states), len(problem.plant.inputs), len(problem.auxiliaries)
        form = mesh.form
        of_degree = {
            d: (
                nx * len(form.state_taus(d)),
                nu * len(form.input_taus(d)),
                na * form.cost_points(d),
            )
            for d in {interval.degree for interval in mesh.intervals}
        }
        sizes = [of_degree[interval.degree] for interval in mesh.intervals]
        begins = np.cumsum([nx, *(sum(size) for size in sizes)]).tolist()
        tail = len(problem.legs), len(problem.design), problem.m.numel()
        values = [len(mesh.form.input_taus(interval.degree)) for interval in mesh.intervals]
        return cls(ca.MX.sym("w", begins[-1] + sum(tail)), begins, sizes, values, nx, nu, tail)

    def _start(self, k: int) -> int:
        """Where the state at the start of interval k stands."""
        return 0 if k == 0 else self.begins[k - 1] + self.sizes[k - 1][0] - self.nx

    def begin(self, k: int) -> ca.MX:
        """State at the start of interval k (its end for k = number of intervals)."""
        return self.w[self._start(k) : self._start(k) + self.nx]

    def inputs(self, k: int) -> ca.MX:
        """(nu, values) of interval k."""
        at = self.begins[k] + self.sizes[k][0]
        return ca.reshape(self.w[at : at + self.sizes[k][1]], self.nu, self.values[k])

    def columns(self, members: Sequence[int]) -> list[ca.MX]:
        """Starts, states, inputs and auxiliaries of intervals of one degree, a column each."""
        states, inputs, auxiliaries = self.sizes[members[0]]
        begins = np.array([self.begins[k] for k in members])
        starts = np.array([self._start(k) for k in members])
        return [
            self._gathered(starts, self.nx),
            self._gathered(begins, states),
            self._gathered(begins + states, inputs),
            self._gathered(begins + states + inputs, auxiliaries),
        ]

    def _gathered(self, begins: Index, size: int) -> ca.MX:
        at = begins[:, None] + np.arange(size)
        return ca.reshape(self.w[at.ravel().tolist()], size, len(begins))

    @property
    def _tail(self) -> list[ca.MX]:
        ends = np.cumsum([self.begins[-1], *self.tail]).tolist()
        return [self.w[a:b] for a, b in pairwise(ends)]

    @property
    def durations(self) -> ca.MX:
        return self._tail[0]

    @property
    def design(self) -> ca.MX:
        return self._tail[1]

    @property
    def peaks(self) -> ca.MX:
        return self._tail[2]
