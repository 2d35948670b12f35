"""What stands between a plant and a record of it: dead times, sensors, starts, a correction by what
is measured, disturbances; each known, or to be estimated along with the plant's parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_finite, require_names, require_positive
from ...core.units import per_second
from ...plants.plant import Plant
from ...plants.undelayed import Redeclared
from ..statistics import Array
from .experiment import ParameterGroup, named

Delay: TypeAlias = "float | tuple[float, float] | Mapping[str, float | tuple[float, float]]"
"""[s] of all inputs, or by input (names, or patterns with one delay in common); a pair is the range
in which it is estimated.
"""


@dataclass(frozen=True)
class Rig:
    """Known figures of a rig. delays : {input: dead time [s]}. gains, offsets : {measured variable:
    of its sensor}: it shows gain x + offset. starts : {state that is not measured: where runs
    begin}. corrections : {(state, measured variable): what the state gains per unit by which the
    model is behind}.
    """

    delays: Mapping[str, float] = field(default_factory=dict)
    gains: Mapping[str, float] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    corrections: Mapping[tuple[str, str], float] = field(default_factory=dict)


KINDS = ("groups", "delays", "gains", "offsets", "starts", "corrections", "own_starts")
"""Of unknowns, in their order; those of the plant and of its sensors first."""
OF_MODEL = KINDS[:4]


@dataclass(frozen=True, eq=False)
class Unknown:
    """A number that is sought; guess and bounds in parts of ``scale``. key : what it belongs to: a
    group of parameters; positions of the inputs that are late, of a measured name (gains less 1),
    of a state (where it begins in all runs, or in one record), of a state and the measured name
    that corrects it.
    """

    kind: str
    key: Any
    name: str
    unit: str
    guess: float
    scale: float
    low: float
    high: float

    @classmethod
    def sized(cls, kind: str, key: Any, name: str, unit: str, *size: float) -> Unknown:
        """size : value, scale, low and high, in the unit."""
        value, scale, low, high = size
        return cls(kind, key, name, unit, value / scale, scale, low / scale, high / scale)

    @classmethod
    def of_group(cls, g: ParameterGroup) -> Unknown:
        return cls.sized("groups", g, g.name, g.unit, g.value, g.scale, g.low, g.high)

    @classmethod
    def of_start(cls, plant: Plant, place: int, kind: str) -> Unknown:
        v = plant.states[place]
        start = float(v.start or 0.0)
        return cls.sized(kind, place, f"{v.name}(0)", v.unit, start, v.nominal, v.min, v.max)


@dataclass(frozen=True, eq=False)
class RunUnknowns:
    """Everything that is sought in free runs: z, scaled, a row for each. rows : in the order of
    KINDS, own starts record after record. records : how many of them have starts of their own.
    along : positions of states whose own starts hold for the begin of a record: runs begin where
    the plant has come by then.
    """

    rows: tuple[Unknown, ...] = ()
    records: int = 1
    along: tuple[int, ...] = ()

    def of(self, kind: str) -> list[tuple[int, Any]]:
        """(position in z, key) of each unknown of a kind."""
        return [(i, r.key) for i, r in enumerate(self.rows) if r.kind == kind]

    @cached_property
    def groups(self) -> tuple[ParameterGroup, ...]:
        return tuple(g for _, g in self.of("groups"))

    @cached_property
    def own_starts(self) -> tuple[int, ...]:
        """Positions of the states that begin in each record by themselves."""
        every = [i for _, i in self.of("own_starts")]
        return tuple(every[: len(every) // max(self.records, 1)])

    @cached_property
    def shared(self) -> int:
        """How many unknowns are the same for all records."""
        return sum(r.kind != "own_starts" for r in self.rows)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(r.name for r in self.rows)

    @cached_property
    def guess(self) -> Array:
        return np.array([r.guess for r in self.rows])

    @cached_property
    def scale(self) -> Array:
        return np.array([r.scale for r in self.rows])

    @cached_property
    def low(self) -> Array:
        return np.array([r.low for r in self.rows])

    @cached_property
    def high(self) -> Array:
        return np.array([r.high for r in self.rows])

    def changed(self, **columns: Sequence[Any] | Array) -> RunUnknowns:
        """With other names, guesses or bounds, one for each."""
        every = [
            dict(zip(columns, own, strict=True)) for own in zip(*columns.values(), strict=True)
        ]
        rows = (replace(r, **own) for r, own in zip(self.rows, every, strict=True))
        return replace(self, rows=tuple(rows))

    def with_more(self, *rows: Unknown) -> RunUnknowns:
        """With more unknowns, each behind those of its kind."""
        every = sorted((*self.rows, *rows), key=lambda r: KINDS.index(r.kind))
        return replace(self, rows=tuple(every))

    @property
    def of_model(self) -> NDArray[np.intp]:
        """Positions in z of what belongs to plant and sensors, not to an observer or a start."""
        return np.nonzero([r.kind in OF_MODEL for r in self.rows])[0]

    def of_motions(self, plant: Plant, motions: int) -> RunUnknowns:
        """What belongs to the model, and where every state begins in each of so many motions."""
        states = range(len(plant.states))
        begin = [Unknown.of_start(plant, i, "own_starts") for i in states] * motions
        model = (r for r in self.rows if r.kind in OF_MODEL)
        return RunUnknowns((*model, *begin), motions)

    def parameters(self, plant: Plant, z: Array) -> dict[str, float]:
        """Values of the plant's parameters at z."""
        return {
            plant.parameters[m].name: float(v * g.scale)
            for g, v in zip(self.groups, z, strict=False)
            for m in g.members
        }

    @cached_property
    def natural(self) -> RunUnknowns:
        """The same, each in its own unit."""
        keys = [replace(r.key, scale=1.0) if r.kind == "groups" else r.key for r in self.rows]
        sizes = {n: getattr(self, n) * self.scale for n in ("guess", "low", "high")}
        return self.changed(key=keys, scale=np.ones(len(keys)), **sizes)

    def vector(self, plant: Plant, z: Any, base: Any = None) -> Any:
        """All parameters of the plant at z, a vector of CasADi; ``base`` those that are known."""
        known = ca.DM(plant.vector("parameter")) if base is None else base
        place, free = np.zeros((known.numel(), len(self.groups))), np.ones(known.numel())
        for j, group in enumerate(self.groups):
            place[list(group.members), j] = group.scale
            free[list(group.members)] = 0.0
        found = ca.sparsify(ca.DM(place)) @ z[: len(self.groups)]
        return ca.sparsify(ca.DM(free)) * known + found

    def sensors(self, measured: Sequence[str], known: Rig, z: Any) -> tuple[list[Any], list[Any]]:
        """Gains and offsets of the sensors at z, numbers or symbols."""
        gains: list[Any] = [known.gains.get(n, 1.0) for n in measured]
        offsets: list[Any] = [known.offsets.get(n, 0.0) for n in measured]
        for j, i in self.of("gains"):
            gains[i] = 1 + z[j]
        for j, i in self.of("offsets"):
            offsets[i] = z[j] * self.scale[j]
        return gains, offsets

    def values(self, z: Array) -> Array:
        """Each in its unit at z."""
        found = z * self.scale
        found[[j for j, _ in self.of("gains")]] += 1.0
        return found

    def begins(self, plant: Plant, z: Array) -> list[dict[str, float]]:
        """Where the states with starts of their own begin in each record at z."""
        own = [plant.states[i] for i in self.own_starts]
        rows = (z * self.scale)[self.shared :].reshape(self.records, len(own))
        return [
            {v.name: float(np.clip(x, v.min, v.max)) for v, x in zip(own, row, strict=True)}
            for row in rows
        ]

    def rig(self, plant: Plant, measured: Sequence[str], known: Rig, z: Array) -> Rig:
        """The rig at z, with what was ``known`` of its dead times."""
        value, states = z * self.scale, [v.name for v in plant.states]

        def found(kind: str) -> list[tuple[Any, float]]:
            return [(key, float(value[j])) for j, key in self.of(kind)]

        delays = dict(known.delays)
        for members, late in found("delays"):
            delays |= {plant.inputs[i].name: late for i in members}
        return Rig(
            delays,
            {measured[i]: 1.0 + v for i, v in found("gains")},
            {measured[i]: v for i, v in found("offsets")},
            {states[i]: v for i, v in found("starts")},
            {(states[i], measured[k]): v for (i, k), v in found("corrections")},
        )


