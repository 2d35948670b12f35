"""Loops of CasADi Functions that end early after a bounded number of turns: C without heap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

FLAT = 20
"""Calls in a row that are written one after another."""


def repeated(
    body: ca.Function, carried: int, count: int, wanted: ca.MX, symbols: Sequence[ca.MX]
) -> ca.Function:
    """At most ``count`` calls of ``body`` (carried..., constants...) -> carried..., each only while
    ``wanted`` (of ``symbols``, the carried) holds. Many calls are nested, so that C code stays
    short; each level takes memory for what it hands on.
    """
    arguments = [ca.MX.sym(f"a{k}", body.sparsity_in(k)) for k in range(body.n_in())]
    still = ca.Function("still", list(symbols), [wanted])
    stay = ca.Function("stay", arguments, arguments[:carried])

    def chain(part: ca.Function, times: int, now: list[ca.MX]) -> list[ca.MX]:
        """So many calls in turn, each only while wanted."""
        either = ca.Function.if_else("while", part, stay)
        for _ in range(times):
            now = [*either.call([still(*now[:carried]), *now]), *now[carried:]]
        return now

    full, rest = divmod(count, FLAT)
    now = arguments
    if full > 1:
        part = ca.Function("chain", arguments, chain(body, FLAT, arguments)[:carried])
        now = chain(part, full, now)
    elif full:
        rest += FLAT
    return ca.Function("chain", arguments, chain(body, rest, now)[:carried])


def inlined(function: ca.Function, arguments: Sequence[Any]) -> list[ca.MX]:
    """The results of a call written out where it stands, which takes no memory of its own."""
    return list(function.call(list(arguments), True, False))
