"""CasADi expressions as readable formulas of a modelling language, shared parts named once."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ...core.errors import ExportError
from .instructions import Instructions

__all__ = ["Language", "formulas", "identifiers"]

ATOM, POWER, PRODUCT, SUM, LOGIC = 4, 3, 2, 1, 0
"""How firmly a text holds together."""
LONG = 60
"""Letters, beyond which a part that is used twice gets a name; shorter ones are written again."""


@dataclass(frozen=True)
class Language:
    """How a language writes what CasADi has.

    functions : {operation: template}, ``{0}`` and ``{1}`` its arguments. condition : of (if, then)
        with else 0. logic : words for and, or, not. number : how a number is written. pair : what
        joins a named part and its formula.
    """

    name: str
    functions: Mapping[str, str]
    condition: str
    logic: tuple[str, str, str]
    power: str = "^"


@dataclass(eq=False)
class _Node:
    """A value: an operation on others, a name or a number; ``name`` once it has one."""

    kind: str
    parts: tuple[_Node, ...] = ()
    text: str = ""
    used: int = 0
    name: str = ""
    made: dict[bool, tuple[str, int]] = field(default_factory=dict)


_BOOLEAN = ("lt", "le", "eq", "ne", "not", "and", "or")
_COMPARED = {"lt": "{0} < {1}", "le": "{0} <= {1}"}


def identifiers(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """{name: an identifier for it}, dots as underscores, no two alike."""
    taken, found = set(reserved), {}
    for name in names:
        plain = base = re.sub(r"\W", "_", name)
        count = 1
        while plain in taken:
            count += 1
            plain = f"{base}_{count}"
        taken.add(plain)
        found[name] = plain
    return found


def formulas(
    program: Instructions, arguments: Sequence[Sequence[str]], language: Language, prefix: str
) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """((name, formula) of the shared parts, in order; the formulas of each result).

    arguments : names of each argument's entries. prefix : of the names of shared parts.
    """
    known: dict[tuple[object, ...], _Node] = {}
    nodes: list[_Node] = []

    def entered(kind: str, parts: tuple[_Node, ...] = (), text: str = "") -> _Node:
        key = (kind, *map(id, parts), text)
        if key not in known:
            known[key] = _Node(kind, parts, text)
            nodes.append(known[key])
            for part in parts:
                part.used += 1
        return known[key]

    def operation(kind: str) -> Callable[..., _Node]:
        return lambda *parts: entered(kind, parts)

    from .instructions import OPERATIONS

    table = {kind: operation(kind) for kind in OPERATIONS}
    entries = [lambda i, names=names: entered("name", (), names[i]) for names in arguments]
    results = program.run(table, entries, lambda v: entered("number", (), _number(v)))
    for column in results:
        for entry in column:
            entry.used += 1
    writer = _Writer(language)
    shared: list[tuple[str, str]] = []
    for node in nodes:
        if node.parts and node.used > 1 and node.kind not in _BOOLEAN:
            text, _ = writer.number(node)
            if len(text) > LONG or node.kind in language.functions:
                node.name = f"{prefix}{len(shared) + 1}"
                node.made.clear()
                shared.append((node.name, text))
    return shared, [[writer.number(entry)[0] for entry in column] for column in results]


def _branches(a: _Node, b: _Node) -> tuple[_Node, _Node, _Node] | None:
    """(condition, then, else) where a sum is what CasADi makes of if_else."""
    if a.name or b.name or not a.kind == b.kind == "if_else_zero":
        return None
    for one, other in ((a, b), (b, a)):
        no = other.parts[0]
        if no.kind == "not" and no.parts[0] is one.parts[0]:
            return one.parts[0], one.parts[1], other.parts[1]
    return None


def _number(value: float) -> str:
    if value != value or value in (float("inf"), float("-inf")):
        raise ExportError(f"an equation holds the number {value}, which no formula can")
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") and "e" not in text and len(text) < 9 else text


class _Writer:
    """Nodes to text, each once."""

    def __init__(self, language: Language) -> None:
        self.language = language

    def number(self, node: _Node) -> tuple[str, int]:
        """The text of a value, and how firmly it holds together."""
        if node.name:
            return node.name, ATOM
        if False not in node.made:
            node.made[False] = self._number(node)
        return node.made[False]

    def _at(self, node: _Node, least: int) -> str:
        text, level = self.number(node)
        return text if level >= least else f"({text})"

    def _number(self, node: _Node) -> tuple[str, int]:
        kind, parts = node.kind, node.parts
        if kind in ("name", "number"):
            return node.text, SUM if node.text.startswith("-") else ATOM
        if kind in _BOOLEAN:
            return self.language.condition.format(self.truth(node), "1", "0"), ATOM
        if kind == "if_else_zero":
            return self._either(parts[0], parts[1], None), ATOM
        if kind == "add" and (branches := _branches(*parts)):
            return self._either(*branches), ATOM
        if kind == "add":
            return f"{self._at(parts[0], SUM)} + {self._at(parts[1], PRODUCT)}", SUM
        if kind == "sub":
            return f"{self._at(parts[0], SUM)} - {self._at(parts[1], PRODUCT)}", SUM
        if kind == "mul":
            return f"{self._at(parts[0], PRODUCT)}*{self._at(parts[1], POWER)}", PRODUCT
        if kind == "div":
            return f"{self._at(parts[0], PRODUCT)}/{self._at(parts[1], POWER)}", PRODUCT
        if kind == "neg":
            return f"-{self._at(parts[0], PRODUCT)}", SUM
        if kind == "twice":
            return f"2*{self._at(parts[0], POWER)}", PRODUCT
        if kind == "inv":
            return f"1/{self._at(parts[0], POWER)}", PRODUCT
        if kind == "sq":
            return f"{self._at(parts[0], ATOM)}{self.language.power}2", POWER
        if kind in ("pow", "constpow"):
            both = self._at(parts[0], ATOM), self._at(parts[1], ATOM)
            return self.language.power.join(both), POWER
        if kind not in self.language.functions:
            raise ExportError(f"{self.language.name} has no {kind!r}; write the formula otherwise")
        plain = [self.number(part)[0] for part in parts]
        return self.language.functions[kind].format(*plain), ATOM

    def _either(self, condition: _Node, then: _Node, other: _Node | None) -> str:
        rest = "0" if other is None else self.number(other)[0]
        return self.language.condition.format(self.truth(condition), self.number(then)[0], rest)

    def truth(self, node: _Node) -> str:
        """The text of a condition."""
        both, either, no = self.language.logic
        kind, parts = node.kind, node.parts
        if node.name or kind not in _BOOLEAN:
            # of a number: whether it is not 0, which relations of reals do not ask
            text = self.number(node)[0]
            return f"{self.language.functions['fabs'].format(text)} > 0"
        if kind in _COMPARED:
            return _COMPARED[kind].format(self._at(parts[0], SUM), self._at(parts[1], SUM))
        if kind == "not":
            return f"{no}({self.truth(parts[0])})"
        if kind in ("and", "or"):
            word = both if kind == "and" else either
            return f"({self.truth(parts[0])}) {word} ({self.truth(parts[1])})"
        sides = self._at(parts[0], SUM), self._at(parts[1], SUM)
        same = f"{sides[0]} >= {sides[1]} {both} {sides[0]} <= {sides[1]}"
        return f"({same})" if kind == "eq" else f"{no}({same})"
