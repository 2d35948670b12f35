"""What every world of arrays shares of a plant: its names and numbers, and its two functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError
from ...core.variables import Variable
from ...plants.plant import Plant
from .instructions import Instructions, instructions


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
