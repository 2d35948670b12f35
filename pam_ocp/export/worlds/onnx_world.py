"""A plant or a controller as an ONNX model: one node for each operation, rows for batches."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from ... import __version__
from ...core.atomic import atomic_path
from ...core.block import Block
from ...core.errors import ExportError, InputError
from ...core.lazy import library
from ...core.stop import verb
from ...plants.plant import Plant, require_plant
from ..sampled import as_block
from .instructions import Instructions, Table
from .registry import ENDINGS, WORLDS
from .signature import Signature, block_program, plant_programs, signature

Precision = Literal["double", "single"]
OPSET, IR = 18, 10
PLAIN = {
    **{"add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "neg": "Neg", "fabs": "Abs"},
    **{"exp": "Exp", "log": "Log", "sqrt": "Sqrt", "sin": "Sin", "cos": "Cos", "tanh": "Tanh"},
    **{"floor": "Floor", "ceil": "Ceil", "sign": "Sign", "fmin": "Min", "fmax": "Max"},
    **{"inv": "Reciprocal", "pow": "Pow", "constpow": "Pow"},
}
"""Operations that ONNX has, and that its runtime computes in double precision."""


@verb
def to_onnx(
    system: Plant | Block | Any, path: str | os.PathLike[str], *, precision: Precision = "double"
) -> Path:
    """Write a plant, or a block such as a controller, as an ONNX model; returns its path.

    A plant's model takes ``x`` (N, nx), ``u`` (N, nu), ``p`` (N or 1, np) and gives ``xdot`` and
    ``y``; a block's takes ``memory``, ``inputs``, ``p`` and gives ``memory_next`` and ``outputs``:
    rows of a batch, columns in the order that the model's metadata name, all in SI. ``p`` is what
    the system has as parameters; their values stand in the metadata, too.

    precision : "double", or "single" for targets that have no other.

    Raises InputError where onnx is missing, ExportError for what is no formula (docs/worlds.md).

    Examples
    --------
    >>> pam.export.to_onnx(plant, "load.onnx").name  # doctest: +SKIP
    'load.onnx'
    """
    onnx = library("onnx", "onnx", "to_onnx")
    if precision not in get_args(Precision):
        raise InputError(f"precision = {precision!r}: choose 'double' or 'single'")
    block = as_block(system)
    if block is not None:
        own, programs = signature(block), [block_program(block)]
        ends = ("memory", "inputs", "p"), ("memory_next", "outputs")
    else:
        plant = require_plant(system)
        own, programs = signature(plant), list(plant_programs(plant))
        ends = ("x", "u", "p"), ("xdot", "y")
    model = _model(own, programs, *ends, precision)
    onnx.checker.check_model(model, full_check=True)
    with atomic_path(path) as file:
        file.write_bytes(model.SerializeToString())
    return Path(path)


WORLDS.register("onnx")(to_onnx)
ENDINGS[".onnx"] = "onnx"


def _model(
    own: Signature,
    programs: Sequence[Instructions],
    arguments: Sequence[str],
    results: Sequence[str],
    precision: Precision,
) -> Any:
    from onnx import helper

    graph = _Graph(precision == "double")
    groups = zip(arguments, (own.states, own.inputs, own.parameters), strict=True)
    columns = {name: len(names) for name, names in groups}
    entries = [graph.split(name, n) for name, n in columns.items()]
    rows = graph.rows([name for name, n in columns.items() if n])
    made = [
        column
        for program in programs
        for column in program.run(graph.table(), entries, graph.constant)
    ]
    for name, column in zip(results, made, strict=True):
        graph.join(name, column, rows)

    def value(name: str, n: int) -> Any:
        return helper.make_tensor_value_info(name, graph.kind, ["rows_of_" + name, n])

    inputs = [value(name, n) for name, n in columns.items() if n]
    outputs = [value(name, len(column)) for name, column in zip(results, made, strict=True)]
    built = helper.make_graph(graph.nodes, own.name, inputs, outputs, graph.initializers)
    model = helper.make_model(
        built,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR,
        producer_name="pam_ocp",
        producer_version=__version__,
    )
    told = dict(zip(arguments, (own.states, own.inputs, own.parameters), strict=True))
    told |= {results[0]: own.states, results[1]: own.outputs}
    numbers = zip(("start", "u_start", "p_start"), (own.x0, own.u0, own.p0), strict=True)
    helper.set_model_props(
        model,
        {name: ",".join(names) for name, names in told.items()}
        | {name: ",".join(repr(float(v)) for v in values) for name, values in numbers},
    )
    return model


class _Graph:
    """Nodes under way; a value is its name."""

    def __init__(self, double: bool) -> None:
        from onnx import TensorProto

        self.double = double
        self.kind = TensorProto.DOUBLE if double else TensorProto.FLOAT
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self._known: dict[tuple[Any, ...], str] = {}

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """One operation; the same one stands once."""
        from onnx import helper

        key = (kind, inputs, tuple(sorted(attributes.items())))
        if key not in self._known:
            self._known[key] = f"v{len(self._known)}"
            name = self._known[key]
            self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return self._known[key]

    def constant(self, value: float) -> str:
        return self._stored(np.array(value, np.float64 if self.double else np.float32))

    def _stored(self, value: Any) -> str:
        from onnx import numpy_helper

        key = ("constant", value.tobytes(), str(value.dtype), value.shape)
        if key not in self._known:
            self._known[key] = f"c{len(self._known)}"
            self.initializers.append(numpy_helper.from_array(value, self._known[key]))
        return self._known[key]

    # ---- columns ------------------------------------------------------------------------------
    def split(self, name: str, count: int) -> Callable[[int], str]:
        """What gives the columns (N, 1) of an input."""

        def column(i: int) -> str:
            return self.node("Gather", name, self._stored(np.array([i])), axis=1)

        return column

    def rows(self, inputs: Sequence[str]) -> str:
        """Zeros (N, 1) of the batch, for results that hang on no input."""
        zeros = [self.node("Mul", self.split(name, 1)(0), self.constant(0.0)) for name in inputs]
        total = zeros[0]
        for zero in zeros[1:]:
            total = self.node("Add", total, zero)
        shape = self.node("Shape", total)
        return shape

    def join(self, name: str, column: Sequence[str], rows: str) -> None:
        """The columns side by side as an output."""
        from onnx import helper

        wide = [self.node("Expand", entry, rows) for entry in column]
        if wide:
            self.nodes.append(helper.make_node("Concat", wide, [name], axis=1))
            return
        none = self._stored(np.zeros(0, np.int64))
        some = self.node("Expand", self.constant(0.0), rows)
        self.nodes.append(helper.make_node("Gather", [some, none], [name], axis=1))

    # ---- operations ---------------------------------------------------------------------------
    def table(self) -> Table:
        """All operations, by nodes that the runtime has in double precision."""
        node, constant = self.node, self.constant

        def plain(kind: str) -> Callable[..., str]:
            return lambda *inputs: node(kind, *inputs)

        def number(condition: str) -> str:
            return node("Cast", condition, to=self.kind)

        def compared(kind: str) -> Callable[[str, str], str]:
            return lambda a, b: number(node(kind, a, b))

        def truth(a: str) -> str:
            return node("Not", node("Equal", a, constant(0.0)))

        def joined(kind: str) -> Callable[[str, str], str]:
            return lambda a, b: number(node(kind, truth(a), truth(b)))

        own = {name: plain(kind) for name, kind in PLAIN.items()}
        own |= {"lt": compared("Less"), "le": compared("LessOrEqual"), "eq": compared("Equal")}
        own |= {"and": joined("And"), "or": joined("Or")}
        own |= {
            "sq": lambda a: node("Mul", a, a),
            "twice": lambda a: node("Add", a, a),
            "ne": lambda a, b: number(node("Not", node("Equal", a, b))),
            "not": lambda a: number(node("Equal", a, constant(0.0))),
            "if_else_zero": lambda c, a: node("Where", truth(c), a, constant(0.0)),
        }
        return own | _composed(own, self)


def _composed(o: dict[str, Callable[..., str]], graph: _Graph) -> dict[str, Callable[..., str]]:
    """What ONNX, or its runtime in double precision, does not have, made of what it has."""
    number = graph.constant

    def where(condition: str, a: str, b: str) -> str:
        return graph.node("Where", graph.node("Cast", condition, to=9), a, b)

    def half(a: str) -> str:
        return o["mul"](number(0.5), a)

    def sinh(a: str) -> str:
        small, e = o["lt"](o["fabs"](a), number(1.0)), expm1(a)
        exact = half(o["add"](e, o["div"](e, o["add"](e, number(1.0)))))
        return where(small, exact, half(o["sub"](o["exp"](a), o["exp"](o["neg"](a)))))

    def cosh(a: str) -> str:
        return half(o["add"](o["exp"](a), o["exp"](o["neg"](a))))

    def expm1(a: str) -> str:
        # tanh(a/2) = (e^a - 1)/(e^a + 1)
        near = o["mul"](o["tanh"](half(a)), o["add"](o["exp"](a), number(1.0)))
        far = o["sub"](o["exp"](a), number(1.0))
        return where(o["lt"](o["fabs"](a), number(1.0)), near, far)

    def log1p(a: str) -> str:
        # W. Kahan: the error of 1 + a is taken back
        whole = o["add"](number(1.0), a)
        rest = o["sub"](whole, number(1.0))
        same = o["eq"](rest, number(0.0))
        safe = where(same, number(1.0), rest)
        return where(same, a, o["mul"](o["log"](whole), o["div"](a, safe)))

    def tan(a: str) -> str:
        return o["div"](o["sin"](a), o["cos"](a))

    def atan(a: str) -> str:
        if not graph.double:
            return graph.node("Atan", a)
        # single precision, then what is missing: atan(a) - y = atan((a - tan y)/(1 + a tan y))
        y = graph.node("Cast", graph.node("Atan", graph.node("Cast", a, to=1)), to=11)
        sine, cosine = o["sin"](y), o["cos"](y)
        missing = o["div"](o["sub"](o["mul"](a, cosine), sine), o["add"](cosine, o["mul"](a, sine)))
        return o["add"](y, missing)

    def asin(a: str) -> str:
        root = o["sqrt"](o["mul"](o["sub"](number(1.0), a), o["add"](number(1.0), a)))
        return o["twice"](atan(o["div"](a, o["add"](number(1.0), root))))

    def atan2(y: str, x: str) -> str:
        # 2 atan(y/(|(x, y)| + x)) right of the axis, turned by half a turn left of it
        left = o["lt"](x, number(0.0))
        length = o["add"](hypot(x, y), o["fabs"](x))
        none = o["eq"](length, number(0.0))
        right = o["twice"](atan(o["div"](y, where(none, number(1.0), length))))
        return where(left, o["sub"](copysign(number(np.pi), y), right), right)

    def hypot(a: str, b: str) -> str:
        size = o["fmax"](o["fabs"](a), o["fabs"](b))
        safe = where(o["eq"](size, number(0.0)), number(1.0), size)
        parts = o["sq"](o["div"](a, safe)), o["sq"](o["div"](b, safe))
        return o["mul"](size, o["sqrt"](o["add"](*parts)))

    def copysign(a: str, b: str) -> str:
        negative = o["or"](
            o["lt"](b, number(0.0)), o["lt"](o["inv"](b), number(0.0))
        )  # 1/-0 is -inf
        return where(negative, o["neg"](o["fabs"](a)), o["fabs"](a))

    def asinh(a: str) -> str:
        size = o["fabs"](a)
        root = o["sqrt"](o["add"](o["sq"](size), number(1.0)))
        more = o["add"](size, o["div"](o["sq"](size), o["add"](number(1.0), root)))
        return o["mul"](o["sign"](a), log1p(more))

    def acosh(a: str) -> str:
        b = o["sub"](a, number(1.0))
        return log1p(o["add"](b, o["sqrt"](o["add"](o["twice"](b), o["sq"](b)))))

    def atanh(a: str) -> str:
        return half(log1p(o["div"](o["twice"](a), o["sub"](number(1.0), a))))

    def remainder(a: str, b: str) -> str:
        return o["sub"](a, o["mul"](b, graph.node("Round", o["div"](a, b))))

    def erf(a: str) -> str:
        if graph.double:
            raise ExportError(
                "to_onnx: the error function is there in single precision alone; give "
                "precision='single'"
            )
        return graph.node("Erf", a)

    def erfinv(a: str) -> str:
        raise ExportError("to_onnx: ONNX has no inverse of the error function; write it otherwise")

    return {
        "sinh": sinh,
        "cosh": cosh,
        "tan": tan,
        "atan": atan,
        "asin": asin,
        "acos": lambda a: o["sub"](number(np.pi / 2), asin(a)),
        "atan2": atan2,
        "asinh": asinh,
        "acosh": acosh,
        "atanh": atanh,
        "log1p": log1p,
        "expm1": expm1,
        "hypot": hypot,
        "copysign": copysign,
        "fmod": lambda a, b: graph.node("Mod", a, b, fmod=1),
        "remainder": remainder,
        "erf": erf,
        "erfinv": erfinv,
    }
