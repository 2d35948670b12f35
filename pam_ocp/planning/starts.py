"""Several starts of one program: whether they pay, which they are, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..plants.plant import Plant
from .problem.problem import Problem
from .settings import SETTINGS
from .solvers.ipopt_options import Start
from .solvers.solver import Outcome
from .transcription.guess import by_stops, wants_balance
from .transcription.mesh import Mesh

Array: TypeAlias = NDArray[np.float64]

STARTS: tuple[tuple[bool, float, Start], ...] = (
    (True, 1.0, "cold"),
    (True, 1.0, "adaptive"),
    (True, 0.3, "cold"),
    (True, 3.0, "cold"),
    (True, 0.3, "adaptive"),
    (True, 3.0, "adaptive"),
    (False, 1.0, "cold"),
    (False, 1.0, "adaptive"),
    (False, 0.3, "cold"),
    (False, 3.0, "cold"),
    (False, 0.3, "adaptive"),
    (False, 3.0, "adaptive"),
)
"""(whether states run as in the planner's own guess, its durations, barrier strategy), the order in
which they found most on random tasks with valves.
"""
MOST = len(STARTS)


@dataclass(frozen=True)
class Task:
    """One start: a guess, and the solver's barrier strategy."""

    guess: Array
    start: Start


def figures_of(ends: Sequence[Outcome]) -> dict[str, Any]:
    """For a plan's statistics: where each start ended, and how far apart the solutions lay, as part
    of the best.
    """
    each = [
        {
            "objective": o.objective,
            "status": o.status,
            "solved": o.success,
            "iterations": o.iterations,
        }
        for o in ends
    ]
    values, apart = sorted(o.objective for o in ends if o.success), float("nan")
    if values:
        apart = (values[-1] - values[0]) / max(abs(values[0]), 1e-12)
    return {"starts": each, "starts_apart": apart}


def tasks(problem: Problem, mesh: Mesh, starts: int) -> list[Task]:
    """The first ``starts`` that differ, the planner's own guess first."""
    own, free = (
        wants_balance(problem),
        any(leg.duration[0] < leg.duration[1] for leg in problem.legs),
    )
    chosen = [s for s in STARTS if free or s[1] == 1.0][:starts]
    return [
        Task(by_stops(problem, mesh, own if usual else not own, stretch), start)
        for usual, stretch, start in chosen
    ]


def number_of_starts(plant: Plant) -> int:
    """How many starts pay: several with valves or a load on a spring of its own, else one.

    Valves are inputs that act more or less as the state is (a flow by the pressures beside it) or
    as they are themselves; a load on a spring moves by way of another position only.
    """
    return SETTINGS.several if _throttled(plant) or _in_series(plant) else 1


def _throttled(plant: Plant) -> bool:
    """Whether the slope of a rate, but that of a velocity,
    by an input changes with state or input.
    """
    xdot, velocities = plant.function(plant.x, plant.u, plant.p)[0], set(plant.positions.values())
    rows = [i for i, v in enumerate(plant.states) if v.name not in velocities]
    free = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    if not rows or not free:
        return False
    slopes = ca.jacobian(xdot[rows], plant.u)[:, free]
    return bool(ca.depends_on(slopes, ca.vertcat(plant.x, plant.u)))


def _in_series(plant: Plant) -> bool:
    """Whether the inputs reach a velocity by way of another position only."""
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    by_state = np.array(ca.DM(ca.jacobian_sparsity(xdot, plant.x), 1.0), bool)
    by_input = np.array(ca.DM(ca.jacobian_sparsity(xdot, plant.u), 1.0), bool)
    names = [v.name for v in plant.states]
    moved = {names.index(n) for pair in plant.positions.items() for n in pair}
    free = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    if not free:
        return False
    for velocity in plant.positions.values():
        target = names.index(velocity)
        reached = set(np.flatnonzero(by_input[:, free].any(axis=1)).tolist())
        new = reached - (moved - {target})
        seen: set[int] = set()
        while new:
            seen |= new
            onward = set(np.flatnonzero(by_state[:, sorted(new)].any(axis=1)).tolist())
            new = onward - seen - (moved - {target})
        if target not in seen:
            return True
    return False
