"""Elementary functions of sums and products alone, whose last bit is the same everywhere.

No two C libraries agree on the last bit of exp. Where a result depends strongly on its data (many
iterations, kinks), a difference there grows to one that can be seen, so that a Function gives other
numbers in Python than in its C code on a target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache

import casadi as ca

__all__ = ["portable", "written_out"]

LN2_HIGH, LN2_LOW = float.fromhex("0x1.62e42fee00000p-1"), float.fromhex("0x1.a39ef35793c76p-33")
"""ln(2) in two parts; the first has so few digits that its multiples by whole numbers are exact."""
TERMS = 13
"""Of the series of exp on [-ln(2)/2, ln(2)/2]: its remainder is 4e-18."""
LARGEST = 700.0
"""Arguments of exp are held to this size: beyond are neither numbers nor zeros to compute with."""


def _power_of_two(k: ca.SX) -> ca.SX:
    """2^k of a whole number, |k| <= 1023, as a product of powers: pow would do, but bare targets
    have none.
    """
    left, power = ca.fabs(k), ca.SX(1.0)
    for bit in range(9, -1, -1):
        has = left >= 2**bit
        power = power * ca.if_else(has, 2.0 ** (2**bit), 1)
        left = left - ca.if_else(has, 2**bit, 0)
    return ca.SX(ca.if_else(k < 0, 1 / power, power))


def _parts(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(2^k, exp(r) - 1) of x = k ln(2) + r, |r| <= ln(2)/2; powers of two are exact everywhere."""
    held = ca.if_else(x > LARGEST, LARGEST, ca.if_else(x < -LARGEST, -LARGEST, x))
    k = ca.floor(held * (1 / math.log(2)) + 0.5)
    r = (held - k * LN2_HIGH) - k * LN2_LOW
    series = ca.SX(1.0)
    for n in range(TERMS, 1, -1):
        series = 1 + r * series * (1 / n)
    return _power_of_two(k), r * series


def _exp(x: ca.SX) -> ca.SX:
    power, rest = _parts(x)
    return power + power * rest


def _expm1(x: ca.SX) -> ca.SX:
    power, rest = _parts(x)
    return (power - 1) + power * rest


def _tanh(x: ca.SX) -> ca.SX:
    grown = _expm1(-2 * ca.fabs(x))
    value = -grown / (2 + grown)
    return ca.SX(ca.if_else(x < 0, -value, value))


NAME = "elementary"
"""Of the Functions that stand for them."""
_WRITTEN = {ca.OP_EXP: _exp, ca.OP_EXPM1: _expm1, ca.OP_TANH: _tanh}


@cache
def _replacement(code: int) -> ca.Function:
    """A Function that is called, not written out at each place: a step of a plant has dozens of
    exponentials, of 170 operations each, and compilers take more than their share for long code.
    """
    x = ca.SX.sym("x")
    return ca.Function(NAME, [x], [_WRITTEN[code](x)], {"cse": True})


def portable(function: ca.Function) -> ca.Function:
    """An SX Function whose exp, expm1 and tanh are sums and products, in Functions of their own;
    itself where it has none.

    Rounding differs from the C library's by some units in the last place; an argument that is not a
    number gives none.
    """
    return _rewritten(function, dict.fromkeys(_WRITTEN, _elementary))


def written_out(function: ca.Function) -> ca.Function:
    """An SX Function with what :func:`portable` calls written out, for those who read its
    instructions; itself where it calls anything else, such as tables.
    """
    codes = (function.instruction_id(k) for k in range(function.n_instructions()))
    calls = [k for k, code in enumerate(codes) if code == ca.OP_CALL]
    if not calls:
        return function
    nodes = function.instructions_sx()
    if any(nodes[k].which_function().name() != NAME for k in calls):
        return function
    return _rewritten(function, {ca.OP_CALL: _called})


def _elementary(node: ca.SX, x: ca.SX) -> ca.SX:
    return ca.SX(_replacement(node.op()).call([x], False, True)[0])


def _called(node: ca.SX, x: ca.SX) -> ca.SX:
    found: ca.SX = node.which_function().call([x], True, False)[0]
    return found


def _rewritten(
    function: ca.Function, other: Mapping[int, Callable[[ca.SX, ca.SX], ca.SX]]
) -> ca.Function:
    """The Function with (instruction, argument) -> expression in place of some operations; itself
    where it has none of them.
    """
    count = function.n_instructions()
    codes = [function.instruction_id(k) for k in range(count)]
    if not any(code in other for code in codes):
        return function
    nodes, arguments = function.instructions_sx(), function.sx_in()
    entries = [ca.vertsplit(a.nz[:]) if a.nnz() else [] for a in arguments]
    outputs: list[list[ca.SX]] = [
        [ca.SX(0.0)] * function.nnz_out(i) for i in range(function.n_out())
    ]
    work: list[ca.SX] = [ca.SX(0.0)] * function.sz_w()
    for k, code in enumerate(codes):
        from_, to = function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_INPUT:
            work[to[0]] = entries[from_[0]][from_[1]]
        elif code == ca.OP_OUTPUT:
            outputs[to[0]][to[1]] = work[from_[0]]
        elif code == ca.OP_CONST:
            work[to[0]] = ca.SX(function.instruction_constant(k))
        elif code in other:
            work[to[0]] = other[code](nodes[k], work[from_[0]])
        elif len(from_) == 1:
            work[to[0]] = ca.SX.unary(code, work[from_[0]])
        else:
            work[to[0]] = ca.SX.binary(code, *(work[i] for i in from_))
    results = [
        ca.SX(function.sparsity_out(i), ca.vertcat(*column))
        if column
        else ca.SX(*function.size_out(i))
        for i, column in enumerate(outputs)
    ]
    return ca.Function(function.name(), arguments, results, {"cse": True})
