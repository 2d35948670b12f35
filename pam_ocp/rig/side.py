"""A rig as the side of a closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..control.loop import closed_loop
from ..control.sides import Side
from ..core.errors import InputError, kind_of
from ..core.trajectory import Trajectory
from ..plants.plant import Given, by_name
from .channels import Command
from .guard import RigError
from .running import STEP, Running, recorded

if TYPE_CHECKING:
    from .rig import Rig

WITHIN = 16
"""Moments of a sample at which the inputs of a motion are averaged."""
RESTING = 0.05
"""Rates per second, scaled by nominals, below which a motion begins at rest."""


class RigSide(Side):
    """Between two samples the rig moves by itself, and is waited for."""

    measured = True

    def __init__(self, rig: Rig, sample_time: float, start: Given | None) -> None:
        super().__init__()
        self.rig, self.name, self.variables = rig, rig.name, rig.variables
        target = {n: float(v) for n, v in by_name("start", start).items() if n in rig.commands}
        self._run = self._held_open.enter_context(Running(rig, sample_time))
        try:
            if target:
                self._run.approach(target)
        except BaseException as error:
            self.__exit__(type(error), error, error.__traceback__)
            raise
        self.inputs = dict(self._run.sent)
        self._begin = dict(self._run.sent)
        self._offset: dict[str, float] | None = None
        self.bumpless = True
        self._steps, self._sample_time = 0, sample_time
        self._first = len(self._run.rows)

    def values(self) -> dict[str, float]:
        """See :class:`Side`: readings, and commands as they act."""
        return {**self._run.values, **self.inputs}

    def step(self, time: float) -> None:
        """See :class:`Side`. The step of a controller that takes over fades."""
        run = self._run
        asked = {n: self.inputs[n] for n in self.rig.commands}
        if self._offset is None:
            self._offset = {n: self._begin[n] - asked[n] for n in asked}
        fade = self.rig.guard.fade
        left = 0.0
        if fade and self.bumpless:
            left = math.exp(-self._steps * self._sample_time / fade)
        self._steps += 1
        run.step({n: v + left * self._offset[n] for n, v in asked.items()})
        self.inputs = dict(run.sent)

    def trajectory(self) -> Trajectory:
        """See :class:`Side`: at the times at which the readings were taken."""
        run = self._run
        last = [*run.values.values(), *(self.inputs[n] for n in self.rig.commands)]
        rows = [
            *run.rows[self._first : self._first + self._steps],
            (max(run.time, run.at + STEP), last),
        ]
        return recorded(rows, self.variables)


def player(
    inputs: Any, sample_time: float, commands: Mapping[str, Command]
) -> tuple[Callable[[float, Any], Mapping[str, float]], float | None]:
    """(a controller that plays inputs, how long they are [s])."""
    motion = getattr(inputs, "trajectory", inputs)
    if not isinstance(motion, Trajectory):
        if not callable(inputs):
            raise InputError(
                f"inputs is {kind_of(inputs)}: give a function of time, a trajectory, or a plan"
            )
        return (lambda t, seen: inputs(t)), None
    names = [n for n in motion.named("input") if n in commands]
    if not names:
        raise RigError(f"the motion holds none of the commands {', '.join(commands)}")
    t0, end = float(motion.t[0]), float(motion.t[-1])
    count = max(1, round((end - t0) / sample_time))
    inside = (np.arange(count * WITHIN) + 0.5) / WITHIN
    fine = motion.at(np.minimum(t0 + sample_time * inside, end)).array(names)
    rows = fine.reshape(count, WITHIN, len(names)).mean(axis=1)  # a switch keeps its impulse

    def law(t: float, seen: Any) -> dict[str, float]:
        row = rows[min(max(round(t / sample_time), 0), count - 1)]
        return dict(zip(names, row.tolist(), strict=True))

    return law, float(motion.duration)


def start_of(rig: Rig, motion: Any) -> dict[str, float]:
    """Commands under which the model rests where a motion begins; its first ones where it does not
    begin at rest, or where there is no model that says so.
    """
    motion = getattr(motion, "trajectory", motion)
    first = {n: float(motion[n][0]) for n in motion.named("input") if n in rig.commands}
    plant = rig.plant
    if plant is None or any(v.name not in motion for v in (*plant.states, *plant.inputs)):
        return first
    from scipy.optimize import least_squares

    names = [v.name for v in plant.inputs]
    places = [names.index(n) for n in first]
    x, u = (np.array([motion[v.name][0] for v in kind]) for kind in (plant.states, plant.inputs))
    p, nominal = plant.vector("parameter"), plant.vector("state", attribute="nominal")
    low, high = (np.array([getattr(rig.commands[n], a) for n in first]) for a in ("low", "high"))

    def rates(part: Any) -> Any:
        u[places] = low + part * (high - low)
        return np.asarray(plant.function(x, u, p)[0], dtype=float).ravel() / nominal

    begin = np.clip((u[places] - low) / (high - low), 0.0, 1.0)
    found = least_squares(rates, begin, bounds=(0.0, 1.0), xtol=1e-12, ftol=1e-12)
    if np.max(np.abs(found.fun)) > RESTING:
        return first
    return dict(zip(first, (low + found.x * (high - low)).tolist(), strict=True))


def play(rig: Rig, motion: Trajectory, start: Mapping[str, float] | None = None) -> Trajectory:
    """Play a motion's inputs as they are, after a soft start to ``start`` (by default to those of
    :func:`start_of`). What was read and sent.
    """
    law, span = player(motion, rig.sample_time, rig.commands)
    first = start_of(rig, motion) if start is None else start
    side = RigSide(rig, rig.sample_time, first)
    side.bumpless = False
    with side:
        for k in range(max(1, round((span or 0.0) / rig.sample_time))):
            t = k * rig.sample_time
            side.inputs = {**side.inputs, **law(t, {})}
            side.step(t)
        return side.trajectory()


def run_on(rig: Rig, inputs: Any, duration: float | None, start: Given | None) -> Trajectory:
    """See :meth:`Rig.run`."""
    if not callable(inputs):
        return play(rig, inputs, None if start is None else by_name("start", start))
    if duration is None:
        raise InputError("duration: give it, where the inputs are a function")
    law, h = player(inputs, rig.sample_time, rig.commands)[0], rig.sample_time
    return closed_loop(law, rig, duration=duration, start=start, sample_time=h).trajectory
