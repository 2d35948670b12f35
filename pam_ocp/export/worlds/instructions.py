"""What every world of arrays shares: one walk over the instructions of a CasADi function, and the
names, numbers and functions of a plant or a block.

CasADi keeps a function of scalars as a list of elementary operations. A world gives a table of what
each of them is there; :meth:`Instructions.run` puts its values through the list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.errors import ExportError, InputError, UnknownNameError
from ...core.expressions import Step, carried_out, steps_of
from ...core.variables import Variable
from ...numerics.elementwise import COMMON, NAMED
from ...numerics.portable import written_out
from ...plants.plant import Plant

Operation: TypeAlias = Callable[..., Any]
Table: TypeAlias = Mapping[str, Operation]
"""{name of an operation, as CasADi has it without OP_ and in small letters: what it is}."""

OPERATIONS = (
    *COMMON,
    *NAMED,
    *("lt", "le", "eq", "ne", "not", "and", "or", "if_else_zero", "fmin", "fmax", "fabs"),
    *("pow", "constpow", "remainder", "erf", "erfinv"),
)
"""All that a table has: if_else_zero(c, a) is a where c is not 0, else 0; comparisons give 1 or 0.
"""

LONGEST = 200_000
"""Operations beyond which a function is refused: other worlds would compile for hours."""

_SAME: Table = {"assign": lambda a: a, "lift": lambda a, _: a}
_KNOWN = frozenset((*OPERATIONS, *_SAME, "const", "input", "output"))


@dataclass(frozen=True)
class Instructions:
    """A function of dense columns as a list of operations on scalars. sizes : of the results."""

    name: str
    steps: tuple[Step, ...]
    sizes: tuple[int, ...]

    def run(
        self,
        table: Table,
        arguments: Sequence[Callable[[int], Any]],
        constant: Callable[[float], Any] = float,
    ) -> list[list[Any]]:
        """The entries of each result; see :func:`pam_ocp.core.expressions.carried_out`."""
        return carried_out(self.steps, {**_SAME, **table}, arguments, self.sizes, constant)


def instructions(function: ca.Function, what: str, cse: bool = True) -> Instructions:
    """The operations of a CasADi function, its inner functions written out.

    what : it is, for the message. Raises ExportError where it cannot be written as operations on
    scalars (it calls compiled code, or looks for a root), and where they are too many.
    """
    function = _scalar(function, what, cse)
    count = function.n_instructions()
    if count > LONGEST:
        raise ExportError(
            f"{what} is {count} operations long, more than {LONGEST}: other worlds would compile "
            "for hours; export it as an FMU or as C code"
        )
    steps = tuple(steps_of(function))
    for step in steps:
        if step.name not in _KNOWN:
            raise _refusal(what, f"the operation {step.name!r}")
    sizes = tuple(function.numel_out(i) for i in range(function.n_out()))
    return Instructions(function.name(), steps, sizes)


def _scalar(function: ca.Function, what: str, cse: bool) -> ca.Function:
    """The function in scalars, with dense results."""
    symbols = [ca.SX.sym(f"a{i}", function.numel_in(i)) for i in range(function.n_in())]
    shapes = [function.size_in(i) for i in range(function.n_in())]
    shaped = [ca.reshape(s, *shape) for s, shape in zip(symbols, shapes, strict=True)]
    try:
        scalar = function if function.is_a("SXFunction") else function.expand()
        results = scalar.call(shaped)
    except RuntimeError as error:  # of CasADi
        raise _refusal(what, _reason(error)) from None
    dense = [ca.vec(ca.densify(r)) for r in results]
    return written_out(ca.Function(function.name(), symbols, ca.cse(dense) if cse else dense))


def _reason(error: RuntimeError) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].rpartition(": ")[2] if lines else "an unknown part"


def _refusal(what: str, because: str) -> ExportError:
    return ExportError(
        f"{what} holds what is no formula of scalars ({because}): a function of compiled code, an "
        "interpolant or a search; write it as a formula, or export the plant as an FMU"
    )


# ---- a plant or a block -------------------------------------------------------------------------
@dataclass(frozen=True)
class Signature:
    """Names in the order of the columns, and start values [SI], of a plant or a block."""

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    x0: NDArray[np.float64]
    u0: NDArray[np.float64]
    p0: NDArray[np.float64]
    nominal: NDArray[np.float64]

    def values(self, p: Any) -> list[Any]:
        """Parameters in their order: of a mapping by name (others at their values), an array, None.

        Raises UnknownNameError for a name that is no parameter, InputError for a wrong length.
        """
        if p is None or isinstance(p, Mapping):
            given: Mapping[str, Any] = p or {}
            for name in given:
                if name not in self.parameters:
                    raise UnknownNameError("parameter", name, self.parameters)
            pairs = zip(self.parameters, self.p0, strict=True)
            return [given[n] if n in given else float(v) for n, v in pairs]
        return self.entries("p", p, len(self.parameters))

    def groups(
        self, x: Any, u: Any, p: Any, names: tuple[str, str] = ("x", "u")
    ) -> tuple[list[Any], list[Any], list[Any]]:
        """States, inputs and parameters, each entry by entry."""
        return (
            self.entries(names[0], x, len(self.states)),
            self.entries(names[1], u, len(self.inputs)),
            self.values(p),
        )

    def entries(self, what: str, values: Any, length: int) -> list[Any]:
        """The entries along the last axis. Raises InputError where there are not so many."""
        shape = tuple(getattr(values, "shape", ()))
        if not shape or shape[-1] != length:
            raise InputError(
                f"{what} has shape {shape}; its last axis must have the {length} entries of "
                f"{self.name}"
            )
        return [values[..., i] for i in range(length)]


def _names(variables: Sequence[Variable]) -> tuple[str, ...]:
    return tuple(v.name for v in variables)


def signature(system: Plant | Block) -> Signature:
    """Of a plant, or of a block, whose memory takes the place of states."""
    states = system.memory if isinstance(system, Block) else system.states
    groups = (states, system.inputs, system.parameters)
    x0, u0, p0 = (np.array([v.start or 0.0 for v in group]) for group in groups)
    return Signature(
        system.name,
        _names(states),
        _names(system.inputs),
        _names(system.outputs),
        _names(system.parameters),
        x0,
        u0,
        p0,
        np.array([v.nominal for v in states]),
    )


def plant_programs(plant: Plant) -> tuple[Instructions, Instructions]:
    """x' and y of (x, u, p)."""
    arguments = [plant.x, plant.u, plant.p]
    xdot, y, _ = plant.function(*arguments)
    made = (ca.Function(n, arguments, [e]) for n, e in (("xdot", xdot), ("outputs", y)))
    return tuple(instructions(f, f"plant {plant.name!r}") for f in made)  # type: ignore[return-value]


def block_program(block: Block) -> Instructions:
    """(memory, outputs) of (memory, inputs, parameters)."""
    return instructions(block.step, f"block {block.name!r}")


REACH = 2.5
"""Longest step in time constants of the quickest motion that decays: the border of RK4 is 2.785,
that of Euler's method 2."""


def quickest(plant: Plant, u: NDArray[np.float64]) -> float:
    """The rate [1/s] of the quickest motion that decays, at the start under these inputs."""
    a = np.array(plant.jacobians(plant.vector("state"), u, plant.vector("parameter"))[0])
    poles = np.linalg.eigvals(a) if np.all(np.isfinite(a)) else np.zeros(1)
    return float(np.max(np.abs(poles[poles.real < 0]), initial=0.0))
