"""Playing a record's inputs to an FMU, as exactly as each mode of FMI allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import PamError
from ..core.trajectory import Trajectory
from .runner import Kind, Runner, UnpackedFmu

Array: TypeAlias = NDArray[np.float64]

_EXCHANGE_TOLERANCE = 1e-11
"""Relative tolerance of CVode in Model Exchange: far below the deviations that are looked for."""
_CURVE_RESIDUAL = 1e-3
"""In Co-Simulation a curved input is played in parts by straight lines with its own mean and first
moment over the part. What is left has neither, so it moves a state of rate r by no more than about
(r part)^3 / 100 of its size, and that is kept below this share of nominal by halving the parts:
with parts below 0.1 / r an error of 1e-8.
"""
_MOST_PARTS = 1024
_PAIRS, _LONGEST_PAIR = 100, 1e-3
"""FMI 3 gives Co-Simulation no slopes of inputs: what is not constant between two samples is played
as at least so many pairs of held values, no pair longer than this [s]. The two values of a pair
have the input's mean and first moment: the error is of fourth order in the pair's length.
"""


@dataclass(frozen=True)
class _Played:
    """Inputs over a grid that has all their breaks: on interval k the polynomials
    sum_j pieces[k, j] (t - times[k])^j; ``values`` are those at the times, to the right of a jump.
    """

    names: list[str]
    times: Array
    pieces: Array
    values: Array
    nominals: Array

    def at(self, k: int, t: Array | float) -> Array:
        """Inputs (times, inputs) by the polynomials of interval k."""
        elapsed = np.atleast_1d(t) - self.times[k]
        return np.asarray(elapsed[:, None] ** np.arange(self.pieces.shape[1]) @ self.pieces[k])

    def is_held(self, k: int) -> bool:
        return not np.any(self.pieces[k, 1:])

    def lines(self, k: int, parts: int) -> tuple[Array, Array, float]:
        """Means and slopes (per part) of lines with the inputs' mean and first moment, and how far
        the inputs are from the lines scaled by nominals."""
        begin, size = self.times[k], (self.times[k + 1] - self.times[k]) / parts
        nodes, weights = np.polynomial.legendre.leggauss(self.pieces.shape[1] // 2 + 2)
        place, weights = (nodes + 1) / 2, weights / 2
        shown = np.concatenate([[0.0], place, [1.0]])
        t = begin + size * (np.arange(parts)[:, None] + shown)
        u = self.at(k, t.ravel()).reshape(*t.shape, -1)
        mean = np.einsum("j,pji->pi", weights, u[:, 1:-1])
        slope = 12 * np.einsum("j,pji->pi", weights * (place - 0.5), u[:, 1:-1])
        line = mean[:, None] + slope[:, None] * (shown - 0.5)[:, None]
        return mean, slope, float(np.max(np.abs(u - line) / self.nominals, initial=0.0))


def _played(record: Trajectory, inputs: list[str]) -> tuple[_Played, NDArray[np.intp]]:
    """The inputs as they run in the record, and where the record's own times are."""
    t, exact = record.t, record.signals
    own = record.named("input") if exact is not None else []
    times = t
    if exact is not None:
        inside = exact.breaks[(exact.breaks > t[0]) & (exact.breaks < t[-1])]
        behind = np.clip(np.searchsorted(t, inside), 1, len(t) - 1)
        apart = np.minimum(np.abs(t[behind] - inside), np.abs(t[behind - 1] - inside))
        times = np.union1d(t, inside[apart > 1e-12 * (1 + np.abs(inside))])
    degree = 1 if exact is None else max(1, exact.degree)
    pieces = np.zeros((len(times) - 1, degree + 1, len(inputs)))
    values = np.zeros((len(times), len(inputs)))
    shifted = None if exact is None else exact.shifted(times)
    for i, name in enumerate(inputs):
        if exact is not None and shifted is not None and name in own:
            column = own.index(name)
            pieces[:, : exact.degree + 1, i] = shifted.coefficients[:, :, column]
            values[:, i] = exact(times)[:, column]
        elif record.interpolation == "linear":
            values[:, i] = np.interp(times, t, record[name])
            pieces[:, 0, i], pieces[:, 1, i] = (
                values[:-1, i],
                np.diff(values[:, i]) / np.diff(times),
            )
        else:
            rows = np.searchsorted(t, times + 1e-12 * (1 + np.abs(times)), side="right") - 1
            values[:, i] = record[name][rows]
            pieces[:, 0, i] = values[:-1, i]
    nominals = np.array([record.variable(n).nominal for n in inputs])
    return _Played(inputs, times, pieces, values, nominals), np.searchsorted(times, t)


