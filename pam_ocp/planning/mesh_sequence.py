"""Which mesh follows which: from coarse to the one asked for, and on where one estimate asks for
more.

The estimate counts, in this order, what a mesh lacks: the dynamics at large (sum of the intervals'
errors against a tight integration, above ``resolved``), the objective (what its inputs keep it
from, by the gradients of the Lagrangian: Pontryagin's switching function), then the plan's
tolerance, of dynamics (simulation error as in A. A. Haman, A. V. Rao, AIAA J. Guid. Control Dyn.
2024) and of limits between points. Where errors are smooth degrees are raised, else intervals are
split (ph: M. A. Patterson, W. W. Hager, A. V. Rao, Optim. Control Appl. Methods 36 (2015) 398-421).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .candidate import Candidate
from .problem.problem import Problem, is_nonnegative
from .settings import Settings
from .solvers.solver import SETTLED
from .transcription.mesh import (
    Interval,
    Mesh,
    coarsened,
    doubled,
    doubled_at_most,
    halved,
    held,
    merged,
    watched,
)
from .transcription.transcription import is_nonsmooth

Array: TypeAlias = NDArray[np.float64]

RATIO = 0.8
"""Of errors of the objective from mesh to mesh, at most: where few intervals were split, theirs
count.
"""
UNSEEN = 2.0
"""Times as much may be gained as first-order gradients show."""
LEAST_CAME = 0.1
"""Of what gradients promised of the mesh before, at least: that nothing came may be luck."""


class MeshSequence:
    """Meshes for one problem, to a tolerance (None: the one that was asked for, alone).

    merges : whether many intervals are reached from few.
    """

    def __init__(
        self,
        asked: Mesh,
        problem: Problem,
        settings: Settings,
        tolerance: float | None,
        merges: bool = True,
    ) -> None:
        self.asked, self.problem, self.settings = asked, problem, settings
        self.nonsmooth = is_nonsmooth(problem)
        aim = np.inf if tolerance is None else settings.aim * tolerance
        self.tolerance, self.wanted = max(aim, settings.exact), aim / settings.aim
        self.legs = len(problem.legs)
        self.economical = problem.objective.economical
        self._bounded = self.economical and is_nonnegative(problem)
        self.ladder = self._ladder(merges)

    def aims_at(self, tolerance: float) -> None:
        """Another tolerance of the plan."""
        self.tolerance = max(tolerance, self.settings.exact)
        self.wanted = max(tolerance, self.wanted)

    def _ladder(self, merges: bool) -> list[Mesh]:
        """Meshes up to the one that was asked for."""
        s, found = self.settings, [self.asked]
        each = len(self.asked.intervals) // self.legs
        if self.economical:
            while True:
                coarse = coarsened(found[0])
                if coarse == found[0] or len(coarse.intervals) < s.coarsest * self.legs:
                    return found
                found.insert(0, coarse)
        if merges and each >= s.many and self.asked.form.scheme != "shooting":
            found.insert(0, merged(self.asked, -(-each // s.few)))
        return found

    def is_coarse(self, mesh: Mesh) -> bool:
        """Whether a mesh is one on the way to the one that was asked for."""
        return mesh in self.ladder[:-1]

    @property
    def resolving(self) -> bool:
        """Whether finer meshes leave the inputs as they are: then the way is resolved, too."""
        form = self.asked.form
        return form.control == "constant" and form.scheme != "shooting"

    def after(self, c: Candidate, costs: bool = True) -> list[tuple[Mesh, str]]:
        """Meshes that may do better and why, the most promising first; none where this one does.

        costs : whether the objective is to be refined, too.
        """
        if self.is_coarse(c.mesh):
            following = self.ladder[self.ladder.index(c.mesh) + 1]
            between = doubled(c.mesh)
            others = [(between, "between")] if between != following else []
            return [(following, "towards the mesh asked for"), *others]
        if not np.isfinite(self.wanted):
            return []
        finds = (self._unresolved, self._dear, self._inexact) if costs else (self._inexact,)
        for find in finds:
            meshes = find(c)
            if meshes:
                return [(mesh, why) for mesh, why in meshes if mesh != c.mesh]
        return []

    def _refined(self, c: Candidate, errors: Sequence[float], allowed: float) -> Mesh:
        return doubled_at_most(c.mesh, errors, allowed, self.nonsmooth, self.settings.points)

    def _unresolved(self, c: Candidate) -> list[tuple[Mesh, str]]:
        """The dynamics at large, on the way and wherever costs are still to be looked at."""
        if not self.resolving or not (c.place < 1.0 or self.economical):
            return []
        total, allowed = sum(c.errors), self.settings.resolved
        if total <= allowed:
            return []
        finer = self._refined(c, c.errors, allowed / 2 / len(c.errors))
        return [(finer, f"dynamics unresolved by {total:.1g}")]

    # ---- the objective --------------------------------------------------------------------------
    def is_dear(self, c: Candidate) -> bool:
        """Whether finer meshes may lower the objective by more than the plan's tolerance."""
        if not self.economical or c.place < 1.0 or not np.isfinite(self.wanted):
            return False
        few = len(c.mesh.intervals) <= self.settings.finest * self.legs
        return few and not self.gap(c) <= self.wanted

    def _dear(self, c: Candidate) -> list[tuple[Mesh, str]]:
        if not self.is_dear(c):
            return []
        mesh = self.split(c.mesh, c.gains, self.settings)
        return [(mesh, f"objective may fall by {100 * self.gap(c):.2g} %")]

    def gap(self, c: Candidate) -> float:
        """What finer meshes may gain, as a part of the objective: by the gradients, in so far as
        they held before, or by the changes so far (Richardson), whichever is less.
        """
        if c.gap is not None:
            return c.gap
        left = UNSEEN * self._left(c) * self._came(c)
        known = [v for v in (left, self._extrapolated(c)) if np.isfinite(v)]
        if self._bounded:  # no more can be gained than there is
            known.append(c.objective / c.scale)
        return min(known) if known else float("inf")

    def _left(self, c: Candidate) -> float:
        gained = c.gains
        return float("nan") if gained is None else float(gained.sum()) / c.scale

    def _came(self, c: Candidate) -> float:
        """How much came of what the gradients promised of the intervals that were split (an index
        of effectivity), at most all; where both meshes' costs are at their least.
        """
        before, s = c.coarser, self.settings
        if before is None or SETTLED in (c.solved.outcome.status, before.solved.outcome.status):
            return 1.0
        promised = s.marked * self._left(before)
        if not promised > 0 or sum(before.errors) > s.resolved or before.place < 1.0:
            return 1.0
        if self.split(before.mesh, before.gains, s) != c.mesh:
            return 1.0
        came = (before.objective - c.objective) / c.scale / promised
        return float(np.clip(came, LEAST_CAME, 1.0))

    @staticmethod
    def change(c: Candidate) -> float:
        """Of the objective from the mesh before, as a part of it."""
        if c.coarser is None or c.coarser.place != c.place:
            return float("nan")
        return abs(c.objective - c.coarser.objective) / c.scale

    def _extrapolated(self, c: Candidate) -> float:
        """The error of the objective by its last change, which is e (1 - r) / r where r = e / e of
        the mesh before. With held inputs r is the ratio of the intervals (first order, as at
        switches), or its square (second, along smooth arcs): a change that is less than that lets
        expect is luck. Of what a mesh costs that does not resolve the dynamics nothing follows.
        """
        change = self.change(c)
        if c.coarser is None or np.isnan(change) or sum(c.coarser.errors) > self.settings.resolved:
            return float("nan")
        ratio = min(len(c.coarser.mesh.intervals) / len(c.mesh.intervals), RATIO)
        row = change * ratio / (1 - ratio)
        return float(np.fmax(row, ratio**2 * self._extrapolated(c.coarser)))

    @staticmethod
    def split(mesh: Mesh, gained: Array | None, settings: Settings) -> Mesh:
        """Those intervals split in two that keep back ``marked`` of what is to be gained; all where
        nothing is known of it.
        """
        if gained is None or not np.isfinite(gained).all() or not gained.sum() > 0:
            return doubled(mesh)
        order = np.argsort(gained)[::-1]
        part = settings.marked * gained.sum()
        chosen = set(order[: 1 + int(np.searchsorted(np.cumsum(gained[order]), part))].tolist())
        intervals: list[Interval] = []
        for k, interval in enumerate(mesh.intervals):
            own = replace(interval, watched=())
            intervals += own.split(2, interval.degree) if k in chosen else [own]
        return Mesh(tuple(intervals), mesh.form)

    def _miscounted(self, c: Candidate) -> bool:
        """Whether costs, which are counted at the points of the mesh, are others between them."""
        if not self.economical:
            return False
        apart = abs(c.check.replay.objective - c.objective) / c.scale
        return bool(np.isfinite(apart) and apart > self.wanted)

    # ---- the plan's tolerance -------------------------------------------------------------------
    @staticmethod
    def _stalls(c: Candidate) -> bool:
        """Whether limits that are watched on the same intervals are missed by as much as before."""
        before = c.coarser
        if before is None or before.place < 1.0:
            return False
        same = [i.fraction for i in before.mesh.intervals] == [i.fraction for i in c.mesh.intervals]
        return same and c.check.miss > before.check.miss / 2

    def _inexact(self, c: Candidate) -> list[tuple[Mesh, str]]:
        if c.place < 1.0 or (c.check.miss <= self.tolerance and not self._miscounted(c)):
            return []
        s, mesh, check = self.settings, c.mesh, c.check
        if mesh.form.control == "polynomial" and c.rounds >= s.polynomial_rounds:
            return [(held(self.asked), "polynomial inputs do not meet the tolerance")]
        if c.rounds >= s.rounds:
            return []
        beyond = check.replay.beyond
        why = f"tolerance missed by {check.miss:.1g}"
        near = beyond and not self._stalls(c)
        by_limits = [(watched(mesh, beyond, self.tolerance), why)] if near else []
        everywhere = [(halved(mesh), why)]
        if mesh.form.control == "constant":
            everywhere.insert(0, (halved(mesh, joined=True), why))
        if check.miss <= self.tolerance:
            return [(finer, "costs between its points are others") for finer, _ in everywhere]
        if check.dynamic <= self.tolerance:
            worst = [max(each.values(), default=0.0) for each in beyond]
            # where checks between the points make the program unsolvable, shorter intervals may do
            finer = self._refined(c, worst, self.tolerance)
            return [*by_limits, (finer, why), *everywhere]
        total, worst_of_all = sum(c.errors), check.dynamic
        # errors of intervals add up, and may grow along the motion; waypoints may see more of them
        known = np.isfinite(worst_of_all) and total > 0
        grown = max(1.0, worst_of_all / total) if known else 1.0
        finer = self._refined(c, c.errors, self.tolerance / len(c.errors) / grown)
        return [(finer, why), *by_limits, *everywhere]
