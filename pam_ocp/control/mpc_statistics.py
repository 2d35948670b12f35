"""What a model predictive controller's steps took, and how they ended."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.shown import shown

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class MpcStep:
    """What one call of :meth:`Mpc.control` did."""

    seconds: float
    qp_seconds: float
    """Of ``seconds``, spent in the QP solver (or in IPOPT)."""
    iterations: int
    work: int
    """Iterations of the interior-point method in all quadratic programs (0 where it is not told).
    """
    last_step: float
    """Change in the last iteration, scaled by nominals: the largest of that of the weighted errors
    (root mean square over the horizon), of the inputs applied, and of violations taken away.
    """
    converged: bool
    fallback: bool
    """The SQP failed and IPOPT was asked."""
    failed: bool
    """IPOPT failed too: the inputs are those of the plan before, one step on."""


_COLUMNS = [field.name for field in fields(MpcStep)]
_COUNTS, _FLAGS = ("iterations", "work"), ("converged", "fallback", "failed")


def record(columns: array[float], *values: float) -> None:
    """Append a call's values, in the order of MpcStep: numbers in a row, no objects for the
    collector of garbage to visit while a loop is to be on time.
    """
    columns.extend(values)


def steps_of(columns: array[float]) -> tuple[MpcStep, ...]:
    """What :func:`record` kept."""
    kinds: dict[str, Any] = dict.fromkeys(_COUNTS, int) | dict.fromkeys(_FLAGS, bool)
    size = len(_COLUMNS)
    rows = (columns[k : k + size] for k in range(0, len(columns), size))
    return tuple(
        MpcStep(**{n: kinds.get(n, float)(v) for n, v in zip(_COLUMNS, row, strict=True)})
        for row in rows
    )


@shown
@dataclass(frozen=True)
class MpcStatistics:
    """Of all calls of :meth:`Mpc.control` so far; the first call, which starts cold, apart."""

    steps: tuple[MpcStep, ...]

    @property
    def seconds(self) -> Array:
        """Of each call after the first [s]."""
        return np.array([s.seconds for s in self.steps[1:]] or [math.nan])

    @property
    def median(self) -> float:
        """Median time of a call [s]."""
        return float(np.median(self.seconds))

    @property
    def worst(self) -> float:
        """Longest time of a call [s]."""
        return float(np.max(self.seconds))

    @property
    def fallbacks(self) -> int:
        """How often IPOPT had to be asked."""
        return sum(s.fallback for s in self.steps)

    @property
    def failures(self) -> int:
        """How often there was no solution at all."""
        return sum(s.failed for s in self.steps)

    @property
    def unconverged(self) -> int:
        """How often a solution was applied whose last change was above the controller's tolerance:
        its iterations were used up, or its ``work`` was.
        """
        return sum(not s.converged and not s.failed for s in self.steps)

    @property
    def counts(self) -> dict[str, int]:
        """{"all", "unconverged", "failed": how many calls}."""
        return {
            "all": len(self.steps),
            "unconverged": self.unconverged,
            "failed": self.failures,
        }

    def __str__(self) -> str:
        iterations = [s.iterations for s in self.steps[1:]] or [0]
        return (
            f"{len(self.steps)} steps: median {1e3 * self.median:.2f} ms, worst "
            f"{1e3 * self.worst:.2f} ms, iterations {np.median(iterations):.0f} (at most "
            f"{max(iterations)}), IPOPT asked {self.fallbacks} times, failed {self.failures} "
            f"times, not converged {self.unconverged} times"
        )
