"""How many operations one step of a block takes, counted in CasADi's instructions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

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


def counted(function: ca.Function) -> Counts:
    """The operations of one call."""
    codes = {
        getattr(ca, f"OP_{op}"): kind
        for kind, ops in _KINDS.items()
        for op in ops.split()
        if hasattr(ca, f"OP_{op}")
    }
    found: Counter[str] = Counter()
    known: dict[str, tuple[Counter[str], bool]] = {}
    whole = _count(function, 1, codes, found, known)
    return Counts({kind: found[kind] for kind in _KINDS}, whole)


def _count(
    function: ca.Function,
    times: int,
    codes: Mapping[int, str],
    found: Counter[str],
    known: dict[str, tuple[Counter[str], bool]],
) -> bool:
    """Add the operations of ``times`` calls; whether all were understood."""
    own, whole = _own(function, codes, known)
    for kind, n in own.items():
        found[kind] += times * n
    return whole


def _own(
    function: ca.Function,
    codes: Mapping[int, str],
    known: dict[str, tuple[Counter[str], bool]],
) -> tuple[Counter[str], bool]:
    key = f"{function.name()} {function.__hash__()}"
    if key in known:
        return known[key]
    own: Counter[str] = Counter()
    whole = True
    if function.is_a("SXFunction"):
        nodes = function.instructions_sx()
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            if code == ca.OP_CALL:
                whole = _count(nodes[k].which_function(), 1, codes, own, known) and whole
            elif code in codes:
                own[codes[code]] += 1
    elif function.is_a("MXFunction"):
        for k in range(function.n_instructions()):
            whole = _instruction(function, k, codes, own, known) and whole
    elif function.is_a("Map") and function.info().get("f") is not None:
        whole = _count(function.info()["f"], function.info()["n"], codes, own, known)
    elif function.class_name() == "Switch":  # one of the branches is taken: at most the longest
        branches = [*function.info()["f"], function.info()["f_def"]]
        parts = [_own(branch, codes, known) for branch in branches]
        longest: Counter[str] = max((counts for counts, _ in parts), key=Counter.total)
        own.update(longest)
        whole = all(understood for _, understood in parts)
    else:
        whole = False
    known[key] = own, whole
    return known[key]


def _instruction(
    function: ca.Function,
    k: int,
    codes: Mapping[int, str],
    own: Counter[str],
    known: dict[str, tuple[Counter[str], bool]],
) -> bool:
    code = function.instruction_id(k)
    node = function.instruction_MX(k)
    if code == ca.OP_CALL:
        return _count(node.which_function(), 1, codes, own, known)
    if code == ca.OP_MTIMES:
        left, right = node.dep(1), node.dep(2)
        products = left.shape[0] * left.shape[1] * right.shape[1]
        own["multiplications"] += products
        own["additions and subtractions"] += products
        return True
    kind = codes.get(code)
    if kind:
        own[kind] += node.nnz()
        return True
    return code not in (ca.OP_SOLVE, ca.OP_INVERSE, ca.OP_DETERMINANT)
