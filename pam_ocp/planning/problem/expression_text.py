"""Expressions as text: "muscle1.force - 2*abs(v)" becomes a CasADi expression of a plant."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable
from typing import Any

import casadi as ca

from ...core.errors import InputError, UnknownNameError
from ...judge.statement import TIME
from ...plants.plant import Plant

__all__ = ["expression_of"]

_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, ca.fabs),
    "sqrt": (1, ca.sqrt),
    "exp": (1, ca.exp),
    "log": (1, ca.log),
    "sin": (1, ca.sin),
    "cos": (1, ca.cos),
    "tan": (1, ca.tan),
    "tanh": (1, ca.tanh),
    "min": (2, ca.fmin),
    "max": (2, ca.fmax),
}
"""What may be called: number of arguments, and the function."""

LONGEST = 2000
"""Characters of an expression."""


def expression_of(plant: Plant, text: Any, where: str = "expression") -> ca.SX:
    """A scalar expression of the plant's variables, from text.

    Numbers (SI), + - * / **, brackets, names of variables, ``der(STATE)``, ``time`` (since the
    motion began) and the functions abs, sqrt, exp, log, sin, cos, tan, tanh, min, max. Nothing in
    the text is executed. Raises InputError naming what is not understood.
    """
    if not isinstance(text, str):
        raise InputError(f"{where} = {text!r}: give a text, as 'muscle1.force - muscle2.force'")
    if len(text) > LONGEST:
        raise InputError(
            f"{where} has {len(text)} characters, {LONGEST} are allowed; write it in Python"
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise InputError(f"{where} = {text!r} is no expression") from None
    return ca.SX(_value(plant, tree, f"{where} = {text!r}"))


def _value(plant: Plant, node: ast.expr, where: str) -> Any:
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    ):
        return ca.SX(node.value)
    if isinstance(node, ast.Name | ast.Attribute):
        name = ast.unparse(node)
        return TIME if name == "time" else plant.expression(name)
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = (_value(plant, side, where) for side in (node.left, node.right))
        return _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
        return _UNARY[type(node.op)](_value(plant, node.operand, where))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        return _called(plant, node.func.id, node.args, where)
    raise InputError(
        f"{where}: {ast.unparse(node)!r} is not understood; use numbers, + - * / **, names of "
        f"variables, time, der(STATE) and {', '.join(_FUNCTIONS)}"
    )


def _called(plant: Plant, name: str, arguments: list[ast.expr], where: str) -> Any:
    if name == "der" and len(arguments) == 1:
        return plant.expression(f"der({ast.unparse(arguments[0])})")
    if name not in _FUNCTIONS:
        raise UnknownNameError(f"function in {where}", name, ["der", *_FUNCTIONS])
    count, function = _FUNCTIONS[name]
    if len(arguments) != count:
        raise InputError(f"{where}: {name} takes {count} arguments, not {len(arguments)}")
    return function(*(_value(plant, a, where) for a in arguments))
