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

from ..core.expressions import SYMBOLIC, carried_out, steps_of

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
_WRITTEN = {"exp": _exp, "expm1": _expm1, "tanh": _tanh}


@cache
def _replacement(name: str) -> ca.Function:
    """A Function that is called, not written out at each place: a step of a plant has dozens of
    exponentials, of 170 operations each, and compilers take more than their share for long code.
    """
    x = ca.SX.sym("x")
    return ca.Function(NAME, [x], [_WRITTEN[name](x)], {"cse": True})


def portable(function: ca.Function) -> ca.Function:
    """An SX Function whose exp, expm1 and tanh are sums and products, in Functions of their own;
    itself where it has none.

    Rounding differs from the C library's by some units in the last place; an argument that is not a
    number gives none.
    """

    def called(name: str) -> Callable[[ca.SX], ca.SX]:
        return lambda x: _replacement(name).call([x], False, True)[0]

    return _rewritten(function, {name: called(name) for name in _WRITTEN})


def written_out(function: ca.Function) -> ca.Function:
    """An SX Function with what :func:`portable` calls written out, for those who read its
    instructions; itself where it calls anything else, such as tables.
    """
    calls = [k for k, step in enumerate(steps_of(function)) if step.name == "call"]
    if not calls:
        return function
    nodes = function.instructions_sx()
    called = [nodes[k].which_function() for k in calls]
    if any(inner.name() != NAME for inner in called):
        return function
    ahead = iter(called)  # they are met in this order
    return _rewritten(function, {"call": lambda x: next(ahead).call([x], True, False)[0]})


def _rewritten(function: ca.Function, other: Mapping[str, Callable[[ca.SX], ca.SX]]) -> ca.Function:
    """The Function with other expressions in place of some operations; itself where it has none of
    them.
    """
    steps = list(steps_of(function))
    if not any(step.name in other for step in steps):
        return function
    arguments = function.sx_in()
    entries = [ca.vertsplit(a.nz[:]) if a.nnz() else [] for a in arguments]
    sizes = [function.nnz_out(i) for i in range(function.n_out())]
    columns = carried_out(
        steps, {**SYMBOLIC, **other}, [e.__getitem__ for e in entries], sizes, ca.SX
    )
    results = [
        ca.SX(function.sparsity_out(i), ca.vertcat(*column))
        if column
        else ca.SX(*function.size_out(i))
        for i, column in enumerate(columns)
    ]
    return ca.Function(function.name(), arguments, results, {"cse": True})