def known_rig(
    plant: Plant,
    measured: Sequence[str],
    delay: Any = 0.0,
    gains: Mapping[str, float] | None = None,
    offsets: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
    corrections: Mapping[tuple[str, str], float] | None = None,
) -> Rig:
    """A rig from what a user gave."""
    found: dict[str, float] = {}
    for names, ends in _delays(plant, delay):
        if isinstance(ends, tuple):
            raise InputError(f"delay of {names[0]} = {ends}: give seconds; a fit takes a range")
        found |= dict.fromkeys(names, ends)

    def state(argument: str, name: str) -> str:
        return named(argument, name, plant, "state").name

    def sensor(argument: str, name: str) -> str:
        return _seen(argument, name, plant, measured)

    return Rig(
        {n: d for n, d in found.items() if d},
        {sensor("gains", n): require_positive("gains", v) for n, v in (gains or {}).items()},
        {sensor("offsets", n): require_finite("offsets", v) for n, v in (offsets or {}).items()},
        {state("starts", n): require_finite("starts", v) for n, v in (starts or {}).items()},
        {
            (state("corrections", s), sensor("corrections", y)): require_finite("corrections", v)
            for (s, y), v in (corrections or {}).items()
        },
    )


def unknowns_of(
    plant: Plant,
    groups: Sequence[ParameterGroup],
    measured: Sequence[str],
    records: int,
    sampling: float,
    *,
    delay: Any = 0.0,
    gains: Sequence[str] = (),
    offsets: Sequence[str] = (),
    starts: Mapping[str, str] | Sequence[str] = (),
    correct: Mapping[str, Sequence[str]] | bool = False,
    pushed: Mapping[str, tuple[str, int]] | None = None,
    hidden: Mapping[int, Array] | None = None,
) -> tuple[RunUnknowns, Rig]:
    """What is sought, and the rig where the search begins. pushed : {disturbance: (measured name
    that corrects it, power of 1/s in its gain)}. hidden : {state: guesses of its start in each
    record}, of those that are found by default.
    """
    order = [v.name for v in plant.states]
    inputs = [v.name for v in plant.inputs]
    rows = [Unknown.of_group(g) for g in groups]
    known: dict[str, float] = {}
    for names, ends in _delays(plant, delay):
        if isinstance(ends, tuple):
            members = tuple(inputs.index(n) for n in names)
            label = "delay" if len(names) == len(inputs) else f"delay of {' = '.join(names)}"
            middle = sum(ends) / 2
            rows.append(Unknown.sized("delays", members, label, "s", middle, sampling, *ends))
            known |= dict.fromkeys(names, middle)
        else:
            known |= dict.fromkeys(names, ends)
    places = {n: i for i, n in enumerate(measured)}
    for entry in require_names("gains", gains):
        n = _seen("gains", entry, plant, measured)
        rows.append(Unknown("gains", places[n], f"{n}.gain", "1", 0.0, 1.0, -0.9, np.inf))
    for entry in require_names("offsets", offsets):
        n = _seen("offsets", entry, plant, measured)
        v, ends = plant.variable(n), (-np.inf, np.inf)
        rows.append(Unknown("offsets", places[n], f"{n}.offset", v.unit, 0.0, v.nominal, *ends))
    common, own = _starts(plant, starts, measured)
    rows += [Unknown.of_start(plant, place, "starts") for place in common]
    pulls = _corrections(plant, correct, measured, sampling, pushed or {})
    guesses = hidden or {}
    for r in range(records):
        for place in (*own, *guesses):
            row = Unknown.of_start(plant, place, "own_starts")
            guess = float(guesses[place][r]) / row.scale if place in guesses else row.guess
            rows.append(replace(row, name=f"{row.name[:-1]}, record {r + 1})", guess=guess))
    unknowns = RunUnknowns(tuple(rows), records, tuple(guesses)).with_more(*pulls)
    rig = Rig(
        {n: d for n, d in known.items() if d},
        corrections={(order[p.key[0]], measured[p.key[1]]): p.guess * p.scale for p in pulls},
    )
    return unknowns, rig


