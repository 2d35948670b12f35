"""A plant or a controller as an ONNX model: one node for each operation, rows for batches."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Sequence
from functools import partial, reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, get_args

import numpy as np

from ... import __version__
from ...core.atomic import atomic_path
from ...core.block import Block
from ...core.errors import ExportError, InputError
from ...core.lazy import library
from ...core.stop import verb
from ...numerics.elementwise import array_table
from ...plants.plant import Plant, require_plant
from ..sampled import as_block
from .instructions import (
    Instructions,
    Signature,
    Table,
    block_program,
    plant_programs,
    signature,
)
from .registry import ENDINGS, WORLDS

Precision = Literal["double", "single"]
OPSET, IR = 18, 10
PLAIN = {
    **{"exp": "Exp", "log": "Log", "sqrt": "Sqrt", "sin": "Sin", "cos": "Cos", "tanh": "Tanh"},
    **{"floor": "Floor", "ceil": "Ceil", "sign": "Sign", "round": "Round", "abs": "Abs"},
    **{"minimum": "Min", "maximum": "Max", "where": "Where"},
}
"""NumPy's functions that ONNX has, and that its runtime computes in double precision."""


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
    entries = [graph.split(name) for name in columns]
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


def _operator(kind: str, swapped: bool = False) -> Any:
    def operate(self: _Value, *others: Any) -> _Value:
        operands = (self, *others)
        return self.graph.node(kind, *(operands[::-1] if swapped else operands))

    return operate


class _Value:
    """A value under way: the name of what a node gives; operators make further nodes."""

    def __init__(self, graph: _Graph, name: str) -> None:
        self.graph, self.name = graph, name

    __add__, __radd__ = _operator("Add"), _operator("Add", True)
    __sub__, __rsub__ = _operator("Sub"), _operator("Sub", True)
    __mul__, __rmul__ = _operator("Mul"), _operator("Mul", True)
    __truediv__, __rtruediv__ = _operator("Div"), _operator("Div", True)
    __neg__, __abs__ = _operator("Neg"), _operator("Abs")
    __lt__, __le__, __eq__ = _operator("Less"), _operator("LessOrEqual"), _operator("Equal")
    __and__, __or__ = _operator("And"), _operator("Or")

    def __ne__(self, other: Any) -> Any:
        return self.graph.node("Not", self == other)


class _Graph:
    """Nodes under way."""

    def __init__(self, double: bool) -> None:
        from onnx import TensorProto

        self.double = double
        self.kind = TensorProto.DOUBLE if double else TensorProto.FLOAT
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self._known: dict[tuple[Any, ...], str] = {}

    def node(self, kind: str, *inputs: Any, **attributes: Any) -> _Value:
        """One operation on values, numbers or inputs by name; the same one stands once."""
        from onnx import helper

        values = [self.constant(i) if isinstance(i, int | float) else i for i in inputs]
        names = tuple(v.name if isinstance(v, _Value) else v for v in values)
        key = (kind, names, tuple(sorted(attributes.items())))
        if key not in self._known:
            self._known[key] = f"v{len(self._known)}"
            made = helper.make_node(kind, list(names), [self._known[key]], **attributes)
            self.nodes.append(made)
        return _Value(self, self._known[key])

    def constant(self, value: float) -> _Value:
        return self._stored(np.array(value, np.float64 if self.double else np.float32))

    def _stored(self, value: Any) -> _Value:
        from onnx import numpy_helper

        key = ("constant", value.tobytes(), str(value.dtype), value.shape)
        if key not in self._known:
            self._known[key] = f"c{len(self._known)}"
            self.initializers.append(numpy_helper.from_array(value, self._known[key]))
        return _Value(self, self._known[key])

    # ---- columns ------------------------------------------------------------------------------
    def split(self, name: str) -> Callable[[int], _Value]:
        """What gives the columns (N, 1) of an input."""
        return lambda i: self.node("Gather", name, self._stored(np.array([i])), axis=1)

    def rows(self, inputs: Sequence[str]) -> _Value:
        """The shape (N, 1) of the batch, for results that hang on no input."""
        zeros = [0.0 * self.split(name)(0) for name in inputs]
        return self.node("Shape", reduce(operator.add, zeros))

    def join(self, name: str, column: Sequence[_Value], rows: _Value) -> None:
        """The columns side by side as an output."""
        from onnx import helper

        wide = [self.node("Expand", entry, rows).name for entry in column]
        if wide:
            self.nodes.append(helper.make_node("Concat", wide, [name], axis=1))
            return
        none = self._stored(np.zeros(0, np.int64)).name
        some = self.node("Expand", 0.0, rows).name
        self.nodes.append(helper.make_node("Gather", [some, none], [name], axis=1))

    # ---- operations ---------------------------------------------------------------------------
    def table(self) -> Table:
        """All operations, by nodes that the runtime has in double precision."""
        power = partial(self.node, "Pow")
        own = array_table(_functions(self))
        return {**own, "pow": power, "constpow": power, **_errors(self)}


