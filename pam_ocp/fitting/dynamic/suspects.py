"""What a plant may lack, as parameters that are zero: their sensitivities are the directions in
which residuals point if it is so.

A score test asks nothing else of a model than the slope of its residuals in a parameter that is
held at zero (C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50-57). So the fitted plant gets a
force against the motion, fitted values that run away with time, inputs that act late or otherwise
scaled, and runs as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ...core.trajectory import Trajectory
from ...core.units import per_second
from ...plants.plant import Plant
from ...plants.undelayed import Redeclared
from ..statistics import Array
from .experiment import ParameterGroup, with_columns

CAUSES = ("drift", "friction or hysteresis", "scale", "lag", "floor", "law")
"""What is looked for, besides noise that is not white. ``law``: a force that depends on position or
speed in another way than the model's."""
LAGS = (1.0, 5.0, 20.0)
"""Of inputs that act late, in samples: first order each, so that together they are any short delay.
"""
STICK = 0.05
"""Speed, in root mean squares, at which friction has reached its size."""
PRESLIDING = 0.05
"""Way, in ranges of the position, after which hysteresis has."""


@dataclass(frozen=True)
class Suspect:
    """A parameter at zero, which counts in ``size`` [unit]. subject : what it changes."""

    cause: str
    subject: str
    unit: str = "1"
    size: float = 1.0


@dataclass(frozen=True, eq=False)
class Suspected:
    """The plant with suspects as its last parameters, and what these need of records and delays."""

    plant: Plant
    records: Sequence[Trajectory]
    groups: tuple[ParameterGroup, ...]
    suspects: tuple[Suspect, ...]
    delays: Mapping[str, float]


class _Builder:
    """Declares the plant once more, with suspects. meant : what stands for each variable."""

    def __init__(self, plant: Plant) -> None:
        again = Redeclared(plant)
        self.again, self.plant, self.made = again, plant, again.made
        self.symbols, self.meant = again.own, again.symbols
        self.push: dict[str, ca.SX] = {}
        self.memory: dict[str, ca.SX] = {}
        self.suspects: list[Suspect] = []
        self.columns: dict[str, list[Array]] = {}
        self.delays: dict[str, float] = {}

    def amount(self, cause: str, subject: str, unit: str = "1", size: float = 1.0) -> ca.SX:
        self.suspects.append(Suspect(cause, subject, unit, size))
        return self.made.parameter(f"suspect{len(self.suspects)}", 0.0)

    def input(self, columns: Sequence[Array], delay: float = 0.0) -> ca.SX:
        name = f"suspect.input{len(self.columns) + 1}"
        self.columns[name] = list(columns)
        if delay:
            self.delays[name] = delay
        return self.made.input(name)

    def finished(self) -> Plant:
        found = self.again.equations()
        for name, push in self.push.items():
            found[name] += push
        return self.again.finished(found | self.memory, constraints=False)


def suspected(
    plant: Plant,
    records: Sequence[Trajectory],
    groups: Sequence[ParameterGroup],
    delays: Mapping[str, float],
    outputs: Sequence[str] = (),
) -> Suspected:
    """delays : of inputs [s]. records : whose inputs are all columns. outputs : measured."""
    b = _Builder(plant)
    clocks = [b.input(c) for c in _clocks(records)]
    for g in groups:
        run = sum(b.amount("drift", g.name) * c for c in clocks)
        for m in g.members:
            name = plant.parameters[m].name
            b.meant[name] = b.meant[name] + run * (abs(g.value) or g.scale)
    for v in plant.inputs:
        _input_suspects(b, v.name, records, delays.get(v.name, 0.0), clocks)
    shown = [n for n in outputs if plant.variable(n).causality == "output"]
    forces = [n for n in shown if plant.variable(n).unit == "N"]
    for position, velocity in plant.positions.items():
        _force_suspects(b, position, velocity, records, forces)
    made = b.finished()
    later = [v.name for v in made.parameters][len(plant.parameters) :]
    extra = tuple(
        ParameterGroup(n, (len(plant.parameters) + i,), 0.0, 1.0, -np.inf, np.inf, s.unit, "")
        for i, (n, s) in enumerate(zip(later, b.suspects, strict=True))
    )
    wider = [
        with_columns(r, {n: c[i] for n, c in b.columns.items()}) for i, r in enumerate(records)
    ]
    return Suspected(made, wider, (*groups, *extra), tuple(b.suspects), b.delays)


def _clocks(records: Sequence[Trajectory]) -> list[list[Array]]:
    """Time over all records, from 0 to 1; of several also the time in each."""
    ends = np.cumsum([0.0, *(r.duration for r in records)])
    along = [(e + r.t - r.t[0]) / ends[-1] for e, r in zip(ends[:-1], records, strict=True)]
    if len(records) < 2:
        return [along]
    return [along, [(r.t - r.t[0]) / r.duration for r in records]]


