"""The catalogue: known muscles, from ``catalogue.toml``, each with source and range."""

from __future__ import annotations

import sys
from functools import cache
from importlib.resources import files
from typing import Any

from ..errors import InputError, UnknownNameError
from .force import SixParameterLaw
from .muscle import Muscle

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["muscle", "muscle_names", "transfer_note"]


@cache
def _catalogue() -> dict[str, Any]:
    return tomllib.loads(files(__package__).joinpath("catalogue.toml").read_text("utf-8"))


def transfer_note() -> str:
    """What to know before a set of one laboratory is used on the muscle of another."""
    return " ".join(_catalogue()["transfer_note"].split())


def muscle_names() -> list[str]:
    """The names that :func:`muscle` knows."""
    return [name for name, entry in _catalogue().items() if isinstance(entry, dict)]


def muscle(name: str, *, rest_length: float | None = None) -> Muscle:
    """A muscle of the catalogue.

    rest_length : replaces the catalogue's [m]; needed where it holds none (DMSP-10).

    Raises UnknownNameError with the nearest names, InputError when a rest length is missing.
    """
    if name not in muscle_names():
        raise UnknownNameError("muscle", name, muscle_names())
    entry = _catalogue()[name]
    length = entry.get("rest_length") if rest_length is None else rest_length
    if length is None:
        raise InputError(
            f"muscle {name!r} has no rest length in the catalogue; "
            f"give rest_length in metres, as in muscle({name!r}, rest_length=0.25)"
        )
    return Muscle(
        SixParameterLaw.from_published(entry["coefficients"]),
        rest_length=length,
        diameter=entry.get("diameter"),
        pressure_range=tuple(entry["pressure_range"]),
        contraction_range=tuple(entry["contraction_range"]),
        name=name,
        source=entry["source"],
        note=" ".join(f"{entry.get('note', '')} {transfer_note()}".split()),
    )
