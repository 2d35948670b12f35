"""Where the solver starts: minimum-jerk paths between the stops, or another solution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, combinations, pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, PamError
from ...judge.statement import subject
from ...numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ...operating.held import held_names
from ...operating.resting_point import resting_point
from ...plants.plant import Plant
from ...plants.stillness import rest_rows, totals
from ..problem.problem import Problem, limits
from .mesh import Mesh
from .solution import Solution, filled
from .stage import nominals
from .transcription import has_smoothing

Array: TypeAlias = NDArray[np.float64]
Point: TypeAlias = tuple[Array, Array]
Signal: TypeAlias = Callable[[Array], Array]

IDLE = 1e-6
"""Least change of a state's rate, in nominals per second and nominal of an input, to be influence.
"""
AT_REST = 1e-5
"""Rates [nominal/s] of an equilibrium, at most, and what it may miss of a limit [nominal]."""
WITHIN = 1e-9
"""Half width of ranges in place of the equations of rest: of equations there may be no more than
unknowns, but what closed valves hold and a stop names is said twice, and has no slope.
"""
PLACES = 8
"""Parts of a way between two stops whose ends are equilibria."""
LEVELS = 12
"""Of an input that are tried, to either side of its middle."""


def from_solution(problem: Problem, mesh: Mesh, solution: Solution) -> Array:
    """Scaled unknowns along a solution (of this or another mesh)."""
    states = _on_lines(solution.t, solution.states)
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


def _on_lines(t: Array, table: Array) -> Signal:
    """The columns of a table over time, joined by straight lines."""
    return lambda times: np.column_stack([np.interp(times, t, column) for column in table.T])


def by_stops(problem: Problem, mesh: Mesh, balanced: bool = False, stretch: float = 1.0) -> Array:
    """Scaled unknowns along minimum-jerk paths between the stops, all else at its start.

    balanced : other states run between the equilibria at the stops instead, and the inputs are
        those that move them so. stretch : of durations that are free, from the usual ones.
    """
    shortest, longest = np.array([leg.duration for leg in problem.legs]).T
    durations = np.clip(stretch * problem.time_nominals, shortest, longest)
    path = Path(problem, _stops(problem, balanced), durations)
    inputs = path.driving_inputs() if balanced else path.inputs
    return sampled_along(problem, mesh, durations, path.states, inputs)


def by_rests(problem: Problem, mesh: Mesh) -> Array:
    """Scaled unknowns along equilibria between the stops, in the usual durations.

    A slow motion is nearly one of these; where parts are stiff, the states between the stops' own
    would meet large forces instead.
    """
    durations = problem.time_nominals
    path = path_of_rests(problem, durations)
    return sampled_along(problem, mesh, durations, path.states, path.driving_inputs())


def path_of_rests(problem: Problem, durations: Array) -> Path:
    """A minimum-jerk motion along equilibria between the stops."""
    return Path(problem, _rests(problem), durations, PLACES)


def sampled_along(
    problem: Problem, mesh: Mesh, durations: Array, states: Signal, inputs: Signal
) -> Array:
    """Scaled unknowns of signals, design and peaks at their usual values."""
    peaks = np.ones(problem.m.numel())
    return _sampled(problem, mesh, durations, states, inputs, _design(problem), peaks)


@lru_cache(maxsize=8)  # each start and mesh of a search asks; where nothing rests it takes seconds
def _stops(problem: Problem, balanced: bool) -> list[Point]:
    """(states, inputs) at each stop."""
    return [_node(problem, stop, balanced) for stop in problem.stops]


@lru_cache(maxsize=4)
def _rests(problem: Problem) -> list[Point]:
    """(states, inputs) at each stop and at the places between; where none rests, on a line."""
    nodes = _stops(problem, balanced=True)
    found = nodes[:1]
    for (a, b), (one, other) in zip(pairwise(problem.stops), pairwise(nodes), strict=True):
        ends = {n: (_middle(a[n]), _middle(b[n])) for n in a if n in b}
        known = {n: (x, y) for n, (x, y) in ends.items() if x is not None and y is not None}
        for s in np.arange(1, PLACES) / PLACES:
            line = tuple((1 - s) * x + s * y for x, y in zip(one, other, strict=True))
            values = {n: (1 - s) * x + s * y for n, (x, y) in known.items()}
            # where inputs are more than needed to rest, the equations of rest leave some open
            rest = _rest(problem.plant, values) or _balance(problem, values, line[0], line[1])
            found.append(rest)
        found.append(other)
    return found


def _rest(plant: Plant, known: dict[str, float], completed: bool = False) -> Point | None:
    """(states, inputs) of an equilibrium with these values; None when there is none.

    completed : with as many pressures at their start values as inputs are open then.
    """
    controls = [v for v in plant.inputs if not v.disturbance]
    pressures = [v for v in plant.states if v.unit == "Pa" and not v.memory]
    open_ones = [v for v in pressures if v.name not in known and v.name not in plant.copies]
    more = range(len(controls) + 1 if completed else 1)  # two valves of a muscle count as one
    for added in chain.from_iterable(combinations(open_ones, count) for count in more):
        try:
            point = resting_point(plant, {**known, **{v.name: v.start for v in added}})
        except PamError:
            continue
        if point is None:
            continue
        x, u = ([point[v.name] for v in kind] for kind in (plant.states, plant.inputs))
        return np.array(x), np.array(u)
    return None


def wants_balance(problem: Problem) -> bool:
    """Whether the plant's start values are no place to begin at.

    So it is where the stops leave positions open (a tendon would hang slack), where hysteresis has
    to be led (with the widest roundings, too), and where an input has no influence (a closed
    valve).
    """
    plant = problem.plant
    spoken = ca.vertcat(*(subject(plant, n)[1] for stop in problem.stops for n in stop))
    open_ends = [
        q
        for q, order, _ in rest_rows(plant, plant.resting())
        if order == 2 and not ca.depends_on(spoken, plant.expression(q.name))
    ]
    return bool(open_ends) or has_smoothing(problem) or _idle_inputs(plant)


def _idle_inputs(plant: Plant) -> bool:
    """Whether an input has no influence where it starts."""
    x, u = plant.vector("state"), plant.vector("input")
    free = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    if not free:
        return False
    moved = np.tile(u[:, None], (1, len(free) + 1))
    for k, i in enumerate(free):
        variable = plant.inputs[i]
        step = 1e-4 * variable.nominal
        moved[i, k + 1] += step if u[i] + step <= variable.max else -step
    rates = np.asarray(plant.function(x, moved, plant.vector("parameter"))[0], float)
    nominal = plant.vector("state", attribute="nominal")[:, None]
    slopes = np.abs((rates[:, 1:] - rates[:, :1]) / nominal).max(axis=0) / 1e-4
    return bool(np.any(slopes < IDLE))


@dataclass(frozen=True)
class Path:
    """Minimum-jerk motion between nodes (states, inputs), ``parts`` of them from stop to stop."""

    problem: Problem
    nodes: list[Point]
    durations: Array
    parts: int = 1

    def _between(self, t: Array, column: int) -> Point:
        """(values, slopes) of states (0) or inputs (1)."""
        ends = np.concatenate([[0.0], np.cumsum(self.durations)])
        value = np.empty((len(t), len(self.nodes[0][column])))
        slope = np.zeros_like(value)
        nodes = np.array([node[column] for node in self.nodes])
        for i, duration in enumerate(self.durations):
            inside = (t >= ends[i]) & (t <= ends[i + 1] * (1 + 1e-12))
            s = np.clip((t[inside] - ends[i]) / duration, 0.0, 1.0)[:, None]
            gone, rate = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / duration
            own = nodes[i * self.parts : (i + 1) * self.parts + 1]
            if self.parts == 1:
                value[inside], slope[inside] = own[0] + (own[1] - own[0]) * gone, rate
                slope[inside] *= own[1] - own[0]
            else:
                from scipy.interpolate import CubicSpline  # half a second, for several stops alone

                line = CubicSpline(np.linspace(0.0, 1.0, len(own)), own)
                value[inside] = line(gone[:, 0])
                slope[inside] = line(gone[:, 0], 1) * rate
        return value, slope

    def states(self, t: Array) -> Array:
        """(n, nx); velocities are those of the positions that move."""
        value, slope = self._between(t, 0)
        self._move(value, slope, self.inputs(t))
        return value

    def _move(self, value: Array, slope: Array, u: Array) -> None:
        """Give the velocities the values with which the positions that move have their slopes."""
        plant = self.problem.plant
        names, p = [v.name for v in plant.states], plant.vector("parameter")
        moving = [
            q
            for q in plant.resting()
            if not q.driven and np.any(slope[:, names.index(q.name)] != 0.0)
        ]
        if not moving:
            return
        rows = np.array([names.index(q.name) for q in moving])
        free = {names.index(v) for q in moving for v in q.velocities} - {*rows.tolist()}
        columns = np.array(sorted(free), dtype=np.intp)
        nominal = plant.vector("state", attribute="nominal")
        size, nx = nominal[columns], len(names)
        at = np.arange(len(value))  # the moments whose velocities are still sought
        for _ in range(5):  # Gauss-Newton: rates are nearly linear in velocities
            wanted, columns_u = slope[at][:, rows], u[at].T
            rates = np.asarray(plant.function(value[at].T, columns_u, p)[0], float).T
            missed = wanted - rates[:, rows]
            off = np.abs(missed) > 1e-9 * (nominal[rows] + np.abs(wanted))
            far = np.any(off | np.isnan(missed), axis=1)
            at, missed = at[far], missed[far]
            if not at.size:
                return
            slopes = np.asarray(plant.jacobians(value[at].T, u[at].T, p)[0], float)
            slopes = slopes.reshape(nx, len(at), nx)[np.ix_(rows, np.arange(len(at)), columns)]
            inverse = np.linalg.pinv(slopes.transpose(1, 0, 2) * size, rcond=1e-9)
            value[np.ix_(at, columns)] += (inverse @ missed[:, :, None])[:, :, 0] * size

    def inputs(self, t: Array) -> Array:
        """(n, nu) between the nodes' own."""
        value, _ = self._between(t, 1)
        return value

    def driving_inputs(self) -> Signal:
        """Inputs that move the states nearly as they should, chosen among levels one by one."""
        plant = self.problem.plant
        ends = np.concatenate([[0.0], np.cumsum(self.durations)])
        t = np.unique(np.concatenate([np.linspace(a, b, 15) for a, b in pairwise(ends)]))
        x, wanted, u = self.states(t), self._between(t, 0)[1], self.inputs(t)
        p, nominal = plant.vector("parameter"), plant.vector("state", attribute="nominal")
        for i, variable in enumerate(plant.inputs):
            low, high = self.problem.legs[0].bounds[variable.name]
            if variable.disturbance or not np.isfinite([low, high]).all():
                continue
            levels = np.linspace(low, high, 2 * LEVELS)  # an even number: the middle is left out
            missed = []
            for level in levels:
                u[:, i] = level
                rates = np.asarray(plant.function(x.T, u.T, p)[0], float).T
                missed.append((((rates - wanted) / nominal) ** 2).sum(axis=1))
            u[:, i] = levels[np.argmin(missed, axis=0)]
        return _on_lines(t, u)


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
    at, driven, begin = [np.array([0.0])], [np.empty(0)], 0.0
    for interval in mesh.intervals:
        h = float(durations[interval.leg] * interval.fraction)
        at.append(begin + h * mesh.form.state_taus(interval.degree))
        # this side of a jump
        nodes = np.clip(mesh.form.input_taus(interval.degree), 1e-6, 1 - 1e-6)
        driven.append(begin + h * nodes)
        begin += h
    u = np.split(
        inputs(np.concatenate(driven)) / u_nominal, np.cumsum([len(t) for t in driven[1:-1]])
    )
    return filled(
        problem, mesh, states(np.concatenate(at)) / x_nominal, u, (durations, design, peaks)
    )


