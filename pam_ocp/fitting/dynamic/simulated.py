"""Least squares by simulation: residuals of accurate runs, slopes by differences.

For plants whose equations have kinks that no polynomial over a sampling interval follows: slip
elements, play, softening. Nothing but parameters and starts is unknown; a simulation meets every
kink where it is, and where a step of a parameter moves it, the residuals follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import PamError
from ...core.signals import PiecewisePolynomial
from ...plants.plant import Plant
from ...simulation.simulator import simulate
from ..statistics import Array
from .experiment import Experiment
from .transcribe import Unknowns, head_of

__all__ = ["SimulatedProgram"]

RTOL = 1e-8
STEP = 1e-4
"""Of differences, in the unknowns' own sizes: the runs' error is some 1e-4 of what it moves."""
DIVERGED = 1e3
"""Residual, in nominals, of a motion that cannot be simulated."""


class SimulatedProgram:
    """What a search asks of a program, with nothing unknown but its head; see FitProgram."""

    jumps = 0

    def __init__(self, plant: Plant, experiments: Sequence[Experiment], unknowns: Unknowns) -> None:
        self._plant, self._experiments, self._unknowns = plant, experiments, unknowns
        self._nominal = np.array([plant.variable(n).nominal for n in unknowns.names])
        self.guess, self.low, self.high, self.head_scale = head_of(plant, experiments, unknowns)
        self.head = self.guess.size

    def residuals(self, w: Array) -> Array:
        """Measured less simulated, (K, ny) in nominals."""
        plant, u = self._plant, self._unknowns
        values = w * self.head_scale
        first = len(u.groups)
        parameters = {
            plant.parameters[m].name: float(v)
            for g, v in zip(u.groups, values, strict=False)
            for m in g.members
        }
        sensor = np.ones(len(u.names)), np.zeros(len(u.names))
        for places, column in ((u.gains, sensor[0]), (u.offsets, sensor[1])):
            for place in places:
                column[place] += values[first]
                first += 1
        delay = u.delay
        if u.delay_bounds is not None:
            delay = float(values[first])
            first += 1
        starts = values[first:].reshape(len(self._experiments), -1)
        parts = []
        for e, x0 in zip(self._experiments, starts, strict=True):
            start = {
                v.name: float(np.clip(x, v.min, v.max))
                for v, x in zip(plant.states, x0, strict=True)
            }
            try:
                modelled = self._run(e, start, parameters, delay) * sensor[0] + sensor[1]
                parts.append((e.measured - modelled) / self._nominal)
            except PamError:
                parts.append(np.full(e.measured.shape, DIVERGED))
        return np.concatenate(parts)

    def _run(
        self,
        e: Experiment,
        start: Mapping[str, float],
        parameters: Mapping[str, float],
        delay: float,
    ) -> Array:
        times = e.t - delay
        times[0] = max(times[0], e.mesh[0])
        grid = times if times[0] <= e.mesh[0] else np.concatenate([e.mesh[:1], times])
        inputs = PiecewisePolynomial(e.mesh, e.coefficients)
        run = simulate(
            self._plant, inputs, t=grid, start=dict(start), parameters=dict(parameters), rtol=RTOL
        )
        return run.array(list(self._unknowns.names))[len(grid) - len(times) :]

    def jacobian(self, weights: Array, w: Array) -> Array:
        """d(weighted residuals)/d(w), (K ny, head): central differences, one-sided at bounds."""
        columns = []
        for i in range(w.size):
            size = STEP * max(1.0, abs(w[i]))
            ends = np.clip([w[i] - size, w[i] + size], self.low[i], self.high[i])
            moved = [np.where(np.arange(w.size) == i, end, w) for end in ends]
            below, above = (self.residuals(z) for z in moved)
            columns.append(((above - below) * weights).ravel() / (ends[1] - ends[0]))
        return np.stack(columns, axis=1)

    def solve(
        self,
        weights: Array,
        guess: Array,
        evaluations: int,
        seen: Callable[[Any, Any, Any], None],
    ) -> Any:
        """SciPy's trust-region method; TimeIsUp passes."""
        from scipy.optimize import least_squares

        def compute(z: Array) -> Array:
            found = (self.residuals(z) * weights).ravel()
            seen(z, float(found @ found) / 2, 0.0)
            return found

        inside = 1e-9 * (1 + np.abs(guess))
        return least_squares(
            compute,
            np.clip(guess, self.low + inside, self.high - inside),
            diff_step=STEP,
            bounds=(self.low, self.high),
            x_scale="jac",
            xtol=1e-7,
            ftol=1e-9,
            gtol=1e-9,
            max_nfev=evaluations,
        )
