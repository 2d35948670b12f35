"""What a motion leaves in the memories of a plant's losses: integrated along a known motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..numerics.rosenbrock import rodas3
from ..plants.plant import Plant

__all__ = ["MemoryModel"]

Array: TypeAlias = NDArray[np.float64]

PARTS = 32
"""Steps of the integrator per sample: finer than the edge of an element that begins to slide."""


class MemoryModel:
    """States with memory (hysteresis, creep) while position and pressures move as is said.

    plant : what is believed of the muscles. Hysteresis and creep need the motion alone, so they are
    integrated along it without the rest of the plant.
    """

    def __init__(self, plant: Plant, position: str, velocity: str) -> None:
        self.names = tuple(v.name for v in plant.states if v.memory)
        names = [v.name for v in (*plant.states, *plant.inputs)]
        self._memory = [names.index(n) for n in self.names]
        self._at = names.index(position), names.index(velocity)
        self._index = {n: i for i, n in enumerate(names)}
        self._start = np.concatenate([plant.vector("state"), plant.vector("input")])
        self._low, self._high = (
            np.array([getattr(plant.variable(n), a) for n in self.names]) for a in ("min", "max")
        )
        self._p = plant.vector("parameter")
        self._step = self._build(plant) if self.names else None
        self.reset()

    def _build(self, plant: Plant) -> ca.Function:
        """(memories, all states and inputs of each part, durations, parameters) -> memories.

        ``part`` : the same for one part.
        """
        z = ca.vertcat(plant.x, plant.u)
        rates = ca.vertcat(*(plant.expression(f"der({n})") for n in self.names))
        slope = ca.densify(ca.jacobian(rates, z)[:, self._memory])
        system = ca.Function("rates", [z, plant.p], [rates, slope])
        memory, full, duration = (
            ca.SX.sym(n, k) for n, k in (("m", len(self.names)), ("z", z.numel()), ("h", 1))
        )

        def slopes(x: ca.SX) -> tuple[ca.SX, ca.SX]:
            here = ca.SX(full)
            here[self._memory] = x
            found = system(here, plant.p)
            return found[0], found[1]

        after = rodas3(slopes, memory, duration)
        self.part = ca.Function("memory", [memory, full, duration, plant.p], [after])
        return self.part.mapaccum(PARTS)

    def reset(self) -> None:
        """Begin at the plant's start values."""
        self._z = self._start.copy()

    @property
    def values(self) -> dict[str, float]:
        """The memories by name."""
        return dict(zip(self.names, self._z[self._memory].tolist(), strict=True))

    def place(self, values: Mapping[str, float]) -> None:
        """Where other states and inputs stand (position, pressures), and memories if named."""
        for name, value in values.items():
            self._z[self._index[name]] = value

    def move(self, position: float, duration: float) -> None:
        """On to ``position`` in ``duration`` [s] at an even speed."""
        if self._step is not None:
            begin, velocity = self._z[self._at[0]], self._at[1]
            parts = np.repeat(self._z[:, None], PARTS, axis=1)
            parts[self._at[0]] = begin + (position - begin) * (np.arange(PARTS) + 0.5) / PARTS
            parts[velocity] = (position - begin) / duration
            steps = np.full((1, PARTS), duration / PARTS)
            known = np.repeat(self._p[:, None], PARTS, axis=1)
            found = np.asarray(self._step(self._z[self._memory], parts, steps, known))[:, -1]
            self._z[self._memory] = np.clip(found, self._low, self._high)
        self._z[self._at[0]] = position
