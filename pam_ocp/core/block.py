"""Block: a sampled system with named variables and one step function, such as a controller.

What a controller is outside of Python: the FMU, the C code and the simulation of a block all call
its one ``step``. It knows nothing of muscles or of control.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from .errors import InputError, UnknownNameError, require_count, require_positive
from .variables import Causality, Variable

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Block:
    """(memory, outputs) = step(memory, inputs, parameters), every ``sample_time`` seconds.

    Parameters
    ----------
    name : of the block, as a variable's name.
    sample_time : time between two steps [s].
    inputs : measurements and references, causality "input"; an input may be NaN (a measurement that
        is missing) where the block says so in its description.
    outputs : commands, estimates and status, causality "output".
    parameters : causality "parameter"; those with ``tunable`` may change while it runs.
    memory : what is carried from step to step, causality "state", with start values.
    step : Function (memory, inputs, parameters) -> (memory, outputs), dense columns in SI. Time is
        not among its arguments: a block that follows a clock counts its steps in its memory.
    description : one line for people.
    commands : those of the outputs that drive a plant; the others are estimates and status.
    missing : those of the inputs that may be NaN, where the step itself knows what to do then.
    loops : {what is repeated within one step: how often at most}, as a target's worst case.
    delay : samples from measuring to acting that it is designed for.
    flags : {output that is a sum of bits: {bit: name}; input that is on (1) or off (0): {}}.
    matrices : {name: (rows, columns)} of parameters that stand in a row, ``name.*``, row by row.
    """

    name: str
    sample_time: float
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    memory: tuple[Variable, ...]
    step: ca.Function
    description: str = ""
    commands: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    loops: Mapping[str, int] = field(default_factory=dict)
    delay: int = 0
    flags: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    matrices: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        Variable(self.name, "parameter")
        sample_time = require_positive("sample_time", self.sample_time, "s")
        object.__setattr__(self, "sample_time", sample_time)
        require_count("delay", self.delay, 0)
        kinds: tuple[tuple[str, Causality], ...] = (
            ("inputs", "input"),
            ("outputs", "output"),
            ("parameters", "parameter"),
            ("memory", "state"),
        )
        seen: set[str] = set()
        for argument, causality in kinds:
            for variable in getattr(self, argument):
                if variable.causality != causality:
                    raise InputError(
                        f"{argument}: {variable.name} is {variable.kind}, not of "
                        f"causality {causality!r}"
                    )
                if variable.name in seen:
                    raise InputError(f"{argument}: {variable.name} is there twice; rename one")
                seen.add(variable.name)
        known = {"commands": self.outputs, "missing": self.inputs}
        for argument, variables in known.items():
            for name in getattr(self, argument):
                if name not in {v.name for v in variables}:
                    raise UnknownNameError(argument, name, [v.name for v in variables])
        wanted = [len(getattr(self, a)) for a in ("memory", "inputs", "parameters")]
        found = [self.step.size_in(i) for i in range(self.step.n_in())]
        if found != [(n, 1) for n in wanted]:
            raise InputError(f"step takes {found}; it must take columns of {wanted} entries")
        wanted = [len(self.memory), len(self.outputs)]
        found = [self.step.size_out(i) for i in range(self.step.n_out())]
        if found != [(n, 1) for n in wanted]:
            raise InputError(f"step gives {found}; it must give columns of {wanted} entries")

    @classmethod
    def of(cls, controller: Any, **options: Any) -> Block:
        """What ``pam_ocp.control.block`` makes of a controller, an estimator or a motion."""
        return courtesy.block(controller, **options)

    def __repr__(self) -> str:
        return (
            f"<Block {self.name}: {len(self.inputs)} inputs to {len(self.outputs)} outputs every "
            f"{1e3 * self.sample_time:g} ms, {len(self.parameters)} parameters, "
            f"{len(self.memory)} values kept>"
        )

    def start(self, kind: str) -> Array:
        """Start values of "memory", "inputs" or "parameters", in order [SI]."""
        return np.array([v.start or 0.0 for v in getattr(self, kind)], dtype=float)
