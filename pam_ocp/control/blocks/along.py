"""What follows a clock: feedback along a motion, its inputs alone, and motions as sources.

The values of every sample stand in a table; a block counts its samples while it is active, and
stays at the last one.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, require_positive
from ...core.trajectory import Trajectory
from ...core.variables import Variable
from ..along_motion import OpenLoop, TrajectoryFeedback
from .draft import Array, Draft, Symbol, as_output
from .feedback import Integrating, acting
from .kinds import BLOCKS

__all__ = ["open_loop", "source", "trajectory_feedback"]

LONGEST = 2**24
"""Samples of a motion: single precision counts so far."""


def _samples(end: float, sample_time: float) -> int:
    """Samples until a motion that ends at ``end`` [s] stays as it is."""
    count = math.ceil(max(end, 0.0) / sample_time - 1e-9) + 2
    if count >= LONGEST:
        raise InputError(
            f"the motion of {end:g} s has {count} samples of {sample_time:g} s; give it in parts "
            f"of less than {LONGEST}"
        )
    return count


def _row(draft: Draft, table: Array) -> Symbol:
    """The row of this sample, as a column; the count goes on while the block is active."""
    count = draft.memory("sample", description="samples since the beginning")
    last = len(table) - 1
    here = ca.fmin(ca.fmax(count, 0), last)
    started = draft.memory("started", description="1 after the first step")
    # what was sent a sample ago decides whether that sample counts
    now = ca.if_else(started, ca.fmin(here + draft.active, last), here)
    draft.next("sample", now)
    draft.next("started", draft.kind(1))
    return ca.MX(ca.DM(table.T))[:, now]


@BLOCKS.register("TrajectoryFeedback")
def trajectory_feedback(controller: TrajectoryFeedback, name: str = "tvlqr") -> Block:
    """u = u(t) - K(t) (x - x(t)) - Ki(t) integral(y - y(t)), as :class:`TrajectoryFeedback`."""
    c, plant = controller, controller.plant
    draft = Draft(name, c.sample_time, "time-varying state feedback along a motion", ca.MX)
    chosen = [c._inversion.inner.variable(n) for n in c.inputs]
    integrated = [plant.variable(n) for n in c.integrated]
    times = c.sample_time * np.arange(_samples(float(c.motion.t[-1]), c.sample_time))
    rows = [
        np.concatenate(
            [
                c._planned(t),
                c._row(t, c._x, c.motion.t),
                c._row(t, c._y, c.motion.t),
                c._row(t, c.K, c.t).T.ravel(),
                c._row(t, c.Ki, c.t).T.ravel(),
            ]
        )
        for t in times
    ]
    nu, nx, ni = len(chosen), len(plant.states), len(integrated)
    ends = np.cumsum([0, nu, nx, ni, nu * nx, nu * ni]).tolist()
    u0, x0, y0, k, ki = ca.vertsplit(_row(draft, np.array(rows)), ends)
    k, ki = ca.reshape(k, nu, nx), ca.reshape(ki, nu, ni)
    v = u0 - ca.mtimes(k, draft.states(c._inversion, plant.states) - x0)
    integrals = Integrating(draft, c.integrated)
    u = v
    if integrated:
        short = acting(draft, c._inversion if c._inversion else None, chosen) - v
        u = v - ca.mtimes(ki, integrals.values(ki, short))
    errors = [draft.like(w) - y0[i] for i, w in enumerate(integrated)]
    integrals.add(errors, u, c._low, c._high)
    draft.send(c._inversion if c._inversion else None, chosen, u)
    return draft.block()


@BLOCKS.register("OpenLoop")
def open_loop(controller: OpenLoop, name: str = "open_loop") -> Block:
    """The inputs of a motion, whatever happens, as :class:`OpenLoop`."""
    c, plant = controller, controller.plant
    draft = Draft(name, c.sample_time, "inputs of a motion", ca.MX)
    times = c.sample_time * np.arange(_samples(float(c.motion.t[-1]), c.sample_time))
    row = _row(draft, np.array([c.planned(t) for t in times]))
    for i, n in enumerate(c.inputs):
        draft.output(as_output(plant.variable(n)), row[i], command=True)
    return draft.block()


@BLOCKS.register("Trajectory")
def source(
    motion: Trajectory,
    name: str = "motion",
    *,
    sample_time: float = 1e-3,
    names: list[str] | None = None,
) -> Block:
    """A motion as a source of references ``wanted.NAME``, at the end of it the last ones.

    names : of its columns; by default all. sample_time : [s].
    """
    draft = Draft(name, require_positive("sample_time", sample_time, "s"), "a motion", ca.MX)
    wanted = list(names or motion.names)
    begin, end = float(motion.t[0]), float(motion.t[-1])
    times = np.clip(sample_time * np.arange(_samples(end, sample_time)), begin, end)
    distinct, place = np.unique(times, return_inverse=True)
    table = motion.at(distinct).array(wanted)[place]
    row = _row(draft, table)
    for i, n in enumerate(wanted):
        v = motion.variable(n)
        about = Variable(
            f"wanted.{n}",
            "output",
            unit=v.unit,
            nominal=v.nominal,
            start=float(table[0, i]),
            description=f"planned: {v.description}",
        )
        draft.output(about, row[i])
    return draft.block()
