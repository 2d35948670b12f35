"""The rungs of a ladder of models: a plant of an arrangement, each with one thing more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from ...core.errors import InputError, UnknownNameError, require_instance
from ...plants.feeds import DeadTime, Regulator
from ...plants.losses import CoulombFriction, Creep, MaxwellSlip
from ...plants.plant import Plant
from .experiment import groups

__all__ = ["LADDER", "Builder", "Rung", "rungs_of"]

LADDER = ("static", "lag", "dead time", "slew", "friction", "memory", "creep")
"""What there is to climb, in this order."""
SLIP_YIELDS = (0.003, 0.015)
"""Contractions at which the elements of the memory slide; their forces are fitted."""


class Builder(Protocol):
    """What makes the plant of a rung: ``partial(pam.AntagonisticSlide, muscle, 2.0)``, a class, or
    a function of one's own.
    """

    def __call__(self, *, feed: Any, losses: Any) -> Plant: ...


@dataclass(frozen=True, eq=False)
class Rung:
    """A model to be tried.

    plant : with start values; where it has a parameter of the rung before, it begins with what was
    found there. free : as for :func:`fit_plant`. starts : values of parameters [SI], from each of
    which the fit begins once; the best goes on. static : the plant counts as at rest at each
    moment. fast : {parameters: parts}: starts are these parts of the fastest rate of pressures in
    the rung before.

    Examples
    --------
    >>> rung = pam.fitting.Rung("lag", plant, ("mass", "muscle.lag"))
    >>> rung.name, rung.static
    ('lag', False)
    """

    name: str
    plant: Plant
    free: tuple[str | tuple[str, ...], ...]
    starts: tuple[Mapping[str, float], ...] = ({},)
    static: bool = False
    fast: Mapping[str, Sequence[float]] = field(default_factory=dict)


def rungs_of(
    build: Builder,
    free: Sequence[str | Sequence[str]] = (),
    *,
    feed: Regulator | None = None,
    dynamic: Sequence[str | Sequence[str]] | None = None,
    names: Sequence[str] = LADDER,
) -> list[Rung]:
    """The rungs of :func:`fit_ladder` for an arrangement; see there.

    One start of each is (nearly) the rung before, so that no rung fits worse than it.
    """
    regulator = require_instance(
        "feed", feed or Regulator(), Regulator, "give a Regulator or PairRegulator"
    )
    unknown = [n for n in names if n not in LADDER]
    if unknown:
        raise UnknownNameError("rung", unknown[0], LADDER)
    steps = [n for n in LADDER if n in names]
    if not steps:
        raise InputError(f"rungs is empty: name some of {', '.join(LADDER)}")
    found: list[Rung] = []
    parts: dict[str, Any] = {"dead_time": None, "slew": None, "venting_slew": None}
    losses: tuple[Any, ...] = ()
    own: list[str] = []
    for name in steps:
        starts: list[dict[str, float]] = [{}]
        fast: dict[str, Sequence[float]] = {}
        if name == "lag":
            own += ["lag"] + (["venting_lag"] if regulator.venting_lag is not None else [])
            starts = [dict.fromkeys(own, value) for value in (0.002, 0.02, 0.1)]
        elif name == "dead time":
            given = regulator.dead_time
            line = given if isinstance(given, DeadTime) else DeadTime(0.01, order=3)
            parts["dead_time"] = line
            starts = [{"dead_time": value} for value in (0.001, 0.004, 0.02, 0.06)]
            own += ["dead_time"]
        elif name == "slew":
            parts["slew"] = regulator.slew or 1e6
            fast = {"slew": (3.0, 0.9, 0.5, 0.25)}
            own += ["slew"]
        elif name == "friction":
            losses += (CoulombFriction(5.0, speed=3e-3),)
            starts = [{"friction_constant": value} for value in (0.0, 1.0, 8.0)]
            own += ["friction_constant"]
        elif name == "memory":
            losses += (MaxwellSlip((2.0, 2.0), SLIP_YIELDS, edge=1.0),)
            starts = [{"slip1_force": v, "slip2_force": v} for v in (0.0, 1.0, 6.0)]
            own += ["slip1_force", "slip2_force"]
        elif name == "creep":
            losses += (Creep((200.0,), (1.0,)),)
            starts = [
                {"creep1_stiffness": k, "creep1_time": v}
                for k, v in ((0.1, 1.0), (100.0, 0.3), (100.0, 3.0))
            ]
            own += ["creep1_stiffness", "creep1_time"]
        plant = build(feed=replace(regulator, **parts), losses=losses)
        static = name == "static"
        chosen = [*_present(plant, free)]
        if not static:
            moving = ("damping", "damping_ratio") if dynamic is None else dynamic
            chosen += _present(plant, moving, dynamic is not None)
            chosen += [_tied(plant, key) for key in own]
        by_name = tuple({n: v for k, v in s.items() for n in _tied(plant, k)} for s in starts)
        by_rate = {n: p for k, p in fast.items() for n in _tied(plant, k)}
        label = name if not found else f"+ {name}"
        found.append(Rung(label, plant, tuple(chosen), by_name, static, by_rate))
    return found


def _tied(plant: Plant, key: str) -> tuple[str, ...]:
    """All parameters called so, of whatever muscle: equal in a ladder."""
    names = [v.name for v in plant.parameters if v.name.rpartition(".")[2] == key]
    return tuple(names)


def _present(
    plant: Plant, wanted: Sequence[str | Sequence[str]], required: bool = True
) -> list[str | tuple[str, ...]]:
    """Entries of free; of defaults those that the plant has."""
    known = {v.name for v in plant.parameters}
    found: list[str | tuple[str, ...]] = []
    for entry in wanted:
        plain = entry if isinstance(entry, str) else tuple(entry)
        if required or plain in known:
            found.append(plain)
    groups(plant, found)  # refuses what is no parameter
    return found


def starting(rung: Rung, before: Mapping[str, float], rate: float) -> list[Plant]:
    """The plants from which the fit of a rung begins.

    before : values found on the rung before. rate : the fastest of a pressure there [Pa/s].
    """
    known = {v.name: v for v in rung.plant.parameters}
    kept = {n: v for n, v in before.items() if n in known}
    ways = [dict(s) for s in rung.starts]
    if rung.fast:
        count = len(next(iter(rung.fast.values())))
        rates = [{n: rate * parts[i] for n, parts in rung.fast.items()} for i in range(count)]
        ways = [{**a, **b} for a in ways for b in rates]
    found = []
    for way in ways:
        values = {**kept, **way}
        inside = {n: float(np.clip(v, known[n].min, known[n].max)) for n, v in values.items()}
        found.append(rung.plant.with_values(inside))
    return found