def rest_point(problem: Problem, stop: dict[str, object]) -> Point | None:
    """(states, inputs) with which the plant rests at a stop in its limits, nearest to their start
    values; None where none are found.
    """
    plant, path = problem.plant, problem.legs[0].path
    x, u = _node(problem, stop, balanced=True)
    rates = np.asarray(plant.function(x, u, plant.vector("parameter"))[0], float).ravel()
    kept = {*totals(plant), *(n for n in held_names(plant) if n in stop)}
    still = all(
        abs(rate) <= AT_REST * v.nominal or v.name in kept
        for rate, v in zip(rates, plant.states, strict=True)
    )
    values = np.ravel(problem.conditions("path", path)(x, u, *_others(problem)))
    low, high = limits(path)
    missed = np.maximum(low - values, values - high)
    return (x, u) if still and np.all(missed <= AT_REST) else None


def _others(problem: Problem) -> tuple[Any, ...]:
    """What conditions ask for besides states and inputs, as it is before a motion."""
    p, profiles = problem.plant.vector("parameter"), np.zeros(problem.r.numel())
    return p, 0.0, profiles, np.array(problem.aims), np.ones(problem.m.numel())


def _node(problem: Problem, stop: dict[str, object], balanced: bool) -> Point:
    """(states, inputs) at a stop."""
    plant = problem.plant
    values = {name: _middle(value) for name, value in stop.items()}
    known = {name: value for name, value in values.items() if value is not None}
    x = np.array([known.get(v.name, v.start or 0.0) for v in plant.states])
    u = np.array([known.get(v.name, v.start or 0.0) for v in plant.inputs])
    return _balance(problem, known, x, u) if balanced else (x, u)


