"""Test vectors of a block: inputs that exercise it, and the outputs that Python gives for them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.errors import ExportError
from ...core.expressions import carried_out, steps_of
from ...numerics.elementwise import array_table
from ...numerics.portable import written_out
from .counts import counted

Array: TypeAlias = NDArray[np.float64]

BUDGET = 1_000_000
"""Instructions that are carried out, at most (about ten seconds)."""

DRAWS = 8
"""Runs in single precision at once: the first as IEEE 754 rounds, in the others each result is off
by a unit in its last place or not, at random, unless it is whole (as other orders of sums and other
C libraries round)."""

POOL = 4093
"""Rows of random units, which come again in turn."""

_F: Any = np.float32
_EXACT = {
    *("assign", "neg", "twice", "floor", "ceil", "fabs", "sign", "not", "lt", "le", "eq", "ne"),
    *("and", "or", "fmod", "copysign", "fmin", "fmax", "if_else_zero"),
}
_SINGLE: dict[str, Callable[..., Any]] = {
    **array_table(np, missing=True),
    "assign": lambda x: x,
    "pow": np.power,
    "constpow": np.power,
}
"""Operations on rows of draws."""


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
    program = tuple(steps_of(written_out(step)))
    if any(s.name not in {*_SINGLE, "const", "input", "output"} for s in program):
        return None
    steps = min(len(inputs), BUDGET // max(len(program), 1))
    if steps < 1:
        return None
    table = _drawn(np.random.default_rng(0))
    memory, parameters = (_repeated(block.start(k)) for k in ("memory", "parameters"))
    sizes, rows = (len(block.memory), len(block.outputs)), []
    with np.errstate(all="ignore"):  # what is too large for it is infinite
        for row in inputs[:steps]:
            given = [a.__getitem__ for a in (memory, _repeated(row), parameters)]
            memory, outputs = carried_out(program, table, given, sizes, _repeated)
            rows.append(np.array(outputs, float).reshape(len(outputs), DRAWS).T)
    return np.stack(rows, axis=1)


def _repeated(values: Any) -> Any:
    """Of each value (or of one number) a row of draws."""
    return np.repeat(np.asarray(values, _F)[..., None], DRAWS, axis=-1)


def _drawn(random: np.random.Generator) -> dict[str, Callable[..., Any]]:
    """The operations, what they round a unit off at random; not the first draw."""
    units = random.integers(-1, 2, (POOL, DRAWS)).astype(_F)
    units[:, 0] = 0
    factors = itertools.cycle(1 + units * np.finfo(_F).eps)

    def exact(operation: Callable[..., Any], *given: Any) -> Any:
        return operation(*given).astype(_F, copy=False)

    def rounded(operation: Callable[..., Any], *given: Any) -> Any:
        value = operation(*given)
        return np.where(value == np.rint(value), value, value * next(factors))

    return {n: partial(exact if n in _EXACT else rounded, f) for n, f in _SINGLE.items()}


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
