"""Symbols that a planning problem needs besides the plant's: aims, profiles, further unknowns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from ...core.errors import require_finite
from ...core.variables import Variable
from .problem import Condition
from .profile import Profile

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
    widths: dict[int, float] = field(default_factory=dict)

    def aim(self, name: str, value: Any) -> ca.SX:
        """The symbol of a constant aim, or of a Profile's value."""
        if isinstance(value, Profile):
            self.profiles.append(value)
            self.r.append(ca.SX.sym(f"profile_{len(self.r)}"))
            return self.r[-1]
        self.aims.append(require_finite(name, value))
        self.q.append(ca.SX.sym(f"aim_{len(self.q)}"))
        return self.q[-1]

    def width(self, widest: float, own: float) -> ca.SX:
        """The symbol of a rounding that goes from the widest to its own width while it is solved
        for.
        """
        self.widths[len(self.aims)] = widest
        return self.aim("width", own)

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
