"""The catalogue of valves, from ``valves.toml``, each with its source."""

from __future__ import annotations

import sys
from functools import cache
from importlib.resources import files
from typing import Any, cast

from ..core.errors import UnknownNameError
from ..core.stop import verb
from ..muscles.gas import conductance_from_flow
from .kinds import FEEDS
from .spools import FirstOrderSpool
from .valves import GasFeed

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found, unused-ignore]

__all__ = ["valve", "valve_entry", "valve_names"]

_TAKEN = ("conductance", "exhaust_conductance", "critical_ratio")


@cache
def _catalogue() -> dict[str, dict[str, Any]]:
    text = files(__package__).joinpath("valves.toml").read_text("utf-8")
    return cast(dict[str, dict[str, Any]], tomllib.loads(text))


def valve_names() -> list[str]:
    """The names that :func:`valve` knows.

    Examples
    --------
    >>> len(pam.feeds.valve_names()) > 2
    True
    """
    return list(_catalogue())


def valve_entry(name: str) -> dict[str, Any]:
    """What the catalogue says of a valve: figures, ``source``, ``how_sure``.

    Raises UnknownNameError with the nearest names.
    """
    if name not in _catalogue():
        raise UnknownNameError("valve", name, valve_names())
    return dict(_catalogue()[name])


@verb
def valve(name: str, **arguments: Any) -> GasFeed:
    """The feed of a valve of the catalogue, a ``SpoolValve`` or ``OnOffValves``.

    arguments : of the feed besides, such as ``supply=5e5``, ``tube=...``; they go before the
        catalogue's. See :func:`valve_entry` for the source, and what it does not know.

    Raises UnknownNameError with the nearest names.

    Examples
    --------
    >>> feed = pam.feeds.valve(pam.feeds.valve_names()[0], supply=5e5)
    >>> feed.supply
    500000.0
    """
    entry = valve_entry(name)
    known = {key: entry[key] for key in _TAKEN if key in entry}
    if "nominal_flow" in entry:
        known["conductance"] = conductance_from_flow(entry["nominal_flow"])
    if "spool_time" in entry:
        known["spool"] = FirstOrderSpool(entry["spool_time"])
    return cast(GasFeed, FEEDS[entry["feed"]](**{**known, **arguments}))
