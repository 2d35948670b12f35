"""Slow ramps of thousands of rows as cells: branch by branch, level by level, repeat by repeat.

A quasi-static record holds contraction (or pressure) and lets the other rise and fall. Neighbouring
rows of it are no independent measurements: they are binned, with the scatter of the rows in a cell
and the error of its mean, which counts how the rows follow each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = NDArray[np.intp]
FEWEST = 400
"""Rows below which a table is taken cell by cell."""
FINE = 0.006
"""Of the range: steps between rows of a ramp are smaller, those between cells of a table larger."""
TURN = 0.1
"""Of the range: a reversal smaller than this is no new branch."""
RESTING = 0.2
"""Of a branch's mean slope: where the ramp is slower, it dwells."""
BINS = 20
"""Cells over the whole range of a ramp."""
LAGS = 4
"""Distances of rows at which their errors are compared."""
LEAST_ROWS = 3
"""Of a cell."""
SPANS = 0.004
"""Contractions, and 0.02 of the largest pressure, within which all is one level."""


@dataclass(frozen=True)
class Cell:
    """Rows that make one cell; scatter [N] of their forces about a line, error [N] of the mean."""

    rows: Rows
    branch: str
    run: str
    scatter: float
    error: float


@dataclass(frozen=True)
class Ramp:
    """A ramp as cells. words : what it was, and which rows were left out."""

    cells: tuple[Cell, ...]
    words: str


def floor_of(force: Array) -> float | None:
    """The value, exactly the same in many rows, at which a sensor clips its least; or None."""
    values, counts = np.unique(force, return_counts=True)
    if values.size < 5 or counts[0] < max(5, 0.002 * force.size):
        return None
    usual = float(np.percentile(counts[1:], 95))
    return float(values[0]) if counts[0] >= 5 * usual else None


