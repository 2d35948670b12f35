"""Numbers of a motion by words: ``"x.final"``, ``"max(muscle1.force)"``, ``"crossing(x, 0.01)"``.

Words are parsed, never run: Python's own parser makes the tree, and what is not named here is
refused. A signal is known at the motion's samples and taken as straight lines between them.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, UnknownNameError
from ..core.quantities import quantity
from ..core.variables import Variable

Array: TypeAlias = NDArray[np.float64]
Signals: TypeAlias = "Callable[[str], Array]"
"""name -> samples (cases, times) of a signal, or values (cases, 1) of a parameter."""


# ---- the reducers: t (times,), signals (cases, times), targets (cases, 1) ------------------------
def _sum(values: Array) -> Array:
    # rows that lie in one piece: each is summed in the same order, however many stand beside it
    return np.asarray(np.add.reduce(np.ascontiguousarray(values), axis=1, keepdims=True))


def _integral(t: Array, s: Array) -> Array:
    return _sum((s[:, 1:] + s[:, :-1]) / 2 * np.diff(t))


def _mean(t: Array, s: Array) -> Array:
    return np.asarray(_integral(t, s) / (t[-1] - t[0]))


def _rms(t: Array, s: Array) -> Array:
    return np.asarray(np.sqrt(_mean(t, s * s)))


def _first_of(found: Any) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """(whether there is one, the first place of it) for each row, as columns."""
    return found.any(axis=1)[:, None], np.argmax(found, axis=1)[:, None]


def _meets(t: Array, s: Array, i: NDArray[np.intp], level: Array) -> Array:
    """When the line behind sample i is at a level."""
    a, b = np.take_along_axis(s, i, 1), np.take_along_axis(s, i + 1, 1)
    with np.errstate(all="ignore"):
        return np.asarray(t[i] + (t[i + 1] - t[i]) * (level - a) / (b - a))


def _crossing(t: Array, s: Array, level: Array, direction: str = "either") -> Array:
    before, behind = s[:, :-1], s[:, 1:]
    rises = (before < level) & (behind >= level)
    falls = (before > level) & (behind <= level)
    chosen = {"rising": rises, "falling": falls, "either": rises | falls}[direction]
    there, i = _first_of(chosen)
    return np.where(there, _meets(t, s, i, level), np.nan)


def _overshoot(t: Array, s: Array, target: Array | None = None) -> Array:
    target = s[:, -1:] if target is None else target
    step = target - s[:, :1]
    beyond = ((s - target) * np.sign(step)).max(axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        parts = np.maximum(beyond, 0.0) / np.abs(step)
    return np.where(step == 0, np.nan, parts)


def _settling(
    t: Array,
    s: Array,
    target: Array | None = None,
    band: Array | float = 0.02,
    absolute: bool = False,
) -> Array:
    target = s[:, -1:] if target is None else target
    width = band if absolute else band * np.abs(target - s[:, :1])
    out = np.abs(s - target) > width
    there, k = _first_of(out[:, ::-1])
    last = s.shape[1] - 1 - k  # outside for the last time
    i = np.minimum(last, s.shape[1] - 2)
    side = target + width * np.sign(np.take_along_axis(s, i, 1) - target)
    when = np.where(there, _meets(t, s, i, side) - t[0], 0.0)
    return np.where(there & (last == s.shape[1] - 1), np.nan, when)


@dataclass(frozen=True)
class _Reducer:
    of: Callable[..., Array]
    says: str
    arguments: tuple[str, ...] = ()
    needed: int = 0


REDUCERS: Mapping[str, _Reducer] = {
    "final": _Reducer(lambda t, s: s[:, -1:], "the last sample"),
    "initial": _Reducer(lambda t, s: s[:, :1], "the first sample"),
    "min": _Reducer(lambda t, s: s.min(axis=1, keepdims=True), "the smallest sample"),
    "max": _Reducer(lambda t, s: s.max(axis=1, keepdims=True), "the largest sample"),
    "mean": _Reducer(_mean, "over time (integral by duration)"),
    "rms": _Reducer(_rms, "root of the mean square over time"),
    "integral": _Reducer(_integral, "over time, by trapezoids"),
    "crossing": _Reducer(
        _crossing,
        "the first time at which it meets `level` (`rising`, `falling` or `either`); NaN: never",
        ("level", "direction"),
        1,
    ),
    "overshoot": _Reducer(
        _overshoot,
        "how far beyond `target` (the last sample), as a part of the way from the first one to it",
        ("target",),
    ),
    "settling": _Reducer(
        _settling,
        "the time behind the first sample from which on the signal stays within `band` of `target` "
        "(the last sample); the band is a part of the way (0.02), or a quantity ('0.1 mm'); "
        "NaN: it does not",
        ("target", "band"),
    ),
}
"""{word: what it makes of a signal}; ``docs/many.md`` has the table."""
ALIASES = {
    "crossing_time": "crossing",
    "time_of_crossing": "crossing",
    "settling_time": "settling",
    "last": "final",
    "first": "initial",
}
DIRECTIONS = ("rising", "falling", "either")
FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    name: getattr(np, name) for name in ("abs", "sqrt", "exp", "log", "sin", "cos", "tan")
}
OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
GRAMMAR = (
    "give SIGNAL.REDUCER or REDUCER(SIGNAL, ...) with a reducer of "
    f"{', '.join(REDUCERS)}; numbers may be joined by + - * / **"
)
LONGEST = 2000
"""Characters."""


# ---- words ---------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reduction:
    """A number of a motion: called with (t, signals), it gives one for each case."""

    text: str
    signals: frozenset[str]
    """What it asks for."""
    node: _Node
    made_of: tuple[str, str, tuple[Variable, ...]]

    def __reduce__(self) -> tuple[Any, ...]:  # it travels as its words
        return parsed, self.made_of

    def __call__(self, t: Array, of: Signals, count: int) -> Array:
        """(count,) numbers."""
        with np.errstate(all="ignore"):
            found = np.asarray(self.node.of(t, of), float)
        return np.array(np.broadcast_to(found, (count, 1))[:, 0], float)


@dataclass(frozen=True)
class _Node:
    """Part of the words: what it is worth, and what it is."""

    of: Callable[[Array, Signals], Any]
    series: bool
    unit: str | None = None
    """Where strings such as '10 mm' are quantities of its kind."""
    text: str | None = None
    """A quantity that is not read yet."""


def parsed(label: str, text: str, variables: Sequence[Variable]) -> Reduction:
    """The number that words name. Raises InputError, UnknownNameError.

    label : ``keep['x_end']``. variables : what may be named (states, inputs, outputs, parameters).
    """
    if len(text) > LONGEST:
        raise InputError(f"{label} has {len(text)} characters; give at most {LONGEST}")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(f"{label} = {text!r} cannot be read; {GRAMMAR}") from None
    reader = _Reader(label, text, {v.name: v for v in variables}, set())
    try:
        node = reader.node(tree)
    except RecursionError:
        raise InputError(f"{label} is nested too deeply; {GRAMMAR}") from None
    if node.text is not None:
        raise InputError(f"{label} = {text!r} names no signal; {GRAMMAR}")
    if node.series:
        raise InputError(
            f"{label} = {text!r} is a signal, not a number: say which number of it is kept, such "
            f"as 'max({text})'"
        )
    return Reduction(text, frozenset(reader.asked), node, (label, text, tuple(variables)))


@dataclass(frozen=True)
class _Reader:
    label: str
    text: str
    known: Mapping[str, Variable]
    asked: set[str]

    def refuse(self, why: str) -> InputError:
        return InputError(f"{self.label} = {self.text!r}: {why}; {GRAMMAR}")

    def node(self, tree: ast.expr) -> _Node:
        if isinstance(tree, ast.Constant):
            return self._constant(tree.value)
        if isinstance(tree, ast.Name | ast.Attribute):
            return self._name(tree)
        if isinstance(tree, ast.Call):
            return self._call(tree)
        if isinstance(tree, ast.UnaryOp) and type(tree.op) in OPERATORS:
            return self._joined(type(tree.op), [tree.operand])
        if isinstance(tree, ast.BinOp) and type(tree.op) in OPERATORS:
            return self._joined(type(tree.op), [tree.left, tree.right])
        raise self.refuse(f"{ast.unparse(tree)[:60]!r} is not among what may be said")

    def _constant(self, value: Any) -> _Node:
        if isinstance(value, str):
            return _Node(lambda t, of: np.nan, False, text=value)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(f"{value!r} is no number")
        try:
            number = float(value)
        except OverflowError:
            raise self.refuse("a number is larger than any float") from None
        return _Node(lambda t, of: number, False)

    def _dotted(self, tree: ast.expr) -> str | None:
        if isinstance(tree, ast.Name):
            return tree.id
        if isinstance(tree, ast.Attribute):
            front = self._dotted(tree.value)
            return None if front is None else f"{front}.{tree.attr}"
        return None

    def _variable(self, name: str) -> Variable | None:
        """Of this name; ``_`` may stand for ``.``."""
        if name in self.known:
            return self.known[name]
        return next((v for n, v in self.known.items() if n.replace(".", "_") == name), None)

    def _name(self, tree: ast.Name | ast.Attribute) -> _Node:
        name = self._dotted(tree)
        if name is not None:
            variable = self._variable(name)
            if variable is not None:
                self.asked.add(variable.name)
                series = variable.causality != "parameter"
                return _Node(lambda t, of: of(variable.name), series, variable.unit)
        if isinstance(tree, ast.Attribute):
            word = ALIASES.get(tree.attr, tree.attr)
            inner = self._dotted(tree.value)
            if word in REDUCERS and (inner is None or self._variable(inner) is not None):
                return self._reduced(word, [tree.value], {})
            if inner is not None and self._variable(inner) is not None:
                raise UnknownNameError(f"reducer in {self.label}", tree.attr, list(REDUCERS))
            if word in REDUCERS and inner is not None:
                name = inner
        shown = name if name is not None else ast.unparse(tree)
        error = UnknownNameError(f"signal in {self.label}", shown, self.known)
        if error.nearest:
            error.args = (f"{error}; known: {', '.join(self.known)}",)
        raise error

    def _call(self, tree: ast.Call) -> _Node:
        word = self._dotted(tree.func) or ast.unparse(tree.func)
        if word in FUNCTIONS and len(tree.args) == 1 and not tree.keywords:
            inner = self._number_or_series(tree.args[0])
            made = FUNCTIONS[word]
            return _Node(lambda t, of: made(inner.of(t, of)), inner.series)
        word = ALIASES.get(word, word)
        if word not in REDUCERS:
            raise UnknownNameError(f"reducer in {self.label}", word, [*REDUCERS, *FUNCTIONS])
        if not tree.args:
            raise self.refuse(f"{word} of what?")
        return self._reduced(word, tree.args, {k.arg or "**": k.value for k in tree.keywords})

    def _number_or_series(self, tree: ast.expr) -> _Node:
        found = self.node(tree)
        if found.text is not None:
            raise self.refuse(f"{found.text!r} stands where a signal or a number is wanted")
        return found

    def _reduced(
        self, word: str, given: Sequence[ast.expr], named: Mapping[str, ast.expr]
    ) -> _Node:
        reducer = REDUCERS[word]
        of = self._number_or_series(given[0])
        if not of.series:
            raise self.refuse(f"{word} wants a signal, {ast.unparse(given[0])!r} is a number")
        if len(given) - 1 > len(reducer.arguments):
            raise self.refuse(f"{word} takes {len(reducer.arguments)} further arguments at most")
        more = dict(zip(reducer.arguments, given[1:], strict=False))
        for name, tree in named.items():
            if name not in reducer.arguments or name in more:
                raise self.refuse(f"{word} has no argument {name!r}, or has it twice")
            more[name] = tree
        if len(more) < reducer.needed:
            raise self.refuse(f"{word} needs {', '.join(reducer.arguments[: reducer.needed])}")
        fixed = dict(self._arguments(more, of.unit))
        numbers = {n: v for n, v in fixed.items() if isinstance(v, _Node)}
        plain = {n: v for n, v in fixed.items() if not isinstance(v, _Node)}

        def value(t: Array, signals: Signals) -> Array:
            values = {n: np.reshape(v.of(t, signals), (-1, 1)) for n, v in numbers.items()}
            return reducer.of(t, of.of(t, signals), **values, **plain)

        return _Node(value, False, None)

    def _arguments(
        self, more: Mapping[str, ast.expr], unit: str | None
    ) -> Iterator[tuple[str, Any]]:
        for name, tree in more.items():
            if name == "direction":
                said = tree.value if isinstance(tree, ast.Constant) else self._dotted(tree)
                if said not in DIRECTIONS:
                    raise self.refuse(f"direction {said!r} is none of {', '.join(DIRECTIONS)}")
                yield name, said
                continue
            node = self.node(tree)
            if node.series:
                raise self.refuse(f"{name} = {ast.unparse(tree)} is a signal, not a number")
            if node.text is None:
                yield name, node
                continue
            if unit is None:
                raise self.refuse(f"{name} = {node.text!r}: give it in SI, as a number")
            number = quantity(f"{self.label}: {name}", node.text, unit)
            yield name, np.array([[number]])
            if name == "band":
                yield "absolute", True

    def _joined(self, kind: type, parts: Sequence[ast.expr]) -> _Node:
        nodes = [self._number_or_series(p) for p in parts]
        join = OPERATORS[kind]

        def value(t: Array, of: Signals) -> Any:
            return join(*(np.asarray(n.of(t, of), float) for n in nodes))

        same = {n.unit for n in nodes}
        unit = same.pop() if len(same) == 1 and kind in (ast.Add, ast.Sub, ast.USub) else None
        return _Node(value, any(n.series for n in nodes), unit)
