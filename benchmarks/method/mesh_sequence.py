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

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from method.candidate import Candidate
from method.settings import Settings
from pam_ocp.planning.checked import Checked
from pam_ocp.planning.problem.problem import Problem
from pam_ocp.planning.sharpen import gains
from pam_ocp.planning.transcription.mesh import (
    Interval,
    Mesh,
    coarsened,
    doubled,
    halved,
    held,
    merged,
    refined,
    watched,
)

__all__ = ["MeshSequence"]

Array: TypeAlias = NDArray[np.float64]

RATIO = 0.5, 0.8
"""What a mesh leaves of the gain of the one before: at least (small first steps seem to gain
quickly) and at most (a geometric row then sums to four times its last change).
"""
UNSEEN = 2.0
"""Times as much may be gained as first-order gradients show."""
FLOOR = 1e-2
"""Objectives below it (in units of their terms) are judged as if they were this large."""


class MeshSequence:
    """Meshes for one problem, to a tolerance (None: the one that was asked for, alone)."""

    def __init__(
        self, asked: Mesh, problem: Problem, settings: Settings, tolerance: float | None
    ) -> None:
        self.asked, self.problem, self.settings = asked, problem, settings
        self.tolerance = np.inf if tolerance is None else settings.aim * tolerance
        self.wanted = np.inf if tolerance is None else tolerance
        self.legs = len(problem.legs)
        self.economical = problem.objective.economical
        self.ladder = self._ladder()

    def _ladder(self) -> list[Mesh]:
        """Meshes up to the one that was asked for."""
        s, found = self.settings, [self.asked]
        each = len(self.asked.intervals) // self.legs
        if self.economical:
            while True:
                coarse = coarsened(found[0])
                if coarse == found[0] or len(coarse.intervals) < s.coarsest * self.legs:
                    return found
                found.insert(0, coarse)
        if each >= s.many and self.asked.form.scheme != "shooting":
            found.insert(0, merged(self.asked, -(-each // s.few)))
        return found

    def begin(self, mesh: Mesh) -> None:
        """Let the sequence begin with this mesh."""
        finer = [m for m in self.ladder if len(m.intervals) > len(mesh.intervals)]
        self.ladder = [mesh, *(finer or ([] if mesh == self.asked else [self.asked]))]

    @property
    def resolving(self) -> bool:
        """Whether finer meshes leave the inputs as they are: then the way is resolved, too."""
        form = self.asked.form
        return form.control == "constant" and form.scheme != "shooting"

    def after(self, c: Candidate, nonsmooth: bool) -> list[tuple[Mesh, str]]:
        """Meshes that may do better and why, the most promising first; none where this one does."""
        if c.mesh in self.ladder[:-1]:
            following = self.ladder[self.ladder.index(c.mesh) + 1]
            return [(following, "towards the mesh asked for"), (doubled(c.mesh), "between")]
        if not np.isfinite(self.wanted):
            return []
        for find in (self._unresolved, self._dear, self._inexact):
            meshes = find(c, nonsmooth)
            if meshes:
                most = len(c.mesh.intervals) + self.settings.more_intervals
                return [
                    (mesh, why)
                    for mesh, why in meshes
                    if mesh != c.mesh and len(mesh.intervals) <= most
                ]
        return []

    def _unresolved(self, c: Candidate, nonsmooth: bool) -> list[tuple[Mesh, str]]:
        """The dynamics at large, on the way and wherever costs are still to be looked at."""
        total, allowed = sum(c.errors), self.settings.resolved
        if total <= allowed or not self.resolving or not (c.place < 1.0 or self.economical):
            return []
        finer = refined(c.mesh, c.errors, allowed / len(c.errors), nonsmooth)
        return [(finer, f"dynamics unresolved by {total:.1g}")]

    # ---- the objective --------------------------------------------------------------------------
    def _dear(self, c: Candidate, nonsmooth: bool) -> list[tuple[Mesh, str]]:
        if not self.economical or c.place < 1.0:
            return []
        gap = self.gap(c)
        if gap <= self.wanted:
            return []
        if len(c.mesh.intervals) > self.settings.finest * self.legs:
            return []
        mesh = self._split(c.mesh, self.gained(c))
        return [(mesh, f"objective may fall by {100 * gap:.2g} %")]

    def gained(self, c: Candidate) -> Array | None:
        """Of each interval, what its inputs keep the objective from."""
        if "gained" not in c.__dict__:
            c.__dict__["gained"] = gains(c.solved)
        found: Array | None = c.__dict__["gained"]
        return found

    def gap(self, c: Candidate) -> float:
        """What finer meshes may gain, as a part of the objective: by the gradients, or by a
        geometric row of the changes so far (Richardson), whichever is less.
        """
        left, pace = self._left(c), self._pace(c)
        before = float("nan") if c.coarser is None else self._left(c.coarser)
        ratio = self._ratio(left, before)
        row = pace * ratio / (1 - ratio)
        known = [v for v in (UNSEEN * left, row) if np.isfinite(v)]
        if abs(c.objective) < FLOOR:  # work and air are never negative
            known.append(abs(c.objective) / FLOOR)
        return min(known) if known else float("inf")

    def _left(self, c: Candidate) -> float:
        gained = self.gained(c)
        return float("nan") if gained is None else float(gained.sum()) / scale(c)

    def _pace(self, c: Candidate) -> float:
        """The last change of the objective, or what those before it let expect where that is more:
        a change that is less is luck.
        """
        if c.coarser is None or c.coarser.place != c.place:
            return float("nan")
        change = abs(c.objective - c.coarser.objective) / scale(c)
        ratio = self._ratio(self._left(c), self._left(c.coarser))
        return float(np.fmax(change, ratio * self._pace(c.coarser)))

    @staticmethod
    def _ratio(left: float, before: float) -> float:
        ratio = left / before if before > 0 else float("nan")
        return float(np.clip(ratio, *RATIO)) if np.isfinite(ratio) else RATIO[0]

    def _split(self, mesh: Mesh, gained: Array | None) -> Mesh:
        """Those intervals split in two that keep back ``marked`` of what is to be gained; all where
        nothing is known of it.
        """
        if gained is None or not np.isfinite(gained).all() or not gained.sum() > 0:
            return doubled(mesh)
        order = np.argsort(gained)[::-1]
        part = self.settings.marked * gained.sum()
        chosen = set(order[: 1 + int(np.searchsorted(np.cumsum(gained[order]), part))].tolist())
        intervals: list[Interval] = []
        for k, interval in enumerate(mesh.intervals):
            own = replace(interval, watched=())
            intervals += own.split(2, interval.degree) if k in chosen else [own]
        return Mesh(tuple(intervals), mesh.form)

    # ---- the plan's tolerance -------------------------------------------------------------------
    def _inexact(self, c: Candidate, nonsmooth: bool) -> list[tuple[Mesh, str]]:
        if c.place < 1.0 or c.check.miss <= self.tolerance:
            return []
        s, mesh, check = self.settings, c.mesh, c.check
        if mesh.form.control == "polynomial" and c.rounds >= s.polynomial_rounds:
            return [(held(self.asked), "polynomial inputs do not meet the tolerance")]
        if c.rounds >= s.rounds:
            return []
        beyond = check.replay.beyond
        why = f"tolerance missed by {check.miss:.1g}"
        by_limits = [(watched(mesh, beyond, self.tolerance), why)] if beyond else []
        everywhere = [(halved(mesh), why)]
        if mesh.form.control == "constant":
            everywhere.insert(0, (halved(mesh, joined=True), why))
        if dynamic(check) <= self.tolerance:
            worst = [max(each.values(), default=0.0) for each in beyond]
            # where checks between the points make the program unsolvable, shorter intervals may do
            return [*by_limits, (refined(mesh, worst, self.tolerance, nonsmooth), why), *everywhere]
        total = sum(c.errors)
        # errors of intervals add up, and may grow along the motion; stops may see more of them
        grown = (
            max(1.0, dynamic(check) / total) if np.isfinite(dynamic(check)) and total > 0 else 1.0
        )
        allowed = self.tolerance / len(c.errors) / grown
        return [(refined(mesh, c.errors, allowed, nonsmooth), why), *by_limits, *everywhere]


def scale(c: Candidate) -> float:
    """What parts of an objective are parts of."""
    return max(abs(c.objective), FLOOR)


def dynamic(check: Checked) -> float:
    """What a motion that is more exact would mend."""
    return max(check.replay.error, check.replay.missed)
