"""Economical motions, from coarse meshes to fine ones, until their objective settles.

What costs work or air is spent on short arcs along the limits of muscles (slack tendons, closed
valves): from a rough guess a fine mesh takes hundreds of iterations or fails, from the solution on
a mesh half as fine some twenty. And inputs that are held cannot follow such arcs: on 50 intervals
the work of an antagonistic pair is 1 to 5 % above its least.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .result import Solved
from .run import Run
from .solvers.backend import Backend
from .transcription.mesh import Mesh, coarsened, doubled
from .transcription.transcription import transcribe

__all__ = ["Climb", "ladder"]

FEWEST = 10
"""Intervals of a leg, on the coarsest mesh."""
MOST = 400
"""Intervals of a leg, at most."""
CLIMBERS = 2
"""Of the coarse mesh's solutions, from different starts: what is best there need not be so in the
end.
"""
FLOOR = 1e-2
"""Objectives below it (in units of their terms) are judged as if they were this large."""


def ladder(mesh: Mesh) -> list[Mesh]:
    """Meshes from the coarsest to one half as fine as this."""
    found: list[Mesh] = []
    coarse = coarsened(mesh)
    while coarse != mesh and len(coarse.intervals) >= FEWEST * _legs(coarse):
        found.insert(0, coarse)
        mesh, coarse = coarse, coarsened(coarse)
    return found


def _legs(mesh: Mesh) -> int:
    return 1 + mesh.intervals[-1].leg


@dataclass
class Climb:
    """From a solution on a mesh to finer ones.

    iterations : of the solver on the way; change : of the objective with the last step, as a part
    of it.
    """

    backend: Backend
    iterations: int = 0
    change: float = float("nan")

    def reached(
        self, search: Callable[[Run], list[Solved]], run: Run, meshes: list[Mesh]
    ) -> list[Solved]:
        """Solutions on the mesh of ``run``, from a search on the first of coarser ones; empty where
        the way is blocked.
        """
        problem = run.program.problem
        first = Run(transcribe(problem, meshes[0]), self.backend)
        found = search(first)
        runs = [Run(transcribe(problem, mesh), self.backend) for mesh in meshes[1:]]
        top = []
        for each in found:
            if not each.outcome.ended:
                continue
            here: Solved | None = each
            for following in (*runs, run):
                here = here and self._next(following, here)
            if here is not None:
                top.append(here)
            if len(top) == CLIMBERS:
                break
        return sorted(top, key=lambda each: each.outcome.objective)

    def settled(self, found: Solved, tolerance: float) -> Solved:
        """The solution on meshes twice as fine each, until the objective changes by no more."""
        while not self.change <= tolerance:
            mesh = doubled(found.program.mesh)
            if len(mesh.intervals) > MOST * _legs(mesh):
                break
            run = Run(transcribe(found.program.problem, mesh), self.backend)
            finer = self._next(run, found)
            if finer is None:
                break
            old, new = found.outcome.objective, finer.outcome.objective
            self.change = abs(new - old) / max(abs(new), FLOOR)
            found = finer
        return found

    def _next(self, run: Run, coarse: Solved) -> Solved | None:
        """The solution on a finer mesh; None when it was not found."""
        if coarse.outcome.stopped:
            return None
        found = run.refined(coarse, again=False)
        self.iterations += found.outcome.iterations
        return found if found.outcome.success else None
