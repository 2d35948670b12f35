"""From a Problem to a nonlinear program: direct collocation on Radau points.

On each interval the state is a polynomial through its start and the collocation points, and meets
the plant's equation at these points (Biegler, Nonlinear Programming, SIAM 2010, ch. 10). All
variables and defects are scaled by the plant's nominals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .problem import Condition, Problem

__all__ = ["Collocation", "Control", "Program", "Row", "transcribe"]

Array: TypeAlias = NDArray[np.float64]
Control: TypeAlias = Literal["constant", "linear"]


@dataclass(frozen=True)
class Collocation:
    """Radau collocation: ``intervals`` per phase, polynomials of ``degree``.

    control : inputs constant on each interval (as a digital controller holds them), or linear and
        continuous within a phase.
    """

    intervals: int = 50
    degree: int = 3
    control: Control = "constant"

    def __post_init__(self) -> None:
        if not (isinstance(self.intervals, int) and self.intervals >= 1):
            raise InputError(f"intervals = {self.intervals!r}: give a whole number >= 1")
        if not (isinstance(self.degree, int) and 1 <= self.degree <= 9):
            raise InputError(f"degree = {self.degree!r}: give a whole number from 1 to 9")
        if self.control not in ("constant", "linear"):
            raise InputError(f"control = {self.control!r}: choose 'constant' or 'linear'")

    @property
    def points(self) -> Array:
        """Radau points in (0, 1]; the last is 1."""
        return np.array(ca.collocation_points(self.degree, "radau"))


@dataclass(frozen=True)
class Row:
    """What some rows of the NLP's constraints are: for messages and for the elastic re-solve."""

    label: str
    kind: Literal["defect", "path", "stop", "closing"]
    size: int
    low: Array
    high: Array
    nominal: float
    conditions: tuple[Condition, ...] = ()


@dataclass(frozen=True)
class Program:
    """The NLP of a Problem, in scaled variables w; ``p`` are the plant's parameters.

    ``unpack`` takes w to (states (nx, 1 + n degree), inputs (nu, columns), durations (phases,)) in
    SI, all along the motion; columns are one per interval (constant) or degree + 1 per interval.
    """

    problem: Problem
    method: Collocation
    nlp: dict[str, ca.MX]
    unpack: ca.Function
    rows: tuple[Row, ...]
    w_low: Array
    w_high: Array
    guess: Array

    def times(self, durations: Array) -> Array:
        """Times of all columns of the states [s]: the start, then every collocation point."""
        h = np.repeat(durations / self.method.intervals, self.method.intervals)
        starts = np.concatenate([[0.0], np.cumsum(h)])
        inside = starts[:-1, None] + h[:, None] * self.method.points
        inside[:, -1] = starts[1:]
        return np.concatenate([[0.0], inside.ravel()])


@dataclass(frozen=True)
class _Unknowns:
    """Scaled symbols of the program and what they are in SI."""

    start: ca.MX
    states: ca.MX  # nx x (n K)
    inputs: ca.MX  # nu x n, or nu x 2n for the ends of each interval
    durations: ca.MX


def transcribe(problem: Problem, method: Collocation) -> Program:
    """State the NLP: defects, path conditions, stops, closing; bounds and initial guess."""
    plant = problem.plant
    phases, n = len(problem.durations), len(problem.durations) * method.intervals
    nx, nu, degree = len(plant.states), len(plant.inputs), method.degree
    x_nominal = plant.vector("state", attribute="nominal")
    u_nominal = plant.vector("input", attribute="nominal")
    t_nominal = np.array([np.sqrt(low * high) for low, high in problem.durations])
    ends = 2 if method.control == "linear" else 1

    z = _Unknowns(
        ca.MX.sym("x0", nx), ca.MX.sym("x", nx, n * degree),
        ca.MX.sym("u", nu, n * ends), ca.MX.sym("T", phases),
    )  # fmt: skip
    p = ca.MX.sym("p", len(plant.parameters))
    w = ca.veccat(z.start, z.states, z.inputs, z.durations)
    durations = z.durations * t_nominal
    h = ca.horzcat(
        *(ca.repmat(durations[i] / method.intervals, 1, method.intervals) for i in range(phases))
    )
    begins = ca.horzcat(z.start, z.states[:, degree - 1 :: degree])[:, :-1]

    stage = _stage(problem, method, x_nominal, u_nominal)
    mapped = stage.map(n)
    defects, path, effort = mapped(
        begins, ca.reshape(z.states, nx * degree, n), ca.reshape(z.inputs, nu * ends, n), h, p
    )
    constraints, rows = _rows(problem, method, defects, path, n)
    for piece, row in _nodes(problem, method, z, x_nominal, u_nominal, p):
        constraints.append(piece)
        rows.append(row)
    if method.control == "linear" and method.intervals > 1:
        constraints.append(_continuity(z.inputs, method.intervals, phases))
        size = constraints[-1].numel()
        rows.append(Row("continuous inputs", "defect", size, np.zeros(size), np.zeros(size), 1.0))
    objective = problem.weights.get("time", 0.0) * ca.sum1(durations) + problem.weights.get(
        "effort", 0.0
    ) * ca.sum2(effort)
    return Program(
        problem, method,
        {"x": w, "p": p, "f": objective, "g": ca.veccat(*constraints)},
        ca.Function("unpack", [w], [
            ca.horzcat(z.start, z.states) * ca.repmat(ca.DM(x_nominal), 1, 1 + n * degree),
            z.inputs * ca.repmat(ca.DM(u_nominal), 1, n * ends),
            durations,
        ]),
        tuple(rows),
        *_bounds_and_guess(problem, method, x_nominal, u_nominal, t_nominal, ends),
    )  # fmt: skip


