"""One walk over the instructions of a CasADi function, for every world that computes with arrays.

CasADi keeps a function of scalars as a list of elementary operations. A world gives a table of what
each of them is there; :meth:`Instructions.run` puts its values through the list.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca

from ...core.errors import ExportError
from ...numerics.portable import written_out

__all__ = ["OPERATIONS", "Instructions", "Operation", "Table", "array_table", "instructions"]

Operation: TypeAlias = Callable[..., Any]
Table: TypeAlias = Mapping[str, Operation]
"""{name of an operation, as CasADi has it without OP_ and in small letters: what it is}."""

COMMON: Table = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "sq": lambda a: a * a,
    "twice": lambda a: a + a,
    "inv": lambda a: 1.0 / a,
}
"""What Python's operators say in every world."""
NAMED = (
    *("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "floor", "ceil", "sign"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "log1p", "expm1"),
    *("fmod", "copysign", "atan2", "hypot"),
)
"""What array libraries call as CasADi does."""
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

_NAMES = {getattr(ca, n): n[3:].lower() for n in dir(ca) if n.startswith("OP_")}
_SAME = ("assign", "lift")
_KNOWN = frozenset((*OPERATIONS, *_SAME, "const", "input", "output"))


def array_table(space: Any, missing: bool = False) -> dict[str, Operation]:
    """The operations by a library of arrays whose functions have NumPy's names.

    missing : NaN among the values is no number that is there, which fmin and fmax pass over, as in
        C; otherwise they share a slope between equal values, as CasADi does.
    """

    def truth(a: Any) -> Any:
        return a != 0

    def number(condition: Any) -> Any:
        return space.where(condition, 1.0, 0.0)

    table: dict[str, Operation] = {**COMMON, **{n: getattr(space, n) for n in NAMED}}
    return table | {
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


@dataclass(frozen=True)
class Instructions:
    """A function of dense columns as a list of operations on scalars.

    steps : (name, where the value goes, where its arguments stand). Of an input the arguments are
        (argument, entry), of an output the place is (result, entry) as ``targets`` says.
    constants : {number of a step: its value}.
    sizes : lengths of the results.
    """

    name: str
    steps: tuple[tuple[str, int, tuple[int, ...]], ...]
    constants: Mapping[int, float]
    targets: Mapping[int, tuple[int, int]]
    sizes: tuple[int, ...]

    def run(
        self,
        table: Table,
        arguments: Sequence[Callable[[int], Any]],
        constant: Callable[[float], Any] = float,
    ) -> list[list[Any]]:
        """The entries of each result.

        arguments : of each argument, what gives the entry of a number. constant : makes a value of
        a number.
        """
        work: dict[int, Any] = {}
        results: list[list[Any]] = [[constant(0.0)] * n for n in self.sizes]
        for k, (name, place, inputs) in enumerate(self.steps):
            if name == "const":
                work[place] = constant(self.constants[k])
            elif name == "input":
                work[place] = arguments[inputs[0]](inputs[1])
            elif name == "output":
                result, entry = self.targets[k]
                results[result][entry] = work[inputs[0]]
            elif name in _SAME:
                work[place] = work[inputs[0]]
            else:
                work[place] = table[name](*(work[i] for i in inputs))
        return results


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
    steps, constants, targets = [], {}, {}
    for k in range(count):
        name = _NAMES.get(function.instruction_id(k), "unknown")
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if name not in _KNOWN:
            raise _refusal(what, f"the operation {name!r}")
        if name == "const":
            constants[k] = float(function.instruction_constant(k))
        if name == "output":
            targets[k] = (outputs[0], outputs[1])
        steps.append((name, -1 if name == "output" else outputs[0], tuple(inputs)))
    sizes = tuple(function.numel_out(i) for i in range(function.n_out()))
    return Instructions(function.name(), tuple(steps), constants, targets, sizes)


def _scalar(function: ca.Function, what: str, cse: bool) -> ca.Function:
    """The function in scalars, with dense results."""
    symbols = [ca.SX.sym(f"a{i}", function.numel_in(i)) for i in range(function.n_in())]
    shapes = [function.size_in(i) for i in range(function.n_in())]
    shaped = [ca.reshape(s, *shape) for s, shape in zip(symbols, shapes, strict=True)]
    try:
        results = (
            function.call(shaped) if function.is_a("SXFunction") else _expanded(function, shaped)
        )
    except RuntimeError as error:  # of CasADi
        raise _refusal(what, _reason(error)) from None
    dense = [ca.vec(ca.densify(r)) for r in results]
    return written_out(ca.Function(function.name(), symbols, ca.cse(dense) if cse else dense))


def _expanded(function: ca.Function, arguments: Sequence[ca.SX]) -> list[ca.SX]:
    return list(function.expand().call(list(arguments)))


def _reason(error: RuntimeError) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].rpartition(": ")[2] if lines else "an unknown part"


def _refusal(what: str, because: str) -> ExportError:
    return ExportError(
        f"{what} holds what is no formula of scalars ({because}): a function of compiled code, an "
        "interpolant or a search; write it as a formula, or export the plant as an FMU"
    )
