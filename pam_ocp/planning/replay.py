"""What a tight integrator says of a planned motion, on the whole and for each interval."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import SimulationError
from ..core.signals import signals
from ..core.trajectory import Trajectory
from ..numerics.elementwise import Columns
from ..plants.plant import Plant
from ..simulation.integrate import Integration, evaluated
from ..simulation.simulator import simulate
from .problem.problem import Budget, Condition, Leg, Problem
from .transcription.mesh import Mesh
from .transcription.solution import Solution, pack
from .transcription.stage import nominals
from .transcription.transcription import Program

Array: TypeAlias = NDArray[np.float64]

KEPT = 8
"""Expressions that are kept ready for a plant at a time."""


class PlantColumns:
    """A plant's rates and outputs at many points."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def _of(self, which: int) -> Columns:
        plant = self._plant

        def build() -> Columns:
            arguments = [plant.x, plant.u, plant.p]
            return Columns(arguments, plant.function(*arguments)[which])

        found: Columns = plant.cached(("columns", which), build)
        return found

    def rates(self, x: Array, u: Array, p: Array) -> Array:
        """(nx, n) x' [SI] at states (nx, n), inputs (nu, n) and parameters (np,)."""
        return self._of(0)(x, u, p)

    def outputs(self, x: Array, u: Array, p: Array) -> Array:
        """(n, ny) outputs at states (n, nx), inputs (n, nu) and parameters (np,)."""
        y: Array = self._of(1)(x.T, u.T, p).T
        return y


def moved(plant: Plant, samples: Trajectory, times: Array, rtol: float) -> Trajectory:
    """The motion from the first of the samples under their inputs, at ``times``.

    Raises SimulationError as :func:`simulate`, of which this is the default way.
    """
    u = signals(plant, samples, times, "previous")
    # a solver may leave the range by rounding; start values are held to it elsewhere
    start = {v.name: float(np.clip(samples[v.name][0], v.min, v.max)) for v in plant.states}
    run = Integration.over(plant, u, times, plant.vector("state", start), rtol=rtol)
    states = run()
    if states is None:
        return simulate(plant, samples, t=times, rtol=rtol)  # which says how far it came
    return evaluated(plant, times, run.at(times, states), u, machine=PlantColumns(plant))


def values_along(
    problem: Problem, plant: Plant, expressions: Sequence[ca.SX], arguments: tuple[Array, ...]
) -> Array:
    """(expressions, n) values at (x, u, p, t, r, q, m), the arguments of a Problem's functions."""
    symbols = [plant.x, plant.u, plant.p, *problem.given]
    kept: OrderedDict[tuple[int, ...], Columns] = plant.cached(("columns along",), OrderedDict)
    column = ca.densify(ca.vertcat(ca.SX(0, 1), *expressions))
    every = (*ca.vertsplit(column), *(e for s in problem.given for e in ca.vertsplit(s)))
    key = tuple(e.element_hash() for e in every)
    if key not in kept:
        kept[key] = Columns(symbols, column)
        while len(kept) > KEPT:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key](*arguments)


TOLERANCE = 1e-11
"""Relative tolerance of the integrator that replays a plan, at its tightest."""
PART, WIDEST = 1e-5, 1e-8
"""Of a plan's tolerance; and the same at its widest."""
OVERSAMPLING = 8
"""Integrated times between two points of a plan."""
BY_SHOOTING = 32
"""The same where an interval has no point inside."""
FINER = {"polynomial": 10}
"""Parts of each of these that are looked at, by how the inputs run (even numbers). Others than the
checks that the mesh itself makes there: those hold what they see.
"""
USUALLY = 2


