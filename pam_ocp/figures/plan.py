"""Pictures of plans: the motion with its limits, costates, robust plans,
fronts of two objectives.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import require_instance, with_kinds
from ..core.interrupts import interruptible
from ..core.stop import turns
from ..core.units import significant
from ..core.variables import Variable
from ..planning.result import Plan
from .canvas import COLOURS, axis_label, caption, ink, legible, name_beside, over_time, panels
from .paper import paper_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..planning.active import Limit
    from ..planning.studies.front import Pareto
    from ..planning.studies.robust_result import RobustPlan

_COPY = re.compile(r"\.(draw|deviation)\d+$")
_EFFORTS = {"N", "N.m", "N/m", "N.m/rad"}
"""Units of outputs that always have a panel."""
GREY = "#8a8f94"


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """One colour per muscle, the same in all panels; others in turn, one for each owner."""
    numbered = {n: m for n in names if (m := re.match(r"muscle(\d*)\.", n))}
    others = (ink(), *COLOURS[2:]) if numbered else (ink(), *COLOURS[2:], *COLOURS[:2])
    owners = {n: n.rpartition(".")[0] or n for n in names if n not in numbered}
    turns = {
        owner: others[i % len(others)] for i, owner in enumerate(dict.fromkeys(owners.values()))
    }
    own = {n: COLOURS[(int(m[1] or 1) - 1) % len(COLOURS)] for n, m in numbered.items()}
    return {n: own[n] if n in own else turns[owners[n]] for n in names}


def panels_of(plan: Plan) -> dict[str, list[str]]:
    """Columns to draw by their unit: states, inputs, forces and stiffness, and what has a limit.

    Contractions say nothing that positions do not; copies of a robust plan's ensemble are left out.
    """
    motion = plan.trajectory
    stops = plan._problem.stops if plan._problem else ()
    asked = {n for stop in stops for n in stop}
    if plan._problem:
        asked |= {c.label for leg in plan._problem.legs for c in leg.path}
    found: dict[str, list[str]] = {}
    for v in motion.variables:
        shown = v.causality != "output" or v.unit in _EFFORTS or v.name in asked
        if (
            shown
            and not v.disturbance
            and not v.name.endswith(".contraction")
            and not _COPY.search(v.name)
        ):
            found.setdefault(v.display_unit, []).append(v.name)
    return found


@interruptible()
def plot_plan(plan: Plan) -> Figure:
    """The planned motion by panels of one unit each (several, by joints and muscles, where there
    are many curves), and below which limits are active when.

    States and outputs as the replay found them, inputs as planned (thin); limits dashed, and the
    curve wide and pale where it touches one; stops as rings (ranges as bars), dwells shaded grey.
    """
    from ..planning.active import limits_along

    parts = [part for names in panels_of(plan).values() for part in legible(names)]
    limits = limits_along(plan)
    touched = _touched(limits)
    chart = 0.45 + (0.17 if paper_width() is None else 0.3) * len(touched) if touched else 0.0
    figure, axes = over_time(len(parts), chart)
    for ax, names in zip(axes, parts, strict=False):
        _panel(ax, plan, names, limits)
        caption(ax, y=axis_label(*map(plan.trajectory.variable, names)))
    if touched:
        _chart(axes[-1], touched, plan.duration)
    for ax in axes:
        _phases(ax, plan)
    words = "" if plan.verified else "NOT VERIFIED: "
    words += f"{plan.plant.name}: {plan.duration * 1e3:.2f} ms, replay error "
    caption(axes[0], title=f"{words}{plan.replay_error:.1e} scaled by nominal values")
    axes[-1].set_xlim(0.0, plan.duration)
    return figure


def _panel(ax: Axes, plan: Plan, names: Sequence[str], limits: Sequence[Limit]) -> None:
    assert plan.replay is not None  # of a plan that succeeded
    replay = plan.replay.trajectory
    for name, colour in colours_of(names).items():
        variable = replay.variable(name)
        factor = variable.display_factor
        style: dict[str, Any] = {"color": colour, "lw": 1.7, "label": name}
        if variable.causality == "input":
            t, values = _signal(plan, name)
            ax.plot(t, values / factor, **{**style, "lw": 0.9, "alpha": 0.9})
        else:
            if variable.causality == "output" and name.endswith(".stiffness"):
                style["ls"] = "-."
            ax.plot(replay.t, replay[name] / factor, **style)
        for limit in (one for one in limits if one.column == name):
            ax.plot(limit.t, limit.limit / factor, color=GREY, lw=0.9, ls=(0, (5, 4)), zorder=1)
            if variable.causality != "input" and limit.active.any():
                there = replay[name][np.searchsorted(replay.t, limit.t)] / factor
                touching = np.where(limit.active, there, np.nan)
                ax.plot(limit.t, touching, color=colour, lw=7, alpha=0.25, solid_capstyle="butt")
        _stops(ax, plan, name, colour, factor)
    _within(ax, plan, names)
    name_beside(ax)


def _signal(plan: Plan, name: str) -> tuple[Any, Any]:
    """An input as it runs, jumps included."""
    motion = plan.trajectory
    signals = motion.signals
    assert signals is not None  # a plan's inputs are known in between
    column = motion.named("input").index(name)
    shares = np.linspace(0.0, 1.0 - 1e-9, 2 if signals.degree < 2 else 12)
    lengths = np.diff(signals.breaks)
    t = (signals.breaks[:-1, None] + lengths[:, None] * shares).ravel()
    return t, signals(t)[:, column]


def _within(ax: Axes, plan: Plan, names: Sequence[str]) -> None:
    """A view of the curves: limits far outside them do not flatten it."""
    assert plan.replay is not None  # of a plan that succeeded
    rows = [plan.replay.trajectory[n] / plan.trajectory.variable(n).display_factor for n in names]
    low, high = min(map(np.min, rows)), max(map(np.max, rows))
    margin = 0.12 * ((high - low) or abs(high) or 1.0)
    ax.set_ylim(low - margin, high + margin)


def _stops(ax: Axes, plan: Plan, name: str, colour: str, factor: float) -> None:
    """Rings where a stop names this variable, bars where it gives a range."""
    if plan._problem is None:
        return
    times = np.concatenate([[0.0], np.cumsum(plan.durations)])
    for t, stop in zip(times, plan._problem.stops, strict=True):
        value = stop.get(name)
        if value is None:
            continue
        if np.ndim(value) == 0:
            ring: dict[str, Any] = {"ms": 7, "mfc": "white", "mec": colour, "mew": 1.6}
            ax.plot(t, float(value) / factor, "o", **ring, zorder=5, clip_on=False)
        else:
            ends = [plan.plant.variable(name).min, plan.plant.variable(name).max]
            low, high = (own if v is None else v for v, own in zip(value, ends, strict=True))
            if np.isfinite([low, high]).all():
                ax.plot(
                    [t, t], [low / factor, high / factor], color=colour, lw=9, alpha=0.45, zorder=5
                )


def _phases(ax: Axes, plan: Plan) -> None:
    """Lines at the nodes, dwells shaded."""
    ends = np.concatenate([[0.0], np.cumsum(plan.durations)])
    for time in ends[1:-1]:
        ax.axvline(time, color="#999999", lw=0.8, ls=":")
    legs = plan._problem.legs if plan._problem else ()
    for begin, end, leg in zip(ends, ends[1:], legs, strict=False):
        if leg.dwell:
            ax.axvspan(begin, end, color="#000000", alpha=0.05, lw=0)


def _touched(limits: Sequence[Limit]) -> dict[str, list[Limit]]:
    """Limits that are active anywhere, by label, their legs together."""
    found: dict[str, list[Limit]] = {}
    for limit in limits:
        if limit.active.any() and not _COPY.search(limit.label.rsplit(" ", 1)[0]):
            found.setdefault(limit.label, []).append(limit)
    return found


def _chart(ax: Axes, touched: dict[str, list[Limit]], duration: float) -> None:
    """A row per limit, filled while it is active; a moment is drawn as wide as the eye needs."""
    least = 0.004 * duration
    for row, (label, limits) in enumerate(touched.items()):
        colour = colours_of([label])[label]
        spans = [span for limit in limits for span in _spans(limit)]
        bars = [(begin, max(end - begin, least)) for begin, end in spans]
        alpha = 0.75 if paper_width() is None else 0.3
        ax.broken_barh(bars, (row - 0.35, 0.7), color=colour, alpha=alpha, lw=0)
    if paper_width() is None:
        ax.set_yticks(range(len(touched)), list(touched), fontsize="small")
        ax.yaxis.tick_right()
    else:  # no room beside
        ax.set_yticks([])
        for row, label in enumerate(touched):
            ax.text(0.01, row, label, transform=ax.get_yaxis_transform(), va="center")
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(touched) - 0.4, -0.6)
    ax.set_ylabel("active\nlimits")
    ax.grid(False, axis="y")


def _spans(limit: Limit) -> list[tuple[float, float]]:
    """Times from begin to end of each active stretch; half a sample wide at the least."""
    spans = []
    for active, group in groupby(range(len(limit.t)), key=lambda i: bool(limit.active[i])):
        if active:
            rows = list(group)
            begin = (limit.t[rows[0]] + limit.t[max(rows[0] - 1, 0)]) / 2
            end = (limit.t[rows[-1]] + limit.t[min(rows[-1] + 1, len(limit.t) - 1)]) / 2
            spans.append((float(begin), float(end)))
    return spans


@with_kinds
@turns
def plot_costates(plan: Plan) -> Figure:
    """What a change of each state at each time would cost: d(objective)/d(state) over time.

    Examples
    --------
    >>> pam.figures.plot_costates(plan).savefig("costates.png")
    """
    require_instance("plan", plan, Plan, "give what plan() returned")
    costates = plan.costates
    groups: dict[str, list[Variable]] = {}
    for v in plan.plant.states:
        if not _COPY.search(v.name):
            groups.setdefault(v.display_unit, []).append(v)
    figure, axes = panels(len(groups), size=(9, 1.0 + 1.7 * len(groups)))
    for ax, (unit, variables) in zip(axes, groups.items(), strict=True):
        colours = colours_of([v.name for v in variables])
        for v in variables:
            values = costates[v.name] * v.display_factor
            ax.plot(costates.t, values, color=colours[v.name], lw=1.6, label=v.name)
        ax.axhline(0.0, color=GREY, lw=0.8)
        ax.set_ylabel("per unit" if unit == "1" else f"objective\nper {unit}")
        name_beside(ax)
        _phases(ax, plan)
    title = f"{plan.plant.name}: costates, objective {significant(plan.objective)}"
    caption(axes[0], title=title)
    caption(axes[-1], "time [s]")
    axes[-1].set_xlim(0.0, plan.duration)
    return figure


@interruptible()
def plot_pareto(front: Pareto) -> Figure:
    """The second objective over the first, with the knee;
    plans that are not verified crossed out.
    """
    figure, (ax,) = panels(1, size=(6.5, 4.5))
    x, y = (
        front.values[:, i] / v.display_factor for i, v in enumerate((front.first, front.second))
    )
    ax.plot(x, y, "o-", color=COLOURS[0], ms=5, lw=1.3)
    knee = x[front.knee], y[front.knee]
    ax.plot(*knee, "o", ms=12, mfc="none", mec=COLOURS[1], mew=1.8)
    ax.annotate("knee", knee, (10, 10), textcoords="offset points", color=COLOURS[1])
    wrong = list(front.unverified)
    if wrong:
        ax.plot(x[wrong], y[wrong], "x", ms=11, mew=2.2, color="k", label="not verified")
        ax.legend(frameon=False)
    if y.min() > 0 and y.max() > 30 * y.min():
        ax.set_yscale("log")
    title = f"{front.plans[0].plant.name}: {len(front)} plans"
    caption(ax, front.first.label, front.second.label, title=title)
    return figure


@interruptible()
def plot_robust(robust: RobustPlan) -> Figure:
    """Deviation of every plant from the nominal one over time, nominal plan beside robust plan."""
    widths = robust.widths
    sides = (
        ("nominal plan", robust.nominal_members, robust.nominal_unseen),
        ("robust plan", robust.members, robust.unseen),
    )
    figure, axes = panels(len(widths), 2, size=(10, 1.0 + 2.6 * len(widths)), sharex=False)
    for i, name in enumerate(widths):
        row = axes[2 * i : 2 * i + 2]
        variable = robust.members.plant.variable(name)
        factor = variable.display_factor
        top = 0.0
        for ax, (title, spread, unseen) in zip(row, sides, strict=True):
            t = spread.nominal.t
            for some, colour, alpha in ((unseen, GREY, 0.35), (spread, COLOURS[0], 0.9)):
                for line in [] if some is None else some.deviation(name) / factor:
                    ax.plot(t, line, color=colour, alpha=alpha, lw=1.0)
                    top = max(top, float(np.nanmax(np.abs(line))))
            for at, (_, _, allowed) in zip(spread.stops, robust.demand.stops, strict=True):
                if name in allowed:
                    ends = np.array([-1.0, 1.0]) * allowed[name] / factor
                    bar: dict[str, Any] = {"color": COLOURS[1], "lw": 4, "alpha": 0.8, "zorder": 5}
                    ax.plot([t[at]] * 2, ends, **bar, solid_capstyle="butt", clip_on=False)
            worst = variable.shown(spread.worst(name), 3)
            caption(ax, title=f"{title}: {worst} at the stops")
        for ax in row:
            ax.set_ylim(-1.05 * top, 1.05 * top)
            ax.axhline(0.0, color=GREY, lw=0.8)
        row[0].set_ylabel(f"{name} - nominal [{variable.display_unit}]")
    ax = axes[1]
    ax.plot([], [], color=COLOURS[0], label=f"{len(robust.members.draws)} plants planned for")
    if robust.unseen:
        ax.plot([], [], color=GREY, label=f"{len(robust.unseen.draws)} unseen plants")
    ax.plot([], [], color=COLOURS[1], lw=4, label="allowed at the stop")
    caption(ax, names="best")
    for ax in axes[-2:]:
        caption(ax, "time [s]")
    return figure
