"""Refinement: meshes as fine as the replay of a plan asks for, until the plan is verified."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.stop import TimeIsUp
from .approach import Approach
from .arcs import BY_ARCS, guarded
from .arcs_search import ArcSearch
from .checked import Checked, checked
from .climb import FLOOR
from .correction import CORRECTABLE, Corrected, corrected
from .landing import landed
from .renewal import on_mesh
from .replay import interval_errors
from .result import Solved
from .run import Run
from .solvers.backend import Backend
from .solvers.ipopt_options import Start
from .solvers.narrowing import has_kinks
from .solvers.solver import SETTLED
from .stages import stage
from .transcription.mesh import Mesh, doubled_at_most, halved, held, refined, watched
from .transcription.solution import unpack
from .transcription.transcription import transcribe

__all__ = ["CLOSER", "Refinement"]

Array: TypeAlias = NDArray[np.float64]

ROUNDS = 12
"""Of refinement, at most."""
POLYNOMIAL_ROUNDS = 5
"""Before polynomial inputs are held constant instead: refinement may chase their switches for ever.
"""
EVERYWHERE = 3
"""Each so many rounds all intervals are split: where only some are, held inputs move about there
the more, and what swings behind them with them.
"""
ITERATIONS = 1500
"""Of the solver in all rounds."""
POLYNOMIAL_ITERATIONS = 300
"""Of the solver before polynomial inputs are held constant instead."""
CLOSER = 0.8
"""Of the tolerance: what refinement aims at, so that who looks at other times finds it kept, too.
"""
ROUGH = 0.3
"""Replay error in units of nominal from which a mesh does not resolve the motion at all: the solver
has made use of its errors, and finer meshes have other optima.
"""
PLAIN_ROUNDS = 3
"""Of refinement alone; then defects are corrected of all motions."""
CORRECTIONS = 4
"""On one mesh, at most; each leaves a part of the error, ``LEFT`` of it at most."""
LEFT = 0.5
NEARLY = 10.0
"""Tolerances that a motion with kinks may miss, to be landed before its mesh is solved again."""
POINTS = 1000
"""Of a mesh, up to which one that is more than twice as fine is solved at once."""
HARDLY = 1.25
"""Times as many unknowns, at most, for which costs that are flat are not looked at again."""
MORE_INTERVALS = 300
"""Refinement ends before it adds more: a mesh that grows so is slow to solve."""


class Refinement:
    """Solves a solution's problem on finer meshes until its replay meets a tolerance.

    Ends after ``ROUNDS``. What was best is kept: a finer mesh that fails loses nothing.
    """

    def __init__(self, first: Checked, tolerance: float, backend: Backend) -> None:
        self.best, self.tolerance, self.backend = first, CLOSER * tolerance, backend.near()
        self.first = first.found
        self.kinks = has_kinks(first.found.program.problem)
        # economical motions have the mesh already on which their objective has settled
        self.corrects = self.kinks or first.found.program.problem.objective.economical
        self.meshes = [first.found.program.mesh]
        self.iterations = 0
        self._sought = len(first.found.outcome.w)
        """Unknowns of the last mesh on which costs were looked at."""
        self.warning = ""
        # where costs are flat (with kinks they are) what a correction shifts is brought back
        flat = self.kinks or self.first.outcome.status == SETTLED
        self._warm: Start = "still" if flat else "warm"
        self.cut = False
        """Whether a time limit ended it."""
        try:
            self._refine()
        except TimeIsUp:
            self.cut = True

    def met(self) -> bool:
        """Whether the best solution meets the tolerance."""
        return self.best.miss <= self.tolerance

    def followed_by(self, then: Refinement) -> Refinement:
        """The one after this, with the meshes and iterations of both."""
        again = then.meshes[0] == self.meshes[-1]
        then.meshes = [*self.meshes, *then.meshes[again:]]
        then.first, then.iterations = self.first, self.iterations + then.iterations
        return then

    def _refine(self) -> None:
        first, asked = self.best, self.meshes[0].form == BY_ARCS
        if asked and np.isfinite(self.tolerance) and not self.kinks and self._by_arcs():
            return
        if self.met():
            return
        if asked:
            first = self._solved(guarded(self.meshes[0]), first.found) or first
        if self.kinks:
            self._kinked(first)
            return
        if self.meshes[0].form.control != "polynomial":
            self._rounds(first, ROUNDS, ITERATIONS)
            return
        self._rounds(first, POLYNOMIAL_ROUNDS, POLYNOMIAL_ITERATIONS)
        if self.met():
            return
        following = self._held(first)
        if following is not None:
            self._rounds(following, ROUNDS, ITERATIONS)
        self.warn()

    def _by_arcs(self) -> bool:
        """Whether intervals that end where inputs switch met the tolerance."""
        search = ArcSearch(self.first, self.tolerance, self.backend, self._taken)
        found = search.solved()
        self.iterations += search.iterations
        if found is not None:
            self.best = found
            self.meshes.append(found.found.program.mesh)
        return found is not None

    def warn(self) -> None:
        """Say where inputs are held that were asked for as polynomials."""
        forms = (self.meshes[0].form, self.best.found.program.mesh.form)
        if [form.control for form in forms] == ["polynomial", "constant"]:
            self.warning = (
                "polynomial inputs did not meet the tolerance, so inputs are held "
                "constant on each interval"
            )

    def _kinked(self, first: Checked) -> None:
        """Finer meshes as long as they lead on at once; else from wide roundings again, with the
        motion resolved at each place of the path.
        """
        if first.replay.error <= ROUGH:
            self._rounds(first, ROUNDS, ITERATIONS, directly=True)
        if not self.met():
            following = self._approached(first.found)
            if following is not None:
                self._rounds(following, ROUNDS, ITERATIONS)
        if not self.met() and self.meshes[0].form.control == "polynomial":
            following = self._held(first)
            if following is not None:
                self._rounds(following, ROUNDS, ITERATIONS)
        self.warn()

    def _held(self, first: Checked) -> Checked | None:
        """With inputs that are held, in place of polynomials."""
        with stage("mesh", "polynomial inputs do not meet the tolerance"):
            return self._solved(held(self.meshes[0]), first.found)

    def _approached(self, rough: Solved) -> Checked | None:
        """By way of wide roundings, from a solution that has the motion at large."""
        mesh = rough.program.mesh
        run = Run(transcribe(rough.program.problem, mesh), self.backend)
        with stage("smoothing", "a finer mesh was not solved at once"):
            wide = run.widely(rough)
        self.iterations += wide.outcome.iterations
        if not wide.outcome.success:
            return None
        approach = Approach(run, wide, self.backend)
        found = approach.solved() or approach.landed(self.tolerance)
        self.iterations += approach.iterations
        return None if found is None else self._taken(found)

    def _rounds(self, current: Checked, most: int, iterations: int, directly: bool = False) -> None:
        """From a solution to finer ones; ``directly`` on the most promising mesh or not at all."""
        iterations += self.iterations
        for i in range(1, most + 1):
            if self.met() or self.iterations > iterations:
                return
            if self.corrects or i > PLAIN_ROUNDS:
                current = self._corrected(current)
            if self.met():
                return
            following = None
            for finer in self._meshes(current, i)[: 1 if directly else None]:
                with stage("mesh", f"tolerance missed by {current.miss:.1g}"):
                    following = self._solved(finer, current.found, directly)
                if following is not None:
                    break
                if self.best.miss <= self.tolerance / CLOSER:  # no more is promised
                    return
            if following is None:
                if not self.corrects:
                    self._corrected(current)
                if self.kinks and not self.met():
                    self._landed(current)
                return
            current = following

    def _corrected(self, current: Checked) -> Checked:
        """The solution with its mesh's defects corrected; itself where that does not pay."""
        tried = False
        for _ in range(CORRECTIONS):
            if not self.tolerance < _missed(current) <= CORRECTABLE:
                break
            if self.kinks and not tried and _missed(current) <= NEARLY * self.tolerance:
                tried = True
                if self._landed(current, self.tolerance):
                    break
            found = current.found
            program = corrected(found.program, found.solution)
            if program is None:
                break
            solver = self.backend.build(found.program)
            with stage("defect correction", f"dynamics miss by {_missed(current):.1g}"):
                outcome = solver(program, found.outcome.w, self._warm, found.outcome)
                if not outcome.ended and self._warm != "last":
                    self.iterations += outcome.iterations
                    self._warm = "last"
                    outcome = solver(program, found.outcome.w, self._warm, found.outcome)
            if not outcome.ended and not tried:
                # dearer economical motions are sought on finer meshes first
                economical = program.problem.objective.economical
                if self._landed(current, self.tolerance if economical else np.inf):
                    break
            solution = unpack(program.problem, program.mesh, outcome.w)
            now = self._taken(Solved(program, outcome, solution))
            if now is None:
                break
            current, before = now, current
            if _missed(current) > LEFT * _missed(before):
                break
        return current

    def _landed(self, current: Checked, dearer: float = np.inf) -> bool:
        """Whether the motion, integrated and brought to its stops, meets the tolerance.

        dearer : part of the objective that this may cost.
        """
        if not self.tolerance < _missed(current) <= CORRECTABLE:
            return False
        found = landed(current.found, self.tolerance)
        if found is not None:
            before, now = current.found.outcome.objective, found.outcome.objective
            if now - before <= dearer * max(abs(before), FLOOR):
                self._taken(found)
        return self.met()

    def _meshes(self, current: Checked, i: int) -> list[Mesh]:
        """Meshes for a round, the most promising first."""
        mesh = current.found.program.mesh
        meshes = [*self._finer(current), halved(mesh)]
        if mesh.form.control == "constant":
            meshes.insert(-1, halved(mesh, joined=True))
        elif i % EVERYWHERE == 0:
            meshes = [meshes[-1], *meshes[:-1]]
        most = len(mesh.intervals) + MORE_INTERVALS
        return [each for each in meshes if each != mesh and len(each.intervals) <= most]

    def _solved(self, mesh: Mesh, coarse: Solved, directly: bool = False) -> Checked | None:
        """The solution on another mesh; None when it was not found."""
        program = on_mesh(coarse.program.problem, mesh, self.backend.programs)
        if isinstance(coarse.program, Corrected) and _alike(mesh, coarse.program.mesh):
            program = corrected(program, coarse.solution) or program
        run = Run(program, self.backend)
        size = program.nlp["x"].numel()
        if coarse.outcome.status == SETTLED and size <= HARDLY * self._sought:  # costs are flat
            found = run.beside(coarse)
            if found is not None:
                return self._taken(found)
        self._sought = size
        if directly:
            return self._taken(run.directly(coarse))
        return self._taken(run.refined(coarse, again=mesh.form.control != "polynomial"))

    def _taken(self, found: Solved) -> Checked | None:
        """A solution replayed, kept when it is the best; None when there is none."""
        self.iterations += found.outcome.iterations
        if not found.outcome.success:
            return None
        now = checked(found)
        if now.miss < self.best.miss:
            self.best = now
            if self.meshes[-1] != found.program.mesh:
                self.meshes.append(found.program.mesh)
        return now

    def _finer(self, current: Checked) -> list[Mesh]:
        """Meshes that may do better, the most promising first."""
        mesh, replay = current.found.program.mesh, current.replay
        by_limits = [watched(mesh, replay.beyond, self.tolerance)] if replay.beyond else []
        worst, kinks = _missed(current), self.kinks
        if worst <= self.tolerance:
            # where checks between the points make the program unsolvable, shorter intervals may do
            beyond = [max(each.values(), default=0.0) for each in replay.beyond]
            return [*by_limits, refined(mesh, beyond, self.tolerance, kinks)]
        errors = interval_errors(current.plant, mesh, current.found.solution)
        # errors of intervals add up, and may grow along the motion; stops may see more of them
        growth = max(1.0, worst / sum(errors)) if np.isfinite(worst) and sum(errors) > 0 else 1.0
        allowed = self.tolerance / len(errors) / growth
        return [doubled_at_most(mesh, errors, allowed, kinks, POINTS), *by_limits]


def _missed(current: Checked) -> float:
    """What a motion that is more exact would mend: its replay's error, and what stops, closing and
    budgets see of it.
    """
    return max(current.replay.error, current.replay.missed)


def _alike(mesh: Mesh, other: Mesh) -> bool:
    """Whether two meshes have the same points, and differ in what is checked between them."""
    bare = [[replace(i, watched=()) for i in each.intervals] for each in (mesh, other)]
    return bare[0] == bare[1]