def replay(
    fmu: UnpackedFmu,
    kind: Kind,
    record: Trajectory,
    parameters: Mapping[str, float],
    outputs: list[str],
) -> Array:
    """Values of ``outputs`` (times, outputs) at the record's times, its inputs played to an
    instance.

    The record's first row gives the start of states, and the parameters where it has some.
    """
    inputs = [n for n in fmu.names("input") if n in record]
    played, rows = _played(record, inputs)
    given = [*fmu.states, *fmu.names("parameter")]
    start = {n: float(record[n][0]) for n in given if n in record}
    start |= dict(zip(inputs, played.values[0].tolist(), strict=True))
    play = _play_exchange if kind == "ModelExchange" else _play_simulation
    with Runner(fmu, kind) as runner:
        try:
            runner.initialize({**start, **parameters}, float(record.t[0]), None)
            return play(runner, played, outputs)[rows]
        except PamError:
            raise
        except Exception as error:  # FMPy raises plain Exceptions
            raise runner.failure(error) from None


# ---- Co-Simulation ------------------------------------------------------------------------------


def _play_simulation(runner: Runner, played: _Played, outputs: list[str]) -> Array:
    rows = []
    for k, begin in enumerate(played.times):
        runner.change_inputs(dict(zip(played.names, played.values[k].tolist(), strict=True)))
        rows.append(runner.get(outputs))
        if k == len(played.times) - 1:
            break
        if played.is_held(k):
            runner.step(begin, played.times[k + 1] - begin)
        elif runner.fmu.fmi == "2.0":
            _play_slopes(runner, played, k)
        else:
            _play_pairs(runner, played, k)
    return np.array(rows)


def _parts(played: _Played, k: int, least: int) -> tuple[Array, Array, float]:
    """Means and slopes of the lines of interval k, and the length of its parts [s]."""
    parts = least
    mean, slope, left = played.lines(k, parts)
    while left > _CURVE_RESIDUAL and parts < _MOST_PARTS:
        parts *= 2
        mean, slope, left = played.lines(k, parts)
    return mean, slope, float(played.times[k + 1] - played.times[k]) / parts


def _play_slopes(runner: Runner, played: _Played, k: int) -> None:
    """Inputs as lines, by FMI 2's derivatives of inputs."""
    mean, slope, size = _parts(played, k, 1)
    references = runner.references(played.names)
    for i, (middle, rise) in enumerate(zip(mean, slope, strict=True)):
        runner.set(dict(zip(played.names, (middle - rise / 2).tolist(), strict=True)))
        runner.inner.setRealInputDerivatives(references, [1] * len(references), rise / size)
        runner.step(played.times[k] + i * size, size)


def _play_pairs(runner: Runner, played: _Played, k: int) -> None:
    """Inputs as pairs of held values."""
    span = float(played.times[k + 1] - played.times[k])
    mean, slope, size = _parts(played, k, max(_PAIRS, int(np.ceil(span / _LONGEST_PAIR))))
    for i, (middle, rise) in enumerate(zip(mean, slope, strict=True)):
        for half, value in enumerate((middle - rise / 3, middle + rise / 3)):
            runner.set(dict(zip(played.names, value.tolist(), strict=True)))
            runner.step(played.times[k] + (i + half / 2) * size, size / 2)


# ---- Model Exchange -----------------------------------------------------------------------------


def _play_exchange(runner: Runner, played: _Played, outputs: list[str]) -> Array:
    """CVode; inputs are the record's own polynomials, however curved."""
    interval = 0
    moving = bool(np.any(played.pieces[:, 1:]))

    def inputs(time: float) -> dict[str, float]:
        return dict(zip(played.names, played.at(interval, time)[0].tolist(), strict=True))

    t = played.times
    solver = runner.integrator(float(t[0]), _EXCHANGE_TOLERANCE, inputs if moving else None)
    rows = []
    for k, (begin, end) in enumerate([*pairwise(t), (t[-1], t[-1])]):
        here = dict(zip(played.names, played.values[k].tolist(), strict=True))
        if k > 0:
            jump = played.at(k - 1, begin)[0] != played.values[k]
            if not moving and np.any(jump):
                runner.change_inputs(here)
            if moving or np.any(jump):
                solver.reset(begin)
        runner.set(here)
        rows.append(runner.get(outputs))
        if begin < end:
            interval = k
            solver.step(begin, end)
            runner.inner.setTime(end)
    return np.array(rows)
