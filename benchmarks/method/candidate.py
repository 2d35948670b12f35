"""A candidate for the plan, the solves that lead to one, and the record of each."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from method.settings import SETTINGS, Settings
from pam_ocp.planning.checked import Checked, checked
from pam_ocp.planning.problem.problem import Problem
from pam_ocp.planning.renewal import on_mesh
from pam_ocp.planning.replay import chosen_plant, interval_errors
from pam_ocp.planning.result import Solved
from pam_ocp.planning.solvers.backend import Backend, Solver
from pam_ocp.planning.solvers.ipopt_options import Start
from pam_ocp.planning.solvers.narrowing import rounded_at
from pam_ocp.planning.solvers.solver import SETTLED, Outcome
from pam_ocp.planning.transcription.guess import from_solution
from pam_ocp.planning.transcription.mesh import Mesh
from pam_ocp.planning.transcription.solution import unpack
from pam_ocp.planning.transcription.transcription import Program

__all__ = ["Candidate", "Engine", "Stage"]

Array: TypeAlias = NDArray[np.float64]

LOG = logging.getLogger(__name__)

HARDLY = 1.25
"""Times as many unknowns: a mesh so little finer has next to nothing to gain."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A solved program at a place of the smoothing path (1: the user's own problem).

    number : of the start that it comes from. coarser : the candidate on the mesh before, for
    estimates of what finer meshes may gain. rounds : of refinement at the end of the path.
    """

    solved: Solved
    place: float = 1.0
    number: int = 0
    coarser: Candidate | None = field(default=None, repr=False)
    rounds: int = 0

    @property
    def mesh(self) -> Mesh:
        return self.solved.program.mesh

    @property
    def objective(self) -> float:
        return self.solved.outcome.objective

    def meshes(self, asked: Mesh) -> tuple[Mesh, ...]:
        """That it was led along, from the one that was asked for."""
        found: list[Mesh] = [self.mesh]
        c = self.coarser
        while c is not None and c.mesh != asked:
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


@dataclass(frozen=True)
class Stage:
    """A step of the search: what was solved, why, and what it cost."""

    name: str
    reason: str
    status: str
    iterations: int
    seconds: float
    """Of the processor."""
    intervals: int
    unknowns: int
    objective: float


class Engine:
    """Solves the programs of one problem on any mesh, and writes down each solve.

    first : the program that was asked for, and the solver that its user chose; all other meshes are
    solved by IPOPT, which starts near.
    """

    def __init__(
        self,
        first: Program,
        solver: Solver,
        backend: Backend,
        settings: Settings = SETTINGS,
        stages: list[Stage] | None = None,
    ) -> None:
        self.first, self.solver, self.backend, self.settings = first, solver, backend, settings
        self._near = backend.near()
        self.stages: list[Stage] = [] if stages is None else stages
        self.sought = 0
        """Unknowns of the mesh on which flat costs were last brought to their least."""
        self.work = 0.0
        """Iterations times unknowns."""

    @property
    def iterations(self) -> int:
        return sum(stage.iterations for stage in self.stages)

    def of(self, problem: Problem) -> Engine:
        """For the same problem in other inputs; its solves are written down here."""
        from pam_ocp.planning.transcription.transcription import transcribe

        first = transcribe(problem, self.first.mesh)
        return Engine(first, self._near.build(first), self.backend, self.settings, self.stages)

    def program(self, mesh: Mesh) -> Program:
        """The user's own problem on a mesh."""
        if mesh == self.first.mesh:
            return self.first
        return on_mesh(self.first.problem, mesh, self._near.programs)

    def solver_of(self, program: Program) -> Solver:
        return self.solver if program.nlp is self.first.nlp else self._near.build(program)

    def solve(
        self,
        mesh: Mesh,
        place: float,
        guess: Array,
        start: Start,
        why: tuple[str, str],
        warm: Outcome | None = None,
    ) -> Solved:
        """The problem on a mesh at a place of the path, from scaled unknowns; ``why``: name and
        reason of the stage.
        """
        own = self.program(mesh)
        program, solver = rounded_at(own, place), self.solver_of(own)
        begin = time.process_time()
        outcome = solver(program, guess, start, warm)
        self.written(why, program, outcome, time.process_time() - begin)
        return self.solved(program, outcome)

    def written(
        self, why: tuple[str, str], program: Program, outcome: Outcome, seconds: float
    ) -> None:
        """Write down a solve."""
        size = len(outcome.w)
        self.work += outcome.iterations * size
        stage = Stage(
            *why,
            outcome.status,
            outcome.iterations,
            seconds,
            len(program.mesh.intervals),
            size,
            outcome.objective,
        )
        self.stages.append(stage)
        LOG.info(
            "%s (%s): %d intervals, %s, %d iterations, %.2f s, objective %.6g",
            *(stage.name, stage.reason, stage.intervals, stage.status, stage.iterations),
            *(stage.seconds, stage.objective),
        )

    def solved(self, program: Program, outcome: Outcome) -> Solved:
        return Solved(program, outcome, unpack(program.problem, program.mesh, outcome.w))

    def refined(self, near: Solved, mesh: Mesh, place: float, why: tuple[str, str]) -> Solved:
        """From the solution on another mesh."""
        program = self.program(mesh)
        guess = from_solution(program.problem, mesh, near.solution)
        start: Start = "near" if place == 1.0 else "between"
        if place == 1.0 and near.outcome.status == SETTLED:
            size = program.nlp["x"].numel()
            if size <= HARDLY * self.sought:  # costs are flat: the motion next to it
                found = self.solve(mesh, place, guess, "still", why)
                if found.outcome.success:
                    return found
            self.sought, start = size, "finer"
        return self.solve(mesh, place, guess, start, why)