# ---- arguments ----------------------------------------------------------------------------------
def _delays(plant: Plant, given: Any) -> list[tuple[list[str], float | tuple[float, float]]]:
    """(inputs, seconds or range) of each entry."""
    inputs = [v.name for v in plant.inputs]
    if not isinstance(given, Mapping):
        given = {"*": given} if inputs else {}
    found: list[tuple[list[str], float | tuple[float, float]]] = []
    taken: set[str] = set()
    for entry, ends in given.items():
        names = (
            [n for n in inputs if fnmatchcase(n, entry)]
            if "*" in entry
            else [plant.variable(entry).name]
        )
        wrong = [n for n in names if n not in inputs] or ([] if names else [entry])
        if wrong:
            raise InputError(f"delay: {wrong[0]} is no input; inputs are {', '.join(inputs)}")
        if taken & set(names):
            raise InputError(f"delay names {sorted(taken & set(names))[0]} twice")
        taken |= set(names)
        found.append((names, delay_range(ends, require_finite)))
    return found


def delay_range(
    given: Any, checked: Callable[[str, Any, str], float]
) -> float | tuple[float, float]:
    """Seconds, or the range in which they are to be estimated."""
    if not isinstance(given, (tuple, list)):
        return checked("delay", given, "s")
    if len(given) != 2:
        raise InputError(f"delay = {given!r}: give seconds, or (low, high) to estimate it")
    low, high = (checked("delay", d, "s") for d in given)
    if not low < high:
        raise InputError(f"delay = ({low:g}, {high:g}) s: the lower must be the smaller")
    return low, high


