"""From a candidate with wide smoothing on a coarse mesh to the plan: one walk along one path.

At each place of the path the mesh is refined until it resolves the motion, then the path goes on
from the multipliers; at its end the mesh is refined to the plan's tolerance. A mesh that does not
resolve a nonsmooth term has optima of its own, which move as the smoothing narrows: there a solver
takes hundreds of iterations from one place to the next, or fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from method.candidate import Candidate, Engine
from method.mesh_sequence import MeshSequence
from pam_ocp.planning.result import Solved
from pam_ocp.planning.solvers.ipopt_options import Start
from pam_ocp.planning.solvers.narrowing import has_kinks
from pam_ocp.planning.transcription.mesh import Mesh

__all__ = ["Continuation"]


class Continuation:
    """Leads candidates to the end; ``taken`` is called with each that solves the user's own
    problem.

    work : of the engine at which it ends.
    """

    def __init__(
        self, engine: Engine, meshes: MeshSequence, taken: Callable[[Candidate], None]
    ) -> None:
        self.engine, self.meshes, self.taken = engine, meshes, taken
        self.nonsmooth = has_kinks(engine.first.problem)
        self.settings = engine.settings
        self.failure: Solved | None = None
        """The last solve that failed."""

    def raised(self, c: Candidate) -> Candidate:
        """At its place, on the mesh that was asked for; on the finest that leads to a solution."""
        while c.mesh in self.meshes.ladder[:-1]:
            finer = self._finer(c, self.meshes.after(c, self.nonsmooth))
            if finer is None:
                return c
            c = finer
        return c

    def led(self, c: Candidate) -> Candidate | None:
        """The last candidate at the end of the path; None where it is blocked before."""
        s, step = self.settings, self.settings.step
        most, blocked, reentered = self.engine.work + s.work, False, False
        while self.engine.work <= most:
            if c.place == 1.0 and (blocked or c.mesh not in self.meshes.ladder[:-1]):
                self.taken(c)
            meshes = [] if blocked else self.meshes.after(c, self.nonsmooth)
            if meshes:
                finer = self._finer(c, meshes)
                if finer is None and c.place == 1.0 and self.nonsmooth and not reentered:
                    finer, reentered = self._reentered(c, meshes[0]), True
                blocked = finer is None
                c = finer or c
                continue
            if c.place >= 1.0:
                return c
            there = min(1.0, c.place + step)
            further = self._further(c, there)
            if further is not None:
                c, step, blocked = further, min(s.step, s.grow * step), False
                continue
            step *= s.shrink
            if step < s.least_step:
                return None
        return c if c.place >= 1.0 else None

    def _finer(self, c: Candidate, meshes: list[tuple[Mesh, str]]) -> Candidate | None:
        """On the first of some meshes that leads to a solution."""
        for mesh, why in meshes:
            found = self.engine.refined(c.solved, mesh, c.place, ("mesh", why))
            if found.outcome.success:
                rounds = c.rounds + (c.place == 1.0)
                return replace(c, solved=found, coarser=c, rounds=rounds)
            self.failure = found
            if found.outcome.stopped:
                return None
        return None

    def _further(self, c: Candidate, there: float) -> Candidate | None:
        """At the next place of the path, from the multipliers of this one."""
        outcome, why = c.solved.outcome, ("smoothing", f"place {there:.2f} of the path")
        start: Start = "along" if there < 1.0 else "last"
        found = self.engine.solve(c.mesh, there, outcome.w, start, why, outcome)
        if not found.outcome.success:
            self.failure = found
            return None
        return replace(c, solved=found, place=there, coarser=None)

    def _reentered(self, c: Candidate, finer: tuple[Mesh, str]) -> Candidate | None:
        """On a finer mesh by way of wider smoothing, where it is not solved at once."""
        mesh, place = finer[0], self.settings.reentry
        why = ("smoothing", f"back to place {place:.2f} of the path on a finer mesh")
        found = self.engine.refined(c.solved, mesh, place, why)
        if not found.outcome.success:
            return None
        return replace(c, solved=found, place=place, coarser=None, rounds=c.rounds + 1)
