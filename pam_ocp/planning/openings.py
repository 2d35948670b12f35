"""The relaxation of valves: their openings as inputs in place of commands.

In commands a solver has to cross dead zones without slope, and each is a place to get stuck; in
openings there is none. What it finds there is transformed back to commands by the exact inverse.

An opening is smoothed at zero, over a thousandth of its range, where closed valves give a little
back to the supply. Where air is what a motion costs, that would be worth having: there the filling
and the venting area of each valve are inputs of their own, and that both are open never pays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.signals import PiecewisePolynomial
from ..judge.statement import Statement
from ..plants.inversion import Inversion
from ..plants.opening import WAYS
from ..plants.plant import Plant
from .problem.formulation import formulate
from .problem.problem import Problem
from .result import Solved
from .transcription.guess import from_solution
from .transcription.mesh import Mesh
from .transcription.solution import Solution, pack
from .transcription.transcription import Program

__all__ = ["ValveOpenings"]

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class ValveOpenings:
    """The same problem with openings as inputs, or with filling and venting areas; and the way
    back.
    """

    problem: Problem
    inversion: Inversion

    @classmethod
    def of(cls, plant: Plant, statement: Statement, ways: bool = False) -> ValveOpenings | None:
        """None where the plant has no openings, the statement speaks of commands as openings
        cannot, or the commands are the ways themselves.
        """
        inversion = Inversion(plant)
        if not inversion or not inversion.exact:
            return None
        if ways and all(len(o.commands) > 1 for o in plant.openings):
            return None
        inner = plant.in_ways() if ways else inversion.inner
        try:
            bounds = _bounds(plant, inversion, statement.bounds)
            if bounds is not None and ways:
                bounds = _of_ways(bounds, inversion.inner, inner)
            return cls(formulate(inner, replace(statement, bounds=bounds)), inversion)
        except InputError:  # names or symbols of commands
            return None

    def guess(self, problem: Problem, mesh: Mesh, found: Solution) -> Array:
        """Scaled unknowns of the problem in commands along a solution in openings."""

        def commands(t: Array) -> Array:
            return self.inversion.sent(self._openings(found.inputs(t)))

        sent: Any = commands  # all that is asked of the inputs is their values
        return from_solution(problem, mesh, replace(found, inputs=sent))

    def in_commands(self, program: Program, found: Solved) -> Solved | None:
        """A solution in openings on the same mesh, as one of the program in commands: the same
        motion, with the multipliers of its equations; None where inputs are not held, or the
        equations are others.
        """
        solution = found.solution
        held = solution.inputs.coefficients
        rows = program.nlp["g"].numel()
        if held.shape[1] > 1 or found.outcome.lam_g.size != rows:
            return None
        commands = self.inversion.sent(self._openings(held[:, 0]))
        inputs = PiecewisePolynomial(solution.inputs.breaks, commands[:, None])
        same = replace(solution, inputs=inputs)
        w = program.completed(pack(program.problem, program.mesh, same))
        outcome = replace(found.outcome, w=w, lam_x=np.zeros(w.size))
        return Solved(program, outcome, same)

    def _openings(self, inputs: Array) -> Array:
        """Columns of openings from those of their ways."""
        columns = dict(zip([v.name for v in self.problem.plant.inputs], inputs.T, strict=True))
        found = []
        for name in (v.name for v in self.inversion.inner.inputs):
            if name in columns:
                found.append(columns[name])
            else:
                filling, venting = (columns[f"{name}.{way}"] for way in WAYS)
                found.append(filling - venting)
        return np.column_stack(found)


def _of_ways(bounds: dict[str, Any], openings: Plant, ways: Plant) -> dict[str, Any]:
    """Bounds of openings said of their ways: the larger of what is left to each."""
    names = {v.name for v in openings.inputs} - {v.name for v in ways.inputs}
    found = {n: pair for n, pair in bounds.items() if n not in names}
    for name in names & set(bounds):
        low, high = bounds[name]
        for way, (least, most) in zip(WAYS, ((low, high), (-high, -low)), strict=True):
            found[f"{name}.{way}"] = (max(least, 0.0), max(most, 0.0))
    return found


def _bounds(plant: Plant, inversion: Inversion, bounds: Any) -> dict[str, Any] | None:
    """The statement's bounds with those of commands said of openings."""
    if bounds is None:
        return None
    commands = {c for o in plant.openings for c in o.commands}
    named = {}
    other = {}
    for name, value in bounds.items():
        inner = name[4:-1] if name.startswith("der(") else name
        full = plant.variable(inner).name
        if full not in commands:
            other[name] = value
        elif inner != name or not isinstance(value, tuple | list) or len(value) != 2:
            raise InputError(f"bounds: {name} cannot be said of an opening")
        else:
            variable = plant.variable(full)
            low, high = value
            named[full] = (
                variable.min if low is None else float(low),
                variable.max if high is None else float(high),
            )
    return {**other, **{n: tuple(v) for n, v in inversion.bounds(named).items()}}
