"""Test vectors of a block: inputs that exercise it, and the outputs that Python gives for them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.errors import ExportError
from ...numerics.portable import written_out
from .counts import counted

__all__ = ["inputs_of", "outputs_of", "sensitivity", "single_outputs"]

Array: TypeAlias = NDArray[np.float64]

BUDGET = 1_000_000
"""Instructions that are carried out, at most (about ten seconds)."""

DRAWS = 8
"""Runs in single precision at once: the first as IEEE 754 rounds, in the others each result is off
by a unit in its last place or not, at random, unless it is whole (as other orders of sums and other
C libraries round)."""

_F: Any = np.float32
_ROUNDED: dict[str, Callable[..., Any]] = {
    "ADD": np.add,
    "SUB": np.subtract,
    "MUL": np.multiply,
    "DIV": np.divide,
    "SQ": np.square,
    "INV": np.reciprocal,
    "SQRT": np.sqrt,
    "POW": np.power,
    "CONSTPOW": np.power,
    "EXP": np.exp,
    "LOG": np.log,
    "SIN": np.sin,
    "COS": np.cos,
    "TAN": np.tan,
    "ASIN": np.arcsin,
    "ACOS": np.arccos,
    "ATAN": np.arctan,
    "SINH": np.sinh,
    "COSH": np.cosh,
    "TANH": np.tanh,
    "LOG1P": np.log1p,
    "EXPM1": np.expm1,
    "ATAN2": np.arctan2,
    "HYPOT": np.hypot,
}
_EXACT: dict[str, Callable[..., Any]] = {
    "ASSIGN": np.positive,
    "NEG": np.negative,
    "TWICE": lambda x: x + x,
    "FLOOR": np.floor,
    "CEIL": np.ceil,
    "FABS": np.abs,
    "SIGN": np.sign,
    "NOT": np.logical_not,
    "LT": np.less,
    "LE": np.less_equal,
    "EQ": np.equal,
    "NE": np.not_equal,
    "AND": np.logical_and,
    "OR": np.logical_or,
    "FMOD": np.fmod,
    "COPYSIGN": np.copysign,
    "FMIN": np.fmin,
    "FMAX": np.fmax,
    "IF_ELSE_ZERO": lambda x, y: np.where(x != 0, y, _F(0)),
}


def single_outputs(block: Block, inputs: Array) -> Array | None:
    """Outputs (draws, steps, outputs) in single precision, of as many steps as the budget allows.

    None where the step is not made of plain operations (tables, linear solvers), or of too many.
    """
    if counted(block.step).total > BUDGET:  # before they are written out and read one by one
        return None
    try:
        step = block.step if block.step.is_a("SXFunction") else block.step.expand()
    except RuntimeError:
        return None
    program = _program(step := written_out(step))
    if program is None:
        return None
    steps = min(len(inputs), BUDGET // max(len(program), 1))
    if steps < 1:
        return None
    random = np.random.default_rng(0)
    memory, parameters = (
        np.repeat(block.start(k).astype(_F)[:, None], DRAWS, axis=1)
        for k in ("memory", "parameters")
    )
    rows = []
    with np.errstate(all="ignore"):
        for row in inputs[:steps].astype(_F):
            given = [memory, np.repeat(row[:, None], DRAWS, axis=1), parameters]
            units = random.integers(-1, 2, (len(program), DRAWS)).astype(_F)
            units[:, 0] = 0
            factors = 1 + units * np.finfo(_F).eps
            results = [np.zeros((len(v), DRAWS), _F) for v in (block.memory, block.outputs)]
            _carry_out(program, step.sz_w(), given, results, factors)
            memory, outputs = results
            rows.append(outputs.T.astype(float))
    return np.stack(rows, axis=1)


def _program(step: ca.Function) -> list[tuple[Any, ...]] | None:
    """(kind, operation or constant, places read, places written) of each instruction."""
    known: dict[int, Any] = {
        getattr(ca, f"OP_{name}"): (kind, operation)
        for kind, table in (("rounded", _ROUNDED), ("exact", _EXACT))
        for name, operation in table.items()
    }
    found: list[tuple[Any, ...]] = []
    for k in range(step.n_instructions()):
        code = step.instruction_id(k)
        reads, writes = step.instruction_input(k), step.instruction_output(k)
        if code == ca.OP_CONST:
            with np.errstate(over="ignore"):  # what is too large for it is infinite
                constant = np.full(DRAWS, step.instruction_constant(k), _F)
            found.append(("constant", constant, (), writes))
        elif code == ca.OP_INPUT:
            found.append(("input", None, reads, writes))
        elif code == ca.OP_OUTPUT:
            found.append(("output", None, reads, writes))
        elif code in known:
            found.append((*known[code], reads, writes))
        else:
            return None
    return found


def _carry_out(
    program: list[tuple[Any, ...]], size: int, given: list[Any], results: list[Any], factors: Any
) -> None:
    w: list[Any] = [np.zeros(DRAWS, _F)] * size
    for (kind, what, reads, writes), factor in zip(program, factors, strict=True):
        if kind == "rounded":
            value = what(*(w[i] for i in reads))
            w[writes[0]] = np.where(value == np.rint(value), value, value * factor)
        elif kind == "exact":
            w[writes[0]] = what(*(w[i] for i in reads)).astype(_F, copy=False)
        elif kind == "constant":
            w[writes[0]] = what
        elif kind == "input":
            w[writes[0]] = given[reads[0]][reads[1]]
        else:
            results[writes[0]][writes[1]] = w[reads[0]]


REACH = 0.3
"""How far the inputs go about their start values, scaled by nominals."""


def inputs_of(block: Block, steps: int, seed: int) -> Array:
    """Smooth inputs (steps, inputs) about their start values, with gaps in what may be missing."""
    random = np.random.default_rng(seed)
    k = np.arange(steps)
    columns = []
    for v in block.inputs:
        start = v.start or 0.0
        column = np.full(steps, start)
        if v.name == "enable":
            column[steps // 2 : steps // 2 + steps // 10] = 0.0
        else:
            for waves in (1, 3, 7):
                size = REACH * v.nominal / waves * random.standard_normal()
                column += size * np.sin(2 * math.pi * (waves * k / steps + random.random()))
            column = np.clip(column, v.min, v.max)
            if v.name in block.missing:
                column[random.random(steps) < 0.03] = np.nan
        columns.append(column)
    if block.missing and steps >= 40:  # and once for longer than anything holds
        names = [v.name for v in block.inputs]
        columns[names.index(block.missing[0])][-steps // 5 : -steps // 10] = np.nan
    found: Array = np.array(columns).T.reshape(steps, len(block.inputs))
    return found


def outputs_of(
    block: Block, inputs: Array, rounding: float = 0.0, single: bool = False, seed: int = 0
) -> Array:
    """Outputs (steps, outputs) of the block in Python.

    single : inputs and parameters are rounded, as in C. rounding : relative error that the memory
    suffers in each step.
    """
    random = np.random.default_rng(seed)
    memory, parameters = block.start("memory"), block.start("parameters")
    if single:
        inputs, parameters = (a.astype(np.float32).astype(float) for a in (inputs, parameters))
    rows = []
    for row in inputs:
        memory, outputs = (np.asarray(m).ravel() for m in block.step(memory, row, parameters))
        rows.append(outputs)
        if rounding:
            moved = memory * (1 + rounding * random.uniform(-1, 1, len(memory)))
            memory = np.where(memory == np.round(memory), memory, moved)  # counts are exact
    found = np.array(rows).reshape(len(inputs), len(block.outputs))
    if not np.all(np.isfinite(found)):
        raise ExportError(
            f"{block.name}: its outputs are not finite under the test vectors; guard it "
            "(pam_ocp.control.block(...)), or give inputs=... of its normal use"
        )
    return found


def sensitivity(
    block: Block, inputs: Array, expected: Array, digits: float, single: bool
) -> tuple[Array, Array]:
    """Of each step so far, the largest change of an output, relative to itself and its nominal,
    that rounding makes; and the expected outputs, NaN for flags (whole numbers) that rounding may
    turn over.

    digits : spacing of numbers at 1. Each value of the memory errs by some of it in each step; in
    single precision every operation is carried out so, too, where the step allows it.
    """
    nominal = np.array([v.nominal for v in block.outputs])
    flags = np.all(expected == np.round(expected), axis=0)
    runs = [outputs_of(block, inputs, 4 * digits, single)]
    drawn = single_outputs(block, inputs) if single else None
    if drawn is not None:
        runs.append(drawn[0])
    told, errors = expected.copy(), np.zeros(len(expected))
    for run in runs:
        wanted = expected[: len(run)]
        off = np.abs(run - wanted)
        size = np.max((off / (nominal + np.abs(wanted)))[:, ~flags], axis=1, initial=0.0)
        errors[: len(run)] = np.maximum(errors[: len(run)], size)
        told[: len(run)][(off > 0) & flags] = np.nan
    if single:  # flags are sure as far as every operation was carried out, by all draws
        sure = 0 if drawn is None else drawn.shape[1]
        told[sure:, flags] = np.nan
        if drawn is not None:
            told[:sure][np.any(drawn != expected[:sure], axis=0) & flags] = np.nan
    return np.maximum.accumulate(errors), told
