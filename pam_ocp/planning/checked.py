"""A solution with its replay: what refinement and arcs judge meshes by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from ..simulation.simulator import evaluated
from .replay import Replay, chosen_plant, explained, replayed
from .result import Solved

__all__ = ["Checked", "checked"]


@dataclass(frozen=True)
class Checked:
    """A solution and its replay."""

    found: Solved
    plant: Plant
    """With the values that were chosen for its design."""
    samples: Trajectory
    replay: Replay

    @property
    def miss(self) -> float:
        """The figure that counts, in units of nominal; infinite when there is none."""
        worst = max(self.replay.error, self.replay.violation)
        return float("inf") if np.isnan(worst) else worst

    @property
    def dynamic(self) -> float:
        """What a motion that is more exact would mend: the replay's error, and what waypoints,
        closing and budgets see of it.
        """
        return max(self.replay.error, self.replay.missed)

    def explained(self, tolerance: float) -> Checked:
        """The same, with what the intervals deviate by where the replay does by more than that."""
        found = self.found
        replay = explained(self.replay, self.plant, found.program.mesh, found.solution, tolerance)
        return replace(self, replay=replay)


def checked(found: Solved) -> Checked:
    """A solution replayed."""
    problem, solution = found.program.problem, found.solution
    plant = chosen_plant(problem, solution)
    samples = evaluated(plant, solution.t, solution.states, solution.inputs)
    replay = replayed(problem, plant, found.program.mesh, samples, solution)
    return Checked(found, plant, samples, replay)
