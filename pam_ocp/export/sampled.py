"""A sampled block (a controller, an estimator, a source) as the content of an FMU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import casadi as ca

from ..core.block import Block
from ..core.errors import ExportError, InputError
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant
from . import source
from .c_code.generated import PRECISIONS, step_code
from .layout import Dependency, Layout

LEAST_SAMPLE_TIME = 1e-6
"""[s] Times of importers are sums of doubles: below, a day of samples cannot be told apart."""
_FORBIDDEN = re.compile(r"\b(malloc|calloc|realloc|fopen|dlopen|printf)\s*\(|#include <(?!math)")


def as_block(system: Any) -> Block | None:
    """The block that ``system`` is or, for a controller, is made of; None for a plant, a motion and
    what is plainly neither.
    """
    if isinstance(system, Block):
        return system
    if isinstance(system, Plant | Trajectory) or type(system).__module__ == "builtins":
        return None
    if not callable(system) and not hasattr(system, "reset"):
        return None  # no controller and no estimator
    return Block.of(system)


def as_booleans(block: Block) -> Block:
    """The block with an output for each bit of its flags (``status.off``), for Booleans of FMI.

    Raises InputError for a block without flags.
    """
    if not block.flags:
        raise InputError(f"booleans = True: {block.name} has no flags; leave it out")
    m, u, p = (block.step.mx_in(i) for i in range(3))
    after, outputs = block.step(m, u, p)
    variables, values = [], []
    for v, value in zip(block.outputs, ca.vertsplit(outputs), strict=True):
        bits = block.flags.get(v.name, {})
        for bit, name in bits.items():
            words = f"{v.description.partition(':')[0]} {bit}" if v.description else ""
            flag = Variable(f"{v.name}.{name}", "output", start=0.0, description=words)
            variables.append(flag)
            values.append(ca.fmod(ca.floor(value / bit), 2))
        if not bits:
            variables.append(v)
            values.append(value)
    step = ca.Function("step", [m, u, p], [after, ca.densify(ca.vertcat(*values))])
    flags: dict[str, dict[int, str]] = {
        v.name: {} for v in variables if v.name.rpartition(".")[0] in block.flags
    }
    flags |= {n: {} for n, bits in block.flags.items() if not bits}
    return replace(block, outputs=tuple(variables), step=step, flags=flags)


class BlockLayout(Layout):
    """The variables of a block's FMU; its memory is not among them.

    first : {output: what stands there until the first sample}; by default what it would give.
    matrices : gains as arrays (FMI 3). booleans : flags of the block are Booleans. enumerations :
    variables with codes are enumerations, by default numbers. single : numbers are Float32 (FMI 3),
    and the step computes with floats.
    """

    def __init__(
        self,
        block: Block,
        clock: bool = True,
        first: Mapping[str, float] | None = None,
        matrices: bool = False,
        booleans: bool = False,
        enumerations: bool = False,
        single: bool = False,
    ) -> None:
        self.block, self.clock, self.single = block, clock, single
        begins = first or {}
        self.sample_time = block.sample_time
        super().__init__(
            block.name,
            block.description,
            [
                ("input", block.inputs),
                ("parameter", block.parameters),
                (
                    "output",
                    tuple(replace(v, start=begins.get(v.name, v.start)) for v in block.outputs),
                ),
            ],
            typed=("input", "parameter", "output") if enumerations else (),
        )
        self.entries = tuple(
            replace(
                e,
                begins=e.role == "output" and e.name in begins,
                boolean=booleans and e.name in block.flags,
            )
            for e in self.entries
        )
        place = {e.name: e.reference for e in self.of("parameter")}
        if matrices:
            self.arrays = {
                min(r for n, r in place.items() if n.startswith(f"{name}.")): (name, *shape)
                for name, shape in block.matrices.items()
            }

    @cached_property
    def dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each output: the inputs it depends on at a sample."""
        return self._depends("input")

    @cached_property
    def initial_dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each output: the inputs and parameters it starts from."""
        more = self._depends("parameter")
        return {o: tuple(sorted(known + more[o])) for o, known in self.dependencies.items()}

    def _depends(self, role: Any) -> Mapping[int, tuple[Dependency, ...]]:
        found: dict[int, tuple[Dependency, ...]] = {e.reference: () for e in self.of("output")}
        knowns = self.of(role)
        if knowns and found:
            pattern = self.block.step.jac_sparsity(1, {"input": 1, "parameter": 2}[role])
            for row, column in zip(pattern.row(), pattern.get_col(), strict=True):
                output = self.of("output")[row].reference
                found[output] += ((knowns[column].reference, "dependent"),)
        return {output: tuple(sorted(known)) for output, known in found.items()}


def require_exportable(block: Block) -> None:
    """Refuse what no FMU can be made of. Raises ExportError, InputError."""
    if block.sample_time < LEAST_SAMPLE_TIME:
        raise InputError(
            f"sample_time = {block.sample_time:g} s of block {block.name!r} is below "
            f"{LEAST_SAMPLE_TIME:g} s, which times of importers cannot resolve; sample less often"
        )
    if not block.outputs:
        raise ExportError(f"block {block.name!r} has no outputs: nothing could be read from it")


def block_sources(block: Block, single: bool = False) -> source.ModelCode:
    """The step as C code, without allocation and without state of its own. single : see
    BlockLayout.
    """
    require_exportable(block)
    if single:
        made = step_code(block, PRECISIONS["single"])
        sizes = (made.arguments, made.results, made.integers, made.reals)
        names = ("BLOCK_ARG", "BLOCK_RES", "BLOCK_IW", "BLOCK_W")
        work = {n: max(s, k) for n, s, k in zip(names, sizes, (3, 2, 1, 1), strict=True)}
        return source.ModelCode({"plant.c": f"typedef float real;\n{made.text}"}, work)
    memory, inputs, parameters = (block.step.mx_in(i) for i in range(3))
    outputs = block.step(memory, inputs, parameters)
    step = ca.Function("block_step", [memory, inputs, parameters], [ca.densify(o) for o in outputs])
    try:
        code = source.plant_code([step])
    except RuntimeError as error:
        raise ExportError(
            f"block {block.name!r} cannot be written as C code: {str(error).splitlines()[-1]}"
        ) from None
    found = _FORBIDDEN.search(code)
    if found:
        raise ExportError(
            f"block {block.name!r}: its step calls {found[0].strip()!r} in C, so that neither its "
            "memory nor its work is bounded; write it with loops of fixed length"
        )
    return source.ModelCode({"plant.c": code}, source.work_of("BLOCK", [step], (3, 2)))


def block_data(layout: BlockLayout) -> dict[str, Any]:
    """What model_data.h says of a block beyond what it says of a plant."""
    block = layout.block
    missing = getattr(block, "missing", ())
    unknown = (str(int(v.name in missing)) for v in block.inputs)
    begins = [str(int(e.begins)) for e in layout.of("output")]
    more = {
        "MODEL_SAMPLED": "",
        "MODEL_SAMPLE_TIME": source.number(block.sample_time),
        "NM": str(len(block.memory)),
    }
    tables = [
        source.table("double", "M_START", map(source.number, block.start("memory"))),
        source.table("double", "Y_START", map(source.number, layout.vector("output", "start"))),
        source.table("int", "Y_BEGINS", begins, "0"),
        source.table("int", "U_MISSING", unknown, "0"),
    ]
    if layout.single:
        more["MODEL_SINGLE"] = ""
    if layout.arrays:
        more["MODEL_ARRAYS"] = ""
        tables.append(source.table("int", "P_SIZE", map(str, _sizes(layout))))
    return {"more": more, "tables": tables}


def _sizes(layout: BlockLayout) -> list[int]:
    """How many values stand behind the reference of each parameter."""
    shapes = {r: rows * columns for r, (_, rows, columns) in layout.arrays.items()}
    return [shapes.get(e.reference, 1) for e in layout.of("parameter")]


def block_notes(block: Block) -> list[str]:
    """What the documentation says of the times of samples."""
    times = f"{block.sample_time:g} s"
    return [
        f"A sampled block: (memory, outputs) = step(memory, inputs, parameters) every {times}, at "
        f"t = start + k {times} exactly: samples are counted. A communication step from t to t + h "
        "makes the samples that are due from t on and before t + h, each with the inputs of its "
        "time, and holds the outputs of the last one. Until the first sample, outputs are those "
        "that it would give.",
        "In FMI 3 with event mode an importer may tick the clock when a sample is due: then "
        "outputs follow inputs at once. A sample that was not ticked is made in the next step.",
    ]
