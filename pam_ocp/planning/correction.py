"""Motions that are exact on meshes that are not: iterated defect correction.

Integrated tightly from its start, an interval leaves a defect in the collocation equations: what
the mesh does not resolve there. A program that asks for this defect instead of none has the
integrated motion as its solution (Frank & Ueberhuber, BIT 17, 1977). The defect hardly changes
with the unknowns, so two or three warm re-solves do what a mesh of several times the size would:
memories have kinks, which no polynomial follows, and meshes resolve them slowly.

The optimum stays that of the mesh, to its error; the motion is the plant's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..simulation.integrate import Integration
from .replay import TOLERANCE, chosen_plant
from .transcription.solution import Solution, pack
from .transcription.stage import nominals
from .transcription.transcription import Program

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Corrected(Program):
    """A program whose collocation equations hold but for what the mesh does not resolve."""

    shift: Array
    """Of the limits of all constraints: zero but for the defects."""

    def exact(self) -> Program:
        """See :class:`Program`: defects of a motion say nothing of another one."""
        return Program(**{f.name: getattr(self, f.name) for f in fields(Program)})

    def limits(self) -> tuple[Array, Array]:
        """(low, high) of all constraints."""
        low, high = super().limits()
        return low + self.shift, high + self.shift


def corrected(program: Program, solution: Solution, exact: Sequence[Array]) -> Corrected | None:
    """The program that a motion would solve if each of its intervals ran as the plant does.

    ``solution`` stands on the program's mesh. exact : of each interval, the states to which an
    integration leads from its start. None where one of these could not be integrated.
    """
    shift = _defects(program, solution, exact)
    return _shifted(program, shift) if np.all(np.isfinite(shift)) else None


def integrated(program: Program, solution: Solution) -> Solution | None:
    """The plant's own motion under the inputs of a solution, at the same points; None where it ends
    before.
    """
    plant = chosen_plant(program.problem, solution)
    ranges = (plant.vector("state", attribute=a) for a in ("min", "max"))
    start = np.clip(solution.states[0], *ranges)
    run = Integration.over(plant, solution.inputs, solution.t, start, rtol=TOLERANCE)
    states = run()
    return None if states is None else replace(solution, states=run.at(solution.t, states))


def left_as(program: Program, solution: Solution) -> Corrected:
    """The program whose collocation equations hold along a motion, whatever that leaves in them."""
    w = program.completed(pack(program.problem, program.mesh, solution))
    function = ca.Function("defects", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    values = np.asarray(function(w, program.parameters()), float).ravel()
    shift = np.zeros(len(values))
    for group in program.groups:
        own = slice(group.first_row, group.first_row + group.rows * len(group.members))
        shift[own] = values[own]
    return _shifted(program, shift)


def _shifted(program: Program, shift: Array) -> Corrected:
    own = {f.name: getattr(program, f.name) for f in fields(Program)}
    return Corrected(**own, shift=shift)


def _defects(program: Program, solution: Solution, exact: Sequence[Array]) -> Array:
    """What an integration of each interval leaves in the constraints."""
    problem, mesh = program.problem, program.mesh
    plant, form = chosen_plant(problem, solution), mesh.form
    x_nominal, u_nominal = nominals(problem)
    states, breaks = solution.states, solution.inputs.breaks
    starts, inputs, at = [], [], 0
    ends = [(own / x_nominal).ravel() for own in exact]
    for k, (interval, length) in enumerate(zip(mesh.intervals, np.diff(breaks), strict=True)):
        starts.append(states[at] / x_nominal)
        since = length * form.input_taus(interval.degree)
        powers = since[:, None] ** np.arange(solution.inputs.degree + 1)
        inputs.append((powers @ solution.inputs.coefficients[k] / u_nominal).ravel())
        at += len(exact[k])
    lengths, parameters = np.diff(breaks), plant.vector("parameter")
    rows = sum(row.size for row in program.rows)
    found = np.zeros(rows)
    for group in program.groups:
        function = group.stage.function.map(len(group.members))

        def of(each: list[Array], members: tuple[int, ...] = group.members) -> Array:
            return np.column_stack([each[k] for k in members])

        # defects know no profiles, aims, peaks and auxiliaries
        unknown = [np.zeros(function.size_in(name)) for name in ("r", "q", "m", "a")]
        defects = function(
            of(starts),
            of(ends),
            of(inputs),
            lengths[list(group.members)][None],
            breaks[list(group.members)][None],
            parameters,
            *unknown,
        )[0]
        size = group.rows * len(group.members)
        found[group.first_row : group.first_row + size] = np.asarray(defects, float).ravel("F")
    return found
