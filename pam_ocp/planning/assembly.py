"""The Plan that a search has come to, with its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..judge.motion import judge
from ..judge.statement import Statement
from ..judge.verdict import TOLERANCE
from ..simulation.simulator import evaluated
from .candidate import Candidate, Checked
from .mesh_sequence import scale
from .result import Plan, Solved, motion_of
from .search import Search
from .solvers.diagnosis import Conflict
from .transcription.mesh import Mesh

HELD = "polynomial inputs did not meet the tolerance, so inputs are held constant on each interval"
BETWEEN = "costs are counted at the points of the mesh, so plan on a finer one"


def assembled(
    found: Solved,
    statement: Statement,
    figures: Mapping[str, Any],
    check: Checked | None = None,
    meshes: tuple[Mesh, ...] = (),
    coarse: Solved | None = None,
    tolerance: float | None = TOLERANCE,
    conflicts: tuple[Conflict, ...] = (),
) -> Plan:
    """The Plan of a solution that was checked, or of what a solver left that failed."""
    program, outcome, solution = found.program, found.outcome, found.solution
    problem = program.problem
    plant = check.plant if check else problem.plant
    samples = (
        check.samples if check else evaluated(plant, solution.t, solution.states, solution.inputs)
    )
    said = [words for words in (outcome.warning, figures.get("warning")) if words]
    statistics = {
        **figures,
        **({"warning": "; ".join(said)} if said else {}),
        "solver": outcome.solver,
        "solve_seconds": outcome.seconds,
        "variables": len(outcome.w),
        "constraints": len(outcome.lam_g),
        "intervals": len(program.mesh.intervals),
    }
    design = {n: float(plant.variable(n).start or 0.0) for n in problem.design}
    meshes = meshes or (program.mesh,)
    judgement, objective = None, outcome.objective
    if check:
        motion = motion_of(samples, meshes[-1], solution.durations)
        judgement = judge(plant, statement, motion, samples)
        if np.isfinite(judgement.objective):
            statistics["objective_on_mesh"], objective = objective, judgement.objective
    return Plan(
        plant,
        outcome.success,
        outcome.status,
        objective,
        tuple(float(d) for d in solution.durations),
        design,
        statistics,
        check.replay if check else None,
        judgement,
        meshes,
        outcome.log,
        conflicts,
        tolerance or TOLERANCE,
        samples,
        statement,
        problem,
        found,
        coarse,
        tuple(map(float, solution.peaks)),
    )


def trust(search: Search, best: Candidate, tolerance: float | None) -> dict[str, Any]:
    """Figures of how far a minimum-energy objective has converged, of whether the mesh's defects
    were corrected, and what did not go as asked.
    """
    figures: dict[str, Any] = {}
    words = []
    meshes, mesh = search.meshes, search.engine.first.mesh
    if (mesh.form.control, best.mesh.form.control) == ("polynomial", "constant"):
        words.append(HELD)
    if meshes.economical and tolerance is not None:
        gap, replayed = meshes.gap(best), best.check.replay.objective
        figures |= {"objective_change": meshes.change(best), "objective_gap": gap}
        figures["objective_replayed"] = replayed
        words += [] if gap <= tolerance else [_not_converged(gap, tolerance)]
        if not abs(replayed - best.objective) / scale(best) <= tolerance:
            words.append(f"along the replay the objective is {replayed:.3g}: {BETWEEN}")
    if best.is_corrected:
        figures["corrected"] = True
    if words:
        figures["warning"] = "; ".join(words)
    return figures


def _not_converged(gap: float, tolerance: float) -> str:
    """The note on an objective that finer meshes may yet lower."""
    far = f"{100 * gap:.2g} %" if gap == gap else "an unknown part"
    return (
        f"the objective has not converged to {tolerance:.0e}: it may lie {far} above its least, "
        "which finer meshes (method=Collocation(intervals)) or a plan as guess may reach"
    ).replace("e-0", "e-")
