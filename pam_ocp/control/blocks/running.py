"""A block's step on fixed memory: what controllers and loops call once a sample."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.block import Block
from ...core.stop import turns
from ...numerics.buffered import Buffered
from ..controller import Measured
from .kinds import TOLD, law_of

__all__ = ["ByBlock", "Running", "SampledLaw"]

Array: TypeAlias = NDArray[np.float64]


class Running:
    """A block whose memory is carried from step to step. Inputs that nobody gives stay as they are.

    memory, inputs, parameters : arrays in the block's order, which may be written to; ``outputs``
    are names.
    needed : measurements that each call must bring (None: all of them).
    """

    def __init__(self, block: Block, needed: Collection[str] | None = None) -> None:
        self.block, self.needed = block, needed
        self._step = Buffered(block.step)
        self.memory, self.inputs, self.parameters = self._step.arguments
        self.places = {v.name: i for i, v in enumerate(block.inputs)}
        measured = [(i, n) for n, i in self.places.items() if n.partition(".")[0] not in TOLD]
        self._measured = [(i, n) for i, n in measured if needed is None or n in needed]
        self._besides = [pair for pair in measured if pair not in self._measured]
        self.outputs = [v.name for v in block.outputs]
        self._commands = [(n, self.outputs.index(n)) for n in block.commands]
        self.parameters[:] = block.start("parameters")
        self.reset()

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self.block, self.needed, *(a.copy() for a in self._step.arguments))

    def reset(self) -> None:
        """Forget the past."""
        self.memory[:] = self.block.start("memory")
        self.inputs[:] = self.block.start("inputs")

    def tell(self, values: Mapping[str, float]) -> None:
        """Set inputs by name. Raises KeyError for others."""
        for name, value in values.items():
            self.inputs[self.places[name]] = value

    def measure(self, measured: Mapping[str, float]) -> None:
        """Set the measurements among the inputs. Raises KeyError where a needed one is missing."""
        inputs = self.inputs
        for i, name in self._measured:
            inputs[i] = measured[name]
        for i, name in self._besides:
            if name in measured:
                inputs[i] = measured[name]

    def step(self) -> Array:
        """The outputs of a step, in the block's order: a view that the next one overwrites."""
        self._step.call()
        after, outputs = self._step.results
        self.memory[:] = after[:, 0]
        return outputs[:, 0]

    def commands(self) -> dict[str, float]:
        """The commands of a step by name [SI]."""
        outputs = self.step().tolist()
        return {n: outputs[i] for n, i in self._commands}


def _again(block: Block, needed: Collection[str] | None, *arrays: Array) -> Running:
    running = Running(block, needed)
    for array, values in zip(
        (running.memory, running.inputs, running.parameters), arrays, strict=True
    ):
        array[:] = values
    return running


class ByBlock:
    """A controller whose law is the step of its block: exported, it is the same function."""

    @cached_property
    def _law(self) -> Running:
        return self._running()

    @turns
    def _running(self) -> Running:
        return Running(law_of(self), self._needed())

    def _needed(self) -> Collection[str] | None:
        """Measurements that each call must bring; None: all that the block takes."""
        return None

    def reset(self) -> None:
        """See :class:`Controller`."""
        self._law.reset()


class SampledLaw(ByBlock):
    """A controller whose call sets the block's inputs and gives the commands of one step."""

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        law = self._law
        law.measure(measured)
        law.tell(self._references(t))
        return law.commands()

    def wanted(self, t: float) -> dict[str, float]:
        """Values by name that are to be reached at a time [s]."""
        return {}

    def _references(self, t: float) -> dict[str, float]:
        """The block's inputs that are no measurements, at a time [s]."""
        return {f"wanted.{n}": value for n, value in self.wanted(t).items()}
