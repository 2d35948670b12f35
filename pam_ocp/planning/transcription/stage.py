"""One interval of a plan as a CasADi function: defects, path conditions, costs.

Collocation: the state is a polynomial through its start and the collocation points and meets the
plant's equation there (Biegler, Nonlinear Programming, SIAM 2010, ch. 10). Shooting: RK4 steps.
States, inputs and defects are in units of nominal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...numerics.collocation import collocation_matrices
from ...numerics.runge_kutta import rk4
from ..problem.problem import Condition, Leg, Problem
from .mesh import Form

Array: TypeAlias = NDArray[np.float64]


def nominals(problem: Problem) -> tuple[Array, Array]:
    """(nx,) and (nu,): nominals of states and inputs."""
    plant = problem.plant
    return plant.vector("state", attribute="nominal"), plant.vector("input", attribute="nominal")


def _limited(condition: Condition) -> bool:
    """Whether there is a limit, and room for it to be exceeded."""
    low, high = condition.low, condition.high
    return bool(np.isfinite([low, high]).any() and low < high)


def _held_back(condition: Condition, margin: float) -> Condition:
    """With limits narrower by a margin [nominals], as far as there is room."""
    by = min(margin * condition.nominal, (condition.high - condition.low) / 4)
    return replace(condition, low=condition.low + by, high=condition.high - by)


def between_points(condition: Condition, leg: Leg, margins: Mapping[str, float]) -> Condition:
    """What a stage checks between its points with the limits of another leg of the same form.

    margins : of what is watched, in nominals, by label.
    """
    path = {c.label: (c.low, c.high) for c in leg.path}
    label = condition.label
    low, high = leg.bounds[label] if label in leg.bounds else path[label]
    return _held_back(replace(condition, low=low, high=high), margins.get(label, 0.0))


class _Costs:
    """Running cost and budgets, the latter in units of nominal, each time at a new point.

    rows : the auxiliaries' conditions at the points so far; values : what they should be there.
    """

    def __init__(self, problem: Problem, a: ca.SX) -> None:
        budgets = [b.integrand / b.nominal for b in problem.budgets]
        running = [problem.objective.integrand, *budgets]
        self._free = not budgets and running[0].is_zero()
        self._integrands = problem.running("integrands", running)
        conditions = [c for each in problem.auxiliaries for c in each.conditions]
        self._held = problem.running("held", [c.expression / c.nominal for c in conditions])
        self._value = problem.function("value", [each.value for each in problem.auxiliaries])
        self._points = iter(ca.horzsplit(a))
        self._some = bool(problem.auxiliaries)
        self.rows: list[ca.SX] = []
        self.values: list[ca.SX] = []

    def __call__(self, *at: ca.SX) -> ca.SX:
        if self._free:
            return ca.SX(1, 1)
        auxiliaries = ca.SX(0, 1)
        if self._some:
            auxiliaries = next(self._points)
            self.rows.append(self._held(*at, auxiliaries))
            self.values.append(self._value(*at))
        found: ca.SX = self._integrands(*at, auxiliaries)
        return found


@dataclass(frozen=True)
class Stage:
    """An interval of ``degree`` on a leg, for :attr:`function`."""

    problem: Problem
    leg: Leg
    form: Form
    degree: int
    watched: tuple[str, ...] = ()
    """What is checked between the points; see :class:`Interval`."""

    def conditions(self, margins: Mapping[str, float] | None = None) -> tuple[Condition, ...]:
        """Of the rows of path values: at each point, at the start, between the points, then those
        of auxiliaries. margins : of what is watched, in nominals, by label.
        """
        points, held = len(self.form.state_taus(self.degree)), margins or {}
        between = (
            _held_back(c, held.get(c.label, 0.0)) if c.label in self.watched else c
            for conditions, taus in self._between
            for c in conditions * len(taus)
        )
        auxiliary = self._auxiliary * self.form.cost_points(self.degree)
        return (*self.leg.path * points, *self._jumping, *between, *auxiliary)

    @property
    def _auxiliary(self) -> tuple[Condition, ...]:
        """What holds wherever costs are evaluated."""
        return tuple(c for a in self.problem.auxiliaries for c in a.conditions)

    @property
    def profile_taus(self) -> Array:
        """Where functions of time are evaluated: at the points, then between them."""
        between = (taus for _, taus in self._between)
        return np.concatenate([self.form.profile_taus(self.degree), *between])

    @property
    def _between(self) -> list[tuple[tuple[Condition, ...], Array]]:
        """(conditions, where they are checked) between the points."""
        u, taus = self.problem.plant.u, self.form.watch_taus(self.degree)
        driven = tuple(c for c in self._watched if u.numel() and ca.depends_on(c.expression, u))
        smooth = tuple(c for c in self._watched if c not in driven)
        found = [
            (self.guarded, self.form.guard_taus(self.degree)),
            (driven, taus),
            (smooth, taus[1:]),  # the start is a point itself
        ]
        return [(conditions, taus) for conditions, taus in found if conditions and len(taus)]

    @property
    def _jumping(self) -> tuple[Condition, ...]:
        """What is checked at the start too, where an input may jump. A polynomial input has as many
        values as points: an equality at these gives them all, one more would be one too many.
        """
        found = self.problem.depends_on_inputs(self.leg)
        if self.form.control != "polynomial":
            return found
        return tuple(c for c in found if c.low < c.high)

    @property
    def guarded(self) -> tuple[Condition, ...]:
        """What a polynomial input might break between its points: its bounds, and path conditions
        that depend on it."""
        inputs = [self._bound(v) for v in self.problem.plant.inputs]
        path = self.problem.depends_on_inputs(self.leg)
        return tuple(c for c in (*inputs, *path) if _limited(c) and c.label not in self.watched)

    @property
    def _watched(self) -> tuple[Condition, ...]:
        """What was seen beyond its limits between the points."""
        plant = self.problem.plant
        known = {c.label: c for c in self.leg.path}
        known |= {v.name: self._bound(v) for v in (*plant.states, *plant.inputs)}
        return tuple(known[n] for n in self.watched if n in known)

    def _bound(self, variable: Variable) -> Condition:
        """The bounds of a state or an input as a condition."""
        low, high = self.leg.bounds[variable.name]
        expression = self.problem.plant.expression(variable.name)
        return Condition(variable.name, expression, low, high, variable.nominal, variable)

    @cached_property
    def function(self) -> ca.Function:
        """(start, states, inputs, h, t, p, r, q, m, a) -> (defects, path, cost, budgets).

        start (nx), states (nx x points) and inputs (nu x columns), the latter two as columns;
        h, t : length and start [s]; r : values of profiles (as many columns as profile_taus);
        a : auxiliaries (as many columns as the form's cost_points).
        """
        return self._functions[0]

    @property
    def completing(self) -> ca.Function:
        """The same, without the auxiliaries, -> their values as a column."""
        return self._functions[1]

    @cached_property
    def _functions(self) -> tuple[ca.Function, ca.Function]:
        f, problem, d = self.form, self.problem, self.degree
        nx, nu = len(problem.plant.states), len(problem.plant.inputs)
        start = ca.SX.sym("start", nx)
        states = ca.SX.sym("states", nx, len(f.state_taus(d)))
        inputs = ca.SX.sym("inputs", nu, len(f.input_taus(d)))
        h, t = ca.SX.sym("h"), ca.SX.sym("t")
        p = ca.SX.sym("p", len(problem.plant.parameters))
        r = ca.SX.sym("r", problem.r.numel(), len(self.profile_taus))
        q, m = ca.SX.sym("q", problem.q.numel()), ca.SX.sym("m", problem.m.numel())
        count = len(problem.auxiliaries)
        a = ca.SX.sym("a", count, f.cost_points(d))
        x_nominal, u_nominal = nominals(problem)

        driven: dict[float, ca.SX] = {}

        def point(tau: float, x: ca.SX, profile: int) -> tuple[ca.SX, ...]:
            if tau not in driven:
                driven[tau] = inputs @ f.weights(d, tau) * u_nominal
            return x * x_nominal, driven[tau], p, t + h * tau, r[:, profile], q, m

        rates = self._rates(inputs, h)
        method = self._shooting if f.scheme == "shooting" else self._collocation
        costs = _Costs(problem, a)
        defects, integrals = method(start, states, h, point, costs)
        path = problem.conditions("path", self.leg.path)
        column = (len(f.profile_taus(d)) - 1) // states.shape[1]  # profile columns per state column
        values = [
            path(*point(tau, states[:, j], column * (j + 1)))
            for j, tau in enumerate(f.state_taus(d))
        ]
        # an input may jump at the start of the interval: what depends on it is checked there too
        jumping = problem.conditions("jumping", self._jumping)
        values.append(jumping(*point(0.0, start, 0)))
        through = ca.horzcat(start, states)
        profile = len(f.profile_taus(d))
        for conditions, taus in self._between:
            between = problem.conditions("between", conditions)
            for tau in taus:
                state = through @ f.state_weights(d, tau)
                values.append(between(*point(tau, state, profile)))
                profile += 1
        values += costs.rows
        arguments = [start, ca.vec(states), ca.vec(inputs), h, t, p, ca.vec(r), q, m]
        names = ["start", "states", "inputs", "h", "t", "p", "r", "q", "m"]
        function = ca.Function(
            "stage",
            [*arguments, ca.vec(a)],
            [defects, ca.vertcat(*values), integrals[0] + rates, integrals[1:]],
            [*names, "a"],
            ["defects", "path", "cost", "budgets"],
            {"cse": True},  # limits look at what the dynamics hold
        )
        completing = ca.Function("completing", arguments, [ca.vertcat(*costs.values)], names, ["a"])
        return function, completing

    def _collocation(
        self, start: ca.SX, states: ca.SX, h: ca.SX, point: object, integrands: _Costs
    ) -> tuple[ca.SX, ca.SX]:
        """(defects, integrals): the polynomial's slope is the plant's, and its end is the end."""
        taus = self.form.collocated(self.degree)
        derivative, ends, quadrature = collocation_matrices(taus)
        through = ca.horzcat(start, states[:, : len(taus)])
        slope = through @ ca.DM(derivative)  # scaled dx/dtau at the points
        x_nominal = nominals(self.problem)[0]
        defects, integrals = [], ca.SX.zeros(1 + len(self.problem.budgets))
        for j, tau in enumerate(taus):
            x, u, p, *rest = point(tau, states[:, j], j + 1)  # type: ignore[operator]
            defects.append(h * self.problem.plant.function(x, u, p)[0] / x_nominal - slope[:, j])
            integrals += h * quadrature[j] * integrands(x, u, p, *rest)
        if self.form.scheme == "gauss":
            defects.append(through @ ca.DM(ends) - states[:, -1])
        return ca.veccat(*defects), integrals

    def _shooting(
        self, start: ca.SX, states: ca.SX, h: ca.SX, point: object, integrands: _Costs
    ) -> tuple[ca.SX, ca.SX]:
        """(defect, integrals) of the classical Runge-Kutta method in ``degree`` steps."""
        x_nominal, _ = nominals(self.problem)
        steps, nx = self.degree, len(x_nominal)

        def slope(both: ca.SX, at: float) -> ca.SX:
            here = point(at / steps, both[:nx], round(2 * at))  # type: ignore[operator]
            rates = self.problem.plant.function(*here[:3])[0] / x_nominal
            return ca.vertcat(rates, integrands(*here))

        begin = ca.vertcat(start, ca.SX.zeros(1 + len(self.problem.budgets)))
        end = rk4(slope, begin, h / steps, steps)
        x, integrals = ca.vertsplit(end, [0, nx, end.numel()])
        return x - states, integrals

    def _rates(self, inputs: ca.SX, h: ca.SX) -> ca.SX | float:
        """Integral of the weighed squared rate of the (scaled) inputs inside the interval."""
        weight = self.problem.objective.rate
        powers = self.form.input_powers(self.degree)
        if not weight or len(powers) == 1:
            return 0.0
        # exact for the polynomial: Gauss points of its own degree
        taus, gauss = np.polynomial.legendre.leggauss(len(powers))
        total = ca.SX(0)
        for tau, share in zip((taus + 1) / 2, gauss / 2, strict=True):
            slope = np.array([j * tau ** (j - 1) if j else 0.0 for j in range(len(powers))])
            total += share * ca.sumsqr(inputs @ (slope @ powers))
        return weight * total / h
