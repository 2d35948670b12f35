"""Where a mesh of held or linear inputs keeps an objective from falling, and a finer mesh there.

An input that could change inside its interval would lower the objective by the gradient of the
Lagrangian by it at the points of the interval (Pontryagin's switching function there), times the
change. The multipliers of the solution give that gradient: no re-solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .result import Solved
from .transcription.mesh import Form, Mesh
from .transcription.transcription import transcribe

__all__ = ["gains"]

Array: TypeAlias = NDArray[np.float64]

LEAST_CHANGE = 0.02
"""Of an input inside its interval, in units of nominal, where those beside are the same."""


@dataclass(frozen=True)
class _Freed(Form):
    """Inputs that have a value at each point of their interval; all rows stay as they are."""

    def input_taus(self, degree: int) -> Array:
        return self.collocated(degree)


def gains(found: Solved) -> Array | None:
    """What each interval keeps the objective from, by the first order: an estimate, good to a
    factor of two or so.

    None where inputs are neither held nor linear, the interval knows no points (shooting), or the
    solution has no multipliers.
    """
    mesh, problem = found.program.mesh, found.program.problem
    form = mesh.form
    if form.control == "polynomial" or form.scheme == "shooting" or not problem.plant.inputs:
        return None
    if not np.any(found.outcome.lam_g):
        return None
    freed = transcribe(
        problem, Mesh(mesh.intervals, _Freed(form.scheme, form.control, form.guarded))
    )
    unknowns, at = _spread(found)
    nlp = freed.nlp
    lam = ca.MX.sym("lam", nlp["g"].numel())
    slope = ca.gradient(nlp["f"] + ca.dot(lam, nlp["g"]), nlp["x"])
    function = ca.Function("slope", [nlp["x"], nlp["p"], lam], [slope])
    slopes = np.asarray(function(unknowns, freed.parameters(), found.outcome.lam_g)).ravel()
    (lower, raised), count = _changes(found), len(problem.plant.inputs)
    result = np.zeros(len(mesh.intervals))
    for k, interval in enumerate(mesh.intervals):
        own = slopes[at[k] : at[k] + count * interval.degree].reshape(interval.degree, count)
        down, up = np.maximum(own, 0.0).sum(axis=0), np.maximum(-own, 0.0).sum(axis=0)
        result[k] = down @ lower[k] + up @ raised[k]
    return result


def _spread(found: Solved) -> tuple[Array, list[int]]:
    """(unknowns with each input at all points of its interval, where these stand)."""
    mesh, problem, w = found.program.mesh, found.program.problem, found.outcome.w
    nx, nu = len(problem.plant.states), len(problem.plant.inputs)
    parts, places, old, new = [w[:nx]], [], nx, nx
    for interval in mesh.intervals:
        states = nx * len(mesh.form.state_taus(interval.degree))
        others = len(problem.auxiliaries) * mesh.form.cost_points(interval.degree)
        values = len(mesh.form.input_taus(interval.degree))
        end = old + states + nu * values
        inputs = w[old + states : end].reshape(values, nu)
        taus = mesh.form.collocated(interval.degree).tolist()
        at = [np.asarray(mesh.form.weights(interval.degree, tau)).ravel() for tau in taus]
        parts += [w[old : old + states], (np.array(at) @ inputs).ravel(), w[end : end + others]]
        places.append(new + states)
        old = end + others
        new += states + nu * interval.degree + others
    return np.concatenate([*parts, w[old:]]), places


def _changes(found: Solved) -> tuple[Array, Array]:
    """By how much an input may (fall, rise) inside an interval: in all as to the intervals beside
    it, and not beyond its bounds. A closed valve has nothing to close.
    """
    problem, mesh = found.program.problem, found.program.mesh
    plant, solution = problem.plant, found.solution
    nominal = plant.vector("input", attribute="nominal")
    bounds = np.array([[leg.bounds[v.name] for v in plant.inputs] for leg in problem.legs])
    low, high = (bounds[[i.leg for i in mesh.intervals]] / nominal[:, None]).transpose(2, 0, 1)
    scale = np.asarray(solution.durations) / problem.time_nominals
    lengths, starts = mesh.clock(problem.time_nominals)
    middles, spans = starts[:-1] @ scale + lengths @ scale / 2, (lengths @ scale)[:, None]
    u = solution.inputs(middles) / nominal
    if mesh.form.control == "constant":
        jumps, least = np.abs(np.diff(u, axis=0)), LEAST_CHANGE
        before, after = jumps, jumps
    else:  # from one slope to that beside it, half an interval away
        slopes = solution.inputs.coefficients[:, 1] / nominal
        kinks, least = np.abs(np.diff(slopes, axis=0)), 0.0
        before, after = kinks * spans[1:] / 2, kinks * spans[:-1] / 2
    none = np.zeros((1, len(nominal)))
    beside = np.maximum(np.vstack([none, before]), np.vstack([after, none]))
    change = np.maximum(beside, least)
    below, above = np.maximum(u - low, 0.0), np.maximum(high - u, 0.0)
    # half of it to either side, and more to one where a bound leaves less to the other
    lower = np.minimum(below, np.maximum(change / 2, change - above))
    return lower, np.minimum(above, np.maximum(change / 2, change - below))
