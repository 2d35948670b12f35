"""One program: from a guess, or from all guesses there are, to a solution or a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.stop import TimeIsUp
from .problem.objective import regularised
from .result import Solved
from .solvers.backend import Backend, Solver
from .solvers.diagnosis import Conflict, advice, elastic, resolving
from .solvers.ipopt_options import Start
from .solvers.narrowing import has_kinks, narrowing, widened
from .solvers.side_by_side import solved_side_by_side
from .solvers.solver import SETTLED, Ipopt, Outcome
from .stages import stage
from .starts import Ends, tasks
from .transcription.guess import by_rests, by_stops, from_solution, wants_balance
from .transcription.leading import by_leading
from .transcription.mesh import merged
from .transcription.solution import unpack
from .transcription.transcription import Program, transcribe

__all__ = ["Run"]

Array: TypeAlias = NDArray[np.float64]

REGULAR = 1e-3
"""Cost of the squared inputs, in nominals and times the weight of the time: a motion of an arm with
four muscles is found in 130 iterations, where 300 without it end nowhere.
"""
COARSER = (4, 2)
"""Intervals in one, where the mesh that was asked for led to nothing."""
FROM_COARSER: tuple[Start, ...] = ("step", "cold", "adaptive")
"""Ways from a solution on a coarser mesh."""


class Run:
    """One program: from a guess, or from all guesses there are, to a solution or a diagnosis.

    A solver that was stopped ends the run: nothing else is tried after it.
    """

    def __init__(self, program: Program, backend: Backend, solver: Solver | None = None) -> None:
        begin = time.perf_counter()
        self.program, self.backend = program, backend
        self.solver = solver or backend.build(program)
        self.build_seconds = time.perf_counter() - begin
        self.conflicts: tuple[Conflict, ...] = ()
        self.feasible = False
        self._misled = False

    def refined(self, coarse: Solved, again: bool = True) -> Solved:
        """From the solution on a coarser mesh; no other guess would be better.

        again : where that fails, from there with the barrier of a cold start.
        """
        guess = from_solution(self.program.problem, self.program.mesh, coarse.solution)
        # where the coarse motion is none of its own, the finer one is damped towards it
        found = self.from_guess(guess, "finer" if coarse.outcome.status == SETTLED else "near")
        return found if found.outcome.ended or not again else self.from_guess(guess)

    def beside(self, coarse: Solved) -> Solved | None:
        """The motion next to that of a coarser mesh, whatever it costs; None where none is."""
        guess = from_solution(self.program.problem, self.program.mesh, coarse.solution)
        found = self._solution(self.solver(self.program, guess, "still"))
        return found if found.outcome.ended else None

    def directly(self, coarse: Solved) -> Solved:
        """The same with the plant's own roundings at once, or not at all."""
        return self.straight(
            from_solution(self.program.problem, self.program.mesh, coarse.solution)
        )

    def straight(self, guess: Array) -> Solved:
        """From a guess on a motion that is all but solved, with the plant's own roundings."""
        return self._solution(self.solver(self.program, guess, "finer"))

    def widely(self, coarse: Solved) -> Solved:
        """With the widest roundings, from the solution on a coarser mesh."""
        guess = from_solution(self.program.problem, self.program.mesh, coarse.solution)
        return self.wide_from(guess)

    def wide_from(self, guess: Array) -> Solved:
        """With the widest roundings, from a guess that is near."""
        program = widened(self.program)
        outcome = self.solver(program, guess, "near")
        if not outcome.ended:
            outcome = self.solver(program, guess)
        return self._solution(outcome, program)

    def narrowed(self, wide: Sequence[Solved]) -> Solved:
        """From solutions with the widest roundings, the first that leads to one of the plant's
        own; else the last failure.
        """
        return self._solution(self._narrowed([each.outcome for each in wide])[0])

    def led_widely(self) -> Solved | None:
        """With the widest roundings from a motion led along the stops; None where that leads to
        nothing, which is tried once.
        """
        if self._misled:
            return None
        program = widened(self.program) if has_kinks(self.program.problem) else self.program
        guess = by_leading(program.problem, program.mesh)
        outcome = self.solver(program, guess, "near")
        self._misled = not outcome.ended
        return None if self._misled else self._solution(outcome, program)

    def several(self, starts: int, wide: bool = False) -> tuple[list[Solved], Ends]:
        """(solutions from different starts, the best first; where all of them ended); ``wide``:
        with the widest roundings.
        """
        kinks = has_kinks(self.program.problem)
        program = widened(self.program) if kinks else self.program
        with stage("starts", f"{starts} of them"):
            return self._started(program, starts, wide)

    def _started(self, program: Program, starts: int, wide: bool) -> tuple[list[Solved], Ends]:
        kinks = has_kinks(self.program.problem)
        own, *others = tasks(program.problem, program.mesh, starts)
        begin = time.perf_counter()
        first = self.solver(program, own.guess, own.start)
        outcomes = [first]
        if others and not first.stopped:
            spent = time.perf_counter() - begin
            try:
                if isinstance(self.solver, Ipopt):
                    outcomes += solved_side_by_side(self.solver, program, others, spent)
                else:
                    for task in others:
                        outcomes.append(self.solver(program, task.guess, task.start))
            except TimeIsUp:
                if not first.success:
                    raise
        ends = Ends(tuple(outcomes))
        chosen = [outcomes[i] for i in ends.solved or [0]]
        if kinks and ends.solved and not wide:
            chosen, program = self._narrowed(chosen), self.program
        return [self._solution(outcome, program) for outcome in chosen], ends

    def _narrowed(self, wide: Sequence[Outcome]) -> list[Outcome]:
        """The first of some solutions with wide roundings that leads to one of the plant's own."""
        found = []
        for outcome in wide:
            found.append(narrowing(self.solver, self.program, outcome.w, "step"))
            if found[-1].ended:
                break
        return found[-1:]

    def solve(self, previous: Solved | None) -> Solved:
        """The first guess that leads to a solution; then the elastic re-solve's; then failure."""
        found = self.usual(previous)
        return found if found.outcome.ended else self.after(found)

    def after(self, found: Solved) -> Solved:
        """After a start that failed: coarser meshes, another guess, the elastic re-solve's; then
        failure.
        """
        with stage("other guesses", "the usual ones led to nothing"):
            return self._after(found)

    def _after(self, found: Solved) -> Solved:
        problem, mesh = self.program.problem, self.program.mesh
        again = self._from_regularised()
        if again is not None:
            return again
        wide = self.led_widely()
        if wide is not None:
            again = self.narrowed([wide]) if has_kinks(problem) else wide
            if again.outcome.ended:
                return again
        rough = self._from_coarser()
        if rough is not None:
            return rough
        again = self.from_guess(by_stops(problem, mesh, balanced=True), "adaptive")
        if again.outcome.ended:
            return again
        feasible = self._diagnosed()
        if feasible is not None:
            again = self.from_guess(feasible, "adaptive")
        if again.outcome.ended:
            return again
        return replace(found, outcome=replace(found.outcome, advice=advice(self.program)))

    def _from_regularised(self) -> Solved | None:
        """From the solution with a small cost of the inputs; where nothing but the time counts.

        Quickest motions of plants with more inputs than they need are no one motion: along a valley
        of equal durations a solver goes to and fro. With the cost there is one.
        """
        problem, mesh = self.program.problem, self.program.mesh
        if not problem.objective.only_time or has_kinks(problem) or not problem.plant.inputs:
            return None
        costly = regularised(problem, REGULAR)
        program = transcribe(costly, mesh)
        guess = by_stops(problem, mesh, balanced=wants_balance(problem))
        outcome = self.backend.near().build(program)(program, guess, "cold")
        if not outcome.success:
            return None
        found = self._solution(self.solver(self.program, outcome.w, "near"))
        return found if found.outcome.ended else None

    def _from_coarser(self) -> Solved | None:
        """From solutions on coarser meshes, which are found sooner (few unknowns, and numerical
        damping); None when they lead to nothing.
        """
        problem, mesh = self.program.problem, self.program.mesh
        coarse: Solved | None = None
        for each in (merged(mesh, count) for count in COARSER):
            if len(each.intervals) < len(mesh.intervals):
                run = Run(transcribe(problem, each), self.backend.near())
                coarse = run.widest(coarse) or coarse
                if coarse is not None and coarse.outcome.stopped:
                    return coarse
        if coarse is None:
            return None
        guess = from_solution(problem, mesh, coarse.solution)
        for start in FROM_COARSER:
            found = self.from_guess(guess, start)
            if found.outcome.ended:
                return found
        return None

    def widest(self, coarse: Solved | None = None) -> Solved | None:
        """The first solution with the widest roundings, from a coarser mesh and from points of
        rest; None when there is none.
        """
        problem, mesh = self.program.problem, self.program.mesh
        program = widened(self.program) if has_kinks(problem) else self.program

        def guesses() -> Iterator[tuple[Array, Start]]:
            if coarse is not None:
                yield from_solution(problem, mesh, coarse.solution), "near"
            along = by_rests(problem, mesh)
            yield along, "cold"
            yield along, "adaptive"
            yield by_stops(problem, mesh, balanced=False), "adaptive"

        for guess, start in guesses():
            outcome = self.solver(program, guess, start)
            if outcome.ended:
                return self._solution(outcome, program)
        return None

    def _diagnosed(self) -> Array | None:
        """A point that meets all constraints; None where none was found. Conflicts are those that
        an elastic re-solve converged to, where another guess does not lead to such a point.
        """
        problem, mesh, options = self.program.problem, self.program.mesh, self.backend.ipopt_options
        for each in dict.fromkeys((mesh, resolving(mesh))):
            program = self.program if each is mesh else transcribe(problem, each)
            ends = []
            for balanced in (True, False):
                ends.append(elastic(program, by_stops(problem, each, balanced=balanced), options))
                if ends[-1].feasible:
                    self.feasible = True
                    if each is mesh:
                        return ends[-1].w
                    return from_solution(problem, mesh, unpack(problem, each, ends[-1].w))
            self.conflicts = next((end.conflicts for end in ends if end.conflicting), ())
            if self.conflicts:
                break
        return None

    def from_another(self, previous: Solved) -> Solved:
        """From a solution of this program (warm) or of another."""
        if previous.program.nlp is self.program.nlp:
            return self.from_guess(previous.outcome.w, "warm", previous.outcome)
        problem, mesh = self.program.problem, self.program.mesh
        return self.from_guess(from_solution(problem, mesh, previous.solution), "near")

    def usual(self, previous: Solved | None) -> Solved:
        """From another solution if there is one,
        else (or if that fails) from the planner's guess.
        """
        if previous is not None:
            found = self.from_another(previous)
            if found.outcome.ended:
                return found
        problem, mesh = self.program.problem, self.program.mesh
        with stage("starts", "the usual guess"):
            return self.from_guess(by_stops(problem, mesh, balanced=wants_balance(problem)))

    def from_guess(
        self, guess: Array, start: Start = "cold", warm: Outcome | None = None
    ) -> Solved:
        """From scaled unknowns; with ``warm`` from the multipliers of that outcome, too."""
        if warm is None and has_kinks(self.program.problem):
            return self._solution(narrowing(self.solver, self.program, guess, start))
        return self._solution(self.solver(self.program, guess, start, warm))

    def _solution(self, outcome: Outcome, program: Program | None = None) -> Solved:
        program = program or self.program
        return Solved(program, outcome, unpack(program.problem, program.mesh, outcome.w))
