"""RobustPlan: one input for a set of plants, for whom it is robust, and what each of them does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ... import courtesy
from ...core.shown import shown
from ...core.trajectory import Trajectory
from ..result import Plan
from .share import Demand, Judged, Share, judged
from .spread import Spread, drawn, spread_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["RobustPlan", "RobustVerdict", "Round"]

SLACK = 1e-3
"""By so much of nominal the plants planned for may miss by simulation what the plan promised."""


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
        return float(judged(spread, replace(self.demand, stops=stops, problem=None)).kept.mean())

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
            shares = "".join(f"{100 * self._within(s):>14.0f} %" for s in both)
            lines.append(f"{'within at all stops':<30}{shares}")
        return "\n".join(lines)
