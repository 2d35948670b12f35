"""robust_plan: one input for a whole set of plants, their spread at the stops bounded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from ..errors import InputError, PamError, require_positive
from ..plant.plant import Plant, require_plant
from ..simulate import evaluated
from ..trajectory import Trajectory
from .ensemble import Ensemble
from .result import Plan, Solved
from .solve import plan
from .spread import Draw, Spread, drawn, spread_of
from .wording import Stop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["RobustPlan", "robust_plan"]

Widths: TypeAlias = Mapping[str, float]
Start: TypeAlias = Literal["rest", "same"]


@dataclass(frozen=True, eq=False)
class RobustPlan:
    """One input for a set of plants, and what each of them does with it by simulation."""

    plan: Plan
    """Of the ensemble: the nominal plant's variables by their names, ``NAME.draw<k>`` of the copies."""
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

    @property
    def widths(self) -> dict[str, float]:
        """The widest spread allowed of each variable."""
        names = dict.fromkeys(n for allowed in self.allowed for n in allowed)
        return {n: max(a[n] for a in self.allowed if n in a) for n in names}

    def verify(self, draws: Sequence[Mapping[str, Any]]) -> Spread:
        """Simulate further plants under the plan's inputs."""
        plant = self.members.plant
        return spread_of(
            plant, self.trajectory, drawn(plant, draws), self.members.stops,
            cyclic=self.cyclic, rest=self.rest,
        )  # fmt: skip

    @property
    def price(self) -> float:
        """Robust objective over nominal objective, less 1."""
        return self.plan.objective / self.nominal_plan.objective - 1

    def plot(self) -> Figure:
        """Deviations of all plants over time under the nominal and the robust plan's inputs."""
        from ..plot_plan import plot_robust

        return plot_robust(self)

    def __str__(self) -> str:
        lines = [str(self.plan), f"price      {100 * self.price:.2f} % over the nominal plan"]
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
            shares = "".join(f"{100 * s.share_within(self.widths):>14.0f} %" for s in both)
            lines.append(f"{'within at all stops':<30}{shares}")
        return "\n".join(lines)


def robust_plan(
    plant: Plant,
    stops: Sequence[Mapping[str, Any] | Stop],
    *,
    draws: Sequence[Mapping[str, Any]],
    spread: Widths | Sequence[Widths | None],
    unseen: Sequence[Mapping[str, Any]] = (),
    all_within: bool = True,
    start: Start = "rest",
    **arguments: Any,
) -> RobustPlan:
    """One input for a set of plants, so that named variables spread little at the stops.

    The nominal plant meets the stops exactly; a copy of it for each draw, driven by the same inputs
    from its own start, ends within ``spread`` of it. Planned as one plant (:class:`Ensemble`), then
    verified by simulating each draw on the plant itself.

    Parameters
    ----------
    stops, arguments : as for :func:`pam_ocp.plan`. Objectives, budgets and tracking see the nominal
        plant. ``cyclic="mirrored"`` is refused: unequal muscles have no mirror image.
    draws : {parameter: value} each, of the same parameters; or cases of :func:`pam_ocp.draws`.
    spread : {variable: largest deviation from the nominal plant} at every stop, in SI; or a list with
        one of these, or None, per stop.
    unseen : further draws, simulated only: how far the bound holds for plants not planned for.
    all_within : bounds and path constraints (never slack, strokes, rates) hold for every draw, not for
        the nominal plant only.
    start : where the copies begin: "rest" in the nominal's first state, but each with its positions
        where it rests under the pressures there (if the first stop is at rest); "same" in the very
        same state, as held by a latch. A cyclic motion has no start: every plant closes its own cycle.

    Raises InputError for what cannot be meant; PlanError where the spread cannot be kept: the message
    names ``NAME.deviation<k>`` at its stop.
    """
    require_plant(plant)
    members = drawn(plant, draws)
    cyclic = arguments.get("cyclic", False)
    if cyclic not in (False, True, None):
        raise InputError(f"cyclic = {cyclic!r}: a robust plan takes True or False")
    if start not in ("rest", "same"):
        raise InputError(f"start = {start!r}: choose 'rest' or 'same'")
    allowed = _allowed(plant, stops, spread)
    first = stops[0] if isinstance(stops[0], Stop) else Stop(stops[0])
    at_rest = arguments.get("rest", True) if first.rest is None else first.rest
    rest = bool(at_rest and start == "rest")
    nominal = plan(plant, stops, **arguments)
    watched = [v.name for v in plant.states] + [n for a in allowed for n in a]
    ensemble = Ensemble(plant, members, list(dict.fromkeys(watched)), all_within)
    wanted = [ensemble.stop(s, widths) for s, widths in zip(stops, allowed, strict=True)]
    if not cyclic:
        wanted[0] = _begun(ensemble, wanted[0], rest)
    guess = _stacked(ensemble, nominal, bool(cyclic), rest)
    further = {k: v for k, v in arguments.items() if k != "guess"}
    found = plan(ensemble, wanted, guess=guess, **ensemble.arguments(further, all_within))
    own = plant.with_values(found.design)
    names = [v.name for v in plant.states]
    samples = found.trajectory
    assert samples.signals is not None  # a plan's inputs are known in between
    motion = evaluated(own, samples.t, samples.array(names), samples.signals)

    def simulated(motion: Trajectory, of: Plan, some: Sequence[Draw]) -> Spread:
        at = _stop_samples(of, allowed)
        plant_of = own if of is found else of.plant
        return spread_of(plant_of, motion, some, at, cyclic=bool(cyclic), rest=rest)

    further_draws = drawn(plant, unseen) if unseen else None
    planned = [simulated(motion, found, d) if d else None for d in (members, further_draws)]
    alone = [
        simulated(nominal.trajectory, nominal, d) if d else None for d in (members, further_draws)
    ]
    assert planned[0] is not None  # there is at least one member
    assert alone[0] is not None
    return RobustPlan(
        found,
        nominal,
        motion,
        allowed,
        planned[0],
        alone[0],
        planned[1],
        alone[1],
        bool(cyclic),
        rest,
    )


