"""A block's step in single precision, instruction by instruction: what rounding makes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.block import Block

__all__ = ["single_outputs"]

Array: TypeAlias = NDArray[np.float64]

BUDGET = 2_000_000
"""Instructions that are carried out, at most (about a second)."""

_F: Any = np.float32
_ONE: dict[str, Callable[[Any], Any]] = {
    "ASSIGN": lambda x: x,
    "NEG": lambda x: -x,
    "EXP": np.exp,
    "LOG": np.log,
    "SQRT": np.sqrt,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: x + x,
    "SIN": np.sin,
    "COS": np.cos,
    "TAN": np.tan,
    "ASIN": np.arcsin,
    "ACOS": np.arccos,
    "ATAN": np.arctan,
    "FLOOR": np.floor,
    "CEIL": np.ceil,
    "FABS": abs,
    "SIGN": np.sign,
    "INV": lambda x: _F(1) / x,
    "SINH": np.sinh,
    "COSH": np.cosh,
    "TANH": np.tanh,
    "LOG1P": np.log1p,
    "EXPM1": np.expm1,
    "NOT": lambda x: _F(x == 0),
}
_TWO: dict[str, Callable[[Any, Any], Any]] = {
    "ADD": lambda x, y: x + y,
    "SUB": lambda x, y: x - y,
    "MUL": lambda x, y: x * y,
    "DIV": lambda x, y: x / y,
    "POW": np.power,
    "CONSTPOW": np.power,
    "LT": lambda x, y: _F(x < y),
    "LE": lambda x, y: _F(x <= y),
    "EQ": lambda x, y: _F(x == y),
    "NE": lambda x, y: _F(x != y),
    "AND": lambda x, y: _F(x != 0 and y != 0),
    "OR": lambda x, y: _F(x != 0 or y != 0),
    "FMOD": np.fmod,
    "COPYSIGN": np.copysign,
    "FMIN": np.fmin,
    "FMAX": np.fmax,
    "ATAN2": np.arctan2,
    "HYPOT": np.hypot,
    "IF_ELSE_ZERO": lambda x, y: y if x != 0 else _F(0),
}


def single_outputs(block: Block, inputs: Array) -> Array | None:
    """Outputs (steps, outputs) in single precision, of as many steps as the budget allows.

    None where the step is not made of plain operations (tables, linear solvers).
    """
    try:
        step = block.step if block.step.is_a("SXFunction") else block.step.expand()
    except RuntimeError:
        return None
    program = _program(step)
    if program is None:
        return None
    steps = min(len(inputs), BUDGET // max(len(program), 1))
    if steps < 1:
        return None
    memory, parameters = (block.start(k).astype(_F) for k in ("memory", "parameters"))
    rows = []
    with np.errstate(all="ignore"):
        for row in inputs[:steps].astype(_F):
            memory, outputs = _carried_out(program, step.sz_w(), [memory, row, parameters], block)
            rows.append(outputs.astype(float))
    return np.array(rows)


def _program(step: ca.Function) -> list[tuple[Any, ...]] | None:
    """(kind, operation or constant, places read, places written) of each instruction."""
    names = {getattr(ca, f"OP_{n}"): f for n, f in (*_ONE.items(), *_TWO.items())}
    known: dict[int, Any] = names
    found: list[tuple[Any, ...]] = []
    for k in range(step.n_instructions()):
        code = step.instruction_id(k)
        reads, writes = step.instruction_input(k), step.instruction_output(k)
        if code == ca.OP_CONST:
            with np.errstate(over="ignore"):  # what is too large for it is infinite
                found.append(("constant", _F(step.instruction_constant(k)), (), writes))
        elif code == ca.OP_INPUT:
            found.append(("input", None, reads, writes))
        elif code == ca.OP_OUTPUT:
            found.append(("output", None, reads, writes))
        elif code in known:
            found.append(("operation", known[code], reads, writes))
        else:
            return None
    return found


def _carried_out(
    program: list[tuple[Any, ...]], size: int, given: list[Any], block: Block
) -> tuple[Any, Any]:
    w: list[Any] = [_F(0)] * size
    results = [np.zeros(len(block.memory), _F), np.zeros(len(block.outputs), _F)]
    for kind, what, reads, writes in program:
        if kind == "operation":
            w[writes[0]] = what(*(w[i] for i in reads))
        elif kind == "constant":
            w[writes[0]] = what
        elif kind == "input":
            w[writes[0]] = given[reads[0]][reads[1]]
        else:
            results[writes[0]][writes[1]] = w[reads[0]]
    return results[0], results[1]
