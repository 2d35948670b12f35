"""A dynamic fit as a nonlinear program: unknowns, residuals, and the plant's equations.

Time runs as the inputs' clock does. What was measured at t left the plant at t - delay, since a
delay of the inputs is, for a plant that knows no time of its own, a delay of all that is measured.
So the mesh stays with the inputs, and the delay only moves the places where it is read.

For plants whose equations have kinks that no polynomial over a sampling interval follows (slip
elements, play, softening) a program by simulation: residuals of accurate runs, slopes by
differences. Nothing but parameters and starts is unknown; a simulation meets every kink where it
is, and where a step of a parameter moves it, the residuals follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from ...core.errors import FitError, InputError, PamError
from ...core.expressions import polynomial
from ...core.signals import PiecewisePolynomial
from ...core.stop import native
from ...numerics.collocation import collocation_matrices, collocation_points, lagrange
from ...numerics.runge_kutta import rk4
from ...plants.plant import Plant
from ...simulation.integrate import Integration
from ...simulation.simulator import simulate
from ..statistics import Array
from .experiment import Experiment
from .rig import Rig, RunUnknowns

FitMethod: TypeAlias = Literal["collocation", "multiple-shooting", "single-shooting", "simulation"]
METHODS = get_args(FitMethod)


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A plant, records and what is sought: parameters, one delay at most, sensors, and where every
    state begins in each record. known_delay : [s], where the delay is no unknown. process :
    positions of states that are disturbed, and the intensities [unit/sqrt(s)].
    """

    plant: Plant
    experiments: Sequence[Experiment]
    measured: Sequence[str]
    unknowns: RunUnknowns
    known_delay: float
    process: Sequence[tuple[int, float]]

    def delay(self, head: Array) -> float:
        """At these values of the unknowns [s]."""
        u = self.unknowns
        late = [float(head[j] * u.scale[j]) for j, _ in u.of("delays")]
        return late[0] if late else self.known_delay

    @property
    def nominal(self) -> Array:
        """Of what is measured."""
        return np.array([self.plant.variable(n).nominal for n in self.measured])


@dataclass(frozen=True, eq=False)
class FitProgram:
    """min |W residuals|^2 subject to ``defects`` = 0, in scaled unknowns w = (head, states, jumps).

    head : the unknowns of the problem.
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

    @cached_property
    def _values(self) -> ca.Function:
        return ca.Function("residuals", [self.w, self.weights], [self.residuals])

    def errors(self, w: Array) -> tuple[Array, Array]:
        """Measured less modelled (K, ny), in nominals and without weights; and the jumps."""
        weights = np.ones(self.weights.numel())
        value = np.asarray(native(self._values, w, weights)).ravel()
        measured, jumps = np.split(value, [value.size - self.jumps])
        return measured.reshape(-1, weights.size), jumps

    def jacobian(self, weights: Array, w: Array, base: Array | None = None) -> Array:
        """d(weighted residuals)/d(head), along solutions of defects(head, states) = 0: d(states) =
        -(d defects/d states)^-1 (d defects/d head) d(head). The rest of the covariance is that of
        least squares in the head alone. Jumps of disturbed states are unknown too: their columns
        are projected out of the head's.
        """
        from scipy.sparse.linalg import splu

        r, g = (block.sparse() for block in native(self.derivatives, w, weights))
        inner = slice(self.head, w.size - self.jumps)
        own = np.r_[: self.head, inner.stop : w.size]
        direct = np.asarray(r[:, own].todense())
        if g.shape[0] == 0:
            return direct
        try:
            states = splu(g[:, inner]).solve(np.asarray(g[:, own].todense()))
        except RuntimeError:
            raise FitError(
                "the plant's equations do not determine its states along a record: one of them is "
                "singular at the solution"
            ) from None
        every = np.asarray(direct - r[:, inner] @ states)
        if not self.jumps:
            return every
        basis = np.linalg.qr(every[:, self.head :])[0]
        rest = every[:, : self.head]
        return np.asarray(rest - basis @ (basis.T @ rest))


@dataclass(frozen=True, eq=False)
class _Mesh:
    """All intervals of all records side by side."""

    h: Array
    u: Array  # (nu (degree + 1), n)
    begin: Array  # column in (initial states, ends of intervals) where each interval begins
    measured: Array  # (ny, K)
    interval: Array  # of each sample
    offset: Array  # (K,) time since the interval's begin at zero delay


def transcribe(problem: FitProblem, method: FitMethod, degree: int) -> FitProgram:
    """State the program for a method; ``degree`` is that of the collocation, or steps of RK4."""
    u, experiments, nominal = problem.unknowns, problem.experiments, problem.nominal
    mesh = _mesh(experiments, problem.delay(u.guess))
    x_nominal = problem.plant.vector("state", attribute="nominal")
    head = ca.MX.sym("head", len(u.names))
    lift = _jumps(mesh, len(experiments), problem.process, x_nominal)
    errors = _input_errors(experiments, mesh)
    jumps = ca.MX.sym("jumps", lift.shape[1] + errors.shape[1])
    inputs = ca.MX(ca.DM(mesh.u))
    if errors.shape[1]:
        inputs += ca.reshape(errors @ jumps[lift.shape[1] :], *mesh.u.shape)
    x0 = ca.reshape(head[u.shared :], len(x_nominal), len(experiments))
    p = u.vector(problem.plant, head)
    inside, step, read = _interval(problem, mesh, method, degree)
    points, ends, defects = ca.MX(0, mesh.h.size), ca.MX(), ca.MX(0, 1)
    if method == "single-shooting":
        ends = _rolled(step, experiments, x0, mesh, (inputs, p))
    else:
        points = ca.MX.sym("x", len(x_nominal) * inside, mesh.h.size)
        ends = points[len(x_nominal) * (inside - 1) :, :]
    begins = ca.horzcat(x0, ends)[:, mesh.begin.tolist()]
    if problem.process:
        begins += ca.reshape(lift @ jumps[: lift.shape[1]], *begins.shape)
    if method != "single-shooting":
        defects = ca.vec(step.map(mesh.h.size)(begins, points, mesh.h[None], inputs, p))

    rows = mesh.interval.tolist()
    late: Any = problem.known_delay
    for place, _ in u.of("delays"):
        late = head[place] * u.scale[place]
    since, spans = mesh.offset[None] - late, mesh.h[rows][None]
    held = points[:, rows] if method == "collocation" else ca.MX(0, len(rows))
    modelled = read.map(len(rows))(begins[:, rows], held, since, spans, inputs[:, rows], p)
    gains, offsets = (ca.vertcat(*c) for c in u.sensors(problem.measured, Rig(), head))
    errors_ = ca.MX(ca.DM(mesh.measured / nominal[:, None])) - modelled * gains - offsets / nominal
    weights = ca.MX.sym("weights", len(nominal))
    residuals = ca.vertcat(ca.vec(errors_ * ca.repmat(weights, 1, len(rows))), jumps)
    inner = _points(experiments, method, degree, x_nominal)
    open_ = np.full(inner.size + jumps.numel(), np.inf)
    return FitProgram(
        ca.veccat(head, points, jumps),
        weights,
        residuals,
        defects,
        head.numel(),
        u.scale,
        np.concatenate([u.guess, inner, np.zeros(jumps.numel())]),
        np.concatenate([u.low, -open_]),
        np.concatenate([u.high, open_]),
        jumps.numel(),
    )


def _jumps(
    mesh: _Mesh, records: int, process: Sequence[tuple[int, float]], x_nominal: Array
) -> ca.DM:
    """Matrix from jumps (in standard deviations) to the begins of all intervals (nominals). White
    noise of intensity q adds the variance q^2 h in an interval of length h. Each record's first
    begin has none.
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
    """Matrix from errors of measured inputs (in standard deviations) to all coefficients."""
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


