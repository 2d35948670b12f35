"""The limits of a tracking program one side at a time, as the Riccati interior point takes them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from .shooting import NodeLimit, TrackingProgram

__all__ = ["Bound", "Side", "bounds_of", "sides_of"]


@dataclass(frozen=True)
class Bound:
    """A finite end of a limit, as a number that may change [SI]."""

    limit: NodeLimit
    high: bool
    place: int
    """Of the limit among those of the program."""

    @property
    def value(self) -> float:
        return self.limit.high if self.high else self.limit.low


@dataclass(frozen=True)
class Side:
    """One side of a limit of a node: sign (value - bound) + slack >= 0, scaled.

    soft : the node's slack stands in it. given : it says nothing at node 0, whose state is given.
    """

    value: ca.SX
    sign: float
    bound: int
    """Place of its bound among all bounds."""
    soft: bool
    given: bool


def bounds_of(program: TrackingProgram) -> tuple[Bound, ...]:
    """All finite ends of the program's limits."""
    found = []
    for place, limit in enumerate(program.limits):
        if math.isfinite(limit.low):
            found.append(Bound(limit, False, place))
        if math.isfinite(limit.high):
            found.append(Bound(limit, True, place))
    return tuple(found)


def sides_of(program: TrackingProgram, bounds: Sequence[Bound]) -> tuple[list[Side], list[Side]]:
    """The sides of these bounds at an inner node, and at the last one, which has no inputs."""
    found = []
    for k, bound in enumerate(bounds):
        value = program.limited[bound.place]
        sign = -1.0 if bound.high else 1.0
        given = not ca.depends_on(value, program.u)
        found.append(Side(value, sign, k, bound.limit.soft, given))
    return found, [s for s in found if not ca.depends_on(s.value, program.u)]
