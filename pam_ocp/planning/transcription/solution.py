"""A solution in the plant's own units, unpacked from a program's unknowns, and packed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.signals import PiecewisePolynomial
from ..problem.problem import Problem
from .mesh import Mesh
from .stage import nominals

__all__ = ["Solution", "Unknowns", "pack", "unpack"]

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


Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """States at all points of a mesh, and inputs as signals."""

    t: Array
    """(n,) the start and every point where states are unknowns [s]."""
    states: Array
    """(n, nx) [SI]."""
    inputs: PiecewisePolynomial
    durations: Array
    """(legs,) [s]."""
    design: Array
    """Values of the design parameters [SI]."""
    peaks: Array
    """In units of nominal."""


def unpack(problem: Problem, mesh: Mesh, w: Array) -> Solution:
    """The solution behind the scaled unknowns ``w`` of a program."""
    x_nominal, u_nominal = nominals(problem)
    nx, nu = len(x_nominal), len(u_nominal)
    legs, designed, peaks = len(problem.legs), len(problem.design), problem.m.numel()
    tail = w[len(w) - legs - designed - peaks :]
    durations = tail[:legs] * problem.time_nominals
    lengths = np.array([durations[i.leg] * i.fraction for i in mesh.intervals])
    breaks = np.concatenate([[0.0], np.cumsum(lengths)])
    degrees = np.array([i.degree for i in mesh.intervals])
    form, a = mesh.form, len(problem.auxiliaries)
    own = {  # numbers of points, of values of the inputs, of unknowns
        d: (len(form.state_taus(d)), len(form.input_taus(d)), a * form.cost_points(d))
        for d in sorted({int(d) for d in degrees})
    }
    points = np.array([own[int(d)][0] for d in degrees])
    sizes = np.array([nx * n + nu * m + rest for n, m, rest in (own[int(d)] for d in degrees)])
    starts = nx + np.concatenate([[0], np.cumsum(sizes[:-1])])
    rows = 1 + np.concatenate([[0], np.cumsum(points[:-1])])
    t, states = np.zeros(1 + points.sum()), np.zeros((1 + points.sum(), nx))
    states[0] = w[:nx]
    pieces = np.zeros((len(lengths), max(m for _, m, _ in own.values()), nu))
    for d, (n, columns, _) in own.items():  # intervals of one degree at once
        those = np.flatnonzero(degrees == d)
        to = rows[those, None] + np.arange(n)
        t[to] = breaks[those, None] + lengths[those, None] * form.state_taus(d)
        at = starts[those, None] + np.arange(nx * n)
        states[to] = w[at].reshape(len(those), n, nx)
        at = starts[those, None] + nx * n + np.arange(nu * columns)
        values = w[at].reshape(len(those), columns, nu) * u_nominal
        powers = lengths[those, None] ** np.arange(columns)
        pieces[those, :columns] = (form.input_powers(d) @ values) / powers[..., None]
    first = np.maximum.accumulate(
        np.where([i.joined for i in mesh.intervals], 0, np.arange(len(lengths)))
    )
    return Solution(
        t,
        states * x_nominal,
        PiecewisePolynomial(breaks, pieces[first]),
        durations,
        tail[legs : legs + designed] * problem.design_nominals,
        tail[legs + designed :],
    )


def pack(problem: Problem, mesh: Mesh, solution: Solution) -> Array:
    """The scaled unknowns of a program on the mesh that a solution stands on; undoes
    :func:`unpack`, but for auxiliaries, which are zero (Program.completed knows them).
    """
    x_nominal, u_nominal = nominals(problem)
    states, inputs = solution.states / x_nominal, solution.inputs
    parts, at = [states[0]], 1
    for k, interval in enumerate(mesh.intervals):
        h = float(solution.durations[interval.leg] * interval.fraction)
        points = len(mesh.form.state_taus(interval.degree))
        powers = (h * mesh.form.input_taus(interval.degree)) ** np.arange(inputs.degree + 1)[
            :, None
        ]
        values = powers.T @ inputs.coefficients[k] / u_nominal
        auxiliaries = len(problem.auxiliaries) * mesh.form.cost_points(interval.degree)
        parts += [states[at : at + points].ravel(), values.ravel(), np.zeros(auxiliaries)]
        at += points
    scaled = solution.durations / problem.time_nominals, solution.design / problem.design_nominals
    return np.concatenate([*parts, *scaled, solution.peaks])