def _seen(argument: str, name: str, plant: Plant, measured: Sequence[str]) -> str:
    known = plant.variable(name).name
    if known not in measured:
        raise InputError(f"{argument}: {known} is not measured; measured are {', '.join(measured)}")
    return known


def given_starts(
    plant: Plant, given: Mapping[str, str] | Sequence[str]
) -> list[tuple[str, str, list[str]]]:
    """(entry, way, its states) of the argument ``starts``."""
    order = [v.name for v in plant.states]
    ways = (
        dict(given)
        if isinstance(given, Mapping)
        else dict.fromkeys(require_names("starts", given), "all")
    )

    def states(entry: str) -> list[str]:
        if "*" in entry:
            return [n for n in order if fnmatchcase(n, entry)]
        return [named("starts", entry, plant, "state").name]

    return [(entry, way, states(entry)) for entry, way in ways.items()]


def _starts(
    plant: Plant, given: Mapping[str, str] | Sequence[str], measured: Sequence[str]
) -> tuple[list[int], list[int]]:
    """Positions of states with one start for all runs, and with one for each record."""
    order = [v.name for v in plant.states]
    common: list[int] = []
    own: list[int] = []
    for entry, way, names in given_starts(plant, given):
        if way not in ("all", "record", "plant"):
            raise InputError(f"starts[{entry!r}] = {way!r}: choose 'all', 'record' or 'plant'")
        for known in names:
            if known in measured:
                raise InputError(f"starts: {known} is measured, and so is where it starts")
            if way == "plant":
                continue
            (common if way == "all" else own).append(order.index(known))
    return common, own


