"""The search for a plan: starts on the first mesh of the sequence, led to the end one by one.

The first verified candidate is kept; others replace it only where they are verified and better. So
whatever ends the search, there is the best motion so far, and more starts are never worse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.stop import TimeIsUp, spared
from ..judge.statement import COSTS, Statement
from .candidate import Candidate, Checked, Engine, renewed, same_form
from .continuation import Continuation, ValveOpenings
from .mesh_sequence import MeshSequence
from .problem.problem import Problem
from .replay import accuracy
from .result import Solved
from .solvers.diagnosis import Conflict, elastic, resolving
from .solvers.ipopt import Start
from .solvers.solver import Ipopt, Outcome
from .stages import WorkIsSpent, limited, stage
from .starts import Task, figures_of, in_series, number_of_starts, solved_side_by_side, tasks
from .transcription.guess import by_leading, by_rests, by_stops, from_solution, wants_balance
from .transcription.mesh import BY_ARCS, Mesh, guarded, merged
from .transcription.solution import unpack
from .transcription.transcription import Program, has_relaxed, is_nonsmooth, transcribe

Array: TypeAlias = NDArray[np.float64]
Guess: TypeAlias = tuple[str, Callable[[], Array | None], Start]

GIVEN = -1
"""Number of the candidate from a given plan: before all starts."""
BLOCKED = "no way from wider smoothing to the plant's own terms"
SPENT = "the iterations that are allowed ended on the way to the plant's own terms"
"""Statuses of a search whose starts are solved, while none is led to the end."""
GRACE = 1.0
"""Seconds for the replay of a solution that was found when the time was up."""
SAME = 1e-6
"""Relative difference of objectives of which the one with less left to gain is kept."""
SHARE = 0.6
"""Of a search's work, for valve openings at most: the way back to commands follows."""
PARTS = 4, 2
"""Intervals in one of meshes that are tried where the first led to nothing: few unknowns, and
numerical damping.
"""


@dataclass
class Found:
    """What a search has come to: the best candidate, or the failure that stands for all."""

    best: Candidate | None = None
    failure: Solved | None = None
    conflicts: tuple[Conflict, ...] = ()
    feasible: bool = False
    """Whether a point meets all constraints, from which no solution was found."""
    cut: bool = False
    """Whether a time limit ended the search."""
    outcomes: list[Outcome] = field(default_factory=list)
    """Of the starts."""
    opened: tuple[Outcome, ...] = ()
    """Of the starts with valve openings as inputs."""
    first: Solved | None = None
    """The solution on the mesh that was asked for."""

    @property
    def figures(self) -> dict[str, Any]:
        """Of the starts, where there were several."""
        ends = (*self.outcomes, *self.opened)
        return figures_of(ends) if len(ends) > 1 else {}


