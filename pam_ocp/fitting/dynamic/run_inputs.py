"""The inputs of a record as free runs take them: in the steps of the integration, late by dead
times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..statistics import Array

__all__ = ["RunInputs", "RunSteps"]


@dataclass(frozen=True, eq=False)
class RunSteps:
    """Inputs at the begins and ends of steps, and what they gain per second of delay, (n - 1,
    steps, nu) each; lengths of the steps (n - 1, steps) [s], and what these gain per second of each
    input's delay (steps, nu).
    """

    begin: Array
    end: Array
    begin_slope: Array
    end_slope: Array
    length: Array
    length_slope: Array


@dataclass(frozen=True, eq=False)
class RunInputs:
    """t (n,), u (n, nu): samples, joined by lines or ``held``. Before the first sample its value
    held.
    """

    t: Array
    u: Array
    held: bool

    def steps(self, delays: Array, late: Sequence[tuple[int, ...]], count: int) -> RunSteps:
        """In ``count`` steps of each sampling interval.

        delays : of each input [s]. late : inputs that are late, those of one delay together. Held
        ones jump inside of the intervals: there a step ends and the next begins, so that none has
        to do with two values and their motion depends on the delay without jumps.
        """
        if self.held:
            return self._between_jumps(delays, late, count)
        part = np.arange(count + 1) / count
        spans = np.diff(self.t)
        grid = self.t[:-1, None] + part * spans[:, None]
        found = [self._line(i, grid - d) for i, d in enumerate(delays)]
        length = np.repeat(spans[:, None] / count, count, axis=1)
        still = np.zeros((count, len(delays)))
        if not found:
            empty = np.empty((len(spans), count, 0))
            return RunSteps(empty, empty, empty, empty, length, still)
        value, slope = (np.stack(c, axis=-1) for c in zip(*found, strict=True))
        edges = value[:, :-1], value[:, 1:], slope[:, :-1], slope[:, 1:]
        return RunSteps(*edges, length, still)

    def _line(self, i: int, at: Array) -> tuple[Array, Array]:
        """Values, and what they gain per second of delay."""
        t, u = self.t, self.u[:, i]
        slopes = np.concatenate([[0.0], np.diff(u) / np.diff(t)])
        # the line that a moment lies on when the delay grows: the one to its left
        left = np.clip(np.searchsorted(t, at - 1e-9 * (t[1] - t[0])), 0, len(t) - 1)
        return np.interp(at, t, u), -slopes[left]

    def _between_jumps(
        self, delays: Array, late: Sequence[tuple[int, ...]], count: int
    ) -> RunSteps:
        n = len(self.t) - 1
        sampling = (self.t[-1] - self.t[0]) / n
        whole, part = _whole_and_part(delays / sampling)
        rank = sorted(range(len(late)), key=lambda g: part[late[g][0]])
        jumps = np.array([part[late[g][0]] for g in rank])
        ends = np.concatenate([[0.0], jumps, [1.0]])
        shares = _shared(np.diff(ends), count)
        between = np.repeat(np.arange(len(shares)), shares)  # the jumps that each step lies behind
        order = np.full(len(delays), -1)
        for k, g in enumerate(rank):
            order[list(late[g])] = k
        passed = between[None, :] > order[:, None]
        place = np.arange(n)[:, None, None] - (whole[:, None] + 1 - passed).T
        value = np.take_along_axis(self.u[:, None, :], np.clip(place, 0, n), axis=0)
        slope = np.zeros((len(shares), len(delays)))
        for k, g in enumerate(rank):
            slope[k, late[g][0]] += 1.0
            slope[k + 1, late[g][0]] -= 1.0
        still = np.zeros_like(value)
        length = np.diff(self.t)[:, None] * (np.diff(ends) / shares)[between]
        return RunSteps(value, value, still, still, length, (slope / shares[:, None])[between])


def _whole_and_part(number: Array) -> tuple[NDArray[np.intp], Array]:
    whole = np.floor(number + 1e-9)
    return whole.astype(np.intp), np.clip(number - whole, 0.0, 1.0)


def _shared(spans: Array, count: int) -> NDArray[np.intp]:
    """``count`` steps over parts of an interval: one to each at least, the others to where steps
    are longest.
    """
    found = np.ones(len(spans), dtype=np.intp)
    for _ in range(count - len(spans)):
        found[int(np.argmax(spans / found))] += 1
    return found