def _functions(graph: _Graph) -> SimpleNamespace:
    """NumPy's functions: what ONNX, or its runtime in double precision, does not have, is made of
    what it has.
    """
    node = graph.node
    own = {name: partial(node, kind) for name, kind in PLAIN.items()}
    exp, log, sqrt, sin, cos = (own[n] for n in ("exp", "log", "sqrt", "sin", "cos"))
    where = own["where"]

    def sinh(a: Any) -> Any:
        e = expm1(a)
        return where(abs(a) < 1.0, 0.5 * (e + e / (e + 1.0)), 0.5 * (exp(a) - exp(-a)))

    def expm1(a: Any) -> Any:
        # tanh(a/2) = (e^a - 1)/(e^a + 1)
        near = own["tanh"](0.5 * a) * (exp(a) + 1.0)
        return where(abs(a) < 1.0, near, exp(a) - 1.0)

    def log1p(a: Any) -> Any:
        # W. Kahan: the error of 1 + a is taken back
        whole = 1.0 + a
        rest = whole - 1.0
        same = rest == 0.0
        return where(same, a, log(whole) * (a / where(same, 1.0, rest)))

    def atan(a: Any) -> Any:
        if not graph.double:
            return node("Atan", a)
        # single precision, then what is missing: atan(a) - y = atan((a - tan y)/(1 + a tan y))
        y = node("Cast", node("Atan", node("Cast", a, to=1)), to=11)
        return y + (a * cos(y) - sin(y)) / (cos(y) + a * sin(y))

    def asin(a: Any) -> Any:
        half = atan(a / (1.0 + sqrt((1.0 - a) * (1.0 + a))))
        return half + half

    def atan2(y: Any, x: Any) -> Any:
        # 2 atan(y/(|(x, y)| + x)) right of the axis, turned by half a turn left of it
        length = hypot(x, y) + abs(x)
        half = atan(y / where(length == 0.0, 1.0, length))
        right = half + half
        return where(x < 0.0, copysign(np.pi, y) - right, right)

    def hypot(a: Any, b: Any) -> Any:
        size = own["maximum"](abs(a), abs(b))
        safe = where(size == 0.0, 1.0, size)
        a, b = a / safe, b / safe
        return size * sqrt(a * a + b * b)

    def copysign(a: Any, b: Any) -> Any:
        negative = (b < 0.0) | (1.0 / b < 0.0)  # 1/-0 is -inf
        return where(negative, -abs(a), abs(a))

    def asinh(a: Any) -> Any:
        size = abs(a)
        square = size * size
        return own["sign"](a) * log1p(size + square / (1.0 + sqrt(square + 1.0)))

    def acosh(a: Any) -> Any:
        b = a - 1.0
        return log1p(b + sqrt(b + b + b * b))

    made: dict[str, Any] = {
        "sinh": sinh,
        "expm1": expm1,
        "log1p": log1p,
        "atan": atan,
        "asin": asin,
    }
    made |= {"atan2": atan2, "hypot": hypot, "copysign": copysign, "asinh": asinh, "acosh": acosh}
    return SimpleNamespace(
        **own,
        **made,
        tan=lambda a: sin(a) / cos(a),
        acos=lambda a: np.pi / 2 - asin(a),
        cosh=lambda a: 0.5 * (exp(a) + exp(-a)),
        atanh=lambda a: 0.5 * log1p((a + a) / (1.0 - a)),
        fmod=lambda a, b: node("Mod", a, b, fmod=1),
    )


def _errors(graph: _Graph) -> Table:
    """The error function and its inverse."""

    def erf(a: Any) -> Any:
        if graph.double:
            raise ExportError(
                "to_onnx: the error function is there in single precision alone; give "
                "precision='single'"
            )
        return graph.node("Erf", a)

    def erfinv(a: Any) -> Any:
        raise ExportError("to_onnx: ONNX has no inverse of the error function; write it otherwise")

    return {"erf": erf, "erfinv": erfinv}
