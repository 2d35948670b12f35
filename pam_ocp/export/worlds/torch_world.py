"""A plant in PyTorch: a module whose functions autograd and torch.func follow."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeAlias

from ...core.block import Block
from ...core.errors import require_count, require_positive
from ...core.lazy import library
from ...core.stop import verb
from ...numerics.elementwise import array_table
from ...numerics.runge_kutta import rk4
from ...plants.plant import Plant, require_plant
from ..sampled import as_block
from .instructions import Instructions, Signature, block_program, plant_programs, signature
from .registry import WORLDS

Tensor: TypeAlias = Any
"""A torch.Tensor."""


@verb
def to_torch(system: Plant | Block | Any) -> Any:
    """A plant, or a block such as a controller, as a ``torch.nn.Module`` in double precision.

    Of a plant ``module(x, u)`` is (x', y); ``module.f(t, x, u, p)`` and
    ``module.outputs(t, x, u, p)`` are as those of :func:`to_jax`: tensors with states (inputs,
    outputs) along their last axis, and
    ``p`` a dictionary by name. What ``p`` does not name is taken from ``module.p``, one
    ``torch.nn.Parameter`` of all values in the order of ``module.signature.parameters``, which
    an optimiser may train. ``module.run(x, u, p, step=1e-3, steps=500)`` makes equal steps of rk4.
    Of a block ``module(memory, inputs)`` is (memory, outputs). ``module.float()`` for single
    precision.

    Raises InputError where torch is missing, ExportError for what is no formula (docs/worlds.md).

    Examples
    --------
    >>> module = pam.export.to_torch(plant)  # doctest: +SKIP
    >>> xdot, y = module(module.x0, module.u0)  # doctest: +SKIP
    """
    library("torch", "torch", "to_torch")
    block = as_block(system)
    if block is not None:
        return _modules()[1](signature(block), block_program(block))
    plant = require_plant(system)
    return _modules()[0](signature(plant), *plant_programs(plant))


WORLDS.register("torch")(to_torch)


@cache
def _modules() -> tuple[type, type]:
    """The classes of plants and of blocks, made where torch is there."""
    import torch

    class Base(torch.nn.Module):  # type: ignore[misc]
        """What both have: names, start values, and parameters that can be trained."""

        def __init__(self, own: Signature, missing: bool) -> None:
            super().__init__()
            self.signature = own
            for name, values in (("x0", own.x0), ("u0", own.u0)):
                self.register_buffer(name, torch.tensor(values, dtype=torch.float64))
            self.p = torch.nn.Parameter(torch.tensor(own.p0, dtype=torch.float64))
            self._table = array_table(torch, missing) | {
                "pow": torch.pow,
                "constpow": torch.pow,
                "erf": torch.erf,
                "erfinv": torch.erfinv,
            }

        def given(self, p: Any) -> Any:
            """Parameters, those that ``p`` does not name as they are trained."""
            if not isinstance(p, dict) and p is not None:
                return p
            return {n: self.p[i] for i, n in enumerate(self.signature.parameters)} | (p or {})

        def results(self, program: Instructions, x: Tensor, u: Tensor, p: Any) -> list[Tensor]:
            """What the operations give, as tensors of (..., n)."""
            groups = self.signature.groups(x, u, self.given(p))

            def constant(value: float) -> Tensor:
                return torch.tensor(value, dtype=self.p.dtype, device=self.p.device)

            made = program.run(self._table, [g.__getitem__ for g in groups], constant)
            shape = torch.broadcast_shapes(*(getattr(e, "shape", ()) for g in groups for e in g))
            return [
                torch.stack([e.expand(shape) for e in r], dim=-1)
                if r
                else self.p.new_zeros((*shape, 0))
                for r in made
            ]

    class TorchPlant(Base):
        """x' and y of a plant."""

        def __init__(self, own: Signature, xdot: Instructions, outputs: Instructions) -> None:
            super().__init__(own, False)
            self._xdot, self._outputs = xdot, outputs

        def f(self, t: Any, x: Tensor, u: Tensor, p: Any = None) -> Tensor:
            """x' of shape (..., nx)."""
            return self.results(self._xdot, x, u, p)[0]

        def outputs(self, t: Any, x: Tensor, u: Tensor, p: Any = None) -> Tensor:
            """y of shape (..., ny)."""
            return self.results(self._outputs, x, u, p)[0]

        def forward(self, x: Tensor, u: Tensor, p: Any = None) -> tuple[Tensor, Tensor]:
            """(x', y)."""
            return self.f(0.0, x, u, p), self.outputs(0.0, x, u, p)

        def run(self, x: Tensor, u: Tensor, p: Any = None, *, step: float, steps: int) -> Tensor:
            """x (steps + 1, ..., nx) by equal steps [s] of rk4; u held, or a row for each step."""
            step = require_positive("step", step, "s")
            rows = [x]
            for k in range(require_count("steps", steps)):
                held = u[k] if u.dim() > x.dim() else u

                def slope(z: Tensor, _: float, held: Tensor = held) -> Tensor:
                    return self.f(0.0, z, held, p)

                rows.append(rk4(slope, rows[-1], step))
            return torch.stack(torch.broadcast_tensors(*rows))

    class TorchBlock(Base):
        """One sample of a block."""

        def __init__(self, own: Signature, program: Instructions) -> None:
            super().__init__(own, True)
            self._program = program

        def forward(self, memory: Tensor, inputs: Tensor, p: Any = None) -> tuple[Tensor, Tensor]:
            """(memory, outputs)."""
            after, outputs = self.results(self._program, memory, inputs, p)
            return after, outputs

    return TorchPlant, TorchBlock
