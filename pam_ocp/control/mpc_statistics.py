"""What a model predictive controller's steps took, and how they ended."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ..core.shown import shown
from .kinds import Array


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


_COLUMNS = [f.name for f in fields(MpcStep)]
_COUNTS, _FLAGS = ("iterations", "work"), ("converged", "fallback", "failed")
KEPT = 20_000
"""Latest calls of which all is kept: a controller may run for days."""


class Calls:
    """The values of calls, in the order of MpcStep: of the first and the latest in a ring of
    numbers, no objects for the collector of garbage to visit while a loop is to be on time; of
    those between, how many ended how.
    """

    def __init__(self) -> None:
        self.count = 0
        self._columns = array("d")
        self._dropped = dict.fromkeys(_ENDS, 0)

    def record(self, *values: float) -> None:
        """Enter a call."""
        if self.count > KEPT:
            at = len(_COLUMNS) * self._oldest
            place = slice(at, at + len(_COLUMNS))
            for name, number in _ends(_step(self._columns[place])).items():
                self._dropped[name] += number
            self._columns[place] = array("d", values)
        else:
            self._columns.extend(values)
        self.count += 1

    @property
    def _oldest(self) -> int:
        """The row behind which the ring goes on."""
        return 1 + (self.count - 1) % KEPT if self.count > KEPT else 1

    @property
    def statistics(self) -> MpcStatistics:
        size = len(_COLUMNS)
        rows = [self._columns[k : k + size] for k in range(0, len(self._columns), size)]
        ordered = rows[:1] + rows[self._oldest :] + rows[1 : self._oldest]
        return MpcStatistics(tuple(map(_step, ordered)), dict(self._dropped))


def _step(row: array[float]) -> MpcStep:
    kinds: dict[str, Any] = dict.fromkeys(_COUNTS, int) | dict.fromkeys(_FLAGS, bool)
    return MpcStep(**{n: kinds.get(n, float)(v) for n, v in zip(_COLUMNS, row, strict=True)})


_ENDS = ("all", "unconverged", "failed", "fallback")


def _ends(step: MpcStep) -> dict[str, int]:
    """What a call adds to the numbers of calls that ended so."""
    ended = (1, not step.converged and not step.failed, step.failed, step.fallback)
    return dict(zip(_ENDS, map(int, ended), strict=True))


@shown
@dataclass(frozen=True)
class MpcStatistics:
    """Of all calls of :meth:`Mpc.control` so far; the first call, which starts cold, apart."""

    steps: tuple[MpcStep, ...]
    """The first call, and the latest 20 000."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Of the calls between: how many there were, and how many ended how (see ``counts``)."""

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

    def _number(self, end: str) -> int:
        return self.dropped.get(end, 0) + sum(_ends(s)[end] for s in self.steps)

    @property
    def fallbacks(self) -> int:
        """How often IPOPT had to be asked."""
        return self._number("fallback")

    @property
    def failures(self) -> int:
        """How often there was no solution at all."""
        return self._number("failed")

    @property
    def unconverged(self) -> int:
        """How often a solution was applied whose last change was above the controller's tolerance:
        its iterations were used up, or its ``work`` was.
        """
        return self._number("unconverged")

    @property
    def counts(self) -> dict[str, int]:
        """{"all", "unconverged", "failed": how many calls}."""
        return {n: self._number(n) for n in ("all", "unconverged", "failed")}

    def __str__(self) -> str:
        iterations = [s.iterations for s in self.steps[1:]] or [0]
        return (
            f"{self.counts['all']} steps: median {1e3 * self.median:.2f} ms, worst "
            f"{1e3 * self.worst:.2f} ms, iterations {np.median(iterations):.0f} (at most "
            f"{max(iterations)}), IPOPT asked {self.fallbacks} times, failed {self.failures} "
            f"times, not converged {self.unconverged} times"
        )
