"""A candidate for the plan, and the solves that lead from one to the next; what its inputs keep the
objective from; programs with other numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from ..simulation.integrate import evaluated
from .problem.problem import Budget, Condition, Problem
from .replay import (
    TOLERANCE,
    Corrected,
    Replay,
    chosen_plant,
    corrected,
    explained,
    integrated,
    interval_errors,
    interval_states,
    left_as,
    replayed,
)
from .result import Solved
from .settings import SETTINGS, Settings
from .solvers.ipopt import Start
from .solvers.solver import SETTLED, STUCK, Backend, Outcome, Solver
from .stages import Stage, stage
from .transcription.guess import from_solution
from .transcription.mesh import Form, Mesh
from .transcription.solution import Places, pack, unpack
from .transcription.stage import between_points
from .transcription.transcription import Program, Row, smoothed_at, transcribe


@dataclass(frozen=True)
class Checked:
    """A solution and its replay."""

    found: Solved
    plant: Plant
    """With the values that were chosen for its design."""
    samples: Trajectory
    replay: Replay

    @property
    def miss(self) -> float:
        """The figure that counts, in units of nominal; infinite when there is none."""
        worst = max(self.replay.error, self.replay.violation)
        return float("inf") if np.isnan(worst) else worst

    @property
    def dynamic(self) -> float:
        """What a motion that is more exact would mend: the replay's error, and what waypoints,
        closing, budgets and limits at the points of the mesh see of it.
        """
        return max(self.replay.error, self.replay.missed, self.replay.at_points)

    def explained(self, tolerance: float) -> Checked:
        """The same, with what the intervals deviate by where the replay does by more than that."""
        found = self.found
        replay = explained(self.replay, self.plant, found.program.mesh, found.solution, tolerance)
        return replace(self, replay=replay)


def checked(found: Solved, rtol: float = TOLERANCE) -> Checked:
    """A solution replayed."""
    problem, solution = found.program.problem, found.solution
    plant = chosen_plant(problem, solution)
    samples = evaluated(plant, solution.t, solution.states, solution.inputs)
    replay = replayed(problem, plant, found.program.mesh, samples, solution, rtol)
    return Checked(found, plant, samples, replay)


Array: TypeAlias = NDArray[np.float64]

FLOOR = 1e-2
"""Objectives below it (in units of their terms) are judged as if they were this large."""
HARDLY = 1.25
FAR = 4.0
"""Times as many unknowns: a mesh so little finer has next to nothing to gain; and one up to so much
finer, where the last had not.
"""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A solved program at a place of the smoothing path (1: the user's own problem).

    number : of the start that it comes from. coarser : the candidate on the mesh before, for
    estimates of what finer meshes may gain. rounds : of refinement at the end of the path. gap :
    such an estimate, where it is known from the same motion in other inputs. shot : whether it
    comes from shooting, whose costs a way that goes on may lower. rtol : of what checks it.
    """

    solved: Solved
    place: float = 1.0
    number: int = 0
    coarser: Candidate | None = field(default=None, repr=False)
    rounds: int = 0
    gap: float | None = None
    shot: bool = False
    rtol: float = TOLERANCE

    @property
    def is_solved(self) -> bool:
        return self.solved.outcome.success

    @property
    def mesh(self) -> Mesh:
        return self.solved.program.mesh

    @property
    def objective(self) -> float:
        return self.solved.outcome.objective

    @property
    def scale(self) -> float:
        """What parts of its objective are parts of."""
        return max(abs(self.objective), FLOOR)

    @property
    def is_corrected(self) -> bool:
        """Whether its collocation equations hold but for the mesh's defects."""
        return isinstance(self.solved.program, Corrected)

    def meshes(self, asked: Mesh) -> tuple[Mesh, ...]:
        """That it was led along, from the one that was asked for."""
        found: list[Mesh] = [self.mesh]
        c = self.coarser
        while c is not None and found[0] != asked:
            if c.mesh != found[0]:
                found.insert(0, c.mesh)
            c = c.coarser
        return tuple(found if found[0] == asked else [asked, *found])

    @cached_property
    def check(self) -> Checked:
        """Its replay; for candidates of the user's own problem."""
        return checked(self.solved, self.rtol)

    @cached_property
    def errors(self) -> list[float]:
        """Of each interval, in units of nominal: how far a tight integration from its start leaves
        its points.
        """
        return interval_errors(self._plant, self.solved.solution, self.exact)

    @cached_property
    def exact(self) -> list[Array]:
        """Of each interval, the states to which a tight integration leads from its start."""
        return interval_states(self._plant, self.mesh, self.solved.solution, self.rtol)

    @property
    def _plant(self) -> Plant:
        return chosen_plant(self.solved.program.problem, self.solved.solution)

    @cached_property
    def gains(self) -> Array | None:
        """Of each interval, what its inputs keep the objective from."""
        return gains(self.solved)


