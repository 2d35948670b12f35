"""The search for a plan's solution: which starts, by way of which other problems and meshes.

A plan at large is solved on its mesh from several starts. Economical motions are sought on coarser
meshes first; with valves in openings, with kinks by way of wide roundings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core.errors import OutOfTime
from ..core.stop import TimeIsUp, deadline, limited
from ..judge.costs import COSTS
from ..judge.statement import Statement
from .approach import Approach, resolvable
from .climb import Climb, ladder
from .correction import Corrected
from .landing import landed
from .opened import Opened, guess_in_openings
from .refine import CLOSER
from .result import Plan, Solved
from .run import Run
from .shortcuts import by_coarser
from .solvers.narrowing import has_kinks, widened
from .stages import stage
from .starts import Ends, number_of_starts
from .transcription.mesh import Mesh
from .transcription.transcription import transcribe

__all__ = ["Search"]

APPROACHES = 2
"""Solutions with wide roundings from which the plant's own are approached, at most."""
LOOSER = 5.0
"""Tolerances to which motions with wide roundings settle: what is left is gained with the plant's
own, on finer meshes than the way there needs.
"""


@dataclass(frozen=True)
class Search:
    """For solutions of one program, the best first.

    run : of the program. statement : what it states. climb : for economical motions. starts :
    how many, None for the usual number. tolerance : of the plan, None for one mesh only. figures :
    of the plan; where the starts ended is entered.
    """

    run: Run
    statement: Statement
    climb: Climb
    starts: int | None
    tolerance: float | None
    figures: dict[str, Any]

    def found(self, guess: Plan | None) -> list[Solved]:
        """Solutions; or the one failure that stands for all.

        With a tolerance, a mesh coarser than the one asked for will do where that leads to nothing.
        """
        program = self.run.program
        meshes = ladder(program.mesh) if program.problem.objective.economical else []
        if not meshes or guess is not None:
            return self._searched(self.run, guess, self.tolerance is not None)
        opened = self._climbed_in_openings(meshes)
        if opened is not None:
            return [opened]
        if has_kinks(program.problem):
            found = self._climbed_widely(meshes)
            if found:
                return found
        return self._climbed(meshes) or self._searched(self.run, None, self.tolerance is not None)

    # ---- by way of coarser meshes -----------------------------------------------------------
    def _climbed(self, meshes: list[Mesh]) -> list[Solved]:
        """The problem as it is; empty where the way is blocked."""
        coarse: list[Solved] = []
        partly = self.tolerance is not None

        def search(first: Run) -> list[Solved]:
            coarse[:] = self._searched(first, None, partly)
            return coarse

        try:
            return self.climb.reached(search, self.run, meshes, partly)
        except TimeIsUp:
            found = [each for each in coarse if each.outcome.success]
            if not found:
                raise
            return found

    def _climbed_in_openings(self, meshes: list[Mesh]) -> Solved | None:
        """Work and air with valves: the climb with openings as inputs until it has settled, and
        from there to commands; None where there are no openings, or the way is blocked.

        Work says nothing of a valve that is closed, nor has its dead zone a slope: in commands
        motions got stuck at up to twice the least work. Of a time limit half is left for commands.
        """
        problem, weights = self.run.program.problem, self.statement.weights
        air = any(term in COSTS and COSTS[term].from_supply for term in weights)
        if self.tolerance is None or not (air or "work" in weights):
            return None
        opened = Opened.of(problem.plant, self.statement, air)
        if opened is None:
            return None
        left = deadline().remaining()
        own = replace(self, climb=Climb(self.run.backend))
        try:
            half = limited(max(left / 2, 1e-3) if left < np.inf else None)
            with half, stage("valve openings", "in place of commands, which have dead zones"):
                return own._back_from(opened, meshes, self.tolerance)
        except OutOfTime:
            return None
        finally:
            self.climb.iterations += own.climb.iterations

    def _back_from(self, opened: Opened, meshes: list[Mesh], tolerance: float) -> Solved | None:
        """From openings to commands: solved there or, where a solver leaves that motion, landed;
        at once where it was landed in openings.
        """
        top = Run(transcribe(opened.problem, self.run.program.mesh), self.run.backend)
        fine = replace(self, run=top)._settled(meshes, tolerance)
        if fine is None or not fine.outcome.success:
            return None
        problem, mesh = self.run.program.problem, fine.program.mesh
        run = Run(transcribe(problem, mesh), self.run.backend.near())
        if not isinstance(fine.program, Corrected):
            guess = opened.guess(problem, mesh, fine.solution)
            found = run.straight(guess) if has_kinks(problem) else run.from_guess(guess, "near")
            self.climb.iterations += found.outcome.iterations
            if found.outcome.ended:
                return found if found.outcome.success else None
        same = opened.sent(run, fine)
        return landed(same, CLOSER * tolerance) if same is not None else None

    def _settled(self, meshes: list[Mesh], tolerance: float) -> Solved | None:
        """The best solution of the climb, on a mesh where it has settled."""
        if has_kinks(self.run.program.problem):
            return next(iter(self._climbed_widely(meshes)), None)
        near = Run(self.run.program, self.run.backend.near())
        reached = self.climb.reached(self._from_stops, near, meshes, True)
        if not reached or not reached[0].outcome.success:
            return None
        return self.climb.settled(reached[0], tolerance)

    def _climbed_widely(self, meshes: list[Mesh]) -> list[Solved]:
        """Motions with kinks: the climb with wide roundings all the way until it has settled, and
        from there to the plant's own, once; empty where that is blocked.
        """
        problem = widened(self.run.program).problem
        top = Run(transcribe(problem, self.run.program.mesh), self.run.backend.near())
        tolerance = self.tolerance
        for each in self.climb.reached(self._from_stops, top, meshes, False):
            wide = each if tolerance is None else self.climb.settled(each, LOOSER * tolerance)
            reached = self._from_wide(self.run, wide, tolerance)
            if reached is not None:
                return [reached]
            if wide.outcome.stopped:
                return [wide]
        return []

    def _from_stops(self, first: Run) -> list[Solved]:
        """What such a climb begins with, on the coarsest of its meshes."""
        return self._searched(first, None, False)

    def _from_wide(self, run: Run, wide: Solved, tolerance: float | None = None) -> Solved | None:
        """From a solution with wide roundings to the plant's own; None where that is blocked, and
        no motion near the end of the way is landed to a tolerance.
        """
        approach = Approach(run, wide, self.run.backend.near())
        reached = approach.solved()
        self.climb.iterations += approach.iterations
        if reached is None and tolerance is not None:
            return approach.landed(CLOSER * tolerance)
        return reached

    # ---- on one mesh ------------------------------------------------------------------------
    def _searched(self, run: Run, guess: Plan | None, partly: bool) -> list[Solved]:
        """Solutions from several starts; or the one failure that stands for all."""
        program = run.program
        near = guess._near(program) if guess is not None else None
        usual = 1 if near is not None else number_of_starts(program.problem.plant)
        count = self.starts or usual
        if partly and near is None and resolvable(program):
            return self._approached(run, count)
        if count == 1:
            short = by_coarser(run, self.climb) if near is None else None
            return [short or run.solve(near)]
        opened = self._opened(run) if near is None else None
        found, ends = run.several(count if opened is None else count - 1)
        ours = run.from_another(near) if near is not None else opened
        if ours is not None:
            ends, found = Ends((*ends.outcomes, ours.outcome)), [*found, ours]
        self.figures.update(ends.figures())
        good = [each for each in found if each.outcome.success]
        if good:
            return sorted(good, key=lambda each: each.outcome.objective)
        stopped = [each for each in found if each.outcome.stopped]
        return stopped or [run.after(found[0])]

    def _approached(self, run: Run, count: int) -> list[Solved]:
        """By meshes that resolve kinks, from the best solutions with wide roundings; where none
        leads on so, on the mesh as it is; or the one failure that stands for all.
        """
        opened = self._opened(run, wide=True) if count > 1 else None
        found, ends = run.several(max(count - (opened is not None), 1), wide=True)
        if opened is not None:
            ends, found = Ends((*ends.outcomes, opened.outcome)), [*found, opened]
        if count > 1:
            self.figures.update(ends.figures())
        if any(each.outcome.stopped for each in found):
            return [each for each in found if each.outcome.stopped]
        good = [each for each in found if each.outcome.success]
        if not good and (led := run.led_widely()) is not None:
            good = [led]
        for wide in sorted(good, key=lambda each: each.outcome.objective)[:APPROACHES]:
            reached = self._from_wide(run, wide)
            if reached is not None:
                return [reached]
        narrow = run.narrowed(good) if good else found[0]
        return [narrow if narrow.outcome.ended else run.after(narrow)]

    def _opened(self, run: Run, wide: bool = False) -> Solved | None:
        """From the optimum in openings of valves; None where there are none, or it helps nothing.

        wide : with the widest roundings.
        """
        program, backend = run.program, self.run.backend
        with stage("valve openings", "a start without dead zones"):
            guess = guess_in_openings(program.problem, program.mesh, self.statement, backend, wide)
        if guess is None:
            return None
        return run.wide_from(guess) if wide else run.from_guess(guess, "near")
