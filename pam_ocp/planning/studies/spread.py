"""Spread: where plants with other parameters come under the inputs of one planned motion, and what
is asked of such an ensemble where it is asked of a plant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.cases import ending
from ...core.errors import InputError, PamError, SimulationError
from ...core.executors import Place
from ...core.trajectory import Trajectory
from ...judge.statement import Avoid, Constraint, Phase, Stop
from ...numerics.newton import NewtonError, iterate, least_squares, newton
from ...plants.ensemble import Ensemble
from ...plants.plant import Plant
from ...plants.stillness import rest_rows
from ...simulation.simulator import simulate

Array: TypeAlias = NDArray[np.float64]
Draw: TypeAlias = Mapping[str, float]

SETTLED = 1e-8
"""A cycle is closed when no state changes by more than this part of nominal over it."""
STEP = 1e-4
"""Of the differences for the Jacobian of a cycle, in units of nominal."""
ITERATIONS = 30


def drawn(plant: Plant, draws: Sequence[Mapping[str, Any]]) -> tuple[dict[str, float], ...]:
    """Draws {parameter: value}, or cases of :func:`pam_ocp.simulation.draws`, checked."""
    found = []
    for draw in draws:
        values = draw.get("parameters", draw)
        if values is not draw and len(draw) > 1:
            others = ", ".join(sorted(set(draw) - {"parameters"}))
            raise InputError(f"draws: a case holds {others}; only parameters can be drawn")
        own = {}
        for name, value in values.items():
            variable = plant.variable(name)
            if variable.causality != "parameter":
                raise InputError(f"draws: {name} is {variable.kind}, not a parameter")
            own[variable.name] = variable.number(value, "draws")
        found.append(own)
    if not found or not found[0]:
        raise InputError("draws is empty; give a list of {parameter: value}")
    if any(set(d) != set(found[0]) for d in found):
        raise InputError("draws: all of them must name the same parameters")
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Spread:
    """The motions of plants with drawn parameters under one motion's inputs.

    Examples
    --------
    >>> draws = [{"mass": 1.96}, {"mass": 2.04}]
    >>> ways = {"share": None, "method": pam.Collocation(10, 3)}
    >>> stops = [{"x": -0.01}, {"x": 0.01}]
    >>> robust = pam.robust_plan(slide, stops, draws=draws, spread={"x": 1e-3}, **ways)
    >>> bool(np.abs(robust.members.at_stops("x")).max() < 1.001e-3)
    True
    """

    plant: Plant
    nominal: Trajectory
    draws: tuple[Draw, ...]
    motions: tuple[Trajectory | PamError, ...]
    """In the order of the draws; the error of one that could not be simulated."""
    stops: tuple[int, ...]
    """Samples of the motions at which a stop is."""

    @property
    def failures(self) -> dict[int, PamError]:
        """Draws that could not be simulated."""
        return {i: m for i, m in enumerate(self.motions) if isinstance(m, PamError)}

    def deviation(self, name: str) -> Array:
        """(draws, samples) difference from the nominal motion; NaN for a draw that failed."""
        rows = [
            np.full(len(self.nominal), np.nan)
            if isinstance(m, PamError)
            else m[name] - self.nominal[name]
            for m in self.motions
        ]
        return np.array(rows)

    def at_stops(self, name: str) -> Array:
        """(draws, stops) difference from the nominal motion at the stops."""
        return self.deviation(name)[:, list(self.stops)]

    def worst(self, name: str) -> float:
        """Largest deviation at a stop; infinite when a draw could not be simulated."""
        return float("inf") if self.failures else float(np.max(np.abs(self.at_stops(name))))

    def share_within(self, limits: Mapping[str, float]) -> float:
        """Part of the draws that stay within all limits at all stops."""
        kept = [
            np.all(np.abs(self.at_stops(n)) <= width * (1 + 1e-6), axis=1)
            for n, width in limits.items()
        ]
        return float(np.mean(np.all(kept, axis=0)))

    @property
    def violation(self) -> tuple[float, str]:
        """(largest violation of the plant's own path constraints in nominals, which one)."""
        found = [(0.0, "")]
        plant = self.plant
        for draw, motion in zip(self.draws, self.motions, strict=True):
            if isinstance(motion, PamError):
                continue
            x, u = (motion.array(motion.named(c)).T for c in ("state", "input"))
            p = plant.vector("parameter", draw)
            values = np.asarray(plant.function(x, u, p)[2], float)
            for v, row in zip(plant.constraints, values, strict=True):
                worst = np.max(np.maximum(v.min - row, row - v.max)) / v.nominal
                found.append((float(worst), v.name))
        return max(found)


def spread_of(
    plant: Plant,
    motion: Trajectory,
    draws: Sequence[Draw],
    stops: Sequence[int],
    *,
    cyclic: bool = False,
    rest: bool = True,
    executor: Place = None,
) -> Spread:
    """Simulate each draw of a plant under the inputs of a motion.

    stops : samples of the motion at which a stop is.
    cyclic : each plant runs in its own steady cycle; else it starts in the motion's first state,
        with (``rest``) its positions where it rests under that state's pressures.
    executor : where, as for :func:`pam_ocp.each`.
    """
    work = _Driven(plant, motion, _Closing(plant, motion) if cyclic else None, rest)
    found = dict(ending(work, draws, executor=executor, what="draws", lost=SimulationError))
    for result in found.values():
        if isinstance(result, Exception) and not isinstance(result, InputError | SimulationError):
            raise result
    motions = tuple(found[i] for i in range(len(draws)))
    return Spread(plant, motion, tuple(draws), motions, tuple(stops))


@dataclass(frozen=True, eq=False)
class _Driven:
    """A motion's inputs; called with a draw it gives the motion of a plant with that under them."""

    plant: Plant
    motion: Trajectory
    closing: _Closing | None
    rest: bool

    def __call__(self, draw: Draw) -> Trajectory:
        own = self.plant.with_values(draw)
        if self.closing is not None:
            return self.closing(own)
        return simulate(own, self.motion, start=_begin(own, self.motion, self.rest))


def _begin(plant: Plant, motion: Trajectory, rest: bool) -> dict[str, float]:
    """Where a plant starts: in the motion's first state, its positions at rest."""
    first = motion.row(0)
    start = _inside(plant, [first[v.name] for v in plant.states])
    if rest:
        start.update(_resting(plant, start, [first[v.name] for v in plant.inputs]))
    return start


def _inside(plant: Plant, x: Sequence[float]) -> dict[str, float]:
    """States by name; a solver's rounding beyond their range is taken off."""
    return {
        v.name: float(np.clip(value, v.min, v.max))
        for v, value in zip(plant.states, x, strict=True)
    }


class _Closing:
    """Finds the steady cycle of plants that are near to one, under the inputs of its motion.

    Newton's method on x(T) = x(0) with one Jacobian, by differences, of the nominal plant.
    """

    def __init__(self, plant: Plant, motion: Trajectory) -> None:
        self.motion = motion
        self.nominal = plant.vector("state", attribute="nominal")
        self.names = [v.name for v in plant.states]
        self.first = motion.array(self.names)[0]
        end = self._end(plant, self.first)[1]
        columns = []
        for i, size in enumerate(self.nominal):
            low, high = plant.variable(self.names[i]).min, plant.variable(self.names[i]).max
            sign = -1.0 if self.first[i] > (low + high) / 2 else 1.0  # into the range
            moved = self.first.copy()
            moved[i] += sign * STEP * size
            columns.append((self._end(plant, moved)[1] - end) / (sign * STEP) / self.nominal)
        self.inverse = np.linalg.inv(np.column_stack(columns) - np.eye(len(self.nominal)))

    def _end(self, plant: Plant, x: Array) -> tuple[Trajectory, Array]:
        run = simulate(plant, self.motion, start=_inside(plant, x.tolist()))
        return run, run.array(self.names)[-1]

    def __call__(self, plant: Plant) -> Trajectory:
        """The cycle of a plant; SimulationError when it is not found."""
        runs: list[Trajectory] = []

        def open_by(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            run, end = self._end(plant, w * self.nominal)
            runs.append(run)
            gap = (end - run.array(self.names)[0]) / self.nominal
            return gap, lambda right: np.asarray(self.inverse @ right)

        start = self.first / self.nominal
        root = iterate(open_by, start, tolerance=SETTLED, steps=ITERATIONS, halvings=0)
        if not root.reason and root.size <= SETTLED:
            return runs[-1]
        raise SimulationError(
            f"{plant.name} with these parameters has no steady cycle near the planned one"
        )


def _resting(plant: Plant, start: Mapping[str, float], inputs: Sequence[float]) -> dict[str, float]:
    """Positions at which the forces balance, all other states as given."""
    positions = [q for q in plant.resting() if not q.driven]
    names = [q.name for q in positions]
    if not names:
        return {}
    scale = np.array([plant.variable(n).nominal for n in names])

    def build() -> ca.Function:
        rows = [
            expression / plant.variable(position.velocities[0]).nominal
            for position, order, expression in rest_rows(plant, tuple(positions))
            if order == 2
        ]
        z, symbols = ca.SX.sym("z", len(names)), [plant.expression(n) for n in names]
        balance = ca.substitute(ca.vertcat(*rows), ca.vertcat(*symbols), z * scale)
        given = [plant.x, plant.u, plant.p]
        return ca.Function("balance", [z, *given], [balance, ca.jacobian(balance, z)])

    balance = plant.cached(("balance", *names), build)
    x = [start[v.name] for v in plant.states]

    def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
        residual, slopes = (
            np.asarray(each, float)
            for each in balance(w, x, list(inputs), plant.vector("parameter"))
        )
        # positions that count one motion are more than the equations
        return residual.ravel(), least_squares(slopes)

    try:
        z, _ = newton(equations, np.array([start[n] for n in names]) / scale, steps=100)
    except NewtonError as error:
        raise SimulationError(
            f"{plant.name} with these parameters has no equilibrium at the start's pressures: "
            f"{error}"
        ) from None
    return dict(zip(names, (z * scale).tolist(), strict=True))


def ensemble_arguments(ensemble: Ensemble, given: Mapping[str, Any], kept: bool) -> dict[str, Any]:
    """Arguments of plan for the nominal plant (all but stops), said of the ensemble.

    kept : the copies keep bounds and constraints too, not the nominal plant only.
    """
    found = dict(given)
    for name in ("integrand", "final"):
        if found.get(name) is not None:
            found[name] = ensemble.expression_in(0, found[name])
    designed = set(found.get("design") or {}) & set(ensemble.draws[0])
    if designed:
        raise InputError(f"design: {', '.join(sorted(designed))} is drawn, it cannot be chosen")
    if found.get("bounds"):
        found["bounds"] = _bounds(ensemble, found["bounds"], kept)
    if found.get("constraints"):
        found["constraints"] = _constraints(ensemble, found["constraints"], kept)
    if found.get("phases"):
        found["phases"] = [
            phase
            if phase is None
            else Phase(
                phase.duration,
                _bounds(ensemble, phase.bounds, kept),
                _constraints(ensemble, phase.constraints, kept),
            )
            for phase in found["phases"]
        ]
    return found


def _bounds(ensemble: Ensemble, bounds: Mapping[str, Any], kept: bool) -> dict[str, Any]:
    copies = {m: b for n, b in bounds.items() for m in ensemble.images(n)} if kept else {}
    return {**bounds, **copies}


def _constraints(
    ensemble: Ensemble, constraints: Sequence[Constraint | Avoid], kept: bool
) -> list[Constraint | Avoid]:
    found: list[Constraint | Avoid] = []
    for given in constraints:
        for k in range(len(ensemble.draws) + 1 if kept else 1):
            of = f" in draw {k}" if k else ""
            if isinstance(given, Constraint):
                expression = ensemble.expression_in(k, given.expression)
                found.append(replace(given, expression=expression, name=given.name + of))
            elif k == 0:
                found.append(given)
            else:
                region = {
                    (ensemble.images(n) or [n] * k)[k - 1] if n != "time" else n: value
                    for n, value in given.region.items()
                }
                found.append(Avoid(region, given.name + of))
    return found


def ensemble_stop(
    ensemble: Ensemble, stop: Mapping[str, Any] | Stop, spread: Mapping[str, float]
) -> Stop:
    """A stop, with the copies' watched variables within their spread there."""
    stop = stop if isinstance(stop, Stop) else Stop(stop)
    within = {
        f"{n}.deviation{k}": (-width, width)
        for n, width in spread.items()
        if n in ensemble.own
        for k in range(1, len(ensemble.draws) + 1)
    }
    return replace(stop, values={**stop.values, **within})