class Engine:
    """Solves the programs of one problem on any mesh.

    first : the program that was asked for, and the solver that its user chose; all other meshes are
    solved by IPOPT, which starts near. stages : where all solves are recorded.
    """

    def __init__(
        self,
        first: Program,
        solver: Solver,
        backend: Backend,
        stages: list[Stage],
        settings: Settings = SETTINGS,
    ) -> None:
        self.first, self.solver, self.backend, self.settings = first, solver, backend, settings
        self.stages, self._near = stages, backend.near()
        self.relaxed = True
        """Whether the path of smoothing leads relaxed parameters along."""
        self._until = 0.0
        """Unknowns of a mesh up to which flat costs need not be brought to their least again."""

    @property
    def work(self) -> float:
        """Of all solves so far."""
        return sum(s.work for s in self.stages)

    def of(
        self, problem: Problem, mesh: Mesh | None = None, settings: Settings | None = None
    ) -> Engine:
        """For another problem."""
        first = transcribe(problem, mesh or self.first.mesh)
        solver = self._near.build(first)
        return Engine(first, solver, self.backend, self.stages, settings or self.settings)

    def program(self, mesh: Mesh) -> Program:
        """The user's own problem on a mesh."""
        if mesh == self.first.mesh:
            return self.first
        return on_mesh(self.first.problem, mesh, self._near.programs)

    def smoothed(self, program: Program, place: float) -> Program:
        """A program at a place of the path."""
        return smoothed_at(program, place, self.relaxed)

    def solver_of(self, program: Program) -> Solver:
        return self.solver if program.nlp is self.first.nlp else self._near.build(program)

    def solve(
        self,
        program: Program,
        place: float,
        guess: Array,
        start: Start,
        why: tuple[str, str],
        warm: Outcome | None = None,
    ) -> Solved:
        """A program at a place of the path, from scaled unknowns; ``why``: name and reason of the
        stage.
        """
        smooth, solver = self.smoothed(program, place), self.solver_of(program)
        with stage(*why):
            outcome = solver(smooth, guess, start, warm)
        return self.solved(smooth, outcome)

    def solved(self, program: Program, outcome: Outcome) -> Solved:
        return Solved(program, outcome, unpack(program.problem, program.mesh, outcome.w))

    def onto(
        self,
        program: Program,
        near: Solved,
        place: float,
        why: tuple[str, str],
        start: Start = "near",
    ) -> Solved:
        """A program from the solution of another, on another mesh."""
        guess = from_solution(program.problem, program.mesh, near.solution)
        if place == 1.0 and near.outcome.status == SETTLED:
            size = program.nlp["x"].numel()
            if size <= self._until:  # costs are flat: the motion next to it
                found = self.solve(program, place, guess, "feasible", why)
                if found.outcome.success and not is_elsewhere(found, near):
                    return found
            found = self.solve(program, place, guess, "finer", why)
            objective = near.outcome.objective
            gained = abs(found.outcome.objective - objective) > self.settings.tie * abs(objective)
            self._until = size * (HARDLY if gained else FAR)
            return found
        return self.solve(program, place, guess, start, why)

    def beside(self, found: Solved, why: tuple[str, str], far: bool = False) -> Solved | None:
        """The motion next to where a solver stopped beside the constraints, or ``far`` from them;
        None where it did not, or there is none.
        """
        program, outcome = found.program, found.outcome
        if outcome.ended or not (far or outcome.beside):
            return None
        near = self.solve(program, 1.0, outcome.w, "feasible", why, outcome)
        if not near.outcome.success:
            return None
        return replace(near, outcome=replace(near.outcome, warning=STUCK.format(outcome.status)))

    def refined(self, c: Candidate, mesh: Mesh, why: str, start: Start = "near") -> Candidate:
        """A candidate on a finer mesh, solved or not."""
        found = self.onto(self.program(mesh), c.solved, c.place, ("mesh", why), start)
        rounds = c.rounds + (c.place == 1.0)
        return replace(c, solved=found, coarser=c, rounds=rounds, gap=None)

    def corrected(self, c: Candidate, start: Start) -> Candidate | None:
        """A candidate whose intervals run as the plant does, from its multipliers: one step of
        defect correction; None where that fails.
        """
        program = corrected(c.solved.program, c.solved.solution, c.exact)
        if program is None:
            return None
        outcome, why = c.solved.outcome, f"dynamics miss by {c.check.dynamic:.1g}"
        found = self.solve(program, 1.0, outcome.w, start, ("defect correction", why), outcome)
        return replace(c, solved=found) if found.outcome.success else None

    def shot(self, c: Candidate) -> Candidate | None:
        """The plant's own motion under the inputs of a candidate, brought to what is asked for by
        the shortest steps (single shooting, with the mesh's derivatives); None where that fails.
        """
        motion = integrated(self.program(c.mesh), c.solved.solution)
        if motion is None:
            return None
        program, why = left_as(self.program(c.mesh), motion), "the plant's own under these inputs"
        guess = pack(program.problem, c.mesh, motion)
        found = self.solve(program, 1.0, guess, "nearest", ("shooting", why), c.solved.outcome)
        if not found.outcome.success:
            return None
        return replace(c, solved=found, place=1.0, coarser=None, shot=True)


