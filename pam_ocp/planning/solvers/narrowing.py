"""Kinks that are rounded off: a motion is planned with wide roundings first, then with narrower
ones.

The parameters of a plant that have a ``widest`` value (of hysteresis) go from there to their own
along a path, evenly in their logarithms; each solution starts the next. The last one is the problem
itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...plants.plant import Plant
from ..problem.problem import Problem
from ..stages import stage
from ..transcription.transcription import Program
from .ipopt_options import Start
from .solver import Outcome, Solver

__all__ = ["has_kinks", "has_roundings", "narrowing", "rounded", "rounded_at", "widened"]

FIRST, LEAST = 0.3, 0.02
"""Parts of the path that are gone at once: at first, and at least before it is given up."""
LATE = 0.6
"""Where the path begins for a guess that solves a neighbouring problem."""


def has_kinks(problem: Problem) -> bool:
    """Whether the plant has roundings to narrow."""
    return bool(_roundings(problem.plant))


def has_roundings(problem: Problem) -> bool:
    """Whether the plant has kinks that are rounded off, at whatever place of the path it stands."""
    return any(v.widest > 0 for v in problem.plant.parameters)


def _roundings(plant: Plant) -> list[Variable]:
    return [v for v in plant.parameters if v.widest > 0 and v.widest > (v.start or 0.0)]


def rounded(plant: Plant, part: float) -> Plant:
    """The plant with the roundings of a place on the path, 0 (widest) .. 1 (its own)."""
    return plant.with_values(
        {
            v.name: float(np.clip(v.widest ** (1 - part) * (v.start or 0.0) ** part, v.min, v.max))
            for v in _roundings(plant)
        }
    )


def rounded_at(program: Program, part: float) -> Program:
    """The program with the roundings of a place on the path; itself at the end."""
    if part >= 1.0:
        return program
    problem = replace(program.problem, plant=rounded(program.problem.plant, part))
    return replace(program, problem=problem)


def widened(program: Program) -> Program:
    """The program with its roundings at their widest."""
    return rounded_at(program, 0.0)


def narrowing(
    solver: Solver, program: Program, guess: NDArray[np.float64], start: Start
) -> Outcome:
    """Solve along the path; the outcome for the plant's own roundings,
    or that of the last place.
    """
    iterations, seconds = 0, 0.0

    def solved(
        part: float, w: NDArray[np.float64], how: Start, warm: Outcome | None = None
    ) -> Outcome:
        nonlocal iterations, seconds
        with stage("smoothing", f"place {part:.2f} of the path"):
            outcome = solver(rounded_at(program, part), w, how, warm)
        iterations, seconds = iterations + outcome.iterations, seconds + outcome.seconds
        return outcome

    def total(outcome: Outcome) -> Outcome:
        return replace(outcome, iterations=iterations, seconds=seconds)

    here = 0.0
    if start == "near":
        direct = solved(1.0, guess, "dash")
        if direct.ended:
            return total(direct)
        here = LATE
    last = solved(here, guess, "near" if start == "step" else start)
    step = FIRST
    failed = last
    while last.success and here < 1.0:
        there = min(1.0, here + step)
        outcome = solved(there, last.w, "along", last)
        if there == 1.0 and not outcome.stopped:
            near = outcome if outcome.success else last
            least = solved(there, near.w, "last", near)  # costs at their least
            outcome = least if least.ended else outcome
        if not outcome.ended:  # others are active there
            outcome = solved(there, last.w, "dash")
        if outcome.success:
            last, here, step = outcome, there, 1.5 * step
            continue
        failed, step = outcome, (there - here) / 2.5
        if outcome.stopped or step < LEAST:
            return total(failed)
    return total(last)
