"""Equations of a finished plant: columns of its expressions, and the functions made of them."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca

from ..core.variables import Causality

__all__ = ["CHANGEABLE", "DEFINED", "Equations"]

# in the order of the plant's function: arguments, and results (a state's is its derivative)
CHANGEABLE: tuple[Causality, ...] = ("state", "input", "parameter")
DEFINED: tuple[Causality, ...] = ("state", "output", "constraint")


@dataclass(frozen=True)
class Equations:
    """Expressions and functions of a finished plant: x' = xdot(x, u, p), y and c alike.

    All copies of a plant share one; ``c`` are its path constraints.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    xdot: ca.SX
    y: ca.SX
    c: ca.SX
    built: OrderedDict[Any, Any] = field(default_factory=OrderedDict)
    """What verbs have built from these expressions, the latest last."""

    @cached_property
    def function(self) -> ca.Function:
        return ca.Function(
            "plant",
            [self.x, self.u, self.p],
            [self.xdot, self.y, self.c],
            ["x", "u", "p"],
            ["xdot", "y", "c"],
        )

    @cached_property
    def jacobians(self) -> ca.Function:
        blocks = [ca.jacobian(e, z) for e in (self.xdot, self.y) for z in (self.x, self.u)]
        return ca.Function(
            "jacobians",
            [self.x, self.u, self.p],
            [ca.densify(b) for b in blocks],
            ["x", "u", "p"],
            ["A", "B", "C", "D"],
        )
