"""Feed-forward through the exact inverse of the hysteresis, for tracking without its error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ..core.block import Block
from ..core.errors import InputError, require_finite, require_positive
from ..core.stop import locked, turns
from ..numerics.rosenbrock import rodas3
from ..plants.inversion import Inversion
from ..plants.plant import Plant
from .blocks.draft import Draft, Symbol, clipped
from .blocks.running import Running, SampledLaw
from .inverse import (
    InverseDynamics,
    pressures_of,
    stiffness_of,
    unreached,
    wanted_motion,
    wanted_stiffness,
)
from .kinds import BLOCKS, CONTROLLERS, law_of
from .pid import PID, PressureLoop, out_of_reach, pid_law
from .references import Source, source

KERNEL: list[tuple[float, float, float]] = [
    ((n + 1) / 2, w / 2, w / 2 * (1 - (n + 1) / 2))
    for n, w in zip(*(e.tolist() for e in np.polynomial.legendre.leggauss(6)), strict=True)
]
"""Gauss's rule: parts of a kernel's half width, weights, and weights times the kernel."""
BISECTIONS = 60
PARTS = 32
"""Steps of the integrator per sample: finer than the edge of an element that begins to slide."""


@locked
@CONTROLLERS.register("hysteresis-compensation")
class HysteresisCompensation:
    """Tracks a position by the inverse of the model, the memory of its losses included.

    The reference is followed in the model: hysteresis and creep are integrated along it
    (:class:`MemoryModel`), the equation of motion with what they hold gives the pressures, and the
    feed's own equation the inputs that make these pressures. So the operator from contraction to
    force is inverted as it stands, whatever losses with memory there are; with sharp elements that
    is the exact inverse of Prandtl-Ishlinskii (see :meth:`PrandtlIshlinskii.elements`). A PID
    corrects what the model does not know.

    Parameters
    ----------
    plant : the model: one position, moved by one muscle or a pair. What its memories hold at the
        beginning are its start values.
    sample_time : [s].
    frequency : bandwidth of the PID [Hz], see :meth:`PID.placed`; 0 for none: feed-forward alone.
    compensate : False leaves the memories as they start, for comparison; all else stays.
    stiffness : of a pair, to be held [N/m or N.m/rad], where the reference says none; by default
        that of the plant at its start values.
    rounding : time [s] over which corners of the reference are smoothed, by a triangular kernel
        of half this width to either side; a corner would ask for an infinite acceleration.
    pressure_time : time constant [s] in which pressures come back to those wanted.

    It is told by the loop what to track, ``closed_loop(controller, plant, {"x": ...})``. Where the
    loop gives no preview, it tracks the reference late by ``rounding``/2.

    Raises InputError for a plant that :class:`InverseDynamics` cannot invert.

    Source: inverse compensation by feed-forward, K. Kuhnen, H. Janocha, Control and Intelligent
    Systems 29 (2001) 74-79; for muscles Y. Liu et al., 2017.

    Examples
    --------
    >>> sticky = pam.HangingLoad(muscle, mass=10.0, losses=pam.losses.MaxwellSlip())
    >>> start = sticky.equilibrium(x=0.04)
    >>> law = pam.control.HysteresisCompensation(sticky.with_values(start), sample_time=5e-3)
    >>> wanted = {"x": lambda t: 0.04 + 0.005 * np.sin(6 * t)}
    >>> loop = pam.closed_loop(law, sticky, wanted, duration=1.0, start=start)
    >>> abs(loop.steady_error("x", 0.5)) < 1e-4
    True
    """

    def __init__(
        self,
        plant: Plant,
        *,
        sample_time: float = 0.002,
        frequency: float = 0.0,
        compensate: bool = True,
        stiffness: float | None = None,
        rounding: float = 0.04,
        pressure_time: float = 0.02,
    ) -> None:
        self.plant = plant
        self.inverse = InverseDynamics(plant)
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.frequency = require_positive("frequency", frequency, "Hz", zero=True)
        self.rounding = require_positive("rounding", rounding, "s")
        self.pressure_time = require_positive("pressure_time", pressure_time, "s")
        self.compensate = bool(compensate)
        self.stiffness = None
        if len(self.inverse.muscles) == 2:
            given = stiffness_of(plant) if stiffness is None else stiffness
            self.stiffness = require_finite("stiffness", given, plant.variable("stiffness").unit)
        elif stiffness is not None:
            raise InputError("stiffness: one muscle alone has no choice of it; leave it out")
        self.inputs = _PressureInputs(plant, self.inverse.muscles)

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> _Tracking:
        """The Controller that tracks ``reference``; see :class:`Tracking`."""
        known = {self.inverse.position} | ({"stiffness"} if self.stiffness is not None else set())
        for name in reference:
            if name not in known:
                raise InputError(
                    f"reference: {name} is not tracked; give {' and '.join(sorted(known))}"
                )
        if self.inverse.position not in reference:
            raise InputError(f"reference: give {self.inverse.position}, the position to be tracked")
        return _Tracking(self, reference, preview)


class _Tracking(SampledLaw):
    """One run of a HysteresisCompensation."""

    def __init__(
        self, owner: HysteresisCompensation, reference: Mapping[str, Source], preview: bool
    ) -> None:
        self.owner, self.plant, self.sample_time = owner, owner.plant, owner.sample_time
        inverse = owner.inverse
        self._path = Rounded(reference[inverse.position], owner.rounding / 2, preview)
        self._stiffness = reference.get(
            "stiffness", None if owner.stiffness is None else source("stiffness", owner.stiffness)
        )
        self._raw = reference
        self._names = (inverse.position, inverse.velocity, "acceleration", "stiffness")

    @turns
    def _running(self) -> Running:
        return Running(law_of(self.owner), self._needed())

    def _needed(self) -> set[str]:
        inverse = self.owner.inverse
        return {inverse.position, *(f"{m}.pressure" for m in inverse.muscles)}

    def wanted(self, t: float) -> dict[str, float]:
        """What is to be reached at a time [s]."""
        return {n: at(t) for n, at in self._raw.items()}

    def _references(self, t: float) -> dict[str, float]:
        references: dict[str, float] = {}
        for first, time in (("wanted", t), ("ahead", t + self.sample_time)):
            values = [*self._path(time)]
            if self._stiffness is not None:
                values.append(self._stiffness(time))
            references |= {f"{first}.{n}": v for n, v in zip(self._names, values, strict=False)}
        return references


class Rounded:
    """A reference with its velocity and acceleration, corners rounded by a triangular kernel.

    Of half width h: x = integral of the kernel times the reference, and so, exactly,
    x'' = [r(t + h) - 2 r(t) + r(t - h)]/h^2. late : without preview the kernel lies in the past.
    """

    def __init__(self, reference: Source, half: float, preview: bool) -> None:
        self._reference, self._half, self._late = reference, half, 0.0 if preview else half

    def __call__(self, t: float) -> tuple[float, float, float]:
        h, middle, at = self._half, t - self._late, self._reference
        x = v = 0.0
        for part, weight, falling in KERNEL:  # at rest before the beginning
            later, before = at(max(middle + h * part, 0.0)), at(max(middle - h * part, 0.0))
            x += falling * (later + before)
            v += weight * (later - before)
        bend = at(max(middle + h, 0.0)) - 2 * at(max(middle, 0.0)) + at(max(middle - h, 0.0))
        return x, v / h, bend / h**2


class MemoryModel:
    """States with memory (hysteresis, creep) while position and pressures move as is said.

    plant : what is believed of the muscles. Hysteresis and creep need the motion alone, so they are
    integrated along it without the rest of the plant. values : the memories at the beginning.
    """

    def __init__(self, plant: Plant, position: str, velocity: str) -> None:
        self._plant, self._at = plant, (position, velocity)
        self.start = {v.name: v.start or 0.0 for v in (*plant.states, *plant.inputs)}
        self._memories = [v for v in plant.states if v.memory]
        self.values = {v.name: self.start[v.name] for v in self._memories}
        self._step = self._build() if self.values else None

    def _build(self) -> ca.Function:
        """(memories, all states and inputs, duration) -> memories."""
        plant = self._plant
        z = ca.vertcat(plant.x, plant.u)
        places = [i for i, n in enumerate(self.start) if n in self.values]
        rates = ca.vertcat(*(plant.expression(f"der({n})") for n in self.values))
        slope = ca.densify(ca.jacobian(rates, z)[:, places])
        system = ca.Function("rates", [z, plant.p], [rates, slope])
        memory, full, duration = (
            ca.SX.sym(n, k) for n, k in (("m", len(places)), ("z", z.numel()), ("h", 1))
        )

        def slopes(x: ca.SX) -> tuple[ca.SX, ca.SX]:
            here = ca.SX(full)
            here[places] = x
            rate, steep = system(here, plant.vector("parameter"))
            return rate, steep

        return ca.Function("memory", [memory, full, duration], [rodas3(slopes, memory, duration)])

    def moved(
        self,
        memory: Symbol,
        way: tuple[Symbol, Symbol],
        known: Mapping[str, Symbol],
        duration: float,
    ) -> Symbol:
        """The memories after a move from one position to another at an even speed.

        known : other states and inputs by name, the pressures among them.
        """
        assert self._step is not None
        position, velocity = self._at
        begin, end = way
        z = {**self.start, **known, velocity: (end - begin) / duration}
        for i in range(PARTS):
            z[position] = begin + (end - begin) * (i + 0.5) / PARTS
            memory = self._step(memory, ca.vertcat(*z.values()), duration / PARTS)
        ends = ([getattr(v, end) for v in self._memories] for end in ("min", "max"))
        return clipped(memory, *ends)


class _PressureInputs:
    """Inputs that give pressures the rates wanted, by the feeds' own equations.

    Where a pressure answers to no input at once (a tube between), a :class:`PressureLoop`.
    """

    def __init__(self, plant: Plant, muscles: list[str]) -> None:
        self.inversion = Inversion(plant)
        inner = self.inversion.inner
        self._u = inner.vector("input")
        self._p = inner.vector("parameter")
        self._solved: dict[str, tuple[int, ca.Function, tuple[float, float]]] = {}
        self._set: list[str] = []
        chosen = {v.name: i for i, v in enumerate(inner.inputs) if not v.disturbance}
        for m in muscles:
            pressure = f"{m}.pressure"
            if inner.variable(pressure).causality == "input":
                self._set.append(m)
                continue
            rate = inner.expression(f"der({pressure})")
            acts = [n for n in chosen if ca.depends_on(rate, inner.expression(n))]
            if len(acts) == 1:
                v = inner.variable(acts[0])
                function = ca.Function("rate", [inner.x, inner.u, inner.p], [rate])
                self._solved[m] = chosen[acts[0]], function, (v.min, v.max)
        self._inputs = [v.name for v in inner.inputs]
        known = {*self._set, *self._solved}
        self._loop = None if known >= set(muscles) else PressureLoop(plant)

    def enter(
        self, draft: Draft, targets: Mapping[str, tuple[Symbol, Symbol]], time: float
    ) -> None:
        """The commands for {muscle: (pressure, its rate)}, as outputs of a block."""
        inner = self.inversion.inner
        values: dict[str, Any] = {f"{m}.pressure": targets[m][0] for m in self._set}
        for m, (index, function, ends) in self._solved.items():
            wanted, slope = targets[m]
            rate = slope + (wanted - draft.like(inner.variable(f"{m}.pressure"))) / time
            values[self._inputs[index]] = self._solve(draft, m, function, index, rate, ends)
        draft.drive(self.inversion, values)
        if self._loop is not None:
            names = {f"{m}.pressure": draft.like(inner.variable(f"{m}.pressure")) for m in targets}
            asked = self._loop.inputs({m: p for m, (p, _) in targets.items()}, names)
            draft.drive(self._loop.inversion, asked)

    def _solve(
        self,
        draft: Draft,
        m: str,
        function: ca.Function,
        index: int,
        rate: Symbol,
        ends: tuple[float, float],
    ) -> Symbol:
        """The input at which the pressure has this rate, or the nearer end (it rises with it)."""
        inner, (low, high) = self.inversion.inner, ends
        sizes = {"x": len(inner.states), "u": 1, "rate": 1, "s": 6}
        x, u, wanted, s = (ca.SX.sym(n, k) for n, k in sizes.items())
        every = ca.SX(ca.DM(self._u))
        every[index] = u
        value = function(x, every, ca.DM(self._p))
        missed = ca.Function(f"missed_{m}", [x, u, wanted], [value - wanted])
        needed = set(ca.jacobian(value, x).sparsity().get_col())
        states = [
            draft.like(v) if i in needed else float(v.start or 0.0)
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
        draft.repeats("steps for the inputs that give the pressures their rates", BISECTIONS)
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


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("HysteresisCompensation")
def hysteresis_compensation(
    controller: HysteresisCompensation, name: str = "compensation"
) -> Block:
    """Tracks a position by the inverse of the model, as :class:`HysteresisCompensation`.

    Inputs are the states that the feed needs, and what is to be reached: ``wanted.*`` now and
    ``ahead.*`` one sample later (position, velocity, acceleration, for a pair stiffness). The
    reference is to be smooth: a target has no preview by which to round it off.
    """
    o, inverse, muscles = controller, controller.inverse, controller.inverse.muscles
    draft = Draft(name, o.sample_time, "feed-forward by the inverse of the hysteresis", ca.MX)
    model = MemoryModel(o.plant, inverse.position, inverse.velocity)
    position = o.plant.variable(inverse.position)

    def reference(first: str) -> tuple[Symbol, Symbol, Symbol, Symbol | None]:
        motion = wanted_motion(draft, inverse, (position.start or 0.0, 0.0, 0.0), first)
        k = None if o.stiffness is None else wanted_stiffness(draft, o.plant, o.stiffness, first)
        return (*motion, k)

    (x, v, a, k), ahead = reference("wanted"), reference("ahead")
    started = draft.started
    held = {n: draft.memory(f"memory.{n}", s) for n, s in model.values.items()}
    modelled = [draft.memory(f"model.{m}.pressure", unit="Pa", nominal=1e5) for m in muscles]
    first = pressures_of(draft, inverse, x, v, a, k, held)
    now = [ca.if_else(started, p, first[i]) for i, p in enumerate(modelled)]
    added: list[Any] = [ca.MX(0)] * len(muscles)
    if o.frequency:
        error = x - draft.like(position)
        more = pid_law(draft, PID.placed(o.frequency), error, out_of_reach(draft))
        wanted = pressures_of(draft, inverse, x, v, a + more, k, held)
        added = [wanted[i] - p for i, p in enumerate(now)]
        draft.next("saturated", unreached(inverse, x, v, a + more, wanted, held))
    after = held
    if held and o.compensate:
        starts = (model.start[f"{m}.pressure"] for m in muscles)
        known = {
            f"{m}.pressure": ca.if_else(started, p, start)
            for m, p, start in zip(muscles, modelled, starts, strict=True)
        }
        moved = model.moved(ca.vertcat(*held.values()), (x, ahead[0]), known, o.sample_time)
        after = dict(zip(held, ca.vertsplit(moved), strict=True))
        draft.repeats("steps of the hysteresis", PARTS)
    coming = pressures_of(draft, inverse, *ahead, after)
    targets = {
        m: (now[i] + added[i], (coming[i] - now[i]) / o.sample_time) for i, m in enumerate(muscles)
    }
    for n, value in after.items():
        draft.next(f"memory.{n}", value)
    for i, m in enumerate(muscles):
        draft.next(f"model.{m}.pressure", coming[i])
    o.inputs.enter(draft, targets, o.pressure_time)
    return draft.block()
