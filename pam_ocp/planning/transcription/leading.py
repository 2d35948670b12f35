"""Where the solver starts when points between the stops lead to nothing: a motion that the plant
can make, led along the usual path.

Step by step (implicit Euler) the inputs are chosen with which the positions stay nearest to a path
of rests between the stops: pressures follow from the forces that the path needs, commands from the
pressures, memories from all that went before. What comes out keeps the plant's equations and
bounds but for the steps' own error, and visits the stops nearly.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..problem.problem import Problem
from .guess import path_of_rests, sampled_along
from .mesh import Mesh
from .stage import nominals

__all__ = ["by_leading"]

Array: TypeAlias = NDArray[np.float64]

POSITIONS, OTHERS, INPUTS = 1e2, 1e-3, 1e-3
"""Weights of squared distances from the path, in units of nominal: positions lead, the rest is
drawn where it is free.
"""
PER_INTERVAL = 2
"""Steps."""


def by_leading(problem: Problem, mesh: Mesh) -> Array:
    """Scaled unknowns along a motion that the plant makes near the path of rests between the stops,
    in the usual durations.
    """
    durations = np.clip(problem.time_nominals, *np.array([leg.duration for leg in problem.legs]).T)
    path = path_of_rests(problem, durations)
    x_nominal, u_nominal = nominals(problem)
    t = _times(mesh, durations)
    states, inputs = path.states(t) / x_nominal, path.inputs(t) / u_nominal
    solver, nx = _step(problem), len(x_nominal)
    here = np.concatenate([states[0], inputs[0]])
    found = [here]
    for k, (begin, end) in enumerate(pairwise(t), start=1):
        leg = min(
            int(np.searchsorted(np.cumsum(durations), begin * (1 + 1e-9))), len(durations) - 1
        )
        low, high = _box(problem, leg)
        wanted = np.concatenate([states[k], inputs[k]])
        result = solver(
            x0=np.clip(here, low, high),
            p=np.concatenate([here[:nx], wanted, [end - begin]]),
            lbx=low,
            ubx=high,
            lbg=0.0,
            ubg=0.0,
        )
        # where no step is possible the path goes on
        here = np.asarray(result["x"], float).ravel() if solver.stats()["success"] else wanted
        found.append(here)
    led = np.array(found)
    x, u = led[:, :nx] * x_nominal, led[:, nx:] * u_nominal

    def at(times: Array) -> Array:
        return np.column_stack([np.interp(times, t, column) for column in x.T])

    def held(times: Array) -> Array:
        """Each step's own inputs."""
        row = np.clip(np.searchsorted(t, times), 0, len(t) - 1)
        return np.asarray(u[row])

    return sampled_along(problem, mesh, durations, at, held)


def _times(mesh: Mesh, durations: Array) -> Array:
    """Of the steps."""
    lengths = np.array([durations[i.leg] * i.fraction for i in mesh.intervals])
    steps = np.repeat(lengths / PER_INTERVAL, PER_INTERVAL)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _box(problem: Problem, leg: int) -> tuple[Array, Array]:
    """(low, high) of scaled states and inputs."""
    variables = (*problem.plant.states, *problem.plant.inputs)
    bounds = np.array([problem.legs[leg].bounds[v.name] for v in variables])
    scaled = bounds / np.concatenate(nominals(problem))[:, None]
    return scaled[:, 0], scaled[:, 1]


def _step(problem: Problem) -> Nlp:
    """(states before, wanted states and inputs, length) -> the states and inputs behind a step."""
    plant = problem.plant
    x_nominal, u_nominal = nominals(problem)
    nx, nu = len(x_nominal), len(u_nominal)
    led = {q.name for q in plant.resting() if not q.driven}
    weights = [POSITIONS if v.name in led else OTHERS for v in plant.states] + [INPUTS] * nu
    z, before = ca.MX.sym("z", nx + nu), ca.MX.sym("before", nx)
    wanted, h = ca.MX.sym("wanted", nx + nu), ca.MX.sym("h")
    rates = plant.function(z[:nx] * x_nominal, z[nx:] * u_nominal, plant.vector("parameter"))[0]
    nlp = {
        "x": z,
        "p": ca.vertcat(before, wanted, h),
        "f": ca.dot(ca.DM(weights), (z - wanted) ** 2),
        "g": z[:nx] - before - h * rates / x_nominal,
    }
    return nlpsol("step", "ipopt", nlp, quiet_ipopt(max_iter=60, tol=1e-6, mu_init=1e-4))
