"""Share: how many plants keep what was asked for, how sure that is, and what stands in the way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import PamError
from ...core.shown import shown
from ...core.trajectory import Trajectory
from ...core.variables import Variable
from ...plants.plant import Plant
from ..problem.problem import Leg, Problem
from .spread import Spread

__all__ = ["Demand", "Judged", "Share", "judged", "missed", "share_of"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-3
"""By so much of nominal a plant may exceed a bound or path constraint and still keeps it."""
ROUNDING = 1e-6
"""The same of a spread, as a part of it."""


@dataclass(frozen=True, eq=False)
class Demand:
    """What every plant is asked for under the inputs of one motion.

    stops : (sample of the motion, number of the stop from 1, {variable: largest deviation}).
    problem : the nominal plant's, for bounds and path conditions along its legs; None to leave them
        out.
    durations : of the legs [s]. peaks : as in :class:`Solution`.
    """

    stops: tuple[tuple[int, int, Mapping[str, float]], ...]
    problem: Problem | None
    durations: Array
    peaks: Array


@dataclass(frozen=True, eq=False)
class Judged:
    """Plants by what they exceed. Columns are demands, values above 0 exceed one."""

    labels: tuple[str, ...]
    widths: tuple[tuple[Variable, float] | None, ...]
    """(variable, allowed deviation) of a demand at a stop, None for a limit along the way."""
    excess: Array
    """(plants, demands): at a stop deviation over width less 1, with its sign in ``signs``; along
    the way the violation in units of nominal less the tolerance; infinite where the simulation
    failed.
    """
    signs: Array

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Which plants keep all."""
        return np.asarray(self.excess.max(axis=1, initial=-1.0) <= 0)

    def worst(self, share: float, most: int) -> list[int]:
        """Plants whose demands must be met for a share of all: of each demand and side the worst.

        Half of those that may fail are taken for outliers and left out, the farthest first.
        """
        largest = self.excess.max(axis=1)
        order = np.argsort(-largest)
        spared = int((1 - share) * len(order) / 2)
        failing = [int(i) for i in order[spared:] if largest[i] > 0]
        groups: dict[tuple[int, float], list[int]] = {}
        for i in failing:
            demand = int(np.argmax(self.excess[i]))
            groups.setdefault((demand, float(self.signs[i, demand])), []).append(i)
        ranked = sorted(groups.values(), key=len, reverse=True)
        return [group[0] for group in ranked][:most]


@shown
@dataclass(frozen=True)
class Share:
    """How many plants of a sample keep the spread at all stops and (``all_within``) all limits."""

    kept: int
    count: int
    wanted: float
    confidence: float
    seed: int | None
    """Of the sample; None when it was given as a list."""
    hindrance: str = ""
    """What most of those that fail exceed most, and how far the wanted share of plants comes there.
    """
    stretch: float = 1.0
    """Times this all spreads together would be kept by the wanted share (limits along the way
    aside).
    """

    @property
    def value(self) -> float:
        """The part that keeps all."""
        return self.kept / self.count

    @property
    def interval(self) -> tuple[float, float]:
        """Two-sided interval of the share by Clopper and Pearson, Biometrika 26 (1934) 404-413."""
        from scipy.special import betaincinv

        k, n, tail = self.kept, self.count, (1 - self.confidence) / 2
        low = float(betaincinv(k, n - k + 1, tail)) if k else 0.0
        high = float(betaincinv(k + 1, n - k, 1 - tail)) if k < n else 1.0
        return low, high

    @property
    def enough(self) -> bool:
        """Whether the part is at least the wanted one."""
        return self.value >= self.wanted

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"{self.kept} of {self.count} plants ({100 * self.value:.1f} %; "
            f"{100 * self.confidence:g} % interval {100 * low:.1f} .. {100 * high:.1f} %)"
        )


def judged(spread: Spread, demand: Demand) -> Judged:
    """What the plants of a spread exceed."""
    columns: list[tuple[str, tuple[Variable, float] | None, Array, Array]] = []
    for sample, stop, widths in demand.stops:
        for name, width in widths.items():
            deviation = spread.deviation(name)[:, sample]
            variable = spread.plant.variable(name)
            excess = np.abs(deviation) / (width * (1 + ROUNDING)) - 1
            columns.append((f"stop {stop}: {name}", (variable, width), excess, np.sign(deviation)))
    if demand.problem is not None:
        rows = [
            {}
            if isinstance(motion, PamError)
            else _violations(demand, spread.plant.with_values(draw), motion)
            for draw, motion in zip(spread.draws, spread.motions, strict=True)
        ]
        labels = dict.fromkeys(label for row in rows for label in row)
        for label in labels:
            values = np.array([row.get(label, np.nan) for row in rows])
            columns.append((label, None, values - TOLERANCE, np.ones(len(rows))))
    names, widths_of, excesses, signs = zip(*columns, strict=True)
    excess = np.column_stack(excesses)
    excess = np.where(np.isnan(excess), np.inf, excess)  # of a plant that could not be simulated
    return Judged(names, widths_of, excess, np.nan_to_num(np.column_stack(signs)))


