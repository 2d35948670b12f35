"""What a load cell shows while the muscle is slack: found in a table, and named.

A muscle cannot push, so a measured force is y = max(S, f) + error: a surface S over pressure and
contraction where it is taut, the floor f where it is slack (the load cell's zero, friction, an
amplifier's offset). This is a Tobit model whose limit is not known (T. Zuehlke, Applied Economics
35 (2003) 1163-1169). It is fitted as a hinge (L. Breiman, IEEE Trans. Inf. Theory 39 (1993)
999-1013): S by least squares to the cells above, f the mean of those where S lies below f, in
turns. S is a polynomial whose degree Akaike's criterion chooses: no force law is assumed, so laws
are compared on the same cells. A reading below the detection limit f + 3.29 scatter (L. Currie,
Anal. Chem. 40 (1968) 586-593) is no force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]
DETECTED = 3.29
"""Standard deviations above the floor from which a reading is a force (1 in 2000 lies above)."""
DEEP = 4.0
"""Standard errors, and scatters of the floor, by which S must lie below it to count as evidence."""
FLAT = 0.05
"""Part of a change of S that the readings of slack cells may follow; those of taut ones do wholly.
"""
CHANCE = 1e-3
"""Probability that taut cells crowd together as those at the floor do, from which there is none."""
RELATIVE, ABSOLUTE = 0.05, 0.005
"""Error of S, in parts of the reading and of the largest one: near the floor it must fit best."""
DEGREES = ((1, 1), (1, 2), (1, 3), (1, 4), (2, 2), (2, 3), (2, 4), (3, 2), (3, 3))
"""Of S, in pressure and contraction."""
DRIFT = 0.8
"""Correlation from which readings follow the rows, or pressure."""
LOWEST = 0.1
"""Of the largest reading: a table whose least lies above it shows no slack cell."""
CROWD, APART = 3, 5.0
"""Readings below zero that are evidence by themselves, at least, and scatters that they lie there.
"""
STARTS, ROUNDS, FEWEST, ENOUGH = 14, 25, 8, 1500


@dataclass(frozen=True)
class Floor:
    """What slack cells read.

    value, stderr : their mean, and its standard error [N]. scatter : their standard deviation [N].
    cells : their number; above : of those, how many read a positive force. limit : below it a
    reading is no force [N]. by : {branch or file: mean}, where these differ. trend : in words, how
    the readings change along the table; "" when they do not.

    Examples
    --------
    >>> reads = np.where(table.slack, 5.0, table.force)  # 5 N wherever the muscle is slack
    >>> shown = pam.fitting.ForceTable(table.pressure, table.contraction, reads)
    >>> shown.floor_found.value, len(shown.taut) == len(table.taut)
    (5.0, True)
    """

    value: float
    stderr: float
    scatter: float
    cells: int
    above: int
    limit: float
    by: Mapping[str, float] = field(default_factory=dict)
    trend: str = ""

    def __str__(self) -> str:
        size = f"{self.value:.3g} ± {self.stderr:.2g} N"
        parts = ", ".join(f"{v:.3g} N on {n}" for n, v in self.by.items())
        return (
            f"{self.cells} cells read {size}{f' ({parts})' if parts else ''} where the muscle is "
            f"slack, {self.above} of them a positive force{self.trend}: they count as slack"
        )

    @property
    def matters(self) -> bool:
        """Whether it is worth a word: cells would pass for taut, or the readings are not zero."""
        return self.above > 0 or self.shifted

    @property
    def shifted(self) -> bool:
        """Whether the readings are not about zero."""
        return abs(self.value) > max(3 * self.stderr, 1e-9) or bool(self.by)


class _Cells(NamedTuple):
    """x, k : pressure and contraction, scaled. weights : of the surface. branch, part : numbers of
    the branch, and of the part (branch, file) whose floor is one.
    """

    x: Array
    k: Array
    y: Array
    weights: Array
    branch: NDArray[np.intp]
    part: NDArray[np.intp]

    def chosen(self, index: Mask | NDArray[np.intp]) -> _Cells:
        x, k, y, weights = (a[index] for a in (self.x, self.k, self.y, self.weights))
        return _Cells(x, k, y, weights, self.branch[index], self.part[index])

    def places(self, chosen: Mask | NDArray[np.intp]) -> int:
        """How many distinct pairs of pressure and contraction there are."""
        pairs = np.stack([np.round(100 * self.x[chosen]), np.round(50 * self.k[chosen])])
        return int(np.unique(pairs, axis=1).shape[1])

    def columns(self, degrees: tuple[int, int]) -> Array:
        powers = [
            self.x**i * self.k**j for i in range(degrees[0] + 1) for j in range(degrees[1] + 1)
        ]
        for one in range(1, int(self.branch.max()) + 1):  # hysteresis
            own = (self.branch == one).astype(float)
            powers += [own, own * self.x]
        return np.stack(powers, axis=1)


class _Hinge(NamedTuple):
    """slack : which cells. floors : of the parts. degrees, c, root : of S, its coefficients, and
    the root of their covariance for readings of error 1. noise : error of a reading of weight 1.
    cost : of all cells. criterion : Akaike's, corrected for few cells.
    """

    slack: Mask
    floors: Array
    degrees: tuple[int, int]
    c: Array
    root: Array
    noise: float
    cost: float
    criterion: float

    def surface(self, cells: _Cells) -> tuple[Array, Array]:
        """S at cells, and its standard error [N]."""
        columns = cells.columns(self.degrees)
        return columns @ self.c, self.noise * np.linalg.norm(columns @ self.root, axis=1)


_Known: TypeAlias = dict[tuple[tuple[int, int], bytes], tuple[_Hinge | None, Mask]]
"""By degrees and slack cells: their hinge, and the cells that are slack by it."""


def find_floor(
    pressure: Array,
    contraction: Array,
    force: Array,
    branch: Sequence[str] = (),
    file: Sequence[str] = (),
) -> tuple[Floor, Mask] | None:
    """The floor, and the cells at it (those of a negative reading included); None without evidence.
    The surface through the other cells must lie far below the readings, these not follow it, and
    crowd together as taut ones do not.
    """
    y, n, top = force, len(force), float(np.max(force, initial=0.0))
    if np.sum(y > 0) < FEWEST or not min(np.ptp(contraction), np.ptp(pressure)) > 0:
        return None
    if float(y.min()) > LOWEST * top:
        return None
    names = part_names(branch, file, n)
    cells = _Cells(
        pressure / float(np.abs(pressure).max()),
        (contraction - contraction.mean()) / (np.ptp(contraction) / 2),
        y,
        1 / (ABSOLUTE * top + RELATIVE * np.abs(y)),
        np.unique(branch or ("",) * n, return_inverse=True)[1],
        np.unique(names, return_inverse=True)[1],
    )
    few = np.argsort(y, kind="stable")[np.linspace(0, n - 1, min(n, ENOUGH)).astype(int)]
    thin = cells.chosen(few)
    for hinge in _hinges(thin):
        deep, scatter = _evidence(thin, hinge)
        if deep is not None:
            start = y <= hinge.floors[cells.part] + DETECTED * scatter + 1e-9 * top
            start |= _beyond(cells, few[deep]) & (y <= hinge.floors[cells.part] + 7 * scatter)
            return _named(cells, start, names)
    pushing = _pushing(y, top)
    return None if pushing is None else _named(cells, pushing, names)


def _pushing(y: Array, top: float) -> Mask | None:
    """Readings that crowd together far below zero, of however few cells: no muscle pushes."""
    below = y[y < 0]
    if len(below) < CROWD:
        return None
    level = float(np.median(below))
    scatter = 1.4826 * float(np.median(np.abs(below - level)))
    if -level < max(APART * scatter, ABSOLUTE * top):
        return None
    near = np.asarray(np.abs(y - level) <= DETECTED * scatter + 1e-3 * top)
    return near if near.sum() >= CROWD else None


def part_names(branch: Sequence[str], file: Sequence[str], n: int) -> list[str]:
    """Branch and file of each cell: cells of one name have one floor."""
    pairs = zip(branch or ("",) * n, file or ("",) * n, strict=True)
    return [" ".join(filter(None, pair)) for pair in pairs]


# ---- the hinge -----------------------------------------------------------------------------------
def _hinges(cells: _Cells) -> list[_Hinge]:
    """Hinges, the best first: of least cost over numbers of slack cells, then over degrees."""
    order, n = np.argsort(cells.y, kind="stable"), len(cells.y)
    below = int(np.sum(cells.y <= 0))
    sizes = np.linspace(max(below, 1), max(0.85 * n, below), STARTS).astype(int)
    found: list[_Hinge] = []
    known: _Known = {}
    for size in dict.fromkeys(np.clip(sizes, 1, n - 4).tolist()):
        start = cells.y <= 0
        start[order[:size]] = True
        hinge = _settled(cells, start, (1, 3), known) or _settled(cells, start, (1, 1), known)
        found += [hinge] if hinge else []
    if not found:
        return []
    first = min(found, key=lambda h: h.cost)
    others = (_settled(cells, first.slack, degrees, known) for degrees in DEGREES)
    return sorted((h for h in others if h), key=lambda h: h.criterion) or [first]


def _settled(cells: _Cells, slack: Mask, degrees: tuple[int, int], known: _Known) -> _Hinge | None:
    """Breiman's hinge finding from these slack cells; None where too few cells tell the surface.
    known : the rounds of other starts, of which many come to the same cells.
    """
    columns, hinge = cells.columns(degrees), None
    for _ in range(ROUNDS):
        key = degrees, slack.tobytes()
        if key not in known:
            known[key] = _round(cells, columns, slack, degrees)
        hinge, new = known[key]
        if hinge is None or np.array_equal(new, slack):
            break
        slack = new
    return hinge


def _round(
    cells: _Cells, columns: Array, slack: Mask, degrees: tuple[int, int]
) -> tuple[_Hinge | None, Mask]:
    """The hinge of these slack cells, and the cells that are slack by it."""
    y, hinge = cells.y, _fitted(cells, columns, slack, degrees)
    if hinge is None:
        return None, slack
    taut, level = y > 0, hinge.floors[cells.part]
    off = (y - level)[slack]
    middle = float(np.median(off))
    band = middle + 6 * float(np.median(np.abs(off - middle))) + 1e-9 * y.max()
    slackened = ~taut | (columns @ hinge.c < level)
    return hinge, ~taut | (_beyond(cells, np.nonzero(slackened)[0]) & (y <= level + band))


def _fitted(cells: _Cells, columns: Array, slack: Mask, degrees: tuple[int, int]) -> _Hinge | None:
    """S by weighted least squares to the taut cells, the floors as means of the slack ones."""
    y, w, fitted = cells.y, cells.weights, (cells.y > 0) & ~slack
    count, size = int(fitted.sum()), columns.shape[1]
    levels = np.unique(np.round(cells.k[fitted], 1)).size
    if count < max(1.5 * size, size + 2, 6) or degrees[1] >= levels or not slack.any():
        return None
    rows = columns[fitted] * w[fitted, None]
    norms = np.linalg.norm(rows, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    u, s, vt = np.linalg.svd(rows / norms, full_matrices=False)
    kept = s > 1e-8 * s[0]
    root = vt[kept].T / s[kept] / norms[:, None]
    c = root @ (u[:, kept].T @ (y[fitted] * w[fitted]))
    squares = float(np.sum((w * (y - columns @ c))[fitted] ** 2))
    floors = _floors(cells, slack)
    cost = squares + float(np.sum((w * (y - floors[cells.part]))[slack] ** 2))
    n, k = len(y), int(kept.sum()) + 1
    criterion = n * np.log(max(cost, 1e-300) / n) + 2 * k * n / max(n - k - 1, 1)
    noise = float(np.sqrt(squares / (count - int(kept.sum()))))
    return _Hinge(slack, floors, degrees, c, root, noise, cost, float(criterion))


def _floors(cells: _Cells, slack: Mask) -> Array:
    """Mean reading of the slack cells of each part; of all of them where a part has hardly any."""
    count = np.bincount(cells.part[slack], minlength=int(cells.part.max()) + 1)
    total = np.bincount(cells.part[slack], cells.y[slack], minlength=count.size)
    whole = total.sum() / count.sum()
    return np.asarray(np.where(count > 2, total / np.maximum(count, 1), whole))


# ---- whether it is one ---------------------------------------------------------------------------
def _evidence(cells: _Cells, hinge: _Hinge) -> tuple[Mask | None, float]:
    """Cells that are slack beyond doubt (None: no floor), and the scatter of the readings there."""
    level, slack = hinge.floors[cells.part], hinge.slack
    off = cells.y - level
    freedom = max(int(slack.sum()) - np.unique(cells.part[slack]).size, 1)
    scatter = float(np.sqrt(off[slack] @ off[slack] / freedom))
    surface, error = hinge.surface(cells)
    whole = np.hypot(error, hinge.noise * ABSOLUTE * float(cells.y.max()))
    deep = slack & (level - surface > DEEP * np.maximum(whole, scatter))
    count = cells.places(deep)  # repeats of a cell agree, slack or not
    if count < 3:
        return None, scatter
    along = surface[deep] - surface[deep].mean()
    size = float(along @ along)
    slope = float(along @ off[deep]) / size if size > 0 else 0.0
    if abs(slope) > max(FLAT, 3 * scatter / np.sqrt(size) if 0 < count < 5 and size > 0 else 0.0):
        return None, scatter
    # of taut cells there would be as many between these readings as there are above
    taut = np.nonzero(~slack & (cells.y > 0))[0]
    near = taut[np.argsort(cells.y[taut])][: max(5, taut.size // 3)]
    width = max(float(np.ptp(off[deep])), 1e-9 * float(cells.y.max()))
    span = float(cells.y[near].max() - level.min())
    expected = cells.places(near) * width / max(span, 1e-300)
    return (deep if _poisson(count, expected) < CHANCE else None), scatter


def _poisson(count: int, expected: float) -> float:
    """Chance of so many or more, by Poisson's law. SciPy's is the same to rounding, and its import
    takes half the time of a first table.
    """
    if not 0 < expected < count:
        return float(expected > 0)  # a half or more: no evidence
    term = total = math.exp(count * math.log(expected) - expected - math.lgamma(count + 1))
    while term > 1e-17 * total:
        count += 1
        term *= expected / count
        total += term
    return total


def _beyond(cells: _Cells, slack: NDArray[np.intp]) -> Mask:
    """Which cells have no more pressure and no less contraction than one of ``slack``."""
    rising = slack[np.argsort(cells.x[slack])]
    least = np.minimum.accumulate(cells.k[rising][::-1])[::-1]
    place = np.searchsorted(cells.x[rising], cells.x - 1e-9)
    return np.asarray(cells.k >= np.append(least, np.inf)[place] - 1e-9)


def _named(cells: _Cells, slack: Mask, names: Sequence[str]) -> tuple[Floor, Mask]:
    """The floor that slack cells show, and all cells that read no more."""
    y, part = cells.y, cells.part
    floors = _floors(cells, slack)
    freedom = max(int(slack.sum()) - np.unique(part[slack]).size, 1)
    scatter = float(np.sqrt(np.sum((y - floors[part])[slack] ** 2) / freedom))
    limits = floors + DETECTED * scatter + 1e-9 * float(y.max())
    slack = slack | (y <= limits[part])
    own, count = y[slack], int(slack.sum())
    value = float(own.mean())
    by = {}
    for one in np.unique(part[slack]):
        mine = np.nonzero(slack & (part == one))[0]
        mean = float(y[mine].mean())
        if len(mine) > 2 and abs(mean - value) > 3 * scatter / np.sqrt(len(mine)):
            by[names[mine[0]]] = mean
    error = scatter / float(np.sqrt(count))
    limit, above = float(limits[part][slack].max()), int(np.sum(own > 0))
    trend = _trend(cells.x[slack], (y - floors[part])[slack])
    return Floor(value, error, scatter, count, above, limit, by, trend), slack


def _trend(x: Array, off: Array) -> str:
    """How readings rise along the rows, or with pressure, where that explains half of them."""
    found = []
    for words, along in (("from the first to the last", np.arange(off.size)), ("with pressure", x)):
        size = float(np.ptp(along))
        if off.size > 5 and size > 0 and np.ptp(off) > 0:
            share = float(np.corrcoef(along, off)[0, 1])
            rise = share * float(np.std(off) / np.std(along)) * size
            found.append((abs(share), f" (changing by {rise:+.2g} N {words})"))
    share, words = max(found, default=(0.0, ""))
    return words if share > DRIFT else ""
