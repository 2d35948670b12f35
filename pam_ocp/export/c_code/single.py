"""A block's step in single precision, every operation rounded: what its C code gives on a target.

The operations of a step are hundreds of thousands. They are read once, sorted into layers, none of
whose operations needs another's result, and those of one kind in a layer are carried out at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.expressions import steps_of
from ...numerics.elementwise import array_table
from .generated import counted

Array: TypeAlias = NDArray[np.float64]
Single: TypeAlias = NDArray[np.float32]

BUDGET = 1_200_000
"""Operations that are carried out, at most (some seconds)."""

DRAWS = 8
"""Runs in single precision at once: the first as IEEE 754 rounds, in the others each result is off
by a unit in its last place or not, at random, unless it is whole (as other orders of sums and other
C libraries round)."""

POOL = 4093
"""Rows of random units, which come again in turn."""

_EXACT = {
    *("assign", "neg", "twice", "floor", "ceil", "fabs", "sign", "not", "lt", "le", "eq", "ne"),
    *("and", "or", "fmod", "copysign", "fmin", "fmax", "if_else_zero"),
}
_SINGLE: Mapping[str, Callable[..., Any]] = {
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
    layers = Layers.of(step)
    if layers is None:
        return None
    steps = min(len(inputs), BUDGET // layers.size)
    if steps < 1:
        return None
    memory, parameters = (_repeated(block.start(k)) for k in ("memory", "parameters"))
    rows = []
    for row in inputs[:steps]:
        memory, outputs = layers(memory, _repeated(row), parameters)
        rows.append(outputs.T)
    return np.stack(rows, axis=1).astype(float)


def _repeated(values: Any) -> Single:
    """Of each value a row of draws."""
    return np.repeat(np.asarray(values, np.float32)[:, None], DRAWS, axis=1)


# ---- operations in layers ------------------------------------------------------------------------
class _Group(NamedTuple):
    """Operations of one kind in a layer."""

    operation: Callable[..., Any]
    exact: bool
    begin: int
    """Of their values."""
    end: int
    arguments: tuple[NDArray[np.intp], ...]
    """The values that they take."""


class _Unknown(Exception):
    """An operation without an entry in the table."""


class _Values:
    """All values of a function: each has the number of its turn, its kind and its layer."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.layers: list[int] = []
        self.arguments: list[Sequence[int]] = []
        """The values that an operation takes."""
        self.constants: list[tuple[int, float]] = []
        self.zero = self._new("const", 0, ())

    def _new(self, kind: str, layer: int, arguments: Sequence[int]) -> int:
        self.kinds.append(kind)
        self.layers.append(layer)
        self.arguments.append(arguments)
        return len(self.kinds) - 1

    def entered(self, count: int) -> list[int]:
        """The entries of an argument."""
        return [self._new("input", 0, ()) for _ in range(count)]

    def read(self, function: ca.Function, given: Sequence[Sequence[int]]) -> list[list[int]]:
        """The entries of each result, from those of the arguments."""
        if not function.is_a("SXFunction"):
            raise _Unknown
        nodes, layers = function.instructions_sx(), self.layers
        holds: dict[int, int] = {}  # place in CasADi's work vector -> its value
        results = [[self.zero] * function.nnz_out(i) for i in range(function.n_out())]
        for k, (name, to, of, constant) in enumerate(steps_of(function)):
            if name == "input":
                holds[to[0]] = given[of[0]][of[1]]
            elif name == "output":
                results[to[0]][to[1]] = holds[of[0]]
            elif name == "const":
                holds[to[0]] = value = self._new(name, 0, ())
                self.constants.append((value, constant))
            elif name == "call":
                taken = [holds[i] for i in of]
                holds.update(zip(to, self._called(nodes[k].which_function(), taken), strict=True))
            elif name in _SINGLE:
                taken = [holds[i] for i in of]
                holds[to[0]] = self._new(name, 1 + max(layers[i] for i in taken), taken)
            else:
                raise _Unknown
        return results

    def _called(self, function: ca.Function, taken: Sequence[int]) -> list[int]:
        """All entries of its results, one after the other."""
        ends = np.cumsum([0, *(function.nnz_in(i) for i in range(function.n_in()))])
        given = [taken[i:j] for i, j in itertools.pairwise(ends)]
        return [value for result in self.read(function, given) for value in result]


def _factors(most: int) -> Single:
    """POOL rows of what results are multiplied by, and the first ``most`` of them once more."""
    units = np.random.default_rng(0).integers(-1, 2, (POOL, DRAWS)).astype(np.float32)
    units[:, 0] = 0  # not the first draw
    return np.resize(1 + units * np.finfo(np.float32).eps, (POOL + most, DRAWS))


class Layers:
    """A function of scalars in single precision, by draws (entries, DRAWS).

    ``size`` values are kept at a time, sorted by layers and by kinds in them.
    """

    def __init__(self, values: _Values, given: Sequence[int], results: list[list[int]]) -> None:
        self.size = len(values.kinds)
        code = np.unique(values.kinds, return_inverse=True)[1]
        layers = np.array(values.layers)
        order = np.lexsort((code, layers))
        place = np.empty(self.size, np.intp)
        place[order] = np.arange(self.size)
        self._given = place[list(given)]
        self._results = [place[np.array(r, np.intp)] for r in results]
        self._values: Single = np.zeros((self.size, DRAWS), np.float32)
        at = [i for i, _ in values.constants]
        with np.errstate(over="ignore"):  # what is too large for it is infinite
            self._values[place[at]] = _repeated([c for _, c in values.constants])
        ends = np.flatnonzero(np.diff(layers[order]) | np.diff(code[order])) + 1
        self._groups: list[_Group] = []
        for begin, end in itertools.pairwise([0, *ends.tolist(), self.size]):
            kind = values.kinds[order[begin]]
            if kind in _SINGLE:
                taken = place[np.array([values.arguments[i] for i in order[begin:end]])]
                columns = tuple(np.ascontiguousarray(column) for column in taken.T)
                self._groups.append(_Group(_SINGLE[kind], kind in _EXACT, begin, end, columns))
        self._factors = _factors(max((g.end - g.begin for g in self._groups), default=0))
        self._turn = 0

    @classmethod
    def of(cls, function: ca.Function) -> Layers | None:
        """None where it is not made of plain operations."""
        values = _Values()
        entries = [values.entered(function.nnz_in(i)) for i in range(function.n_in())]
        try:
            results = values.read(function, entries)
        except _Unknown:
            return None
        return cls(values, [i for entry in entries for i in entry], results)

    def __call__(self, *arguments: Single) -> list[Single]:
        """The results, each (entries, DRAWS); other units at random in each call."""
        values = self._values
        values[self._given] = np.concatenate(arguments)
        with np.errstate(all="ignore"):
            for operation, exact, begin, end, taken in self._groups:
                found = operation(*(values.take(i, axis=0) for i in taken))
                if not exact:
                    first = (begin + self._turn) % POOL
                    moved = found * self._factors[first : first + end - begin]
                    found = np.where(found == np.rint(found), found, moved)
                values[begin:end] = found
        self._turn += self.size
        return [values[i] for i in self._results]
