"""From a Problem to a nonlinear program: direct collocation on Radau points.

On each interval the state is a polynomial through its start and the collocation points, and meets
the plant's equation at these points (Biegler, Nonlinear Programming, SIAM 2010, ch. 10). All
variables and defects are scaled by the plant's nominals, and ordered along the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..plant.plant import Plant
from ..signals import PiecewisePolynomial
from .guess import Unpacked, initial_guess
from .mesh import Control, Interval, Mesh, radau
from .problem import Condition, Problem

__all__ = ["Program", "Row", "transcribe"]

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """What some rows of the NLP's constraints are: for messages and for the elastic re-solve."""

    label: str
    kind: Literal["defect", "path", "stop", "closing"]
    low: Array
    high: Array
    conditions: tuple[Condition, ...] = ()
    """One per row, for "path" and "stop"."""
    where: tuple[str, ...] = ()
    """Where each row stands along the motion, for "path"."""

    @property
    def size(self) -> int:
        return len(self.low)


@dataclass(frozen=True)
class Program:
    """The NLP of a Problem on a Mesh, in scaled variables w; ``p`` are the plant's parameters."""

    problem: Problem
    mesh: Mesh
    nlp: dict[str, ca.MX]
    rows: tuple[Row, ...]
    w_low: Array
    w_high: Array
    guess: Array

    def unpack(self, w: Array) -> Unpacked:
        """(times (n,), states (n, nx), inputs as signals, durations (phases,)) of a solution, in SI.

        The times are the start and every collocation point.
        """
        plant = self.problem.plant
        x_nominal, u_nominal = _nominals(plant)
        nx, nu = len(x_nominal), len(u_nominal)
        durations = w[-len(self.problem.durations) :] * _time_nominals(self.problem)
        t, states, pieces = [0.0], [w[:nx]], []
        breaks, at, begin = [0.0], nx, 0.0
        for interval in self.mesh.intervals:
            h = float(durations[interval.phase] * interval.fraction)
            points = w[at : at + nx * interval.degree].reshape(interval.degree, nx)
            at += nx * interval.degree
            columns = interval.columns(self.mesh.control)
            values = w[at : at + nu * columns].reshape(columns, nu) * u_nominal
            at += nu * columns
            t += list(begin + h * radau(interval.degree))
            states += list(points)
            pieces.append(interval.polynomial(self.mesh.control, values, h))
            begin += h
            breaks.append(begin)
        degree = max(len(p) for p in pieces)
        coefficients = np.zeros((len(pieces), degree, nu))
        for k, piece in enumerate(pieces):
            coefficients[k, : len(piece)] = piece
        signals = PiecewisePolynomial(np.array(breaks), coefficients)
        return np.array(t), np.array(states) * x_nominal, signals, durations


def _nominals(plant: Plant) -> tuple[Array, Array]:
    return plant.vector("state", attribute="nominal"), plant.vector("input", attribute="nominal")


def _time_nominals(problem: Problem) -> Array:
    return np.array([np.sqrt(low * high) for low, high in problem.durations])


@dataclass(frozen=True)
class _Unknowns:
    """Scaled symbols of the program, interval by interval."""

    start: ca.MX
    points: list[ca.MX]
    """nx x degree each; the last column is the interval's end."""
    inputs: list[ca.MX]
    """nu x columns each."""
    durations: ca.MX

    def begin(self, k: int) -> ca.MX:
        """State at the start of interval k (its end for k = number of intervals)."""
        return self.start if k == 0 else self.points[k - 1][:, -1]

    @property
    def w(self) -> ca.MX:
        along = (part for pair in zip(self.points, self.inputs, strict=True) for part in pair)
        return ca.veccat(self.start, *along, self.durations)