def _stage(
    problem: Problem, method: Collocation, x_nominal: Array, u_nominal: Array
) -> ca.Function:
    """One interval: (start, points, inputs, h, p) -> (scaled defects, path values, effort)."""
    plant, degree = problem.plant, method.degree
    nx, nu = len(x_nominal), len(u_nominal)
    ends = 2 if method.control == "linear" else 1
    start, points = ca.SX.sym("start", nx), ca.SX.sym("points", nx, degree)
    inputs, h = ca.SX.sym("inputs", nu, ends), ca.SX.sym("h")
    p = ca.SX.sym("p", len(plant.parameters))
    tau = method.points
    derivative, _, quadrature = ca.collocation_coeff(tau.tolist())
    polynomial = ca.horzcat(start, points) @ ca.DM(derivative)  # scaled dx/dtau at the points
    path = _functions(plant, problem.path)
    defects, effort = [], ca.SX(0)
    values = [ca.SX(0, 1)]
    for j in range(degree):
        fraction = tau[j] if method.control == "linear" else 0.0
        u_scaled = inputs[:, 0] + fraction * (inputs[:, ends - 1] - inputs[:, 0])
        x, u = points[:, j] * x_nominal, u_scaled * u_nominal
        defects.append(h * plant.function(x, u, p)[0] / x_nominal - polynomial[:, j])
        values.append(path(x, u, p))
        effort += h * quadrature[j] * ca.sumsqr(u_scaled)
    # an input may jump at the start of the interval: what depends on it is checked there too
    values.append(
        _functions(plant, _with_inputs(problem))(start * x_nominal, inputs[:, 0] * u_nominal, p)
    )
    return ca.Function(
        "stage",
        [start, ca.vec(points), ca.vec(inputs), h, p],
        [ca.veccat(*defects), ca.vertcat(*values), effort],
    )


def _with_inputs(problem: Problem) -> tuple[Condition, ...]:
    u = problem.plant.u
    return tuple(c for c in problem.path if u.numel() and ca.depends_on(c.expression, u))


def _functions(plant: object, conditions: Sequence[Condition]) -> ca.Function:
    """(x, u, p) -> the conditions' values in units of their nominals."""
    values = [c.expression / c.nominal for c in conditions]
    return ca.Function(
        "conditions", [plant.x, plant.u, plant.p],  # type: ignore[attr-defined]
        [ca.vertcat(*values) if values else ca.SX(0, 1)],
    )  # fmt: skip


def _limits(conditions: Sequence[Condition]) -> tuple[Array, Array]:
    low = np.array([c.low / c.nominal for c in conditions])
    high = np.array([c.high / c.nominal for c in conditions])
    return low, high


def _rows(
    problem: Problem, method: Collocation, defects: ca.MX, path: ca.MX, n: int
) -> tuple[list[ca.MX], list[Row]]:
    size = defects.numel()
    rows = [Row("dynamics", "defect", size, np.zeros(size), np.zeros(size), 1.0)]
    per_interval = (*problem.path * method.degree, *_with_inputs(problem))
    if not per_interval:
        return [defects], rows
    low, high = _limits(per_interval)
    rows.append(
        Row("path", "path", path.numel(), np.tile(low, n), np.tile(high, n), 1.0, per_interval)
    )
    return [defects, path], rows


