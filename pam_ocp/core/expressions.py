"""Expressions that a user gives: scalar, finite, and not the work of Python's own functions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca

from .errors import InputError

__all__ = ["expression_of", "scalar_expression"]


def scalar_expression(name: str, value: Any) -> ca.SX:
    """``value`` as a scalar expression; InputError when it is none, or holds NaN or an infinite
    number.

    Python's own ``float``, and with it all of ``math``, silently make NaN of a CasADi symbol.
    """
    try:
        expression = ca.SX(value)
    except (TypeError, ValueError, NotImplementedError):
        raise InputError(
            f"{name}: {type(value).__name__} is no expression; give one of the plant's symbols or "
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
