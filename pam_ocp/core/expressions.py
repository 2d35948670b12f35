"""Expressions that a user gives: scalar, finite, and not the work of Python's own functions; and
what they are as data, without code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import casadi as ca

from .errors import InputError, kind_of

_NAMES: dict[int, str] = {
    value: name[3:].lower()
    for name, value in vars(ca).items()
    if name.startswith("OP_") and isinstance(value, int)
}


def scalar_expression(name: str, value: Any) -> ca.SX:
    """``value`` as a scalar expression; InputError when it is none, or holds NaN or an infinite
    number.

    Python's own ``float``, and with it all of ``math``, silently make NaN of a CasADi symbol.
    """
    try:
        expression = ca.SX(value)
    except (TypeError, ValueError, NotImplementedError):
        raise InputError(
            f"{name}: {kind_of(value)} is no expression; give one of the plant's symbols or "
            "a number"
        ) from None
    if expression.shape != (1, 1):
        raise InputError(f"{name}: the expression has shape {expression.shape}; give a scalar")
    function = ca.Function("constants", [ca.vertcat(*ca.symvar(expression))], [expression])
    for k in range(function.n_instructions()):  # not by steps: it is asked of every declaration
        if function.instruction_id(k) != ca.OP_CONST:
            continue
        constant = function.instruction_constant(k)
        if not math.isfinite(constant):
            raise InputError(
                f"{name}: the expression holds the constant {constant}; functions of Python's "
                "math make NaN of a symbol: write casadi.sin(x) or numpy.sin(x) instead of "
                "math.sin(x), and casadi.if_else(x > 0, a, b) instead of a if x > 0 else b"
            )
    return expression


def polynomial(coefficients: Sequence[Any], x: Any) -> Any:
    """sum c_j x^j, of expressions or arrays, without a power: CasADi takes x**3 by C's ``pow``,
    which costs as much as thirty products.
    """
    *others, found = coefficients
    for c in reversed(others):
        found = c + x * found
    return found


def expression_of(
    name: str, function: Callable[..., Any], *symbols: ca.SX, **named: ca.SX
) -> ca.SX:
    """What a user's function makes of symbols, as :func:`scalar_expression`.

    InputError also where it asks whether a symbol is true: ``a if x > 0 else b``, ``max(x, 0)``.
    """
    try:
        value = function(*symbols, **named)
    except RuntimeError as error:  # of CasADi
        reason = str(error).rpartition(": ")[2]
        raise InputError(
            f"{name} cannot be evaluated for a symbol ({reason}) write casadi.if_else(x > 0, a, b) "
            "instead of a if x > 0 else b, and casadi.fmax instead of max"
        ) from None
    return scalar_expression(name, value)


# ---- operation by operation ----------------------------------------------------------------------
class Step(NamedTuple):
    """An elementary operation of a function of scalars."""

    name: str
    """As CasADi has it without OP_, in small letters; "unknown" where it has none."""
    to: Sequence[int]
    """The place that it writes to; of an output (result, entry)."""
    of: Sequence[int]
    """The places that it reads; of an input (argument, entry)."""
    constant: float = 0.0


def steps_of(function: ca.Function) -> Iterator[Step]:
    """The operations of an SX Function in their order."""
    for k in range(function.n_instructions()):
        name = _NAMES.get(function.instruction_id(k), "unknown")
        constant = float(function.instruction_constant(k)) if name == "const" else 0.0
        yield Step(name, function.instruction_output(k), function.instruction_input(k), constant)


def carried_out(
    steps: Iterable[Step],
    table: Mapping[str, Callable[..., Any]],
    arguments: Sequence[Callable[[int], Any]],
    sizes: Sequence[int],
    constant: Callable[[float], Any] = float,
    changed: Callable[[int, Any], Any] = lambda result, value: value,
) -> list[list[Any]]:
    """The entries of each result, so many of them as ``sizes`` says.

    table : {name of an operation: what it is}. arguments : of each, what gives the entry of a
    number. constant : makes a value of a number. changed : of an entry of a result, what all that
    follows takes in its place. KeyError for an operation without an entry.
    """
    work: dict[int, Any] = {}
    results: list[list[Any]] = [[constant(0.0)] * size for size in sizes]
    for name, to, of, number in steps:
        if name == "const":
            work[to[0]] = constant(number)
        elif name == "input":
            work[to[0]] = arguments[of[0]](of[1])
        elif name == "output":
            results[to[0]][to[1]] = work[of[0]] = changed(to[0], work[of[0]])
        else:
            work[to[0]] = table[name](*(work[i] for i in of))
    return results


def _symbolic(code: int, *given: ca.SX) -> ca.SX:
    made = ca.SX.binary if len(given) == 2 else ca.SX.unary
    return made(code, *given)


SYMBOLIC: Mapping[str, Callable[..., ca.SX]] = {
    name: partial(_symbolic, code) for code, name in _NAMES.items()
}
"""The operations on CasADi's own scalars."""


# ---- as data ------------------------------------------------------------------------------------
def operations_of(function: ca.Function) -> list[Any]:
    """A function's elementary operations in order, as JSON takes them: [name, result, arguments or
    number]. Raises InputError where it calls another function.
    """
    found: list[Any] = []
    for name, to, of, number in steps_of(function):
        if name in ("call", "unknown"):
            raise InputError(f"{function.name()} calls another function, which no file can hold")
        value: Any = list(of)
        if name == "const":
            value = number if math.isfinite(number) else str(number)
        found.append([name.upper(), list(to), value])
    return found


def results_of(
    operations: Sequence[Any], arguments: Sequence[ca.SX], sizes: Sequence[int]
) -> list[list[ca.SX]]:
    """The results, each a list of so many expressions, that :func:`operations_of` make of the
    arguments.

    Raises InputError, KeyError, TypeError, ValueError or IndexError for what are no operations.
    """
    steps = []
    for name, to, value in operations:
        if name.lower() not in SYMBOLIC:
            raise InputError(f"unknown operation {name!r}")
        constant = name == "CONST"
        steps.append(
            Step(name.lower(), to, () if constant else value, float(value) if constant else 0.0)
        )
    return carried_out(steps, SYMBOLIC, [a.__getitem__ for a in arguments], sizes, ca.SX)
