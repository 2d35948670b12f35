"""The inputs of a record as free runs take them: at the edges of all steps, late by dead times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..statistics import Array

__all__ = ["RunInputs"]


@dataclass(frozen=True, eq=False)
class RunInputs:
    """t (n,), u (n, nu): samples, joined by lines or ``held``; ``steps`` of the integration from
    sample to sample. Before the first sample its value held.
    """

    t: Array
    u: Array
    held: bool
    steps: int

    def edges(self, delays: Array) -> tuple[Array, Array, Array, Array]:
        """Inputs at the begin and the end of each step, and what they gain there per second of
        delay: (n - 1, steps, nu) each.

        An input that is held counts in each step as its mean there: that is right to the order of
        the step wherever in it the input jumps, and depends on the delay without jumps.
        """
        part = np.arange(self.steps + 1) / self.steps
        grid = self.t[:-1, None] + part * np.diff(self.t)[:, None]
        parts = [self._one(i, grid - d) for i, d in enumerate(delays)]
        if not parts:
            empty = np.empty((len(self.t) - 1, self.steps, 0))
            return empty, empty, empty, empty
        begin, end, early, late = (np.stack(c, axis=-1) for c in zip(*parts, strict=True))
        return begin, end, early, late

    def _one(self, i: int, grid: Array) -> tuple[Array, Array, Array, Array]:
        t, u = self.t, self.u[:, i]
        if self.held:
            before = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
            since = np.minimum(grid - t[0], 0.0) * u[0]
            integral = np.interp(grid, t, before) + since
            value = self._held(u, grid)
            h = np.diff(grid, axis=1)
            mean, slope = np.diff(integral, axis=1) / h, -np.diff(value, axis=1) / h
            return mean, mean, slope, slope
        value = np.interp(grid, t, u)
        slopes = np.concatenate([[0.0], np.diff(u) / np.diff(t)])
        # the line that a moment lies on when the delay grows: the one to its left
        slope = -slopes[np.clip(np.searchsorted(t, grid - 1e-9 * (t[1] - t[0])), 0, len(t) - 1)]
        return value[:, :-1], value[:, 1:], slope[:, :-1], slope[:, 1:]

    def _held(self, u: Array, grid: Array) -> Array:
        place = np.searchsorted(self.t, grid + 1e-9 * (self.t[1] - self.t[0]), side="right") - 1
        return np.asarray(u[np.clip(place, 0, len(u) - 1)])
