"""Equilibria: the points of rest of a plant under conditions, within the variables' bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .errors import InputError, PamError, require_finite, require_instance
from .plant.plant import Plant, Values, require_plant

__all__ = [
    "EquilibriumError",
    "OperatingPoint",
    "equilibrium",
]

Array: TypeAlias = NDArray[np.float64]
Expressions: TypeAlias = Mapping[str, tuple[ca.SX, float]]

TOLERANCE = 1e-9
"""Largest residual of an equilibrium, in units of nominal (per second)."""
MARGIN = 1e-8
"""Real parts of poles within this part of the fastest pole count as zero."""


class EquilibriumError(PamError):
    """No equilibrium meets the conditions within the plant's bounds."""


@dataclass(frozen=True)
class OperatingPoint:
    """States, inputs and outputs of a plant at one point; ``point["x"]`` gives a value [SI]."""

    plant: Plant
    x: Array
    u: Array
    residual: float = field(default=0.0)
    """Largest |xdot| in units of nominal per second (0 at an equilibrium)."""

    @cached_property
    def values(self) -> dict[str, float]:
        """All states, inputs and outputs by name."""
        y = np.asarray(self.plant.function(self.x, self.u, self.plant.vector("parameter"))[1])
        variables = (*self.plant.states, *self.plant.inputs, *self.plant.outputs)
        numbers = np.concatenate([self.x, self.u, y.ravel()])
        return {v.name: float(n) for v, n in zip(variables, numbers, strict=True)}

    def __getitem__(self, name: str) -> float:
        variable = self.plant.variable(name)
        if variable.causality == "parameter":
            return float(variable.start or 0.0)
        return self.values[variable.name]

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A [1/s], sorted by falling real part."""
        a = np.asarray(self.plant.jacobians(self.x, self.u, self.plant.vector("parameter"))[0])
        nominal = self.plant.vector("state", attribute="nominal")
        found = np.linalg.eigvals(a * nominal / nominal[:, None])
        return np.asarray(found[np.argsort(-found.real)], dtype=np.complex128)

    @property
    def stability(self) -> Literal["stable", "unstable", "marginal"]:
        """By the first approximation; "marginal" when a pole lies on the imaginary axis (then the
        first approximation cannot tell, or a state is a pure integral)."""
        margin = MARGIN * float(np.abs(self.poles).max(initial=0.0))
        largest = float(self.poles.real.max(initial=-np.inf))
        if largest > margin:
            return "unstable"
        return "stable" if largest < -margin else "marginal"

    def __str__(self) -> str:
        return "\n".join(
            f"{n:<24} {self.plant.variable(n).shown(v)}" for n, v in self.values.items()
        )


def equilibrium(
    plant: Plant,
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    expressions: Expressions | None = None,
    guess: OperatingPoint | None = None,
    **more: Any,
) -> OperatingPoint:
    """The point of rest that meets conditions on states, inputs, outputs (or parameters).

    ``equilibrium(plant, x=0.0, stiffness=2e4)``; values of parameters replace the plant's. As many
    conditions are needed as the plant has inputs (each condition fixes one freedom of rest);
    disturbances (external forces) that are not named are held at their start value.

    free : parameters and disturbances to be found as well, each for one more condition: the load
        that rests at x under 3 bar is ``equilibrium(plant, {"x": 0.05, "muscle.command": 3e5},
        free=["mass"])["mass"]``. The point's own ``plant`` then has these parameters.
    expressions : {label: (CasADi expression of the plant's symbols, value)}, each one more condition
        for what is no variable, such as the co-contraction of a pair:
        ``{"mean": ((plant.expression("muscle1.pressure") + plant.expression("muscle2.pressure")) / 2, 3e5)}``.
    guess : a point to start from (a neighbour), tried first.

    Solved within the variables' bounds by IPOPT from several starts, then by Newton to rounding.
    Raises InputError when the conditions are too few or too many, EquilibriumError when no point
    within the bounds meets them (it names the one that fails, and by how much).
    """
    require_instance("conditions", conditions, Mapping, "give values by name", none=True)
    search, targets = posed(plant, {**(conditions or {}), **more}, free, expressions)
    point, nearest = search.solve(guess)
    if point is None:
        raise EquilibriumError(why_not(search, targets, nearest))
    return point


def posed(
    plant: Plant, conditions: Values, free: Sequence[str], expressions: Expressions | None = None
) -> tuple[_Search, dict[str, float]]:
    """The search that conditions and free variables stand for, and its targets."""
    require_plant(plant)
    given = {plant.variable(n).name: v for n, v in conditions.items()}
    free = [plant.variable(n).name for n in ([free] if isinstance(free, str) else free)]
    for name in free:
        variable = plant.variable(name)
        if variable.causality != "parameter" and not variable.disturbance:
            raise InputError(
                f"free: {name} is a {variable.causality}; name parameters or disturbances "
                "(states and other inputs are unknown anyway)"
            )
        if name in given:
            raise InputError(f"{name} cannot be free and given (= {given[name]}) at once")
    constants = {n: v for n, v in given.items() if plant.variable(n).causality == "parameter"}
    plant = plant.with_values(constants)
    targets = {
        n: plant.variable(n).check(v, "the condition")
        for n, v in given.items()
        if n not in constants
    }
    more = {n: (ca.SX(x), require_finite(n, v)) for n, (x, v) in (expressions or {}).items()}
    targets.update({n: v for n, (_, v) in more.items()})
    loose = [n for n in free if plant.variable(n).causality == "parameter"]
    disturbances = {
        v.name: v.start or 0.0
        for v in plant.inputs
        if v.disturbance and v.name not in targets and v.name not in free
    }
    if len(targets) + len(disturbances) == len(plant.inputs) + len(loose):
        targets.update(disturbances)
    if len(targets) != len(plant.inputs) + len(loose):
        controls = [v.name for v in plant.inputs if v.name not in disturbances] + loose
        raise InputError(
            f"equilibrium of {plant.name!r} needs {len(controls)} condition(s), one for each of its "
            f"inputs{' and free variables' if free else ''} ({', '.join(controls)}); "
            f"{len(targets)} given: {', '.join(targets) or 'none'}"
        )
    return _Search(plant, targets, loose, {n: x for n, (x, _) in more.items()}), targets


class _Search:
    """The residual of rest and conditions, scaled by nominals, and its solution by IPOPT.

    Unknown are z = (states, inputs, free parameters).
    """

    def __init__(
        self,
        plant: Plant,
        targets: Mapping[str, float],
        free: Sequence[str],
        more: Mapping[str, ca.SX],
    ) -> None:
        self.plant, self.targets, self.free = plant, list(targets), list(free)
        self.names = [f"der({v.name})" for v in plant.states] + self.targets
        # an expression has no nominal: its value says its size
        scale = np.array(
            [v.nominal for v in plant.states]
            + [
                abs(v) or 1.0 if n in more else plant.variable(n).nominal
                for n, v in targets.items()
            ]
        )
        rows = [more[n] if n in more else plant.expression(n) for n in self.names]
        values = np.array([0.0] * len(plant.states) + list(targets.values()))
        symbols = [plant.expression(n) for n in free]
        loose = ca.SX.sym("free", len(free))
        z = ca.vertcat(plant.x, plant.u, loose)
        residual = (ca.vertcat(*rows) - values) / scale
        if free:
            residual = ca.substitute(residual, ca.vertcat(*symbols), loose)
        self.function = ca.Function("rest", [z, plant.p], [residual, ca.jacobian(residual, z)])
        self.p = plant.vector("parameter")
        unknown = (*plant.states, *plant.inputs, *(plant.variable(n) for n in free))
        self.nominal, self.low, self.high, self.start = (
            np.array([getattr(v, a) for v in unknown], dtype=float)
            for a in ("nominal", "min", "max", "start")
        )

    def vector(self, point: OperatingPoint) -> Array:
        """The unknowns at a point."""
        return np.concatenate([point.x, point.u, [point[n] for n in self.free]])

    def point(self, z: Array) -> OperatingPoint:
        """The point of given unknowns; its plant has the free parameters' values."""
        n, m = len(self.plant.states), len(self.plant.inputs)
        plant = self.plant
        if self.free:
            plant = plant.with_values(dict(zip(self.free, z[n + m :], strict=True)))
        error = float(np.abs(self.residual(z)).max())
        return OperatingPoint(plant, z[:n], z[n : n + m], error)

    def polished(self, z: Array) -> Array | None:
        """The equilibrium that Newton's method reaches from z, None when outside or none."""
        point = self.newton(z)
        error = np.abs(self.residual(point)).max()
        margin = 1e-9 * self.nominal
        inside = np.all((point >= self.low - margin) & (point <= self.high + margin))
        return np.clip(point, self.low, self.high) if error < TOLERANCE and inside else None

    def residual(self, point: Array) -> Array:
        value: Array = np.asarray(self.function(point, self.p)[0], dtype=float)
        return value.ravel()

    @cached_property
    def _solver(self) -> ca.Function:
        """min |r|^2 s.t. r = residual(z): converges also where no equilibrium exists."""
        w, r = ca.MX.sym("w", len(self.nominal)), ca.MX.sym("r", len(self.names))
        nlp: dict[str, ca.MX] = {
            "x": ca.vertcat(w, r), "f": ca.sumsqr(r),
            "g": self.function(w * self.nominal, self.p)[0] - r,
        }  # fmt: skip
        ipopt: dict[str, Any] = {
            "print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 200, "mu_init": 1e-3,
        }  # fmt: skip
        return ca.nlpsol("equilibrium", "ipopt", nlp, {"print_time": False, "ipopt": ipopt})

    def nearest(self, guess: Array, high: Array | None = None, slack: Array | None = None) -> Array:
        """The point within the bounds whose residual is smallest, |r_i| <= slack_i."""
        high = self.high if high is None else high
        slack = np.full(len(self.names), np.inf) if slack is None else slack
        result = self._solver(
            x0=np.concatenate([guess / self.nominal, np.zeros(len(slack))]),
            lbx=np.concatenate([self.low / self.nominal, -slack]),
            ubx=np.concatenate([high / self.nominal, slack]), lbg=0, ubg=0,
        )  # fmt: skip
        w: Array = np.asarray(result["x"], dtype=float).ravel()[: len(self.nominal)]
        return np.asarray(w * self.nominal)

    def solve(self, guess: OperatingPoint | None = None) -> tuple[OperatingPoint | None, Array]:
        """The equilibrium, or None and the point that comes nearest."""
        if guess is not None:
            near = self.polished(self.newton(self.vector(guess), steps=20))
            if near is not None:
                return self.point(near), near
        best, least = self.start, np.inf
        for start in self.starts():
            nearest = self.nearest(start)
            point = self.polished(nearest)
            if point is not None:
                return self.point(point), point
            miss = float(np.abs(self.residual(nearest)).max())
            if miss < least:
                best, least = nearest, miss
        return None, best

    def relaxed(self, name: str, more_pressure: bool) -> OperatingPoint | None:
        """The equilibrium with condition ``name`` left as near to its value as the others allow.

        more_pressure : pressures may exceed their range. None when there is no such point.
        """
        i = self.names.index(name)
        slack = np.zeros(len(self.names))
        slack[i] = np.inf
        variables = (*self.plant.states, *self.plant.inputs)
        high = self.high.copy()
        high[: len(variables)] = [
            np.inf if more_pressure and v.unit == "Pa" else v.max for v in variables
        ]
        for guess in self.starts():
            point = self.nearest(guess, high, slack)
            others = np.delete(self.residual(point), i)
            if np.abs(others).max() < 1e-6:
                return self.point(np.clip(point, self.low, high))
        return None

    def starts(self, count: int = 5, seed: int = 0, reach: float = 1.0) -> list[Array]:
        """Start values first, then points spread over the bounds (fixed seed: the same each time).

        reach : how many nominals to go from the start where there is no bound.
        """
        span = reach * self.nominal
        low = np.where(np.isfinite(self.low), self.low, self.start - span)
        high = np.where(np.isfinite(self.high), self.high, self.start + span)
        spread = np.random.default_rng(seed).uniform(0.1, 0.9, size=(count, len(low)))
        return [self.start, *(low + s * (high - low) for s in spread)]

    def newton(self, point: Array, steps: int = 4) -> Array:
        """A few Newton steps to rounding; least squares where the Jacobian is singular."""
        for _ in range(steps):
            residual, jacobian = (np.asarray(m, dtype=float) for m in self.function(point, self.p))
            if not np.all(np.isfinite(jacobian)):
                break
            # in units of nominal: else pressures alone would decide what is singular
            step = np.linalg.lstsq(jacobian * self.nominal, residual.ravel(), rcond=None)[0]
            point = point - step * self.nominal
            if np.abs(step).max() < 1e-15:
                break
        return point


def why_not(search: _Search, targets: Mapping[str, float], nearest: Array) -> str:
    """What cannot be met, and for each condition the value that the others would allow."""
    plant = search.plant
    known = {v.name for v in plant.variables}
    wanted = ", ".join(
        f"{n} = {plant.variable(n).shown(v) if n in known else f'{v:.6g}'}"
        for n, v in targets.items()
    )
    remedies = []
    for name, value in ((n, v) for n, v in targets.items() if n in known):
        variable = plant.variable(name)
        inside = search.relaxed(name, more_pressure=False)
        point = search.relaxed(name, more_pressure=True) if inside is None else inside
        if point is None:
            continue
        beyond = " (beyond the plant's range)" if inside is None else ""
        if abs(point[name] - value) > 1e-6 * variable.nominal:
            remedies.append(f"{name} = {variable.shown(point[name])} would do{beyond}")
        else:
            pressures = [v for v in plant.inputs if v.unit == "Pa"]
            needed = " and ".join(f"{v.name} = {v.shown(point[v.name])}" for v in pressures)
            remedies.append(f"{needed} would do{beyond}")
    remedies = list(dict.fromkeys(remedies))
    if remedies:
        hint = f"With all else as it is, {' or '.join(remedies)}"
    else:
        near = search.point(np.clip(nearest, search.low, search.high))
        at = ", ".join(
            f"{v.name} = {v.shown(near[v.name])}" for v in (*plant.states, *plant.inputs)
        )
        worst = search.names[int(np.argmax(np.abs(search.residual(nearest))))]
        hint = f"The nearest point is {at}, where {worst} is not met"
    return (
        f"no equilibrium of {plant.name!r} with {wanted} within the plant's bounds. {hint}; or change "
        "the load or the muscle"
    )