class Search:
    """For the best motion of one problem.

    statement : what is stated. starts : how many, None for the usual number. tolerance : of the
    plan, None for one mesh only.
    """

    def __init__(
        self, engine: Engine, statement: Statement, starts: int | None, tolerance: float | None
    ) -> None:
        self.engine, self.statement, self.starts = engine, statement, starts
        self.tolerance = tolerance
        self.problem, self.settings = engine.first.problem, engine.settings
        merges = engine.backend.name == "ipopt"  # another is somebody's choice for such meshes
        self.meshes = MeshSequence(
            engine.first.mesh, self.problem, self.settings, tolerance, merges
        )
        self.nonsmooth = is_nonsmooth(self.problem)
        self.place = 0.0 if self.nonsmooth else 1.0
        ends = self._take, self._is_led, lambda: self.met
        self.continuation = Continuation(engine, self.meshes, *ends)
        self.found = Found()
        self._began: list[float] = []
        """Objectives of the candidates that were led, on the first mesh."""
        self._stopped: list[Solved] = []
        """Where solvers stopped from a start."""
        self._first_seconds = 0.0
        self._problems: dict[tuple[Mesh, float, bool], Problem] = {}
        self._by_openings = False
        """Whether openings in place of commands led to the plan."""

    def best(
        self, near: Solved | None = None, last: Solved | None = None, finer: Sequence[Program] = ()
    ) -> Found:
        """From a solution that is near, or from the usual starts.

        last : the neighbour's solution on its last mesh; finer : programs on such meshes that are
        kept. Raises TimeIsUp where that came before any solution.
        """
        try:
            self._searched(near, last, finer)
        except TimeIsUp as why:
            self.found.cut = True
            failed = isinstance(why, WorkIsSpent) and self.found.failure is not None
            if self.found.best is None and not failed:
                raise
        return self.found

    def closer(self, tolerance: float) -> bool:
        """Whether the best candidate was led on to another tolerance."""
        before = self.found.best
        assert before is not None
        self.meshes.aims_at(tolerance)
        try:
            self.continuation.led(replace(before, rounds=0, rtol=accuracy(tolerance)))
        except TimeIsUp:
            self.found.cut = True
        best: Candidate = self.found.best or before
        return best.check.miss < before.check.miss

    def _searched(self, near: Solved | None, last: Solved | None, finer: Sequence[Program]) -> None:
        if last is not None and self.starts in (None, 1) and self._reused(last, finer):
            return
        given = None if near is None else self._from_near(near)
        if given is not None:
            self._led(given)
        known = given is not None and self._has_plan()
        if not known or (self.starts or 1) > 1:
            for candidates in self._batches(known):
                self._lead(candidates)
                if self._is_enough():
                    return

    def _goes(self, relaxed: bool) -> None:
        self.engine.relaxed, self._began = relaxed, []
        self.place = 0.0 if self.nonsmooth or relaxed else 1.0

    def _lead(self, candidates: list[Candidate]) -> None:
        """To the end: of those that tie the earliest start first, and only what began better than
        all that were led before, where one of these is verified.
        """
        for c in self._sorted(candidates):
            if self.met or self.tolerance is None:
                worth = all(c.objective < before - self._tie(before) for before in self._began)
            else:
                worth = len(self._began) < self.settings.candidates
            if worth and not self._is_enough():
                self._began.append(c.objective)
                self._led(c)

    def _led(self, c: Candidate) -> None:
        """To the end: by arcs where these were asked for, with held inputs in place of polynomials
        that do not meet the tolerance.
        """
        own = c.place == 1.0 and not self.nonsmooth
        if c.mesh.form == BY_ARCS and np.isfinite(self.meshes.tolerance) and own:
            if self._by_arcs(c):
                return
            finer = self.engine.refined(c, guarded(c.mesh), "by arcs it is not met")
            c = replace(finer if finer.is_solved else c, rounds=0)
        self.continuation.led(c)
        if self.found.best is None and self.found.failure is None:
            status = SPENT if self.continuation.spent else BLOCKED
            blocked = replace(c.solved.outcome, success=False, status=status)
            self.found.failure = replace(c.solved, outcome=blocked)

    def _by_arcs(self, c: Candidate) -> bool:
        """Whether intervals that end where inputs switch met the tolerance."""
        from .arcs_search import ArcSearch  # few plans are by arcs

        def taken(found: Solved) -> Checked | None:
            if not found.outcome.success:
                return None
            now = replace(c, solved=found, coarser=c)
            self._take(now)
            return now.check

        self._take(c)
        met = ArcSearch(c.solved, self.meshes.tolerance, self.engine, taken).solved()
        if met is not None:
            self.found.best = replace(c, solved=met.found, coarser=c)
        return met is not None

    def _take(self, c: Candidate) -> None:
        """Keep a candidate that is the best so far: verified, then with the least objective."""
        if not np.isfinite(self.meshes.tolerance) and self.meshes.is_coarse(c.mesh):
            return  # another mesh than the one that was asked for, alone
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
            less = best.check.replay.objective - c.check.replay.objective
            level = self.meshes.economical and abs(less) <= SAME * abs(c.check.replay.objective)
            better = self.meshes.gap(c) < self.meshes.gap(best) if level else less > 0
        else:
            better = miss < before
        if better:
            self.found.best = c

    def _is_enough(self) -> bool:
        """Whether a plan is found and work is spent: what is left to gain is told with it."""
        return self.met and self.engine.work > self.settings.work

    def _is_led(self) -> bool:
        """The same of a way: what comes from shooting may cost more than the way's end."""
        best = self.found.best
        return self._is_enough() and best is not None and not best.shot

    @property
    def met(self) -> bool:
        """Whether the best candidate meets the tolerance."""
        best = self.found.best
        return best is not None and best.check.miss <= self.meshes.tolerance

    # ---- candidates -----------------------------------------------------------------------------
    def _candidate(self, found: Solved, place: float, number: int = 0) -> Candidate:
        return Candidate(found, place, number, rtol=accuracy(self.meshes.tolerance))

    def _sorted(self, candidates: list[Candidate]) -> list[Candidate]:
        least = min((c.objective for c in candidates), default=0.0)
        return sorted(
            candidates, key=lambda c: (max(c.objective - least, self._tie(least)), c.number)
        )

    def _tie(self, objective: float) -> float:
        return self.settings.tie * max(abs(objective), 1e-9)

    def _batches(self, known: bool) -> Iterator[list[Candidate]]:
        """What one start comes to, until there is a plan: from the usual guess, from others. Then
        from further starts. Each batch is led before the next one is solved, so that there is a
        plan early, and what fewer starts find is found by more, too.

        known : whether a plan that was given led to one.
        """
        if not known:
            yield from self._one()
        others = (self.starts or self._usual_number()) - 1
        if others > 0 and not (self._costly and self._opened is not None):
            for _ in (1,) if self.met else self._ways():
                yield self._further(0 if known else 1, others)
                if self.met:
                    return
        if self.found.best is None:
            yield from ([c] for c in self._feasible())

    def _one(self) -> Iterator[list[Candidate]]:
        """From the usual guess, in openings first; where that leads to no plan, from other guesses
        and by way of coarser meshes.
        """
        for _ in self._ways():
            yield self._from_openings(0, 1)
            if self._has_plan():
                self._by_openings = True
                return
            yield self._solved(self._tasks(1), 0)
            if self._has_plan():
                return
        self._goes(relaxed=False)
        for count, c in enumerate(self._fallbacks(), 1):
            yield [c]
            if self._has_plan() or count >= self.settings.candidates:
                return  # before the next one is solved

    def _ways(self) -> Iterator[bool]:
        """With what is relaxed led along the path and without: first along, where there are
        roundings to be narrowed anyway.
        """
        smooth = not self.nonsmooth
        for relaxed in (not smooth, smooth) if has_relaxed(self.problem) else (False,):
            self._goes(relaxed)
            yield relaxed

    def _has_plan(self) -> bool:
        """Whether there is one; without a tolerance, a solution."""
        return self.met or (self.tolerance is None and self.found.best is not None)

    def _usual_number(self) -> int:
        """How many starts pay: in openings, where the usual guess led to a plan, two (measured on
        24 random tasks: the second was better in three, by 0.02 %, 0.7 % and half, others never).
        """
        plant = self.problem.plant
        usual = number_of_starts(plant)
        return min(usual, 2) if self._by_openings and not in_series(plant) else usual

    def _further(self, begin: int, count: int) -> list[Candidate]:
        """From so many further starts, in openings where these led to a plan."""
        if self._by_openings:
            return self._from_openings(begin, count)
        return self._solved(self._tasks(begin + count)[begin:], 1)

    def _tasks(self, count: int) -> list[Task]:
        mesh = self.meshes.ladder[0]
        return tasks(self._problem_on(mesh), mesh, count)

    def _problem_on(self, mesh: Mesh) -> Problem:
        """At the place where starts begin: one object, so that its points of rest are known."""
        key = mesh, self.place, self.engine.relaxed
        if key not in self._problems:
            program = self.engine.smoothed(self.engine.program(mesh), self.place)
            self._problems[key] = program.problem
        return self._problems[key]

    def _solved(self, starts: list[Task], number: int) -> list[Candidate]:
        """Solutions from these starts on the first mesh; ``number`` of the first of them."""
        engine = self.engine
        own = engine.program(self.meshes.ladder[0])
        program, solver = engine.smoothed(own, self.place), engine.solver_of(own)
        with stage("starts", f"{len(starts)} more" if number else "the usual guess"):
            if isinstance(solver, Ipopt) and len(starts) > 1:
                with limited():
                    outcomes = solved_side_by_side(solver, program, starts, self._first_seconds)
            else:
                outcomes = [solver(program, task.guess, task.start) for task in starts]
        self._first_seconds = outcomes[0].seconds
        self.found.outcomes += outcomes
        if self.found.failure is None and not outcomes[0].success:
            self.found.failure = engine.solved(program, outcomes[0])
        ends = [engine.solved(program, outcome) for outcome in outcomes]
        self._stopped += [end for end in ends if not end.outcome.success]
        return [
            self._candidate(end, self.place, i)
            for i, end in enumerate(ends, number)
            if end.outcome.success
        ]

    def _from_near(self, near: Solved) -> Candidate | None:
        """From a solution of this program (warm), or of another; by way of wider smoothing where
        that does not do.
        """
        engine, place, why = self.engine, 1.0, ("guess", "the plan given")
        if near.program.nlp is engine.first.nlp:
            outcome = near.outcome
            found = engine.solve(engine.first, place, outcome.w, "warm", why, outcome)
        else:
            found = engine.onto(engine.first, near, place, why)
        if self.nonsmooth and not found.outcome.ended:
            place = self.settings.reentry
            found = engine.onto(engine.first, near, place, why)
        if not found.outcome.success:
            self.found.failure = found
            return None
        return self._candidate(found, place, GIVEN)

    def _reused(self, near: Solved, finer: Sequence[Program]) -> bool:
        """Whether the finer mesh of a neighbour's plan does for these numbers, too, from its
        multipliers.
        """
        if not near.multiplied or self.meshes.economical or self.tolerance is None:
            return False
        ours = any(near.program.nlp is each.nlp for each in finer)
        if not ours or not same_form(near.program.problem, self.problem):  # arcs have other legs
            return False
        program, why = renewed(near.program, self.problem), ("guess", "on its finer mesh")
        found = self.engine.solve(program, 1.0, near.outcome.w, "warm", why, near.outcome)
        if not found.outcome.success:
            return False
        c = self._candidate(found, 1.0, GIVEN)
        if c.check.miss > self.meshes.tolerance:
            return False
        self._take(c)
        return True

    # ---- valve openings in place of commands ----------------------------------------------------
    @property
    def _costly(self) -> bool:
        """Whether work or air counts, and meshes may be refined: work says nothing of a valve that
        is closed, nor has its dead zone a slope. Terms on the inputs give it one, and count
        openings there.
        """
        weights = self.statement.weights
        costs = "work" in weights or self._of_air
        return self.tolerance is not None and costs and not {"effort", "rate"} & weights.keys()

    @property
    def _of_air(self) -> bool:
        return any(t in COSTS and COSTS[t].from_supply for t in self.statement.weights)

    @cached_property
    def _opened(self) -> tuple[ValveOpenings, Search] | None:
        """The problem with openings as inputs, and its own search; None where there are none."""
        costly, s = self._costly, self.settings
        opened = ValveOpenings.of(self.problem.plant, self.statement, costly and self._of_air)
        if opened is None:
            return None
        part = replace(s, all_work=SHARE * s.all_work, most_work=SHARE * s.most_work)
        engine = self.engine.of(opened.problem, settings=part)
        return opened, Search(engine, self.statement, self.starts if costly else 1, self.tolerance)

    def _from_openings(self, begin: int, count: int) -> list[Candidate]:
        """From solutions with openings as inputs, by so many starts; none where there are no
        openings, or they lead to nothing. Where work or air counts that is the plan but for the
        names of its inputs; else, since terms on inputs count openings there, these are starts.
        """
        if self._opened is None:
            return []
        opened, inner = self._opened
        limit, found = inner.settings.most_work, list[Candidate]()
        reason = "in place of commands, which have dead zones"
        with stage("valve openings", reason), limited(limit), suppress(WorkIsSpent):
            if self._costly:
                best = inner.best().best
                found = [] if best is None else [replace(best, gap=inner.meshes.gap(best))]
            else:
                inner._goes(self.engine.relaxed)
                known = min((o.objective for o in inner.found.outcomes if o.success), default=None)
                found = inner._sorted(inner._solved(inner._tasks(begin + count)[begin:], begin))
                if begin and known is not None:  # others lead to the plan that there is
                    found = [c for c in found if c.objective < known - inner._tie(known)]
                if not found and not begin:
                    found = list(islice(inner._guessed(inner.engine.first.mesh, 1), 1))
                self.found.opened = tuple(inner.found.outcomes)
        back = (self._in_commands(opened, c) for c in inner._apart(found))
        return [c for c in back if c is not None]

    def _apart(self, candidates: list[Candidate]) -> list[Candidate]:
        """One of each motion, by their objectives, which rise."""
        return [
            c
            for before, c in zip([None, *candidates], candidates, strict=False)
            if before is None or c.objective - before.objective > self._tie(before.objective)
        ]

    def _in_commands(self, opened: ValveOpenings, c: Candidate) -> Candidate | None:
        """A candidate in openings as one in commands: the same motion, where it costs the same and
        each opening has its command; else the least there from it.
        """
        program = self.engine.program(c.mesh)
        sent = opened.in_commands(self.engine.smoothed(program, c.place), c.solved)
        if sent is not None and self._costly:
            return replace(c, solved=sent, rounds=0)
        guess = opened.guess(self.problem, c.mesh, c.solved.solution)
        why = ("valve openings", "back to commands")
        found = self.engine.solve(program, c.place, guess, "near", why)
        if found.outcome.success:
            sent = found
        return None if sent is None else replace(c, solved=sent, rounds=0)

    # ---- where no start leads anywhere ----------------------------------------------------------
    def _fallbacks(self) -> Iterator[Candidate]:
        """From other guesses and by way of coarser meshes; where all that leads to nothing, from
        where solvers stopped beside the constraints.
        """
        asked, usual = self.engine.first.mesh, tuple(self.meshes.ladder)
        ways = [usual, (asked,)]
        if self.tolerance is not None:
            ways.append((*(merged(asked, count) for count in PARTS), asked))
        try:
            for way in dict.fromkeys(tuple(dict.fromkeys(meshes)) for meshes in ways):
                self.meshes.ladder = list(way)
                yield from self._guessed(way[0])
        finally:
            self.meshes.ladder = list(usual)
        for end in sorted(self._stopped, key=lambda end: end.outcome.objective):
            near = self.engine.beside(end, ("other guesses", "where a solver stopped"))
            if near is not None:
                yield self._candidate(near, self.place)

    def _feasible(self) -> Iterator[Candidate]:
        """From a point that meets all constraints."""
        feasible = self.diagnosed()
        if feasible is not None:
            name = "a point that meets all constraints"
            guesses: list[Guess] = [(name, lambda: feasible, "adaptive")]
            yield from self._from_guesses(self.engine.first.mesh, guesses)

    def _guessed(self, mesh: Mesh, most: int | None = None) -> Iterator[Candidate]:
        """Solutions on a mesh from guesses that take longer to make; ``most``: from the first."""
        problem, usual = self.problem, wants_balance(self.problem)
        wide = self._problem_on(mesh)
        guesses: list[Guess] = [
            ("a simulated motion along the stops", lambda: by_leading(wide, mesh), "near"),
            ("equilibria between the stops", lambda: by_rests(problem, mesh), "cold"),
            ("equilibria between the stops", lambda: by_rests(problem, mesh), "adaptive"),
            ("the stops, balanced", lambda: by_stops(problem, mesh, not usual), "adaptive"),
        ]
        yield from self._from_guesses(mesh, guesses[:most])

    def _from_guesses(self, mesh: Mesh, guesses: list[Guess]) -> Iterator[Candidate]:
        engine = self.engine
        for name, make, start in guesses:
            guess = make()
            if guess is None:
                continue
            program, why = engine.program(mesh), ("other guesses", name)
            found = engine.solve(program, self.place, guess, start, why)
            if found.outcome.success:
                yield self._candidate(found, self.place)
                continue
            self._stopped.append(found)
            if self.found.failure is None:
                self.found.failure = found

    def diagnosed(self) -> Array | None:
        """A point that meets all constraints; None where none was found. Conflicts are those that
        an elastic re-solve converged to, where another guess does not lead to such a point.
        """
        own, options = self.engine.first, self.engine.backend.ipopt_options
        problem, mesh, found = self.problem, own.mesh, self.found
        for each in dict.fromkeys((mesh, resolving(mesh))):
            program, ends = own if each is mesh else transcribe(problem, each), []
            for balanced in (True, False):
                ends.append(elastic(program, by_stops(problem, each, balanced=balanced), options))
                if ends[-1].feasible:
                    found.feasible = True
                    if each is mesh:
                        return ends[-1].w
                    return from_solution(problem, mesh, unpack(problem, each, ends[-1].w))
            found.conflicts = next((end.conflicts for end in ends if end.conflicting), ())
            if found.conflicts:
                break
        return None