def _corrections(
    plant: Plant,
    given: Mapping[str, Sequence[str]] | bool,
    measured: Sequence[str],
    sampling: float,
    pushed: Mapping[str, tuple[str, int]],
) -> list[Unknown]:
    """Gains that are sought: of a measured state, of its velocity in one sampling interval, of
    others. A measured state takes up none to all of its own error; others begin at zero.
    """
    order = [v.name for v in plant.states]
    velocities = {v: p for p, v in plant.positions.items() if p in measured}
    own = {n: [n] for n in order if n in measured} | {v: [p] for v, p in velocities.items()}
    if isinstance(given, Mapping):
        own |= {
            named("correct", s, plant, "state").name: [
                _seen("correct", y, plant, measured) for y in require_names("correct", ys)
            ]
            for s, ys in given.items()
        }
    elif not given:
        own = {}
    own |= {state: [name] for state, (name, _) in pushed.items()}
    rows = []
    for state, seen in own.items():
        for name in seen:
            x, y = plant.variable(state), plant.variable(name)
            unit = "1" if x.unit == y.unit else f"({x.unit})/({y.unit})"
            if state == name:
                ends = (0.9, 1.0, 0.0, 1.0)
            elif velocities.get(state) == name:
                ends = (0.4, 1 / sampling, 0.0, 1.0)
            elif state in pushed:
                ends = (TAKEN_UP, sampling ** -pushed[state][1], 0.0, 1.0)
            else:
                ends = (0.0, x.nominal / y.nominal, -np.inf, np.inf)
            key = (order.index(state), list(measured).index(name))
            label = f"correction of {state} by {name}"
            rows.append(Unknown("corrections", key, label, unit, *ends))
    return rows


# ---- unmeasured disturbances ---------------------------------------------------------------------
# What pushes a state and is forgotten with a rate. With gains that are fitted this is the
# innovation form of a coloured disturbance (L. Ljung, System Identification, 1999, 4.3): along the
# past of a start the observer finds how much is being pushed, and the run goes on with it.
FORGETTING = 5.0
"""Of forgetting, where the search begins [1/s]."""
FASTEST_FORGETTING = 200.0
TAKEN_UP = 0.02
"""What a disturbance takes up of an error within a sampling interval, where the search begins."""


def disturbed(
    plant: Plant, names: Sequence[str], measured: Sequence[str]
) -> tuple[Plant, tuple[str, ...], dict[str, tuple[str, int]]]:
    """The plant with a disturbance of the rate of each of these states; names of the rates with
    which they are forgotten; and by what each is corrected, in what unit of gain: 1/s where the
    pushed state itself is measured, 1/s^2 where its position is. ``w`` gets a state
    ``w.disturbance`` (d), zero at first, and a parameter ``w.disturbance_rate`` (r): w' = ... + d,
    d' = -r d.
    """
    positions = {w: q for q, w in plant.positions.items()}
    again = Redeclared(plant)
    rates, by, forgotten = again.equations(), dict[str, tuple[str, int]](), list[str]()
    for name in dict.fromkeys(plant.variable(n).name for n in names):
        v = plant.variable(name)
        if v.causality != "state":
            raise InputError(
                f"disturbance names {name}, which is no state; states are "
                f"{', '.join(x.name for x in plant.states)}"
            )
        seen, power = (name, 1) if name in measured else (positions.get(name, ""), 2)
        if seen not in measured:
            raise InputError(
                f"disturbance: neither {name} nor a position whose velocity it is was measured; "
                f"measured are {', '.join(measured)}"
            )
        push = again.state(
            f"{name}.disturbance",
            unit=per_second(v.unit),
            nominal=FORGETTING * v.nominal,
            description=f"not modelled, of the rate of {name}",
        )
        forget = again.made.parameter(
            f"{name}.disturbance_rate",
            FORGETTING,
            unit="1/s",
            nominal=FORGETTING,
            min=0.0,
            max=FASTEST_FORGETTING,
            description="with which it is forgotten",
        )
        rates[name] += push
        rates[f"{name}.disturbance"] = -forget * push
        by[f"{name}.disturbance"] = seen, power
        forgotten.append(f"{name}.disturbance_rate")
    return again.finished(rates), tuple(forgotten), by
