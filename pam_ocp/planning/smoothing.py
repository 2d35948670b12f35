"""The smoothing homotopy: nonsmooth terms of a plant (dry friction, hysteresis) are widened first.

The parameters of a plant that have a ``widest`` value go from there to their own along one path,
evenly in their logarithms, and with them those that have a ``relaxed`` one. The last place of the
path is the problem itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.variables import Variable
from ..plants.plant import Plant
from .problem.problem import Problem
from .transcription.transcription import Program

__all__ = ["has_relaxed", "has_smoothing", "is_nonsmooth", "smoothed", "smoothed_at"]


def is_nonsmooth(problem: Problem) -> bool:
    """Whether the plant has nonsmooth terms whose smoothing is narrower than it may be."""
    return bool(_widths(problem.plant))


def has_smoothing(problem: Problem) -> bool:
    """Whether the plant has nonsmooth terms, at whatever place of the path it stands."""
    return any(v.widest > 0 for v in problem.plant.parameters)


def has_relaxed(problem: Problem) -> bool:
    """Whether more than widths is led along the path."""
    return any(v.relaxed > 0 for v in problem.plant.parameters)


def _widths(plant: Plant) -> list[Variable]:
    return [v for v in plant.parameters if v.widest > 0 and v.widest > (v.start or 0.0)]


def smoothed(plant: Plant, place: float, relaxed: bool = False) -> Plant:
    """The plant at a place of the path, 0 (widest smoothing) .. 1 (its own).

    relaxed : whether parameters that have such a value are led along.
    """
    begins = {v: v.widest for v in _widths(plant)}
    if relaxed:
        begins |= {v: v.relaxed for v in plant.parameters if v.relaxed > 0}
    return plant.with_values(
        {
            v.name: float(np.clip(begin ** (1 - place) * (v.start or 0.0) ** place, v.min, v.max))
            for v, begin in begins.items()
        }
    )


def smoothed_at(program: Program, place: float, relaxed: bool = False) -> Program:
    """The program at a place of the path; itself at the end."""
    if place >= 1.0:
        return program
    problem = replace(program.problem, plant=smoothed(program.problem.plant, place, relaxed))
    return replace(program, problem=problem)
