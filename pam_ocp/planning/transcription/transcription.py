"""From a Problem to a nonlinear program: stages mapped along the mesh, nodes, closing, bounds.

All unknowns are in units of the plant's nominals and ordered along the motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...plants.plant import Plant
from ..problem.problem import Budget, Condition, Problem, limits
from .mesh import Interval, Mesh
from .solution import Places, Unknowns
from .stage import Stage, nominals

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]
Symbol = TypeVar("Symbol", ca.SX, ca.MX)


@dataclass(frozen=True)
class Row:
    """What some rows of the NLP's constraints are: for messages, duals and the elastic re-solve."""

    label: str
    kind: Literal["defect", "path", "stop", "closing", "budget"]
    size: int
    conditions: tuple[Condition | Budget, ...] = ()
    """What these rows hold in turn, over and over; empty for rows that are zero."""
    members: tuple[int, ...] = ()
    """The intervals in turn, for "path"."""

    def condition(self, index: int) -> Condition | Budget | None:
        """Of one row."""
        return self.conditions[index % len(self.conditions)] if self.conditions else None

    def where(self, index: int) -> str:
        """Of one row, in words."""
        if not self.members:
            return ""
        return f"in interval {self.member(index) + 1}"

    def member(self, index: int) -> int:
        """The interval that one row belongs to."""
        return self.members[index // (self.size // len(self.members))]

    def soft(self) -> NDArray[np.bool_]:
        """Which rows a user could relax: no dynamics, no closing of a cycle, no auxiliaries."""
        if not self.conditions:
            return np.zeros(self.size, dtype=bool)
        own = [not (isinstance(c, Condition) and c.defining) for c in self.conditions]
        return np.tile(own, self.size // len(own))

    def limits(self) -> tuple[Array, Array]:
        """(low, high) of all rows."""
        if not self.conditions:
            return np.zeros(self.size), np.zeros(self.size)
        low, high = limits(self.conditions)
        repeats = self.size // len(low)
        return np.tile(low, repeats), np.tile(high, repeats)


@dataclass(frozen=True)
class Group:
    """Intervals that share a stage function: where their defects begin, and how many each has."""

    members: tuple[int, ...]
    first_row: int
    rows: int
    stage: Stage


@dataclass(frozen=True)
class Program:
    """The NLP of a Problem on a Mesh, in scaled unknowns w; its parameters are (p, aims)."""

    problem: Problem
    mesh: Mesh
    nlp: dict[str, ca.MX]
    rows: tuple[Row, ...]
    groups: tuple[Group, ...]
    other: dict[str, ca.MX]
    """The part of "f", and the rows of "g" behind the groups', that no stage gives (no budgets)."""
    completing: ca.Function | None
    """(w, p) -> the auxiliary unknowns' values; None where there are none."""
    auxiliary: Index
    """Where these stand among the unknowns."""

    def placed(self) -> Iterator[tuple[Row, slice]]:
        """The rows, and where each stands among all constraints."""
        at = 0
        for row in self.rows:
            yield row, slice(at, at + row.size)
            at += row.size

    def exact(self) -> Program:
        """The program whose equations hold as they stand."""
        return self

    def limits(self) -> tuple[Array, Array]:
        """(low, high) of all constraints."""
        both = [row.limits() for row in self.rows]
        return np.concatenate([b[0] for b in both]), np.concatenate([b[1] for b in both])

    def bounds(self) -> tuple[Array, Array]:
        """(low, high) of all unknowns."""
        return _bounds(self.problem, self.mesh)

    def parameters(self) -> Array:
        """Values of the NLP's parameters."""
        return np.concatenate([self.problem.plant.vector("parameter"), self.problem.aims])

    def completed(self, w: Array) -> Array:
        """The unknowns, those that are auxiliary at their values."""
        if self.completing is None:
            return w
        full = np.array(w, float)
        values = np.asarray(self.completing(full, self.parameters()), float).ravel()
        full[self.auxiliary] = np.where(np.isfinite(values), values, 0.0)
        return full


@dataclass(frozen=True)
class _Clock:
    """Times of the mesh as expressions: lengths and starts of intervals, and the end [s]."""

    lengths: list[ca.MX]
    starts: list[ca.MX]
    end: ca.MX

    @classmethod
    def of(cls, mesh: Mesh, durations: ca.MX) -> _Clock:
        """From the durations of the legs [s]."""
        lengths, starts = (
            ca.MX(ca.sparsify(ca.DM(w))) for w in mesh.clock(np.ones(durations.numel()))
        )
        *begins, end = ca.vertsplit(starts @ durations)
        return cls(ca.vertsplit(lengths @ durations), begins, end)


def transcribe(problem: Problem, mesh: Mesh) -> Program:
    """State the NLP: defects, path conditions, stops, closing, budgets, objective."""
    plant = problem.plant
    z = Unknowns.of(problem, mesh)
    p, q = ca.MX.sym("p", len(plant.parameters)), ca.MX.sym("q", problem.q.numel())
    chosen = with_design(problem, p, z.design)
    durations = z.durations * problem.time_nominals
    clock = _Clock.of(mesh, durations)
    made = _stages(problem, mesh, z, clock, (chosen, q))
    beside = [*_nodes(problem, mesh, z, clock, (chosen, q)), *_continuity(problem, mesh, z)]
    rest = [*beside, *_budgets(problem, made.budgets)]
    other = {
        "f": ca.MX(_other_costs(problem, mesh, z, clock, (chosen, q))),
        "g": ca.MX(ca.veccat(*(piece for piece, _ in beside))),
    }
    nlp = {
        "x": z.w,
        "p": ca.vertcat(p, q),
        "f": made.cost + other["f"],
        "g": ca.veccat(*made.constraints, *(piece for piece, _ in rest)),
    }
    rows = (*made.rows, *(row for _, row in rest))
    completing = None
    if problem.auxiliaries:
        completing = ca.Function("completing", [z.w, nlp["p"]], [ca.veccat(*made.completed)])
    auxiliary = _auxiliary(problem, mesh)
    return Program(problem, mesh, nlp, rows, tuple(made.groups), other, completing, auxiliary)


class _Later(Program):
    """A program that is stated when somebody asks for more than its problem and its mesh."""

    def __init__(self, problem: Problem, mesh: Mesh) -> None:
        self.__dict__.update(problem=problem, mesh=mesh)

    def __getattr__(self, name: str) -> object:
        if name.startswith("__") or "mesh" not in self.__dict__:
            raise AttributeError(name)
        self.__dict__.update(transcribe(self.problem, self.mesh).__dict__)
        return self.__dict__[name]


def later(problem: Problem, mesh: Mesh) -> Program:
    """The program of :func:`transcribe`, made at its first use: a motion that came from another
    program needs its own for multipliers only.
    """
    return _Later(problem, mesh)


def _auxiliary(problem: Problem, mesh: Mesh) -> Index:
    """Where the auxiliary unknowns stand among all."""
    places = Places.of(problem, mesh)
    each = np.arange(places.count)
    return np.concatenate([each[places.auxiliaries(k)] for k in range(len(mesh.intervals))])


def with_design(problem: Problem, p: Symbol, design: Symbol) -> Symbol:
    """All parameters of the plant, those to be designed taken from the unknowns [SI]."""
    if not problem.design:
        return p
    names = [v.name for v in problem.plant.parameters]
    entries = ca.vertsplit(p)
    for i, name in enumerate(problem.design):
        entries[names.index(name)] = design[i] * problem.design_nominals[i]
    return ca.vertcat(*entries)


@dataclass
class _Made:
    """What the stages give."""

    constraints: list[ca.MX]
    rows: list[Row]
    groups: list[Group]
    cost: ca.MX
    budgets: ca.MX
    completed: list[ca.MX]
    """Values of the auxiliaries, interval by interval."""


def _stages(
    problem: Problem, mesh: Mesh, z: Unknowns, clock: _Clock, given: tuple[ca.MX, ca.MX]
) -> _Made:
    """Defects and path conditions of all intervals, mapped over those that are alike."""
    made = _Made([], [], [], ca.MX(0), ca.MX(len(problem.budgets), 1), [])
    completed: dict[int, ca.MX] = {}
    profiles = [profile.function() for profile in problem.profiles]
    at = 0
    for stage, members in _alike(problem, mesh):
        mapped = stage.function.map(len(members))
        taus = stage.profile_taus
        h, t = (ca.horzcat(*(each[k] for k in members)) for each in (clock.lengths, clock.starts))
        *own, auxiliaries = z.columns(members)
        profiled = sampled(profiles, h, t, taus)
        arguments = [*own, h, t, given[0], profiled, given[1], z.peaks]
        defects, path, cost, budgets = mapped(*arguments, auxiliaries)
        if problem.auxiliaries:
            values = stage.completing.map(len(members))(*arguments)
            completed |= {k: values[:, j] for j, k in enumerate(members)}
        made.constraints.append(defects)
        made.rows.append(Row("dynamics", "defect", defects.numel()))
        made.groups.append(Group(tuple(members), at, defects.shape[0], stage))
        if path.numel():
            made.constraints.append(path)
            conditions = stage.conditions()
            if stage.watched:
                margins = (dict(mesh.intervals[k].watched) for k in members)
                conditions = tuple(c for each in margins for c in stage.conditions(each))
            made.rows.append(Row("path", "path", path.numel(), conditions, tuple(members)))
        at += defects.numel() + path.numel()
        made.cost += ca.sum2(cost)
        if problem.budgets:
            made.budgets += ca.sum2(budgets)
    made.completed = [completed[k] for k in sorted(completed)]
    return made


_stage = lru_cache(maxsize=32)(Stage)
"""Programs of one problem on several meshes share their stages, and what was derived of them."""


def _alike(problem: Problem, mesh: Mesh) -> list[tuple[Stage, list[int]]]:
    """Intervals of equal degree and checks on legs with equal path conditions (and bounds)."""
    found: list[tuple[Stage, list[int]]] = []
    guarded = [v.name for v in problem.plant.inputs] if mesh.form.guarded else []
    for k, interval in enumerate(mesh.intervals):
        leg = problem.legs[interval.leg]
        labels = tuple(sorted(n for n, _ in interval.watched))
        bounded = [*guarded, *(n for n in labels if n in leg.bounds)]
        for stage, members in found:
            same = (stage.degree, stage.watched) == (interval.degree, labels)
            bounds = all(stage.leg.bounds[n] == leg.bounds[n] for n in bounded)
            if same and bounds and stage.leg.path == leg.path:
                members.append(k)
                break
        else:
            found.append((_stage(problem, leg, mesh.form, interval.degree, labels), [k]))
    return found


def sampled(profiles: Sequence[ca.Function], h: ca.MX, t: ca.MX, taus: Array) -> ca.MX:
    """Values of the profiles at all points: one column per interval, profiles fastest."""
    if not profiles:
        return ca.MX(0, h.shape[1])
    rows = []
    for tau in taus:
        times = t + h * float(tau)
        rows += [function.map(h.shape[1])(times) for function in profiles]
    return ca.vertcat(*rows)


def _nodes(
    problem: Problem, mesh: Mesh, z: Unknowns, clock: _Clock, given: tuple[ca.MX, ca.MX]
) -> list[tuple[ca.MX, Row]]:
    """Conditions at the stops, and the closing of a cycle."""
    x_nominal, _ = nominals(problem)
    count = len(mesh.intervals)
    pieces = []
    for i, conditions in enumerate(problem.nodes):
        if conditions:
            values = problem.conditions("stop", conditions)
            point = _point(problem, mesh, z, clock, given, mesh.first(i))
            row = Row(f"stop {i + 1}", "stop", len(conditions), conditions)
            pieces.append((values(*point), row))
    if problem.closing is not None:
        names = [v.name for v in problem.plant.states]
        closed = [names.index(name) for name in problem.closing]
        image = ca.vertcat(
            *(
                sign * z.begin(0)[names.index(other)] * x_nominal[names.index(other)] / x_nominal[i]
                for i, (sign, other) in zip(closed, problem.closing.values(), strict=True)
            )
        )
        row = Row("closing of the cycle", "closing", len(closed))
        pieces.append((z.begin(count)[closed] - image, row))
    return pieces


def _point(
    problem: Problem, mesh: Mesh, z: Unknowns, clock: _Clock, given: tuple[ca.MX, ca.MX], k: int
) -> tuple[ca.MX, ...]:
    """Arguments of a Problem's function at the start of interval k, or at the end of the motion."""
    x_nominal, u_nominal = nominals(problem)
    count = len(mesh.intervals)
    inside = min(k, count - 1)
    tau = 1.0 if k == count else 0.0
    u = _input(mesh, z, inside, tau) * u_nominal
    time = clock.end if k == count else clock.starts[k]
    profiles = ca.vertcat(*(f.function()(time) for f in problem.profiles))
    return z.begin(k) * x_nominal, u, given[0], time, ca.MX(profiles), given[1], z.peaks


def _continuity(problem: Problem, mesh: Mesh, z: Unknowns) -> list[tuple[ca.MX, Row]]:
    """Linear inputs do not jump; nor do polynomial ones whose rate is penalised, nor held ones
    inside what was one interval.
    """
    control = mesh.form.control
    smooth = control == "linear" or (control == "polynomial" and bool(problem.objective.rate))
    at = [k for k, each in enumerate(mesh.intervals) if k and (smooth or each.joined)]
    if not at or not problem.plant.inputs:
        return []
    jumps = ca.veccat(*(_input(mesh, z, k - 1, 1.0) - _input(mesh, z, k, 0.0) for k in at))
    return [(jumps, Row("continuity of the inputs", "defect", jumps.numel()))]


def _input(mesh: Mesh, z: Unknowns, k: int, tau: float) -> ca.MX:
    """The (scaled) inputs in interval k at tau."""
    return z.inputs(k) @ mesh.form.weights(mesh.intervals[k].degree, tau)


def _budgets(problem: Problem, values: ca.MX) -> list[tuple[ca.MX, Row]]:
    if not problem.budgets:
        return []
    return [(values, Row("budgets", "budget", len(problem.budgets), problem.budgets))]


def _other_costs(
    problem: Problem, mesh: Mesh, z: Unknowns, clock: _Clock, given: tuple[ca.MX, ca.MX]
) -> ca.MX:
    """Time, the last node, peaks, and jumps of the inputs where their rate is penalised."""
    goal = problem.objective
    total = goal.time * clock.end
    if not goal.final.is_zero():
        last = _point(problem, mesh, z, clock, given, len(mesh.intervals))
        total += problem.function("final", [goal.final])(*last)
    if goal.peaks:
        total += ca.dot(ca.DM(list(goal.peaks)), z.peaks)
    if goal.rate and mesh.form.control == "constant":
        total += goal.rate * _jumps(mesh, z, clock)
    return total


def _jumps(mesh: Mesh, z: Unknowns, clock: _Clock) -> ca.MX:
    """Squared jumps over the mean length of what is held beside: the rate of a joined signal."""
    total, firsts = ca.MX(0), mesh.held()
    ends = pairwise([*firsts, len(mesh.intervals)])
    lengths = [sum(clock.lengths[a:b], ca.MX(0)) for a, b in ends]
    for k, before, after in zip(firsts[1:], lengths[:-1], lengths[1:], strict=True):
        jump = _input(mesh, z, k, 0.0) - _input(mesh, z, k - 1, 0.0)
        total += ca.sumsqr(jump) / ((before + after) / 2)
    return total


def _bounds(problem: Problem, mesh: Mesh) -> tuple[Array, Array]:
    plant = problem.plant
    x_nominal, u_nominal = nominals(problem)

    def box(leg: int, variables: Sequence[object], nominal: Array) -> Array:
        bounds = problem.legs[leg].bounds
        pairs = [bounds[v.name] for v in variables]  # type: ignore[attr-defined]
        return np.array(pairs).reshape(-1, 2) / nominal[:, None]

    def both(a: Array, b: Array) -> Array:
        return np.column_stack([np.maximum(a[:, 0], b[:, 0]), np.minimum(a[:, 1], b[:, 1])])

    x = [box(i, plant.states, x_nominal) for i in range(len(problem.legs))]
    u = [box(i, plant.inputs, u_nominal) for i in range(len(problem.legs))]
    parts = [x[0]]
    auxiliary = np.array([[a.low, a.high] for a in problem.auxiliaries]).reshape(-1, 2)
    following: list[Interval | None] = [*mesh.intervals[1:], None]
    for interval, after in zip(mesh.intervals, following, strict=True):
        leg = interval.leg
        end = x[leg] if after is None or after.leg == leg else both(x[leg], x[after.leg])
        parts += [x[leg]] * (len(mesh.form.state_taus(interval.degree)) - 1) + [end]
        # a joined input is another's: bounds and multipliers once
        own = np.tile([-np.inf, np.inf], (len(u[leg]), 1)) if interval.joined else u[leg]
        parts += [own] * len(mesh.form.input_taus(interval.degree))
        parts += [auxiliary] * mesh.form.cost_points(interval.degree)
    durations = np.array([leg.duration for leg in problem.legs])
    parts.append(durations / problem.time_nominals[:, None])
    design = np.array(list(problem.design.values())).reshape(-1, 2)
    parts.append(design / problem.design_nominals[:, None])
    parts.append(np.tile([-np.inf, np.inf], (problem.m.numel(), 1)))
    stacked = np.vstack(parts)
    return stacked[:, 0], stacked[:, 1]


# ---- the smoothing homotopy ----------------------------------------------------------------------
# Nonsmooth terms of a plant (dry friction, hysteresis) are widened first: parameters that have a
# ``widest`` value go from there to their own along one path, evenly in their logarithms, and with
# them those that have a ``relaxed`` one. The last place of the path is the problem itself.
def is_nonsmooth(problem: Problem) -> bool:
    """Whether the plant has nonsmooth terms whose smoothing is narrower than it may be."""
    return bool(_widths(problem.plant))


def has_smoothing(problem: Problem) -> bool:
    """Whether the plant has nonsmooth terms, at whatever place of the path it stands."""
    return any(v.widest > 0 for v in problem.plant.parameters)


def has_relaxed(problem: Problem) -> bool:
    """Whether more than widths is led along the path."""
    return any(v.relaxed > 0 for v in problem.plant.parameters)


def _widths(plant: Plant) -> list[Variable]:
    return [v for v in plant.parameters if v.widest > 0 and v.widest > (v.start or 0.0)]


def smoothed(plant: Plant, place: float, relaxed: bool = False) -> Plant:
    """The plant at a place of the path, 0 (widest smoothing) .. 1 (its own).

    relaxed : whether parameters that have such a value are led along.
    """
    begins = {v: v.widest for v in _widths(plant)}
    if relaxed:
        begins |= {v: v.relaxed for v in plant.parameters if v.relaxed > 0}
    return plant.with_values(
        {
            v.name: float(np.clip(begin ** (1 - place) * (v.start or 0.0) ** place, v.min, v.max))
            for v, begin in begins.items()
        }
    )


def smoothed_at(program: Program, place: float, relaxed: bool = False) -> Program:
    """The program at a place of the path; itself at the end."""
    if place >= 1.0:
        return program
    problem = replace(program.problem, plant=smoothed(program.problem.plant, place, relaxed))
    return replace(program, problem=problem)
