"""What the multipliers of a solved program say: costates and sensitivities."""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.collocation import collocation_matrices
from ..transcription.mesh import Form
from ..transcription.solution import unpack
from ..transcription.stage import nominals
from ..transcription.transcription import Group, Program
from .solver import Outcome

Array: TypeAlias = NDArray[np.float64]


def costates(program: Program, outcome: Outcome) -> tuple[Array, Array]:
    """(times (n,), costates (n, nx)): derivative of the optimal value by the state [objective/SI].

    From the defects' multipliers: lambda = multiplier / quadrature weight at collocation points
    (Benson et al., J. Guid. Control Dyn. 29, 2006, for Gauss points; Garg et al., Comput. Optim.
    Appl. 49, 2011, for Radau points), the multiplier itself at the end of an interval by Gauss
    points or shooting; at the start of the motion from the stationarity of the initial state.
    """
    mesh = program.mesh
    x_nominal, _ = nominals(program.problem)
    breaks = unpack(program.problem, mesh, outcome.w).inputs.breaks
    parts: dict[int, tuple[Array, Array]] = {}
    for group in program.groups:
        degree = group.stage.degree
        taus, shares = mesh.form.state_taus(degree), _shares(mesh.form, degree)
        for k, row in zip(group.members, _block(group, outcome), strict=True):
            values = row.reshape(len(taus), -1) / shares[:, None] / x_nominal
            parts[k] = (breaks[k] + (breaks[k + 1] - breaks[k]) * taus, values)
    order = [parts[k] for k in range(len(mesh.intervals))]
    first = _initial(program, outcome) / x_nominal
    times = np.concatenate([[0.0], *(t for t, _ in order)])
    return times, np.vstack([first, *(values for _, values in order)])


def _shares(form: Form, degree: int) -> Array:
    """By what the multipliers of an interval's defects exceed the costates."""
    if form.scheme == "shooting":
        return np.ones(1)
    shares = collocation_matrices(form.collocated(degree))[2]
    return np.append(shares, 1.0) if form.scheme == "gauss" else shares


def _block(group: Group, outcome: Outcome) -> Array:
    """(intervals, rows) multipliers of a group's defects."""
    size = group.rows * len(group.members)
    return outcome.lam_g[group.first_row : group.first_row + size].reshape(len(group.members), -1)


def _initial(program: Program, outcome: Outcome) -> Array:
    """Gradient of the Lagrangian by the (scaled) initial state."""
    n = len(program.problem.plant.states)
    nlp = program.nlp
    # what the stops and the closing say of the initial state is what its change is asked against
    held = [np.full(r.size, r.kind in ("stop", "closing")) for r in program.rows]
    lam = np.where(np.concatenate(held), 0.0, outcome.lam_g)
    lagrangian = nlp["f"] + ca.dot(nlp["g"], lam)
    gradient = ca.Function("g", [nlp["x"], nlp["p"]], [ca.gradient(lagrangian, nlp["x"])])
    return np.asarray(gradient(outcome.w, program.parameters()), float).ravel()[:n]


def sensitivities(program: Program, outcome: Outcome) -> dict[str, float]:
    """{parameter: derivative of the optimal objective by it} (envelope theorem).

    Holds where the active constraints stay the same; parameters that the plan designs are left out.
    """
    nlp = program.nlp
    lagrangian = nlp["f"] + ca.dot(nlp["g"], outcome.lam_g)
    gradient = ca.Function("g", [nlp["x"], nlp["p"]], [ca.gradient(lagrangian, nlp["p"])])
    values = np.asarray(gradient(outcome.w, program.parameters()), float).ravel()
    problem = program.problem
    names = [v.name for v in problem.plant.parameters]
    return {n: float(v) for n, v in zip(names, values, strict=False) if n not in problem.design}


def stop_sensitivities(program: Program, outcome: Outcome) -> dict[str, float]:
    """{label of a condition at a stop: derivative of the objective by its value}."""
    return {
        condition.label: -float(push) / condition.nominal
        for row, own in program.placed()
        if row.kind == "stop"
        for condition, push in zip(row.conditions, outcome.lam_g[own], strict=True)
    }
