"""Refinement by arcs: interval ends that move onto switches, then higher degrees.

From a coarse solution with polynomial inputs the arcs are read off its multipliers; a program with
one interval for each, of unknown length, is solved; where its replay asks for it degrees are
raised. Arcs that vanish are left out. Where the structure was wrong (a multiplier of the wrong
sign, a limit exceeded that no arc holds) the arcs are read off anew, from a solution on intervals
that end where the arcs did.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..numerics.collocation import HIGHEST_DEGREE
from .arcs_found import Chains, Section, Touch, limits_of, merged, sections
from .arcs_problem import LONGEST, SHORTEST, Divided, by_sections, centred
from .candidate import Checked, Engine
from .replay import accuracy, interval_errors, interval_states
from .result import Solved
from .transcription.guess import from_solution
from .transcription.mesh import BY_ARCS, FORM, Interval, Mesh, watched
from .transcription.solution import pack
from .transcription.transcription import Program, later, transcribe

Array: TypeAlias = NDArray[np.float64]

STRUCTURES = 4
"""Times that arcs are read off."""
ROUNDS = 5
"""Of higher degrees for one structure."""
MOST = 40
"""Arcs, at most: what has more is no motion by arcs."""
BUDGET = 1000
"""Iterations of all programs, after which the mesh is refined as usual."""
MOST_INTERVALS = 80
"""Beyond, splitting does not pay."""
VANISHING = 1e-4
"""Part of its leg below which an arc is left out."""
SLIVER = 0.1
"""Part of its leg below which an arc that holds less than one beside it is tried to be left out."""
NO_WORSE = 1e-8
"""Of the objective, without such an arc."""
FIRST_DEGREES = ((0.15, 9), (0.03, 6), (0.0, 4))
"""(share of its leg, degree of an arc that takes more of it) of the first program."""
EXCEEDED = 3e-4
"""In units of nominal: what no arc holds and exceeds its limit by more calls for another arc."""
WRONG = 0.1
"""Part of an arc's multipliers with the wrong sign from which it should not be one."""
PER_DEGREE = 0.7
"""Decades of an interval's error that a higher degree takes, at least."""
SPARE = 1.0
"""Decades more that parts of an interval are to gain: a further round costs more than points."""
MOST_PARTS = 4
LEAST_ERROR = 2e-10
"""Of an interval, that points can take away: the rest is that of the solver."""
COARSE = 5
"""Degree of a solution that arcs are read off anew from."""