def ramp_of(pressure: Array, contraction: Array, force: Array, asked: bool = False) -> Ramp | None:
    """The ramp that these rows are, as measured; None for a table. ``asked`` by the user: more
    lenient.
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
    for a, b in pairwise(cuts.tolist()):
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


@dataclass(frozen=True)
class _Piece:
    """A branch at a level: its rows, and which of them rest."""

    level: int
    branch: str
    rows: Rows
    resting: NDArray[np.bool_]


def _pieces(levels: Rows, moving: Array, names: tuple[str, str]) -> tuple[list[_Piece], int]:
    """(branches from turn to turn at each level, rows that belong to none)."""
    span, shortest = float(np.ptp(moving)), max(12, moving.size // 2000)
    found: list[_Piece] = []
    outside = 0
    for a, b in _stretches(levels):
        if levels[a] < 0 or b - a < shortest:
            outside += b - a
            continue
        for first, last in pairwise(_turns(moving[a:b], TURN * span)):
            rows = np.arange(a + first, a + last + 1)
            change = float(moving[rows[-1]] - moving[rows[0]])
            if rows.size >= 6 and abs(change) > TURN * span:
                resting = _resting(moving[rows], abs(change))
                found.append(_Piece(int(levels[a]), names[int(change < 0)], rows, resting))
            else:
                outside += rows.size
    return found, outside


def _cells(
    levels: Rows, moving: Array, force: Array, held: Literal["contraction", "pressure"]
) -> Ramp | None:
    names = ("inflation", "deflation") if held == "contraction" else ("shortening", "lengthening")
    pieces, outside = _pieces(levels, moving, names)
    if not pieces:
        return None
    stairs = float(np.mean(np.concatenate([p.resting for p in pieces]))) > 0.5
    usual = float(np.median([np.sum(~p.resting) for p in pieces]))
    count = int(np.clip(usual // 8, 5, BINS))
    edges = np.linspace(moving.min(), moving.max() + 1e-12 * float(np.ptp(moving)), count + 1)
    repeats: Counter[tuple[int, str]] = Counter()
    groups: list[tuple[str, str, Rows]] = []
    for piece in pieces:
        repeats[piece.level, piece.branch] += 1
        run = str(repeats[piece.level, piece.branch])
        parts = _stairs(piece) if stairs else _binned(piece.rows[~piece.resting], moving, edges)
        groups += [(piece.branch, run, part) for part in parts]
    if not groups:
        return None
    rho, wide, scatters = _scatter([rows for *_, rows in groups], moving, force)
    cells = tuple(
        Cell(rows, branch, run, s, float(s * wide / np.sqrt(rows.size)))
        for (branch, run, rows), s in zip(groups, scatters, strict=True)
    )
    moved = "pressure" if held == "contraction" else "contraction"
    heights, most = len({p.level for p in pieces}), max(repeats.values())
    dwell = 0 if stairs else sum(int(p.resting.sum()) for p in pieces)
    words = (
        f"{len(pieces)} {'stairs' if stairs else 'ramps'} of {moved} "
        f"({' and '.join(dict.fromkeys(c.branch for c in cells))}) at {heights} "
        f"level{'s' * (heights != 1)} of {held}, up to {most} repeat{'s' * (most != 1)} -> "
        f"{len(cells)} cells; left out: {dwell} rows of dwell, {outside} between levels; "
        f"neighbouring rows correlate by {rho:.2f}"
    )
    return Ramp(cells, words)


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


def _stairs(piece: _Piece) -> list[Rows]:
    """The second half of each dwell, when the force has settled."""
    found = [
        piece.rows[(a + b) // 2 : b]
        for a, b in _stretches(piece.resting.astype(np.intp))
        if piece.resting[a]
    ]
    return [part for part in found if part.size >= LEAST_ROWS]


def _scatter(groups: list[Rows], moving: Array, force: Array) -> tuple[float, float, list[float]]:
    """(correlation of neighbours, factor by which a mean's error widens, scatter of each cell)."""
    found, products, counts = [], [], []
    for rows in groups:
        x = moving[rows] - moving[rows].mean()
        y = force[rows] - force[rows].mean()
        size = float(x @ x)
        rest = y - x * (float(x @ y) / size if size > 0 else 0.0)
        squares = float(rest @ rest)
        found.append(float(np.sqrt(squares / max(1, rows.size - 2))))
        if rows.size >= LAGS + 4 and squares > 0:
            products.append([rest[k:] @ rest[:-k] / squares for k in range(1, LAGS + 1)])
            counts.append(rows.size)
    if not products:
        return 0.0, 1.0, found
    one, wide = _memory(np.mean(products, axis=0), int(min(np.median(counts), 80)))
    return one, wide, found


def _memory(seen: Array, n: int) -> tuple[float, float]:
    """(correlation of neighbours, factor of the error of a mean) of errors whose residuals about
    lines, n rows each, follow each other as seen. AR(1) with rho of a share c, and white noise. A
    line leaves M R M, R_ij = c rho^|i-j|, M = 1 - projector: (rho, c) is taken whose residuals look
    as these do.
    """
    line = np.linalg.qr(np.column_stack([np.ones(n), np.linspace(-1, 1, n)]))[0]
    left = np.eye(n) - line @ line.T
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    best = (np.inf, 0.0, 1.0)
    for rho in np.linspace(0.0, 0.98, 50):
        slow = rho**apart
        for share in np.linspace(0.1, 1.0, 10) if rho else (0.0,):
            matrix = share * slow + (1 - share) * np.eye(n)
            rest = left @ matrix @ left
            whole = float(np.trace(rest))
            expected = [float(np.trace(rest, k)) / whole for k in range(1, LAGS + 1)]
            misfit = float(np.sum((seen - expected) ** 2))
            if misfit < best[0]:
                of_mean = float(matrix.sum()) / n**2 * (n - 2) / whole  # per s^2
                best = (misfit, float(share * rho), float(np.sqrt(of_mean * n)))
    return best[1], best[2]
