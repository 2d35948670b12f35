"""Slow ramps of thousands of rows as cells: branch by branch, level by level, repeat by repeat.

A quasi-static record holds contraction (or pressure) and lets the other rise and fall. Neighbouring
rows of it are no independent measurements: they are binned, with the scatter of the rows in a cell
and the error of its mean, which counts how the rows follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Cell", "Ramp", "floor_of", "ramp_of"]

Array: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = NDArray[np.intp]

FEWEST = 400
"""Rows below which a table is taken cell by cell."""
FINE = 0.012
"""Of the range: steps between rows of a ramp are smaller, those between cells of a table larger."""
TURN = 0.1
"""Of the range: a reversal smaller than this is no new branch."""
RESTING = 0.2
"""Of a branch's mean slope: where the ramp is slower, it dwells."""
BINS = 20
"""Cells over the whole range of a ramp."""
LEAST_ROWS = 3
"""Of a cell."""
SPANS = 0.004
"""Contractions, and 0.02 of the largest pressure, within which all is one level."""


@dataclass(frozen=True)
class Cell:
    """Rows that make one cell; scatter [N] of their forces about a line, error [N] of their mean."""

    rows: Rows
    branch: str
    run: str
    scatter: float
    error: float


@dataclass(frozen=True)
class Ramp:
    """A ramp as cells. held : what stood still in each branch. dwell, transit : rows left out while
    nothing moved, and on the way between levels. correlation : of neighbouring rows' errors.
    """

    held: Literal["contraction", "pressure"]
    levels: int
    pieces: int
    repeats: int
    stairs: bool
    dwell: int
    transit: int
    correlation: float
    cells: tuple[Cell, ...]

    def __str__(self) -> str:
        moved = "pressure" if self.held == "contraction" else "contraction"
        kind = "stairs" if self.stairs else "ramps"
        names = list(dict.fromkeys(c.branch for c in self.cells))
        return (
            f"{self.pieces} {kind} of {moved} ({' and '.join(names)}) at {self.levels} "
            f"level{'s' * (self.levels != 1)} of {self.held}, up to {self.repeats} "
            f"repeat{'s' * (self.repeats != 1)} -> {len(self.cells)} cells; left out: {self.dwell} "
            f"rows of dwell, {self.transit} between levels; neighbouring rows correlate by "
            f"{self.correlation:.2f}"
        )


def floor_of(force: Array) -> float | None:
    """The value at which a sensor stops, where it returns again and again to its least; or None.

    A value that is clipped stands in many rows exactly, its neighbours by chance in few.
    """
    values, counts = np.unique(force, return_counts=True)
    if values.size < 5 or counts[0] < max(5, 0.02 * force.size):
        return None
    usual = float(np.percentile(counts[1:], 95))
    return float(values[0]) if counts[0] >= 5 * usual else None


