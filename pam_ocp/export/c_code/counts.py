"""How many operations one step of a block takes, counted in CasADi's instructions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

_KINDS: Mapping[str, str] = {
    "additions and subtractions": "ADD SUB NEG",
    "multiplications": "MUL SQ TWICE",
    "divisions": "DIV INV",
    "square roots": "SQRT",
    "comparisons and choices": "LT LE EQ NE NOT AND OR IF_ELSE_ZERO FMIN FMAX FABS SIGN COPYSIGN",
    "roundings": "FLOOR CEIL FMOD REMAINDER",
    "elementary functions": (
        "EXP LOG POW CONSTPOW SIN COS TAN ASIN ACOS ATAN SINH COSH TANH ASINH ACOSH ATANH ATAN2 "
        "ERF LOG1P EXPM1 HYPOT"
    ),
}


@dataclass(frozen=True)
class Counts:
    """Numbers of operations by kind; ``whole`` False where some part could not be counted."""

    by_kind: dict[str, int]
    whole: bool

    @property
    def total(self) -> int:
        return sum(self.by_kind.values())


_CODES = {
    getattr(ca, f"OP_{op}"): kind
    for kind, ops in _KINDS.items()
    for op in ops.split()
    if hasattr(ca, f"OP_{op}")
}
_UNCOUNTED = (ca.OP_SOLVE, ca.OP_INVERSE, ca.OP_DETERMINANT)
_Found: TypeAlias = "tuple[Counter[str], bool]"
"""Operations of one call, and whether all were understood."""


def counted(function: ca.Function) -> Counts:
    """The operations of one call."""
    found, whole = _within(function, {})
    return Counts({kind: found[kind] for kind in _KINDS}, whole)


def _within(function: ca.Function, known: dict[str, _Found]) -> _Found:
    """Of a function that may be called at several places."""
    key = f"{function.name()} {function.__hash__()}"
    if key not in known:
        known[key] = _counted(function, known)
    return known[key]


def _counted(function: ca.Function, known: dict[str, _Found]) -> _Found:
    if function.is_a("SXFunction") or function.is_a("MXFunction"):
        return _instructions(function, known)
    if function.is_a("Map") and function.info().get("f") is not None:
        found, whole = _within(function.info()["f"], known)
        return Counter({kind: n * function.info()["n"] for kind, n in found.items()}), whole
    if function.class_name() == "Switch":  # one of the branches is taken: at most the longest
        branches = [*function.info()["f"], function.info()["f_def"]]
        parts = [_within(branch, known) for branch in branches]
        return max((found for found, _ in parts), key=Counter.total), all(w for _, w in parts)
    return Counter(), False


def _instructions(function: ca.Function, known: dict[str, _Found]) -> _Found:
    found: Counter[str] = Counter()
    whole, scalars = True, function.is_a("SXFunction")
    nodes = function.instructions_sx() if scalars else ()
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        node = nodes[k] if scalars else function.instruction_MX(k)
        if code == ca.OP_CALL:
            inside, understood = _within(node.which_function(), known)
            found.update(inside)
            whole = whole and understood
        elif code == ca.OP_MTIMES:
            left, right = node.dep(1), node.dep(2)
            products = left.shape[0] * left.shape[1] * right.shape[1]
            found["multiplications"] += products
            found["additions and subtractions"] += products
        elif code in _CODES:
            found[_CODES[code]] += 1 if scalars else node.nnz()
        elif code in _UNCOUNTED:
            whole = False
    return found, whole
