"""What stands between a plant and a record of it: dead times, sensors, starts, a correction by what
is measured; each known, or to be estimated along with the plant's parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_finite, require_names, require_positive
from ...plants.plant import Plant
from ..statistics import Array
from .disturbances import GAIN
from .experiment import ParameterGroup, named

__all__ = ["Delay", "Rig", "RunUnknowns", "given_starts", "known_rig", "unknowns_of"]

Delay: TypeAlias = "float | tuple[float, float] | Mapping[str, float | tuple[float, float]]"
"""[s] of all inputs, or by input (a name or a pattern: those have one delay in common); a pair is
the range in which it is estimated.
"""


@dataclass(frozen=True)
class Rig:
    """Known figures of a rig.

    delays : {input: dead time [s]}. gains, offsets : {measured variable: of its sensor}: it shows
    gain x + offset. starts : {state that is not measured: where runs begin}. corrections : {(state,
    measured variable): what the state gains per unit by which the model is behind}.
    """

    delays: Mapping[str, float] = field(default_factory=dict)
    gains: Mapping[str, float] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    corrections: Mapping[tuple[str, str], float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RunUnknowns:
    """Everything that is sought in free runs, scaled: z = (parameters, dead times, gains - 1,
    offsets, starts, corrections, starts of each record).

    delays : of each, the positions of its inputs. gains, offsets : positions among the measured
    names. starts, own_starts : positions of states whose start is one for all runs, or one for each
    record. corrections : positions (state, measured name). along : those of ``own_starts`` that
    hold for the begin of a record: runs begin where the plant has come by then.
    """

    groups: Sequence[ParameterGroup] = ()
    delays: Sequence[tuple[int, ...]] = ()
    gains: Sequence[int] = ()
    offsets: Sequence[int] = ()
    starts: Sequence[int] = ()
    corrections: Sequence[tuple[int, int]] = ()
    own_starts: Sequence[int] = ()
    along: Sequence[int] = ()
    records: int = 1
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    guess: Array = field(default_factory=lambda: np.empty(0))
    scale: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))

    @property
    def shared(self) -> int:
        """How many unknowns are the same for all records."""
        return len(self.names) - len(self.own_starts) * self.records

    def places(self, kind: str) -> NDArray[np.intp]:
        """Positions of one kind of unknowns in z."""
        kinds = ("groups", "delays", "gains", "offsets", "starts", "corrections")
        first = 0
        for name in kinds:
            count = len(getattr(self, name))
            if name == kind:
                return np.arange(first, first + count)
            first += count
        return np.arange(first, len(self.names))

    def moved(self, kind: str, value: float, low: float, high: float) -> RunUnknowns:
        """With all unknowns of a kind at a value, within bounds."""
        at, found = self.places(kind), {}
        for name, number in (("guess", value), ("low", low), ("high", high)):
            found[name] = getattr(self, name).copy()
            found[name][at] = number / self.scale[at]
        return replace(self, **found)

    def with_delay(
        self,
        inputs: tuple[int, ...],
        name: str,
        scale: float,
        guess: float,
        low: float,
        high: float,
    ) -> RunUnknowns:
        """With one more dead time [s], that of the inputs at these positions."""
        at = len(self.groups) + len(self.delays)
        return replace(
            self,
            delays=(*self.delays, inputs),
            names=(*self.names[:at], name, *self.names[at:]),
            units=(*self.units[:at], "s", *self.units[at:]),
            guess=np.insert(self.guess, at, guess / scale),
            scale=np.insert(self.scale, at, scale),
            low=np.insert(self.low, at, low / scale),
            high=np.insert(self.high, at, high / scale),
        )

    @property
    def of_model(self) -> NDArray[np.intp]:
        """Positions in z of what belongs to plant and sensors, not to an observer or a start."""
        kinds = ("groups", "delays", "gains", "offsets")
        return np.concatenate([self.places(k) for k in kinds]).astype(np.intp)

    def of_motions(self, plant: Plant, motions: int) -> RunUnknowns:
        """What belongs to the model, and where every state begins in each of so many motions."""
        kept = self.of_model
        low, high, nominal = (plant.vector("state", attribute=a) for a in ("min", "max", "nominal"))
        starts = [f"start {i}" for i in range(motions * len(nominal))]
        return RunUnknowns(
            groups=self.groups,
            delays=self.delays,
            gains=self.gains,
            offsets=self.offsets,
            own_starts=tuple(range(len(nominal))),
            records=motions,
            names=(*(self.names[i] for i in kept), *starts),
            scale=np.concatenate([self.scale[kept], np.tile(nominal, motions)]),
            low=np.concatenate([self.low[kept], np.tile(low / nominal, motions)]),
            high=np.concatenate([self.high[kept], np.tile(high / nominal, motions)]),
        )

    def parameters(self, plant: Plant, z: Array) -> dict[str, float]:
        """Values of the plant's parameters at z."""
        return {
            plant.parameters[m].name: float(v * g.scale)
            for g, v in zip(self.groups, z, strict=False)
            for m in g.members
        }

    def vector(self, plant: Plant, z: Any) -> Any:
        """All parameters of the plant at z, a vector of CasADi."""
        base = plant.vector("parameter")
        place = np.zeros((len(base), len(self.groups)))
        for j, group in enumerate(self.groups):
            place[list(group.members), j] = group.scale
            base[list(group.members)] = 0.0
        return ca.DM(base) + ca.sparsify(ca.DM(place)) @ z[: len(self.groups)]

    def sensors(self, measured: Sequence[str], known: Rig, z: Any) -> tuple[list[Any], list[Any]]:
        """Gains and offsets of the sensors at z, numbers or symbols."""
        gains: list[Any] = [known.gains.get(n, 1.0) for n in measured]
        offsets: list[Any] = [known.offsets.get(n, 0.0) for n in measured]
        for i, j in zip(self.gains, self.places("gains").tolist(), strict=True):
            gains[i] = 1 + z[j]
        for i, j in zip(self.offsets, self.places("offsets").tolist(), strict=True):
            offsets[i] = z[j] * self.scale[j]
        return gains, offsets

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

        def found(kind: str, keys: Sequence[Any], first: float = 0.0) -> dict[Any, float]:
            return {
                k: first + float(value[j]) for k, j in zip(keys, self.places(kind), strict=True)
            }

        delays = dict(known.delays)
        for members, late in found("delays", self.delays).items():
            delays |= {plant.inputs[i].name: late for i in members}
        return Rig(
            delays,
            found("gains", [measured[i] for i in self.gains], 1.0),
            found("offsets", [measured[i] for i in self.offsets]),
            found("starts", [states[i] for i in self.starts]),
            found("corrections", [(states[i], measured[k]) for i, k in self.corrections]),
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
    return Rig(
        {n: d for n, d in found.items() if d},
        {
            _seen("gains", n, plant, measured): require_positive("gains", v)
            for n, v in (gains or {}).items()
        },
        {
            _seen("offsets", n, plant, measured): require_finite("offsets", v)
            for n, v in (offsets or {}).items()
        },
        {
            named("starts", n, plant, "state").name: require_finite("starts", v)
            for n, v in (starts or {}).items()
        },
        {
            (
                named("corrections", s, plant, "state").name,
                _seen("corrections", y, plant, measured),
            ): require_finite("corrections", v)
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
    """What is sought, and the rig where the search begins.

    pushed : {disturbance: (measured name that corrects it, power of 1/s in its gain)}. hidden :
    {state: guesses of its start in each record}, of those that are found by default.
    """
    order = [v.name for v in plant.states]
    inputs = [v.name for v in plant.inputs]
    rows: list[tuple[str, str, float, float, float, float]] = [
        (g.name, g.unit, g.value / g.scale, g.scale, g.low / g.scale, g.high / g.scale)
        for g in groups
    ]
    free_delays: list[tuple[int, ...]] = []
    known: dict[str, float] = {}
    for names, ends in _delays(plant, delay):
        if isinstance(ends, tuple):
            low, high = ends
            free_delays.append(tuple(inputs.index(n) for n in names))
            label = "delay" if len(names) == len(inputs) else f"delay of {' = '.join(names)}"
            middle = (low + high) / 2
            rows.append((label, "s", middle / sampling, sampling, low / sampling, high / sampling))
            known |= dict.fromkeys(names, middle)
        else:
            known |= dict.fromkeys(names, ends)
    gained = [_place("gains", n, plant, measured) for n in require_names("gains", gains)]
    shifted = [_place("offsets", n, plant, measured) for n in require_names("offsets", offsets)]
    rows += [(f"{measured[i]}.gain", "1", 0.0, 1.0, -0.9, np.inf) for i in gained]
    for i in shifted:
        variable = plant.variable(measured[i])
        rows.append(
            (f"{variable.name}.offset", variable.unit, 0.0, variable.nominal, -np.inf, np.inf)
        )
    common, own = _starts(plant, starts, measured)
    begin = [_start_row(plant, s) for s in common]
    rows += begin
    pulls, values = _corrections(plant, correct, measured, sampling, pushed or {})
    rows += values
    guesses = dict(hidden or {})
    for r in range(records):
        for place in (*own, *guesses):
            name, unit, value, size, low, high = _start_row(plant, place)
            if place in guesses:
                value = float(guesses[place][r]) / size
            rows.append((f"{name[:-1]}, record {r + 1})", unit, value, size, low, high))
    guess, scale, low_z, high_z = np.array([r[2:] for r in rows], dtype=float).reshape(-1, 4).T
    unknowns = RunUnknowns(
        tuple(groups),
        tuple(free_delays),
        tuple(gained),
        tuple(shifted),
        tuple(common),
        tuple(pulls),
        (*own, *guesses),
        tuple(guesses),
        records,
        tuple(r[0] for r in rows),
        tuple(r[1] for r in rows),
        guess,
        scale,
        low_z,
        high_z,
    )
    rig = Rig(
        {n: d for n, d in known.items() if d},
        corrections={
            (order[s], measured[y]): v[2] * v[3] for (s, y), v in zip(pulls, values, strict=True)
        },
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
        if isinstance(ends, (tuple, list)):
            if len(ends) != 2:
                raise InputError(f"delay = {ends!r}: give seconds, or (low, high) to estimate it")
            low, high = (require_finite("delay", d, "s") for d in ends)
            if not low < high:
                raise InputError(f"delay = ({low:g}, {high:g}) s: the lower must be the smaller")
            found.append((names, (low, high)))
        else:
            found.append((names, require_finite("delay", ends, "s")))
    return found


def _place(argument: str, name: str, plant: Plant, measured: Sequence[str]) -> int:
    return list(measured).index(_seen(argument, name, plant, measured))


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


def _start_row(plant: Plant, place: int) -> tuple[str, str, float, float, float, float]:
    v = plant.states[place]
    return (
        f"{v.name}(0)",
        v.unit,
        float(v.start or 0.0) / v.nominal,
        v.nominal,
        v.min / v.nominal,
        v.max / v.nominal,
    )


def _corrections(
    plant: Plant,
    given: Mapping[str, Sequence[str]] | bool,
    measured: Sequence[str],
    sampling: float,
    pushed: Mapping[str, tuple[str, int]],
) -> tuple[list[tuple[int, int]], list[tuple[str, str, float, float, float, float]]]:
    """Positions (state, measured name) of gains that are sought, and their rows.

    A measured state takes up a part of its own error (from none to all), its velocity what of it
    lies within one sampling interval; others begin at zero.
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
    places, rows = [], []
    for state, seen in own.items():
        for name in seen:
            places.append((order.index(state), list(measured).index(name)))
            label = f"correction of {state} by {name}"
            x, y = plant.variable(state), plant.variable(name)
            unit = "1" if x.unit == y.unit else f"({x.unit})/({y.unit})"
            if state == name:
                rows.append((label, unit, 0.9, 1.0, 0.0, 1.0))
            elif velocities.get(state) == name:
                rows.append((label, unit, 0.4, 1 / sampling, 0.0, 1.0))
            elif state in pushed:
                rows.append((label, unit, GAIN, sampling ** -pushed[state][1], 0.0, 1.0))
            else:
                rows.append((label, unit, 0.0, x.nominal / y.nominal, -np.inf, np.inf))
    return places, rows
