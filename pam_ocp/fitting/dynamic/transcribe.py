"""A dynamic fit as a nonlinear program: unknowns, residuals, and the plant's equations.

Time runs as the inputs' clock does. What was measured at t left the plant at t - delay, since a
delay of the inputs is, for a plant that knows no time of its own, a delay of all that is measured.
So the mesh stays with the inputs, and the delay only moves the places where it is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from ...numerics.collocation import collocation_matrices, collocation_points, lagrange
from ...numerics.runge_kutta import rk4
from ...plants.plant import Plant
from ..statistics import Array
from .experiment import Experiment, ParameterGroup

__all__ = ["METHODS", "FitMethod", "FitProgram", "Unknowns", "head_of", "transcribe"]

FitMethod: TypeAlias = Literal["collocation", "multiple-shooting", "single-shooting", "simulation"]
METHODS = ("collocation", "multiple-shooting", "single-shooting", "simulation")


@dataclass(frozen=True)
class Unknowns:
    """What is sought beside the states along the records.

    offsets, gains : positions among the measured names. delay : bounds [s] and value.
    """

    groups: Sequence[ParameterGroup]
    names: Sequence[str]
    offsets: Sequence[int] = ()
    gains: Sequence[int] = ()
    delay: float = 0.0
    delay_bounds: tuple[float, float] | None = None
    process: Sequence[tuple[int, float]] = ()
    """Positions of states that are disturbed, and the intensities [unit/sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class FitProgram:
    """min |W residuals|^2 subject to ``defects`` = 0, in scaled unknowns w = (head, states, jumps).

    head : (parameters, gains - 1, offsets, delay, initial states of every record).
    residuals : in units of the measured variables' nominals; one weight each is the parameter.
    jumps : how many unknowns at the end of w are jumps of disturbed states where intervals begin,
        and errors of measured inputs, in units of their standard deviations; residuals ends with
        them.
    """

    w: ca.MX
    weights: ca.MX
    residuals: ca.MX
    defects: ca.MX
    head: int
    head_scale: Array
    guess: Array
    low: Array
    high: Array
    jumps: int = 0
    solvers: dict[Any, Any] = field(default_factory=dict, repr=False)
    """Of this program, by their settings: they are dear to make."""

    @cached_property
    def slopes(self) -> tuple[ca.MX, ca.MX]:
        """Jacobians of residuals and defects over w."""
        return ca.jacobian(self.residuals, self.w), ca.jacobian(self.defects, self.w)

    @cached_property
    def derivatives(self) -> ca.Function:
        """(w, weights) -> :attr:`slopes`."""
        return ca.Function("derivatives", [self.w, self.weights], [*self.slopes])


@dataclass(frozen=True, eq=False)
class _Mesh:
    """All intervals of all records side by side."""

    h: Array
    u: Array  # (nu (degree + 1), n)
    begin: Array  # column in (initial states, ends of intervals) where each interval begins
    measured: Array  # (ny, K)
    interval: Array  # of each sample
    offset: Array  # (K,) time since the interval's begin at zero delay


def transcribe(
    plant: Plant,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    method: FitMethod,
    degree: int,
) -> FitProgram:
    """State the program for a method; ``degree`` is that of the collocation, or steps of RK4."""
    mesh = _mesh(experiments, unknowns.delay)
    x_nominal = plant.vector("state", attribute="nominal")
    y_nominal = np.array([plant.variable(name).nominal for name in unknowns.names])
    records, usual = len(experiments), float(np.median(mesh.h))
    theta, x0 = ca.MX.sym("theta", len(unknowns.groups)), ca.MX.sym("x0", len(x_nominal), records)
    gain = ca.MX.sym("gain", len(unknowns.gains))
    offset = ca.MX.sym("offset", len(unknowns.offsets))
    delay = ca.MX.sym("delay", 1 if unknowns.delay_bounds else 0)
    p = _parameters(plant, unknowns.groups, theta)
    lift = _jumps(mesh, records, unknowns.process, x_nominal)
    errors = _input_errors(experiments, mesh)
    jumps = ca.MX.sym("jumps", lift.shape[1] + errors.shape[1])
    u = ca.MX(ca.DM(mesh.u))
    if errors.shape[1]:
        u += ca.reshape(errors @ jumps[lift.shape[1] :], *mesh.u.shape)
    given = (x0, p, lift @ jumps[: lift.shape[1]], u)
    way = _way(plant, experiments, unknowns, mesh, method, degree, given)

    rows = mesh.interval.tolist()
    since = mesh.offset[None] - (delay * usual if unknowns.delay_bounds else unknowns.delay)
    modelled = way.read.map(len(rows))(
        way.begins[:, rows], way.inside[:, rows], since, mesh.h[rows][None], u[:, rows], p
    )
    sensor = _sensor(unknowns, gain, offset, len(unknowns.names))
    residuals = (mesh.measured / y_nominal[:, None]) - modelled * sensor[0] - sensor[1]
    weights = ca.MX.sym("weights", len(unknowns.names))
    residuals = ca.vertcat(ca.vec(residuals * ca.repmat(weights, 1, len(rows))), jumps)

    head = ca.veccat(theta, gain, offset, delay, x0)
    guess, low, high = _guess(plant, experiments, unknowns, method, degree, x_nominal)
    head_scale = head_of(plant, experiments, unknowns)[3]
    open_ = np.full(jumps.numel(), np.inf)
    return FitProgram(
        ca.veccat(head, way.points, jumps),
        weights,
        residuals,
        way.defects,
        head.numel(),
        head_scale,
        np.concatenate([guess, np.zeros(jumps.numel())]),
        np.concatenate([low, -open_]),
        np.concatenate([high, open_]),
        jumps.numel(),
    )


@dataclass(frozen=True, eq=False)
class _Way:
    """The motion along all intervals: unknown points, where intervals begin, what is to be zero.

    inside : the points that ``read`` takes besides the begin (none for shooting), a column each.
    """

    points: ca.MX
    begins: ca.MX
    inside: ca.MX
    defects: ca.MX
    read: ca.Function


def _way(
    plant: Plant,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    mesh: _Mesh,
    method: FitMethod,
    degree: int,
    given: tuple[ca.MX, ca.MX, ca.MX, ca.MX],
) -> _Way:
    """The motion by a method. given : initial states, parameters, jumps in nominals (a column),
    inputs.
    """
    x0, p, jumps, u = given
    x_nominal = plant.vector("state", attribute="nominal")
    nx, n = len(x_nominal), mesh.h.size

    def begins(ends: ca.MX) -> ca.MX:
        found = ca.horzcat(x0, ends)[:, mesh.begin.tolist()]
        return found + ca.reshape(jumps, nx, n) if unknowns.process else found

    if method == "collocation":
        points = ca.MX.sym("x", nx * degree, n)
        step, read = _collocation(plant, x_nominal, mesh, unknowns.names, degree)
        begin = begins(points[nx * (degree - 1) :, :])
        defects = step.map(n)(begin, points, mesh.h[None], u, p)
        return _Way(points, begin, points, ca.vec(defects), read)
    step, read = _shooting(plant, x_nominal, mesh, unknowns.names, degree)
    if method == "single-shooting":
        begin = begins(_rolled(step, experiments, x0, mesh, (u, p)))
        return _Way(ca.MX(nx, 0), begin, ca.MX(0, n), ca.MX(0, 1), read)
    points = ca.MX.sym("x", nx, n)
    begin = begins(points)
    defects = step.map(n)(begin, mesh.h[None], u, p) - points
    return _Way(points, begin, ca.MX(0, n), ca.vec(defects), read)


def _jumps(
    mesh: _Mesh, records: int, process: Sequence[tuple[int, float]], x_nominal: Array
) -> ca.DM:
    """Matrix from jumps (in standard deviations) to the begins of all intervals (nominals).

    White noise of intensity q adds the variance q^2 h during an interval of length h; the next one
    begins with it. The first of each record has none: its initial state is free.
    """
    nx, n = len(x_nominal), mesh.h.size
    later = np.nonzero(mesh.begin >= records)[0]
    rows, columns, values = [], [], []
    for place, i in enumerate(later if process else []):
        for column, (state, intensity) in enumerate(process):
            rows.append(int(i * nx + state))
            columns.append(place * len(process) + column)
            values.append(intensity * np.sqrt(mesh.h[i - 1]) / x_nominal[state])
    return ca.DM.triplet(rows, columns, ca.DM(values), nx * n, len(later) * len(process))


def _input_errors(experiments: Sequence[Experiment], mesh: _Mesh) -> ca.DM:
    """Matrix from errors of measured inputs (in standard deviations) to all coefficients, a column
    of ``mesh.u`` after the other.
    """
    rows, columns, values, first, count = [], [], [], 0, 0
    for e in experiments:
        if e.errors is not None:
            rows += (first + e.errors.rows).tolist()
            columns += (count + e.errors.columns).tolist()
            values += e.errors.values.tolist()
            count += e.errors.count
        first += e.coefficients.size
    return ca.DM.triplet(rows, columns, ca.DM(values), mesh.u.size, count)


def _mesh(experiments: Sequence[Experiment], delay: float) -> _Mesh:
    records = len(experiments)
    begin, interval, offset, first = [], [], [], 0
    for r, e in enumerate(experiments):
        n = len(e.mesh) - 1
        begin.append(np.concatenate([[r], records + first + np.arange(n - 1)]))
        place = np.clip(np.searchsorted(e.mesh, e.t - delay + 1e-12, side="right") - 1, 0, n - 1)
        # a sample at the end of an interval belongs to it: the state there is a node
        at_node = (np.abs(e.mesh[place] - (e.t - delay)) < 1e-9) & (place > 0)
        place = place - at_node
        interval.append(first + place)
        offset.append(e.t - e.mesh[place])
        first += n
    u = np.concatenate([e.coefficients.reshape(len(e.mesh) - 1, -1) for e in experiments])
    return _Mesh(
        np.concatenate([np.diff(e.mesh) for e in experiments]),
        u.T,
        np.concatenate(begin),
        np.concatenate([e.measured for e in experiments]).T,
        np.concatenate(interval),
        np.concatenate(offset),
    )


def _parameters(plant: Plant, groups: Sequence[ParameterGroup], theta: ca.MX) -> ca.MX:
    """All parameters of the plant."""
    base = plant.vector("parameter")
    place = np.zeros((len(base), len(groups)))
    for j, group in enumerate(groups):
        place[list(group.members), j] = group.scale
        base[list(group.members)] = 0.0
    return ca.DM(base) + ca.sparsify(ca.DM(place)) @ theta


def _sensor(unknowns: Unknowns, gain: ca.MX, offset: ca.MX, ny: int) -> tuple[ca.MX, ca.MX]:
    """(gains, offsets) of all measured variables; a gain's unknown is its excess over 1."""
    gains, offsets = ca.MX.ones(ny), ca.MX.zeros(ny)
    for i, place in enumerate(unknowns.gains):
        gains[place] = 1 + gain[i]
    for i, place in enumerate(unknowns.offsets):
        offsets[place] = offset[i]
    return gains, offsets


def _symbols(plant: Plant, x_nominal: Array, mesh: _Mesh) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    nu = len(plant.inputs)
    return (
        ca.SX.sym("begin", len(x_nominal)),
        ca.SX.sym("h"),
        ca.SX.sym("u", nu, mesh.u.shape[0] // max(nu, 1)),
        ca.SX.sym("p", len(plant.parameters)),
    )


def _input(u: ca.SX, since: ca.SX) -> ca.SX:
    """The inputs ``since`` an interval began."""
    return u @ ca.vertcat(*(since**j for j in range(u.shape[1])))


def _outputs(plant: Plant, names: Sequence[str]) -> ca.Function:
    """(x, u, p) -> what is measured, in units of nominals."""
    values = [plant.expression(n) / plant.variable(n).nominal for n in names]
    return ca.Function("measured", [plant.x, plant.u, plant.p], [ca.vertcat(*values)])


def _collocation(
    plant: Plant, x_nominal: Array, mesh: _Mesh, names: Sequence[str], degree: int
) -> tuple[ca.Function, ca.Function]:
    """Defects of one interval, and what is measured inside of it (Lagrange polynomial)."""
    begin, h, u, p = _symbols(plant, x_nominal, mesh)
    points, since = ca.SX.sym("points", len(x_nominal), degree), ca.SX.sym("since")
    tau = collocation_points("radau", degree)
    derivative, _, _ = collocation_matrices(tau)
    slope = ca.horzcat(begin, points) @ ca.DM(derivative)
    defects = [
        h * plant.function(points[:, j] * x_nominal, _input(u, h * tau[j]), p)[0] / x_nominal
        - slope[:, j]
        for j in range(degree)
    ]
    basis = lagrange((0.0, *tau.tolist()), since / h)
    x = ca.horzcat(begin, points) @ ca.vertcat(*basis) * x_nominal
    arguments = [begin, ca.vec(points)]
    return (
        ca.Function("defects", [*arguments, h, ca.vec(u), p], [ca.vertcat(*defects)]),
        ca.Function(
            "read",
            [*arguments, since, h, ca.vec(u), p],
            [_outputs(plant, names)(x, _input(u, since), p)],
        ),
    )


def _shooting(
    plant: Plant, x_nominal: Array, mesh: _Mesh, names: Sequence[str], steps: int
) -> tuple[ca.Function, ca.Function]:
    """The state at an interval's end by ``steps`` steps of RK4, and what is measured inside."""
    begin, h, u, p = _symbols(plant, x_nominal, mesh)
    since, span = ca.SX.sym("since"), ca.SX.sym("span")

    d = span / steps

    def slope(x: ca.SX, at: float) -> ca.SX:
        return plant.function(x * x_nominal, _input(u, at * d), p)[0] / x_nominal

    x = rk4(slope, begin, d, steps)
    after = ca.Function("after", [begin, span, ca.vec(u), p], [x])
    inside = after(begin, since, ca.vec(u), p) * x_nominal
    read = _outputs(plant, names)(inside, _input(u, since), p)
    none = ca.SX(0, 1)
    return after, ca.Function("read", [begin, none, since, h, ca.vec(u), p], [read])


def _rolled(
    step: ca.Function,
    experiments: Sequence[Experiment],
    x0: ca.MX,
    mesh: _Mesh,
    given: tuple[ca.MX, ca.MX],
) -> ca.MX:
    """The states at all ends of intervals, each record integrated from its initial state.

    given : inputs and parameters.
    """
    u, p = given
    first, parts = 0, []
    for r, e in enumerate(experiments):
        n = len(e.mesh) - 1
        span = slice(first, first + n)
        parts.append(step.mapaccum(n)(x0[:, r], mesh.h[span][None], u[:, span], ca.repmat(p, 1, n)))
        first += n
    return ca.horzcat(*parts)


def _guess(
    plant: Plant,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    method: FitMethod,
    degree: int,
    x_nominal: Array,
) -> tuple[Array, Array, Array]:
    """Start, lower and upper bounds of w."""
    head, low, high, _ = head_of(plant, experiments, unknowns)
    states = []
    if method != "single-shooting":
        tau = collocation_points("radau", degree) if method == "collocation" else np.ones(1)
        for e in experiments:
            times = (e.mesh[:-1, None] + np.diff(e.mesh)[:, None] * tau).ravel()
            columns = [np.interp(times, e.mesh, e.states[:, i]) for i in range(len(x_nominal))]
            states.append((np.stack(columns, 1) / x_nominal).ravel())
    inner = np.concatenate(states) if states else np.empty(0)
    free = np.full(inner.size, np.inf)
    return (
        np.concatenate([head, inner]),
        np.concatenate([low, -free]),
        np.concatenate([high, free]),
    )


def head_of(
    plant: Plant, experiments: Sequence[Experiment], unknowns: Unknowns
) -> tuple[Array, Array, Array, Array]:
    """Start, bounds and sizes of parameters, gains, offsets, delay and initial states."""
    g, bounds = unknowns.groups, unknowns.delay_bounds
    x_nominal = plant.vector("state", attribute="nominal")
    y_nominal = np.array([plant.variable(name).nominal for name in unknowns.names])
    usual = float(np.median(_mesh(experiments, unknowns.delay).h))
    records = len(experiments)
    x0 = np.concatenate([e.states[0] / x_nominal for e in experiments])
    fixed = len(unknowns.gains) + len(unknowns.offsets)
    lows = [np.array([v.low / v.scale for v in g]), np.full(fixed, -np.inf)]
    highs = [np.array([v.high / v.scale for v in g]), np.full(fixed, np.inf)]
    start = [np.array([v.value / v.scale for v in g]), np.zeros(fixed)]
    if bounds is not None:
        start.append(np.array([unknowns.delay / usual]))
        lows.append(np.array([bounds[0] / usual]))
        highs.append(np.array([bounds[1] / usual]))
    x_low, x_high = (plant.vector("state", attribute=a) / x_nominal for a in ("min", "max"))
    lows.append(np.tile(x_low, records))
    highs.append(np.tile(x_high, records))
    sizes = [
        np.array([v.scale for v in g]),
        np.ones(len(unknowns.gains)),
        y_nominal[list(unknowns.offsets)],
        np.full(0 if bounds is None else 1, usual),
        np.tile(x_nominal, records),
    ]
    low, high = np.concatenate(lows), np.concatenate(highs)
    guess = np.concatenate([*start, np.clip(x0, lows[-1], highs[-1])])
    return guess, low, high, np.concatenate(sizes)
