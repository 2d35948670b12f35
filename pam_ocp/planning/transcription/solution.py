"""A solution in the plant's own units, unpacked from a program's unknowns, and packed again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.signals import PiecewisePolynomial
from ..problem.problem import Problem
from .mesh import Mesh
from .stage import nominals

__all__ = ["Solution", "pack", "unpack"]

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
