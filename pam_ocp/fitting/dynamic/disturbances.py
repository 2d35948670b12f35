"""Unmeasured disturbances beside a plant: what pushes a state and is forgotten with a rate.

With gains that are fitted this is the innovation form of a coloured disturbance (L. Ljung, System
Identification, 1999, 4.3): along the past of a start the observer finds how much is being pushed,
and the run goes on with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ...core.errors import InputError
from ...core.units import per_second
from ...plants.plant import Plant
from ...plants.undelayed import Redeclared

__all__ = ["Disturbances", "disturbed"]

RATE = 5.0
"""Of forgetting, where the search begins [1/s]."""
FASTEST = 200.0
GAIN = 0.02
"""What a disturbance takes up of an error within a sampling interval, where the search begins."""


@dataclass(frozen=True, eq=False)
class Disturbances:
    """A plant with disturbance states: their rates, by what they are corrected, and in what unit
    of gain: 1/s where the pushed state itself is measured, 1/s^2 where its position is.
    """

    plant: Plant
    rates: tuple[str, ...] = ()
    by: Mapping[str, tuple[str, int]] = field(default_factory=dict)


def disturbed(plant: Plant, names: Sequence[str], measured: Sequence[str]) -> Disturbances:
    """The plant with a disturbance of the rate of each of these states.

    ``w`` gets a state ``w.disturbance`` (d) and a parameter ``w.disturbance_rate`` (r): w' = ... +
    d, d' = -r d. It begins at zero, so that the plant by itself is what it was.
    """
    positions = {w: q for q, w in plant.positions.items()}
    by: dict[str, tuple[str, int]] = {}
    for name in names:
        variable = plant.variable(name)
        if variable.causality != "state":
            raise InputError(
                f"disturbance names {variable.name}, which is no state; states are "
                f"{', '.join(v.name for v in plant.states)}"
            )
        seen, power = variable.name, 1
        if seen not in measured:
            seen, power = positions.get(variable.name, ""), 2
        if seen not in measured:
            raise InputError(
                f"disturbance: neither {variable.name} nor a position whose velocity it is was "
                f"measured; measured are {', '.join(measured)}"
            )
        by[variable.name] = seen, power
    made = _with(plant, list(by))
    return Disturbances(
        made,
        tuple(f"{n}.disturbance_rate" for n in by),
        {f"{n}.disturbance": way for n, way in by.items()},
    )


def _with(plant: Plant, pushed: Sequence[str]) -> Plant:
    again = Redeclared(plant)
    rates, pushes = again.equations(), {}
    for name in pushed:
        v = plant.variable(name)
        push = again.state(
            f"{name}.disturbance",
            unit=per_second(v.unit),
            nominal=RATE * v.nominal,
            description=f"not modelled, of the rate of {name}",
        )
        forget = again.made.parameter(
            f"{name}.disturbance_rate",
            RATE,
            unit="1/s",
            nominal=RATE,
            min=0.0,
            max=FASTEST,
            description="with which it is forgotten",
        )
        rates[name] += push
        pushes[f"{name}.disturbance"] = -forget * push
    return again.finished(rates | pushes)
