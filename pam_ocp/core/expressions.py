"""Expressions that a user gives: scalar, finite, and not the work of Python's own functions; and
what they are as data, without code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from .errors import InputError, kind_of

__all__ = ["expression_of", "operations_of", "results_of", "scalar_expression"]

_CODES: dict[int, str] = {
    value: name[3:]
    for name, value in vars(ca).items()
    if name.startswith("OP_") and isinstance(value, int)
}
_NUMBERS = {name: code for code, name in _CODES.items()}


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
    for k in range(function.n_instructions()):
        if function.instruction_id(k) == ca.OP_CONST:
            constant = function.instruction_constant(k)
            if not math.isfinite(constant):
                raise InputError(
                    f"{name}: the expression holds the constant {constant}; functions of Python's "
                    "math make NaN of a symbol: write casadi.sin(x) or numpy.sin(x) instead of "
                    "math.sin(x), and casadi.if_else(x > 0, a, b) instead of a if x > 0 else b"
                )
    return expression


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


# ---- as data ------------------------------------------------------------------------------------
def operations_of(function: ca.Function) -> list[Any]:
    """A function's elementary operations in order, as JSON takes them: [name, result, arguments or
    number]. Raises InputError where it calls another function.
    """
    found: list[Any] = []
    for k in range(function.n_instructions()):
        code = _CODES.get(function.instruction_id(k), "?")
        if code in ("CALL", "?"):
            raise InputError(f"{function.name()} calls another function, which no file can hold")
        value: Any = list(function.instruction_input(k))
        if code == "CONST":
            value = function.instruction_constant(k)
            value = value if math.isfinite(value) else str(value)
        found.append([code, list(function.instruction_output(k)), value])
    return found


def results_of(
    operations: Sequence[Any], arguments: Sequence[ca.SX], sizes: Sequence[int]
) -> list[list[ca.SX]]:
    """The results, each a list of so many expressions, that :func:`operations_of` make of the
    arguments.

    Raises InputError, KeyError, TypeError, ValueError or IndexError for what are no operations.
    """
    work: dict[int, ca.SX] = {}
    found = [[ca.SX(0)] * size for size in sizes]
    for code, out, value in operations:
        if code not in _NUMBERS:
            raise InputError(f"unknown operation {code!r}")
        if code == "CONST":
            work[out[0]] = ca.SX(float(value))
        elif code == "INPUT":
            work[out[0]] = arguments[value[0]][value[1]]
        elif code == "OUTPUT":
            found[out[0]][out[1]] = work[value[0]]
        else:
            given = [work[i] for i in value]
            made = ca.SX.binary if len(given) == 2 else ca.SX.unary
            work[out[0]] = made(_NUMBERS[code], *given)
    return found
