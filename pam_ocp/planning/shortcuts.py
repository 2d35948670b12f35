"""Ways to a solution that are shorter than from the first guess on the mesh that was asked for.

A neighbour's plan that had to be refined has the finer mesh already; and many intervals are solved
from the solution on few: minimum time on 50, 200, 800 intervals takes 45, 72, 176 iterations from
the first guess, but on 200 and 400 only 8 and 15 from the solution on 50.
"""

from __future__ import annotations

from collections.abc import Iterable

from .checked import Checked, checked
from .climb import Climb
from .problem.problem import Problem
from .refine import CLOSER
from .renewal import renewed, same_form
from .result import Solved
from .run import Run
from .solvers.backend import Backend
from .solvers.narrowing import has_kinks
from .stages import stage
from .transcription.mesh import merged
from .transcription.transcription import Program, transcribe

__all__ = ["by_coarser", "carried"]

FEW, MANY = 50, 150
"""Intervals of a leg, on average: of the coarse mesh, and from where it pays."""


def by_coarser(run: Run, climb: Climb) -> Solved | None:
    """From the solution on a mesh of few intervals; None where there is none, or it leads to
    nothing. The climb counts the iterations.
    """
    problem, mesh = run.program.problem, run.program.mesh
    each = len(mesh.intervals) // len(problem.legs)
    if each < MANY or mesh.form.scheme == "shooting" or has_kinks(problem):
        return None
    if run.backend.name != "ipopt":  # somebody's choice for such meshes
        return None
    backend = run.backend.near()
    few = merged(mesh, -(-each // FEW))
    with stage("coarse meshes", "many intervals are solved from few"):
        coarse = Run(transcribe(problem, few), backend).usual(None)
    climb.iterations += coarse.outcome.iterations
    if not coarse.outcome.success:
        return None
    found = run.refined(coarse, again=False)
    if not found.outcome.success:
        climb.iterations += found.outcome.iterations
        return None
    return found


def carried(
    problem: Problem,
    near: Solved | None,
    finer: Iterable[Program],
    wanted: tuple[Backend, float],
    climb: Climb,
) -> Checked | None:
    """On the finer mesh of a neighbour's plan, from its multipliers; None where that is none of
    ``finer``, or not fine enough for these numbers. The climb counts the iterations.

    wanted : who solves it, and the tolerance of the plan.
    """
    if near is None or not near.multiplied:
        return None
    if problem.objective.economical:  # whose meshes have to settle
        return None
    ours = any(near.program.nlp is each.nlp for each in finer)
    if not ours or not same_form(near.program.problem, problem):  # arcs have legs of their own
        return None
    backend, tolerance = wanted
    found = Run(renewed(near.program, problem), backend.near()).from_another(near)
    climb.iterations += found.outcome.iterations
    if not found.outcome.success:
        return None
    check = checked(found)
    return check if check.miss <= CLOSER * tolerance else None
