"""CasADi expressions over arrays, by NumPy.

CasADi's ``map`` calls the expression once for each point; NumPy runs through all points
instruction by instruction, and what depends on one argument alone is computed at that argument's
size only. Values are the same to rounding.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.expressions import steps_of

Array: TypeAlias = NDArray[np.float64]
Operation: TypeAlias = Callable[..., Any]


COMMON: Mapping[str, Operation] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "sq": lambda a: a * a,
    "twice": lambda a: a + a,
    "inv": lambda a: 1.0 / a,
}
"""What Python's operators say in every library."""
NAMED = (
    *("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "floor", "ceil", "sign"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "log1p", "expm1"),
    *("fmod", "copysign", "atan2", "hypot"),
)
"""What libraries of arrays call as CasADi does; NumPy below 2 has arcsin for asin."""


def named(space: Any) -> dict[str, Operation]:
    """The functions of a library of arrays that are called as CasADi's."""
    return {n: getattr(space, n, None) or getattr(space, f"arc{n[1:]}") for n in NAMED}


def array_table(space: Any, missing: bool = False) -> dict[str, Operation]:
    """CasADi's operations by a library of arrays whose functions have NumPy's names.

    missing : NaN among the values is no number that is there, which fmin and fmax pass over, as in
        C; otherwise they share a slope between equal values, as CasADi does.
    """

    def truth(a: Any) -> Any:
        return a != 0

    def number(condition: Any) -> Any:
        return space.where(condition, 1.0, 0.0)

    return {
        **COMMON,
        **named(space),
        "lt": lambda a, b: number(a < b),
        "le": lambda a, b: number(a <= b),
        "eq": lambda a, b: number(a == b),
        "ne": lambda a, b: number(a != b),
        "not": lambda a: number(a == 0),
        "and": lambda a, b: number(truth(a) & truth(b)),
        "or": lambda a, b: number(truth(a) | truth(b)),
        "if_else_zero": lambda c, a: space.where(truth(c), a, 0.0),
        "fmin": space.fmin if missing else space.minimum,
        "fmax": space.fmax if missing else space.maximum,
        "fabs": space.abs,
        "remainder": lambda a, b: a - b * space.round(a / b),
    }


@cache
def _operations() -> dict[str, Operation]:
    def special(name: str) -> Operation:
        def call(x: Any) -> Any:
            import scipy.special

            return getattr(scipy.special, name)(x)

        return call

    own: dict[str, Operation] = {"pow": np.power, "constpow": np.power, "erf": special("erf")}
    own |= {"erfinv": special("erfinv"), "assign": lambda x: x, "lift": lambda x, _: x}
    table = array_table(np, missing=True) | own
    del table["remainder"]  # exact in CasADi alone
    return table


class Elementwise:
    """A CasADi function of SX, called with an array for each scalar input; they broadcast.

    Inputs are numbered through all arguments of the function, outputs through the nonzeros of all
    its results. What NumPy has no operation for is evaluated by CasADi, point by point.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        before = np.cumsum([0, *(function.nnz_in(i) for i in range(function.n_in()))])
        after = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))])
        self.inputs, self.outputs = int(before[-1]), int(after[-1])
        # every value gets a number of its own: inputs, constants, then what operations give
        self._constants: list[Any] = []
        self._steps: list[tuple[Operation, int, int]] = []
        """Operations, and the numbers of the one or two values (-1: none) that they take."""
        self._results = [-1] * self.outputs
        self._numpy = function.is_a("SXFunction") and self._traced(before, after)

    def _traced(self, before: Any, after: Any) -> bool:
        """Read the function's instructions; False where one is unknown."""
        known, steps = _operations(), list(steps_of(self._function))
        first = self.inputs + sum(step.name == "const" for step in steps)
        holds: dict[int, int] = {}  # place in CasADi's work vector -> number of its value
        for name, target, source, constant in steps:
            if name == "input":
                holds[target[0]] = int(before[source[0]]) + source[1]
            elif name == "const":
                holds[target[0]] = self.inputs + len(self._constants)
                self._constants.append(np.float64(constant))
            elif name == "output":
                self._results[int(after[target[0]]) + target[1]] = holds[source[0]]
            elif name in known:
                one, two = (*(holds[s] for s in source), -1)[:2]
                self._steps.append((known[name], one, two))
                holds[target[0]] = first + len(self._steps) - 1
            else:
                return False
        return True

    def __call__(self, *inputs: Any) -> list[Any]:
        """The outputs, each of the shape that the inputs it depends on broadcast to."""
        if len(inputs) != self.inputs:
            raise ValueError(f"{len(inputs)} inputs for {self.inputs}")
        if not self._numpy:
            return self._by_casadi(inputs)
        # floats of Python divide by no zero
        values = [*(np.asarray(i, float) for i in inputs), *self._constants]
        with np.errstate(all="ignore"):
            for operation, one, two in self._steps:
                if two < 0:
                    values.append(operation(values[one]))
                else:
                    values.append(operation(values[one], values[two]))
        return [values[i] for i in self._results]

    def _by_casadi(self, inputs: Sequence[Any]) -> list[Any]:
        arrays = np.broadcast_arrays(*(np.asarray(i, float) for i in inputs))
        shape, flat = arrays[0].shape, np.stack([a.ravel() for a in arrays])
        sizes = [self._function.nnz_in(i) for i in range(self._function.n_in())]
        parts = np.split(flat, np.cumsum(sizes)[:-1])
        arguments = [
            ca.DM(ca.repmat(self._function.sparsity_in(i), 1, flat.shape[1]), part.T.ravel())
            for i, part in enumerate(parts)
        ]
        found = self._function.map(flat.shape[1]).call(arguments)
        rows = [np.array(r.nonzeros()).reshape(flat.shape[1], -1).T for r in found]
        return [row.reshape(shape) for row in np.concatenate(rows)]


AT_ONCE = 4096
"""Columns of one pass: all intermediate values of these are kept at a time."""


class Columns:
    """One column of expressions at many columns of their arguments.

    A tenth to a fifth of the time of CasADi's own map and its conversions; what depends on shared
    arguments alone (parameters) is computed once. Values agree to rounding.
    """

    def __init__(self, arguments: Sequence[ca.SX], expression: ca.SX) -> None:
        """arguments : columns of symbols; expression : a column that depends on these alone."""
        dense = ca.densify(expression)
        self._function = Elementwise(ca.Function("columns", list(arguments), [dense]))
        self._kept = expression  # who looks it up by its nodes finds these

    def __call__(self, *arguments: Array) -> Array:
        """(rows, n) values; each argument is (size, n), or (size,) where all columns share it.

        One argument, at least, has columns.
        """
        n = max(a.shape[1] for a in arguments if a.ndim == 2)
        found = np.empty((self._function.outputs, n))
        for begin in range(0, n, AT_ONCE):
            part = slice(begin, min(begin + AT_ONCE, n))
            rows: list[Array] = []
            for a in arguments:
                rows += list(a[:, part] if a.ndim == 2 else a)
            for i, values in enumerate(self._function(*rows)):
                found[i, part] = values
        return found