def _allowed(
    plant: Plant, stops: Sequence[Any], spread: Widths | Sequence[Widths | None]
) -> tuple[dict[str, float], ...]:
    """The spread that each stop allows."""
    each = [spread] * len(stops) if isinstance(spread, Mapping) else list(spread)
    if len(each) != len(stops):
        raise InputError(f"spread holds {len(each)} entries for {len(stops)} stops")
    found = []
    for widths in each:
        checked = {}
        for name, width in (widths or {}).items():
            variable = plant.variable(name)
            if variable.causality not in ("state", "output"):
                raise InputError(
                    f"spread: {name} is a {variable.causality}; name states or outputs"
                )
            checked[variable.name] = require_positive(f"spread[{name!r}]", width, variable.unit)
        found.append(checked)
    if not any(found):
        raise InputError("spread is empty; name at least one variable, as in {'x': 1e-3}")
    return tuple(found)


def _begun(ensemble: Ensemble, stop: Stop, rest: bool) -> Stop:
    """The first stop, with what it says of the copies' start."""
    if stop.dwells:
        raise InputError("robust_plan: stop 1 has a dwell; begin with the motion")
    plant, values = ensemble.nominal, dict(stop.values)
    for state in plant.states:
        for k in range(1, len(ensemble.draws) + 1):
            if state.name not in ensemble.own:
                continue
            if rest and state.name in plant.positions:
                values[f"der({plant.positions[state.name]}.draw{k})"] = 0.0
            else:
                values[f"{state.name}.deviation{k}"] = 0.0
    return replace(stop, values=values)


def _stacked(ensemble: Ensemble, nominal: Plan, cyclic: bool, rest: bool) -> Plan:
    """The nominal plan with the copies' simulated states beside its own: where the solver starts."""
    plant, solved = nominal.plant, nominal._solved
    assert solved is not None  # a fresh plan that succeeded
    solution = solved.solution
    motion = nominal.trajectory
    runs = spread_of(plant, motion, ensemble.draws, (), rest=rest and not cyclic).motions
    columns = []
    for variable in ensemble.states:
        name, _, number = variable.name.partition(".draw")
        run = runs[int(number) - 1] if number else motion
        columns.append(motion[name] if isinstance(run, PamError) else run[name])
    states = np.column_stack(columns)
    shown = replace(solution, t=motion.t, states=states)
    return replace(nominal, _solved=Solved(solved.program, solved.outcome, shown))


def _stop_samples(found: Plan, allowed: Sequence[Widths]) -> list[int]:
    """Samples of a plan at which a stop is whose spread is bounded."""
    problem = found._problem
    assert problem is not None
    stops = [0]
    for leg in problem.legs:  # a dwell ends at the stop at which it begins
        stops.append(stops[-1] if leg.dwell else (stops[-1] + 1) % len(allowed))
    times = np.concatenate([[0.0], np.cumsum(found.durations)])
    t = found.trajectory.t
    return [
        int(np.argmin(np.abs(t - at))) for at, i in zip(times, stops, strict=True) if allowed[i]
    ]