def transcribe(problem: Problem, mesh: Mesh, previous: Unpacked | None = None) -> Program:
    """State the NLP: defects, path conditions, stops, closing; bounds and initial guess.

    previous : an unpacked solution on another mesh to start from.
    """
    plant = problem.plant
    nx, nu = len(plant.states), len(plant.inputs)
    z = _Unknowns(
        ca.MX.sym("x0", nx),
        [ca.MX.sym(f"x{k}", nx, i.degree) for k, i in enumerate(mesh.intervals)],
        [ca.MX.sym(f"u{k}", nu, i.columns(mesh.control)) for k, i in enumerate(mesh.intervals)],
        ca.MX.sym("T", len(problem.durations)),
    )
    p = ca.MX.sym("p", len(plant.parameters))
    durations = z.durations * _time_nominals(problem)
    constraints, rows, running = _stages(problem, mesh, z, durations, p)
    for piece, row in [*_nodes(problem, mesh, z, p), *_continuity(mesh, z)]:
        constraints.append(piece)
        rows.append(row)
    objective = problem.weights.get("time", 0.0) * ca.sum1(durations) + running
    low, high = _bounds(problem, mesh)
    guess = initial_guess(problem, mesh, _time_nominals(problem), previous)
    return Program(
        problem, mesh, {"x": z.w, "p": p, "f": objective, "g": ca.veccat(*constraints)},
        tuple(rows), low, high, np.clip(guess, low, high),
    )  # fmt: skip


def _stages(
    problem: Problem, mesh: Mesh, z: _Unknowns, durations: ca.MX, p: ca.MX
) -> tuple[list[ca.MX], list[Row], ca.MX]:
    """Defects and path conditions of all intervals, mapped over those of equal degree."""
    constraints, rows, running = [], [], ca.MX(0)
    for degree in sorted({i.degree for i in mesh.intervals}):
        members = [k for k, i in enumerate(mesh.intervals) if i.degree == degree]
        stage = _stage(problem, mesh.control, degree).map(len(members))
        h = ca.horzcat(
            *(durations[mesh.intervals[k].phase] * mesh.intervals[k].fraction for k in members)
        )
        defects, path, cost = stage(
            ca.horzcat(*(z.begin(k) for k in members)),
            ca.horzcat(*(ca.vec(z.points[k]) for k in members)),
            ca.horzcat(*(ca.vec(z.inputs[k]) for k in members)),
            h, p,
        )  # fmt: skip
        zero = np.zeros(defects.numel())
        constraints.append(defects)
        rows.append(Row("dynamics", "defect", zero, zero))
        running += ca.sum2(cost)
        conditions = (*problem.path * degree, *_with_inputs(problem))
        if conditions:
            low, high = _limits(conditions)
            constraints.append(path)
            places = [f"in interval {k + 1} of {len(mesh.intervals)}" for k in members]
            rows.append(
                Row(
                    "path", "path", np.tile(low, len(members)), np.tile(high, len(members)),
                    conditions * len(members), tuple(s for s in places for _ in conditions),
                )
            )  # fmt: skip
    return constraints, rows, running


def _stage(problem: Problem, control: Control, degree: int) -> ca.Function:
    """One interval: (start, points, inputs, h, p) -> (scaled defects, path values, running cost)."""
    plant = problem.plant
    x_nominal, u_nominal = _nominals(plant)
    nx, nu = len(x_nominal), len(u_nominal)
    interval = Interval(0, 1.0, degree)
    start, points = ca.SX.sym("start", nx), ca.SX.sym("points", nx, degree)
    inputs = ca.SX.sym("inputs", nu, interval.columns(control))
    h, p = ca.SX.sym("h"), ca.SX.sym("p", len(plant.parameters))
    derivative, _, quadrature = ca.collocation_coeff(radau(degree).tolist())
    polynomial = ca.horzcat(start, points) @ ca.DM(derivative)  # scaled dx/dtau at the points
    path, running = _values(plant, problem.path), _running(problem)
    defects, values, cost = [], [ca.SX(0, 1)], ca.SX(0)
    for j, tau in enumerate(radau(degree)):
        x = points[:, j] * x_nominal
        u = inputs @ interval.weights(control, tau) * u_nominal
        defects.append(h * plant.function(x, u, p)[0] / x_nominal - polynomial[:, j])
        values.append(path(x, u, p))
        cost += h * quadrature[j] * running(x, u, p)
    # an input may jump at the start of the interval: what depends on it is checked there too
    u = inputs @ interval.weights(control, 0.0) * u_nominal
    values.append(_values(plant, _with_inputs(problem))(start * x_nominal, u, p))
    return ca.Function(
        "stage",
        [start, ca.vec(points), ca.vec(inputs), h, p],
        [ca.veccat(*defects), ca.vertcat(*values), cost],
    )