@dataclass(frozen=True)
class Replay:
    """What an independent tight integration of the planned inputs says."""

    error: float
    """Largest deviation of a state from the plan at its samples, in units of nominal."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation of a bound or path constraint (between the samples too, and on both sides
    of jumps of the inputs), of a condition at a stop, of the closing of a cycle, or of a budget, in
    units of nominal.
    """
    constraint: str
    """What is violated most ("" when nothing is)."""
    trajectory: Trajectory = field(repr=False)
    objective: float = float("nan")
    """Of the replayed motion."""
    beyond: tuple[dict[str, float], ...] = field(default=(), repr=False)
    """For each interval of the mesh {bound or path condition: by how much it is exceeded}."""
    missed: float = 0.0
    """Largest violation of what is no bound: at the stops, of the closing, of a budget."""
    local: float = float("nan")
    """Sum of the :func:`interval_errors`, where somebody asked for it."""
    at_points: float = 0.0
    """Largest violation of a limit at the points of the mesh, where the plan itself keeps it."""


def chosen_plant(problem: Problem, solution: Solution) -> Plant:
    """The problem's plant with the values that a solution chose for its design."""
    chosen = dict(zip(problem.design, map(float, solution.design), strict=True))
    return problem.plant.with_values(
        {n: float(np.clip(v, *problem.design[n])) for n, v in chosen.items()}
    )


def accuracy(tolerance: float) -> float:
    """Of integrations [relative] that tell whether a motion meets a tolerance: far tighter, and not
    more (a method of fifth order takes four times the steps for three decades).
    """
    return float(np.clip(PART * tolerance, TOLERANCE, WIDEST))


