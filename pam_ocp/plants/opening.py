"""Openings as a plant declares them: inputs that stand in for commands with a dead zone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from ..core.errors import InputError
from ..core.variables import Variable

__all__ = ["FlowPath", "Opening", "checked_commands"]


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
    """A symbol in the plant's equations, and what it is in commands and in openings."""

    symbol: ca.SX
    in_commands: ca.SX
    in_openings: ca.SX


def checked_commands(name: str, commands: list[str], known: Mapping[str, Variable]) -> None:
    """InputError when what an opening stands in for are no inputs of the plant."""
    wrong = [c for c in commands if c not in known or known[c].causality != "input"]
    if wrong or not commands:
        raise InputError(
            f"opening {name!r} stands in for {', '.join(wrong) or 'nothing'}; give inputs of the "
            "plant"
        )
