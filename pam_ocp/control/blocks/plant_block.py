"""A plant, alone or with its controller, as one sampled block: simulation in fixed steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, require_count, require_positive, require_tolerance
from ...core.stop import verb
from ...core.variables import Variable
from ...plants.plant import Given, Plant, require_plant
from ...simulation.sampled import SampledPlant, stepped
from ..kinds import Array
from ..sides import start_values
from .draft import Draft, about, column_of
from .running import block as block_of

MOST = 1024
"""Substeps in a sample."""
LEVELS, HELD_FOR, LONGEST = 8, 0.1, 1000
"""Of the motion that substeps are chosen for: jumps of the inputs, the time [s] between two, and
samples in that, at most.
"""
STATE, HELD = "state.", "held."


@verb
def plant_block(
    plant: Plant,
    controller: Any = None,
    *,
    start: Given | None = None,
    sample_time: float | None = None,
    delay: int | None = None,
    substeps: int | None = None,
    tolerance: float = 1e-4,
    name: str | None = None,
) -> Block:
    """A plant as a sampled block in fixed steps, alone or with its controller: one FMU or C unit.

    At sample k, outputs are those of the plant at that time, under the inputs held since sample
    k - 1; the inputs of sample k act from then on. With a controller, its measurements are taken
    from the plant and its commands are held by the plant, as in :func:`pam_ocp.closed_loop`; its
    references, ``enable`` and the plant's disturbances remain inputs.

    Parameters
    ----------
    controller : a Block, or what :func:`pam_ocp.control.block` makes one of, with its guard.
    start : initial states and inputs by name, or an operating point; by default the plant's own.
    sample_time : [s]; by default the controller's, or 1 ms.
    delay : samples from measuring to acting, by default what the controller is designed for.
    substeps : equal steps of RODAS3 (linearly implicit, order 3, L-stable) in a sample. By default
        the fewest, in powers of 2, that miss no state after a sample by more than ``tolerance``
        of its nominal value (against an adaptive integration), along a motion from the start
        values whose inputs jump every 0.1 s (1000 samples, at most): to either end of their
        ranges, then to random values.

    Parameters of the block are those of the plant and, with its name in front, of the controller.

    Raises InputError for values out of range, another plant's controller, and plants that even
    1024 substeps do not follow.

    Examples
    --------
    >>> law = pam.lqr(plant, point, sample_time=2e-3)
    >>> whole = pam.control.plant_block(plant, law)
    >>> pam.export_fmu(whole, "closed_loop.fmu", platforms=["native"]).name
    'closed_loop.fmu'
    """
    plant = require_plant(plant)
    plant = plant.with_values(start_values(plant, start))
    require_tolerance("tolerance", tolerance)
    law = None
    if controller is not None:
        law = controller if isinstance(controller, Block) else block_of(controller, plant=plant)
    usual = law.sample_time if law else 1e-3
    length = require_positive("sample_time", usual if sample_time is None else sample_time, "s")
    if law and abs(length - law.sample_time) > 1e-9 * length:
        raise InputError(
            f"sample_time = {length:g} s, the controller's is {law.sample_time:g} s: leave it out, "
            "or design the controller for it"
        )
    waits = require_count("delay", (law.delay if law else 0) if delay is None else delay, 0)
    count = _substeps(plant, length, tolerance) if substeps is None else substeps
    made = _Sampled(plant, law, length, waits, require_count("substeps", count))
    return made.block(name or (f"{plant.name}_loop" if law else plant.name))


def _motion(plant: Plant, length: float) -> ca.Function:
    """(x, u, p) -> the state after one step of this length [SI]."""
    nominal = plant.vector("state", attribute="nominal")
    x, u, p = (ca.SX.sym(n, len(plant.vector(n))) for n in ("state", "input", "parameter"))
    slope = plant.function(x * nominal, u, p)[0] / nominal
    slopes = ca.Function("slopes", [x, u, p], [slope, ca.jacobian(slope, x)])

    def slopes_at(z: ca.SX) -> tuple[ca.SX, ca.SX]:
        value, jacobian = slopes.call([z, u, p])
        return value, jacobian

    after = stepped(slopes_at, x / nominal, length, "rosenbrock", 1) * nominal
    return ca.Function("plant_step", [x, u, p], [after], {"cse": True})


def _substeps(plant: Plant, length: float, tolerance: float) -> int:
    """The fewest that follow the plant to the tolerance; see plant_block."""
    nominal = plant.vector("state", attribute="nominal")
    before, inputs, wanted = _jumping_motion(plant, length, min(1e-9, max(0.1 * tolerance, 1e-12)))
    p, count = plant.vector("parameter"), 1
    while count <= MOST:
        step = _motion(plant, length / count).fold(count)
        found = np.asarray(step(before.T, np.repeat(inputs.T, count, axis=1), p), dtype=float).T
        missed = ~(np.max(np.abs(found - wanted) / nominal, axis=1) <= tolerance)
        if not missed.any():
            return count
        before, inputs, wanted = before[missed], inputs[missed], wanted[missed]
        count *= 2
    raise InputError(
        f"sample_time = {length:g} s: even {MOST} substeps do not follow {plant.name!r} to "
        f"tolerance = {tolerance:g}; sample more often, or give a larger tolerance"
    )


def _jumping_motion(plant: Plant, length: float, rtol: float) -> tuple[Array, Array, Array]:
    """(state before, inputs held, state after), one row a sample, as the inputs jump over their
    ranges; an input without an end goes a nominal value beyond its start.
    """
    start, nominal = plant.vector("input"), plant.vector("input", attribute="nominal")
    low, high = (
        np.where(np.isfinite(end), end, start + side * nominal)
        for side, end in (
            (-1, plant.vector("input", attribute="min")),
            (1, plant.vector("input", attribute="max")),
        )
    )
    random = np.random.default_rng(0).uniform(low, high, (LEVELS - 3, len(start)))
    samples = min(max(1, round(HELD_FOR / length)), LONGEST)
    exact = SampledPlant(plant, samples * length, rtol, samples)
    x = plant.vector("state")
    rows: list[tuple[Array, Array, Array]] = []
    for u in (start, high, low, *random):
        try:
            after = exact(x, u)
        except RuntimeError:  # where no motion leads on, substeps need not follow
            if not rows:
                raise
            break
        rows.append((np.vstack([x, after[:-1]]), np.tile(u, (samples, 1)), after))
        x = after[-1]
    before, inputs, wanted = (np.vstack(part) for part in zip(*rows, strict=True))
    return before, inputs, wanted


class _Sampled:
    """The variables of the block, who feeds whom, and its step."""

    def __init__(
        self, plant: Plant, law: Block | None, length: float, delay: int, substeps: int
    ) -> None:
        self.plant, self.law, self.length = plant, law, length
        self.delay, self.substeps = delay, substeps
        controls = tuple(v.name for v in plant.inputs if not v.disturbance)
        self.commands = law.commands if law else controls
        known = {v.name for v in plant.inputs}
        foreign = next((c for c in self.commands if c not in known), None)
        if law and (foreign or not self.commands):
            what = f"{foreign} is no input of it" if foreign else f"{law.name} gives no commands"
            raise InputError(f"controller: {what}; give the controller of {plant.name!r}")

    def block(self, name: str) -> Block:
        plant, law = self.plant, self.law
        alone = f"{plant.name} in steps of {1e3 * self.length / self.substeps:g} ms"
        words = f"{law.name} drives {alone}" if law else alone
        draft = Draft(name, self.length, words, ca.MX)
        draft.repeats("steps of the plant", self.substeps)
        p = [draft.parameter(v.name, v.start or 0.0, **_range(v)) for v in plant.parameters]
        held = {  # what acted since the last sample
            v.name: draft.memory(HELD + v.name, v.start or 0.0, **about(v, "acts until now"))
            for v in plant.inputs
        }
        x, y = self._moved(draft, ca.vertcat(*held.values()), ca.vertcat(*p))
        seen = {v.name: y[i] for i, v in enumerate((*plant.states, *plant.outputs))}
        for v in (*plant.states, *plant.outputs):
            draft.output(Variable(v.name, "output", start=v.start, **about(v)), seen[v.name])
        for v, value in zip(plant.states, x, strict=True):
            draft.next(STATE + v.name, value)
        acting = self._answer(draft, seen) if law else {}
        for v in plant.inputs:
            if v.name not in acting:
                acting[v.name] = draft.input(v.name, v.start or 0.0, **_range(v))
            # a command acts after the delay, a disturbance at once
            delay = self.delay if v.name in self.commands else 0
            draft.next(HELD + v.name, draft.delayed(v, acting[v.name], delay))
        made = draft.block()
        shown = {v.name for v in (*made.inputs, *made.outputs)}
        flags = law.flags if law else {}
        return replace(made, flags={k: v for k, v in flags.items() if k in shown})

    def _moved(self, draft: Draft, u: Any, p: Any) -> tuple[list[Any], Any]:
        """The states at this sample, and all that is seen of the plant."""
        plant = self.plant
        before = ca.vertcat(
            *(draft.memory(STATE + v.name, v.start or 0.0, **about(v)) for v in plant.states)
        )
        step, after = _motion(plant, self.length / self.substeps), before
        for _ in range(self.substeps):
            after = step(after, u, p)
        x = ca.if_else(draft.started, after, before)
        return list(ca.vertsplit(x)), ca.vertcat(x, plant.function(x, u, p)[1])

    def _answer(self, draft: Draft, seen: dict[str, Any]) -> dict[str, Any]:
        """The law's commands by name; its outputs, memory and parameters become the block's."""
        law = self.law
        assert law is not None
        given = [
            seen[v.name]
            if v.name in seen
            else draft.input(v.name, v.start or 0.0, missing=v.name in law.missing, **_range(v))
            for v in law.inputs
        ]
        _, _, answer = draft.call(law, column_of(ca.MX, given), f"{law.name}.")
        for i, v in enumerate(law.outputs):
            taken = v.name in seen or v.name in {w.name for w in law.inputs}
            draft.output(replace(v, name=f"{law.name}.{v.name}" if taken else v.name), answer[i])
        for what, count in law.loops.items():
            draft.repeats(what, count)
        return {v.name: answer[i] for i, v in enumerate(law.outputs) if v.name in law.commands}


def _range(v: Variable) -> dict[str, Any]:
    return {**about(v), "min": v.min, "max": v.max}
