"""A built program with other numbers: which changes it bears, and its rows with their limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..core.errors import InputError
from .problem.problem import Budget, Condition, Problem
from .transcription.transcription import Program, Row

__all__ = ["renewed_rows", "require_same_form"]


def _shape(problem: Problem) -> tuple[object, ...]:
    """What the expressions of a program depend on."""
    return (
        [[c.label for c in node] for node in problem.nodes],
        [[c.label for c in leg.path] for leg in problem.legs],
        [b.label for b in problem.budgets],
        len(problem.auxiliaries),
        list(problem.design),
        len(problem.profiles),
        len(problem.aims),
        problem.closing,
        [leg.duration[0] == leg.duration[1] for leg in problem.legs],
    )


def require_same_form(old: Problem, new: Problem) -> None:
    if _shape(old) != _shape(new):
        raise InputError(
            "the changed stops, bounds or budgets name other variables than those the planner was "
            "built with; only numbers may change. Make a new Planner"
        )
    if any(a is not b for a, b in zip(old.profiles, new.profiles, strict=True)):
        raise InputError("a Profile cannot change in a built planner; make a new Planner")


def renewed_rows(program: Program, problem: Problem) -> tuple[Row, ...]:
    """The rows of a program with the limits of another problem of the same form."""
    old = program.problem
    pairs: list[tuple[Sequence[Condition | Budget], Sequence[Condition | Budget]]] = [
        *zip(old.nodes, problem.nodes, strict=True),
        *((a.path, b.path) for a, b in zip(old.legs, problem.legs, strict=True)),
        (old.budgets, problem.budgets),
        *(
            (a.conditions, b.conditions)
            for a, b in zip(old.auxiliaries, problem.auxiliaries, strict=True)
        ),
    ]
    image: dict[int, Condition | Budget] = {
        id(a): b for before, after in pairs for a, b in zip(before, after, strict=True)
    }

    def renewed(row: Row, condition: Condition | Budget) -> Condition | Budget:
        if id(condition) in image:
            return image[id(condition)]
        # an input between its points: its limits are the leg's bounds
        leg = problem.legs[program.mesh.intervals[row.members[0]].leg]
        low, high = leg.bounds[condition.label]
        return replace(condition, low=low, high=high)

    return tuple(
        replace(row, conditions=tuple(renewed(row, c) for c in row.conditions))
        for row in program.rows
    )
