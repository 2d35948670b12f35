"""A candidate for the plan, and the solves that lead from one to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from ..simulation.simulator import evaluated
from .correction import Corrected, corrected, integrated, left_as
from .input_gains import gains
from .problem.problem import Problem
from .replay import Replay, chosen_plant, explained, interval_errors, replayed
from .result import Solved
from .reuse import on_mesh
from .settings import SETTINGS, Settings
from .smoothing import smoothed_at
from .solvers.backend import Backend, Solver
from .solvers.ipopt_options import Start
from .solvers.solver import SETTLED, STUCK, Outcome
from .stages import Stage, stage
from .transcription.guess import from_solution
from .transcription.mesh import Mesh
from .transcription.solution import pack, unpack
from .transcription.transcription import Program, transcribe

__all__ = ["Candidate", "Checked", "Engine", "checked"]


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
        closing and budgets see of it.
        """
        return max(self.replay.error, self.replay.missed)

    def explained(self, tolerance: float) -> Checked:
        """The same, with what the intervals deviate by where the replay does by more than that."""
        found = self.found
        replay = explained(self.replay, self.plant, found.program.mesh, found.solution, tolerance)
        return replace(self, replay=replay)


def checked(found: Solved) -> Checked:
    """A solution replayed."""
    problem, solution = found.program.problem, found.solution
    plant = chosen_plant(problem, solution)
    samples = evaluated(plant, solution.t, solution.states, solution.inputs)
    replay = replayed(problem, plant, found.program.mesh, samples, solution)
    return Checked(found, plant, samples, replay)


Array: TypeAlias = NDArray[np.float64]

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
    comes from shooting, whose costs a way that goes on may lower.
    """

    solved: Solved
    place: float = 1.0
    number: int = 0
    coarser: Candidate | None = field(default=None, repr=False)
    rounds: int = 0
    gap: float | None = None
    shot: bool = False

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
        return checked(self.solved)

    @cached_property
    def errors(self) -> list[float]:
        """Of each interval, in units of nominal: how far a tight integration from its start leaves
        its points.
        """
        problem, solution = self.solved.program.problem, self.solved.solution
        return interval_errors(chosen_plant(problem, solution), self.mesh, solution)

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

    def of(self, problem: Problem, mesh: Mesh | None = None) -> Engine:
        """For another problem."""
        first = transcribe(problem, mesh or self.first.mesh)
        solver = self._near.build(first)
        return Engine(first, solver, self.backend, self.stages, self.settings)

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
                if found.outcome.success:
                    return found
            found = self.solve(program, place, guess, "finer", why)
            objective = near.outcome.objective
            gained = abs(found.outcome.objective - objective) > self.settings.tie * abs(objective)
            self._until = size * (HARDLY if gained else FAR)
            return found
        return self.solve(program, place, guess, start, why)

    def beside(self, found: Solved, why: tuple[str, str]) -> Solved | None:
        """The motion next to where a solver stopped beside the constraints; None where it did not,
        or there is none.
        """
        program, outcome = found.program, found.outcome
        if not outcome.beside:
            return None
        with stage(*why):
            near = self.solver_of(program)(program, outcome.w, "feasible", outcome)
        if not near.success:
            return None
        return self.solved(program, replace(near, warning=STUCK.format(outcome.status)))

    def refined(self, c: Candidate, mesh: Mesh, why: str, start: Start = "near") -> Candidate:
        """A candidate on a finer mesh, solved or not."""
        found = self.onto(self.program(mesh), c.solved, c.place, ("mesh", why), start)
        rounds = c.rounds + (c.place == 1.0)
        return replace(c, solved=found, coarser=c, rounds=rounds, gap=None)

    def corrected(self, c: Candidate, start: Start) -> Candidate | None:
        """A candidate whose intervals run as the plant does, from its multipliers: one step of
        defect correction; None where that fails.
        """
        program = corrected(c.solved.program, c.solved.solution)
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