def _nodes(
    problem: Problem,
    method: Collocation,
    z: _Unknowns,
    x_nominal: Array,
    u_nominal: Array,
    p: ca.MX,
) -> list[tuple[ca.MX, Row]]:
    """Conditions at the stops, and the closing of a cycle."""
    ends = 2 if method.control == "linear" else 1
    per_phase, last = method.intervals, len(problem.nodes) - 1
    pieces = []
    for i, conditions in enumerate(problem.nodes):
        if not conditions:
            continue
        x = z.start if i == 0 else z.states[:, i * per_phase * method.degree - 1]
        column = i * per_phase * ends if i < last else z.inputs.shape[1] - 1
        values = _functions(problem.plant, conditions)(
            x * x_nominal, z.inputs[:, column] * u_nominal, p
        )
        low, high = _limits(conditions)
        pieces.append(
            (values, Row(f"stop {i + 1}", "stop", len(conditions), low, high, 1.0, conditions))
        )
    if problem.closing is not None:
        names = [v.name for v in problem.plant.states]
        image = ca.vertcat(
            *(sign * z.start[names.index(other)] * x_nominal[names.index(other)] / x_nominal[i]
              for i, (sign, other) in enumerate(problem.closing[name] for name in names))
        )  # fmt: skip
        zero = np.zeros(len(names))
        row = Row("closing of the cycle", "closing", len(names), zero, zero, 1.0)
        pieces.append((z.states[:, -1] - image, row))
    return pieces


def _continuity(inputs: ca.MX, intervals: int, phases: int) -> ca.MX:
    """Linear inputs do not jump between the intervals of one phase."""
    ends, begins = inputs[:, 1::2], inputs[:, 0::2]
    inside = [k for k in range(1, intervals * phases) if k % intervals]
    return ca.horzcat(*(ends[:, k - 1] - begins[:, k] for k in inside))


def _bounds_and_guess(
    problem: Problem,
    method: Collocation,
    x_nominal: Array,
    u_nominal: Array,
    t_nominal: Array,
    ends: int,
) -> tuple[Array, Array, Array]:
    plant, n = problem.plant, len(problem.durations) * method.intervals
    columns = 1 + n * method.degree

    def limits(variables: Sequence[object], nominal: Array) -> tuple[Array, Array]:
        pairs = np.array([problem.bounds[v.name] for v in variables]).reshape(-1, 2)  # type: ignore[attr-defined]
        return pairs[:, 0] / nominal, pairs[:, 1] / nominal

    x_low, x_high = limits(plant.states, x_nominal)
    u_low, u_high = limits(plant.inputs, u_nominal)
    t_low, t_high = np.array(problem.durations).T / t_nominal
    low = np.concatenate([np.tile(x_low, columns), np.tile(u_low, n * ends), t_low])
    high = np.concatenate([np.tile(x_high, columns), np.tile(u_high, n * ends), t_high])
    states = _guess(problem, method, t_nominal) / x_nominal[:, None]
    inputs = plant.vector("input") / u_nominal
    guess = np.concatenate([states.T.ravel(), np.tile(inputs, n * ends), t_nominal / t_nominal])
    return low, high, np.clip(guess, low, high)


def _guess(problem: Problem, method: Collocation, durations: Array) -> Array:
    """States along minimum-jerk paths between the stops; all else at its start value."""
    plant = problem.plant
    names = [v.name for v in plant.states]
    h = (np.arange(method.intervals)[:, None] + method.points).ravel() / method.intervals
    blend = h**3 * (10 - 15 * h + 6 * h**2)
    slope = 30 * h**2 * (1 - h) ** 2
    states = np.repeat(plant.vector("state")[:, None], 1 + len(durations) * len(h), axis=1)
    for name in names:
        targets = [
            _middle(stop.get(name), plant.variable(name).start or 0.0) for stop in problem.stops
        ]
        row = states[names.index(name)]
        row[0] = targets[0]
        for i, (a, b) in enumerate(pairwise(targets)):
            row[1 + i * len(h) : 1 + (i + 1) * len(h)] = a + (b - a) * blend
            velocity = plant.positions.get(name)
            if velocity is not None:
                part = states[names.index(velocity)]
                part[1 + i * len(h) : 1 + (i + 1) * len(h)] = (b - a) * slope / durations[i]
    return states


def _middle(value: object, default: float) -> float:
    if value is None:
        return default
    if isinstance(value, list | tuple):
        ends = [v for v in value if v is not None and np.isfinite(v)]
        return float(np.mean(ends)) if ends else default
    return float(value)  # type: ignore[arg-type]
