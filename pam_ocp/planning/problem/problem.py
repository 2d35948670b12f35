"""The form that every planning problem takes: nodes, legs, conditions, objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...judge.statement import TIME, Profile
from ...plants.plant import Plant

__all__ = [
    "Auxiliary",
    "Budget",
    "Condition",
    "Leg",
    "Objective",
    "Problem",
    "Range",
    "limits",
]

Array: TypeAlias = NDArray[np.float64]
Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Condition:
    """low <= expression(x, u, p, ...) <= high; at one node of the motion, or all along a leg."""

    label: str
    expression: ca.SX
    low: float
    high: float
    nominal: float
    shown: Variable
    """The variable whose unit the value is shown in."""
    defining: bool = False
    """Whether it says what an auxiliary is, rather than limits the motion."""


@dataclass(frozen=True, eq=False)
class Leg:
    """The motion between two nodes: bounds of its duration [s], conditions and bounds along it."""

    duration: Range
    path: tuple[Condition, ...]
    bounds: dict[str, Range]
    """{state or input: (low, high)}."""
    dwell: bool = False
    """A rest at the stop before it, not a motion."""


@dataclass(frozen=True, eq=False)
class Budget:
    """low <= integral of ``integrand`` over the motion <= high."""

    label: str
    integrand: ca.SX
    low: float
    high: float
    nominal: float
    shown: Variable


@dataclass(frozen=True, eq=False)
class Auxiliary:
    """An unknown wherever costs and budgets are evaluated, so that their kinks are stated exactly.

    The integral of max(P, 0) is the least integral of s with s >= P and s >= 0, and the largest of
    c P with 0 <= c <= 1: smooth for a solver, and exact.
    """

    symbol: ca.SX
    value: ca.SX
    """What it is at the optimum: an expression of x, u, p, ... with kinks."""
    low: float
    high: float
    conditions: tuple[Condition, ...] = ()
    """What holds wherever it stands."""


@dataclass(frozen=True)
class Objective:
    """What is minimised: a weighted sum."""

    time: float
    """Weight of the duration."""
    rate: float
    """Weight of the squared rate of the inputs, in units of nominal."""
    integrand: ca.SX
    """Running cost: its integral is added."""
    final: ca.SX
    """Cost of the last node."""
    peaks: tuple[float, ...]
    """Weight of each further unknown: of peaks; 0 for inputs that would hold the plant at a stop.
    """
    economical: bool = False
    """Whether work, air or exergy counts."""
    words: str = ""
    """The sum in words, with the unit of each term."""

    @property
    def only_time(self) -> bool:
        """Whether nothing but the duration counts."""
        rest = (self.integrand, self.final)
        return (
            self.time > 0
            and not self.rate
            and not any(self.peaks)
            and all(e.is_zero() for e in rest)
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """A motion of a plant through nodes, with a leg between each two.

    stops : values at the nodes, for the first guess.
    nodes : conditions at each node (stops, and rest there).
    closing : None, or {state: (sign, image)}: the last node's image is the first node.
    design : {parameter: (low, high)} to be chosen with the motion.
    profiles, aims : what the symbols ``r`` and ``q`` stand for: values of time profiles, constant
        aims. ``m`` are further unknowns, in units of nominal: largest values along the motion,
        inputs that would hold the plant at a stop.
    auxiliaries : unknowns of costs and budgets, wherever these are evaluated.
    typical : of each leg [s], where a program was built with other numbers; it knows no others.
        Of other legs than these it says nothing.
    """

    plant: Plant
    stops: tuple[dict[str, Any], ...]
    nodes: tuple[tuple[Condition, ...], ...]
    legs: tuple[Leg, ...]
    closing: dict[str, tuple[float, str]] | None
    objective: Objective
    budgets: tuple[Budget, ...] = ()
    design: dict[str, Range] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()
    aims: tuple[float, ...] = ()
    r: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    q: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    m: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    auxiliaries: tuple[Auxiliary, ...] = ()
    typical: tuple[float, ...] | None = None

    @property
    def given(self) -> tuple[ca.SX, ...]:
        """(time, r, q, m): what expressions may depend on besides the plant's x, u and p."""
        return TIME, self.r, self.q, self.m

    def function(self, name: str, expressions: Sequence[ca.SX]) -> ca.Function:
        """CasADi function (x, u, p, time, r, q, m) -> one column of the expressions."""
        plant = self.plant
        arguments = [plant.x, plant.u, plant.p, *self.given]
        return ca.Function(
            name, arguments, [ca.vertcat(*expressions) if expressions else ca.SX(0, 1)]
        )

    def running(self, name: str, expressions: Sequence[ca.SX]) -> ca.Function:
        """The same of running costs: (x, u, p, time, r, q, m, auxiliaries) -> one column."""
        plant, a = self.plant, ca.vertcat(ca.SX(0, 1), *(a.symbol for a in self.auxiliaries))
        arguments = [plant.x, plant.u, plant.p, *self.given, a]
        return ca.Function(
            name, arguments, [ca.vertcat(*expressions) if expressions else ca.SX(0, 1)]
        )

    def explicit(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """Running costs with the auxiliaries' values in their place."""
        if not self.auxiliaries:
            return list(expressions)
        symbols, values = zip(*((a.symbol, a.value) for a in self.auxiliaries), strict=True)
        found: list[ca.SX] = ca.substitute(list(expressions), list(symbols), list(values))
        return found

    def conditions(self, name: str, conditions: Sequence[Condition]) -> ca.Function:
        """The same of the conditions' values, in units of their nominals."""
        return self.function(name, [c.expression / c.nominal for c in conditions])

    def depends_on_inputs(self, leg: Leg) -> tuple[Condition, ...]:
        """The path conditions that jump when an input jumps."""
        u = self.plant.u
        return tuple(c for c in leg.path if u.numel() and ca.depends_on(c.expression, u))

    @property
    def time_nominals(self) -> Array:
        """A typical duration of each leg [s]: the unit of durations in a program."""
        if self.typical is not None and len(self.typical) == len(self.legs):
            return np.array(self.typical)
        return np.array([np.sqrt(leg.duration[0] * leg.duration[1]) for leg in self.legs])

    @property
    def design_nominals(self) -> Array:
        """A typical size of each design parameter."""
        return np.array([self.plant.variable(name).nominal for name in self.design])


def limits(conditions: Sequence[Condition | Budget]) -> tuple[Array, Array]:
    """(low, high) of conditions in units of their nominals."""
    low = np.array([c.low / c.nominal for c in conditions])
    high = np.array([c.high / c.nominal for c in conditions])
    return low, high
