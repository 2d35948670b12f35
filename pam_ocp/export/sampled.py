"""A sampled block (a controller, an estimator, a source) as the content of an FMU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import casadi as ca

from ..core.block import Block
from ..core.errors import ExportError, InputError
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from . import source
from .layout import Dependency, Layout

__all__ = ["BlockLayout", "as_block", "block_data", "block_notes", "block_sources"]

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


class BlockLayout(Layout):
    """The variables of a block's FMU; its memory is not among them."""

    def __init__(self, block: Block, clock: bool = True) -> None:
        self.block, self.clock = block, clock
        self.sample_time = block.sample_time
        super().__init__(
            block.name,
            block.description,
            [
                ("input", block.inputs),
                ("parameter", block.parameters),
                ("output", block.outputs),
            ],
        )

    @cached_property
    def dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each output: the inputs it depends on at a sample."""
        return self._depends("input")

    @cached_property
    def initial_dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each output: the inputs and parameters it starts from."""
        return self._depends("input", "parameter")

    def _depends(self, *roles: Any) -> Mapping[int, tuple[Dependency, ...]]:
        found: dict[int, tuple[Dependency, ...]] = {e.reference: () for e in self.of("output")}
        for role in roles:
            knowns = self.of(role)
            if not knowns or not found:
                continue
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


def block_sources(block: Block) -> source.ModelCode:
    """The step as C code, without allocation and without state of its own."""
    require_exportable(block)
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
    work = {
        "BLOCK_ARG": max(3, step.sz_arg()),
        "BLOCK_RES": max(2, step.sz_res()),
        "BLOCK_IW": max(1, step.sz_iw()),
        "BLOCK_W": max(1, step.sz_w()),
    }
    return source.ModelCode({"plant.c": code}, work)


def block_data(block: Block) -> dict[str, Any]:
    """What model_data.h says of a block beyond what it says of a plant."""
    missing = getattr(block, "missing", ())
    return {
        "more": {
            "MODEL_SAMPLED": "",
            "MODEL_SAMPLE_TIME": source.number(block.sample_time),
            "NM": str(len(block.memory)),
        },
        "tables": [
            source.table("double", "M_START", map(source.number, block.start("memory"))),
            source.table(
                "double", "Y_START", (source.number(v.start or 0.0) for v in block.outputs)
            ),
            source.table(
                "int", "U_MISSING", (str(int(v.name in missing)) for v in block.inputs), "0"
            ),
        ],
    }


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
