"""Feed-forward through the inverse of the hysteresis as a block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ...core.block import Block
from ..compensation import BISECTIONS, HysteresisCompensation
from ..memory_model import PARTS, MemoryModel
from ..pid import PID
from .draft import Draft, Symbol, as_output, sent_by
from .kinds import BLOCKS
from .pid import pid_law
from .position import at_an_end, pressures_of, wanted_motion, wanted_stiffness

__all__ = ["hysteresis_compensation"]


@BLOCKS.register("HysteresisCompensation")
def hysteresis_compensation(
    controller: HysteresisCompensation, name: str = "compensation"
) -> Block:
    """Tracks a position by the inverse of the model, as :class:`HysteresisCompensation`.

    Inputs are the states that the feed needs, and what is to be reached: ``wanted.*`` now and
    ``ahead.*`` one sample later (position, velocity, acceleration, for a pair stiffness). The
    reference is to be smooth: a target has no preview by which to round it off.
    """
    return _Compensation(controller, name).block()


@dataclass
class _Compensation:
    owner: HysteresisCompensation
    name: str

    def __post_init__(self) -> None:
        o = self.owner
        self.inverse, self.plant = o.inverse, o.plant
        words = "feed-forward by the inverse of the hysteresis"
        self.draft = Draft(self.name, o.sample_time, words, ca.MX)
        self.model = MemoryModel(o.plant, o.inverse.position, o.inverse.velocity)

    def _reference(self, first: str) -> tuple[Symbol, Symbol, Symbol, Symbol | None]:
        x = self.plant.variable(self.inverse.position).start or 0.0
        motion = wanted_motion(self.draft, self.inverse, (x, 0.0, 0.0), first)
        k = None
        if self.owner.stiffness is not None:
            k = wanted_stiffness(self.draft, self.plant, self.owner.stiffness, first)
        return (*motion, k)

    def block(self) -> Block:
        draft, o, muscles = self.draft, self.owner, self.inverse.muscles
        x, v, a, k = self._reference("wanted")
        ahead = self._reference("ahead")
        started = draft.memory("started", description="1 after the first step")
        held = {n: draft.memory(f"memory.{n}", s) for n, s in self.model.values.items()}
        kept = [draft.memory(f"model.{m}.pressure", unit="Pa", nominal=1e5) for m in muscles]
        first = pressures_of(draft, self.inverse, x, v, a, k, held)
        now = [ca.if_else(started, p, first[i]) for i, p in enumerate(kept)]
        added: list[Any] = [ca.MX(0)] * len(muscles)
        if o.frequency:
            error = x - draft.like(self.plant.variable(self.inverse.position))
            saturated = draft.memory("saturated", description="a pressure was at an end")
            frozen = ca.logic_or(saturated, draft.held_back)
            more = pid_law(draft, PID.placed(o.frequency), error, frozen)
            wanted = pressures_of(draft, self.inverse, x, v, a + more, k, held)
            added = [wanted[i] - p for i, p in enumerate(now)]
            draft.next("saturated", at_an_end(self.inverse, wanted))
        after = self._moved(held, x, ahead[0], kept, started) if o.compensate else held
        coming = pressures_of(draft, self.inverse, *ahead, after)
        targets = {
            m: (now[i] + added[i], (coming[i] - now[i]) / o.sample_time)
            for i, m in enumerate(muscles)
        }
        for n, value in after.items():
            draft.next(f"memory.{n}", value)
        for i, m in enumerate(muscles):
            draft.next(f"model.{m}.pressure", coming[i])
        draft.next("started", ca.MX(1))
        self._send(targets)
        return draft.block()

    def _moved(
        self, held: Mapping[str, Symbol], x: Symbol, to: Symbol, p: list[Symbol], started: Symbol
    ) -> dict[str, Symbol]:
        """The memories a sample later; see :meth:`MemoryModel.move`."""
        model, time = self.model, self.owner.sample_time
        if not held:
            return {}
        memory: Any = ca.vertcat(*held.values())
        known: dict[int, Any] = {model._at[1]: (to - x) / time}
        for m, value in zip(self.inverse.muscles, p, strict=True):
            place = model._index[f"{m}.pressure"]
            known[place] = ca.if_else(started, value, float(model._start[place]))
        for i in range(PARTS):
            known[model._at[0]] = x + (to - x) * (i + 0.5) / PARTS
            z = ca.vertcat(*(known.get(j, float(s)) for j, s in enumerate(model._start)))
            memory = model.part(memory, z, time / PARTS, ca.DM(model._p))
        self.draft.repeats("steps of the hysteresis", PARTS)
        kept = [
            ca.fmin(ca.fmax(memory[i], float(low)), float(high))
            for i, (low, high) in enumerate(zip(model._low, model._high, strict=True))
        ]
        return dict(zip(held, kept, strict=True))

    def _send(self, targets: Mapping[str, tuple[Symbol, Symbol]]) -> None:
        feed, draft = self.owner.inputs, self.draft
        inner = feed.inversion.inner
        found: dict[str, Any] = {f"{m}.pressure": targets[m][0] for m in feed._set}
        for m, (place, function, ends) in feed._solved.items():
            wanted, slope = targets[m]
            measured = draft.like(inner.variable(f"{m}.pressure"))
            rate = slope + (wanted - measured) / self.owner.pressure_time
            found[feed._inputs[place]] = self._solve(m, function, place, rate, ends)
        sent = sent_by(feed.inversion, found, draft)
        if feed._loop is not None:
            names = {f"{m}.pressure": draft.like(inner.variable(f"{m}.pressure")) for m in targets}
            asked = feed._loop.inputs({m: p for m, (p, _) in targets.items()}, names)
            there = {v.name for v, _ in sent}
            more = sent_by(feed._loop.inversion, asked, draft)
            sent += [(v, value) for v, value in more if v.name not in there]
        for variable, value in sent:
            draft.output(as_output(variable), value, command=True)

    def _solve(
        self, m: str, function: ca.Function, place: int, rate: Symbol, ends: tuple[float, float]
    ) -> Symbol:
        """The input at which the pressure has a rate, as _PressureInputs._solve."""
        feed, (low, high) = self.owner.inputs, ends
        inner = feed.inversion.inner
        sizes = {"x": len(inner.states), "u": 1, "rate": 1, "s": 6}
        x, u, wanted, s = (ca.SX.sym(n, k) for n, k in sizes.items())
        every = ca.SX(ca.DM(feed._u))
        every[place] = u
        value = function(x, every, ca.DM(feed._p))
        missed = ca.Function(f"missed_{m}", [x, u, wanted], [value - wanted])
        needed = set(ca.jacobian(value, x).sparsity().get_col())
        states = [
            self.draft.like(v) if i in needed else float(v.start or 0.0)
            for i, v in enumerate(inner.states)
        ]
        one = _regula_falsi(missed, x, wanted, s)
        at: Any = ca.vertcat(*states)
        first, last = missed(at, low, rate), missed(at, high, rate)
        begun = ca.if_else(first >= 0, low, high)
        done = ca.logic_or(first >= 0, last <= 0)
        state: Any = ca.vertcat(low, high, first, last, done, begun)
        for _ in range(BISECTIONS):
            state = one(at, rate, state)
        self.draft.repeats("steps for the inputs that give the pressures their rates", BISECTIONS)
        return ca.if_else(state[4], state[5], state[1])


def _regula_falsi(missed: ca.Function, x: ca.SX, wanted: ca.SX, s: ca.SX) -> ca.Function:
    """One step of the Illinois method; s = (low, high, first, last, done, answer)."""
    low, high, first, last, done, answer = ca.vertsplit(s)
    slope = last - first
    middle = high - last * (high - low) / ca.if_else(ca.fabs(slope) > 0, slope, 1)
    value = missed(x, middle, wanted)
    hit = ca.fabs(value) <= 1e-9 * ca.fabs(wanted) + 1e-6
    across = value * last < 0
    moved = [
        ca.if_else(across, high, low),
        middle,
        ca.if_else(across, last, first / 2),
        value,
        hit,
        ca.if_else(hit, middle, answer),
    ]
    after = [ca.if_else(done, old, new) for old, new in zip(ca.vertsplit(s), moved, strict=True)]
    return ca.Function("regula_falsi", [x, wanted, s], [ca.vertcat(*after)], {"cse": True})
