"""Where the solver starts: minimum-jerk paths between the stops, or another solution."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .mesh import Mesh
from .problem import Problem, limits
from .solution import Solution
from .stage import nominals
from .wording import subject

__all__ = ["by_stops", "from_solution"]

Array: TypeAlias = NDArray[np.float64]
Signal: TypeAlias = Callable[[Array], Array]


def from_solution(problem: Problem, mesh: Mesh, solution: Solution) -> Array:
    """Scaled unknowns along a solution (of this or another mesh)."""
    times, table = solution.t, solution.states

    def states(t: Array) -> Array:
        return np.column_stack([np.interp(t, times, column) for column in table.T])

    durations = solution.durations
    if len(durations) != len(problem.legs):
        raise InputError(
            f"guess: a motion of {len(durations)} legs cannot start one of {len(problem.legs)}"
        )
    design = solution.design
    if len(design) != len(problem.design):
        design = _design(problem)
    peaks = solution.peaks
    if len(peaks) != problem.m.numel():
        peaks = np.ones(problem.m.numel())
    return _sampled(problem, mesh, durations, states, solution.inputs, design, peaks)


def by_stops(problem: Problem, mesh: Mesh, balanced: bool = False) -> Array:
    """Scaled unknowns along minimum-jerk paths between the stops, all else at its start.

    balanced : other states and inputs run between the equilibria at the stops instead.
    """
    durations = problem.time_nominals
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    nodes = [_node(problem, stop, balanced) for stop in problem.stops]
    names = [v.name for v in problem.plant.states]
    positions = {names.index(x): names.index(v) for x, v in problem.plant.positions.items()}

    def between(t: Array, column: int) -> tuple[Array, Array]:
        """(values, slopes) of states and inputs by minimum jerk."""
        value = np.empty((len(t), len(nodes[0][column])))
        slope = np.zeros_like(value)
        for i, (a, b) in enumerate(pairwise(node[column] for node in nodes)):
            inside = (t >= ends[i]) & (t <= ends[i + 1] * (1 + 1e-12))
            s = np.clip((t[inside] - ends[i]) / durations[i], 0.0, 1.0)[:, None]
            value[inside] = a + (b - a) * s**3 * (10 - 15 * s + 6 * s**2)
            slope[inside] = (b - a) * 30 * s**2 * (1 - s) ** 2 / durations[i]
        return value, slope

    def states(t: Array) -> Array:
        value, slope = between(t, 0)
        for x, v in positions.items():
            moving = np.any(slope[:, x] != 0.0)
            value[:, v] = slope[:, x] if moving else value[:, v]
        return value

    def inputs(t: Array) -> Array:
        value, _ = between(t, 1)
        return value

    return _sampled(
        problem, mesh, durations, states, inputs, _design(problem), np.ones(problem.m.numel())
    )


def _design(problem: Problem) -> Array:
    """The plant's own values, moved inside their ranges."""
    own = [problem.plant.variable(n).start or 0.0 for n in problem.design]
    ranges = np.array(list(problem.design.values())).reshape(-1, 2)
    return np.asarray(np.clip(np.array(own), ranges[:, 0], ranges[:, 1]))


def _sampled(
    problem: Problem,
    mesh: Mesh,
    durations: Array,
    states: Signal,
    inputs: Signal,
    design: Array,
    peaks: Array,
) -> Array:
    """Scaled unknowns of signals."""
    x_nominal, u_nominal = nominals(problem)
    parts, begin = [states(np.array([0.0])).ravel() / x_nominal], 0.0
    for interval in mesh.intervals:
        h = float(durations[interval.leg] * interval.fraction)
        at = begin + h * mesh.form.state_taus(interval.degree)
        parts.append((states(at) / x_nominal).ravel())
        # this side of a jump
        nodes = np.clip(mesh.form.input_taus(interval.degree), 1e-6, 1 - 1e-6)
        parts.append((inputs(begin + h * nodes) / u_nominal).ravel())
        begin += h
    scaled = durations / problem.time_nominals, design / problem.design_nominals, peaks
    return np.concatenate([*parts, *scaled])


def _node(problem: Problem, stop: dict[str, object], balanced: bool) -> tuple[Array, Array]:
    """(states, inputs) at a stop."""
    plant = problem.plant
    values = {name: _middle(value) for name, value in stop.items()}
    known = {name: value for name, value in values.items() if value is not None}
    x = np.array([known.get(v.name, v.start or 0.0) for v in plant.states])
    u = np.array([known.get(v.name, v.start or 0.0) for v in plant.inputs])
    return _balance(problem, known, x, u) if balanced else (x, u)


def _balance(problem: Problem, known: dict[str, float], x: Array, u: Array) -> tuple[Array, Array]:
    """The point nearest to (x, u) at which the plant rests with the stop's values, in its limits."""
    plant, leg = problem.plant, problem.legs[0]
    x_nominal, u_nominal = nominals(problem)
    z = ca.MX.sym("z", len(x) + len(u))
    scale = np.concatenate([x_nominal, u_nominal])
    given = np.concatenate([x, u]) / scale
    state, given_input = z[: len(x)] * x_nominal, z[len(x) :] * u_nominal
    p = plant.vector("parameter")
    wanted = [plant.expression(n) / subject(plant, n)[0].nominal for n in known]
    rest = (p, 0.0, np.zeros(problem.r.numel()), np.array(problem.aims), np.ones(problem.m.numel()))
    low, high = limits(leg.path) if leg.path else (np.zeros(0), np.zeros(0))
    aims = np.array([value / subject(plant, n)[0].nominal for n, value in known.items()])
    still = np.zeros(len(x))
    box = np.array([leg.bounds[v.name] for v in (*plant.states, *plant.inputs)]) / scale[:, None]
    nlp = {
        "x": z,
        "f": ca.sumsqr(z - given),
        "g": ca.veccat(
            plant.function(state, given_input, p)[0] / x_nominal,
            problem.function("wanted", wanted)(state, given_input, *rest),
            problem.conditions("path", leg.path)(state, given_input, *rest),
        ),
    }
    options: dict[str, Any] = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 200}}
    solver = ca.nlpsol("balance", "ipopt", nlp, options)
    found = solver(
        x0=given, lbx=box[:, 0], ubx=box[:, 1],
        lbg=np.concatenate([still, aims, low]), ubg=np.concatenate([still, aims, high]),
    )  # fmt: skip
    if not solver.stats()["success"]:
        return x, u
    point = np.asarray(found["x"], float).ravel() * scale
    return point[: len(x)], point[len(x) :]


def _middle(value: object) -> float | None:
    """Of a range, or the value itself; None when it is open."""
    if value is None:
        return None
    if isinstance(value, list | tuple):
        ends = [v for v in value if v is not None and np.isfinite(v)]
        return float(np.mean(ends)) if ends else None
    return float(value)  # type: ignore[arg-type]