def _input_suspects(
    b: _Builder,
    name: str,
    records: Sequence[Trajectory],
    delay: float,
    clocks: Sequence[ca.SX],
) -> None:
    """An input that acts otherwise scaled, with an offset, drifting, late."""
    u, size = b.symbols[name], max(float(np.ptp(np.concatenate([r[name] for r in records]))), 1e-30)
    changed = b.amount("scale", name) * u
    changed += b.amount("scale", name, b.plant.variable(name).unit, size) * size
    changed += sum(b.amount("drift", name) * c * u for c in clocks)
    for lag in LAGS:
        keep = float(np.exp(-1 / lag))
        late = [_filtered(r[name], keep) - r[name] for r in records]
        changed += b.amount("lag", name) * b.input(late, delay)
    b.meant[name] = u + changed


def _filtered(u: Array, keep: float) -> Array:
    """First order, at rest before."""
    from scipy.signal import lfilter

    found, _ = lfilter([1 - keep], [1, -keep], u, zi=[keep * u[0]])
    return np.asarray(found)


def _force_suspects(
    b: _Builder,
    position: str,
    velocity: str,
    records: Sequence[Trajectory],
    shown: Sequence[str],
) -> None:
    """Forces (accelerations) against the motion, and others that position and speed make. shown :
    measured forces, which are those of a muscle with what acts inside it, or without.
    """
    q, w = b.symbols[position], b.symbols[velocity]
    middle, reach, speed = _sizes(b.plant, position, velocity, records)
    held = b.again.state(f"{velocity}.suspect", min=-1.0, max=1.0)
    b.memory[f"{velocity}.suspect"] = (w - ca.fabs(w) * held) / (PRESLIDING * reach)
    x, v = (q - middle) / reach, w / speed
    pushes = [
        ("friction or hysteresis", -ca.tanh(w / (STICK * speed))),
        ("friction or hysteresis", -held),
        *(("law", f) for f in (x, x**2, x**3, -v, -v * ca.fabs(v))),
    ]
    units = {velocity: per_second(b.plant.variable(velocity).unit), **dict.fromkeys(shown, "N")}
    for pushed, unit in units.items():
        forces = [b.amount(cause, pushed, unit) * f for cause, f in pushes]
        b.push[pushed] = b.push.get(pushed, ca.SX(0)) + ca.sum1(ca.vertcat(*forces))


def _sizes(
    plant: Plant, position: str, velocity: str, records: Sequence[Trajectory]
) -> tuple[float, float, float]:
    """Middle, reach and speed of a motion, as measured or by nominals."""
    if position not in records[0]:
        q, w = plant.variable(position), plant.variable(velocity)
        return float(q.start or 0.0), q.nominal, w.nominal
    every = np.concatenate([r[position] for r in records])
    low, high = float(every.min()), float(every.max())
    speeds = np.concatenate([np.gradient(_smooth(r[position]), r.t) for r in records])
    reach = max((high - low) / 2, 1e-6 * plant.variable(position).nominal)
    return (low + high) / 2, reach, max(float(np.sqrt(np.mean(speeds**2))), 1e-9 * reach)


def _smooth(x: Array) -> Array:
    """Means of five."""
    padded = np.concatenate([np.full(2, x[0]), x, np.full(2, x[-1])])
    return np.convolve(padded, np.full(5, 0.2), "valid")


def sensor_suspects(
    outputs: Sequence[tuple[str, str]], modelled: Sequence[Array], measured: Sequence[Array]
) -> list[tuple[Suspect, list[Array]]]:
    """What sensors may do, with its slope (K, ny) in each motion; ``outputs`` : (name, unit)."""
    total = float(sum(map(len, modelled)))
    firsts = np.cumsum([0, *map(len, modelled)])
    found: list[tuple[Suspect, list[Array]]] = []
    for j, (name, unit) in enumerate(outputs):
        every = np.concatenate([y[:, j] for y in measured])
        size = max(float(every.std()), 1e-300)
        low, high = np.percentile(every, [2, 98])

        def only(values: Sequence[Array], place: int = j) -> list[Array]:
            return [
                np.stack([v if i == place else 0 * v for i in range(len(outputs))], axis=1)
                for v in values
            ]

        own = [y[:, j] for y in modelled]
        clock = [(f + np.arange(len(y))) / total for f, y in zip(firsts, own, strict=False)]
        along = [c * y for c, y in zip(clock, own, strict=True)]
        found += [
            (Suspect("scale", name), only(own)),
            (Suspect("scale", name, unit, size), only([size + 0 * y for y in own])),
            (Suspect("drift", f"the scale of {name}"), only(along)),
            (Suspect("drift", f"the zero of {name}", unit, size), only([size * c for c in clock])),
            (Suspect("lag", f"the sensor of {name}"), only([np.gradient(y) for y in own])),
            (Suspect("floor", name), only([np.maximum(low - y, 0.0) for y in own])),
            (Suspect("floor", name), only([np.maximum(y - high, 0.0) for y in own])),
            (Suspect("floor", name), only([size * (y < low) for y in own])),
        ]
    return found
