"""The search for a plan: starts on the first mesh of the sequence, the best of them led to the end.

The first verified candidate is kept; others replace it only where they are verified and better.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from method.candidate import Candidate, Engine
from method.continuation import Continuation
from method.mesh_sequence import MeshSequence
from pam_ocp.core.stop import TimeIsUp, spared
from pam_ocp.judge.costs import COSTS
from pam_ocp.judge.statement import Statement
from pam_ocp.planning.opened import Opened
from pam_ocp.planning.result import Solved
from pam_ocp.planning.run import Run
from pam_ocp.planning.solvers.ipopt_options import Start
from pam_ocp.planning.solvers.narrowing import has_kinks, rounded_at
from pam_ocp.planning.solvers.side_by_side import solved_side_by_side
from pam_ocp.planning.solvers.solver import Ipopt
from pam_ocp.planning.starts import Ends, number_of_starts, tasks
from pam_ocp.planning.transcription.guess import by_rests, by_stops, wants_balance
from pam_ocp.planning.transcription.leading import by_leading
from pam_ocp.planning.transcription.mesh import Mesh, merged

__all__ = ["Found", "Search"]

Array: TypeAlias = NDArray[np.float64]

GIVEN, LAST = -1, 99
"""Numbers of the candidates from a given plan, and from openings: before and behind all starts."""
GRACE = 1.0
"""Seconds for the replay of a solution that was found when the time was up."""
PARTS = 2, 4
"""Intervals in one of meshes that are tried where the first led to nothing: few unknowns, and
numerical damping.
"""


@dataclass
class Found:
    """What a search has come to: the best candidate, or the failure that stands for all."""

    best: Candidate | None = None
    failure: Solved | None = None
    cut: bool = False
    """Whether a time limit ended the search."""
    figures: dict[str, Any] = field(default_factory=dict)
    first: Solved | None = None
    """The solution on the mesh that was asked for."""


class Search:
    """For the best motion of one problem.

    statement : what is stated. starts : how many, None for the usual number. tolerance : of the
    plan, None for one mesh only.
    """

    def __init__(
        self,
        engine: Engine,
        statement: Statement,
        starts: int | None,
        tolerance: float | None,
    ) -> None:
        self.engine, self.statement, self.starts = engine, statement, starts
        self.tolerance = tolerance
        self.problem, self.settings = engine.first.problem, engine.settings
        self.meshes = MeshSequence(engine.first.mesh, self.problem, self.settings, tolerance)
        self.nonsmooth = has_kinks(self.problem)
        self.place = 0.0 if self.nonsmooth else 1.0
        self.continuation = Continuation(engine, self.meshes, self._take)
        self.found = Found()

    def best(self, near: Solved | None = None) -> Found:
        """From a solution that is near, or from the usual starts.

        Raises TimeIsUp where that came before any solution.
        """
        try:
            self._searched(near)
        except TimeIsUp:
            self.found.cut = True
            if self.found.best is None:
                raise
        return self.found

    def _searched(self, near: Solved | None) -> None:
        given = None if near is None else self._from_near(near)
        candidates = [] if given is None else [given]
        if given is None or (self.starts or 1) > 1:
            candidates += self._candidates(near is not None)
        for count, c in enumerate(self._ordered(candidates)):
            if count and not self._worth(c, count):
                continue
            self.continuation.led(c)
        if self.found.best is not None:
            return
        for c in self._fallbacks():
            if self.continuation.led(c) is not None:
                return

    def _take(self, c: Candidate) -> None:
        """Keep a candidate that is the best so far: verified, then with the least objective."""
        try:
            miss = c.check.miss
        except TimeIsUp:
            with spared(GRACE):
                miss = c.check.miss
        if self.found.first is None and c.solved.program.nlp is self.engine.first.nlp:
            self.found.first = c.solved
        best, limit = self.found.best, self.meshes.tolerance
        if best is None:
            self.found.best = c
            return
        before = best.check.miss
        if miss <= limit and before <= limit:
            better = c.check.replay.objective < best.check.replay.objective
        else:
            better = miss < before
        if better:
            self.found.best = c

    @property
    def met(self) -> bool:
        """Whether the best candidate meets the tolerance."""
        best = self.found.best
        return best is not None and best.check.miss <= self.meshes.tolerance

    # ---- candidates -----------------------------------------------------------------------------
    def _ordered(self, candidates: list[Candidate]) -> list[Candidate]:
        """The best first; of those that tie the earlier start. Of coarse meshes two are brought to
        the mesh that was asked for: what is best there need not be so in the end.
        """
        candidates, ladder = self._sorted(candidates), self.meshes.ladder
        if len(candidates) < 2 or candidates[0].mesh not in ladder[:-1]:
            return candidates
        others = [c for c in candidates[1:] if not self._same(c, candidates[0])][:1]
        raised = [self.continuation.raised(c) for c in (candidates[0], *others)]
        fine = [c for c in raised if c.mesh == ladder[-1]]
        return self._sorted(fine) + [c for c in raised if c.mesh != ladder[-1]]

    def _sorted(self, candidates: list[Candidate]) -> list[Candidate]:
        least = min((c.objective for c in candidates), default=0.0)
        tie = self.settings.tie * max(abs(least), 1e-9)
        return sorted(candidates, key=lambda c: (max(c.objective - least, tie), c.number))

    def _same(self, one: Candidate, other: Candidate) -> bool:
        apart = abs(one.objective - other.objective)
        return apart <= self.settings.tie * max(abs(other.objective), 1e-9)

    def _worth(self, c: Candidate, count: int) -> bool:
        """Whether a further candidate is led to the end: where none is verified, and the usual
        start where it ended elsewhere, so that more starts are never worse than one.
        """
        best = self.found.best
        if best is None or not self.met:
            return count < self.settings.brought
        if c.number > 0 or best.number == c.number:
            return False
        return c.objective <= best.objective + self.settings.near_best * abs(best.objective)

    def _candidates(self, known: bool) -> list[Candidate]:
        """From openings, and from several starts on the first mesh of the sequence.

        known : whether a plan is given as well.
        """
        count = (self.starts or number_of_starts(self.problem.plant)) - known
        opened = None
        if not known and (count > 1 or self._costly):
            opened = self._from_openings()
        if opened is None:
            return self._several(max(count, 1))
        return [opened] if self._costly else [*self._several(max(count - 1, 1)), opened]

    def _several(self, count: int) -> list[Candidate]:
        """Solutions from different starts on the first mesh."""
        engine, mesh = self.engine, self.meshes.ladder[0]
        own = engine.program(mesh)
        program, solver = rounded_at(own, self.place), engine.solver_of(own)
        first, *others = tasks(program.problem, mesh, count)
        begin = time.process_time()
        outcomes = [solver(program, first.guess, first.start)]
        spent = time.process_time() - begin
        if others and not outcomes[0].stopped:
            try:
                if isinstance(solver, Ipopt):
                    outcomes += solved_side_by_side(solver, program, others, spent)
                else:
                    outcomes += [solver(program, task.guess, task.start) for task in others]
            except TimeIsUp:
                if not outcomes[0].success:
                    raise
        for i, outcome in enumerate(outcomes):
            seconds = outcome.seconds if i else spent
            engine.written(("start", f"number {i + 1}"), program, outcome, seconds)
        if len(outcomes) > 1:
            self.found.figures.update(Ends(tuple(outcomes)).figures())
        if not any(outcome.success for outcome in outcomes):
            self.found.failure = engine.solved(program, outcomes[0])
        return [
            Candidate(engine.solved(program, outcome), self.place, i)
            for i, outcome in enumerate(outcomes)
            if outcome.success
        ]

    def _from_near(self, near: Solved) -> Candidate | None:
        """From a solution of this program (warm), or of another; by way of wider smoothing where
        that does not do.
        """
        engine, mesh, why = self.engine, self.engine.first.mesh, ("guess", "the plan given")
        place = 1.0
        if near.program.nlp is engine.first.nlp:
            found = engine.solve(mesh, place, near.outcome.w, "warm", why, near.outcome)
        else:
            found = engine.refined(near, mesh, place, why)
        if self.nonsmooth and not found.outcome.ended:
            place = self.settings.reentry
            found = engine.refined(near, mesh, place, why)
        return Candidate(found, place, GIVEN) if found.outcome.success else None

    # ---- valve openings in place of commands ----------------------------------------------------
    @property
    def _costly(self) -> bool:
        """Whether work or air counts, and meshes may be refined: work says nothing of a valve that
        is closed, nor has its dead zone a slope.
        """
        return self.tolerance is not None and ("work" in self.statement.weights or self._of_air)

    @property
    def _of_air(self) -> bool:
        return any(t in COSTS and COSTS[t].from_supply for t in self.statement.weights)

    def _from_openings(self) -> Candidate | None:
        """From the solution with openings as inputs; None where there are none, or it leads to
        nothing. Where work or air counts that is the plan but for the names of its inputs; else,
        since terms on inputs count openings there, a start.
        """
        costly = self._costly
        opened = Opened.of(self.problem.plant, self.statement, costly and self._of_air)
        if opened is None:
            return None
        engine, told = self.engine.of(opened.problem), self.statement
        if costly:
            c = Search(engine, told, self.starts, self.tolerance).best().best
        else:
            inner = Search(engine, told, 1, None)
            c = next(iter(inner._several(1)), None) or next(
                inner._guessed(engine.first.mesh, 1), None
            )
        if c is None:
            return None
        run = Run(self.engine.program(c.mesh), self.engine.backend.near())
        sent, same = opened.sent(run, c.solved) if costly else None, None
        if sent is not None:
            same = replace(c, solved=sent, number=LAST, rounds=0)
            self._take(same)
        guess = opened.guess(self.problem, c.mesh, c.solved.solution)
        why = ("openings", "back to commands")
        found = self.engine.solve(c.mesh, c.place, guess, "near", why)
        return replace(c, solved=found, number=LAST, rounds=0) if found.outcome.success else same

    # ---- where no start leads anywhere ----------------------------------------------------------
    def _fallbacks(self) -> Iterator[Candidate]:
        """From other guesses and coarser meshes."""
        asked = self.engine.first.mesh
        tried: list[Mesh] = []
        for mesh in (self.meshes.ladder[0], asked, *(merged(asked, n) for n in PARTS)):
            if mesh not in tried:
                tried.append(mesh)
                self.meshes.begin(mesh)
                yield from self._guessed(mesh)

    def _guessed(self, mesh: Mesh, most: int | None = None) -> Iterator[Candidate]:
        """Solutions on a mesh from guesses that take longer to make; ``most``: from the first."""
        problem, engine, usual = self.problem, self.engine, wants_balance(self.problem)
        wide = rounded_at(engine.program(mesh), self.place).problem
        guesses: list[tuple[str, Any, Start]] = [
            ("a motion led along the stops", lambda: by_leading(wide, mesh), "near"),
            ("points of rest between the stops", lambda: by_rests(problem, mesh), "cold"),
            ("points of rest between the stops", lambda: by_rests(problem, mesh), "adaptive"),
            ("the stops, balanced", lambda: by_stops(problem, mesh, not usual), "adaptive"),
        ]
        for name, make, start in guesses[:most]:
            found = engine.solve(mesh, self.place, make(), start, ("start", name))
            if found.outcome.success:
                yield Candidate(found, self.place)