class ArcSearch:
    """The motion of a solution by its arcs, to a tolerance.

    taken : replays a solution and keeps it if it is the best; None where it is none.
    """

    def __init__(
        self,
        first: Solved,
        tolerance: float,
        engine: Engine,
        taken: Callable[[Solved], Checked | None],
    ) -> None:
        self.first, self.tolerance, self.engine, self.taken = first, tolerance, engine, taken
        self.problem = first.program.problem
        self.helped = centred(
            self.problem, first.outcome.objective, float(np.sum(first.solution.durations))
        )
        self.chains = Chains(self.problem)
        self.spent = 0
        """On programs by arcs."""

    def solved(self) -> Checked | None:
        """The motion; None where the tolerance was not met."""
        coarse = self._free(self.first.program.mesh, self.first)
        before: list[tuple[int, frozenset[Touch]]] = []
        for _ in range(STRUCTURES):
            if coarse is None:
                break
            found = sections(coarse, self.chains)
            structure = [(s.leg, s.active) for s in found]
            if len(found) > MOST or self.spent > BUDGET:
                break
            last = coarse
            if structure != before:
                divided, now = self._by(found, coarse)
                if now is not None and now.miss <= self.tolerance:
                    return self._trimmed(divided, now)
                last = now.found if now is not None else coarse
            before = structure
            coarse = self._free(_halves(last.program.mesh), last)
        return None

    def _free(self, mesh: Mesh, near: Solved) -> Solved | None:
        """The solution with inequalities alone, not guarded; None when there is none."""
        known = near.program.mesh == mesh and mesh.form in (FORM, BY_ARCS)
        if known and near.multiplied:
            return near
        found = self._from(transcribe(self.problem, Mesh(mesh.intervals, FORM)), near)
        return found if found.outcome.success else None

    def _from(self, program: Program, near: Solved) -> Solved:
        """A program from the solution of another; where that fails, from there with the barrier of
        a cold start.
        """
        why = ("arcs", "intervals that end where inputs switch")
        found = self.engine.onto(program, near, 1.0, why)
        self.spent += found.outcome.iterations
        if not found.outcome.ended:
            guess = from_solution(program.problem, program.mesh, near.solution)
            found = self.engine.solve(program, 1.0, guess, "cold", why)
            self.spent += found.outcome.iterations
        return found

    # ---- one structure --------------------------------------------------------------------------
    def _by(self, found: Sequence[Section], guess: Solved) -> tuple[Divided, Checked | None]:
        """The best motion by these arcs, degrees raised as its replay asks for."""
        arcs = self._arcs(found, guess)
        mesh = arcs.mesh(_degrees(arcs.sections))
        near, best = guess, None
        for _ in range(ROUNDS):
            program = transcribe(arcs.problem, mesh)
            if _overdetermined(program):
                return arcs, best
            if self.spent > BUDGET:
                break
            solved = self._from(program, replace(near, solution=arcs.there(near.solution)))
            if not solved.outcome.success:
                return arcs, best
            again = _changed(arcs, solved)
            near = self._original(arcs, solved)
            if again is not None:
                arcs = self._arcs(again, near)
                mesh = arcs.mesh(_degrees(arcs.sections))
                continue
            now = self.taken(near)
            if now is None:
                return arcs, best
            best = now if best is None or now.miss < best.miss else best
            finer = None if now.miss <= self.tolerance else self._finer(arcs, mesh, now)
            arcs = self._estimated(arcs, solved)
            if finer is None:
                break
            mesh = finer
        return arcs, best

    def _arcs(self, found: Sequence[Section], guess: Solved) -> Divided:
        begins = np.concatenate([[0.0], np.cumsum([s.duration for s in found])[:-1]])
        t, states = guess.solution.t, guess.solution.states
        at = np.column_stack([np.interp(begins, t, column) for column in states.T])
        return by_sections(self.helped, found, self.chains, list(at))

    def _estimated(self, arcs: Divided, solved: Solved) -> Divided:
        """The same arcs, their durations as they were found."""
        durations = solved.solution.durations
        again = [
            replace(s, duration=float(d)) for s, d in zip(arcs.sections, durations, strict=True)
        ]
        return replace(arcs, sections=tuple(again))

    def _original(self, arcs: Divided, solved: Solved) -> Solved:
        """A solution by arcs as one of the problem itself; without multipliers."""
        mesh = arcs.onto(solved.program.mesh, solved.solution.durations)
        program, goal = later(self.problem, mesh), self.problem.objective
        solution = arcs.back(solved.solution)
        w = pack(self.problem, mesh, solution)
        if self.problem.auxiliaries:
            w = program.completed(w)
        if goal.only_time:
            value = goal.time * float(np.sum(solution.durations))
        else:
            nlp = program.nlp
            objective = ca.Function("objective", [nlp["x"], nlp["p"]], [nlp["f"]])
            value = float(objective(w, program.parameters()))
        unknown = np.full(len(solved.outcome.lam_g), np.nan)
        nothing = np.full(len(w), np.nan)
        outcome = replace(solved.outcome, w=w, objective=value, lam_g=unknown, lam_x=nothing)
        return Solved(program, outcome, solution)

    def _finer(self, arcs: Divided, mesh: Mesh, now: Checked) -> Mesh | None:
        """Higher degrees where intervals deviate, checks where limits are exceeded between the
        points; None where another structure is wanted.
        """
        found, replay = now.found, now.replay
        run = interval_states(now.plant, mesh, found.solution, accuracy(self.tolerance))
        errors = np.array(interval_errors(now.plant, found.solution, run))
        if not np.isfinite(errors).all() or not np.isfinite(now.miss):
            return None
        beyond: list[dict[str, float]] = []
        for k, each in enumerate(replay.beyond):
            section = arcs.sections[mesh.intervals[k].leg]
            limits = limits_of(self.problem, self.problem.legs[section.leg])
            held = {limits[t.place].label for t in section.active}
            errors[k] = max([errors[k], *(v for n, v in each.items() if n in held)])
            beyond.append({n: v for n, v in each.items() if n not in held})
        if max((v for each in beyond for v in each.values()), default=0.0) > EXCEEDED:
            return None
        total = float(errors.sum())
        growth = max(1.0, max(replay.error, replay.missed) / total) if total > 0 else 1.0
        allowed = max(self.tolerance / len(errors) / growth, LEAST_ERROR)
        parts: list[Interval] = []
        for interval, error, excess in zip(mesh.intervals, errors, beyond, strict=True):
            raised = _raised(interval, float(error), allowed)
            if raised == [interval]:
                one = Mesh((interval,), mesh.form)
                raised = list(watched(one, [excess], self.tolerance).intervals)
            parts += raised
        finer = Mesh(tuple(parts), mesh.form)
        return finer if finer != mesh and len(parts) <= MOST_INTERVALS else None

    # ---- fewer arcs -----------------------------------------------------------------------------
    def _trimmed(self, divided: Divided, now: Checked) -> Checked:
        """Without arcs that hold less than one beside them and are short, or lie between two that
        are alike, where that costs nothing.
        """
        objective, legs = now.found.outcome.objective, now.found.solution.durations
        sizes = [s.duration for s in divided.sections]
        gone = {
            k
            for k, s in enumerate(divided.sections)
            if _lesser(divided.sections, k, sizes[k] < SLIVER * legs[s.leg])
        }
        if not gone:
            return now
        fewer = without(divided.sections, gone)
        then = self._by(fewer, now.found)[1]
        if then is None or then.miss > self.tolerance:
            return now
        worst = objective + NO_WORSE * max(abs(objective), 1e-3)
        return then if then.found.outcome.objective <= worst else now


