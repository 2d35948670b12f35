"""The catalogue: known muscles, from ``catalogue.toml``, each with source and range."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, cast

from ..core.errors import InputError, UnknownNameError, with_kinds
from ..core.stop import verb
from .law import LAWS, ForceLaw, SixParameterLaw
from .pneumatic_muscle import Muscle

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]


@cache
def _catalogue() -> dict[str, Any]:
    text = files(__package__).joinpath("catalogue.toml").read_text("utf-8")
    return cast(dict[str, Any], tomllib.loads(text))


def transfer_note() -> str:
    """What to know before a set of one laboratory is used on the muscle of another."""
    return " ".join(_catalogue()["transfer_note"].split())


def muscle_names() -> list[str]:
    """The names that :func:`muscle` knows.

    Examples
    --------
    >>> "DMSP-20-300" in pam.muscles.muscle_names()
    True
    """
    return [name for name, entry in _catalogue().items() if isinstance(entry, dict)]


def catalogue_entry(name: str) -> dict[str, Any]:
    """What the catalogue says of a muscle, as plain values; for lists and tables.

    Keys: ``law``, ``coefficients``, ``pressure_range`` [Pa], ``contraction_range`` [1],
    ``construction``, ``obtained``, ``source``, and where known ``rest_length`` [m],
    ``diameter`` [m], ``mass`` [kg], ``mass_per_length`` [kg/m], ``end_mass`` [kg], ``note``,
    ``data`` (a bundled table). :func:`attribution` has the rest.
    Raises UnknownNameError with the nearest names.
    """
    if name not in muscle_names():
        raise UnknownNameError("muscle", name, muscle_names())
    return dict(_catalogue()[name])


@dataclass(frozen=True)
class Attribution:
    """Whose numbers those of a muscle of the catalogue are, and how far they can be trusted.

    Examples
    --------
    >>> who = pam.muscles.attribution("DMSP-20-300")
    >>> who.confidence
    'high'
    """

    name: str
    measured: str
    """What was measured."""
    by: str
    where: str
    source: str
    obtained: str
    """"published", "transcribed" or "fitted here"."""
    confidence: str
    """"high", "medium" or "low"."""
    sure: str
    """Why, in a sentence."""

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.measured}, by {self.by} ({self.where}).\n"
            f"Source ({self.obtained}): {self.source}.\n"
            f"Confidence: {self.confidence}. {self.sure}"
        )


@with_kinds
def attribution(name: str) -> Attribution:
    """What is measured in an entry of the catalogue, where, by whom, and how sure it is.

    Raises UnknownNameError with the nearest names.

    Examples
    --------
    >>> pam.muscles.attribution("DMSP-20-300").by
    'M. Martens, I. Boblan'
    """
    entry = catalogue_entry(name)
    keys = ("measured", "measured_by", "measured_where", "source", "obtained", "confidence", "sure")
    return Attribution(name, *(entry[key] for key in keys))


def attribution_table() -> str:
    """Sources and confidence of all muscles as a table in Markdown: docs/muscles.md has it."""
    rows = [("muscle", "source", "confidence"), ("---",) * 3]
    for a in map(attribution, muscle_names()):
        rows.append((f"`{a.name}`", f"{a.source} ({a.obtained})", a.confidence))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def summary(name: str) -> str:
    """An entry in two lines for a list: law, size, range and construction; source."""
    entry = catalogue_entry(name)
    length, diameter = (
        f"{1e3 * entry[key]:g} mm" if key in entry else "not known"
        for key in ("rest_length", "diameter")
    )
    low, high = (p / 1e5 for p in entry["pressure_range"])
    return (
        f"{name:18} {entry['law']}; rest length {length}, inner diameter {diameter}; "
        f"{low:g} .. {high:g} bar, to {100 * entry['contraction_range'][1]:g} %; "
        f"{entry['construction']}, {entry['obtained']}\n{'':18} {entry['source']}"
    )


@verb
def muscle(name: str, *, rest_length: float | None = None) -> Muscle:
    """A muscle of the catalogue.

    rest_length : replaces the catalogue's [m]; needed where it holds none (DMSP-10).

    Raises UnknownNameError with the nearest names, InputError when a rest length is missing.

    Examples
    --------
    >>> muscle = pam.muscle("DMSP-20-300")
    >>> print(f"{muscle.force(6e5, 0.0):.0f} N")
    1793 N
    """
    entry = catalogue_entry(name)
    length = entry.get("rest_length") if rest_length is None else rest_length
    if length is None:
        raise InputError(
            f"muscle {name!r} has no rest length in the catalogue; give rest_length in metres, as "
            f"in muscle({name!r}, rest_length=0.25)"
        )
    return Muscle(
        _law(entry, entry.get("rest_length", length)),
        rest_length=entry.get("rest_length", length),
        diameter=entry.get("diameter"),
        pressure_range=tuple(entry["pressure_range"]),
        contraction_range=tuple(entry["contraction_range"]),
        name=name,
        source=entry["source"],
        note=" ".join(f"{entry.get('note', '')} {transfer_note()}".split()),
        mass=entry.get("mass"),
        mass_per_length=entry.get("mass_per_length", 0.0),
        end_mass=entry.get("end_mass", 0.0),
        construction=entry["construction"],
        obtained=entry["obtained"],
    ).with_rest_length(length)


def _law(entry: dict[str, Any], rest_length: float) -> ForceLaw:
    """A list of coefficients is as published (bar, percent), a table is in SI."""
    coefficients = entry["coefficients"]
    if isinstance(coefficients, list):
        return SixParameterLaw.from_published(coefficients)
    law = LAWS[entry["law"]]
    if "rest_length" in law.fixed_coefficients():
        coefficients = {**coefficients, "rest_length": rest_length}
    return law(**coefficients)
