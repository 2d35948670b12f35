"""Economical motions, from coarse meshes to fine ones, until their objective settles.

What costs work or air is spent on short arcs along the limits of muscles (slack tendons, closed
valves): from a rough guess a fine mesh takes hundreds of iterations or fails, from the solution on
a mesh half as fine some twenty. And inputs that are held cannot follow such arcs: on 50 intervals
the work of an antagonistic pair is 1 to 5 % above its least. So the mesh grows where its held
inputs cost most, see sharpen.py: half the intervals of a mesh that is as fine everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from .problem.problem import Problem
from .result import Solved
from .run import Run
from .sharpen import gains, sharpened
from .solvers.backend import Backend
from .solvers.narrowing import has_kinks
from .stages import stage
from .transcription.mesh import Mesh, coarsened, doubled
from .transcription.transcription import transcribe

__all__ = ["FLOOR", "Climb", "ladder"]

FEWEST = 10
"""Intervals of a leg, on the coarsest mesh."""
MOST = 400
"""Intervals of a leg, at most, on average."""
CLIMBERS = 2
"""Of the coarse mesh's solutions, from different starts: what is best there need not be so in the
end.
"""
WORSE = 0.2
"""Part of the objective by which a climber may lie above another on the same mesh."""
UNSEEN = 2.0
"""Times as much may be gained as the gradients show: where an input swings once more inside its
interval, they know its size by the inputs beside only.
"""
FLOOR = 1e-2
"""Objectives below it (in units of their terms) are judged as if they were this large."""
EFFORT = 6e6
"""Iterations times unknowns of the way, at most: half a minute or so. What has not settled by then
is returned, and says so.
"""
SLOWEST = 0.8
"""Ratio of what two meshes leave to be gained, at most: so slow a geometric row of changes sums to
four times the last. Where inputs matter little the gradients alone see more than there is.
"""
QUICKEST = 0.5
"""The same ratio, at least: meshes that grow little at first seem to gain more quickly than they go
on to.
"""


def ladder(mesh: Mesh) -> list[Mesh]:
    """Meshes from the coarsest to one half as fine as this."""
    found: list[Mesh] = []
    coarse = coarsened(mesh)
    while coarse != mesh and len(coarse.intervals) >= FEWEST * _legs(coarse):
        found.insert(0, coarse)
        mesh, coarse = coarse, coarsened(coarse)
    return found


def _nothing(problem: Problem) -> bool:
    """Whether no motion has an objective below 0: it counts positive work and squares, say, and no
    more.
    """
    goal = problem.objective
    if any(goal.peaks) or not goal.final.is_zero():  # all other weights are >= 0
        return False
    counted = ca.vertcat(*(a.symbol for a in problem.auxiliaries if a.low >= 0))
    if not counted.numel():
        return False
    slopes = ca.jacobian(goal.integrand, counted)
    alone = ca.substitute(goal.integrand, counted, ca.DM.zeros(counted.shape))
    if not slopes.is_constant() or not np.all(np.asarray(ca.DM(slopes)) >= 0):
        return False
    return _square(alone)


def _square(expression: ca.SX) -> bool:
    """Whether an expression is a constant >= 0 and a sum of squares of its symbols."""
    symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(expression))
    curvature, slope = ca.hessian(expression, symbols)
    if not curvature.is_constant():
        return False
    origin = ca.DM.zeros(symbols.shape)
    least, slopes = (ca.DM(ca.substitute(e, symbols, origin)) for e in (expression, slope))
    still = not np.any(np.asarray(slopes)) and float(least) >= 0
    return still and bool(np.all(np.linalg.eigvalsh(np.asarray(ca.DM(curvature))) >= 0))


def _legs(mesh: Mesh) -> int:
    return 1 + mesh.intervals[-1].leg


@dataclass
class Climb:
    """From a solution on a mesh to finer ones.

    iterations : of the solver on the way; effort : the same times the unknowns. change : of the
    objective with the last step; gap : what finer meshes may yet gain, an estimate; both as parts
    of the objective. rungs : solutions on the way from the first that was to settle, the last the
    finest.
    """

    backend: Backend
    iterations: int = 0
    effort: float = 0.0
    change: float = float("nan")
    gap: float = float("nan")
    rungs: list[Solved] = field(default_factory=list)
    directly: bool = False
    """Whether kinks stay as they are from a mesh to the next: to lead each solution along the path
    of their roundings takes more than the whole climb.
    """
    _best: dict[int, float] = field(default_factory=dict)
    """The least objective by the number of intervals."""
    _pace: float = float("nan")
    """The last change, or what the ones before it let expect where that is more."""

    def reached(
        self,
        search: Callable[[Run], list[Solved]],
        run: Run,
        meshes: list[Mesh],
        partly: bool,
    ) -> list[Solved]:
        """Solutions on the mesh of ``run``, from a search on the first of coarser ones, the best
        first; empty where the way is blocked.

        partly : where no way leads there, the solution on the finest mesh that was reached.
        """
        problem = run.program.problem
        first = Run(transcribe(problem, meshes[0]), self.backend)
        with stage("coarse meshes", "from few intervals to many"):
            return self._climbed(search(first), run, meshes, partly)

    def _climbed(
        self, starts: list[Solved], run: Run, meshes: list[Mesh], partly: bool
    ) -> list[Solved]:
        problem = run.program.problem
        found = [each for each in starts if each.outcome.ended]
        runs = [*(Run(transcribe(problem, mesh), self.backend) for mesh in meshes[1:]), run]
        top: list[Solved] = []
        last: list[Solved] = []
        for each in found:
            here = each
            for following in runs:
                finer = self._onward(following, here)
                if finer is None:
                    break
                here = finer
                if self._hopeless(here):
                    break
            last.append(here)
            if here.program is run.program:
                top.append(here)
            if len(top) == CLIMBERS or self.effort > EFFORT / 2:
                break
        if not top and last and (partly or last[0].outcome.stopped):
            return [max(last, key=lambda each: len(each.program.mesh.intervals))]
        return sorted(top, key=lambda each: each.outcome.objective)

    def settled(self, found: Solved, tolerance: float) -> Solved:
        """The solution on finer and finer meshes, until they can gain no more than this."""
        self.rungs = [found]
        self.gap = self.change = self._pace = float("nan")
        self.directly = has_kinks(found.program.problem)
        before, bounded = float("nan"), _nothing(found.program.problem)
        while not self.gap <= tolerance and not found.outcome.stopped:
            gained = gains(found)
            left = float("nan") if gained is None else self._part(float(gained.sum()), found)
            self._estimate(left, before)
            if bounded:  # no more can be gained than there is
                self.gap = float(np.fmin(self.gap, self._part(found.outcome.objective, found)))
            if self.gap <= tolerance:
                break
            mesh = sharpened(found.program.mesh, gained)
            with stage("objective", f"finer meshes may lower it by {100 * self.gap:.2g} %"):
                finer = self._on(mesh, found)
                if finer is None and gained is not None and self.effort < EFFORT / 2:
                    finer = self._on(doubled(found.program.mesh), found)
            if finer is None:
                break
            self.change = self._part(abs(finer.outcome.objective - found.outcome.objective), finer)
            found, before = finer, left
            self.rungs.append(found)
        return found

    def follow(self, other: Climb) -> None:
        """From here on what another climb settled on is what counts."""
        self.rungs, self.gap, self.change = other.rungs, other.gap, other.change

    def above(self, found: Solved) -> float:
        """What a solution may lie above the least, as a part of the objective: by what finer meshes
        may gain, and by the best that was found.
        """
        return self.gap + max(self.worse(found), 0.0)

    def inexact(self, found: Solved, replayed: float) -> float:
        """What the replayed motion's objective differs from a solution's, as a part of it: costs
        are counted at the points of the mesh, and may be others between them.
        """
        return self._part(abs(replayed - found.outcome.objective), found)

    def worse(self, found: Solved) -> float:
        """By how much a solution lies above the finest, as a part of the objective."""
        best = self.rungs[-1]
        return self._part(found.outcome.objective - best.outcome.objective, best)

    def _part(self, value: float, found: Solved) -> float:
        """A value as a part of the objective."""
        return value / max(abs(found.outcome.objective), FLOOR)

    def _estimate(self, left: float, before: float) -> None:
        """What is to be gained: by the gradients (``left``; ``before`` on the mesh before), or by
        a geometric row of changes (Richardson), whichever is less.

        Without gradients each change is taken as half of the one before it. A change that is less
        than the row says is luck.
        """
        ratio = left / before if np.isfinite(left / before) else QUICKEST
        ratio = min(max(ratio, QUICKEST), SLOWEST)
        self._pace = float(np.fmax(self.change, ratio * self._pace))
        row = self._pace * ratio / (1 - ratio)
        known = [value for value in (UNSEEN * left, row) if np.isfinite(value)]
        self.gap = min(known) if known else float("nan")

    def _hopeless(self, found: Solved) -> bool:
        """Whether another climber was much better on a mesh of this size."""
        size, value = len(found.program.mesh.intervals), found.outcome.objective
        best = min(self._best.get(size, value), value)
        self._best[size] = best
        return value - best > WORSE * max(abs(best), FLOOR)

    def _onward(self, run: Run, coarse: Solved) -> Solved | None:
        """The solution on a finer mesh, by way of one between where the step is too long."""
        found = self._next(run, coarse)
        if found is not None or coarse.outcome.stopped:
            return found
        between = self._on(sharpened(coarse.program.mesh, gains(coarse)), coarse)
        return None if between is None else self._next(run, between)

    def _on(self, mesh: Mesh, coarse: Solved) -> Solved | None:
        """The solution on this mesh; None where it is too fine, or was not found."""
        if len(mesh.intervals) > MOST * _legs(mesh) or self.effort > EFFORT:
            return None
        return self._next(Run(transcribe(coarse.program.problem, mesh), self.backend), coarse)

    def _next(self, run: Run, coarse: Solved) -> Solved | None:
        """The solution on a finer mesh; None when it was not found."""
        if coarse.outcome.stopped:
            return None
        found = run.directly(coarse) if self.directly else run.refined(coarse, again=False)
        self.iterations += found.outcome.iterations
        self.effort += found.outcome.iterations * len(found.outcome.w)
        return found if found.outcome.success else None
