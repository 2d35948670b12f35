"""RobustPlan: one input for a set of plants, how many of them keep what was asked for and how sure
that is, and what each of them does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ... import courtesy
from ...core.errors import PamError
from ...core.shown import shown
from ...core.trajectory import Trajectory
from ...core.variables import Variable
from ...plants.plant import Plant
from ..problem.problem import Problem
from ..replay import Check
from ..result import Plan
from ..transcription.mesh import Mesh
from ..transcription.solution import Solution
from .spread import Spread, drawn, spread_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array: TypeAlias = NDArray[np.float64]

SLACK = 1e-3
"""By so much of nominal the plants planned for may miss by simulation what the plan promised."""
TOLERANCE = 1e-3
"""By so much of nominal a plant may exceed a bound or path constraint and still keeps it."""
LOOKS = 8
"""Parts of each gap between two points of a plan in which limits are looked at."""
ROUNDING = 1e-6
"""The same of a spread, as a part of it."""


@dataclass(frozen=True, eq=False)
class Demand:
    """What every plant is asked for under the inputs of one motion.

    stops : (sample of the motion, number of the stop from 1, {variable: largest deviation}).
    dwells : the same of samples, along a dwell at a stop.
    problem : the nominal plant's, for bounds and path conditions along its legs; None to leave them
        out.
    mesh, solution : of the plan.
    """

    stops: tuple[tuple[int, int, Mapping[str, float]], ...]
    dwells: tuple[tuple[slice, int, Mapping[str, float]], ...]
    problem: Problem | None
    mesh: Mesh
    solution: Solution

    @cached_property
    def every(self) -> Problem | None:
        """The problem with what every plant has to keep: peaks are the nominal plant's business, as
        all of the objective, and what a dwell holds varies as the stop does.
        """
        problem = self.problem
        if problem is None:
            return None
        legs = []
        for leg, values in zip(problem.legs, problem.stops, strict=False):
            path = leg.path[: len(leg.path) - len(values)] if leg.dwell else leg.path
            kept = (c for c in path if not ca.depends_on(c.expression, problem.m))
            legs.append(replace(leg, path=tuple(kept)))
        return replace(problem, legs=tuple(legs))


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
    places: list[tuple[str, slice, Mapping[str, float]]] = [
        *((f"stop {n}", slice(at, at + 1), widths) for at, n, widths in demand.stops),
        *((f"dwell at stop {n}", along, widths) for along, n, widths in demand.dwells),
    ]
    for place, samples, widths in places:
        for name, width in widths.items():
            along = spread.deviation(name)[:, samples]
            farthest = np.argmax(np.abs(along), axis=1)[:, None]
            deviation = np.take_along_axis(along, farthest, axis=1)[:, 0]
            variable = spread.plant.variable(name)
            excess = np.abs(deviation) / (width * (1 + ROUNDING)) - 1
            columns.append((f"{place}: {name}", (variable, width), excess, np.sign(deviation)))
    problem = demand.every
    if problem is not None:
        own = {v.name: v.start for v in spread.plant.parameters}
        rows = [
            None
            if isinstance(motion, PamError)
            else _violations(demand, problem, problem.plant.with_values({**own, **draw}), motion)
            for draw, motion in zip(spread.draws, spread.motions, strict=True)
        ]
        labels = dict.fromkeys(label for row in rows if row is not None for label in row)
        for label in labels:
            values = np.array([np.nan if row is None else row.get(label, 0.0) for row in rows])
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


def _violations(
    demand: Demand, problem: Problem, plant: Plant, motion: Trajectory
) -> dict[str, float]:
    """{bound or path condition: how far it is exceeded along a motion, in units of nominal}."""
    states = motion.array([v.name for v in plant.states]).T
    check = Check(problem, plant, demand.mesh, demand.solution, motion.t, states, 1, LOOKS)
    found = dict.fromkeys([v.name for v in plant.states], 0.0)
    found |= {c.label: 0.0 for leg in problem.legs for c in leg.path}
    for beyond in check.along()[0]:
        for label, value in beyond.items():
            found[label] = max(found.get(label, 0.0), value)
    return found


@shown
@dataclass(frozen=True)
class RobustVerdict:
    """Whether a robust plan holds what was asked for,
    in one sentence with the figure that failed.
    """

    solved: str
    """What is wrong with the plan of the ensemble, "" if nothing."""
    planned_for: int
    """Number of plants that were planned for."""
    missed: float
    """By how much one of them misses by simulation [nominals]; infinite where that failed."""
    where: str
    """What it misses."""
    share: Share | None
    """Of plants that were not planned for; None when none was tried."""
    wanted: float | None
    """The share that was asked for; None: nothing was asked for but the plants planned for."""
    ended: str = ""
    """Why no further plants were added, when the share is not enough."""

    @property
    def verified(self) -> bool:
        """Whether the plan is verified, keeps its own plants,
        and the wanted share of unseen ones.
        """
        own = not self.solved and self.missed <= SLACK
        return own and (self.wanted is None or (self.share is not None and self.share.enough))

    def __bool__(self) -> bool:
        return self.verified

    def __str__(self) -> str:
        if self.solved:
            return f"not verified: the plan of the ensemble is not, {self.solved}"
        if not self.missed <= SLACK:
            return (
                f"not verified: a plant planned for misses {self.where} by {self.missed:.2g} of "
                f"nominal in its simulation, more than {SLACK:g}"
            )
        if self.wanted is None:
            return f"verified for the {self.planned_for} plants planned for, and said of no others"
        if self.share is None:
            return (
                f"not verified: besides the {self.planned_for} plants planned for none was tried; "
                "give draws as a function (count, seed), or unseen ones, or share=None"
            )
        words = (
            f"of unseen ones {self.share} keep the spread and all limits, wanted "
            f"{100 * self.wanted:g} %"
        )
        if self.verified:
            return f"verified: {words}"
        rest = f"; most of the others exceed {self.share.hindrance}"
        if self.share.stretch > 1.0:
            rest += f". With these inputs all spreads times {self.share.stretch:.3g} would be kept"
        return f"not verified: {words}{rest}" + (f" ({self.ended})" if self.ended else "")


@dataclass(frozen=True)
class Round:
    """One plan of the search: for how many plants, and what an unseen sample said of it."""

    planned_for: int
    objective: float
    share: Share | None
    seconds: float
    """Since the search began."""


@shown
@dataclass(frozen=True, eq=False)
class RobustPlan:
    """One input for a set of plants, and what each of them does with it by simulation.

    ``print(robust.verdict)`` says for whom it is robust; ``share`` is that of plants that no round
    of the search had seen before, with its interval.

    Examples
    --------
    >>> draws = [{"mass": 1.96}, {"mass": 2.04}]
    >>> ways = {"share": None, "method": pam.Collocation(10, 3)}
    >>> stops = [{"x": -0.01}, {"x": 0.01}]
    >>> robust = pam.robust_plan(slide, stops, draws=draws, spread={"x": 1e-3}, **ways)
    >>> robust.verified, robust.plan.duration > plan.duration
    (True, True)
    """

    plan: Plan
    """Of the ensemble: the nominal plant's variables by their names, ``NAME.draw<k>`` of the
    copies.
    """
    nominal_plan: Plan
    """The plan of the nominal plant alone, which knows nothing of the others."""
    trajectory: Trajectory
    """The robust motion of the nominal plant."""
    allowed: tuple[dict[str, float], ...]
    """The spread that each stop allows."""
    members: Spread
    """The plants that were planned for, simulated under the plan's inputs."""
    nominal_members: Spread
    """The same plants under the inputs of the nominal plan."""
    unseen: Spread | None
    """Plants that the plan does not know, under its inputs."""
    nominal_unseen: Spread | None
    """The same under the inputs of the nominal plan."""
    cyclic: bool
    rest: bool
    verdict: RobustVerdict
    demand: Demand
    """What every plant is judged by."""
    rounds: tuple[Round, ...]
    """The plans of the search in their order."""

    def __getstate__(self) -> dict[str, Any]:
        """Symbols do not travel between processes; the nominal plan builds its problem anew."""
        limited = self.demand.problem is not None
        return {**self.__dict__, "demand": replace(self.demand, problem=None), "limited": limited}

    def __setstate__(self, state: dict[str, Any]) -> None:
        problem = state["nominal_plan"]._problem if state.pop("limited") else None
        self.__dict__.update(state, demand=replace(state["demand"], problem=problem))

    @property
    def verified(self) -> bool:
        """Whether the plan is verified and the wanted share of unseen plants keeps all."""
        return self.verdict.verified

    @property
    def share(self) -> Share | None:
        """Of unseen plants that keep the spread at all stops and all limits, with its interval."""
        return self.verdict.share

    @property
    def widths(self) -> dict[str, float]:
        """The widest spread allowed of each variable."""
        names = dict.fromkeys(n for allowed in self.allowed for n in allowed)
        return {n: max(a[n] for a in self.allowed if n in a) for n in names}

    def verify(self, draws: Sequence[Mapping[str, Any]]) -> Spread:
        """Simulate further plants under the plan's inputs; :meth:`judge` says which of them keep
        all.
        """
        plant = self.members.plant
        return spread_of(
            plant,
            self.trajectory,
            drawn(plant, draws),
            self.members.stops,
            cyclic=self.cyclic,
            rest=self.rest,
        )

    def judge(self, spread: Spread) -> Judged:
        """What the plants of a spread under the plan's inputs exceed; ``.kept`` is True where
        nothing.
        """
        return judged(spread, self.demand)

    def _within(self, spread: Spread) -> float:
        """Part of the plants that keep the spread of each stop, under this plan's inputs or the
        nominal's.
        """
        stops = tuple(
            (sample, number, widths)
            for sample, (_, number, widths) in zip(spread.stops, self.demand.stops, strict=True)
        )
        alone = replace(self.demand, stops=stops, dwells=(), problem=None)
        return float(judged(spread, alone).kept.mean())

    @property
    def price(self) -> float:
        """Robust objective over nominal objective, less 1."""
        return self.plan.objective / self.nominal_plan.objective - 1

    def plot(self) -> Figure:
        """Deviations of all plants over time under the nominal and the robust plan's inputs."""
        return courtesy.plot_robust(self)

    def __str__(self) -> str:
        lines = [str(self.verdict), str(self.plan)]
        lines.append(f"price      {100 * self.price:.2f} % over the nominal plan")
        if len(self.rounds) > 1:
            planned = ", ".join(str(r.planned_for) for r in self.rounds)
            lines.append(f"rounds     {len(self.rounds)}, planned for {planned} plants")
        rows = [("planned for", self.nominal_members, self.members)]
        if self.unseen and self.nominal_unseen:
            rows.append(("unseen", self.nominal_unseen, self.unseen))
        lines.append(f"{'spread at the stops':<30}{'nominal plan':>16}{'robust plan':>16}")
        for label, *both in rows:
            count = f"of {len(both[0].draws)} plants {label}"
            for name, width in self.widths.items():
                shown = self.members.plant.variable(name).shown
                cells = "".join(
                    f"{'failed' if s.failures else shown(float(f'{s.worst(name):.3g}')):>16}"
                    for s in both
                )
                lines.append(f"{name} {count:<{29 - len(name)}}{cells}   allowed {shown(width)}")
            shares = "".join(f"{100 * self._within(s):>14.3g} %" for s in both)
            lines.append(f"{'within at all stops':<30}{shares}")
        return "\n".join(lines)
