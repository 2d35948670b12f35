"""A scalar CasADi expression over arrays, by NumPy.

CasADi's ``map`` calls the expression once for each point; NumPy runs through all points
instruction by instruction, and what depends on one argument alone is computed at that argument's
size only. Values are the same to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

__all__ = ["Elementwise"]

Array: TypeAlias = NDArray[np.float64]
Operation: TypeAlias = Callable[..., Any]


def _number(comparison: Operation) -> Operation:
    """CasADi's comparisons give 0 and 1."""
    return lambda *arguments: np.asarray(comparison(*arguments), dtype=float)


def _special(name: str) -> Operation:
    def call(x: Any) -> Any:
        import scipy.special

        return getattr(scipy.special, name)(x)

    return call


@cache
def _operations() -> dict[int, Operation]:
    return {
        ca.OP_ADD: np.add,
        ca.OP_SUB: np.subtract,
        ca.OP_MUL: np.multiply,
        ca.OP_DIV: np.divide,
        ca.OP_NEG: np.negative,
        ca.OP_SQ: np.square,
        ca.OP_TWICE: lambda x: 2 * x,
        ca.OP_INV: np.reciprocal,
        ca.OP_POW: np.power,
        ca.OP_CONSTPOW: np.power,
        ca.OP_SQRT: np.sqrt,
        ca.OP_EXP: np.exp,
        ca.OP_EXPM1: np.expm1,
        ca.OP_LOG: np.log,
        ca.OP_LOG1P: np.log1p,
        ca.OP_SIN: np.sin,
        ca.OP_COS: np.cos,
        ca.OP_TAN: np.tan,
        ca.OP_ASIN: np.arcsin,
        ca.OP_ACOS: np.arccos,
        ca.OP_ATAN: np.arctan,
        ca.OP_ATAN2: np.arctan2,
        ca.OP_SINH: np.sinh,
        ca.OP_COSH: np.cosh,
        ca.OP_TANH: np.tanh,
        ca.OP_ASINH: np.arcsinh,
        ca.OP_ACOSH: np.arccosh,
        ca.OP_ATANH: np.arctanh,
        ca.OP_HYPOT: np.hypot,
        ca.OP_ERF: _special("erf"),
        ca.OP_ERFINV: _special("erfinv"),
        ca.OP_FABS: np.abs,
        ca.OP_SIGN: np.sign,
        ca.OP_COPYSIGN: np.copysign,
        ca.OP_FLOOR: np.floor,
        ca.OP_CEIL: np.ceil,
        ca.OP_FMOD: np.fmod,
        ca.OP_FMIN: np.fmin,
        ca.OP_FMAX: np.fmax,
        ca.OP_LT: _number(np.less),
        ca.OP_LE: _number(np.less_equal),
        ca.OP_EQ: _number(np.equal),
        ca.OP_NE: _number(np.not_equal),
        ca.OP_NOT: _number(np.logical_not),
        ca.OP_AND: _number(np.logical_and),
        ca.OP_OR: _number(np.logical_or),
        ca.OP_IF_ELSE_ZERO: lambda condition, x: np.where(condition != 0, x, 0.0),
        ca.OP_ASSIGN: lambda x: x,
        ca.OP_LIFT: lambda x, _: x,
    }


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
        self._constants: list[float] = []
        self._steps: list[tuple[Operation, int, int]] = []
        """Operations, and the numbers of the one or two values (-1: none) that they take."""
        self._results = [-1] * self.outputs
        self._numpy = function.is_a("SXFunction") and self._traced(before, after)

    def _traced(self, before: Any, after: Any) -> bool:
        """Read the function's instructions; False where one is unknown."""
        function, known = self._function, _operations()
        codes = [function.instruction_id(k) for k in range(function.n_instructions())]
        first = self.inputs + codes.count(ca.OP_CONST)
        holds: dict[int, int] = {}  # place in CasADi's work vector -> number of its value
        for k, code in enumerate(codes):
            source, target = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_INPUT:
                holds[target[0]] = int(before[source[0]]) + source[1]
            elif code == ca.OP_CONST:
                holds[target[0]] = self.inputs + len(self._constants)
                self._constants.append(function.instruction_constant(k))
            elif code == ca.OP_OUTPUT:
                self._results[int(after[target[0]]) + target[1]] = holds[source[0]]
            elif code in known:
                one, two = (*(holds[s] for s in source), -1)[:2]
                self._steps.append((known[code], one, two))
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
        values = [*inputs, *self._constants]
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
