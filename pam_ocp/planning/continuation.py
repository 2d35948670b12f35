"""From a candidate with wide smoothing on a coarse mesh to the plan: one walk along one path.

At each place of the path the mesh is refined until it resolves the motion, then the path goes on
from the multipliers (predictor: the solution before; corrector: a few damped steps); at its end the
mesh is refined to the plan's tolerance. A mesh that does not resolve a nonsmooth term has optima of
its own, which move as the smoothing narrows: there a solver takes hundreds of iterations from one
place to the next, or fails.

The other relaxation is that of valves: their openings are inputs in place of commands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.signals import PiecewisePolynomial
from ..core.stop import TimeIsUp
from ..judge.motion import GROWTH
from ..judge.statement import Statement
from ..plants.inversion import Inversion
from ..plants.opening import WAYS
from ..plants.plant import Plant
from .candidate import Candidate, Engine, is_elsewhere
from .mesh_sequence import MeshSequence
from .problem.formulation import HOLDS, formulate
from .problem.problem import Problem
from .result import Solved
from .solvers.ipopt import Start
from .solvers.solver import PROJECTIONS, SETTLED
from .transcription.guess import from_solution, rest_point
from .transcription.mesh import Mesh
from .transcription.solution import Solution, pack
from .transcription.transcription import Program, is_nonsmooth


class Continuation:
    """Leads candidates to the end; ``taken`` is called with each that solves the user's own
    problem, ``is_enough`` says whether what was taken will do, ``is_met`` whether it is a plan.
    """

    def __init__(
        self,
        engine: Engine,
        meshes: MeshSequence,
        taken: Callable[[Candidate], None],
        is_enough: Callable[[], bool],
        is_met: Callable[[], bool],
    ) -> None:
        self.engine, self.meshes, self.taken = engine, meshes, taken
        self.is_enough, self.is_met = is_enough, is_met
        self.nonsmooth = is_nonsmooth(engine.first.problem)
        self.settings = engine.settings
        self.spent = False
        """Whether the work allowed ended the last way."""
        self._at_hand: Candidate | None = None

    def raised(self, c: Candidate) -> Candidate:
        """At its place, on the mesh that was asked for; on the finest that leads to a solution."""
        while self.meshes.is_coarse(c.mesh):
            finer = self._finer(c, self.meshes.after(c))
            if finer is None:
                return c
            c = finer
        return c

    def led(self, c: Candidate) -> Candidate | None:
        """The last candidate at the end of the path; None where it is blocked before. What ends the
        search in between leaves the candidate that it was at.
        """
        try:
            return self._led(c)
        except TimeIsUp:
            if self._at_hand is not None and self._at_hand.place == 1.0:
                self.taken(self._at_hand)
            raise

    def _led(self, c: Candidate) -> Candidate | None:
        s, step = self.settings, self.settings.step
        since, blocked = self.engine.work, False
        first, missed, costs = c.place, np.inf, True
        self.spent = False
        while True:
            self._at_hand = c
            spent = self._is_spent(since) or self.is_enough()
            if c.place == 1.0 and (blocked or spent or not self.meshes.is_coarse(c.mesh)):
                self.taken(c)
                c = c if self.is_enough() else self._corrected(c, spent)
            if spent and not self._is_unstable(c) and self._misses_less(c, missed):
                # work limits what is left to gain; what is missed goes on to fall
                spent, missed, costs = False, c.check.miss, False
                since = self.engine.work
            if spent or self._is_unstable(c):
                shot = self._shot(c) if c.place < 1.0 else None
                if shot is None or self.is_met():
                    self.spent = spent
                    return c if c.place == 1.0 else shot
                c, since = shot, self.engine.work
                continue
            meshes = [] if blocked else self.meshes.after(c, costs)
            if meshes:
                finer = self._finer(c, meshes)
                if finer is not None:
                    c = finer
                elif c.place == 1.0 and costs:
                    costs = False  # what they would gain is left; what is missed is not
                else:
                    blocked = True
                continue
            if c.place >= 1.0:
                return c
            there = min(1.0, c.place + step)
            last = step * s.shrink < s.least_step
            further = self._further(c, there, last)
            if further is None and (last or c.place >= s.reentry):
                shot = self._shot(c)
                if last and shot is None:
                    return None
                further = shot if last else None
            if further is not None:
                if c.place == first or further.place == 1.0:  # mesh, path and end each have theirs
                    since = self.engine.work
                c, step, blocked = further, min(s.step, s.grow * step), False
                continue
            step *= s.shrink

    def _is_spent(self, since: float) -> bool:
        """Whether a part of the way, or the search, has taken its work."""
        work = self.engine.work
        return work - since > self.settings.work or work > self.settings.all_work

    def _finer(self, c: Candidate, meshes: list[tuple[Mesh, str]]) -> Candidate | None:
        """On the first of some meshes that leads to a solution, at the end of the path to this
        motion. Along the path costs need not be at their least, unless that is the only way to a
        finer mesh. Where a solver is blocked, the motion next to where it stopped; at last the one
        next to the coarser mesh's.
        """
        on_path = c.place < 1.0 and not self.meshes.is_coarse(c.mesh)
        starts: tuple[Start, ...] = ("restored", "near") if on_path else ("near",)
        for mesh, why in meshes:
            for start in starts:
                finer = self.engine.refined(c, mesh, why, start)
                if not finer.is_solved:
                    finer = self._beside(finer, c)
                if self._leads_on(finer, c):
                    return self._same_motion(finer, c, why)
        mesh, why = meshes[0]
        finer = self.engine.refined(c, mesh, why, "feasible")
        return finer if self._leads_on(finer, c) else None

    def _same_motion(self, finer: Candidate, c: Candidate, why: str) -> Candidate:
        """A finer mesh's, or where that costs more than the coarser one's, which resolved its
        motion, what short steps lead to from there, if it costs less.
        """
        s, short = self.settings, c.solved.outcome.status == SETTLED  # its steps were short
        more = finer.objective - c.objective > s.dearer * c.scale
        if c.place < 1.0 or short or not more or sum(c.errors) > s.resolved:
            return finer
        near = self.engine.refined(c, finer.mesh, why, "finer")
        return near if near.is_solved and near.objective < finer.objective else finer

    def _beside(self, failed: Candidate, c: Candidate) -> Candidate:
        """The motion next to where a solver stopped, if it costs no more than the coarser mesh's
        but for a little; else what failed.
        """
        why = ("mesh", "where the solver stopped")
        near = self.engine.beside(failed.solved, why, far=True)
        if near is None or near.outcome.objective - c.objective > self.settings.dearer * c.scale:
            return failed
        return replace(failed, solved=near)

    @staticmethod
    def _leads_on(finer: Candidate, c: Candidate) -> bool:
        """Whether a mesh is solved, at the end of the path by the same motion."""
        return finer.is_solved and (c.place < 1.0 or not is_elsewhere(finer.solved, c.solved))

    def _corrected(self, c: Candidate, last: bool) -> Candidate:
        """With the mesh's defects corrected, where plain refinement is slow (nonsmooth terms) or
        changes the optimum (flat costs); itself where that does not pay. last : nothing follows;
        else costs come first.
        """
        s, aim = self.settings, self.meshes.tolerance
        if not (self.nonsmooth or self.meshes.economical) or (self.meshes.is_dear(c) and not last):
            return c
        flat = self.nonsmooth or last or c.solved.outcome.status == SETTLED
        start: Start = "feasible" if flat else "warm"
        for _ in range(s.corrections):
            if c.check.dynamic <= aim or sum(c.errors) > s.resolved:
                return c
            now = self.engine.corrected(c, start)
            if start == "feasible" and (now is None or is_elsewhere(now.solved, c.solved)):
                now = self.engine.corrected(c, "last")
            if now is None:
                return c
            self.taken(now)
            if sum(now.errors) > sum(c.errors) / 2:
                return now if now.check.dynamic < c.check.dynamic else c
            c = now
        return c

    def _misses_less(self, c: Candidate, before: float) -> bool:
        """Whether a motion at the end of the path does not meet the tolerance, but came nearer."""
        return c.place == 1.0 and self.meshes.tolerance < c.check.miss < before / 2

    def _is_unstable(self, c: Candidate) -> bool:
        """Whether errors grow so much along a motion that no mesh makes it exact."""
        missed = c.check.replay.error if c.place == 1.0 else 0.0
        return missed > self.meshes.tolerance and missed > GROWTH * sum(c.errors)

    def _further(self, c: Candidate, there: float, last: bool) -> Candidate | None:
        """At the next place of the path, from the multipliers of this one; at its end, and in the
        ``last`` try, with costs at their least, where a solver gets there.
        """
        why = ("smoothing", f"place {there:.2f} of the path")
        found = self._at(c.solved, c.mesh, there, "corrector", why)
        if there == 1.0 or (last and not found.outcome.success):
            near = found if found.outcome.success or there < 1.0 else c.solved
            least = self._at(near, c.mesh, there, "last", why)
            least = self.engine.beside(least, why, far=True) or least
            if least.outcome.ended and not _costs_less(found, least):
                found = least
            for start in PROJECTIONS:
                if not found.outcome.ended:
                    found = self._at(c.solved, c.mesh, there, start, why)
        if not found.outcome.success:
            return None
        return replace(c, solved=found, place=there, coarser=None)

    def _shot(self, c: Candidate) -> Candidate | None:
        """At the end of the path by shooting, as often as each time halves what is missed; None
        where that fails, or gave a plan before. So there is one early, whose costs are near those
        of the place; the way goes on.
        """
        if self.is_met():
            return None
        found, missed = self.engine.shot(c), np.inf
        while found is not None:
            now = found.check.dynamic
            if now <= self.meshes.tolerance:
                self.taken(found)
                return found
            if not now < missed / 2:
                return None
            found, missed = self.engine.shot(found), now
        return None

    def _at(
        self, near: Solved, mesh: Mesh, place: float, start: Start, why: tuple[str, str]
    ) -> Solved:
        """On the same mesh, from another solution there."""
        outcome, program = near.outcome, self.engine.program(mesh)
        return self.engine.solve(program, place, outcome.w, start, why, outcome)


def _costs_less(found: Solved, other: Solved) -> bool:
    """Whether one is solved, and costs less than another."""
    return found.outcome.success and found.outcome.objective < other.outcome.objective


# ---- the relaxation of valves -------------------------------------------------------------------
# In commands a solver has to cross dead zones without slope, and each is a place to get stuck; in
# openings there is none. What it finds there is transformed back to commands by the exact inverse.
#
# An opening is smoothed at zero, over a thousandth of its range, where closed valves give a little
# back to the supply. Where air is what a motion costs, that would be worth having: there the
# filling and the venting area of each valve are inputs of their own, and that both are open never
# pays.
Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class ValveOpenings:
    """The same problem with openings as inputs, or with filling and venting areas; and the way
    back.
    """

    problem: Problem
    inversion: Inversion

    @classmethod
    def of(cls, plant: Plant, statement: Statement, ways: bool = False) -> ValveOpenings | None:
        """None where the plant has no openings, the statement speaks of commands as openings
        cannot, or the commands are the ways themselves.
        """
        inversion = Inversion(plant)
        if not inversion or not inversion.exact:
            return None
        if ways and all(len(o.commands) > 1 for o in plant.openings):
            return None
        inner = plant.in_ways() if ways else inversion.inner
        try:
            bounds = _bounds(plant, inversion, statement.bounds)
            if bounds is not None and ways:
                bounds = _of_ways(bounds, inversion.inner, inner)
            return cls(formulate(inner, replace(statement, bounds=bounds)), inversion)
        except InputError:  # names or symbols of commands
            return None

    def guess(self, problem: Problem, mesh: Mesh, found: Solution) -> Array:
        """Scaled unknowns of the problem in commands along a solution in openings."""

        def commands(t: Array) -> Array:
            return self.inversion.sent(self._openings(found.inputs(t)))

        sent: Any = commands  # all that is asked of the inputs is their values
        same = replace(found, inputs=sent, peaks=self._peaks(problem, found))
        return from_solution(problem, mesh, same)

    def in_commands(self, program: Program, found: Solved) -> Solved | None:
        """A solution in openings on the same mesh, as one of the program in commands: the same
        motion, with the multipliers of its equations where there are as many; None where inputs
        are not held.
        """
        solution, lam = found.solution, found.outcome.lam_g
        held = solution.inputs.coefficients
        if held.shape[1] > 1:
            return None
        rows = program.nlp["g"].numel()
        if lam.size != rows:  # filling and venting may each have an input, here or there
            lam = np.zeros(rows)
        commands = self.inversion.sent(self._openings(held[:, 0]))
        inputs = PiecewisePolynomial(solution.inputs.breaks, commands[:, None])
        same = replace(solution, inputs=inputs, peaks=self._peaks(program.problem, solution))
        w = program.completed(pack(program.problem, program.mesh, same))
        outcome = replace(found.outcome, w=w, lam_g=lam, lam_x=np.zeros(w.size))
        return Solved(program, outcome, same)

    def _peaks(self, problem: Problem, found: Solution) -> Array:
        """Peaks in commands, and among them the commands that hold the plant where it begins."""
        own, theirs = _holders(problem), _holders(self.problem)
        peaks = np.ones(problem.m.numel())
        others = np.setdiff1d(np.arange(len(peaks)), [*own.values()])
        peaks[others] = np.delete(found.peaks, [*theirs.values()])
        point = self._begins(problem, found) if own.keys() - theirs.keys() else {}
        for (stop, name), at in own.items():
            if (stop, name) in theirs:
                peaks[at] = found.peaks[theirs[stop, name]]
            elif name in point:
                peaks[at] = point[name] / problem.plant.variable(name).nominal
        return peaks

    @staticmethod
    def _begins(problem: Problem, found: Solution) -> dict[str, float]:
        """Inputs under which the plant rests where a motion begins."""
        names = [v.name for v in problem.plant.states]
        begin: dict[str, object] = dict(zip(names, found.states[0], strict=True))
        point = rest_point(problem, begin)
        names = [v.name for v in problem.plant.inputs]
        return {} if point is None else dict(zip(names, point[1], strict=True))

    def _openings(self, inputs: Array) -> Array:
        """Columns of openings from those of their ways."""
        columns = dict(zip([v.name for v in self.problem.plant.inputs], inputs.T, strict=True))
        found = []
        for name in (v.name for v in self.inversion.inner.inputs):
            if name in columns:
                found.append(columns[name])
            else:
                filling, venting = (columns[f"{name}.{way}"] for way in WAYS)
                found.append(filling - venting)
        return np.column_stack(found)


def _holders(problem: Problem) -> dict[tuple[str, str], int]:
    """{(stop, input): its place among the peaks} of what holds the plant."""
    found = {}
    for c in (c for node in problem.nodes for c in node if c.label.endswith(HOLDS)):
        stop, name = c.label.removesuffix(HOLDS).split(": ", 1)
        found[stop, name] = ca.which_depends(c.expression, problem.m, 1, False).index(True)
    return found


def _of_ways(bounds: dict[str, Any], openings: Plant, ways: Plant) -> dict[str, Any]:
    """Bounds of openings said of their ways: the larger of what is left to each."""
    names = {v.name for v in openings.inputs} - {v.name for v in ways.inputs}
    found = {n: pair for n, pair in bounds.items() if n not in names}
    for name in names & set(bounds):
        low, high = bounds[name]
        for way, (least, most) in zip(WAYS, ((low, high), (-high, -low)), strict=True):
            found[f"{name}.{way}"] = (max(least, 0.0), max(most, 0.0))
    return found


def _bounds(plant: Plant, inversion: Inversion, bounds: Any) -> dict[str, Any] | None:
    """The statement's bounds with those of commands said of openings."""
    if bounds is None:
        return None
    commands = {c for o in plant.openings for c in o.commands}
    named = {}
    other = {}
    for name, value in bounds.items():
        inner = name[4:-1] if name.startswith("der(") else name
        full = plant.variable(inner).name
        if full not in commands:
            other[name] = value
        elif inner != name or not isinstance(value, tuple | list) or len(value) != 2:
            raise InputError(f"bounds: {name} cannot be said of an opening")
        else:
            variable = plant.variable(full)
            low, high = value
            named[full] = (
                variable.min if low is None else float(low),
                variable.max if high is None else float(high),
            )
    return {**other, **{n: tuple(v) for n, v in inversion.bounds(named).items()}}
