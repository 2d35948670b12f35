"""CasADi functions on fixed memory: a call copies its arguments and makes nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


class Buffered:
    """A function with dense arguments and results; a plain call costs 30 times as much around it.

    ``results`` are matrices as views of the memory that the next call writes to. arguments : memory
    from which it reads, by default its own.
    """

    def __init__(self, function: ca.Function, arguments: Sequence[Array] = ()) -> None:
        self._buffer, self.call = function.buffer()
        """Evaluates at what stands in ``arguments``."""
        own = (np.zeros(function.nnz_in(i)) for i in range(function.n_in()))
        self.arguments = list(arguments or own)
        self._memory = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.arguments):
            self._buffer.set_arg(i, memoryview(array))  # type: ignore
        for i, array in enumerate(self._memory):
            self._buffer.set_res(i, memoryview(array))  # type: ignore
        self.results: list[Array] = [
            m.reshape(function.size2_out(i), function.size1_out(i)).T
            for i, m in enumerate(self._memory)
        ]

    def __call__(self, *arguments: Any) -> list[Array]:
        """The results for these arguments (vectors, or matrices column by column)."""
        for own, given in zip(self.arguments, arguments, strict=True):
            own[:] = given
        self.call()
        return self.results
