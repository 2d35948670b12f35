"""Openings as a plant declares them: inputs that stand in for commands with a dead zone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import get_args

import casadi as ca

from ..core.errors import InputError
from ..core.system import PathOf, Way
from ..core.variables import Variable
from ..muscles.dead_zone import two_ways

__all__ = ["WAYS", "FlowPath", "Instead", "Opening", "checked_commands", "flow_path", "path_of"]

WAYS: tuple[Way, ...] = get_args(Way)


@dataclass(frozen=True)
class Opening:
    """An input that stands in for commands of a plant; see :meth:`Plant.opening`.

    variable, symbol : the opening itself. commands : names of the inputs that it stands in for.
    forward : the opening that the commands give; inverse : each command that gives the opening.
    Both are expressions of the plant's symbols, its parameters among them.
    """

    variable: Variable
    symbol: ca.SX
    commands: tuple[str, ...]
    forward: ca.SX
    inverse: tuple[ca.SX, ...]

    @property
    def name(self) -> str:
        return self.variable.name


@dataclass(frozen=True)
class FlowPath:
    """A symbol in the plant's equations, and what it is in commands and in openings.

    opening : the name of the one it belongs to. way : which part of that, above or below zero; None
    for a path that is neither.
    """

    symbol: ca.SX
    in_commands: ca.SX
    in_openings: ca.SX
    opening: str
    way: Way | None = None


def path_of(of: PathOf, opening: ca.SX) -> ca.SX:
    """What a path is of an opening: a way of it, or any function. InputError for all else."""
    if callable(of):
        return ca.SX(of(opening))
    if of not in WAYS:
        raise InputError(
            f"a path of an opening is {of!r}; give 'filling' or 'venting', or a function of the "
            "opening"
        )
    return two_ways(opening)[WAYS.index(of)]


def flow_path(symbol: ca.SX, way: ca.SX, opening: Opening, of: PathOf) -> FlowPath:
    """A path of an opening, with ``way`` what it is of the commands."""
    named = of if isinstance(of, str) else None
    return FlowPath(symbol, ca.SX(way), path_of(of, opening.symbol), opening.name, named)


def checked_commands(name: str, commands: list[str], known: Mapping[str, Variable]) -> None:
    """InputError when what an opening stands in for are no inputs of the plant."""
    wrong = [c for c in commands if c not in known or known[c].causality != "input"]
    if wrong or not commands:
        raise InputError(
            f"opening {name!r} stands in for {', '.join(wrong) or 'nothing'}; give inputs of the "
            "plant"
        )


@dataclass(frozen=True)
class Instead:
    """What takes the place of an opening's commands: itself, or its ways where it has them.

    inputs : (variable, symbol) by name. value : the opening. paths : what its flow paths are.
    """

    opening: Opening
    inputs: Mapping[str, tuple[Variable, ca.SX]]
    value: ca.SX
    paths: tuple[tuple[ca.SX, ca.SX], ...]

    @classmethod
    def whole(cls, opening: Opening, paths: Iterable[FlowPath]) -> Instead:
        """The opening itself."""
        own = tuple((p.symbol, p.in_openings) for p in paths if p.opening == opening.name)
        return cls(opening, {opening.name: (opening.variable, opening.symbol)}, opening.symbol, own)

    @classmethod
    def ways(cls, opening: Opening, paths: Iterable[FlowPath]) -> Instead:
        """Its ways, each from 0 to what the opening has of it, whose difference it is;
        the opening itself where another path than a way depends on it.
        """
        own = [path for path in paths if path.opening == opening.name]
        if not own or any(path.way is None for path in own):
            return cls.whole(opening, own)
        symbols = {way: ca.SX.sym(f"{opening.name}.{way}") for way in WAYS}
        value = symbols["filling"] - symbols["venting"]
        ends = {"filling": opening.variable.max, "venting": -opening.variable.min}
        words = opening.variable.description
        inputs = {
            f"{opening.name}.{way}": (
                replace(
                    opening.variable,
                    name=f"{opening.name}.{way}",
                    min=0.0,
                    max=max(ends[way], 0.0),
                    start=0.0,
                    description=f"{words}; the part for {way}",
                ),
                symbol,
            )
            for way, symbol in symbols.items()
        }
        return cls(opening, inputs, value, tuple((p.symbol, symbols[p.way]) for p in own if p.way))

    def starting(self, value: float) -> dict[str, Variable]:
        """Its variables, with the start values that give the opening this value."""
        low, high = self.opening.variable.min, self.opening.variable.max
        value = min(max(value, low), high)
        if len(self.inputs) == 1:
            return {n: v.with_start(value) for n, (v, _) in self.inputs.items()}
        parts = max(value, 0.0), max(-value, 0.0)
        pairs = zip(self.inputs.items(), parts, strict=True)
        return {n: v.with_start(part) for (n, (v, _)), part in pairs}

    def mirrored(self, sign: float, other: Instead) -> dict[str, tuple[float, str]]:
        """The mirror map of its inputs where that of the opening is ``sign`` times another."""
        names = list(other.inputs)
        if len(names) == 1:
            return dict.fromkeys(self.inputs, (sign, names[0]))
        if sign < 0:
            names.reverse()
        return {n: (abs(sign), m) for n, m in zip(self.inputs, names, strict=True)}
