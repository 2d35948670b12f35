"""From wide roundings to the plant's own ones, on meshes that resolve the motion at each place.

A mesh that does not resolve a kink has optima of its own, which move as the kink narrows: there a
solver takes hundreds of iterations from one place of the path to the next, or fails. Where the
motion is resolved before each step, most steps take some ten.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .correction import CORRECTABLE
from .landing import landed
from .renewal import on_mesh
from .replay import chosen_plant, interval_errors
from .result import Solved
from .run import Run
from .solvers.backend import Backend
from .solvers.ipopt_options import Start
from .solvers.narrowing import has_kinks, rounded_at
from .solvers.solver import Outcome
from .stages import stage
from .transcription.guess import from_solution
from .transcription.mesh import doubled_at_most
from .transcription.solution import unpack
from .transcription.transcription import Program, transcribe

__all__ = ["Approach", "resolvable"]

Array: TypeAlias = NDArray[np.float64]

RESOLVED = CORRECTABLE
"""Sum of the intervals' errors in units of nominal, on the way: what is left of them at its end is
corrected without a finer mesh.
"""
STEP, LEAST = 0.15, 0.01
"""Parts of the path that are gone at once: at most (longer steps lead to other, worse optima), and
at least before it is given up.
"""
FASTER, SLOWER = 1.4, 0.4
"""Of these parts, after a step that led to a solution, and after one that did not."""
REFINEMENTS = 6
"""At each place, at most."""
NEAR_ENOUGH = 0.5
"""Part of the path from which on its motions differ so little from those at its end that inputs
need little change to land these.
"""
EFFORT = 1.2e7
"""Iterations times unknowns of the way, at most: a minute or so."""


def resolvable(program: Program) -> bool:
    """Whether a program has kinks that finer meshes may resolve while its inputs stay as they are.

    Economical motions have meshes of their own, see climb.py.
    """
    constant = program.mesh.form.control == "constant" and program.mesh.form.scheme != "shooting"
    return constant and has_kinks(program.problem) and not program.problem.objective.economical


class Approach:
    """The way of one program from a solution with the widest roundings, on whatever mesh that is.

    iterations : of the solver on it.
    """

    def __init__(self, run: Run, wide: Solved, backend: Backend) -> None:
        self.run, self.backend = run, backend
        problem, mesh = run.program.problem, wide.program.mesh
        if mesh != run.program.mesh:  # a climb has meshes of its own
            self.run = Run(on_mesh(problem, mesh, backend.programs), backend)
        self._here, self._part = wide, 0.0
        self.iterations, self._effort = 0, 0.0

    def solved(self) -> Solved | None:
        """The solution with the plant's own roundings, on a mesh of its own; None where the way
        is blocked.
        """
        step = STEP
        self._resolve()
        while self._part < 1.0:
            if step < LEAST or self._effort > EFFORT:
                return None
            there = min(1.0, self._part + step)
            with stage("smoothing", f"place {there:.2f} of the path"):
                found = self._onward(there)
            if found.outcome.stopped:
                return None
            if not found.outcome.success:
                step *= SLOWER
                continue
            self._here, self._part, step = found, there, min(STEP, FASTER * step)
            if there < 1.0:
                self._resolve()
        return self._here

    def landed(self, tolerance: float) -> Solved | None:
        """Where the way is blocked: the motion of its last place, landed with the plant's own
        roundings to a tolerance [nominals]; None where the way is long yet, or no motion is found.
        """
        if self._part < NEAR_ENOUGH:
            return None
        return landed(replace(self._here, program=self.run.program), tolerance)

    def _resolve(self) -> None:
        """Finer meshes, until the motion is resolved; where one fails, the one before it."""
        problem = self.run.program.problem
        for _ in range(REFINEMENTS):
            mesh, solution = self._here.program.mesh, self._here.solution
            plant = chosen_plant(self._here.program.problem, solution)
            errors = interval_errors(plant, mesh, solution)
            finer = doubled_at_most(mesh, errors, RESOLVED / len(errors), True)
            if sum(errors) <= RESOLVED or finer == mesh or self._effort > EFFORT:
                return
            run = Run(transcribe(problem, finer), self.backend)
            guess = from_solution(problem, finer, solution)
            with stage("smoothing", f"dynamics unresolved by {sum(errors):.1g}"):
                found = self._on(run, self._part, guess, "between")
            if not found.outcome.success:
                return
            self.run, self._here = run, found

    def _onward(self, part: float) -> Solved:
        """The next place of the path, from the multipliers of this one; at its end with costs at
        their least, where a solver gets there.
        """
        here = self._here.outcome
        there = self._on(self.run, part, here.w, "along", here)
        if part < 1.0 or there.outcome.stopped:
            return there
        near = there.outcome if there.outcome.success else here
        least = self._on(self.run, part, near.w, "last", near)
        return least if least.outcome.ended else there

    def _on(
        self, run: Run, part: float, guess: Array, how: Start, warm: Outcome | None = None
    ) -> Solved:
        """What the solver makes of a program at a place of the path."""
        program = rounded_at(run.program, part)
        outcome = run.solver(program, guess, how, warm)
        self.iterations += outcome.iterations
        self._effort += outcome.iterations * len(outcome.w)
        return Solved(program, outcome, unpack(program.problem, program.mesh, outcome.w))
