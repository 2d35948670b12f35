"""Symbols that a planning problem needs besides the plant's: aims, profiles, further unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import casadi as ca

from ...core.errors import require_finite
from ...core.variables import Variable
from ...judge.statement import Profile
from .problem import Auxiliary, Condition

__all__ = ["Symbols"]


@dataclass
class Symbols:
    """Symbols that a problem needs besides the plant's; see Problem."""

    profiles: list[Profile] = field(default_factory=list)
    aims: list[float] = field(default_factory=list)
    peaks: list[tuple[float, Condition]] = field(default_factory=list)
    r: list[ca.SX] = field(default_factory=list)
    q: list[ca.SX] = field(default_factory=list)
    m: list[ca.SX] = field(default_factory=list)
    auxiliaries: dict[str, Auxiliary] = field(default_factory=dict)
    wanted: Literal["small", "large"] = "small"
    """How the integral that is being stated is wanted."""

    def aim(self, name: str, value: Any, unit: str = "") -> ca.SX:
        """The symbol of a constant aim [unit], or of a Profile's value."""
        if isinstance(value, Profile):
            self.profiles.append(value)
            self.r.append(ca.SX.sym(f"profile_{len(self.r)}"))
            return self.r[-1]
        self.aims.append(require_finite(name, value, unit))
        self.q.append(ca.SX.sym(f"aim_{len(self.q)}"))
        return self.q[-1]

    def positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """max(expression, 0), stated smoothly for an integral that is ``wanted`` small or large."""
        small = self.wanted == "small"
        return (self._at_least_positive if small else self._at_most_positive)(variable, expression)

    def differ(self, one: ca.SX, other: ca.SX) -> bool:
        """Whether two integrands have not the same auxiliaries: one is wanted small, one large."""
        both = [ca.depends_on(e, a.symbol) for a in self.auxiliaries.values() for e in (one, other)]
        return both[::2] != both[1::2]

    def _at_least_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """What is max(expression, 0) where its integral is wanted small."""
        name = f"positive {variable.name}"
        if name not in self.auxiliaries:
            symbol = ca.SX.sym(name)
            missed = expression - variable.nominal * symbol
            inf, nominal = float("inf"), variable.nominal
            held = Condition(name, missed, -inf, 0.0, nominal, variable, defining=True)
            value = ca.fmax(expression / nominal, 0)
            self.auxiliaries[name] = Auxiliary(symbol, value, 0.0, inf, (held,))
        return variable.nominal * self.auxiliaries[name].symbol

    def _at_most_positive(self, variable: Variable, expression: ca.SX) -> ca.SX:
        """What is max(expression, 0) where its integral is wanted large."""
        name = f"counted {variable.name}"
        if name not in self.auxiliaries:
            counted = Auxiliary(ca.SX.sym(name), expression > 0, 0.0, 1.0)
            self.auxiliaries[name] = counted
        return expression * self.auxiliaries[name].symbol

    def unknown(self) -> ca.SX:
        """The symbol of a further unknown of the motion, of order one."""
        self.m.append(ca.SX.sym(f"unknown_{len(self.m)}"))
        return self.m[-1]

    def peak(self, variable: Variable, expression: ca.SX, weight: float) -> None:
        """A new unknown that no value of the expression exceeds, in units of nominal."""
        excess = expression - variable.nominal * self.unknown()
        label = f"peak of {variable.name}"
        self.peaks.append(
            (weight, Condition(label, excess, -float("inf"), 0.0, variable.nominal, variable))
        )