def interval_states(
    plant: Plant, mesh: Mesh, solution: Solution, rtol: float = TOLERANCE
) -> list[Array]:
    """For each interval: the states at its points by an integration from its planned start; no
    numbers where that ends before.
    """
    run = Integration(plant, solution.inputs, solution.inputs.breaks, solution.states[0], rtol=rtol)
    degrees = np.array([interval.degree for interval in mesh.intervals])
    counts = np.array([len(mesh.form.state_taus(d)) for d in degrees.tolist()])
    starts = solution.states[np.cumsum(counts) - counts]
    found = [np.full((n, starts.shape[1]), np.nan) for n in counts.tolist()]

    def integrate(pieces: NDArray[np.intp]) -> None:
        taus = tuple(mesh.form.state_taus(int(degrees[pieces[0]])).tolist())
        try:
            for k, own in zip(pieces, run.apart(pieces, starts[pieces], taus), strict=True):
                found[k] = own
        except RuntimeError:  # one of them
            if len(pieces) > 1:
                integrate(pieces[: len(pieces) // 2])
                integrate(pieces[len(pieces) // 2 :])

    for degree in np.unique(degrees):
        integrate(np.flatnonzero(degrees == degree))
    return found


def interval_errors(plant: Plant, solution: Solution, found: Sequence[Array]) -> list[float]:
    """For each interval: how far its :func:`interval_states` leave its planned points; infinite
    where they are no numbers.
    """
    nominal = plant.vector("state", attribute="nominal")
    missed = np.abs(np.concatenate(found) - solution.states[1:]) / nominal
    firsts = np.cumsum([0, *(len(own) for own in found[:-1])])
    worst = np.maximum.reduceat(missed.max(axis=1), firsts)  # NaN is passed on
    return [float(e) for e in np.where(np.isfinite(worst), worst, np.inf)]


def explained(
    replay: Replay, plant: Plant, mesh: Mesh, solution: Solution, tolerance: float
) -> Replay:
    """A replay that deviates by more than a tolerance, with what its intervals deviate by."""
    if replay.error <= tolerance or not np.isfinite(replay.error):
        return replay
    found = interval_states(plant, mesh, solution)
    return replace(replay, local=sum(interval_errors(plant, solution, found)))


def replayed(
    problem: Problem,
    plant: Plant,
    mesh: Mesh,
    samples: Trajectory,
    solution: Solution,
    rtol: float = TOLERANCE,
) -> Replay:
    """Integrate the planned inputs tightly, and look at all that was asked for, between the samples
    too.
    """
    per = BY_SHOOTING if mesh.form.scheme == "shooting" else OVERSAMPLING
    fine = np.linspace(samples.t[:-1], samples.t[1:], per, endpoint=False).T.ravel()
    fine = np.append(fine, samples.t[-1])
    try:
        motion = moved(plant, samples, fine, rtol)
    except SimulationError as error:
        part = error.trajectory or samples
        stopped, inf = f"the replay stops at t = {error.time:g} s", float("inf")
        return Replay(inf, stopped, inf, "everything behind", part)
    names = samples.named("state")
    nominal = plant.vector("state", attribute="nominal")
    deviation = np.abs(motion.array(names)[::per] - samples.array(names)) / nominal
    worst = names[int(np.argmax(deviation.max(axis=0)))]
    check = Check(problem, plant, mesh, solution, motion.t, motion.array(names).T, per)
    beyond, at_points = check.along()
    others = {**check.at_stops(), **check.closing(), **check.budgets()}
    every = [*(pair for each in beyond for pair in each.items()), *others.items()]
    label, violation = max(every, key=lambda pair: pair[1], default=("", 0.0))
    return Replay(
        float(deviation.max()),
        worst,
        violation,
        label,
        motion,
        check.objective(),
        beyond,
        max(others.values(), default=0.0),
        at_points=at_points,
    )


@dataclass(frozen=True)
class Check:
    """All that was asked for, looked at along a motion.

    Each interval is looked at from its start to its end with its own inputs, so a jump of the
    inputs is seen from both sides.

    t, x : (n,) and (nx, n) the motion, ``per`` times from one sample to the next. looks : parts of
    each gap between these that are looked at; 0: as many as the kind of inputs needs.
    """

    problem: Problem
    plant: Plant
    mesh: Mesh
    solution: Solution
    t: Array
    x: Array
    per: int
    looks: int = 0

    @cached_property
    def _interval(self) -> NDArray[np.intp]:
        """(gaps,) the interval in which each gap between two neighbouring times lies."""
        form = self.mesh.form
        counts = [self.per * len(form.state_taus(i.degree)) for i in self.mesh.intervals]
        return np.repeat(np.arange(len(counts)), counts)

    @cached_property
    def _last(self) -> NDArray[np.bool_]:
        """(gaps,) whether a gap is the last of its interval."""
        return np.append(np.diff(self._interval) > 0, True)

    @cached_property
    def _gaps(self) -> tuple[Array, Array, Array]:
        """Times (gaps, places), states (nx, gaps, places) and inputs (nu, gaps, places): each gap
        from its start to its end, the states by cubic Hermite polynomials.
        """
        finer = self.looks or FINER.get(self.mesh.form.control, USUALLY)
        s = np.linspace(0.0, 1.0, finer + 1)
        h = np.diff(self.t)[:, None]
        t = self.t[:-1, None] + h * s
        inputs, k = self.solution.inputs, self._interval
        since = (t - inputs.breaks[k][:, None])[..., None] ** np.arange(inputs.degree + 1)
        u = np.einsum("gsj,gji->igs", since, inputs.coefficients[k])
        ends = np.concatenate([self.x[:, :-1], self.x[:, 1:]], axis=1)
        driven = np.concatenate([u[..., 0], u[..., -1]], axis=1)
        gaps = len(h)
        own = np.append(np.ones(gaps, bool), self._last)  # a gap's end is the next one's start
        p = self.plant.vector("parameter")
        known = PlantColumns(self.plant).rates(ends[:, own], driven[:, own], p)
        slopes = np.empty_like(ends)
        slopes[:, own] = known
        inside = np.flatnonzero(~self._last)
        slopes[:, gaps + inside] = slopes[:, inside + 1]
        left, right = (side[..., None] for side in np.split(ends, 2, axis=1))
        rising, falling = (h * side[..., None] for side in np.split(slopes, 2, axis=1))
        x = (
            left * ((1 + 2 * s) * (1 - s) ** 2)
            + rising * (s * (1 - s) ** 2)
            + right * (s**2 * (3 - 2 * s))
            + falling * (s**2 * (s - 1))
        )
        return t, x, u

    def _arguments(self, t: Array, x: Array, u: Array) -> tuple[Array, ...]:
        """Of a Problem's function, at columns of times, states and inputs."""
        return self.problem.arguments(self.plant, t, x, u, self.solution.peaks)

    def _values(self, expressions: Sequence[ca.SX], t: Array, x: Array, u: Array) -> Array:
        """Of expressions at columns of times, states and inputs."""
        return values_along(self.problem, self.plant, expressions, self._arguments(t, x, u))

    @cached_property
    def _points(self) -> NDArray[np.bool_]:
        """(gaps, places) what is a point of the mesh where its interval holds limits."""
        found = np.zeros(self._gaps[0].shape, bool)
        found[:: self.per, 0] = True
        found[np.append(True, self._last[:-1]), 0] = False  # the start of an interval
        found[self._last, -1] = True
        return found

    def _legs(
        self,
    ) -> Iterator[tuple[Leg, NDArray[np.bool_], NDArray[np.intp], Array, Array, Array]]:
        """(leg, whether each place is a point, its interval, times, states, inputs)."""
        t, x, u = self._gaps
        of_leg = np.array([interval.leg for interval in self.mesh.intervals])[self._interval]
        once = np.ones(t.shape, bool)
        once[~self._last, -1] = False  # the next gap's start
        for i, leg in enumerate(self.problem.legs):
            own = once & (of_leg == i)[:, None]
            if own.any():
                of = np.broadcast_to(self._interval[:, None], t.shape)
                yield leg, self._points[own], of[own], t[own], x[:, own], u[:, own]

    def along(self) -> tuple[tuple[dict[str, float], ...], float]:
        """(for each interval {bound or path condition: by how much it is exceeded} in nominals, the
        most of that at the mesh's points).
        """
        found: list[dict[str, float]] = [{} for _ in self.mesh.intervals]
        most = 0.0
        for leg, at, of, t, x, u in self._legs():
            variables = (*self.plant.states, *self.plant.inputs)
            labels = [v.name for v in variables] + [c.label for c in leg.path]
            scale = np.array([v.nominal for v in variables])[:, None]
            values = np.vstack([x, u]) / scale
            pairs = [(np.array(leg.bounds[v.name]) / v.nominal) for v in variables]
            pairs += [np.array([c.low, c.high]) / c.nominal for c in leg.path]
            if leg.path:
                nominal = np.array([c.nominal for c in leg.path])[:, None]
                path = self._values([c.expression for c in leg.path], t, x, u)
                values = np.vstack([values, path / nominal])
            low, high = (np.array(side)[:, None] for side in zip(*pairs, strict=True))
            excesses = _excess(values, low, high)
            driven = slice(len(self.plant.states), len(variables))  # inputs are as planned
            most = max(most, float(np.delete(excesses, driven, 0)[:, at].max(initial=0.0)))
            first = np.flatnonzero(np.diff(of, prepend=-1))  # of each interval
            worsts = np.maximum.reduceat(excesses, first, axis=1)
            for row, place in np.argwhere(worsts > 0):
                label, k, worst = labels[row], of[first[place]], float(worsts[row, place])
                # two conditions may bear one name
                found[k][label] = max(worst, found[k].get(label, 0.0))
        return tuple(found), most

    def _node(self, i: int) -> tuple[Array, ...]:
        """Arguments at a node: at the start of the interval behind it,
        or at the end of the motion.
        """
        first, last = self.mesh.first(i), len(self.mesh.intervals)
        t, x, u = self._gaps
        last_gap, end = len(t) - 1, t.shape[1] - 1
        gap, place = (last_gap, end) if first == last else (self._interval.searchsorted(first), 0)
        one = slice(gap, gap + 1)
        return self._arguments(t[one, place], x[:, one, place], u[:, one, place])

    def at_stops(self) -> dict[str, float]:
        """{condition at a stop: by how much it is missed} in nominals."""
        found: dict[str, float] = {}
        for i, conditions in enumerate(self.problem.nodes):
            if conditions:
                function = self.problem.conditions("stop", conditions)
                values = np.asarray(function(*self._node(i)), float).ravel()
                for label, by in _missed(conditions, values).items():
                    # a dwell has two nodes, whose conditions bear the same names
                    found[label] = max(by, found.get(label, 0.0))
        return found

    def closing(self) -> dict[str, float]:
        """{"closing of the cycle: state": by how much the cycle is open} in nominals."""
        names = [v.name for v in self.plant.states]
        nominal = nominals(self.problem)[0]
        found = {}
        for name, (sign, image) in (self.problem.closing or {}).items():
            i = names.index(name)
            gap = self.x[i, -1] - sign * self.x[names.index(image), 0]
            found[f"closing of the cycle: {name}"] = _finite(abs(gap) / nominal[i])
        return found

    def _integral(self, expressions: Sequence[ca.SX]) -> Array:
        """Of expressions over the whole motion, by Simpson's rule on each gap."""
        t, x, u = self._gaps
        columns = (part.reshape(len(part), -1) for part in (x, u))
        values = self._values(self.problem.explicit(expressions), t.ravel(), *columns)
        places = t.shape[1]
        simpson = np.where(np.arange(places) % 2, 4.0, 2.0)
        simpson[[0, -1]] = 1.0
        weights = np.diff(self.t)[:, None] * simpson / (3 * (places - 1))
        return np.asarray(values @ weights.ravel())

    def budgets(self) -> dict[str, float]:
        """{budget: by how much it is missed} in nominals."""
        budgets = self.problem.budgets
        if not budgets:
            return {}
        spent = self._integral([b.integrand / b.nominal for b in budgets])
        return _missed(budgets, spent)

    def objective(self) -> float:
        """Of the motion; the rate of the inputs and peaks as planned."""
        goal, total = self.problem.objective, 0.0
        total += goal.time * float(sum(self.solution.durations))
        if not goal.integrand.is_zero():
            total += float(self._integral([goal.integrand])[0])
        if not goal.final.is_zero():
            last = self._node(len(self.problem.legs))
            total += float(self.problem.function("final", [goal.final])(*last))
        total += float(np.dot(goal.peaks, self.solution.peaks)) if goal.peaks else 0.0
        return total + goal.rate * self._rate() if goal.rate else total

    def _rate(self) -> float:
        """Integral of the squared rate of the inputs in nominals; of held ones,
        that of the joined.
        """
        inputs, u_nominal = self.solution.inputs, nominals(self.problem)[1]
        h = np.diff(inputs.breaks)
        c = inputs.coefficients / u_nominal
        if self.mesh.form.control == "constant":
            first = self.mesh.held()
            h = np.add.reduceat(h, first)
            jumps = np.sum(np.diff(c[first, 0], axis=0) ** 2, axis=1)
            return float(np.sum(jumps / ((h[:-1] + h[1:]) / 2)))
        taus, weights = np.polynomial.legendre.leggauss(inputs.degree + 1)
        total, j = 0.0, np.arange(1, inputs.degree + 1)
        for tau, weight in zip((taus + 1) / 2, weights / 2, strict=True):
            slopes = np.einsum("kj,kji->ki", j * (tau * h)[:, None] ** (j - 1), c[:, 1:])
            total += weight * float(np.sum(h * np.sum(slopes**2, axis=1)))
        return total


def _excess(values: Array, low: Array | float, high: Array | float) -> Array:
    """By how much values are outside; infinite where they are no numbers."""
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    return np.where(np.isnan(beyond), np.inf, beyond)


def _finite(value: float) -> float:
    return float("inf") if np.isnan(value) else float(value)


def _missed(conditions: Sequence[Condition | Budget], values: Array) -> dict[str, float]:
    """{label: by how much a value is outside its limits} of those that are, in nominals."""
    found: dict[str, float] = {}
    for c, value in zip(conditions, values, strict=True):
        by = float(_excess(np.array([value]), c.low / c.nominal, c.high / c.nominal)[0])
        if by > 0:
            found[c.label] = max(by, found.get(c.label, 0.0))
    return found


# ---- defect correction --------------------------------------------------------------------------
# Integrated tightly from its start, an interval leaves a defect in the collocation equations: what
# the mesh does not resolve there. A program that asks for this defect instead of none has the
# integrated motion as its solution (R. Frank, C. W. Ueberhuber, BIT 17 (1977) 146-159). The defect
# hardly changes with the unknowns, so two or three warm re-solves do what a mesh of several times
# the size would: memories have kinks, which no polynomial follows, and meshes resolve them slowly.
# The optimum stays that of the mesh, to its error; the motion is the plant's.


@dataclass(frozen=True)
class Corrected(Program):
    """A program whose collocation equations hold but for what the mesh does not resolve."""

    shift: Array
    """Of the limits of all constraints: zero but for the defects."""

    def exact(self) -> Program:
        """See :class:`Program`: defects of a motion say nothing of another one."""
        return Program(**{f.name: getattr(self, f.name) for f in fields(Program)})

    def limits(self) -> tuple[Array, Array]:
        """(low, high) of all constraints."""
        low, high = super().limits()
        return low + self.shift, high + self.shift


def corrected(program: Program, solution: Solution, exact: Sequence[Array]) -> Corrected | None:
    """The program that a motion would solve if each of its intervals ran as the plant does.

    ``solution`` stands on the program's mesh. exact : of each interval, the states to which an
    integration leads from its start. None where one of these could not be integrated.
    """
    shift = _defects(program, solution, exact)
    return _shifted(program, shift) if np.all(np.isfinite(shift)) else None


def integrated(program: Program, solution: Solution) -> Solution | None:
    """The plant's own motion under the inputs of a solution, at the same points; None where it ends
    before.
    """
    plant = chosen_plant(program.problem, solution)
    ranges = (plant.vector("state", attribute=a) for a in ("min", "max"))
    start = np.clip(solution.states[0], *ranges)
    run = Integration.over(plant, solution.inputs, solution.t, start, rtol=TOLERANCE)
    states = run()
    return None if states is None else replace(solution, states=run.at(solution.t, states))


def left_as(program: Program, solution: Solution) -> Corrected:
    """The program whose collocation equations hold along a motion, whatever that leaves in them."""
    w = program.completed(pack(program.problem, program.mesh, solution))
    function = ca.Function("defects", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    values = np.asarray(function(w, program.parameters()), float).ravel()
    shift = np.zeros(len(values))
    for group in program.groups:
        own = slice(group.first_row, group.first_row + group.rows * len(group.members))
        shift[own] = values[own]
    return _shifted(program, shift)


def _shifted(program: Program, shift: Array) -> Corrected:
    own = {f.name: getattr(program, f.name) for f in fields(Program)}
    return Corrected(**own, shift=shift)


def _defects(program: Program, solution: Solution, exact: Sequence[Array]) -> Array:
    """What an integration of each interval leaves in the constraints."""
    problem, mesh = program.problem, program.mesh
    plant, form = chosen_plant(problem, solution), mesh.form
    x_nominal, u_nominal = nominals(problem)
    states, breaks = solution.states, solution.inputs.breaks
    starts, inputs, at = [], [], 0
    ends = [(own / x_nominal).ravel() for own in exact]
    for k, (interval, length) in enumerate(zip(mesh.intervals, np.diff(breaks), strict=True)):
        starts.append(states[at] / x_nominal)
        since = length * form.input_taus(interval.degree)
        powers = since[:, None] ** np.arange(solution.inputs.degree + 1)
        inputs.append((powers @ solution.inputs.coefficients[k] / u_nominal).ravel())
        at += len(exact[k])
    lengths, parameters = np.diff(breaks), plant.vector("parameter")
    rows = sum(row.size for row in program.rows)
    found = np.zeros(rows)
    for group in program.groups:
        function = group.stage.function.map(len(group.members))

        def of(each: list[Array], members: tuple[int, ...] = group.members) -> Array:
            return np.column_stack([each[k] for k in members])

        # defects know no profiles, aims, peaks and auxiliaries
        unknown = [np.zeros(function.size_in(name)) for name in ("r", "q", "m", "a")]
        defects = function(
            of(starts),
            of(ends),
            of(inputs),
            lengths[list(group.members)][None],
            breaks[list(group.members)][None],
            parameters,
            *unknown,
        )[0]
        size = group.rows * len(group.members)
        found[group.first_row : group.first_row + size] = np.asarray(defects, float).ravel("F")
    return found
