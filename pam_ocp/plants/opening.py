"""Openings as a plant declares them: inputs that stand in for commands with a dead zone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import get_args

import casadi as ca

from ..core.errors import InputError
from ..core.system import PathOf, Way
from ..core.variables import Variable
from ..muscles.dead_zone import two_ways

WAYS: tuple[Way, ...] = get_args(Way)
NEAR = 1e-3
"""Of the travel: a play is taken up as long as a spool is farther than this from its place."""


@dataclass(frozen=True)
class Carried:
    """A state that moves between a command and a dead zone.

    entered : what it is in the plant with openings, where there is no dead zone behind it; left :
        the way back. Both are expressions of the states and parameters of the plant they start in.
    """

    name: str
    entered: ca.SX
    left: ca.SX


@dataclass(frozen=True)
class Opening:
    """An input that stands in for commands of a plant; see :meth:`Plant.opening`.

    variable, symbol : the opening itself. commands : names of the inputs that it stands in for.
    forward : the opening that the commands give; inverse : each command that gives the opening.
    Both are expressions of the plant's symbols, its parameters among them.
    carried : of a dead zone behind something that moves (a spool), the states of that. Then the
        opening acts as through the same motion without a dead zone: the commands that give it are
        those of rest, and the time in which the dead zone is crossed is left out.
    """

    variable: Variable
    symbol: ca.SX
    commands: tuple[str, ...]
    forward: ca.SX
    inverse: tuple[ca.SX, ...]
    carried: tuple[Carried, ...] = ()

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


@dataclass(frozen=True)
class Asked:
    """What is asked of a moving part where that is no input: inside of a feedback.

    symbol : stands for it in the part's equations (of :meth:`Plant.gathered`). value : what the
    command asks for at rest, ``slope`` per unit. behind : states between the two, equal at rest.
    """

    symbol: ca.SX
    value: ca.SX
    slope: ca.SX
    behind: tuple[ca.SX, ...] = ()


@dataclass(frozen=True)
class Lead:
    """What moves between a command and a dead zone: linear states, and perhaps a play behind them.

    states : at rest each is ``share`` times what is asked. straight : the position without play,
    ``gain`` times that. play : (the held memory z within -1 .. 1, by how much it takes back), for
    position = straight - back z; None without.
    """

    states: tuple[ca.SX, ...]
    share: tuple[ca.SX, ...]
    straight: ca.SX
    gain: ca.SX
    play: tuple[ca.SX, ca.SX] | None

    @classmethod
    def of(
        cls,
        position: ca.SX,
        asked: ca.SX,
        variables: Mapping[str, Variable],
        rates: Mapping[str, ca.SX],
    ) -> Lead | None:
        """Of a position as an expression of states whose ``rates`` are known; None where these are
        not linear in themselves and in ``asked`` alone.
        """
        memories = [s for s in _states(position, variables) if _memory(s, variables) == "held"]
        states = [s for s in _states(position, variables) if _memory(s, variables) != "held"]
        for state in states:  # which grows as it is gone through
            if state.name() not in rates:
                return None
            known = {s.name() for s in states}
            states += [s for s in _states(rates[state.name()], variables) if s.name() not in known]
        x, z = ca.vertcat(*states), ca.vertcat(*memories)
        slopes = ca.vertcat(*(rates[s.name()] for s in states))
        others = {
            s.name()
            for s in ca.symvar(ca.vertcat(slopes, position))
            if s.name() not in variables or variables[s.name()].causality != "parameter"
        }
        if not states or others - {s.name() for s in (*states, *memories, asked)}:
            return None
        a, b = ca.jacobian(slopes, x), ca.jacobian(slopes, asked)
        c, back = ca.jacobian(position, x), -ca.jacobian(position, z)
        if len(memories) > 1 or ca.depends_on(ca.veccat(a, b, c, back), ca.vertcat(x, z, asked)):
            return None
        if ca.sprank(a) < len(states) or not b.nnz():
            return None
        share = ca.solve(a, -ca.densify(b))
        play = (memories[0], back) if memories else None
        return cls(tuple(states), tuple(ca.vertsplit(share)), ca.mtimes(c, x), c @ share, play)

    def position(self) -> ca.SX:
        """Where the part stands before its dead zone."""
        return self.straight if self.play is None else self.straight - self.play[1] * self.play[0]

    def asking(self, position: ca.SX) -> ca.SX:
        """What to ask for a position at rest: a play is taken up on the side it is moved to."""
        if self.play is None:
            return ca.SX(position / self.gain)
        z, back = self.play
        side = z + (position - self.position()) / NEAR
        return ca.SX((position + back * ca.fmax(ca.fmin(side, 1), -1)) / self.gain)

    def opening(
        self,
        asked: Asked | None,
        command: ca.SX,
        effect: Callable[[ca.SX], ca.SX],
        inverse: Callable[[ca.SX], ca.SX],
        inner: ca.SX,
    ) -> tuple[ca.SX, ca.SX, tuple[Carried, ...]]:
        """(forward, inverse, states carried) of the opening ``inner`` in place of a command.

        effect : what the dead zone leaves of a position; inverse : the way back.
        """
        wanted = inner
        if asked is None:
            forward = effect(self.gain * command) / self.gain
            sent = self.asking(inverse(self.gain * inner))
        else:
            wanted = ca.substitute(asked.value, command, inner)
            left = effect(self.gain * asked.value) / self.gain
            forward = command + (left - asked.value) / asked.slope
            sent = inner + (self.asking(inverse(self.gain * wanted)) - wanted) / asked.slope
        y, back = self.straight, ca.SX(0)
        if self.play is not None:
            back = self.play[1] * self.play[0]
        inwards = (effect(y - back) - y) / self.gain
        outwards = (inverse(y) + back - y) / self.gain
        shares = zip(self.states, self.share, strict=True)
        moved = [*shares, *((s, ca.SX(1)) for s in (asked.behind if asked else ()))]
        carried = tuple(
            Carried(s.name(), s + share * inwards, s + share * outwards)
            for s, share in moved
            if not share.is_zero()
        )
        return ca.SX(forward), ca.SX(sent), carried


def _states(expression: ca.SX, variables: Mapping[str, Variable]) -> list[ca.SX]:
    symbols = ca.symvar(expression)
    return [s for s in symbols if getattr(variables.get(s.name()), "causality", "") == "state"]


def _memory(state: ca.SX, variables: Mapping[str, Variable]) -> str:
    return variables[state.name()].memory


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
