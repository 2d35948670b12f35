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
    t, states = [0.0], [w[:nx]]
    pieces: list[Array] = []
    breaks, at, begin = [0.0], nx, 0.0
    for interval in mesh.intervals:
        h = float(durations[interval.leg] * interval.fraction)
        taus = mesh.form.state_taus(interval.degree)
        points = w[at : at + nx * len(taus)].reshape(len(taus), nx)
        at += points.size
        columns = len(mesh.form.input_taus(interval.degree))
        values = w[at : at + nu * columns].reshape(columns, nu) * u_nominal
        at += values.size + len(problem.auxiliaries) * mesh.form.cost_points(interval.degree)
        t += list(begin + h * taus)
        states += list(points)
        powers = mesh.form.input_powers(interval.degree)
        piece = powers @ values / h ** np.arange(columns)[:, None]
        pieces.append(pieces[-1] if interval.joined else piece)
        begin += h
        breaks.append(begin)
    coefficients = np.zeros((len(pieces), max(len(p) for p in pieces), nu))
    for k, piece in enumerate(pieces):
        coefficients[k, : len(piece)] = piece
    return Solution(
        np.array(t),
        np.array(states) * x_nominal,
        PiecewisePolynomial(np.array(breaks), coefficients),
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