def _interval(
    problem: FitProblem, mesh: _Mesh, method: FitMethod, degree: int
) -> tuple[int, ca.Function, ca.Function]:
    """How many points lie in an interval, the last at its end; (begin, points, length, inputs,
    parameters) -> their defects; and (begin, points, time since the begin, length, inputs,
    parameters) -> what is measured, in nominals. States are in nominals, too.

    Collocation: of Lagrange polynomials. Shooting: one point, compared with ``degree`` steps of
    RK4, which need no points to tell what is measured.
    """
    plant = problem.plant
    x_nominal = plant.vector("state", attribute="nominal")
    nx, nu = len(x_nominal), len(plant.inputs)
    inside = degree if method == "collocation" else 1
    begin, points = ca.SX.sym("begin", nx), ca.SX.sym("points", nx, inside)
    h, since = ca.SX.sym("h"), ca.SX.sym("since")
    u, p = ca.SX.sym("u", nu, mesh.u.shape[0] // max(nu, 1)), ca.SX.sym("p", len(plant.parameters))

    def slope(x: ca.SX, at: Any) -> ca.SX:
        """Rates of the states; ``at`` : time since the begin."""
        now = ca.SX(polynomial(ca.horzsplit(u), at))
        return plant.function(x * x_nominal, now, p)[0] / x_nominal

    def rolled(span: ca.SX) -> ca.SX:
        return rk4(lambda x, at: slope(x, at * span / degree), begin, span / degree, degree)

    if method == "collocation":
        tau = collocation_points("radau", degree)
        gained = ca.horzcat(begin, points) @ ca.DM(collocation_matrices(tau)[0])
        parts = [h * slope(points[:, j], h * tau[j]) - gained[:, j] for j in range(degree)]
        basis = lagrange((0.0, *tau.tolist()), since / h)
        x, known = ca.horzcat(begin, points) @ ca.vertcat(*basis), ca.vec(points)
    else:
        parts, x, known = [rolled(h) - points], rolled(since), ca.SX(0, 1)
    now = ca.SX(polynomial(ca.horzsplit(u), since))
    values = [plant.expression(n) / plant.variable(n).nominal for n in problem.measured]
    outputs = ca.Function("measured", [plant.x, plant.u, plant.p], [ca.vertcat(*values)])
    given = [h, ca.vec(u), p]
    return (
        inside,
        ca.Function("defects", [begin, ca.vec(points), *given], [ca.vertcat(*parts)]),
        ca.Function("read", [begin, known, since, *given], [outputs(x * x_nominal, now, p)]),
    )


def _rolled(
    step: ca.Function,
    experiments: Sequence[Experiment],
    x0: ca.MX,
    mesh: _Mesh,
    given: tuple[ca.MX, ca.MX],
) -> ca.MX:
    """The states at all ends of intervals, each record integrated from its initial state: there
    defects from points at zero are the states themselves.
    """
    u, p = given
    first, parts = 0, []
    for r, e in enumerate(experiments):
        n = len(e.mesh) - 1
        span = slice(first, first + n)
        still, every = ca.DM.zeros(x0.shape[0], n), ca.repmat(p, 1, n)
        parts.append(step.mapaccum(n)(x0[:, r], still, mesh.h[span][None], u[:, span], every))
        first += n
    return ca.horzcat(*parts)


def _points(
    experiments: Sequence[Experiment], method: FitMethod, degree: int, x_nominal: Array
) -> Array:
    """Guesses of the states inside and at the ends of intervals, in nominals."""
    if method == "single-shooting":
        return np.empty(0)
    tau = collocation_points("radau", degree) if method == "collocation" else np.ones(1)
    states = []
    for e in experiments:
        times = (e.mesh[:-1, None] + np.diff(e.mesh)[:, None] * tau).ravel()
        columns = [np.interp(times, e.mesh, e.states[:, i]) for i in range(len(x_nominal))]
        states.append((np.stack(columns, 1) / x_nominal).ravel())
    return np.concatenate(states)


RTOL = 1e-8
STEP = 1e-4
"""Of differences, in the unknowns' own sizes: the runs' error is some 1e-4 of what it moves."""
DIVERGED = 1e3
"""Residual, in nominals, of a motion that cannot be simulated."""


class SimulatedProgram:
    """As :class:`FitProgram`, by simulations, with nothing unknown but the head."""

    jumps = 0

    def __init__(self, problem: FitProblem) -> None:
        self._problem, u = problem, problem.unknowns
        self.guess, self.low, self.high, self.head_scale = u.guess, u.low, u.high, u.scale
        self.head = self.guess.size
        try:  # hundreds of runs: compiling takes as long as some tens of them
            self._compiled = Integration.built(problem.plant) is not None
        except InputError:  # no compiler here
            self._compiled = False

    def errors(self, w: Array) -> tuple[Array, Array]:
        """As those of :class:`FitProgram`; there are no jumps."""
        problem = self._problem
        plant, u, names = problem.plant, problem.unknowns, problem.measured
        rig, late = u.rig(plant, names, Rig(), w), problem.delay(w)
        values = u.parameters(plant, w)
        parts = []
        for e, start in zip(problem.experiments, u.begins(plant, w), strict=True):
            try:
                modelled = sensed(plant, e, start, late, names, rig, values, self._compiled)
                parts.append((e.measured - modelled) / problem.nominal)
            except PamError:
                parts.append(np.full(e.measured.shape, DIVERGED))
        return np.concatenate(parts), np.empty(0)

    def jacobian(self, weights: Array, w: Array, base: Array | None = None) -> Array:
        """By central differences, one-sided at bounds, and from ``base``, known errors at w."""
        columns = []
        for i in range(w.size):
            size = STEP * max(1.0, abs(w[i]))
            ends = np.clip([w[i] - size, w[i] + size], self.low[i], self.high[i])
            if base is not None:  # to the side where there is room
                ends[int(ends[1] - w[i] < w[i] - ends[0])] = w[i]
                ends = np.sort(ends)
            moved = [np.where(np.arange(w.size) == i, end, w) for end in ends]
            below, above = (
                self.errors(z)[0] if base is None or end != w[i] else base
                for z, end in zip(moved, ends, strict=True)
            )
            width = ends[1] - ends[0]
            columns.append(((above - below) * weights).ravel() / (width or 1.0))
        return np.stack(columns, axis=1)


Program: TypeAlias = FitProgram | SimulatedProgram


def sensed(
    plant: Plant,
    experiment: Experiment,
    start: Mapping[str, float],
    delay: float,
    names: Sequence[str],
    rig: Rig,
    parameters: Mapping[str, float] | None = None,
    compiled: bool = False,
) -> Array:
    """The plant under the measured inputs (K, ny), as its sensors would have shown it."""
    times = experiment.t - delay
    times[0] = max(times[0], experiment.mesh[0])
    grid = times
    if times[0] > experiment.mesh[0]:
        grid = np.concatenate([experiment.mesh[:1], times])
    inputs = PiecewisePolynomial(experiment.mesh, experiment.coefficients)
    given = dict(parameters or {})
    run = simulate(
        plant, inputs, t=grid, start=start, parameters=given, rtol=RTOL, compiled=compiled
    )
    gains = np.array([rig.gains.get(n, 1.0) for n in names])
    offsets = np.array([rig.offsets.get(n, 0.0) for n in names])
    return np.asarray(run.array(names)[len(grid) - len(times) :] * gains + offsets)