def _balance(problem: Problem, known: dict[str, float], x: Array, u: Array) -> Point:
    """The point nearest to (x, u) at which the plant rests with the stop's values,
    in its limits.
    """
    plant, leg = problem.plant, problem.legs[0]
    x_nominal, u_nominal = nominals(problem)
    z = ca.MX.sym("z", len(x) + len(u))
    scale = np.concatenate([x_nominal, u_nominal])
    given = np.concatenate([x, u]) / scale
    state, given_input = z[: len(x)] * x_nominal, z[len(x) :] * u_nominal
    p = plant.vector("parameter")
    wanted = [plant.expression(n) / subject(plant, n)[0].nominal for n in known]
    others = _others(problem)
    low, high = limits(leg.path)
    aims = np.array([value / subject(plant, n)[0].nominal for n, value in known.items()])
    # a memory that is given keeps what it holds; rounded, it may give up some of it
    kept = {n for n in held_names(plant) if n in known}
    free = [i for i, v in enumerate(plant.states) if v.name not in kept]
    equal = np.concatenate([np.zeros(len(free)), aims])
    box = np.array([leg.bounds[v.name] for v in (*plant.states, *plant.inputs)]) / scale[:, None]
    nlp = {
        "x": z,
        "f": ca.sumsqr(z - given),
        "g": ca.veccat(
            (plant.function(state, given_input, p)[0] / x_nominal)[free],
            problem.function("wanted", wanted)(state, given_input, *others),
            problem.conditions("path", leg.path)(state, given_input, *others),
        ),
    }
    solver = nlpsol("balance", "ipopt", nlp, quiet_ipopt(max_iter=200))
    found = solver(
        x0=given,
        lbx=box[:, 0],
        ubx=box[:, 1],
        lbg=np.concatenate([equal - WITHIN, low]),
        ubg=np.concatenate([equal + WITHIN, high]),
    )
    if not solver.stats()["success"]:
        # from start values behind a clamp (a slack tendon) this finds nothing
        return _rest(plant, known, completed=True) or (x, u)
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


# ---- a motion that the plant can make, led along the usual path ----------------------------------
# Step by step (implicit Euler) the inputs are chosen with which the positions stay nearest to a
# path of rests between the stops: pressures follow from the forces that the path needs, commands
# from the pressures, memories from all that went before. What comes out keeps the plant's equations
# and bounds but for the steps' own error, and visits the stops nearly.
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

    def held(times: Array) -> Array:
        """Each step's own inputs."""
        row = np.clip(np.searchsorted(t, times), 0, len(t) - 1)
        return np.asarray(u[row])

    return sampled_along(problem, mesh, durations, _on_lines(t, x), held)


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
