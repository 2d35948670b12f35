"""One program: from a guess, or from all guesses there are, to a solution or a diagnosis."""

from __future__ import annotations

import time
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .backend import Backend, Solver
from .diagnosis import Conflict, elastic
from .guess import by_stops, from_solution, wants_balance
from .narrowing import has_kinks, narrowing
from .result import Solved
from .solution import unpack
from .solver import Outcome, Start
from .transcription import Program

__all__ = ["STARTS", "Run"]

Array: TypeAlias = NDArray[np.float64]

_STRATEGIES: tuple[Start, ...] = ("cold", "adaptive")
STARTS = tuple(product((True, False), (1.0, 0.3, 3.0), _STRATEGIES))
"""(whether states run as in the planner's own guess, its durations, barrier strategy)."""


class Run:
    """One program: from a guess, or from all guesses there are, to a solution or a diagnosis.

    A solver that was stopped ends the run: nothing else is tried after it.
    """

    def __init__(self, program: Program, backend: Backend, solver: Solver | None = None) -> None:
        begin = time.perf_counter()
        self.program, self.options = program, backend.ipopt_options
        self.solver = solver or backend.build(program)
        self.build_seconds = time.perf_counter() - begin
        self.conflicts: tuple[Conflict, ...] = ()

    def refined(self, coarse: Solved) -> Solved:
        """From the solution on a coarser mesh; no other guess would be better."""
        guess = from_solution(self.program.problem, self.program.mesh, coarse.solution)
        found = self._from(guess, "near")
        return found if found.outcome.ended else self._from(guess)

    def best(self, first: Solved, starts: int) -> tuple[Solved, list[float]]:
        """The best of the first start and further ones, and the objectives of all that led somewhere."""
        own = wants_balance(self.program.problem)
        tried = [first]
        for usual, stretch, start in STARTS[1:starts]:
            balanced = own if usual else not own
            guess = by_stops(self.program.problem, self.program.mesh, balanced, stretch)
            tried.append(self._from(guess, start))
        solved = [s for s in tried if s.outcome.success]
        objectives = [s.outcome.objective for s in solved]
        return (solved[int(np.argmin(objectives))] if solved else first), objectives

    def solve(self, previous: Solved | None) -> Solved:
        """The first guess that leads to a solution; then the elastic re-solve's; then failure."""
        found = self._usual(previous)
        if found.outcome.ended:
            return found
        program, problem, mesh = self.program, self.program.problem, self.program.mesh
        balanced = by_stops(problem, mesh, balanced=True)
        again = self._from(balanced, "adaptive")
        if again.outcome.ended:
            return again
        self.conflicts, feasible = elastic(program, balanced, self.options)
        if not self.conflicts:
            again = self._from(feasible, "adaptive")
        return again if again.outcome.ended else found

    def _usual(self, previous: Solved | None) -> Solved:
        """From another solution if there is one, else (or if that fails) from the planner's guess."""
        program, problem, mesh = self.program, self.program.problem, self.program.mesh
        if previous is not None:
            if previous.program.nlp is program.nlp:
                found = self._from(previous.outcome.w, "warm", previous.outcome)
            else:
                found = self._from(from_solution(problem, mesh, previous.solution), "near")
            if found.outcome.ended:
                return found
        return self._from(by_stops(problem, mesh, balanced=wants_balance(problem)))

    def _from(self, guess: Array, start: Start = "cold", warm: Outcome | None = None) -> Solved:
        if warm is None and has_kinks(self.program.problem):
            outcome = narrowing(self.solver, self.program, guess, start)
        else:
            outcome = self.solver(self.program, guess, start, warm)
        solution = unpack(self.program.problem, self.program.mesh, outcome.w)
        return Solved(self.program, outcome, solution)
