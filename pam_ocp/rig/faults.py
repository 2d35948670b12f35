"""Faults that a twin is given: from when to when, where, and how much."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..core.errors import InputError, UnknownNameError
from ..core.quantities import known_keys, quantity

__all__ = ["FAULTS", "Fault", "faults_of"]

FAULTS: dict[str, str] = {
    "stuck": "a reading stays where it is",
    "nan": "a reading is no number",
    "bias": "a reading is shifted by value",
    "gain": "a reading is multiplied by value",
    "drift": "a reading drifts by value per second",
    "spike": "a reading jumps by value at every other look",
    "valve": "a command has no effect any more: the last one stays",
    "dead_zone": "commands less than value from their vent value have no effect",
    "cable": "nothing is answered, and nothing arrives",
    "stale": "the same answer again and again, with its time",
    "supply": "the supply is lost: all commands act as vented",
}
"""Kinds, in words."""
OF_A_READING = ("stuck", "nan", "bias", "gain", "drift", "spike")
OF_A_COMMAND = ("valve", "dead_zone")
SIZED = ("bias", "gain", "drift", "spike", "dead_zone")


@dataclass(frozen=True)
class Fault:
    """What goes wrong in a twin.

    kind : one of ``FAULTS``. channel : the reading or command that it concerns. value : its size in
    SI, of those that have one. at, until : [s] after the twin began.

    Examples
    --------
    >>> pam.rig.Fault("stuck", "x", at=2.0).on(2.5)
    True
    """

    kind: str
    channel: str = ""
    value: float = math.nan
    at: float = 0.0
    until: float = math.inf

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise UnknownNameError("kind of fault", self.kind, FAULTS)
        if bool(self.channel) != (self.kind in OF_A_READING + OF_A_COMMAND):
            needs = "no channel" if self.channel else "the channel that it concerns"
            raise InputError(f"fault {self.kind!r} ({FAULTS[self.kind]}): give it {needs}")
        if math.isfinite(self.value) != (self.kind in SIZED):
            raise InputError(
                f"fault {self.kind!r} ({FAULTS[self.kind]}): value = {self.value:g}; give it "
                + ("a finite value" if self.kind in SIZED else "none")
            )
        if not self.at < self.until:
            raise InputError(f"fault {self.kind!r}: at = {self.at:g} s must be before until")

    def on(self, t: float) -> bool:
        """Whether it acts, at a time after the beginning [s]."""
        return self.at <= t < self.until


def faults_of(given: Iterable[Any], units: Mapping[str, str]) -> tuple[Fault, ...]:
    """Faults of tables, as ``[[fault]]`` of a file holds them. units : of the channels, SI."""
    found = []
    for said in given:
        if isinstance(said, Fault):
            found.append(said)
            continue
        if not isinstance(said, Mapping):
            raise InputError(
                f"fault = {said!r}: give a table, as {{ kind = 'stuck', channel = 'x' }}"
            )
        known_keys("fault", said, ("kind", "channel", "value", "at", "until"))
        kind, channel = said.get("kind"), str(said.get("channel", ""))
        plain = ("1",) if kind == "gain" else (units.get(channel, "1"), "1")
        per = (f"{units[channel]}/s",) if kind == "drift" and channel in units else plain
        options = {n: quantity(f"fault.{n}", said[n], "s") for n in ("at", "until") if n in said}
        if "value" in said:
            options["value"] = quantity("fault.value", said["value"], *per)
        found.append(Fault(str(kind), channel, **options))
    for fault in found:
        if fault.channel and fault.channel not in units:
            raise UnknownNameError("channel of the twin", fault.channel, units)
    return tuple(found)