def _running(problem: Problem) -> ca.Function:
    """The integrand of the objective: weighed effort, and the user's own."""
    plant = problem.plant
    total = ca.SX(0)
    weight = problem.weights.get("effort", 0.0)
    if weight:
        total += weight * ca.sumsqr(plant.u / plant.vector("input", attribute="nominal"))
    if problem.integrand is not None:
        total += problem.integrand
    return ca.Function("running", [plant.x, plant.u, plant.p], [total])


def _with_inputs(problem: Problem) -> tuple[Condition, ...]:
    u = problem.plant.u
    return tuple(c for c in problem.path if u.numel() and ca.depends_on(c.expression, u))


def _values(plant: Plant, conditions: Sequence[Condition]) -> ca.Function:
    """(x, u, p) -> the conditions' values in units of their nominals."""
    values = [c.expression / c.nominal for c in conditions]
    return ca.Function(
        "conditions", [plant.x, plant.u, plant.p], [ca.vertcat(*values) if values else ca.SX(0, 1)]
    )


def _limits(conditions: Sequence[Condition]) -> tuple[Array, Array]:
    low = np.array([c.low / c.nominal for c in conditions])
    high = np.array([c.high / c.nominal for c in conditions])
    return low, high


def _nodes(problem: Problem, mesh: Mesh, z: _Unknowns, p: ca.MX) -> list[tuple[ca.MX, Row]]:
    """Conditions at the stops, and the closing of a cycle."""
    x_nominal, u_nominal = _nominals(problem.plant)
    count = len(mesh.intervals)
    pieces = []
    for i, conditions in enumerate(problem.nodes):
        if not conditions:
            continue
        k = mesh.first(i)  # the interval behind the node, or the number of intervals at the end
        inside = min(k, count - 1)
        weights = mesh.intervals[inside].weights(mesh.control, 1.0 if k == count else 0.0)
        u = z.inputs[inside] @ weights * u_nominal
        values = _values(problem.plant, conditions)(z.begin(k) * x_nominal, u, p)
        low, high = _limits(conditions)
        pieces.append((values, Row(f"stop {i + 1}", "stop", low, high, conditions)))
    if problem.closing is not None:
        names = [v.name for v in problem.plant.states]
        image = ca.vertcat(
            *(sign * z.start[names.index(other)] * x_nominal[names.index(other)] / x_nominal[i]
              for i, (sign, other) in enumerate(problem.closing[name] for name in names))
        )  # fmt: skip
        zero = np.zeros(len(names))
        pieces.append((z.begin(count) - image, Row("closing of the cycle", "closing", zero, zero)))
    return pieces


def _continuity(mesh: Mesh, z: _Unknowns) -> list[tuple[ca.MX, Row]]:
    """Linear inputs do not jump."""
    if mesh.control != "linear" or len(mesh.intervals) < 2:
        return []
    jumps = ca.veccat(
        *(a[:, 1] - b[:, 0] for a, b in zip(z.inputs[:-1], z.inputs[1:], strict=True))
    )
    zero = np.zeros(jumps.numel())
    return [(jumps, Row("continuity of the inputs", "defect", zero, zero))]


def _bounds(problem: Problem, mesh: Mesh) -> tuple[Array, Array]:
    plant = problem.plant
    x_nominal, u_nominal = _nominals(plant)
    x, u = (
        np.array([problem.bounds[v.name] for v in variables]).reshape(-1, 2) / nominal[:, None]
        for variables, nominal in ((plant.states, x_nominal), (plant.inputs, u_nominal))
    )
    parts = [x]
    for interval in mesh.intervals:
        parts += [x] * interval.degree + [u] * interval.columns(mesh.control)
    parts.append(np.array(problem.durations) / _time_nominals(problem)[:, None])
    both = np.vstack(parts)
    return both[:, 0], both[:, 1]
