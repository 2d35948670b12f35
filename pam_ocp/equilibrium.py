"""Equilibria: the points of rest of a plant under conditions, within the variables' bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .errors import InputError, PamError
from .plant.plant import Plant, Values

__all__ = ["EquilibriumError", "OperatingPoint", "equilibrium"]

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-9
"""Largest residual of an equilibrium, in units of nominal (per second)."""


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
        return self.values[self.plant.variable(name).name]

    def __str__(self) -> str:
        return "\n".join(
            f"{n:<24} {self.plant.variable(n).shown(v)}" for n, v in self.values.items()
        )


def equilibrium(plant: Plant, conditions: Values | None = None, /, **more: Any) -> OperatingPoint:
    """The point of rest that meets conditions on states, inputs, outputs (or parameters).

    ``equilibrium(plant, x=0.0, stiffness=2e4)``; values of parameters replace the plant's. As many
    conditions are needed as the plant has inputs (each condition fixes one freedom of rest);
    disturbances (external forces) that are not named are held at their start value.

    Solved within the variables' bounds by IPOPT from several starts, then by Newton to rounding.
    Raises InputError when the conditions are too few or too many, EquilibriumError when no point
    within the bounds meets them (it names the one that fails, and by how much).
    """
    given = {plant.variable(n).name: v for n, v in {**(conditions or {}), **more}.items()}
    constants = {n: v for n, v in given.items() if plant.variable(n).causality == "parameter"}
    plant = plant.with_values(constants)
    targets = {n: float(v) for n, v in given.items() if n not in constants}
    for name, value in targets.items():
        if not np.isfinite(value):
            raise InputError(f"equilibrium: {name} = {value} must be finite")
        plant.variable(name).check(value, "the condition")
    disturbances = {
        v.name: v.start or 0.0 for v in plant.inputs if v.disturbance and v.name not in targets
    }
    if len(targets) + len(disturbances) == len(plant.inputs):
        targets.update(disturbances)
    if len(targets) != len(plant.inputs):
        controls = [v.name for v in plant.inputs if v.name not in disturbances]
        raise InputError(
            f"equilibrium of {plant.name!r} needs {len(controls)} condition(s), one for each of its "
            f"inputs ({', '.join(controls)}); {len(targets)} given: {', '.join(targets) or 'none'}"
        )
    search = _Search(plant, targets)
    point, nearest = search.solve()
    if point is None:
        raise EquilibriumError(_why(search, targets, nearest))
    return point


class _Search:
    """The residual of rest and conditions, scaled by nominals, and its solution by IPOPT."""

    def __init__(self, plant: Plant, targets: Mapping[str, float]) -> None:
        self.plant, self.targets = plant, list(targets)
        self.names = [f"der({v.name})" for v in plant.states] + self.targets
        variables = (*plant.states, *(plant.variable(n) for n in targets))
        scale = np.array([v.nominal for v in variables])
        values = np.array([0.0] * len(plant.states) + list(targets.values()))
        z = ca.vertcat(plant.x, plant.u)
        residual = (ca.vertcat(*(plant.expression(n) for n in self.names)) - values) / scale
        self.function = ca.Function("rest", [z, plant.p], [residual, ca.jacobian(residual, z)])
        self.p = plant.vector("parameter")
        self.nominal, self.low, self.high, self.start = (
            np.concatenate([plant.vector(c, attribute=a) for c in ("state", "input")])
            for a in ("nominal", "min", "max", "start")
        )

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

    def _nearest(self, guess: Array, high: Array, slack: Array) -> Array:
        """The point within the bounds whose residual is smallest, |r_i| <= slack_i."""
        result = self._solver(
            x0=np.concatenate([guess / self.nominal, np.zeros(len(slack))]),
            lbx=np.concatenate([self.low / self.nominal, -slack]),
            ubx=np.concatenate([high / self.nominal, slack]), lbg=0, ubg=0,
        )  # fmt: skip
        return np.asarray(result["x"], dtype=float).ravel()[: len(self.nominal)] * self.nominal

    def solve(self) -> tuple[OperatingPoint | None, Array]:
        """The equilibrium, or None and the point that comes nearest."""
        free = np.full(len(self.names), np.inf)
        best, least = self.start, np.inf
        for guess in self._starts():
            nearest = self._nearest(guess, self.high, free)
            point = self._newton(nearest)
            error = float(np.abs(self.residual(point)).max())
            margin = 1e-9 * self.nominal
            if error < TOLERANCE and np.all(
                (point >= self.low - margin) & (point <= self.high + margin)
            ):
                point = np.clip(point, self.low, self.high)
                n = len(self.plant.states)
                return OperatingPoint(self.plant, point[:n], point[n:], error), point
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
        high = np.array([np.inf if more_pressure and v.unit == "Pa" else v.max for v in variables])
        for guess in self._starts():
            point = self._nearest(guess, high, slack)
            others = np.delete(self.residual(point), i)
            if np.abs(others).max() < 1e-6:
                x, u = np.split(point, [len(self.plant.states)])
                return OperatingPoint(self.plant, x, u)
        return None

    def _starts(self) -> list[Array]:
        """Start values first, then points spread over the bounds (fixed seed: the same each time)."""
        low = np.where(np.isfinite(self.low), self.low, self.start - self.nominal)
        high = np.where(np.isfinite(self.high), self.high, self.start + self.nominal)
        spread = np.random.default_rng(0).uniform(0.1, 0.9, size=(5, len(low)))
        return [self.start, *(low + s * (high - low) for s in spread)]

    def _newton(self, point: Array, steps: int = 4) -> Array:
        """A few Newton steps to rounding; least squares where the Jacobian is singular."""
        for _ in range(steps):
            residual, jacobian = (np.asarray(m, dtype=float) for m in self.function(point, self.p))
            if not np.all(np.isfinite(jacobian)):
                break
            point = point - np.linalg.lstsq(jacobian, residual.ravel(), rcond=None)[0]
        return point


def _why(search: _Search, targets: Mapping[str, float], nearest: Array) -> str:
    """What cannot be met, and for each condition the value that the others would allow."""
    plant = search.plant
    wanted = ", ".join(f"{n} = {plant.variable(n).shown(v)}" for n, v in targets.items())
    remedies = []
    for name, value in targets.items():
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
        x, u = np.split(nearest, [len(plant.states)])
        near = OperatingPoint(plant, x, u)
        at = ", ".join(
            f"{v.name} = {v.shown(near[v.name])}" for v in (*plant.states, *plant.inputs)
        )
        worst = search.names[int(np.argmax(np.abs(search.residual(nearest))))]
        hint = f"The nearest point is {at}, where {worst} is not met"
    return (
        f"no equilibrium of {plant.name!r} with {wanted} within the plant's bounds. {hint}; or change "
        "the load or the muscle"
    )