def share_of(found: Judged, wanted: float, confidence: float, seed: int | None = None) -> Share:
    """The share that keeps all, and what hinders the others."""
    kept = found.kept
    if kept.mean() >= wanted:
        return Share(int(kept.sum()), len(kept), wanted, confidence, seed)
    first = Counter(int(np.argmax(row)) for row in found.excess[~kept])
    demand = first.most_common(1)[0][0]
    at_stops = [i for i, w in enumerate(found.widths) if w is not None]
    ratio = _quantile(found.excess[:, at_stops].max(axis=1, initial=-1.0), wanted) + 1
    reached = _quantile(found.excess[:, demand], wanted)
    words, width = found.labels[demand], found.widths[demand]
    if width is not None:
        variable, allowed = width
        far = variable.shown(float(f"{(reached + 1) * allowed:.3g}"))
        words += f", where {100 * wanted:g} % come within {far} (allowed {variable.shown(allowed)})"
    else:
        words += (
            f", which {100 * wanted:g} % exceed by at most {reached + TOLERANCE:.2g} of nominal"
        )
    return Share(int(kept.sum()), len(kept), wanted, confidence, seed, words, max(ratio, 1.0))


def missed(found: Judged) -> tuple[float, str]:
    """By how much [nominals] the worst of plants exceeds what, at the stops and along the way."""
    every = [(0.0, "")]
    for label, width, column in zip(found.labels, found.widths, found.excess.T, strict=True):
        largest = float(column.max())
        if width is None:
            every.append((largest + TOLERANCE, label))
        else:
            variable, allowed = width
            every.append((largest * allowed / variable.nominal, label))
    return max(every)


def _quantile(values: Array, share: float) -> float:
    """The least of the values that a share of them does not exceed."""
    count = max(int(np.ceil(share * len(values) - 1e-9)), 1)
    return float(np.sort(values)[count - 1])


def _violations(demand: Demand, plant: Plant, motion: Trajectory) -> dict[str, float]:
    """{bound or path condition: how far it is exceeded along a motion, in units of nominal}."""
    problem = demand.problem
    assert problem is not None
    ends = np.concatenate([[0.0], np.cumsum(demand.durations)])
    found: dict[str, float] = {}
    for i, leg in enumerate(problem.legs):
        inside = (motion.t >= ends[i] - 1e-12) & (motion.t <= ends[i + 1] + 1e-12)
        for label, value in _along(problem, leg, plant, motion, inside, demand.peaks):
            found[label] = max(found.get(label, 0.0), value)
    return found


def _along(
    problem: Problem,
    leg: Leg,
    plant: Plant,
    motion: Trajectory,
    inside: NDArray[np.bool_],
    peaks: Array,
) -> list[tuple[str, float]]:
    """(label, largest excess in nominals) of the bounds of states and the path conditions
    of a leg.
    """
    if not inside.any():
        return []
    found = []
    for variable in plant.states:
        low, high = leg.bounds[variable.name]
        values = motion[variable.name][inside]
        beyond = float(np.max(np.maximum(low - values, values - high)))
        found.append((variable.name, beyond / variable.nominal))
    # the peak of a variable is the nominal plant's business, as all of the objective
    path = [c for c in leg.path if not ca.depends_on(c.expression, problem.m)]
    if not path:
        return found
    x, u = (motion.array(motion.named(c))[inside].T for c in ("state", "input"))
    t = motion.t[inside]
    profiles = [profile(t) for profile in problem.profiles]
    r = np.vstack(profiles) if profiles else np.zeros((0, len(t)))
    function = plant.cached(
        ("share", problem, tuple(path)),
        lambda: problem.conditions("path", path),
    )
    given = (x, u, plant.vector("parameter"), t[None, :], r, np.array(problem.aims), peaks)
    values = np.asarray(function(*given), float)
    for condition, row in zip(path, values, strict=True):
        low, high = condition.low / condition.nominal, condition.high / condition.nominal
        found.append((condition.label, float(np.max(np.maximum(low - row, row - high)))))
    return found
