"""How a plant looks, as shapes whose points are expressions of its variables; films draw them.

A plant says it in its own file, by a method ``sketch()``: no drawing library is needed for that.
Points are (x, y) in metres, of numbers or of the plant's expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

Point: TypeAlias = tuple[Any, Any]


@dataclass(frozen=True)
class Spindle:
    """A muscle between two points, thicker the more it contracts, coloured by its pressure."""

    muscle: str
    start: Point
    end: Point


@dataclass(frozen=True)
class Polygon:
    """A filled outline: the body that moves, or the ground."""

    points: Sequence[Point]
    style: Literal["body", "ground"] = "body"


@dataclass(frozen=True)
class Line:
    """A line through points: a stiff rod, a rope that only pulls, a thin needle, a rail."""

    points: Sequence[Point]
    style: Literal["rod", "rope", "needle", "rail"] = "rope"


@dataclass(frozen=True)
class Disc:
    """A pulley or a wheel."""

    centre: Point
    radius: Any


@dataclass(frozen=True)
class Mark:
    """A tick wherever ``state`` has a stop: a line, and the value beside its end."""

    state: str
    points: Sequence[Point]
    label: Literal["", "below", "right"] = ""


Shape: TypeAlias = Spindle | Polygon | Line | Disc


@dataclass(frozen=True)
class Sketch:
    """A picture of a plant. width, height : (low, high) that it takes, as numbers or expressions
    of parameters."""

    shapes: Sequence[Shape]
    width: Point
    height: Point
    marks: Sequence[Mark] = ()


def box(low: Point, high: Point) -> tuple[Point, ...]:
    """The corners of a rectangle."""
    return (low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])
