"""What a search has found, brought to the plan's tolerance: settled, refined, and looked at again.

Economical motions settle on finer meshes before they are refined. Where refinement then makes them
dearer, the meshes before did not resolve the motion.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..core.stop import TimeIsUp, spared
from .approach import resolvable
from .checked import checked
from .climb import Climb
from .refine import CLOSER, Refinement
from .result import Solved
from .run import Run
from .search import Search
from .solvers.narrowing import has_kinks
from .stages import stage
from .transcription.mesh import doubled
from .transcription.transcription import transcribe

__all__ = ["Settling"]

GRACE = 1.0
"""Seconds for the replay of a solution that was found when the time was up."""

MISLED = 1e-2
"""Part of the objective by which refinement may make an economical motion dearer, before its mesh
is held too coarse to have led anywhere.
"""
FINEST = 200
"""Intervals of a leg on which is sought again, at most."""
OTHERS = 3
"""Solutions from different starts that are refined, at most, where the best cannot be verified."""


@dataclass(frozen=True)
class Settling:
    """Of what one search has found; its climb goes on here."""

    search: Search

    def brought(self, found: list[Solved]) -> Refinement:
        """The best of solutions, settled where economical, and refined."""
        program, climb = self.search.run.program, self.search.climb
        base = found[0]
        if program.problem.objective.economical and self.search.tolerance is not None:
            with contextlib.suppress(TimeIsUp):
                found = [climb.settled(base, self.search.tolerance), *found[1:]]
        refinement = self._refined(found)
        meshes, first = refinement.meshes, refinement.first
        if any(first is each for each in climb.rungs[1:]):
            first, meshes = base, [base.program.mesh, *meshes]
        if resolvable(program) and meshes[0] != program.mesh:  # kinks were approached on finer ones
            meshes = [program.mesh, *meshes]
        refinement.meshes, refinement.first = meshes, first
        return refinement

    def resolved(self, refinement: Refinement) -> Refinement:
        """Where refinement made an economical motion another, settled and refined once more; where
        it made it dearer by ``MISLED``, sought on meshes twice as fine as well.

        Coarse meshes that do not resolve a motion have optima of their own, which cost less than
        any motion does, and may lie elsewhere.
        """
        found, climb, tolerance = refinement.best.found, self.search.climb, self.search.tolerance
        if tolerance is None or not climb.rungs or has_kinks(found.program.problem):
            return refinement
        dearer = climb.worse(found)
        if not refinement.met() or dearer <= tolerance:
            return refinement
        try:
            if dearer > MISLED:
                refinement = self._with_finer(refinement)
            return self._resettled(refinement, tolerance)
        except TimeIsUp:
            return refinement

    def _with_finer(self, refinement: Refinement) -> Refinement:
        """The better of this and of what a search on a mesh twice as fine comes to."""
        run, climb = self.search.run, self.search.climb
        mesh = doubled(run.program.mesh)
        if len(mesh.intervals) > FINEST * len(run.program.problem.legs):
            return refinement
        finer = Run(transcribe(run.program.problem, mesh), run.backend)
        own = replace(self.search, run=finer, climb=Climb(run.backend), figures={})
        with stage("second search", "refinement made the motion dearer: on twice the intervals"):
            found = own.found(None)
        if not found[0].outcome.success:
            return refinement
        settling = Settling(own)
        other = settling.resolved(settling.brought(found))
        climb.iterations += own.climb.iterations
        if not _less(other, refinement):
            return refinement
        climb.follow(own.climb)
        return refinement.followed_by(other)

    def _resettled(self, refinement: Refinement, tolerance: float) -> Refinement:
        """Settled from its own mesh, and refined again."""
        found, climb = refinement.best.found, self.search.climb
        if climb.worse(found) <= tolerance:
            return refinement
        own = Climb(self.search.run.backend)
        finer = own.settled(found, tolerance)
        climb.iterations += own.iterations
        climb.follow(own)
        if finer is found:
            return refinement
        again = Refinement(checked(finer), tolerance, self.search.run.backend)
        return refinement.followed_by(again) if _less(again, refinement) else refinement

    def _refined(self, found: Sequence[Solved]) -> Refinement:
        """The best solution, refined; where that is not verified, the next best that is.

        Of the climb's solutions a coarser one stands before a finer one that is no better and not
        verified, and before all that cannot be.
        """
        wanted, climb = self.search.tolerance or float("inf"), self.search.climb
        try:
            finest = checked(found[0])
        except TimeIsUp:
            with spared(GRACE):
                finest = checked(found[0])
        if finest.miss > CLOSER * wanted:
            with contextlib.suppress(TimeIsUp):
                for each in climb.rungs[-2::-1]:
                    if climb.worse(each) > wanted:
                        break
                    if (other := checked(each)).miss <= CLOSER * wanted:
                        return Refinement(other, wanted, self.search.run.backend)
        first = Refinement(finest, wanted, self.search.run.backend)
        if first.met():
            return first
        with contextlib.suppress(TimeIsUp):
            for other in map(checked, climb.rungs[-2::-1]):
                if other.miss <= CLOSER * wanted:
                    return Refinement(other, wanted, self.search.run.backend)
        tried = [first]
        for each in found[1:OTHERS]:
            try:
                tried.append(Refinement(checked(each), wanted, self.search.run.backend))
            except TimeIsUp:
                break
            if tried[-1].met():
                break
        return min(tried, key=lambda refinement: refinement.best.miss)


def _less(one: Refinement, other: Refinement) -> bool:
    """Whether a refinement that is met is less dear than another."""
    costs = [each.best.found.outcome.objective for each in (one, other)]
    return one.met() and costs[0] < costs[1]