def ramp_of(pressure: Array, contraction: Array, force: Array, asked: bool = False) -> Ramp | None:
    """The ramp that these rows are, in the order in which they were measured; None for a table.

    asked : the user says that it is one: fewer rows and larger steps will do.
    """
    n = pressure.size
    if n < (40 if asked else FEWEST):
        return None
    width = int(np.clip(n // 1500, 1, 25)) * 2 + 1
    p, k = (_smooth(v, width) for v in (pressure, contraction))
    span_p, span_k = float(np.ptp(p)), float(np.ptp(k))
    steady_p = span_p < 0.02 * max(float(np.max(np.abs(p))), 1.0)
    steady_k = span_k < SPANS
    if steady_p and steady_k:
        return None
    steps = [
        np.abs(np.diff(v)) / s
        for v, s, q in ((p, span_p, steady_p), (k, span_k, steady_k))
        if not q
    ]
    if not asked and float(np.median(np.max(steps, axis=0))) > FINE:
        return None
    held: Literal["contraction", "pressure"]
    if steady_k or (not steady_p and _occupied(k) <= _occupied(p)):
        held, still, moving, steady = "contraction", k, p, steady_k
    else:
        held, still, moving, steady = "pressure", p, k, steady_p
    levels = np.zeros(n, np.intp) if steady else _levels(still)
    if levels is None:
        return None
    return _cells(levels, moving, force, held)


def _smooth(values: Array, width: int) -> Array:
    """Running mean, shorter at the ends."""
    ones = np.ones(width)
    return np.asarray(
        np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same")
    )


def _occupied(values: Array) -> int:
    """Of a hundred bins over the range those that hold nine tenths of the rows."""
    counts = np.sort(np.histogram(values, 100)[0])[::-1]
    return int(np.searchsorted(np.cumsum(counts), 0.9 * values.size)) + 1


def _levels(still: Array) -> Rows | None:
    """Number of the level of each row, -1 on the way between; None where there are none."""
    bins = 200
    counts, edges = np.histogram(still, bins)
    dense = counts > max(2.0, 0.5 * still.size / bins)
    starts = np.nonzero(dense & ~np.concatenate([[False], dense[:-1]]))[0]
    ends = np.nonzero(dense & ~np.concatenate([dense[1:], [False]]))[0]
    if not starts.size or float(np.sum(ends - starts + 1)) > 0.6 * bins:
        return None
    found = np.full(still.size, -1, np.intp)
    step = edges[1] - edges[0]
    for number, (a, b) in enumerate(zip(starts, ends, strict=True)):
        found[(still >= edges[a] - step) & (still <= edges[b + 1] + step)] = number
    return found


def _stretches(labels: Rows) -> Iterator[tuple[int, int]]:
    """(first, behind last) of stretches of one label."""
    cuts = np.concatenate([[0], np.nonzero(np.diff(labels))[0] + 1, [labels.size]])
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        yield int(a), int(b)


def _turns(values: Array, least: float) -> list[int]:
    """Where a series turns, by more than ``least`` each; its ends, too."""
    low = high = 0
    turns, rising = [0], 0
    for i, v in enumerate(values.tolist()):
        if v < values[low]:
            low = i
        if v > values[high]:
            high = i
        if rising >= 0 and values[high] - v > least:
            turns += [high] if rising or high else []
            rising, low = -1, i
            high = i
        elif rising <= 0 and v - values[low] > least:
            turns += [low] if rising or low else []
            rising, high = 1, i
            low = i
        if rising > 0 and v >= values[high]:
            low = i
        if rising < 0 and v <= values[low]:
            high = i
    return sorted({*turns, values.size - 1})


def _cells(levels: Rows, moving: Array, force: Array, held: str) -> Ramp | None:
    names = ("inflation", "deflation") if held == "contraction" else ("shortening", "lengthening")
    span = float(np.ptp(moving))
    shortest = max(12, moving.size // 2000)
    pieces: list[tuple[int, str, Rows, Rows]] = []  # level, branch, rows, which of them rest
    transit = int(np.sum(levels < 0))
    for a, b in _stretches(levels):
        if levels[a] < 0:
            continue
        if b - a < shortest:
            transit += b - a
            continue
        turns = _turns(moving[a:b], TURN * span)
        for first, last in zip(turns[:-1], turns[1:], strict=True):
            rows = np.arange(a + first, a + last + 1)
            change = moving[rows[-1]] - moving[rows[0]]
            if rows.size >= 6 and abs(change) > TURN * span:
                resting = _resting(moving[rows], abs(float(change)))
                pieces.append((int(levels[a]), names[change < 0], rows, resting))
            else:
                transit += rows.size
    if not pieces:
        return None
    share = float(np.mean(np.concatenate([resting for *_, resting in pieces])))
    stairs = share > 0.5
    usual = float(np.median([np.sum(~r) for *_, r in pieces]))
    count = int(np.clip(usual // 8, 5, BINS))
    edges = np.linspace(moving.min(), moving.max() + 1e-12 * span, count + 1)
    repeats: dict[tuple[int, str], int] = {}
    groups: list[tuple[str, str, Rows]] = []
    for level, branch, rows, resting in pieces:
        repeats[level, branch] = run = repeats.get((level, branch), 0) + 1
        parts = _stairs(rows, resting) if stairs else _binned(rows[~resting], moving, edges)
        groups += [(branch, str(run), part) for part in parts]
    rho, scatters = _scatter([g[2] for g in groups], moving, force)
    wide = float(np.sqrt((1 + rho) / (1 - rho)))
    cells = tuple(
        Cell(rows, branch, run, s, s * wide / np.sqrt(rows.size))
        for (branch, run, rows), s in zip(groups, scatters, strict=True)
    )
    dwell = 0 if stairs else int(sum(r.sum() for *_, r in pieces))
    number = len({level for level, *_ in pieces})
    most = max(repeats.values())
    return Ramp(
        "contraction" if held == "contraction" else "pressure",
        number, len(pieces), most, stairs, dwell, transit, rho, cells,
    ) if cells else None  # fmt: skip


def _resting(values: Array, change: float) -> NDArray[np.bool_]:
    """Rows of a branch at which next to nothing moves."""
    half = max(3, values.size // 100)
    index = np.arange(values.size)
    before, behind = np.maximum(index - half, 0), np.minimum(index + half, values.size - 1)
    slope = np.abs(values[behind] - values[before]) / np.maximum(behind - before, 1)
    return np.asarray(slope < RESTING * change / values.size)


def _binned(rows: Rows, moving: Array, edges: Array) -> list[Rows]:
    places = np.searchsorted(edges, moving[rows], side="right")
    found = [rows[places == i] for i in np.unique(places)]
    return [part for part in found if part.size >= LEAST_ROWS]


def _stairs(rows: Rows, resting: NDArray[np.bool_]) -> list[Rows]:
    """The second half of each dwell, when the force has settled."""
    found = [rows[(a + b) // 2 : b] for a, b in _stretches(resting.astype(np.intp)) if resting[a]]
    return [part for part in found if part.size >= LEAST_ROWS]


def _scatter(groups: list[Rows], moving: Array, force: Array) -> tuple[float, list[float]]:
    """(correlation of neighbouring rows, standard deviation of each cell's rows about a line)."""
    found, products, squares = [], 0.0, 0.0
    for rows in groups:
        x = moving[rows] - moving[rows].mean()
        y = force[rows] - force[rows].mean()
        size = float(x @ x)
        rest = y - x * (float(x @ y) / size if size > 0 else 0.0)
        found.append(float(np.sqrt(rest @ rest / max(1, rows.size - 2))))
        products += float(rest[1:] @ rest[:-1])
        squares += float(rest @ rest) * (rows.size - 1) / rows.size
        # two coefficients of each cell's line take away from the correlation of its residuals
    rho = products / squares if squares > 0 else 0.0
    size = float(np.mean([rows.size for rows in groups])) if groups else 1.0
    return float(np.clip(rho + 2 * (1 + rho) / max(size, 4.0), 0.0, 0.98)), found