def _lesser(found: Sequence[Section], k: int, short: bool) -> bool:
    """Whether an arc holds less than one beside it on its leg (if it is short), or than both, which
    are alike.
    """
    own = found[k]
    beside = [found[j] for j in (k - 1, k + 1) if 0 <= j < len(found) and found[j].leg == own.leg]
    more = [own.active < each.active for each in beside]
    alike = len(beside) == 2 and beside[0].active == beside[1].active
    return any(more) and (short or alike)


def without(found: Sequence[Section], gone: Iterable[int]) -> list[Section]:
    """Sections but for some, whose time goes to one beside them; neighbours that are alike made
    one.
    """
    left = list(found)
    for k in sorted(gone, reverse=True):
        own = left.pop(k)
        beside = [j for j in (k - 1, k) if 0 <= j < len(left) and left[j].leg == own.leg]
        if beside:
            j = max(beside, key=lambda j: len(left[j].active & own.active))
            left[j] = replace(left[j], duration=left[j].duration + own.duration)
    return merged(left)


def _degrees(found: Sequence[Section]) -> list[int]:
    """Of the first program: higher for longer arcs."""
    totals: dict[int, float] = {}
    for s in found:
        totals[s.leg] = totals.get(s.leg, 0.0) + s.duration
    return [
        next(degree for share, degree in FIRST_DEGREES if s.duration >= share * totals[s.leg])
        for s in found
    ]


def _raised(interval: Interval, error: float, allowed: float) -> list[Interval]:
    """An interval with as many more points as its error asks for: a higher degree where one is
    enough, else parts of the highest.
    """
    if error <= allowed:
        return [interval]
    decades = float(np.log10(error / allowed))
    degree = interval.degree + max(1, int(np.ceil(decades / PER_DEGREE)))
    if degree <= HIGHEST_DEGREE:
        return [replace(interval, degree=degree)]
    decades -= PER_DEGREE * (HIGHEST_DEGREE - interval.degree)
    parts = int(np.ceil(10 ** ((decades + SPARE) / HIGHEST_DEGREE)))
    return interval.split(min(max(parts, 2), MOST_PARTS), HIGHEST_DEGREE)


def _halves(mesh: Mesh) -> Mesh:
    parts = (p for i in mesh.intervals for p in replace(i, watched=()).split(2, COARSE))
    return Mesh(tuple(parts), mesh.form)


def _changed(divided: Divided, solved: Solved) -> list[Section] | None:
    """Sections to go on with: without those that vanish; None where they may stay."""
    durations, problem = solved.solution.durations, divided.problem
    totals = divided.durations(durations)
    again: list[Section] = []
    gone, changed = [], False
    for section, leg, duration in zip(divided.sections, problem.legs, durations, strict=True):
        low, high = leg.duration
        bounded = (low, high) == (SHORTEST * section.duration, LONGEST * section.duration)
        if bounded and duration < max(1.05 * low, VANISHING * totals[section.leg]):
            gone.append(len(again))
        changed = changed or (bounded and duration > 0.95 * high)
        again.append(replace(section, duration=float(duration)))
    return without(again, gone) if gone or changed else None


def _overdetermined(program: Program) -> bool:
    """Whether there are more equations than unknowns: such arcs leave nothing to choose."""
    low, high = program.limits()
    least, most = program.bounds()
    return int(np.sum(low == high)) > int(np.sum(least < most))
