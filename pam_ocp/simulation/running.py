"""The simulation of one case of many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from .simulator import simulate

__all__ = ["CASE_KEYS", "Case", "Result", "Simulation"]

Case: TypeAlias = Mapping[str, Any]
Result: TypeAlias = "Trajectory | Exception"
CASE_KEYS = ("parameters", "start", "inputs")


@dataclass(frozen=True, eq=False)
class Simulation:
    """A plant and what is the same for all its cases; called with a case."""

    plant: Plant
    common: Mapping[str, Any]

    def __call__(self, case: Case) -> Trajectory:
        return simulate(self.plant, **self.arguments(case))

    def arguments(self, case: Case) -> dict[str, Any]:
        """Of simulate, for one case."""
        arguments = dict(self.common)
        for key in CASE_KEYS:
            if key in case:
                both = isinstance(case[key], Mapping) and isinstance(arguments.get(key), Mapping)
                arguments[key] = {**arguments[key], **case[key]} if both else case[key]
        return arguments
