"""One walk over the instructions of a CasADi function, for every world that computes with arrays.

CasADi keeps a function of scalars as a list of elementary operations. A world gives a table of what
each of them is there; :meth:`Instructions.run` puts its values through the list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca

from ...core.errors import ExportError
from ...core.expressions import Step, carried_out, steps_of
from ...numerics.elementwise import COMMON, NAMED
from ...numerics.portable import written_out

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
