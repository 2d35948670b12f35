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

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Places:
    """Where the scaled unknowns of a program stand: the first state; states at points, inputs and
    auxiliaries interval by interval; then durations, design, peaks.
    """

    begins: list[int]
    """Of each interval; and behind the last."""
    sizes: list[tuple[int, int, int]]
    """How many states at points, values of inputs and auxiliaries each has."""
    nx: int
    nu: int
    tail: tuple[int, int, int]
    """How many durations, design parameters and peaks there are."""

    @classmethod
    def of(cls, problem: Problem, mesh: Mesh) -> Places:
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
        return cls(begins, sizes, nx, nu, tail)

    @property
    def count(self) -> int:
        """Of all unknowns."""
        return self.begins[-1] + sum(self.tail)

    def begin(self, k: int) -> slice:
        """The state at the start of interval k (its end for k = number of intervals)."""
        end = self.nx if k == 0 else self.states(k - 1).stop
        return slice(end - self.nx, end)

    def _part(self, k: int, part: int) -> slice:
        first = self.begins[k] + sum(self.sizes[k][:part])
        return slice(first, first + self.sizes[k][part])

    def states(self, k: int) -> slice:
        """Of interval k, at its points; the last is its end."""
        return self._part(k, 0)

    def inputs(self, k: int) -> slice:
        """All values of interval k."""
        return self._part(k, 1)

    def auxiliaries(self, k: int) -> slice:
        """All of interval k."""
        return self._part(k, 2)


@dataclass(frozen=True)
class Unknowns:
    """The same as expressions. They are one symbol, of which each part is taken at once: to put it
    together of hundreds takes longer than all the rest of a program.
    """

    w: ca.MX
    places: Places
    values: list[int]
    """How many values each input has in each interval."""

    @classmethod
    def of(cls, problem: Problem, mesh: Mesh) -> Unknowns:
        places = Places.of(problem, mesh)
        values = [len(mesh.form.input_taus(interval.degree)) for interval in mesh.intervals]
        return cls(ca.MX.sym("w", places.count), places, values)

    def begin(self, k: int) -> ca.MX:
        """State at the start of interval k (its end for k = number of intervals)."""
        return self.w[self.places.begin(k)]

    def inputs(self, k: int) -> ca.MX:
        """(nu, values) of interval k."""
        return ca.reshape(self.w[self.places.inputs(k)], self.places.nu, self.values[k])

    def columns(self, members: Sequence[int]) -> list[ca.MX]:
        """Starts, states, inputs and auxiliaries of intervals of one degree, a column each."""
        p = self.places
        return [
            self._gathered([part(k) for k in members])
            for part in (p.begin, p.states, p.inputs, p.auxiliaries)
        ]

    def _gathered(self, parts: Sequence[slice]) -> ca.MX:
        at = [i for part in parts for i in range(part.start, part.stop)]
        return ca.reshape(self.w[at], len(at) // len(parts), len(parts))

    @property
    def _tail(self) -> list[ca.MX]:
        ends = np.cumsum([self.places.begins[-1], *self.places.tail]).tolist()
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
    places, form = Places.of(problem, mesh), mesh.form
    nx, nu, (legs, designed, _) = places.nx, places.nu, places.tail
    tail = w[places.begins[-1] :]
    durations = tail[:legs] * problem.time_nominals
    lengths = np.array([durations[i.leg] * i.fraction for i in mesh.intervals])
    breaks = np.concatenate([[0.0], np.cumsum(lengths)])
    degrees = np.array([i.degree for i in mesh.intervals])
    own = {  # numbers of points, of values of the inputs
        d: (len(form.state_taus(d)), len(form.input_taus(d)))
        for d in sorted({int(d) for d in degrees})
    }
    points = np.array([own[int(d)][0] for d in degrees])
    starts = np.array(places.begins[:-1])
    rows = 1 + np.concatenate([[0], np.cumsum(points[:-1])])
    t, states = np.zeros(1 + points.sum()), np.zeros((1 + points.sum(), nx))
    states[0] = w[:nx]
    pieces = np.zeros((len(lengths), max(m for _, m in own.values()), nu))
    for d, (n, columns) in own.items():  # intervals of one degree at once
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
    inputs, driven = solution.inputs, []
    for k, interval in enumerate(mesh.intervals):
        h = float(solution.durations[interval.leg] * interval.fraction)
        powers = (h * mesh.form.input_taus(interval.degree)) ** np.arange(inputs.degree + 1)[
            :, None
        ]
        driven.append(powers.T @ inputs.coefficients[k] / u_nominal)
    return filled(
        problem,
        mesh,
        solution.states / x_nominal,
        driven,
        (solution.durations, solution.design, solution.peaks),
    )


def filled(
    problem: Problem,
    mesh: Mesh,
    states: Array,
    inputs: Sequence[Array],
    tail: tuple[Array, Array, Array],
) -> Array:
    """The scaled unknowns of a program, auxiliaries zero, from scaled states at all points, scaled
    inputs (values, nu) of each interval, and durations, design and peaks.
    """
    places = Places.of(problem, mesh)
    durations, design, peaks = tail
    w = np.zeros(places.count)
    w[: places.nx] = states[0]
    at = 1
    for k, values in enumerate(inputs):
        own = w[places.states(k)]
        points = len(own) // max(places.nx, 1)
        own[:] = states[at : at + points].ravel()
        w[places.inputs(k)] = values.ravel()
        at += points
    scaled = durations / problem.time_nominals, design / problem.design_nominals, peaks
    w[places.begins[-1] :] = np.concatenate(scaled)
    return w
