"""The equations of rest of a plant under conditions.

At rest the rates of all states vanish, but those of held memories (hysteresis), which keep a value
instead; and what was asked for has its value. Equilibria, branches, borders of stability and
whatever else speaks of rest take the equations from here.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_finite
from ..numerics.newton import iterate, least_squares
from ..numerics.solvers import Nlp, nlpsol, quiet_ipopt
from ..plants.plant import Plant, Values, require_plant
from .held import Memory, at_rest, held
from .operating_point import OperatingPoint

Array: TypeAlias = NDArray[np.float64]
Expressions: TypeAlias = Mapping[str, tuple[ca.SX, float]]

TOLERANCE = 1e-9
"""Largest scaled residual of an equilibrium [1/s]."""
ROUGH = 1e-6
"""Largest residual from which Newton's method is asked for the rest."""
TAUT = 3
"""Starts under high pressures."""


class Rest:
    """r(z) = 0 for z = (states, inputs, free parameters), all scaled by nominals.

    Rows : the rates, then the held memories' values (``pinned``), then the conditions
    (``targets``). Held memories that are not pinned have neither, and need a condition more.
    more : expressions among the conditions, by label.
    """

    def __init__(
        self,
        plant: Plant,
        targets: Mapping[str, float],
        free: Sequence[str] = (),
        more: Mapping[str, ca.SX] | None = None,
        pinned: Mapping[str, float] | None = None,
    ) -> None:
        more, pinned = more or {}, pinned or {}
        self.plant, self.targets, self.free = plant, list(targets), list(free)
        self.more, self.pinned = dict(more), dict(pinned)
        rates = [v for v in plant.states if v.memory != "held"]
        given = {**pinned, **targets}
        self.names = [f"der({v.name})" for v in rates] + list(given)
        # an expression has no nominal: its value says its size
        sizes = [
            abs(v) or 1.0 if n in more else plant.variable(n).nominal for n, v in given.items()
        ]
        rows = [more[n] if n in more else plant.expression(n) for n in self.names]
        values = ca.SX.sym("values", len(given))
        scale = np.array([v.nominal for v in rates] + sizes)
        residual = (ca.vertcat(*rows) - ca.vertcat(ca.SX.zeros(len(rates)), values)) / scale
        z, residual = self._unknown(residual)
        p = ca.vertcat(plant.p, values)
        self.function = ca.Function("rest", [z, p], [residual, ca.jacobian(residual, z)])
        self.p = np.concatenate([plant.vector("parameter"), list(given.values())])
        unknown = (*plant.states, *plant.inputs, *(plant.variable(n) for n in free))
        self.unknown = [v.name for v in unknown]
        self.nominal, self.low, self.high, self.start = (
            np.array([getattr(v, a) for v in unknown], dtype=float)
            for a in ("nominal", "min", "max", "start")
        )
        for name, value in pinned.items():
            i = self.unknown.index(name)
            self.low[i] = self.high[i] = self.start[i] = value

    def _unknown(self, expression: ca.SX) -> tuple[ca.SX, ca.SX]:
        """(z, the expression of it): free parameters are unknowns like states and inputs."""
        free = ca.SX.sym("free", len(self.free))
        if self.free:
            symbols = ca.vertcat(*(self.plant.expression(n) for n in self.free))
            expression = ca.substitute(expression, symbols, free)
        return ca.vertcat(self.plant.x, self.plant.u, free), ca.SX(expression)

    # ---- other equations like these -----------------------------------------------------------
    def along(self, name: str) -> Rest:
        """The same without the condition on a variable: one unknown more than equations."""
        loose = list(self.free)
        if self.plant.variable(name).causality == "parameter" and name not in loose:
            loose.append(name)
        kept = {n: v for n, v in self.values.items() if n != name}
        return Rest(self.plant, kept, loose, self.more, self.pinned)

    def moved(self, name: str, value: float) -> Rest:
        """The same with another value of one condition."""
        other = copy.copy(self)
        other.__dict__.pop("_relaxed", None)
        other.p = self.p.copy()
        other.p[self.place(name)] = value
        return other

    def place(self, name: str) -> int:
        """Where a parameter, a condition or a pinned memory stands in ``p``."""
        parameters = [v.name for v in self.plant.parameters]
        return (parameters + self.names[len(self.names) - len(self.p) + len(parameters) :]).index(
            name
        )

    @property
    def values(self) -> dict[str, float]:
        """The conditions."""
        numbers = self.p[len(self.p) - len(self.targets) :].tolist()
        return dict(zip(self.targets, numbers, strict=True))

    # ---- points -------------------------------------------------------------------------------
    def vector(self, point: OperatingPoint) -> Array:
        """The unknowns at a point."""
        return np.concatenate([point.x, point.u, [point[n] for n in self.free]])

    def point(self, z: Array) -> OperatingPoint:
        """The point of given unknowns; its plant has the free parameters' values.

        A memory that would not stay (a largest contraction so far below the present one) is where
        it comes to.
        """
        n, m = len(self.plant.states), len(self.plant.inputs)
        plant = self.plant
        if self.free:
            plant = plant.with_values(dict(zip(self.free, z[n + m :], strict=True)))
        left = at_rest(plant, z[:n], self.pinned, z[n : n + m])
        if left != self.pinned:
            other = Rest(self.plant, self.values, self.free, self.more, left)
            stays = other.converged(z)
            if stays is not None:
                return OperatingPoint(plant, stays[:n], stays[n : n + m], other.worst(stays))
        return OperatingPoint(plant, z[:n], z[n : n + m], self.worst(z))

    def worst(self, z: Array) -> float:
        """The largest residual at given unknowns."""
        return float(np.abs(self.residual(z)).max())

    def residual(self, point: Array) -> Array:
        value: Array = np.asarray(self.function(point, self.p)[0], dtype=float)
        return value.ravel()

    def equations(self, w: Array) -> tuple[Array, Array]:
        """(residual, Jacobian) at unknowns scaled by nominals."""
        found = self.function(w * self.nominal, self.p)
        residual, jacobian = (np.asarray(m, dtype=float) for m in found)
        return residual.ravel(), jacobian * self.nominal

    def of(self, name: str) -> Callable[[Array], tuple[float, Array]]:
        """w -> (value, gradient) of a variable in units of its nominal; w as in `equations`."""
        value = self.plant.expression(name) / self.plant.variable(name).nominal
        z, value = self._unknown(value)
        function = ca.Function("value", [z, self.plant.p], [value, ca.jacobian(value, z)])
        p = self.plant.vector("parameter")

        def evaluated(w: Array) -> tuple[float, Array]:
            found, gradient = function(w * self.nominal, p)
            return float(found), np.asarray(gradient, dtype=float).ravel() * self.nominal

        return evaluated

    # ---- Newton's method ----------------------------------------------------------------------
    def newton(self, point: Array, steps: int = 4, inside: bool = False) -> Array:
        """A few Newton steps to rounding; least squares where the Jacobian is singular.

        inside : each step ends within the bounds.
        """

        def scaled(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            residual, jacobian = self.equations(w)  # in SI pressures alone would say what is small
            return residual, least_squares(jacobian)

        within = (self.low / self.nominal, self.high / self.nominal) if inside else None
        start = point / self.nominal
        root = iterate(scaled, start, settled=1e-15, steps=steps, halvings=0, within=within)
        return np.asarray(root.w * self.nominal)

    def converged(self, z: Array, high: Array | None = None) -> Array | None:
        """The equilibrium that Newton's method reaches from z, None when outside or none."""
        high = self.high if high is None else high
        point = self.newton(z)
        error = np.abs(self.residual(point)).max()
        margin = 1e-9 * self.nominal
        inside = np.all((point >= self.low - margin) & (point <= high + margin))
        return np.clip(point, self.low, high) if error < TOLERANCE and inside else None

    # ---- the search within the bounds, from nothing: IPOPT from several starts ------------------
    @cached_property
    def _relaxed(self) -> dict[tuple[str, bool], Array | None]:
        """What :meth:`relaxed` has found."""
        return {}

    @property
    def _open(self) -> list[int]:
        """The rows that are no pinned value: these are bounds for IPOPT."""
        return [i for i, n in enumerate(self.names) if n not in self.pinned]

    @cached_property
    def _solver(self) -> Nlp:
        """min |r|^2 s.t. r = residual(z): converges also where no equilibrium exists."""
        w, r = ca.MX.sym("w", len(self.nominal)), ca.MX.sym("r", len(self._open))
        p = ca.MX.sym("p", len(self.p))
        nlp: dict[str, ca.MX] = {
            "x": ca.vertcat(w, r),
            "p": p,
            "f": ca.sumsqr(r),
            "g": self.function(w * self.nominal, p)[0][self._open] - r,
        }
        options = quiet_ipopt(tol=1e-10, max_iter=200, mu_init=1e-3)
        return nlpsol("equilibrium", "ipopt", nlp, options)

    def nearest(self, guess: Array, high: Array | None = None, slack: Array | None = None) -> Array:
        """The point within the bounds whose residual is smallest, |r_i| <= slack_i."""
        high = self.high if high is None else high
        slack = np.full(len(self._open), np.inf) if slack is None else slack[self._open]
        result = self._solver(
            x0=np.concatenate([guess / self.nominal, np.zeros(len(slack))]),
            p=self.p,
            lbx=np.concatenate([self.low / self.nominal, -slack]),
            ubx=np.concatenate([high / self.nominal, slack]),
            lbg=0,
            ubg=0,
        )
        w: Array = np.asarray(result["x"], dtype=float).ravel()[: len(self.nominal)]
        return np.asarray(w * self.nominal, dtype=float)

    def solve(self, guess: OperatingPoint | None = None) -> tuple[OperatingPoint | None, Array]:
        """The equilibrium, or None and the point that comes nearest."""
        if guess is not None:
            near = self.converged(self.newton(self.vector(guess), steps=20))
            if near is not None:
                return self.point(near), near
        best, least = self.start, np.inf
        for start in self.starts():
            nearest = self.nearest(start)
            for near in (nearest, self.newton(start, steps=20, inside=True)):
                point = self.converged(near)
                if point is not None:
                    return self.point(point), point
            miss = float(np.abs(self.residual(nearest)).max())
            if miss < least:
                best, least = nearest, miss
        for name in self.targets:  # by way of those that meet all conditions but one
            near = self.relaxed(name, more_pressure=False)
            point = None if near is None else self.converged(self.newton(near, steps=20))
            if point is not None:
                return self.point(point), point
        return None, best

    def relaxed(self, name: str, more_pressure: bool) -> Array | None:
        """The equilibrium with condition ``name`` left as near to its value as the others allow.

        more_pressure : pressures may exceed their range. None when there is no such point.
        """
        key = (name, more_pressure)
        if key not in self._relaxed:
            self._relaxed[key] = self._let_go(name, self.higher if more_pressure else self.high)
        return self._relaxed[key]

    def _let_go(self, name: str, high: Array) -> Array | None:
        i = self.names.index(name)
        slack = np.zeros(len(self.names))
        slack[i] = np.inf
        for guess in self.starts():
            point = self.nearest(guess, high, slack)
            others = np.delete(self.residual(point), i)
            if np.abs(others).max(initial=0.0) < ROUGH:
                return np.asarray(np.clip(point, self.low, high))
        return None

    @cached_property
    def higher(self) -> Array:
        """Upper bounds without those of pressures."""
        high = self.high.copy()
        for i, v in enumerate((*self.plant.states, *self.plant.inputs)):
            if v.unit == "Pa":
                high[i] = np.inf
        return np.asarray(high, dtype=float)

    def starts(self, count: int = 5, seed: int = 0, reach: float = 1.0) -> list[Array]:
        """Start values, points spread over the bounds (fixed seed: the same each time), taut ones.

        States and inputs that are conditions have their value.

        reach : how many nominals to go from the start where there is no bound.
        """
        span = reach * self.nominal
        low = np.where(np.isfinite(self.low), self.low, self.start - span)
        high = np.where(np.isfinite(self.high), self.high, self.start + span)
        spread = np.random.default_rng(seed).uniform(0.1, 0.9, size=(count, len(low)))
        found = np.vstack([self.start, low + spread * (high - low)])
        # under little pressure muscles may be slack, and a slack one gives no slope to leave by
        taut = np.tile(self.start, (TAUT, 1))
        for i, variable in enumerate((*self.plant.states, *self.plant.inputs)):
            if variable.unit == "Pa" and np.isfinite(high[i]):
                taut[:, i] = low[i] + np.linspace(0.6, 0.9, TAUT) * (high[i] - low[i])
        found = np.vstack([found, taut])
        for i, variable in enumerate((*self.plant.states, *self.plant.inputs)):
            if variable.name in self.targets:
                found[:, i] = self.values[variable.name]
        return list(found)


# ---- what a user says ---------------------------------------------------------------------------
def posed(
    plant: Plant,
    conditions: Values,
    free: Sequence[str] = (),
    expressions: Expressions | None = None,
    memory: Memory = "virgin",
) -> Rest:
    """The equations of conditions, free variables and a memory.

    Values of parameters are the plant's; disturbances that nobody speaks of keep their start value.
    Raises InputError where conditions are too few or too many, UnknownNameError.
    """
    require_plant(plant)
    given = {plant.variable(n).name: v for n, v in conditions.items()}
    free = [plant.variable(n).name for n in ([free] if isinstance(free, str) else free)]
    for name in free:
        _require_free(plant, name, given)
    constants = {n: v for n, v in given.items() if plant.variable(n).causality == "parameter"}
    plant = plant.with_values(constants)
    pinned = held(plant, memory)
    targets: dict[str, float] = {}
    for name, value in ((n, v) for n, v in given.items() if n not in constants):
        number = plant.variable(name).check(value, "the condition")
        (pinned if name in pinned else targets)[name] = number
    more = {n: (ca.SX(x), require_finite(n, v)) for n, (x, v) in (expressions or {}).items()}
    targets.update({n: v for n, (_, v) in more.items()})
    disturbances = {
        v.name: v.start or 0.0
        for v in plant.inputs
        if v.disturbance and v.name not in targets and v.name not in free
    }
    loose = [n for n in free if plant.variable(n).causality == "parameter"]
    kept = [n for n in free if n in pinned]
    needed = len(plant.inputs) + len(loose) + len(kept)
    if len(targets) + len(disturbances) == needed:
        targets.update(disturbances)
    if len(targets) != needed:
        controls = [v.name for v in plant.inputs if v.name not in disturbances] + loose + kept
        raise InputError(
            f"equilibrium of {plant.name!r} needs {len(controls)} condition(s), one for each of "
            f"its inputs{' and free variables' if free else ''} ({', '.join(controls)}); "
            f"{len(targets)} given: {', '.join(targets) or 'none'}"
        )
    pins = {n: v for n, v in pinned.items() if n not in free}
    return Rest(plant, targets, loose, {n: x for n, (x, _) in more.items()}, pins)


def _require_free(plant: Plant, name: str, given: Values) -> None:
    variable = plant.variable(name)
    allowed = variable.causality == "parameter" or variable.disturbance or variable.memory == "held"
    if not allowed:
        raise InputError(
            f"free: {name} is {variable.kind}; name parameters, disturbances or held "
            "memories (other states and inputs are unknown anyway)"
        )
    if name in given:
        raise InputError(f"{name} cannot be free and given (= {given[name]}) at once")


# ---- one value left to vary ---------------------------------------------------------------------
class VariedRest:
    """The equations of rest as functions of one value: z = (x, u)/nominal, lam = value/nominal.

    parameter : what varies: a parameter, or an input (or anything else that may be a condition).
    conditions : all others.
    """

    def __init__(
        self, plant: Plant, parameter: str, conditions: Values, memory: Memory = "virgin"
    ) -> None:
        self.variable = v = plant.variable(parameter)
        given = {n: x for n, x in conditions.items() if plant.variable(n).name != v.name}
        anything = float(np.clip(v.start or 0.0, v.min, v.max))
        self.rest = posed(plant, {**given, v.name: anything}, memory=memory)
        self.plant, self.nominal = self.rest.plant, self.rest.nominal
        self.constants = self.rest.p
        """Parameters, then the conditions' values; that of what varies is not looked at."""
        self.nx = len(plant.states)
        self.place = self.rest.place(v.name)
        self.key = (v.name, *self.rest.names)
        """What the equations are of, for a plant's cache."""

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, dict[str, ca.SX]]:
        """(z, lam, constants, expressions): in "rest" what vanishes at rest.

        "slopes" are the Jacobian of the scaled rates over the states, without the fading of held
        memories; its eigenvalues are the plant's.
        """
        z, lam = ca.SX.sym("z", len(self.nominal)), ca.SX.sym("lam")
        constants = ca.SX.sym("constants", len(self.constants))
        value = lam * self.variable.nominal
        p = ca.vertcat(constants[: self.place], value, constants[self.place + 1 :])
        scaled = z * self.nominal
        x, u = scaled[: self.nx], scaled[self.nx :]
        rates = self.plant.function(x, u, p[: len(self.plant.parameters)])[0]
        slopes = ca.jacobian(rates / self.nominal[: self.nx], z)[:, : self.nx]
        kept = [i for i, v in enumerate(self.plant.states) if v.name in self.rest.pinned]
        for i in kept:
            for j in kept:
                slopes[i, j] = 0.0
        return z, lam, constants, {"rest": self.rest.function(scaled, p)[0], "slopes": slopes}

    @cached_property
    def function(self) -> ca.Function:
        """(z, lam, constants) -> (residual, Jacobian in z)."""
        z, lam, constants, found = self.symbols()
        residual = found["rest"]
        return ca.Function("rest", [z, lam, constants], [residual, ca.jacobian(residual, z)])

    @cached_property
    def stability(self) -> ca.Function:
        """(z, lam, constants) -> the scaled Jacobian of the rates."""
        z, lam, constants, found = self.symbols()
        return ca.Function("stability", [z, lam, constants], [ca.densify(found["slopes"])])

    def given(self, value: float) -> dict[str, float]:
        """All conditions with the varying value put in, as equilibria take them."""
        return {**self.rest.values, **self.rest.pinned, self.variable.name: value}

    def inside(self, z: Array) -> bool:
        """Whether all unknowns lie within the variables' bounds."""
        low, high = (bound / self.nominal for bound in (self.rest.low, self.rest.high))
        return bool(np.all(z >= low - 1e-9) and np.all(z <= high + 1e-9))

    def at(self, z: Array, value: float) -> OperatingPoint:
        """The OperatingPoint of a scaled solution; its plant holds all values as start values."""
        values = z * self.nominal
        fixed: dict[str, float] = {
            n: float(np.clip(x, self.plant.variable(n).min, self.plant.variable(n).max))
            for n, x in zip(self.rest.unknown, values, strict=True)
        }
        if self.variable.causality == "parameter":
            fixed[self.variable.name] = value
        residual = self.function(z, value / self.variable.nominal, self.constants)[0]
        return OperatingPoint(
            self.plant.with_values(fixed),
            values[: self.nx],
            values[self.nx :],
            float(np.max(np.abs(np.asarray(residual)))),
        )

    def eigenvalues(self, z: Array, value: float) -> NDArray[np.complex128]:
        """Eigenvalues of the plant at rest [1/s], unsorted; held memories stick and have none."""
        if self.rest.pinned:
            return self.at(z, value).poles
        a = self.stability(z, value / self.variable.nominal, self.constants)
        return np.asarray(np.linalg.eigvals(np.asarray(a)), dtype=complex)
