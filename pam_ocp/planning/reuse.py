"""A built program with other numbers: which changes it bears, and its rows with their limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from ..core.errors import InputError
from .problem.problem import Budget, Condition, Problem
from .transcription.mesh import Mesh
from .transcription.stage import between_points
from .transcription.transcription import Program, Row, transcribe

__all__ = ["on_mesh", "renewed", "same_form"]


def _shape(problem: Problem) -> tuple[object, ...]:
    """What the expressions of a program depend on."""
    plant, goal = problem.plant, problem.objective
    return (
        [v.name for v in (*plant.states, *plant.inputs)],  # openings in place of commands, say
        (goal.time, goal.rate, goal.peaks, goal.words, goal.only_time),
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


def same_form(old: Problem, new: Problem) -> bool:
    """Whether two problems differ by numbers only, so that a program of one bears the other's."""
    return _shape(old) == _shape(new)


def _require_same_form(old: Problem, new: Problem) -> None:
    if not same_form(old, new):
        raise InputError(
            "the changed stops, bounds or budgets name other variables than those the planner was "
            "built with; only numbers may change. Make a new Planner"
        )
    if any(a is not b for a, b in zip(old.profiles, new.profiles, strict=True)):
        raise InputError("a Profile cannot change in a built planner; make a new Planner")


def renewed(program: Program, problem: Problem, mesh: Mesh | None = None) -> Program:
    """A program with the numbers of another problem of the same form; ``mesh``: with its margins,
    all else of it being the program's.
    """
    program = program.exact()
    _require_same_form(program.problem, problem)
    # durations are unknowns in units that the expressions hold
    same = replace(problem, typical=tuple(map(float, program.problem.time_nominals)))
    moved = replace(program, problem=same, mesh=mesh or program.mesh)
    return replace(moved, rows=_rows(program, moved))


def on_mesh(problem: Problem, mesh: Mesh, known: Iterable[Program]) -> Program:
    """The program of a problem on a mesh, with the expressions of a known one where these are the
    same: margins are limits, and no part of them.
    """
    for program in known:
        same = _structure(program.mesh) == _structure(mesh)
        if same and same_form(program.problem, problem):
            return renewed(program, problem, mesh)
    return transcribe(problem, mesh)


def _structure(mesh: Mesh) -> tuple[object, ...]:
    """What the expressions of a program depend on."""
    return mesh.form, [
        replace(i, raised=False, watched=tuple((label, 0.0) for label, _ in i.watched))
        for i in mesh.intervals
    ]


def _rows(program: Program, moved: Program) -> tuple[Row, ...]:
    """The rows of a program with the limits of another problem of the same form."""
    old, problem, intervals = program.problem, moved.problem, moved.mesh.intervals
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

    def limited(row: Row, condition: Condition | Budget) -> Condition | Budget:
        if id(condition) in image:
            return image[id(condition)]
        assert isinstance(condition, Condition)  # looked at between the points
        interval = intervals[row.members[0]]
        return between_points(condition, problem.legs[interval.leg], dict(interval.watched))

    return tuple(
        replace(row, conditions=tuple(limited(row, c) for c in row.conditions))
        for row in program.rows
    )