def is_elsewhere(finer: Solved, coarser: Solved) -> bool:
    """Whether a motion on a finer mesh costs so much more that it is another one."""
    before = coarser.outcome.objective
    return finer.outcome.objective - before > max(abs(before), FLOOR)


# ---- what inputs keep the objective from ---------------------------------------------------------
# An input that could change inside its interval would lower the objective by the gradient of the
# Lagrangian by it at the points of the interval (Pontryagin's switching function there), times the
# change. The multipliers of the solution give that gradient: no re-solve.
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
    form, w = found.program.mesh.form, found.outcome.w
    old = Places.of(found.program.problem, found.program.mesh)
    parts, places, size = [w[: old.nx]], [], old.nx
    for k, interval in enumerate(found.program.mesh.intervals):
        inputs = w[old.inputs(k)].reshape(-1, old.nu)
        taus = form.collocated(interval.degree).tolist()
        at = [np.asarray(form.weights(interval.degree, tau)).ravel() for tau in taus]
        own = [w[old.states(k)], (np.array(at) @ inputs).ravel(), w[old.auxiliaries(k)]]
        places.append(size + len(own[0]))
        size += sum(map(len, own))
        parts += own
    return np.concatenate([*parts, w[old.begins[-1] :]]), places


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


# ---- a built program with other numbers ----------------------------------------------------------
def _shape(problem: Problem) -> tuple[object, ...]:
    """What the expressions of a program depend on."""
    plant, goal = problem.plant, problem.objective
    return (
        [v.name for v in (*plant.states, *plant.inputs)],  # openings in place of commands, say
        (goal.time, goal.rate, goal.peaks, goal.words, goal.only_time),
        [[c.label for c in node] for node in problem.nodes],
        [[(c.label, c.nominal) for c in leg.path] for leg in problem.legs],
        [b.label for b in problem.budgets],
        len(problem.auxiliaries),
        list(problem.design),
        len(problem.profiles),
        len(problem.aims),
        problem.closing,
        [leg.duration[0] == leg.duration[1] for leg in problem.legs],
    )


def same_form(old: Problem, new: Problem) -> bool:
    """Whether two problems differ by numbers only, so that a program of one bears the other's."""
    return _shape(old) == _shape(new)


def _require_same_form(old: Problem, new: Problem) -> None:
    if not same_form(old, new):
        raise InputError(
            "the changed stops, bounds, budgets or track have other names, weights or within= than "
            "those the planner was built with; only numbers may change. Make a new Planner"
        )
    if any(a is not b for a, b in zip(old.profiles, new.profiles, strict=True)):
        raise InputError("a Profile cannot change in a built planner; make a new Planner")


def renewed(program: Program, problem: Problem, mesh: Mesh | None = None) -> Program:
    """A program with the numbers of another problem of the same form; ``mesh``: with its margins,
    all else of it being the program's.
    """
    program = program.exact()
    _require_same_form(program.problem, problem)
    # durations are unknowns in units that the expressions hold
    same = replace(problem, typical=tuple(map(float, program.problem.time_nominals)))
    moved = replace(program, problem=same, mesh=mesh or program.mesh)
    return replace(moved, rows=_rows(program, moved))


def on_mesh(problem: Problem, mesh: Mesh, known: Iterable[Program]) -> Program:
    """The program of a problem on a mesh, with the expressions of a known one where these are the
    same: margins are limits, and no part of them.
    """
    for program in known:
        same = _structure(program.mesh) == _structure(mesh)
        if same and same_form(program.problem, problem):
            return renewed(program, problem, mesh)
    return transcribe(problem, mesh)


def _structure(mesh: Mesh) -> tuple[object, ...]:
    """What the expressions of a program depend on."""
    return mesh.form, [
        replace(i, raised=False, watched=tuple((label, 0.0) for label, _ in i.watched))
        for i in mesh.intervals
    ]


def _rows(program: Program, moved: Program) -> tuple[Row, ...]:
    """The rows of a program with the limits of another problem of the same form."""
    old, problem, intervals = program.problem, moved.problem, moved.mesh.intervals
    pairs: list[tuple[Sequence[Condition | Budget], Sequence[Condition | Budget]]] = [
        *zip(old.nodes, problem.nodes, strict=True),
        *((a.path, b.path) for a, b in zip(old.legs, problem.legs, strict=True)),
        (old.budgets, problem.budgets),
        *(
            (a.conditions, b.conditions)
            for a, b in zip(old.auxiliaries, problem.auxiliaries, strict=True)
        ),
    ]
    image: dict[int, Condition | Budget] = {
        id(a): b for before, after in pairs for a, b in zip(before, after, strict=True)
    }

    def limited(row: Row, index: int, condition: Condition | Budget) -> Condition | Budget:
        if id(condition) in image:
            return image[id(condition)]
        assert isinstance(condition, Condition)  # looked at between the points
        interval = intervals[row.member(index)]
        return between_points(condition, problem.legs[interval.leg], dict(interval.watched))

    return tuple(
        replace(row, conditions=tuple(limited(row, i, c) for i, c in enumerate(row.conditions)))
        for row in program.rows
    )
